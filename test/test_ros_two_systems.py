"""Two systems in one ROS domain without namespaces: each goes on by itself, and says that there is another one."""

import json
import socket
from contextlib import suppress
from dataclasses import replace
from urllib.request import urlopen

import numpy as np
import pytest
from logs_for_nodes import LASER, PACE, SECOND, START, Corridor, corridor_bag
from test_ros_localization import NODES, Nodes

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray

from hmt_slam_ros.logs import LogRecord
from hmt_slam_ros.logs.writer import write_bag
from hmt_slam_ros.messages.documents import decode
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DIAGNOSTICS

SCANS = 32
DAY = 86_400 * SECOND
OF_BOTH = {"robot__flow_control": False, "robot__scan_listeners": 2, "robot__odometry_listeners": 4}
"""Parameters of a robot that waits for the nodes of both systems, and not for their answers."""


class NextDay(Corridor):
    """The same drive, a day later."""

    def records(self):
        for record in super().records():
            stamp = record.measurement.stamp + DAY
            yield LogRecord(stamp, replace(record.measurement, stamp=stamp))


def values_of(reports, system, node):
    """The last diagnostics of a node of a system, {name: value}."""
    for report in reversed(reports):
        status = report.status[0]
        values = {one.key: one.value for one in status.values}
        if status.name == f"/{node}" and values.get("system") == system:
            return values
    return {}


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def test_both_go_on_and_report_each_other_on_diagnostics_and_on_the_page(listener, start, tmp_path):
    port = free_port()
    later = tmp_path / "later"
    write_bag(NextDay(SCANS), later)
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    systems = {name: Nodes(start, listener, laser_pose=LASER.tolist(), system=name) for name in ("one", "two")}

    read = []

    def estimates(system):
        """Those of the first drive, by stamp."""
        texts = [message.data for message in systems["one"].estimates[len(read) :]]
        read.extend((json.loads(text)["system"], decode(text, LocalEstimate)) for text in texts)
        own = [one for sender, one in read if sender == system]
        return {one.stamp: one.pose.mean for one in own if one.stamp <= START + SCANS * SECOND}

    view = start("view", port=port, system="one")
    for system, log in (("one", corridor_bag(tmp_path, SCANS)), ("two", later)):
        systems[system].drive(log, first=0, rate=0.3, system=system, **OF_BOTH)
        systems["one"].until(lambda: estimates("one"))
    everyone = [view, *systems["one"].alive, *systems["two"].alive]
    for system, other in (("one", "two"), ("two", "one")):
        for node in ("aam", "tsbi", "tlca", "rtl"):
            listener.until(
                lambda system=system, node=node, other=other: (
                    values_of(reports, system, node).get("second system") == other
                ),
                alive=everyone,
            )

    def verdict():
        with suppress(OSError), urlopen(f"http://127.0.0.1:{port}/snapshot.json", timeout=5) as answer:
            return json.load(answer).get("verdict", {})
        return {}

    listener.until(lambda: verdict().get("text") == "A second system runs here: two.", alive=everyone)
    assert verdict()["level"] == "attention"
    assert verdict()["advice"] == "Give each system a namespace or a ROS_DOMAIN_ID of its own."

    # Measurements do not name their system: both follow the clock that they received first.
    end = START + (SCANS - 1) * SECOND // 5
    for system in systems:
        listener.until(lambda system=system: end in estimates(system), alive=everyone)
        assert len(estimates(system)) == SCANS
        assert np.abs(estimates(system)[end] - 4 * (SCANS - 1) * PACE).max() < 0.1
        for node in ("slam", "rtl"):
            assert int(values_of(reports, system, node)["refused on odom"]) > 0


@pytest.mark.parametrize(("one", "two"), [("one", "two"), ("", ""), ("same", "same")])
def test_a_launch_that_was_left_running_and_a_second_one_name_each_other_at_once(listener, start, one, two):
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    nodes = [start("slam", *(["-p", f"system:={name}"] if name else [])) for name in (one, two)]

    def others():
        """{start of a node: the system that it reports}, of those that warn of it."""
        found = {}
        for report in reports:
            status = report.status[0]
            values = {each.key: each.value for each in status.values}
            if status.message.startswith(f"a second system runs here, {values.get('second system')}: give each"):
                found[values["started at"]] = values["second system"]
        return found

    listener.until(lambda: len(others()) == 2, alive=nodes)
    assert set(others().values()) == ({one, two} if one else {"without a name"})


@pytest.mark.long
def test_systems_without_names_are_detected_by_their_publishers(listener, start):
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    nodes = [start("rtl"), start("rtl")]

    def latest():
        return [{one.key: one.value for one in report.status[0].values} for report in reports[-2:]]

    listener.until(
        lambda: len(reports) > 2 and all(values.get("second system") == "2 publishers of pose" for values in latest()),
        alive=nodes,
    )
    sentence = "pose has 2 publishers, so a second system runs here: give each system a namespace or a ROS_DOMAIN_ID of"
    assert sentence in reports[-1].status[0].message
    nodes.pop().terminate()
    listener.until(lambda: "second system" not in latest()[-1], alive=nodes)


def test_a_robot_and_a_process_that_are_started_by_hand_join_the_system_beside_them(listener, start, tmp_path):
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    nodes = Nodes(start, listener, laser_pose=LASER.tolist(), system="one")
    tlca = nodes.alive.pop(NODES.index("tlca"))
    tlca.kill()
    tlca.communicate()
    nodes.alive.append(start("tlca"))
    nodes.drive(corridor_bag(tmp_path, 20), first=0)
    nodes.until(lambda: len(nodes.estimates) == 20)
    for node in (*NODES, "robot"):
        nodes.until(lambda node=node: values_of(reports, "one", node))
        assert "second system" not in values_of(reports, "one", node)
    # The robot's status counts, from which slam knows that the log has ended.
    nodes.until(lambda: values_of(reports, "one", "slam").get("sent EndOfRun") == "1")
    assert "robot_status" not in values_of(reports, "one", "slam")["last error"]
