"""Warnings end, and what happened to the nodes stays on a topic; the nodes of all robots report to one topic, too."""

import time

import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from std_msgs.msg import String

from hmt_slam_ros.messages.messages import ClosureDecision
from hmt_slam_ros.messages.system_name import SystemName
from hmt_slam_ros.ros import diagnostics, topics
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics, is_of_other_namespace
from hmt_slam_ros.ros.topics import AGGREGATED, DOCUMENTS, INCIDENTS

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


def test_a_warning_ends_and_its_sentence_stays_with_the_time(listener, monkeypatch):
    own = NodeDiagnostics(listener.node, SystemName())
    reports = listener.subscribe(DiagnosticArray, AGGREGATED, topics.STREAM)

    def newest():
        count = len(reports)
        own.publish()
        listener.until(lambda: len(reports) > count)
        status = reports[-1].status[0]
        return status.level, status.message, {value.key: value.value for value in status.values}

    monkeypatch.setattr(diagnostics, "WARNING_LIFETIME", 0.3)
    own.warn("the wheels slip")
    level, message, _ = newest()
    assert (level, message) == (WARN, "the wheels slip")
    time.sleep(0.3)
    level, message, values = newest()
    assert (level, message, values["last error"]) == (OK, "running", "the wheels slip")
    assert values["last error at"].startswith("20")
    own.fail("the chain has a gap")
    own.warn("the wheels slip")
    assert newest()[:2] == (ERROR, "the chain has a gap")
    own.clear()
    own.fail("scans wait", lifetime=0.0)
    assert newest()[:2] == (OK, "running")
    own.system.note_other("two")
    level, message, values = newest()
    assert (level, values["second system"]) == (WARN, "two")
    assert message.startswith("a second system runs here, two: give each system a namespace")


def test_what_happens_to_a_node_stays_on_a_topic_and_is_where_aggregators_listen(listener, start):
    incidents = listener.subscribe(DiagnosticArray, f"robot1/{INCIDENTS}", topics.INCIDENT_HISTORY)
    of_robot = listener.subscribe(DiagnosticArray, "robot1/diagnostics", topics.STREAM)
    of_all = listener.subscribe(DiagnosticArray, AGGREGATED, topics.STREAM)
    decisions = listener.node.create_publisher(String, f"robot1/{DOCUMENTS[ClosureDecision]}", topics.CHAIN)
    namespace = ("-r", "__ns:=/robot1")
    view, rtl = start("view", *namespace, port=0), start("rtl", *namespace)
    for reports in (of_robot, of_all):
        listener.until(lambda reports=reports: any(each.status[0].name == "/robot1/rtl" for each in reports))
    assert is_of_other_namespace(of_all[-1].status[0], listener.node)
    decisions.publish(String(data='{"document":"closure_decision","version":99}'))

    def newest():
        return {(each.status[0].name, each.status[0].level): each.status[0].message for each in incidents}

    listener.until(lambda: "has version 99" in newest().get(("/robot1/rtl", WARN), ""), alive=[view, rtl])
    assert abs(incidents[-1].header.stamp.sec - time.time()) < 60.0
    rtl.kill()
    rtl.communicate()
    rtl = start("rtl", *namespace)
    listener.until(lambda: newest()["/robot1/rtl", WARN] == "was started again", alive=[view, rtl])
