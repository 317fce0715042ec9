"""The nodes as managed nodes: another program brings them up, halts them amid a drive and takes them down."""

import shutil
import signal
import time

import numpy as np
import pytest
from logs_for_nodes import SECOND, corridor_bag
from test_ros_localization import NODES, Nodes

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from std_srvs.srv import Trigger

from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import stamp_from_time
from hmt_slam_ros.ros.topics import DIAGNOSTICS, KEYFRAMES, ODOM, POSE, SCAN
from hmt_slam_ros.saved_map.folder import FORMAT, VERSION, FolderReader

SCANS = 110  # so that some are left when the last node comes back, whatever came while the others were away
SHUTDOWN = {
    "unconfigured": Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
    "inactive": Transition.TRANSITION_INACTIVE_SHUTDOWN,
    "active": Transition.TRANSITION_ACTIVE_SHUTDOWN,
}
LOST, ASKED = 20.0, 3
"""After so long no answer comes any more, s; and how often the state of a node is requested."""

UP, DOWN = ("rtl", "tsbi", "slam", "aam", "tlca"), ("tlca", "slam", "rtl", "aam", "tsbi")


class Manager:
    """Requests transitions of nodes, as a lifecycle manager does."""

    def __init__(self, listener):
        self.listener = listener
        self.clients = {}

    def call(self, kind, name, request):
        """The answer; None where DDS lost it, as it may where the node does not know of the client yet."""
        if name not in self.clients:
            self.clients[name] = self.listener.node.create_client(kind, name)
        self.listener.until(self.clients[name].service_is_ready)
        future, deadline = self.clients[name].call_async(request), time.monotonic() + LOST
        self.listener.until(lambda: future.done() or time.monotonic() > deadline)
        return future.result() if future.done() else None

    def state(self, node):
        answers = (self.call(GetState, f"{node}/get_state", GetState.Request()) for _ in range(ASKED))
        answer = next((one for one in answers if one is not None), None)
        assert answer is not None, f"{node} does not say its state"
        return answer.current_state.label

    def until(self, node, state):
        """Wait for a state that the node comes to by itself, which may compile its kernels first."""
        self.listener.until(lambda: self.state(node) == state, seconds=150.0)

    def change(self, node, transition):
        """Whether the node did it; a transition is given by its name or its number."""
        request, before = ChangeState.Request(), self.state(node)
        if isinstance(transition, str):
            request.transition.label = transition
        else:
            request.transition.id = transition
        answer = self.call(ChangeState, f"{node}/change_state", request)
        return self.state(node) != before if answer is None else answer.success

    def lead(self, names, transition, state):
        for name in names:
            assert self.change(name, transition), name
            assert self.state(name) == state, name


def estimates_of(nodes, since):
    return [message.data for message in nodes.estimates[since:]]


@pytest.mark.long
def test_nodes_that_are_halted_and_taken_down_amid_a_drive_come_to_the_same_as_others(listener, start, tmp_path):
    log, saved = corridor_bag(tmp_path, scans=SCANS), tmp_path / "hmt_map"
    manager, nodes = Manager(listener), Nodes(start, listener, autostart=False, save_to=saved, save_on_shutdown=True)

    def messages(node):
        return nodes.diagnosis(node)["state"]

    nodes.until(lambda: all(messages(name) == "unconfigured" for name in NODES))
    assert listener.node.count_subscribers(SCAN) == listener.node.count_publishers(KEYFRAMES) == 0
    nodes.drive(log, first=0, rate=4.0, robot__discovery_timeout=120.0)
    manager.lead(UP, "configure", "inactive")
    nodes.until(lambda: all(messages(name) == "inactive" for name in NODES))
    assert listener.node.count_subscribers(SCAN) == 0
    manager.lead(DOWN, "activate", "active")
    listener.until(lambda: nodes.estimates, seconds=150.0, alive=nodes.alive)  # a first run compiles

    nodes.until(lambda: len(nodes.estimates) > 8)
    halt(manager, nodes, "aam")
    take_down_and_up(manager, "aam")
    nodes.until(lambda: len(nodes.estimates) > 18)
    halt(manager, nodes, "tsbi")
    manager.lead(["rtl"], "deactivate", "inactive")  # nobody waits for it
    away = len(nodes.estimates)
    take_down_and_up(manager, "tsbi")
    nodes.until(lambda: len(nodes.estimates) > away + 12)  # 2.4 s of the log
    halt(manager, nodes, "tlca")
    manager.lead(["rtl"], "activate", "active")
    take_down_and_up(manager, "tlca")
    nodes.until(lambda: len(nodes.estimates) > 40)
    manager.lead(["slam"], "deactivate", "inactive")
    stands(nodes)
    assert not manager.change("slam", Transition.TRANSITION_CONFIGURE)
    renew_rtl(manager, nodes)
    manager.lead(["slam"], "activate", "active")
    nodes.until(lambda: len(nodes.estimates) == SCANS)
    nodes.park()
    assert np.diff([stamp_from_time(pose.header.stamp) for pose in nodes.poses]).max() > 2 * SECOND
    nodes.until_at(4 * (SCANS - 1))

    manager.lead(DOWN, "deactivate", "inactive")
    assert listener.call(Trigger, "slam/save", Trigger.Request()).success
    FolderReader(saved, FORMAT, VERSION)
    restart_all(manager, nodes, log)
    assert estimates_of(nodes, SCANS) == estimates_of(nodes, 0)[:SCANS]

    shutil.rmtree(saved)
    for name in UP:
        assert manager.change(name, SHUTDOWN["active"])
        assert manager.state(name) == "finalized"
    nodes.until(lambda: listener.node.count_subscribers("hmt/closure_decisions") == 0)
    FolderReader(saved, FORMAT, VERSION)
    nodes.until(lambda: all(messages(name) == "finalized" for name in NODES))


def halt(manager, nodes, name):
    """Deactivate a node for which all others wait."""
    manager.lead([name], "deactivate", "inactive")
    nodes.until(lambda: int(nodes.diagnosis(name)["kept until it is active"] or 0) > 0)
    stands(nodes)


def take_down_and_up(manager, name):
    """Let an inactive node restart; it receives the whole chain once more."""
    for transition, state in (("cleanup", "unconfigured"), ("configure", "inactive"), ("activate", "active")):
        manager.lead([name], transition, state)


def renew_rtl(manager, nodes):
    """Let rtl restart, until all know of it that it receives odometry and says where the robot is."""
    node = nodes.listener.node
    manager.lead(["rtl"], "deactivate", "inactive")
    manager.lead(["rtl"], "cleanup", "unconfigured")
    nodes.until(lambda: (node.count_publishers(POSE), node.count_subscribers(ODOM)) == (0, 1))
    manager.lead(["rtl"], "configure", "inactive")
    manager.lead(["rtl"], "activate", "active")
    nodes.until(lambda: (node.count_publishers(POSE), node.count_subscribers(ODOM)) == (1, 2))


def stands(nodes):
    """Nothing more is reported of scans before the end of the log, but for what is on its way."""
    before = -1
    while before < len(nodes.estimates):
        before = len(nodes.estimates)
        nodes.listener.spin(1.0)  # 20 scans of a drive that goes on
    assert before < SCANS


def restart_all(manager, nodes, log):
    """Slam alone does not restart, all five do."""
    manager.lead(["slam"], "cleanup", "unconfigured")
    assert not manager.change("slam", "configure")
    assert manager.state("slam") == "unconfigured"
    nodes.until(lambda: "still have the map that slam gave up" in nodes.diagnosis("slam")["last error"])
    assert nodes.diagnosis("slam")["last error"].startswith("aam, rtl, tlca, tsbi still")
    manager.lead(NODES[1:], "cleanup", "unconfigured")
    manager.lead(NODES, "configure", "inactive")
    manager.lead(NODES, "activate", "active")
    nodes.until(lambda: nodes.diagnosis("slam")["last error"] == "")
    nodes.drive(log, first=0)
    nodes.until(lambda: len(nodes.estimates) == 2 * SCANS)
    nodes.park()


def test_a_node_that_cannot_be_configured_says_why_and_stays(listener, start, tmp_path):
    manager = Manager(listener)
    start("aam", autostart=False, filter__particles=0)
    start("tlca", autostart=False, start_from=tmp_path / "nowhere", recovery=tmp_path / "recovery")
    assert not manager.change("aam", "configure")
    assert not manager.change("tlca", "configure")
    for name in ("aam", "tlca"):
        assert manager.state(name) == "unconfigured"
        assert manager.change(name, SHUTDOWN["unconfigured"])
        assert manager.state(name) == "finalized"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_a_node_that_is_killed_comes_back_in_the_state_in_which_it_was(listener, start, tmp_path):
    reported, manager = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM), Manager(listener)
    node = start("rtl", recovery=tmp_path)
    manager.until("rtl", "active")
    assert manager.change("rtl", "deactivate")
    node.send_signal(signal.SIGKILL)
    node.communicate()
    received = len(reported)
    node = start("rtl", recovery=tmp_path)
    listener.until(lambda: len(reported) > received, alive=[node])
    assert reported[-1].status[0].message == "inactive"
