"""Latency of the nodes' poses, with a fast laser and in replays at ten times real time."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import LaserScan
from std_msgs.msg import String

from benchmark.logs import open_logs
from benchmark.report import Report, Requirement, table
from benchmark.running_nodes import Listener
from benchmark.settings import Settings
from hmt_slam_ros.messages.documents import RobotStatus, decode
from hmt_slam_ros.messages.messages import EarlyEstimate, LocalEstimate
from hmt_slam_ros.metric_slam.look_ahead import EarlyEstimateRecord
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.process_memory import proportional_set_size
from hmt_slam_ros.process_table import ALL, process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import stamp_from_time
from hmt_slam_ros.ros.topics import DOCUMENTS, ODOM, POSE, ROBOT_STATUS, SCAN

PROCESSES = process_names()
BUSY = "sim:office,rate=10,readings=10"
"""A drive with 100 odometry readings a second."""

FAST = "sim:office,rate=40,readings=3,beams=1080,field_of_view=270,laps=3"
"""Three laps of a building, in which loops close, with 40 scans a second of 1080 beams."""

SECONDS, FAST_SECONDS = 60.0, 600.0
"""Durations of the drives, and of that with the fast laser, s."""

LATENCY, SATURATED_LATENCY = 0.005, 0.010
"""Largest time from an odometry message to its pose, at 99 of 100, s; and while all cores are busy."""

SCAN_LATENCY, LARGEST_SCAN_LATENCY = 0.030, 0.100
"""Largest time from a scan to its first estimate, early or not: at 99 of 100, and of all, s."""

BEHIND = 0.5
"""Largest delay of metric SLAM at the end with the fast laser, s."""

SLOW_TSBI = ("-m", "benchmark.slow_topology")
"""Arguments of the Python interpreter that run a node of TSBI which takes a second for each event."""

REPLAYED = ("aces", "intel", "csail")

RATE = 10.0
"""Speed of replays relative to real time."""

LATER = 1.1
"""Largest ratio of the time of a replay to that of its log at that rate."""

MEMORY = 500.0
"""Largest memory of all nodes on Intel, forked from one program, MB."""

_TIMEOUT = 3600.0

POLICY = (
    "Every node is an OS process, and messages go over DDS. Latencies are by the time stamps of DDS. Odometry to pose: "
    f"{SECONDS:.0f} s with 100 odometry readings a second in real time; saturated: beside one process for every core "
    "that only computes. Scan to estimate: to the first one, which is an early estimate where the scan waits for "
    f"topology. Fast laser: {FAST_SECONDS:.0f} s with 40 scans a second of 1080 beams in a building with loops. Slow "
    "topology: TSBI takes a second more for each keyframe event. Replays: the logs at "
    f"{RATE:g} times real time with flow control: the robot waits while 20 scans have no answer."
)

Stamped = dict[int, float]
Estimate = TypeVar("Estimate", EarlyEstimate, LocalEstimate)


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


class ScanTimes(NamedTuple):
    """Times of scans and of their estimates.

    :ivar first: up to the first estimate of a scan, early or not.
    :ivar final: up to the estimate of metric SLAM.
    :ivar early: the early estimates against those of metric SLAM.
    """

    first: MessageTimes
    final: MessageTimes
    early: EarlyEstimateRecord


def measure_live(settings: Settings) -> Report:
    """Measure the delays of the nodes, with drives and with replays."""
    report = Report("live", "Latency of the nodes")
    poses = {"alone": measure_odometry(BUSY, SECONDS), "all else saturated": measure_saturated(BUSY, SECONDS)}
    scans = {
        "real time": measure_scans(BUSY, SECONDS),
        "fast laser": measure_scans(FAST, FAST_SECONDS),
        "slow topology": measure_scans(BUSY, SECONDS, SLOW_TSBI),
    }
    for name, limit in zip(poses, (LATENCY, SATURATED_LATENCY), strict=True):
        report.requirements += [
            Requirement(f"odometry to pose, {name}, p99", float(np.quantile(poses[name].delays, 0.99)), limit, "s"),
            Requirement(f"{name}: odometry without a pose", count_unanswered(poses[name]), 0),
        ]
    for name, times in scans.items():
        first = times.first.delays
        report.requirements += [
            Requirement(f"scan to estimate, {name}, p99", float(np.quantile(first, 0.99)), SCAN_LATENCY, "s"),
            Requirement(f"scan to estimate, {name}, largest", float(first.max()), LARGEST_SCAN_LATENCY, "s"),
            Requirement(f"{name}: scans without a pose", len(times.final.sent) - len(times.final.delays), 0),
        ]
    behind = float(scans["fast laser"].final.delays[-20:].mean())
    report.requirements.append(Requirement("fast laser: delay at the end", behind, BEHIND, "s"))
    rows = [_row(f"odometry to pose, {name}", times.delays) for name, times in poses.items()]
    for name, times in scans.items():
        rows.append(_row(f"scan to first estimate, {name}", times.first.delays))
        rows.append(_row(f"scan to estimate of metric SLAM, {name}", times.final.delays))
        report.body.append(f"Early estimates, {name}: {times.early}.")
    report.body.append(table(["", "messages", "median [ms]", "p99 [ms]", "largest [ms]"], rows))
    with open_logs(settings.logs_or(REPLAYED)) as logs:
        replays = {log.name: replay_log(str(log.path)) for log in logs}
        if "intel" in replays:
            path = next(str(log.path) for log in logs if log.name == "intel")
            together = replay_log(path, [ALL])
            replays["intel, one program"] = together
            report.requirements.append(Requirement("intel, one program: memory", together.memory / 1e6, MEMORY, "MB"))
    for name, replay in replays.items():
        report.requirements += [
            Requirement(f"{name}: scans lost", replay.scans - replay.answered_scans, 0),
            Requirement(f"{name}: time / that of the log at {RATE:g} times", replay.time_ratio, LATER),
        ]
    report.body += [_replay_table(replays), POLICY]
    report.data = {
        "odometry": {name: times.delays.tolist() for name, times in poses.items()},
        "scans": {name: [one.delays.tolist() for one in (times.first, times.final)] for name, times in scans.items()},
        "replays": {name: replay._asdict() for name, replay in replays.items()},
    }
    return report


def measure_odometry(log: str, seconds: float) -> MessageTimes:
    """Times of odometry and poses."""
    with _run_nodes() as listener:
        sent = _collect_times(listener, Odometry, ODOM, topics.SENSOR)
        received = _collect_times(listener, PoseWithCovarianceStamped, POSE, topics.STREAM)
        play_log(listener, log, seconds, ODOM)
        return MessageTimes(sent, received)


def measure_saturated(log: str, seconds: float) -> MessageTimes:
    """Times of odometry and poses, while all cores are busy."""
    with _saturate_cores():
        return measure_odometry(log, seconds)


def measure_scans(log: str, seconds: float, tsbi: Sequence[str] = ()) -> ScanTimes:
    """Times of scans and estimates.

    :param tsbi: arguments of the Python interpreter that run the node ``tsbi``; by default those of the package.
    """
    with _run_nodes({"tsbi": tsbi}) as listener:
        sent = _collect_times(listener, LaserScan, SCAN, topics.SENSOR)
        record = EarlyEstimateRecord()
        early = _collect_estimates(listener, EarlyEstimate, record.add)
        final = _collect_estimates(listener, LocalEstimate, record.compare)
        # The first early estimates would be lost otherwise.
        listener.wait_until(lambda: listener.node.count_publishers(DOCUMENTS[EarlyEstimate]) > 0)
        play_log(listener, log, seconds, SCAN)
        listener.wait_until(lambda: len(final) >= len(sent), _TIMEOUT)
        first = {stamp: min(moment, early.get(stamp, moment)) for stamp, moment in final.items()}
        return ScanTimes(MessageTimes(sent, first), MessageTimes(sent, final), record)


def _collect_estimates(listener: Listener, kind: type[Estimate], add: Callable[[Estimate], None]) -> Stamped:
    """A dictionary that collects {stamp of a scan: time at which its estimate was published, s}.

    :param add: called with each estimate.
    """
    times: Stamped = {}

    def add_time(message: String, info: dict[str, int]) -> None:
        estimate = decode(message.data, kind)
        times[estimate.stamp] = 1e-9 * info["source_timestamp"]
        add(estimate)

    profile = topics.CHAIN if kind is LocalEstimate else topics.STREAM
    listener.node.create_subscription(String, DOCUMENTS[kind], add_time, profile)
    return times


class ReplayScores(NamedTuple):
    """The scores of a replay.

    :ivar scans: of the log.
    :ivar answered_scans: number of scans with a pose.
    :ivar time_ratio: ratio of its time to that of the log at this rate.
    :ivar memory: proportional set size of all OS processes at the end, bytes.
    """

    scans: int
    answered_scans: int
    time_ratio: float
    memory: int


def replay_log(log: str, programs: Sequence[str] = PROCESSES) -> ReplayScores:
    """Replay a log at ten times real time.

    :param programs: those that run the processes.
    """
    duration = open_log(log).duration / RATE
    with Listener() as listener, ExitStack() as stack:
        started = [stack.enter_context(listener.running(name, {})).pid for name in programs]
        answered_scans = _count_documents(listener, DOCUMENTS[LocalEstimate])
        begin = time.monotonic()
        status = play_log(listener, log, 0.0, rate=RATE, flow_control=True)
        seconds = time.monotonic() - begin
        listener.wait_until(lambda: answered_scans() >= status.scans)
        memory = sum(proportional_set_size(process) for pid in started for process in (pid, *_children(pid)))
        return ReplayScores(status.scans, answered_scans(), seconds / duration, memory)


def _children(pid: int) -> list[int]:
    """Pids of the children of an OS process."""
    return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii").split()]


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
    head = ["log", "scans", "with a pose", f"time / that of the log at {RATE:g} times", "memory [MB]"]
    rows = []
    for name, own in replays.items():
        memory = f"{own.memory / 1e6:.0f}"
        rows.append([name, str(own.scans), str(own.answered_scans), f"{own.time_ratio:.2f}", memory])
    return table(head, rows)


@contextmanager
def _run_nodes(commands: Mapping[str, Sequence[str]] = MappingProxyType({})) -> Iterator[Listener]:
    """All five nodes as processes, with a listener.

    :param commands: {node: arguments of the Python interpreter} of those that do not run as usual.
    """
    with ExitStack() as stack:
        listener = stack.enter_context(Listener())
        for name in PROCESSES:
            stack.enter_context(listener.running(name, {}, commands.get(name, ())))
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


def play_log(
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
