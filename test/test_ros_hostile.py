"""A participant that sends what cannot be right: no node ends, stalls or grows, and the map is the same to the byte."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from urllib.request import urlopen

import pytest
from logs_for_nodes import corridor_bag
from preloaded import hmt_slam
from test_ros_replay import children_of
from test_ros_two_systems import free_port

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.process_memory import current_rss
from hmt_slam_ros.process_table import DOCUMENTS, PROCESSES, node_command, process_names
from hmt_slam_ros.ros.replay import replay

ROOT = Path(__file__).resolve().parent.parent
NODES = {*process_names(), "robot", "view", "explorer"}
BEFORE = 30
"""Scans before the attack, in which all nodes take the memory that they need."""
SCANS = 200
GROWTH = 60e6
"""Memory that a node may take for what it refuses, bytes: DDS keeps buffers of the size of the largest messages."""
ANSWER_TIME = 30.0
"""Time in which each request is answered, s, on a computer with two cores that all nodes share."""
FORCED = ("trajectory.tum", "trajectory_online.tum", "pmf.csv", "map.pgm", "hmt_map/map.json", "hmt_map/map.bin")


def environment_of(pid):
    """Environment of an OS process."""
    entries = Path(f"/proc/{pid}/environ").read_bytes().decode().split("\0")
    return dict(entry.partition("=")[::2] for entry in entries if entry)


def watch_page(port):
    """Be a browser, for which the page receives the map."""
    with suppress(OSError), urlopen(f"http://127.0.0.1:{port}/news", timeout=60) as stream:
        for _ in stream:
            pass


class Attack:
    """The stranger, started when a run is under way; memory and process ids of the nodes before and after."""

    def __init__(self, folder, port):
        self.report, self._folder, self._process, self._port = folder / "report.json", folder, None, port
        self.pids, self.before, self.after = {}, {}, {}
        self._explorer = None

    def watch(self, scans):
        """To be called with the number of scans that have a pose."""
        if self._explorer is None and scans >= 1:
            self._explorer = self._start_explorer()
        if self._process is None and scans >= BEFORE:
            threading.Thread(target=watch_page, args=(self._port,), daemon=True).start()
            self.pids = children_of(os.getpid())
            command = [sys.executable, str(ROOT / "test" / "hostile.py"), str(self.report)]
            with (self._folder / "stranger.log").open("w") as log:
                self._process = subprocess.Popen(command, env=environment_of(self.pids["slam"]), stdout=log, stderr=log)
        if self._process is not None:
            assert self._process.poll() is None, (self._folder / "stranger.log").read_text()
        ready = self.report.with_suffix(".ready")
        if ready.exists():
            self.before = {name: current_rss(pid) for name, pid in self.pids.items()}
            ready.unlink()
        if self.report.exists() and not self.after:
            assert children_of(os.getpid()) == self.pids
            self.after = {name: current_rss(pid) for name, pid in self.pids.items()}

    def _start_explorer(self):
        """An explorer beside the replay, that has nothing to do."""
        slam = children_of(os.getpid())["slam"]
        words = Path(f"/proc/{slam}/cmdline").read_text().split("\0")
        system = next(word for word in words if word.startswith("system:="))
        settings = [system, "explorer.explores:=false", "explorer.drive:=goals"]
        parameters = [word for setting in settings for word in ("-p", setting)]
        command = [sys.executable, *node_command("explorer"), "--ros-args", *parameters]
        with (self._folder / "explorer.log").open("w") as log:
            return subprocess.Popen(command, env=environment_of(slam), stdout=log, stderr=log)

    def end(self):
        for process in (self._process, self._explorer):
            if process is not None:
                process.send_signal(signal.SIGINT)
                process.wait(20)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Output folders of a log, mapped with a stranger and in lock-step, and the attack."""
    folder = tmp_path_factory.mktemp("hostile")
    log = corridor_bag(folder, scans=SCANS)
    hmt_slam("map", log, "--out", folder / "map", "--set", "robot.rate=1.0", check=True)
    port = free_port()
    attack = Attack(folder, port)
    begin = time.monotonic()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("PYTHONPATH", str(ROOT))
        try:
            replay(log, folder / "out", load_configuration(settings=["robot.rate=1.0"]), attack.watch, view_port=port)
        finally:
            attack.end()
    grown = {name: f"{(attack.after[name] - attack.before[name]) / 1e6:.0f} MB" for name in attack.after}
    print(f"{time.monotonic() - begin:.0f} s, grown by {grown}")
    return folder / "out", folder / "map", attack, json.loads(attack.report.read_text())


def test_no_node_ends_and_each_answers_every_request(run):
    _, _, attack, report = run
    assert set(attack.pids) == NODES
    assert report["unanswered"] == []
    assert report["slowest"] < ANSWER_TIME
    assert sum(report["sent"].values()) + sum(report["called"].values()) >= 261, report


def test_the_result_is_the_same_to_the_byte(run):
    out, other, _, _ = run
    for name in FORCED:
        assert (out / name).read_bytes() == (other / name).read_bytes(), name


def test_no_node_grows(run):
    attack = run[2]
    grown = {name: attack.after[name] - attack.before[name] for name in NODES}
    assert max(grown.values()) < GROWTH, grown


def test_every_topic_and_service_was_tried(run):
    report = run[3]
    assert {
        "/scan",
        "/odom",
        "/tf_static",
        "/initialpose",
        "/map",
        "/pose",
        "/hmt/topology",
        "/explorer/task",
    } <= report["sent"].keys()
    received = {name for row in PROCESSES for name in row.consumes}
    wanted = {f"/{row.topic}" for row in DOCUMENTS if row.message.rpartition(":")[2] in received}
    assert wanted <= report["sent"].keys()
    for name in NODES:
        assert f"/{name}/set_parameters" in report["called"]
    assert report["called"]["/slam/load"] > 15


def test_what_is_refused_is_counted_and_named_with_a_remedy(run):
    report = run[3]
    counted = Counter()
    for values in report["counts"].values():
        for key, count in values.items():
            counted[key.removeprefix("refused on ")] += int(count)
    documents = [f"/{row.topic}" for row in DOCUMENTS]
    # The page takes the newest of some topics, five times a second.
    seldom = {"/map", "/pose", "/hmt/topology", "/hmt/alternatives", "/hmt/evidence", "/pilot/place_estimate"}
    for topic in {"/scan", "/odom", "/tf_static", "/initialpose", *seldom, *documents} & report["sent"].keys():
        name = topic.removeprefix("/")
        assert counted[name] >= (1 if topic in seldom else 5), (name, counted)
        sentences = [text for text in report["sentences"] if text.startswith(f"{name} is left out: ")]
        assert sentences, (name, report["sentences"])
        assert all(": " in text.partition("is left out: ")[2] for text in sentences), sentences
