"""Every node starts, says how it is, and ends with status 0 on request."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from logs_for_nodes import corridor_bag, is_alive

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry as OdometryMessage
from std_msgs.msg import Float64MultiArray, String

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.messages import AreaEvents, ClosureDecision, Hypotheses, Hypothesis, LocalEstimate
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.topics import DIAGNOSTICS, DOCUMENTS, HMT_POSE, KEYFRAMES, POSE
from hmt_slam_ros.sensors import Odometry

NODES = (*process_names(), "robot")


def parameters(name, tmp_path):
    return {"log": corridor_bag(tmp_path), "robot__discovery_timeout": 3600.0} if name == "robot" else {}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
def test_every_node_that_runs_ends_well_on_request(tmp_path, listener, start, number):
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    processes = {name: start(name, **parameters(name, tmp_path)) for name in NODES}
    listener.until(lambda: all(level(reported, name) for name in NODES), alive=processes.values())
    for name, process in processes.items():
        assert level(reported, name).level == DiagnosticStatus.OK
        process.send_signal(number)
    for name, process in processes.items():
        error = process.communicate(timeout=20)[1]
        assert process.returncode == 0, name
        assert "Traceback" not in error, name
        assert "terminate called" not in error, name


def test_a_value_out_of_range_keeps_every_node_from_starting(tmp_path, start):
    processes = {name: start(name, filter__particles=0, **parameters(name, tmp_path)) for name in NODES}
    for name, process in processes.items():
        error = process.communicate(timeout=40)[1]
        assert process.returncode == 2, name
        assert "filter.particles = 0" in error, name
        assert len(error.strip().splitlines()) == 1, name


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda number: number.name)
def test_a_node_that_is_still_being_loaded_ends_well_on_request(start, number):
    processes = []
    for moment in range(6):
        processes.append(start("slam", preload=False))
        while not heeds_sigterm(processes[-1].pid):
            time.sleep(0.01)
        time.sleep(0.3 * moment)
        processes[-1].send_signal(number)
    for process in processes:
        assert process.communicate(timeout=40) == ("", "")
        assert process.returncode == 0


def heeds_sigterm(pid):
    """Whether a process has a handler for it, which Python alone has not."""
    caught = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("SigCgt:"))
    return bool(int(caught.split()[1], 16) >> signal.SIGTERM - 1 & 1)


def test_two_signals_in_a_row_do_no_harm(listener, start):
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    process = start("rtl")
    listener.until(lambda: reported)
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=20)[1]
    assert process.returncode == 0, error


def level(reported, name):
    levels = [status for message in reported for status in message.status if status.name == f"/{name}"]
    return levels[-1] if levels else None


def test_a_malformed_document_is_reported_and_survived(listener, start):
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    events = listener.node.create_publisher(String, DOCUMENTS[ClosureDecision], topics.CHAIN)
    process = start("rtl")
    events.publish(String(data='{"document":"closure_decision","version":99}'))
    listener.until(
        lambda: (status := level(reported, "rtl")) and status.level == DiagnosticStatus.WARN, alive=[process]
    )
    assert "has version 99, not 2" in level(reported, "rtl").message


def test_a_lost_message_of_the_chain_is_reported(listener, start):
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    accepted = listener.node.create_publisher(String, DOCUMENTS[ClosureDecision], topics.CHAIN)
    process = start("rtl")
    accepted.publish(String(data=encode(ClosureDecision(0))))
    for sequence in (2, 3, 4):
        accepted.publish(String(data=encode(ClosureDecision(sequence))))
    listener.until(
        lambda: (status := level(reported, "rtl")) and status.level == DiagnosticStatus.ERROR, alive=[process]
    )
    assert "ClosureDecision 1 never came, 2 did" in level(reported, "rtl").message


def test_a_node_that_starts_late_catches_up(listener, start):
    """What was reported before a node started is latched, and reaches it in the order of the chain."""
    keyframes = listener.node.create_publisher(String, KEYFRAMES, topics.CHAIN)
    hypotheses = listener.node.create_publisher(String, DOCUMENTS[Hypotheses], topics.CHAIN)
    accepted = listener.node.create_publisher(String, DOCUMENTS[ClosureDecision], topics.CHAIN)
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    assert keyframes
    for sequence in range(3):
        hypotheses.publish(String(data=encode(Hypotheses(sequence, (Hypothesis(0, 0, 1.0, 0),)))))
        accepted.publish(String(data=encode(ClosureDecision(sequence))))
    process = start("rtl")

    def status_values():
        status = level(reported, "rtl")
        return {entry.key: entry.value for entry in status.values} if status else {}

    listener.until(lambda: status_values().get("received ClosureDecision") == "3", alive=[process])
    listener.until(lambda: status_values().get("received Hypotheses") == "3", alive=[process])
    listener.until(lambda: status_values().get("waiting for their turn") == "0", alive=[process])


def test_rtl_answers_every_odometry_reading(listener, start):
    odom = listener.node.create_publisher(OdometryMessage, "odom", topics.SENSOR)
    estimates = listener.node.create_publisher(String, DOCUMENTS[LocalEstimate], topics.CHAIN)
    local = listener.subscribe(PoseWithCovarianceStamped, HMT_POSE, topics.STREAM)
    placed = listener.subscribe(PoseWithCovarianceStamped, POSE, topics.STREAM)
    process = start("rtl")
    matched = (odom, estimates)
    listener.until(lambda: all(publisher.get_subscription_count() for publisher in matched), alive=[process])
    belief = PoseGaussian(np.array([1.0, 2.0, 0.0]), 1e-4 * np.eye(3))
    reading = Odometry(0, np.zeros(3))
    while not placed:  # the publishers of rtl may find this node later than its subscriptions do
        reading = Odometry(reading.stamp + 20_000_000, reading.pose)
        odom.publish(conversions.odometry_message(reading, "odom", "base_link"))
        estimates.publish(String(data=encode(LocalEstimate(reading.stamp, 0, 0, belief, reading.pose, 0))))
        listener.spin(0.1)
    listener.until(lambda: len(local) == len(placed))
    before = len(placed)
    for k in range(1, 51):
        step = Odometry(reading.stamp + k * 20_000_000, np.array([0.01 * k, 0.0, 0.0]))
        odom.publish(conversions.odometry_message(step, "odom", "base_link"))
    listener.until(lambda: len(placed) == len(local) == before + 50)
    assert local[-1].header.frame_id == "area_0"
    assert placed[-1].header.frame_id == "map"
    assert conversions.pose_from_message(placed[-1].pose.pose) == pytest.approx([1.5, 2.0, 0.0])
    assert placed[-1].pose.covariance[0] > placed[before].pose.covariance[0]


def test_rtl_publishes_the_transform_from_map_to_odom(listener, start):
    reason = "tf2_msgs is not installed: run scripts/test.sh, which builds it"
    TFMessage = pytest.importorskip("tf2_msgs.msg", reason=reason).TFMessage
    moving = listener.subscribe(TFMessage, "tf", topics.STREAM)
    odom = listener.node.create_publisher(OdometryMessage, "odom", topics.SENSOR)
    estimates = listener.node.create_publisher(String, DOCUMENTS[LocalEstimate], topics.CHAIN)
    start("rtl")
    listener.until(lambda: all(publisher.get_subscription_count() for publisher in (odom, estimates)))
    belief = PoseGaussian(np.array([1.0, 2.0, 0.0]), 1e-4 * np.eye(3))
    stamp = 0
    while not moving:
        stamp += 20_000_000
        estimates.publish(String(data=encode(LocalEstimate(stamp, 0, 0, belief, np.array([5.0, 0.0, 0.0]), 0))))
        odom.publish(conversions.odometry_message(Odometry(stamp, np.array([5.0, 0.0, 0.0])), "odom", "base_link"))
        listener.spin(0.1)
    (joint,) = moving[0].transforms
    assert (joint.header.frame_id, joint.child_frame_id) == ("map", "odom")
    assert (joint.transform.translation.x, joint.transform.translation.y) == pytest.approx((-4.0, 2.0))


def test_a_best_effort_driver_is_received_too(listener, start):
    live = listener.node.create_publisher(OdometryMessage, "odom", topics.LIVE_SENSOR)
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    process = start("rtl")
    reading = Odometry(0, np.zeros(3))

    def has_count():
        status = level(reported, "rtl")
        return status is not None and any(entry.key == "received Odometry" for entry in status.values)

    while not has_count():
        reading = Odometry(reading.stamp + 20_000_000, reading.pose)
        live.publish(conversions.odometry_message(reading, "odom", "base_link"))
        listener.spin(0.1)
        assert process.poll() is None


def test_aam_answers_only_to_keyframes(listener, start):
    answers = listener.subscribe(String, DOCUMENTS[AreaEvents], topics.CHAIN)
    costs = listener.subscribe(Float64MultiArray, "hmt/cost", topics.CHAIN)
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    start("aam")
    listener.until(lambda: reported)
    assert not answers
    assert not costs


def test_a_node_ends_with_the_program_that_started_it(listener):
    """A program that dies without a word, as by SIGKILL, leaves no node behind."""
    script = (
        "import os, subprocess, sys, time\n"
        "environment = {**os.environ, 'HMT_SLAM_PARENT': str(os.getpid())}\n"
        "node = subprocess.Popen([sys.executable, '-m', 'hmt_slam_ros.ros.run_node', 'rtl'], env=environment)\n"
        "print(node.pid, flush=True)\n"
        "time.sleep(600)\n"
    )
    reported = listener.subscribe(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    node = int(parent.stdout.readline())
    listener.until(lambda: reported, alive=[parent])
    assert is_alive(node)
    parent.kill()
    parent.communicate()
    listener.until(lambda: not is_alive(node))
