"""Latency of the nodes' poses, with a fast laser and in replays at ten times real time."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from benchmark.logs import WITH_RELATIONS, open_logs
from benchmark.report import Report, Requirement, table
from benchmark.running_nodes import Listener
from benchmark.settings import Settings
from hmt_slam_ros.messages.documents import RobotStatus, decode
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import stamp_from_time
from hmt_slam_ros.ros.topics import DOCUMENTS, ODOM, POSE, ROBOT_STATUS, SCAN

PROCESSES = process_names()
BUSY = "sim:office,rate=10,readings=10"
"""A drive with 100 odometry readings a second."""

FAST = "sim:office,rate=40,readings=3,beams=1080,field_of_view=270"
"""A drive with 40 scans a second of 1080 beams."""

SECONDS = 60.0
"""Duration of each drive, s."""

LATENCY = 0.010
"""Largest time from an odometry message to its pose, at 99 of 100, s."""

BEHIND = 0.5
"""Largest delay of metric SLAM at the end with the fast laser, s."""

RATE = 10.0
"""Speed of replays relative to real time."""

LATER = 1.1
"""Largest ratio of the time of a replay to that of its log at that rate."""

_TIMEOUT = 3600.0

POLICY = (
    f"Every node is an OS process, and messages go over DDS. Saturated: a drive of {SECONDS:.0f} s with 100 odometry "
    "readings a second in real time, with one process for every core that only computes. The latency is the time from "
    "the publication of an odometry message to that of its pose, by the time stamps of DDS. Fast laser: "
    f"{SECONDS:.0f} s with 40 scans a second of 1080 beams; the delay is that from a scan to metric SLAM's estimate. "
    f"Replays: the logs at {RATE:g} times real time with flow control: the robot waits while 20 scans have no answer."
)

Stamped = dict[int, float]


class MessageTimes(NamedTuple):
    """Times at which messages were published, by the stamps in their headers.

    :ivar sent: {stamp, ns: s}.
    :ivar received: likewise.
    """

    sent: Stamped
    received: Stamped

    @property
    def delays(self) -> NDArray[np.float64]:
        """Delays of all answered messages, s."""
        return np.array([moment - self.sent[stamp] for stamp, moment in self.received.items() if stamp in self.sent])


def measure_live(settings: Settings) -> Report:
    """Measure the delays of the nodes, with drives and with replays."""
    report = Report("live", "Latency of the nodes")
    poses, scans = measure_saturated(BUSY, SECONDS), measure_fast(FAST, SECONDS)
    requirements = [
        Requirement("odometry to pose, all else saturated, p99", float(np.quantile(poses.delays, 0.99)), LATENCY, "s"),
        Requirement("odometry without a pose", count_unanswered(poses), 0),
        Requirement("fast laser: scans without a pose", len(scans.sent) - len(scans.delays), 0),
        Requirement("fast laser: delay at the end", float(scans.delays[-20:].mean()), BEHIND, "s"),
    ]
    rows = [_row("odometry to pose, saturated", poses.delays), _row("scan to pose, fast laser", scans.delays)]
    report.body.append(table(["", "messages", "median [ms]", "p99 [ms]", "largest [ms]"], rows))
    with open_logs(settings.logs_or(WITH_RELATIONS)) as logs:
        replays = {log.name: replay_log(str(log.path)) for log in logs}
    for name, replay in replays.items():
        requirements.append(Requirement(f"{name}: scans lost", replay.scans - replay.answered_scans, 0))
        requirements.append(Requirement(f"{name}: time / that of the log at {RATE:g} times", replay.time_ratio, LATER))
    report.requirements += requirements
    report.body += [_replay_table(replays), POLICY]
    report.data = {
        "saturated": poses.delays.tolist(),
        "fast": scans.delays.tolist(),
        "replays": {name: replay._asdict() for name, replay in replays.items()},
    }
    return report


def measure_saturated(log: str, seconds: float) -> MessageTimes:
    """Times of odometry and poses, while all cores are busy."""
    with _run_nodes() as listener, _saturate_cores():
        sent = _collect_times(listener, Odometry, ODOM, topics.SENSOR)
        received = _collect_times(listener, PoseWithCovarianceStamped, POSE, topics.STREAM)
        _play_log(listener, log, seconds, ODOM)
        return MessageTimes(sent, received)


def measure_fast(log: str, seconds: float) -> MessageTimes:
    """Times of scans and estimates, with a fast laser."""
    with _run_nodes() as listener:
        sent = _collect_times(listener, LaserScan, SCAN, topics.SENSOR)
        received: Stamped = {}

        def add_estimate(message: String, info: dict[str, int]) -> None:
            estimate = decode(message.data, LocalEstimate)
            received[estimate.stamp] = 1e-9 * info["source_timestamp"]

        listener.node.create_subscription(String, DOCUMENTS[LocalEstimate], add_estimate, topics.CHAIN)
        _play_log(listener, log, seconds, SCAN)
        listener.wait_until(lambda: len(received) >= len(sent))
        return MessageTimes(sent, received)


class ReplayScores(NamedTuple):
    """The scores of a replay.

    :ivar scans: of the log.
    :ivar answered_scans: number of scans with a pose.
    :ivar time_ratio: ratio of its time to that of the log at this rate.
    """

    scans: int
    answered_scans: int
    time_ratio: float


def replay_log(log: str) -> ReplayScores:
    """Replay a log at ten times real time."""
    duration = open_log(log).duration / RATE
    with _run_nodes() as listener:
        answered_scans = _count_documents(listener, DOCUMENTS[LocalEstimate])
        begin = time.monotonic()
        status = _play_log(listener, log, 0.0, rate=RATE, flow_control=True)
        seconds = time.monotonic() - begin
        listener.wait_until(lambda: answered_scans() >= status.scans)
        return ReplayScores(status.scans, answered_scans(), seconds / duration)


def count_unanswered(passed: MessageTimes) -> int:
    """Number of messages without an answer since the first answered one."""
    first = min(passed.received)
    return sum(stamp not in passed.received for stamp in passed.sent if stamp >= first)


def _count_documents(listener: Listener, topic: str) -> Callable[[], int]:
    """A function that returns the number of documents of a topic since now."""
    documents: list[None] = []
    listener.node.create_subscription(String, topic, lambda _message: documents.append(None), topics.CHAIN)
    return lambda: len(documents)


def _replay_table(replays: dict[str, ReplayScores]) -> str:
    head = ["log", "scans", "with a pose", f"time / that of the log at {RATE:g} times"]
    return table(
        head,
        [[name, str(own.scans), str(own.answered_scans), f"{own.time_ratio:.2f}"] for name, own in replays.items()],
    )


@contextmanager
def _run_nodes() -> Iterator[Listener]:
    """All five nodes as processes, with a listener."""
    with ExitStack() as stack:
        listener = stack.enter_context(Listener())
        for name in PROCESSES:
            stack.enter_context(listener.running(name, {}))
        yield listener


@contextmanager
def _saturate_cores() -> Iterator[None]:
    """A computing process for every core."""
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def _play_log(
    listener: Listener,
    log: str,
    seconds: float,
    monitored_topic: str = "",
    rate: float = 1.0,
    *,
    flow_control: bool = False,
) -> RobotStatus:
    """Play a log to its end by the robot node; return the last status.

    :param seconds: of the log that are played; 0 for all.
    :param monitored_topic: the robot's topic that the listener has subscribed to.
    """
    statuses: list[RobotStatus] = []
    listener.node.create_subscription(
        String, ROBOT_STATUS, lambda message: statuses.append(decode(message.data, RobotStatus)), topics.LATCHED
    )
    parameters: dict[str, str | float | list[float]] = {
        "log": log,
        "robot.duration": seconds,
        "robot.rate": rate,
        "robot.flow_control": str(flow_control).lower(),
        "robot.scan_listeners": 1 + (monitored_topic == SCAN),
        "robot.odometry_listeners": 2 + (monitored_topic == ODOM),
        "robot.discovery_timeout": 120.0,
    }
    with listener.running("robot", parameters):
        listener.wait_until(lambda: bool(statuses) and statuses[-1].state == "ended", _TIMEOUT)
    return statuses[-1]


def _collect_times(listener: Listener, kind: type, topic: str, profile: QoSProfile) -> Stamped:
    """A dictionary that collects {stamp of a message: time at which it was published, s}."""
    times: Stamped = {}

    def add_time(message: Odometry, info: dict[str, int]) -> None:
        times[stamp_from_time(message.header.stamp)] = 1e-9 * info["source_timestamp"]

    listener.node.create_subscription(kind, topic, add_time, profile)
    return times


def _row(name: str, delays: NDArray[np.float64]) -> list[str]:
    return [name, str(len(delays)), *(f"{1e3 * value:.1f}" for value in np.quantile(delays, [0.5, 0.99, 1.0]))]
