"""Localization: the robot finds its place in a map that stays as it was loaded, until the mode is changed."""

import json

import numpy as np
import pytest
from logs_for_nodes import PACE
from preloaded import hmt_slam
from test_ros_localization import SCANS, Nodes, initial_pose

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from geometry_msgs.msg import PoseWithCovarianceStamped
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from std_msgs.msg import String
from std_srvs.srv import Trigger

from hmt_slam_ros.messages.documents import KeyframeHeader, decode
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import INITIAL_POSE, KEYFRAMES


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def set_mode(listener, mode):
    request = SetParameters.Request(parameters=[Parameter("mode", value=mode).to_parameter_msg()])
    return listener.call(SetParameters, "slam/set_parameters", request).results[0]


def are_stored(keyframes):
    """Whether keyframes were stored under any hypothesis."""
    return [any(hypothesis.stored for hypothesis in head(message).estimates) for message in keyframes]


def head(message):
    return decode(message.data, KeyframeHeader)


def test_a_robot_is_recognized_and_tracked_in_a_map_that_is_saved_as_it_was_loaded(corridor, listener, start, tmp_path):
    log, out = corridor
    nodes = Nodes(start, listener, start_from=out, mode="localization", save_to=tmp_path / "saved")
    keyframes = listener.subscribe(String, KEYFRAMES, topics.CHAIN)
    pointing = listener.node.create_publisher(PoseWithCovarianceStamped, INITIAL_POSE, topics.STREAM)
    nodes.drive(log, first=20, rate=8.0)
    nodes.until(nodes.is_localized)
    nodes.until(lambda: len(nodes.estimates) == SCANS - 20)
    nodes.until_at(4 * (SCANS - 1))
    while_lost = are_stored(keyframes)
    # What it needs to be recognized, which is two looks at five keyframes each and what came meanwhile; nothing since.
    recognized = while_lost.index(False)
    assert 0 < recognized <= 14
    assert not any(while_lost[recognized:])
    assert len(while_lost) > recognized + 4
    saved = listener.call(Trigger, "slam/save", Trigger.Request())
    assert saved.success, saved.message
    assert content(tmp_path / "saved") == content(out / "hmt_map")

    kept = listener.call(Trigger, "slam/reset", Trigger.Request())
    assert (kept.success, kept.message) == (
        False,
        "mode = localization keeps the map: set mode of slam to mapping first",
    )

    refused = set_mode(listener, "sleeping")
    assert not refused.successful
    assert "mode = sleeping is not a choice: use mapping or localization or lifelong" in refused.reason
    assert set_mode(listener, "lifelong").successful
    nodes.park()
    nodes.until(pointing.get_subscription_count)
    pointing.publish(initial_pose(np.zeros(3)))
    nodes.until(lambda: not nodes.is_localized())
    nodes.drive(log, first=0, robot__duration=6.0)
    nodes.until(nodes.is_localized)
    nodes.until(lambda: len(nodes.estimates) == SCANS - 20 + 30)
    # Each keyframe tells the others that the map may change from here on.
    assert [head(message).mapping for message in keyframes][-3:] == [True] * 3
    assert not any(head(message).mapping for message in keyframes[: len(while_lost)])
    assert listener.call(Trigger, "slam/save", Trigger.Request()).success
    assert content(tmp_path / "saved") != content(out / "hmt_map")


def test_offline_too_the_map_stays_as_it_was(corridor, tmp_path):
    log, out = corridor

    def run_map(*arguments):
        return hmt_slam("map", log, "--out", tmp_path / "out", *arguments)

    found = run_map("--from", out, "--mode", "localization", "--start", "4.0")
    assert found.returncode == 0, found.stderr
    assert f"out: {SCANS - 20} of {SCANS - 20} scans beside {SCANS} of one log before, 0 dropped; " in found.stdout
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["scans"] == {"in": SCANS - 20, "processed": SCANS - 20, "dropped": 0}
    assert report["scans_of_earlier_logs"] == SCANS
    assert report["travelled_m"] == pytest.approx(4 * (SCANS - 20) * PACE[0], rel=0.1)
    assert content(tmp_path / "out" / "hmt_map") == content(out / "hmt_map")
    poses = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    assert np.abs(poses[-1, 1:3] - 4 * (SCANS - 1) * PACE[:2]).max() < 0.1
    alone = run_map("--mode", "localization")
    assert alone.returncode == 2
    assert "mode = localization wants a map to find the robot in: give --from" in alone.stderr
