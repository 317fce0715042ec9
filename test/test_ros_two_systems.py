"""Two systems in one ROS domain without namespaces: the later one waits for the end of the other, and then stops."""

import json
import signal
import socket
import subprocess
from contextlib import suppress
from dataclasses import replace
from urllib.request import urlopen

import numpy as np
import preloaded
import pytest
from logs_for_nodes import LASER, PACE, SECOND, START, Corridor, corridor_bag
from test_ros_localization import NODES, Nodes

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState

from hmt_slam_ros.logs import LogRecord
from hmt_slam_ros.logs.writer import write_bag
from hmt_slam_ros.messages.documents import decode
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.topics import DIAGNOSTICS, POSE

SCANS = 32
DAY = 86_400 * SECOND
WAITS = "the system 'one' was started earlier and runs here, so this node waits up to 15 s for its end: end it, or give"
STOPS = "the system 'one' was started earlier and runs here, so this node does not run beside it: end it, or give each"


class NextDay(Corridor):
    """The same drive, a day later."""

    def records(self):
        for record in super().records():
            stamp = record.measurement.stamp + DAY
            yield LogRecord(stamp, replace(record.measurement, stamp=stamp))


def values(status):
    return {one.key: one.value for one in status.values}


def started_at(status):
    return values(status)["started at"]


def status_of(reports, system, node):
    """The last diagnostics of a node of a system."""
    found = (report.status[0] for report in reversed(reports) if report.status[0].name == f"/{node}")
    return next((status for status in found if values(status).get("system") == system), DiagnosticStatus())


def values_of(reports, system, node):
    """The last values of a node of a system, {name: value}."""
    return values(status_of(reports, system, node))


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def test_a_later_set_waits_for_the_earlier_one_then_ends_and_never_touches_it(listener, start, tmp_path):
    ports = {"one": free_port(), "two": free_port()}
    later = tmp_path / "later"
    write_bag(NextDay(SCANS), later)
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    first = Nodes(start, listener, laser_pose=LASER.tolist(), system="one")
    page = start("view", port=ports["one"], system="one")
    first.drive(corridor_bag(tmp_path, SCANS), first=0, rate=0.3, system="one")
    first.until(lambda: len(first.estimates) > 2)

    def verdict(system):
        with suppress(OSError), urlopen(f"http://127.0.0.1:{ports[system]}/snapshot.json", timeout=5) as answer:
            return json.load(answer).get("verdict", {})
        return {}

    second = Nodes(start, listener, laser_pose=LASER.tolist(), system="two")
    second.alive.append(start("explorer", system="two"))
    second.drive(later, first=0, system="two")
    start("view", port=ports["two"], system="two")
    everyone = [page, *first.alive, *second.alive]
    for node in (*NODES, "robot", "explorer"):
        listener.until(lambda node=node: status_of(reports, "two", node).message.startswith(WAITS), alive=everyone)
    for node in NODES:
        assert values_of(reports, "two", node)["state"] == "inactive"
        listener.until(lambda node=node: values_of(reports, "one", node).get("second system") == "two", alive=everyone)
        assert values_of(reports, "one", node)["state"] == "active"
    listener.until(lambda: verdict("one").get("text") == "A second system runs here: two.", alive=everyone)
    assert verdict("one")["level"] == "attention"
    assert verdict("one")["advice"] == "Give each system a namespace or a ROS_DOMAIN_ID of its own."
    listener.until(lambda: verdict("two").get("advice", "").startswith(WAITS), alive=everyone)
    assert verdict("two")["text"] == "This system waits for the end of an earlier one."

    doctor = preloaded.start(
        preloaded.COMMAND,
        "doctor",
        "--live",
        "--seconds",
        "3",
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    listener.until(lambda: doctor.poll() is not None)
    assert f"slam says: {WAITS}" in doctor.communicate()[0]
    listener.until(lambda: status_of(reports, "two", "slam").message.startswith(STOPS))
    listener.until(lambda: all(one.poll() is not None for one in second.alive), alive=[page, *first.alive])
    for one in second.alive:
        assert one.returncode == 3
        error = one.communicate()[1]
        assert STOPS in error.splitlines()[-1]
        assert "Traceback" not in error

    first.until(lambda: len(first.estimates) == SCANS)
    estimates = [decode(message.data, LocalEstimate) for message in first.estimates]
    assert {json.loads(message.data)["system"] for message in first.estimates} == {"one"}
    assert estimates[-1].stamp == START + (SCANS - 1) * SECOND // 5
    assert np.abs(estimates[-1].pose.mean - 4 * (SCANS - 1) * PACE).max() < 0.1
    assert not any(key.startswith("refused on odom") for key in values_of(reports, "one", "rtl"))


@pytest.mark.parametrize(("one", "two"), [("one", "two"), ("", "")])
def test_a_launch_that_comes_before_the_end_of_the_old_one_names_it_and_goes_on_after_it(listener, start, one, two):
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)

    def latest(process):
        """The last status of a process, by the order of the starts."""
        starts = sorted({started_at(report.status[0]) for report in reports})
        mine = [report.status[0] for report in reports if started_at(report.status[0]) == starts[process]]
        return mine[-1]

    nodes = [start("slam", *(["-p", f"system:={one}"] if one else []))]
    listener.until(lambda: reports and values(latest(0))["state"] == "active", alive=nodes)
    nodes.append(start("slam", *(["-p", f"system:={two}"] if two else [])))
    name = "the system 'one'" if one != two else f"another node '/slam', of {started_at(latest(0))},"
    begin = f"{name} was started earlier and runs here, so this node waits up to 15 s for its end: end it, or give each"
    listener.until(lambda: len({started_at(report.status[0]) for report in reports}) == 2, alive=nodes)
    listener.until(lambda: latest(1).message.startswith(begin), alive=nodes)
    listener.until(lambda: "second system" in values(latest(0)), alive=nodes)
    assert values(latest(0))["second system"] == (two or "without a name")
    assert values(latest(0))["state"] == "active"
    assert values(latest(1))["state"] == "inactive"
    nodes[0].send_signal(signal.SIGINT)
    assert nodes.pop(0).wait(20) == 0
    listener.until(lambda: values(latest(1))["state"] == "active", seconds=5.0, alive=nodes)
    listener.until(lambda: latest(1).message == "running", seconds=5.0, alive=nodes)


def test_a_killed_node_that_is_started_again_and_a_node_in_another_namespace_are_no_second_system(listener, start):
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    others = listener.subscribe(DiagnosticArray, f"robot/{DIAGNOSTICS}", topics.STREAM)
    killed = start("slam", "-p", "system:=one")
    other = start("slam", "-p", "system:=two", "-r", "__ns:=/robot")
    listener.until(lambda: values_of(reports, "one", "slam").get("state") == "active", alive=[killed, other])
    listener.until(lambda: listener.node.get_node_names_and_namespaces().count(("slam", "/")) == 1)
    killed.kill()
    killed.communicate()
    del reports[:]
    again = start("slam", "-p", "system:=one")
    listener.until(lambda: listener.node.get_node_names_and_namespaces().count(("slam", "/")) == 2, alive=[again])
    running = [again, other]
    listener.until(lambda: values_of(reports, "one", "slam").get("state") == "active", seconds=15.0, alive=running)
    listener.until(lambda: others and values(others[-1].status[0])["state"] == "active", alive=running)
    for report in (*reports, *others):
        assert report.status[0].level == DiagnosticStatus.OK, report.status[0].message
        assert "second system" not in values(report.status[0])


def test_a_lifecycle_manager_is_refused_an_activation_beside_an_earlier_system(listener, start):
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    nodes = [start("aam", system="one")]
    listener.until(lambda: values_of(reports, "one", "aam").get("state") == "active", alive=nodes)
    nodes.append(start("aam", system="two", autostart=False))
    listener.until(lambda: values_of(reports, "two", "aam").get("state") == "unconfigured", alive=nodes)
    # Both nodes get the requests; the first one is where they lead, and refuses them.
    client = listener.node.create_client(ChangeState, "aam/change_state")
    listener.until(client.service_is_ready)
    for transition in ("configure", "activate"):
        client.call_async(ChangeState.Request(transition=Transition(label=transition)))
        listener.until(lambda: values_of(reports, "two", "aam").get("state") == "inactive", alive=nodes)
    listener.until(lambda: status_of(reports, "two", "aam").message.startswith(STOPS), alive=nodes)
    assert status_of(reports, "two", "aam").level == DiagnosticStatus.ERROR
    assert values_of(reports, "two", "aam")["state"] == "inactive"
    assert values_of(reports, "one", "aam")["state"] == "active"


@pytest.mark.long
def test_a_set_that_meets_an_earlier_one_amid_a_drive_saves_its_map_and_ends(listener, start, tmp_path):
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    first = [start(node, system="one") for node in NODES]
    listener.until(lambda: all(values_of(reports, "one", node).get("state") == "active" for node in NODES), alive=first)
    for node in first:
        node.send_signal(signal.SIGSTOP)
    saved = tmp_path / "map"
    second = Nodes(start, listener, laser_pose=LASER.tolist(), system="two", save_on_shutdown=True, save_to=saved)
    second.drive(corridor_bag(tmp_path, SCANS), first=0)
    second.until(lambda: len(second.estimates) == SCANS)
    for node in first:
        node.send_signal(signal.SIGCONT)
    listener.until(lambda: all(one.poll() is not None for one in second.alive), alive=first)
    assert {one.returncode for one in second.alive} == {3}
    assert values_of(reports, "two", "slam")["state"] == "inactive"
    assert (saved / "manifest.json").exists()
    assert all(values_of(reports, "one", node)["state"] == "active" for node in NODES)


@pytest.mark.long
def test_another_program_that_publishes_the_pose_is_detected_by_its_publisher(listener, start):
    reports = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    node = start("rtl")
    publisher = listener.node.create_publisher(PoseWithCovarianceStamped, POSE, topics.STREAM)
    listener.until(lambda: reports and values(reports[-1].status[0]).get("second system"), alive=[node])
    assert values(reports[-1].status[0])["second system"] == "2 publishers of pose"
    sentence = "pose has 2 publishers, so a second system runs here: give each system a namespace or a ROS_DOMAIN_ID of"
    assert sentence in reports[-1].status[0].message
    assert values(reports[-1].status[0])["state"] == "active"
    listener.node.destroy_publisher(publisher)
    listener.until(lambda: "second system" not in values(reports[-1].status[0]), alive=[node])


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
