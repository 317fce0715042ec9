"""The nodes save one map together while they run, and begin with it again."""

import signal
import time

import numpy as np
import pytest
from logs_for_nodes import PACE, START, corridor_bag
from preloaded import hmt_slam

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from hmt_slam_ros.area_abstraction.partition import AamState
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.loop_closure.tlca import TlcaState
from hmt_slam_ros.messages.documents import KeyframeHeader, decode
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.metric_slam.slam import SlamState
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.results.hmt_map import ChainState, read_saved_map
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DOCUMENTS, KEYFRAMES, MAP
from hmt_slam_ros.saved_map.folder import FORMAT, VERSION, FolderReader
from hmt_slam_ros.topological_inference.tsbi import TsbiState

NODES = process_names()
STATES = {"slam": SlamState, "aam": AamState, "tsbi": TsbiState, "tlca": TlcaState}


class Nodes:
    """The five processes and a robot, and their messages."""

    def __init__(self, start, listener, log, folder, rate, **robot):
        self.listener = listener
        self.estimates = listener.subscribe(String, DOCUMENTS[LocalEstimate], topics.CHAIN)
        self.keyframes = listener.subscribe(String, KEYFRAMES, topics.CHAIN)
        self.processes = [start(name, save_to=folder) if name == "slam" else start(name) for name in NODES]
        self.robot = start("robot", log=log, robot__rate=rate, **robot)

    def until(self, condition):
        self.listener.until(condition, alive=[*self.processes, self.robot])

    def save(self):
        return self.listener.call(Trigger, "slam/save", Trigger.Request())

    def pause(self, on):
        assert self.listener.call(SetBool, "robot/pause", SetBool.Request(data=on)).success

    def kill(self):
        for process in (*self.processes, self.robot):
            process.kill()
        for process in (*self.processes, self.robot):
            process.communicate()

    @property
    def last(self):
        return decode(self.estimates[-1].data, LocalEstimate)


def states(folder):
    """The parts of the map by process; reading it checks that it is whole."""
    reader = FolderReader(folder, FORMAT, VERSION)
    return {name: reader.read(name, kind) for name, kind in STATES.items()}, reader.read("chain", ChainState).events


def replica_in_words(replica):
    """What a map says, to be compared."""
    return (
        sorted(replica.scans),
        replica.common.areas.tolist(),
        replica.common.poses.tolist(),
        replica.common.means.tolist(),
        {h: (own.keyframes.tolist(), own.poses.tolist()) for h, own in replica.changes.items()},
        dict(replica.robot_areas),
    )


def test_a_map_is_saved_while_the_robot_drives_and_others_go_on_from_it_when_all_are_killed(tmp_path, listener, start):
    log, folder = corridor_bag(tmp_path, scans=80), tmp_path / "maps" / "hmt_map"
    first = Nodes(start, listener, log, folder, 4.0)
    first.until(lambda: len(first.estimates) > 20)
    saved = first.save()  # while scans come
    assert saved.success, saved.message
    assert saved.message == f"saved to {folder}"
    parts, events = states(folder)
    assert events == parts["slam"].keyframe_events > 3
    # All parts are of one and the same moment.
    maps = {name: replica_in_words(part.replica) for name, part in parts.items()}
    assert maps["slam"] == maps["aam"] == maps["tsbi"] == maps["tlca"]
    assert max(maps["slam"][0]) < events
    assert sorted(path.name for path in folder.parent.iterdir()) == ["hmt_map"]

    first.pause(on=True)
    known = -1
    while known < len(first.estimates):  # what came before is worked off
        known = len(first.estimates)
        listener.spin(1.0)
    assert first.save().success
    stopped, events = states(folder)
    assert stopped["slam"].processed_scans == len(first.estimates) < 80
    first.kill()

    # At the first scan that is not in the map.
    begin = (stopped["slam"].scan_queue.last_stamp - START) / 1e9 + 0.001
    stayed = start_with(start, start_from=folder, start_lost=False)
    second = Nodes(stayed, listener, log, folder, 0.0, robot__start=begin)
    second.until(lambda: second.estimates and second.last.scan_index == 79)
    heads = [decode(message.data, KeyframeHeader).sequence for message in second.keyframes]
    assert heads == list(range(events, events + len(heads)))
    known = read_saved_map(folder)
    assert second.save().success
    grown = read_saved_map(folder)
    best, before = grown.replica.maps[grown.replica.best_hypothesis], known.replica.maps[known.replica.best_hypothesis]
    assert set(before.area_ids()) <= set(best.area_ids())
    # The robot is where it truly is, in the map of before.
    at = se2.compose(grown.area_poses[second.last.area].mean, second.last.pose.mean)
    assert np.abs(at - 4 * 79 * PACE).max() < 0.1


def test_nodes_that_have_to_end_save_their_map_first_if_that_is_wanted(tmp_path, listener, start):
    """All at once, twice, and the robot with them, as a launch does that is in a hurry."""
    log, folder = corridor_bag(tmp_path, scans=200), tmp_path / "hmt_map"
    nodes = Nodes(start_with(start, save_on_shutdown=True), listener, log, folder, 4.0)
    nodes.until(lambda: len(nodes.estimates) > 20)
    everybody = [*nodes.processes, nodes.robot]
    for process in everybody:
        process.send_signal(signal.SIGINT)
    time.sleep(0.1)
    for process in nodes.processes:
        process.send_signal(signal.SIGTERM)
    begin = time.monotonic()
    for process in everybody:
        error = process.communicate(timeout=20)[1]
        assert process.returncode == 0, error
        assert "Traceback" not in error, error
    assert time.monotonic() - begin < 8.0
    parts, events = states(folder)
    assert events > 3
    maps = {name: replica_in_words(part.replica) for name, part in parts.items()}
    assert maps["slam"] == maps["aam"] == maps["tsbi"] == maps["tlca"]


def test_nodes_show_a_map_of_the_command_line_at_once_and_go_on_from_it(tmp_path, listener, start):
    log, out = corridor_bag(tmp_path, scans=60), tmp_path / "out"
    hmt_slam("map", log, "--out", out, "--duration", 6, check=True)
    grids = listener.subscribe(OccupancyGrid, MAP, topics.LATCHED)
    stayed = start_with(start, start_from=out, start_lost=False)
    nodes = Nodes(stayed, listener, log, tmp_path / "hmt_map", 0.0, robot__start=6.001)
    nodes.until(lambda: grids and nodes.estimates and nodes.last.scan_index == 59)
    known = (np.frombuffer(grids[0].data, dtype=np.int8) == 100).sum()
    assert known > 100
    events = FolderReader(out / "hmt_map", FORMAT, VERSION).read("chain", ChainState).events
    assert decode(nodes.keyframes[0].data, KeyframeHeader).sequence == events > 3


def start_with(start, **parameters):
    """As ``start``, the processes with further parameters."""
    return lambda name, **own: start(name, **(own if name == "robot" else own | parameters))


def test_what_cannot_be_saved_is_reported(tmp_path, listener, start):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "notes.txt").write_text("precious")
    start("slam", save_to=tmp_path / "notes")
    answer = listener.call(Trigger, "slam/save", Trigger.Request())
    assert (answer.success, answer.message) == (
        False,
        f"{tmp_path / 'notes'} cannot be saved: nothing is mapped yet, drive first",
    )


def test_a_map_that_is_damaged_or_made_with_other_particles_keeps_the_nodes_from_starting(tmp_path, start):
    out = tmp_path / "out"
    hmt_slam("map", corridor_bag(tmp_path), "--out", out, check=True)
    node = start("slam", start_from=out, filter__particles=5)
    assert "made with filter.particles = 12, not with filter.particles = 5" in node.communicate(timeout=40)[1]
    assert node.returncode == 2
    (out / "hmt_map" / "tlca.json").write_text("{}")
    node = start("rtl", start_from=out)
    assert "tlca.json is truncated or damaged" in node.communicate(timeout=40)[1]
    assert node.returncode == 2
