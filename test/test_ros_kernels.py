"""Nodes load their kernels before the first scan, and none amid a drive."""

from itertools import pairwise
from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import OccupancyGrid
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.messages.documents import RobotStatus, decode
from hmt_slam_ros.messages.messages import ClosureDecision
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.recorder_node import RecorderNode
from hmt_slam_ros.ros.topics import DIAGNOSTICS, DOCUMENTS, IS_LOCALIZED, LANDMARKS, MAP

BUNDLED = Path(__file__).resolve().parent.parent / "data" / "malaga_one_loop"


def kernel_entries(reported, name):
    """The entries of a node on its kernels, one for each message."""
    statuses = (status for message in reported for status in message.status if status.name == f"/{name}")
    return [value.value for status in statuses for value in status.values if value.key == "kernels"]


class Drive:
    """Drives of the bundled log by nodes that share no memory with one that has called kernels before."""

    def __init__(self, listener, start):
        self._listener, self._start = listener, start
        self.reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
        self.localized = listener.subscribe(Bool, IS_LOCALIZED, topics.LATCHED)
        self._decisions = listener.subscribe(String, DOCUMENTS[ClosureDecision], topics.CHAIN)
        self._robot_states = listener.subscribe(String, DOCUMENTS[RobotStatus], topics.LATCHED)
        # tlca makes these for subscribers alone.
        listener.subscribe(OccupancyGrid, MAP, topics.LATCHED)
        self.landmarks = listener.subscribe(MarkerArray, LANDMARKS, topics.LATCHED)
        self._nodes = [start(name, preload=False, laser_pose="[0.0, 0.0, 0.0]") for name in process_names()]

    def run(self, duration):
        """Replay some seconds of the log; 0 for all. Returns the numbers of arcs in the answers of tlca."""
        self._robot_states.clear()
        self._decisions.clear()
        robot = self._start("robot", log=BUNDLED, robot__rate=0.0, robot__duration=duration)
        self._listener.until(self._has_ended, alive=[*self._nodes, robot])
        robot.terminate()
        robot.communicate(timeout=20)
        return [len(decode(message.data, ClosureDecision).arcs) for message in self._decisions]

    @property
    def landmark_kinds(self):
        """Of the last message, which comes every three seconds at most."""
        return {marker.ns for message in self.landmarks[-1:] for marker in message.markers}

    def _has_ended(self):
        states = self._robot_states
        return states and decode(states[-1].data, RobotStatus).state == "ended"


def test_no_kernel_is_loaded_amid_a_drive_with_a_loop_closure_and_a_relocalization(listener, start):
    drive = Drive(listener, start)
    assert max(drive.run(0.0)) > 1, "a loop closure refines several arcs"
    assert listener.call(Trigger, "slam/relocalize", Trigger.Request()).success
    drive.run(15.0)
    listener.until(lambda: (False, True) in pairwise(message.data for message in drive.localized))
    listener.until(lambda: drive.landmark_kinds & {"corners", "convex_corners", "openings"})
    count = len(drive.reported)
    listener.until(lambda: all(kernel_entries(drive.reported[count:], name) for name in process_names()))
    last = {name: kernel_entries(drive.reported, name)[-1] for name in process_names()}
    assert all(entry.endswith(" loaded") for entry in last.values()), last
    assert [name for name, entry in last.items() if entry == "0 loaded"] == ["rtl"]


def test_configure_is_answered_when_the_kernels_are_loaded_and_other_requests_meanwhile(listener, start):
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    start("tsbi", preload=False, autostart=False)
    change = listener.node.create_client(ChangeState, "tsbi/change_state")
    listener.until(change.service_is_ready)
    answers = [
        change.call_async(ChangeState.Request(transition=Transition(id=number)))
        for number in (Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
    ]
    states = []
    while not answers[0].done():
        states.append(listener.call(GetState, "tsbi/get_state", GetState.Request()).current_state.label)
    assert states.count("inactive") > 1
    listener.until(answers[1].done)
    assert [answer.result().success for answer in answers] == [True, True]
    listener.until(lambda: kernel_entries(reported, "tsbi")[-1:] and "loaded" in kernel_entries(reported, "tsbi")[-1])


def test_a_replay_does_not_stand_still_while_a_node_compiles(listener):
    recorder = RecorderNode(Configuration(), listener.context, "one")
    counts = []
    for kernels in ("loading", "compiling kernels, 40 s left", "63 loaded"):
        values = [KeyValue(key="system", value="one"), KeyValue(key="kernels", value=kernels)]
        status = DiagnosticStatus(name="/tlca", hardware_id="hmt_slam_ros", values=values)
        recorder._on_diagnostics(DiagnosticArray(status=[status]))
        counts.append(recorder.message_count)
    recorder.destroy_node()
    assert counts == [0, 1, 1]
