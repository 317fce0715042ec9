"""Services by which the map is requested, exchanged and forgotten, and mapping pauses, while the nodes run."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from logs_for_nodes import PACE
from test_ros_localization import NODES, SCANS, Nodes

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from recording import Recording
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.documents import KeyframeHeader, decode, decode_with_reset
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.messages.topology import Topology
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DOCUMENTS, KEYFRAMES, MAP, TFMessage
from hmt_slam_ros.saved_map.folder import MANIFEST

TRANSFORMS = {"tf", "tf_static"} if TFMessage else set()
NAMED = {value for name, value in vars(topics).items() if name.isupper() and isinstance(value, str)}
MESSAGES = Path(__file__).parent.parent / "docs" / "reference" / "messages.md"
SAID = {f"/{topic.lstrip('/')}" for topic in {*NAMED, *topics.DOCUMENTS.values(), *TRANSFORMS}} - {
    *("/team/statuses", "/team/requests", "/team/updates", "/team/placements", "/hmt/joined_ground"),  # of a team
    *("/team/rendezvous", "/team/goals"),  # likewise
    *("/initialpose", "/cmd_vel", "/rendezvous", "/statement"),  # which are subscribed to
    "/ground_truth",  # of a robot that is driven
    "/hmt/incidents",  # of the page
    *("/goal_pose", "/pilot/place_estimate", "/hmt/task_feedback", "/navigate_to_pose"),  # of explorer and pilot
    "/hmt/notices",  # as there is nothing to complain of
    *("/hmt/ambiguity", "/hmt/ambiguity_goal"),  # as one hypothesis is probable
}


def count_occupied(grid):
    return int((np.frombuffer(grid.data, dtype=np.int8) == 100).sum())


def request_with(listener, service, parameter, folder):
    """The answer of a service of slam after its parameter was set to a folder."""
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(folder))
    request = SetParameters.Request(parameters=[Parameter(name=parameter, value=value)])
    (result,) = listener.call(SetParameters, "slam/set_parameters", request).results
    assert result.successful, result.reason
    return listener.call(Trigger, service, Trigger.Request())


def load(listener, folder):
    return request_with(listener, "slam/load", "load_from", folder)


def last(nodes):
    return decode(nodes.estimates[-1].data, LocalEstimate)


def test_a_map_is_loaded_while_the_nodes_run_and_the_robot_recognized_in_it(corridor, listener, start, tmp_path):
    log, out = corridor
    nodes = Nodes(start, listener)
    assert listener.call(GetMap, "tlca/get_map", GetMap.Request()).map.info.width == 0
    nodes.drive(log, first=90, robot__duration=2.0)
    nodes.until(lambda: len(nodes.estimates) == 10)
    nodes.park()
    little = listener.call(GetMap, "tlca/get_map", GetMap.Request()).map
    assert count_occupied(little) > 20
    nodes.until(lambda: nodes.localized)

    missing = load(listener, tmp_path / "nowhere")
    assert (missing.success, missing.message[:20]) == (False, "there is no folder '")
    shutil.copytree(out / "hmt_map", tmp_path / "damaged")
    (tmp_path / "damaged" / "tlca.json").write_text("{}")
    damaged = load(listener, tmp_path / "damaged")
    assert not damaged.success
    assert "tlca.json is truncated or damaged" in damaged.message
    assert nodes.is_localized()

    grids = listener.subscribe(OccupancyGrid, MAP, topics.LATCHED)
    answer = load(listener, out)
    assert (answer.success, answer.message) == (True, f"goes on from {out}")
    nodes.until(lambda: not nodes.is_localized())
    nodes.until(lambda: grids and count_occupied(grids[-1]) > 2 * count_occupied(little))
    nodes.drive(log, first=20, rate=8.0)
    nodes.until(nodes.is_localized)
    nodes.until(lambda: last(nodes).scan_index == SCANS + (SCANS - 20) - 1)
    nodes.until_at(4 * (SCANS - 1))


def test_after_a_reset_a_new_map_begins_where_the_robot_is_and_all_messages_can_be_recorded(
    corridor, listener, start, tmp_path
):
    log, out = corridor
    recording = Recording(listener, tmp_path / "bag")
    nodes = Nodes(start, listener, start_from=out, start_lost=False, save_to=tmp_path / "saved")
    keyframes = listener.subscribe(String, KEYFRAMES, topics.CHAIN)
    nodes.until(lambda: {m.status[0].name for m in nodes.diagnostics} == {f"/{name}" for name in NODES})
    topologies = listener.subscribe(String, DOCUMENTS[Topology], topics.LATCHED)
    nodes.until(lambda: topologies)
    before, reset_number = decode_with_reset(topologies[-1].data, Topology)
    assert before.areas
    assert (before.events > 0, reset_number) == (True, 0)
    answer = listener.call(Trigger, "slam/reset", Trigger.Request())
    assert (answer.success, answer.message) == (True, "the map is forgotten, a new one begins")
    nodes.until(lambda: decode(topologies[-1].data, Topology).events == 0)
    after, reset_number = decode_with_reset(topologies[-1].data, Topology)
    assert (after.areas, reset_number > 0) == ((), True)
    assert listener.call(GetMap, "tlca/get_map", GetMap.Request()).map.info.width == 0
    # Slam, rtl, and the recording.
    nodes.drive(log, first=40, rate=8.0, robot__duration=8.0, robot__odometry_listeners=3)
    nodes.until(lambda: len(nodes.estimates) == 40)
    assert decode(keyframes[0].data, KeyframeHeader).sequence == 0
    nodes.until(nodes.is_localized)
    # In the frame of the first scan after it.
    nodes.until_at(4 * 79, se2.between(4 * 40 * PACE, 4 * 79 * PACE), tolerance=0.3)
    assert count_occupied(listener.call(GetMap, "tlca/get_map", GetMap.Request()).map) > 20
    assert listener.call(Trigger, "slam/save", Trigger.Request()).message == f"saved to {tmp_path / 'saved'}"
    other = request_with(listener, "slam/save", "save_to", tmp_path / "other" / "map")
    assert (other.success, other.message) == (True, f"saved to {tmp_path / 'other' / 'map'}")
    assert (tmp_path / "other" / "map" / MANIFEST).exists()
    nodes.until(lambda: set(recording.counts) >= SAID)
    recording.close()
    assert_documented(recording.offered)
    assert TFMessage is None or open_log(recording.folder).scan_count == 40


def assert_documented(offered):
    """Type and profile of each topic, beside ROS's own, are those in docs/reference/messages.md."""
    row = re.compile(r"^\| (/?[\w/]+)[^|]*\| (\w+)/(\w+)[^|]*\| (?:\w+; robot: )?([A-Z_]+)[^|]*\|", re.MULTILINE)
    tables = {f"/{topic.lstrip('/')}": rest for topic, *rest in row.findall(MESSAGES.read_text())}
    for topic, (kind, profiles) in offered.items():
        if topic in {"/rosout", "/parameter_events"} or topic.endswith("/transition_event"):
            continue
        package, name, profile = tables[topic]
        assert kind == f"{package}/msg/{name}", topic
        promised = getattr(topics, profile)
        for reported in profiles:
            assert (reported.reliability, reported.durability) == (promised.reliability, promised.durability), topic


def test_while_paused_scans_are_passed_over_and_odometry_is_not(corridor, listener, start):
    # Not to the end of the corridor, where the laser sees little but the wall before it.
    scans = 90
    nodes = Nodes(start, listener)
    nodes.drive(corridor[0], first=0, rate=2.0, robot__duration=0.2 * scans)
    nodes.until(lambda: len(nodes.estimates) > 10)
    paused = listener.call(SetBool, "slam/pause", SetBool.Request(data=True))
    assert (paused.success, paused.message) == (True, "paused, scans are passed over")

    def stands():
        """What came before is worked off."""
        messages = nodes.diagnosis("slam")
        return messages["waiting scans"] == "0" and int(messages["dropped scans"] or 0) >= 10

    nodes.until(stands)
    messages = len(nodes.estimates)
    listener.spin(1.0)
    assert len(nodes.estimates) == messages
    nodes.until(lambda: nodes.diagnosis("slam").get("paused", "").startswith("yes"))
    assert listener.call(SetBool, "slam/pause", SetBool.Request(data=False)).success
    # The robot, which waited for an acknowledgement, goes on.
    end = 4 * (scans - 1) * PACE
    nodes.until(lambda: np.abs(last(nodes).pose.mean - end).max() < 0.1)
    nodes.until(lambda: nodes.diagnosis("slam").get("paused") == "no")
    dropped = int(nodes.diagnosis("slam")["dropped scans"])
    assert dropped >= 5
    nodes.until(lambda: len(nodes.estimates) == scans - dropped)


def test_nothing_is_exchanged_where_not_all_processes_run(listener, start):
    start("slam")
    answer = listener.call(Trigger, "slam/reset", Trigger.Request())
    assert (answer.success, answer.message) == (
        False,
        "the map cannot be exchanged: 0 of aam, tsbi, tlca, rtl are running: start all of them",
    )
