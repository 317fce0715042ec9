"""All processes from one program: as those that are started one by one, and with less memory."""

import os
import signal
import socket
import subprocess
from pathlib import Path

import pytest
from logs_for_nodes import MAPPED_SCANS as SCANS
from logs_for_nodes import is_alive
from test_ros_localization import NODES, Nodes

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")


class ForkedNodes(Nodes):
    """The five processes, forked from one program."""

    def __init__(self, start, listener, **parameters):
        self.program = start("all", preload=False, **parameters)
        super().__init__(self.start_other(start), listener)

    def start_other(self, start):
        return lambda name, *arguments, **others: self.program if name in NODES else start(name, *arguments, **others)

    def pids(self):
        """{name of the OS process: pid}."""
        listed = subprocess.run(["pgrep", "-P", str(self.program.pid)], capture_output=True, text=True, check=False)
        return {Path(f"/proc/{pid}/comm").read_text().strip(): int(pid) for pid in listed.stdout.split()}


def shared_bytes(pid):
    """Memory that an OS process has in common with others, and that is not of a file."""
    rows = dict(line.split(":") for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:])
    return 1024 * int(rows["Shared_Dirty"].split()[0])


def test_a_node_that_is_killed_is_forked_again_and_the_map_is_whole(corridor, listener, start, tmp_path):
    nodes = ForkedNodes(start, listener, recovery=tmp_path / "recovery")
    system = f"{socket.gethostname()}-{nodes.program.pid}"
    nodes.until(lambda: nodes.diagnosis("tsbi")["system"] == system)
    nodes.drive(corridor[0], 0)
    nodes.until(lambda: len(nodes.estimates) >= SCANS // 3)
    before = nodes.pids()
    assert set(before) == {f"hmt_slam_{name}" for name in NODES}
    assert all(shared_bytes(pid) > 20e6 for pid in before.values())
    os.kill(before["hmt_slam_tsbi"], signal.SIGKILL)
    nodes.until(lambda: len(nodes.estimates) == SCANS)
    after = nodes.pids()
    assert {name for name in before if after[name] != before[name]} == {"hmt_slam_tsbi"}
    nodes.park()
    nodes.program.send_signal(signal.SIGINT)
    assert nodes.program.wait(20) == 0
    assert not any(map(is_alive, after.values()))


def test_a_node_that_cannot_start_ends_all_with_its_sentence(start):
    program = start("all", preload=False, filter__particles=0)
    _, error = program.communicate(timeout=60)
    assert program.returncode == 2
    assert "filter.particles" in error
    assert "all others with it" in error
    assert "Traceback" not in error
