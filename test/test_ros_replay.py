"""A whole run of robot and nodes: the same map as in lock-step, and nothing left behind where it fails."""

import json
import os
import signal
import socket
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from urllib.request import urlopen

import numpy as np
import preloaded
import pytest
from logs_for_nodes import Corridor, corridor_bag, is_alive
from preloaded import hmt_slam
from two_lasers import TOPICS, bag_with_two_topics

from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import read_tum
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.hmt_map import read_saved_map

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from hmt_slam_ros.process_table import RUN_NODE, process_names
from hmt_slam_ros.ros import node_processes
from hmt_slam_ros.ros.replay import replay

ROOT = Path(__file__).resolve().parent.parent
BUNDLED = ROOT / "data" / "malaga_one_loop"
NODES = {*process_names(), "robot"}


def children_of(pid):
    """{node: its process id} of a running replay."""
    found = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            try:
                parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
                words = (folder / "cmdline").read_text().split("\0")
            except (OSError, ValueError):
                continue
            if parent == pid and RUN_NODE in words:
                found[words[words.index(RUN_NODE) + 1]] = int(folder.name)
    return found


def wait_until(condition, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)


@pytest.fixture
def running(tmp_path):
    """A replay in real time of a drive of 40 s, that has all its nodes."""
    log = corridor_bag(tmp_path, 200)
    words = ("replay", log, "--out", tmp_path / "out", "--rate", 1.0)
    process = preloaded.start(preloaded.COMMAND, *words, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    wait_until(lambda: set(children_of(process.pid)) == NODES or process.poll() is not None)
    nodes = children_of(process.pid)
    yield process, nodes
    process.kill()
    process.wait()
    process.stderr.close()
    wait_until(lambda: not any(is_alive(pid) for pid in nodes.values()))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The output folders of the bundled log, mapped by the nodes and in lock-step, by the two commands."""
    top = tmp_path_factory.mktemp("runs")
    for command in ("replay", "map"):
        hmt_slam(command, BUNDLED, "--out", top / command, "--set", "robot.rate=0", check=True)
    return top / "replay", top / "map"


@pytest.fixture
def preloaded_nodes(monkeypatch):
    """{node: process id of its last start}, for replays in this process: nodes have their libraries loaded before."""
    pids = {}

    def start(command, **options):
        process = preloaded.start(*command[2:], **options)
        pids[command[command.index(RUN_NODE) + 1]] = process.pid
        return process

    monkeypatch.setattr(node_processes, "subprocess", SimpleNamespace(**vars(subprocess) | {"Popen": start}))
    return pids


@pytest.fixture
def map_twice(tmp_path, preloaded_nodes):
    """Maps a log by nodes and in lock-step; returns the output folders."""

    def run(log, *settings):
        settings = ("robot.rate=0.0", *settings)
        nodes, lock_step = tmp_path / "replay", tmp_path / "map"
        replay(log, nodes, load_configuration(settings=settings))
        words = [word for setting in settings for word in ("--set", setting)]
        hmt_slam("map", log, "--out", lock_step, *words, check=True)
        return nodes, lock_step

    return run


@pytest.mark.parametrize("name", ["trajectory.tum", "trajectory_online.tum", "graph.g2o", "pmf.csv", "map.pgm"])
def test_the_nodes_take_the_same_decisions_as_the_lock_step_run(folders, name):
    nodes, lock_step = folders
    assert (nodes / name).read_bytes() == (lock_step / name).read_bytes()


def test_the_nodes_correct_scans_of_two_lasers_for_the_motion_during_their_sweeps_as_the_lock_step_run_does(
    map_twice, tmp_path
):
    log = bag_with_two_topics(Corridor(40, sweep=0.15, has_rear_laser=True), tmp_path)
    nodes, lock_step = map_twice(log, f"sensors.scan_topics={TOPICS}")
    scans, others = (read_saved_map(folder / "hmt_map").replica.scans for folder in (nodes, lock_step))
    assert {k: scan.motion.tobytes() for k, scan in scans.items()} == {k: s.motion.tobytes() for k, s in others.items()}
    # The log ends within the last sweep.
    end = read_tum(nodes / "trajectory.tum").stamps[-1]
    motions = np.array([scan.motion for scan in scans.values() if scan.stamp < end])
    assert len(motions) > 8
    np.testing.assert_allclose(np.hypot(motions[:, 0], motions[:, 1]), 0.075, rtol=1e-3)
    np.testing.assert_allclose(motions[:, 2], 0.006, rtol=1e-3)
    assert {round(scan.laser_pose[2]) for scan in scans.values()} == {0, 3}
    for name in ("trajectory.tum", "map.pgm", "hmt_map/map.json"):
        assert (nodes / name).read_bytes() == (lock_step / name).read_bytes()


@pytest.mark.long
def test_the_nodes_have_two_areas_become_one_and_forget_keyframes_as_the_lock_step_run_does(map_twice):
    name, settings = "sim:grid,size=0.7,rate=1,laps=2", ("robot.duration=250.0", "aam.keyframes_per_place=1")
    run = LockStepRun(load_configuration(settings=settings))
    for record in open_log(name, duration=250.0).records():
        run.process_record(record)
    gone = {one.keyframe for answer in run.recorder.hypotheses.values() for one in answer.pruned_keyframes}
    assert len(gone) > 3
    nodes, lock_step = map_twice(name, *settings)
    table = np.genfromtxt(nodes / "pmf.csv", delimiter=",", names=True, usecols=("keyframe", "areas"))
    assert np.diff(table["areas"]).min() < 0
    assert not gone & read_saved_map(nodes / "hmt_map").replica.scans.keys()
    for file in ("trajectory.tum", "trajectory_online.tum", "pmf.csv", "hmt_map/map.json", "hmt_map/map.bin"):
        assert (nodes / file).read_bytes() == (lock_step / file).read_bytes()


def test_the_report_accounts_for_every_scan_and_every_process(folders):
    report = json.loads((folders[0] / "report.json").read_text())
    assert report["runtime"] == "nodes"
    assert report["scans"] == {"in": 225, "processed": 225, "dropped": 0}
    assert set(report["processes"]) == NODES - {"robot"}
    assert set(report["peak_rss_bytes"]) == NODES
    assert all(20e6 < rss < 4e9 for rss in report["peak_rss_bytes"].values())
    assert all(0 < pss < report["peak_rss_bytes"][name] for name, pss in report["pss_bytes"].items())
    slam = report["processes"]["slam"]
    assert 0.0 < slam["mean_ms_per_scan"] < slam["max_ms_per_scan"]
    assert report["cpu_s"] > slam["total_s"]


def test_processes_that_are_killed_one_after_the_other_go_on_to_the_same_bit(folders, preloaded_nodes, tmp_path, capfd):
    """At last all of them at once. Scans, keyframe events and checkpoints are under way wherever that happens."""
    due = {20: ("rtl",), 45: ("tlca",), 75: ("tsbi",), 105: ("aam",), 135: ("slam",), 165: process_names()}

    def strike(scans):
        if due and scans >= min(due):
            for name in due.pop(min(due)):
                os.kill(preloaded_nodes[name], signal.SIGKILL)

    out = tmp_path / "out"
    replay(BUNDLED, out, load_configuration(settings=["robot.rate=0.0"]), strike)
    assert not due
    reported = capfd.readouterr().err
    for name in process_names():
        assert (
            reported.count(f"the node {name} was killed by signal 9: it is started again and goes on where it was") == 2
        )
    for name in ("trajectory.tum", "trajectory_online.tum", "graph.g2o", "pmf.csv", "map.pgm", "hmt_map/map.bin"):
        assert (out / name).read_bytes() == (folders[1] / name).read_bytes()
    report, undisturbed = (json.loads((folder / "report.json").read_text()) for folder in (out, folders[1]))
    assert report["scans"] == undisturbed["scans"]
    assert report["notices"] == undisturbed["notices"]


def test_a_node_that_is_killed_again_and_again_ends_the_run_and_leaves_nothing(running, tmp_path):
    process, nodes = running
    killed = set()
    while process.poll() is None:
        found = children_of(process.pid)
        nodes.update(found)
        if "tlca" in found and found["tlca"] not in killed:
            killed.add(found["tlca"])
            os.kill(found["tlca"], signal.SIGKILL)
        time.sleep(0.02)
    error = process.communicate(timeout=40)[1]
    assert process.returncode == 2
    assert "the node tlca was killed by signal 9 for the 4th time within a minute and is not started again" in error
    assert len(killed) == 4
    assert not (tmp_path / "out").exists()
    assert not any(is_alive(pid) for pid in nodes.values())


def test_a_robot_that_dies_ends_the_run_with_its_name_and_leaves_nothing(running, tmp_path):
    process, nodes = running
    os.kill(nodes["robot"], signal.SIGKILL)
    error = process.communicate(timeout=40)[1]
    assert process.returncode == 2
    assert "the node robot ended with status -9" in error
    assert not (tmp_path / "out").exists()
    assert {entry.name for entry in tmp_path.iterdir()} == {"corridor"}
    assert not any(is_alive(pid) for pid in nodes.values())


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_that_is_stopped_takes_its_nodes_with_it(running, tmp_path, number, status):
    process, nodes = running
    process.send_signal(number)
    error = process.communicate(timeout=40)[1]
    assert process.returncode == status
    assert "Traceback" not in error
    assert not any(is_alive(pid) for pid in nodes.values())
    assert {entry.name for entry in tmp_path.iterdir()} == {"corridor"}


def test_a_run_that_is_killed_takes_its_nodes_with_it(running):
    process, nodes = running
    process.kill()
    process.communicate()
    wait_until(lambda: not any(is_alive(pid) for pid in nodes.values()))


@pytest.mark.long
def test_a_run_that_stands_still_names_the_node_it_waits_for(tmp_path, preloaded_nodes):
    log, out = corridor_bag(tmp_path, 200), tmp_path / "out"

    def stop(_):
        os.kill(preloaded_nodes["aam"], signal.SIGSTOP)

    with pytest.raises(HmtSlamError, match="the run waits for the node aam"):
        replay(log, out, load_configuration(settings=["robot.rate=1.0"]), stop, stall_timeout=6.0)
    assert not out.exists()
    assert not any(is_alive(pid) for pid in preloaded_nodes.values())


@pytest.mark.long
def test_the_live_page_of_a_run_is_served_while_it_lasts_though_it_is_killed_unless_its_port_is_taken(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        log, out = corridor_bag(tmp_path, 200), tmp_path / "out"
        words = ("replay", log, "--out", out, "--set", "robot.rate=4", "--view", port)
        done = hmt_slam(*words, timeout=60.0)
    assert done.returncode == 2
    assert f"the page cannot listen on 127.0.0.1, port {port}" in done.stderr.splitlines()[-1]

    outputs = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with preloaded.start(preloaded.COMMAND, *words, cwd=ROOT, **outputs) as process:
        url = process.stderr.readline().split()[-1]

        def read_screen():
            assert process.poll() is None
            with suppress(OSError), urlopen(url + "snapshot.json", timeout=5) as answer:
                return json.load(answer)
            return {}

        def received_of(name):
            rows = read_screen().get("nodes", ())
            return next((row["message"] for row in rows if row["name"] == name), "not heard yet")

        wait_until(lambda: "robot" in read_screen())
        nodes = children_of(process.pid)
        os.kill(nodes["robot"], signal.SIGSTOP)
        os.kill(nodes["view"], signal.SIGKILL)
        wait_until(lambda: nodes["view"] not in children_of(process.pid).values())
        wait_until(lambda: received_of("rtl") != "not heard yet")
        os.kill(nodes["robot"], signal.SIGCONT)
        wait_until(lambda: "robot" in read_screen())
        error = process.communicate(timeout=60)[1]
    assert process.returncode == 0
    assert "the node view was killed by signal 9: it is started again" in error
    assert set(json.loads((tmp_path / "out" / "report.json").read_text())["peak_rss_bytes"]) == NODES
    with pytest.raises(OSError, match="refused"):
        urlopen(url, timeout=5)


def test_a_truncated_log_is_one_sentence_before_anything_starts(tmp_path):
    log = corridor_bag(tmp_path)
    (storage,) = log.glob("*.mcap")
    storage.write_bytes(storage.read_bytes()[: storage.stat().st_size // 2])
    done = hmt_slam("replay", log, "--out", tmp_path / "out", timeout=60.0)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()
