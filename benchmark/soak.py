"""Memory of nodes over hours of driving in known rooms, at ten times real time, and resources that they keep."""

from __future__ import annotations

import math
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import String

from benchmark.charted_run import resident_bytes
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings
from hmt_slam_ros.logs.records import SIMULATION_PREFIX
from hmt_slam_ros.messages.documents import RobotStatus, decode
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.process_table import process_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.execution import wait_until_alone
from hmt_slam_ros.ros.node_processes import NodeProcesses, own_domain
from hmt_slam_ros.ros.topics import DIAGNOSTICS, ROBOT_STATUS, TFMessage
from hmt_slam_ros.sensors import Scan

WORLD = "office"
RATE = 10.0
"""Speed of the replay relative to real time."""

CHANGE = 0.02
"""Largest change of a node's memory after the first hour of the log."""

_SHORTFALL = 0.95
_FIRST, _BASE = 1.0, 1.25
"""End of the first hour, and of the quarter of an hour whose mean later memory is compared with, h of the log."""
_PERIOD = 5.0  # s between two samples of memory
_SPIN = 0.1  # s
_DEPARTURES = 3.0  # s
_SHARED_MEMORY = "/dev/shm/"
# Files of ports are named by their numbers, and reused by the next participant.
_PORT = "fastrtps_port"

POLICY = (
    f"The nodes, each an OS process, map laps of `sim:{WORLD}` (seed 0), which the robot node plays at {RATE:g} "
    f"times real time, or slower if slam is behind. Memory is read every {_PERIOD:g} s: RSS, which counts shared "
    "pages whole, and PSS, which divides them among the processes. In the first hour of the log the map becomes "
    "complete and the histories of DDS fill up. The change is the largest difference of the RSS after that from "
    "its mean over the next quarter of an hour, as a share. Slopes are least squares after the first hour with "
    "their standard errors, which assume independent samples. Segments of shared memory are those that a node had"
    " mapped and that still existed when all had ended. Segments of ports are excluded, because the next nodes "
    "reuse them. Zombies are ended child processes of a node, or ended nodes, without a parent that read their "
    "status."
)


@dataclass
class Soak:
    """The measurements of a run.

    :ivar seconds: wall time, s.
    :ivar log_seconds: played time of the log, s.
    :ivar scans: acknowledged by slam.
    :ivar hours: played time of the log at every sample, h.
    :ivar resident: {node: RSS at every sample, bytes}.
    :ivar proportional: {node: PSS at every sample, bytes}.
    :ivar segments: files of shared memory of the nodes.
    :ivar leaked: those that still existed when all nodes had ended.
    :ivar zombies: largest number at a sample.
    :ivar errors: {node: its last message of level ERROR}.
    :ivar dropped: scans that slam dropped.
    :ivar statuses: {node: exit status after the request to end}.
    """

    seconds: float = 0.0
    log_seconds: float = 0.0
    scans: int = 0
    hours: list[float] = field(default_factory=list)
    resident: dict[str, list[int]] = field(default_factory=dict)
    proportional: dict[str, list[int]] = field(default_factory=dict)
    segments: set[str] = field(default_factory=set)
    leaked: set[str] = field(default_factory=set)
    zombies: int = 0
    errors: dict[str, str] = field(default_factory=dict)
    dropped: int = 0
    statuses: dict[str, int] = field(default_factory=dict)


def measure_soak(settings: Settings) -> Report:
    """Drive for some minutes, and sample the nodes."""
    report = Report("soak", "Long runs of the nodes", seeds=(0,))
    found = run_nodes(settings.minutes)
    report.requirements += requirements(found)
    report.data["soak"] = asdict(found) | {name: sorted(getattr(found, name)) for name in ("segments", "leaked")}
    rows = [
        [name, *_summarize(found.hours, own), *_summarize(found.hours, found.proportional[name])]
        for name, own in found.resident.items()
    ]
    columns = [f"{kind} {what}" for kind in ("RSS", "PSS") for what in ("at 1 h [MB]", "at the end [MB]", "[MB/h]")]
    summary = f"{found.seconds / 60:.0f} minutes, {found.log_seconds / 3600:.1f} h of driving, {found.scans} scans"
    report.body += [
        summary,
        table(["node", *columns], rows),
        POLICY,
    ]
    return report


def requirements(found: Soak) -> list[Requirement]:
    """Requirements on a run."""
    changes = [
        Requirement(f"{name}: change of memory after an hour", largest_change(found.hours, own), CHANGE)
        for name, own in found.resident.items()
    ]
    speed = found.log_seconds / found.seconds
    return [
        *changes,
        Requirement("speed, times real time", speed, math.inf, least=_SHORTFALL * RATE),
        Requirement("scans dropped", found.dropped, 0),
        Requirement("errors in /diagnostics", len(found.errors), 0),
        Requirement("segments of shared memory left behind", len(found.leaked), 0),
        Requirement("zombies", found.zombies, 0),
        Requirement(
            "nodes with an exit status other than 0", sum(status != 0 for status in found.statuses.values()), 0
        ),
    ]


def largest_change(hours: Sequence[float], memory: Sequence[int]) -> float:
    """Largest difference after the first hour from the mean of the next quarter, as a share; NaN for shorter runs.

    :param hours: played time of the log at every sample, h.
    :param memory: of a node at every sample, bytes.
    """
    times, values = np.array(hours), np.array(memory, dtype=np.float64)
    is_base, is_later = (times >= _FIRST) & (times < _BASE), times >= _BASE
    if not (is_base.any() and is_later.any()):
        return math.nan
    return float(np.max(np.abs(values[is_later] / np.mean(values[is_base]) - 1.0)))


def slope(hours: Sequence[float], memory: Sequence[int]) -> tuple[float, float]:
    """Growth after the first hour by least squares, and its standard error, bytes/h; NaN for fewer than 3 samples.

    :param hours: played time of the log at every sample, h.
    :param memory: of a node at every sample, bytes.
    """
    times, values = np.array(hours), np.array(memory, dtype=np.float64)
    later = times >= _FIRST
    count = np.count_nonzero(later)
    if count < 3:
        return math.nan, math.nan
    centered = times[later] - np.mean(times[later])
    spread = float(centered @ centered)
    growth = float(centered @ values[later]) / spread
    residuals = values[later] - np.mean(values[later]) - growth * centered
    return growth, math.sqrt(float(residuals @ residuals) / (count - 2) / spread)


def _summarize(hours: Sequence[float], memory: Sequence[int]) -> list[str]:
    """Memory at the first hour and at the end, MB, and the slope with its error, MB/h."""
    first = next((value for hour, value in zip(hours, memory, strict=True) if hour >= _FIRST), math.nan)
    growth, error = slope(hours, memory)
    last = memory[-1] if memory else math.nan
    return [f"{1e-6 * first:.1f}", f"{1e-6 * last:.1f}", f"{1e-6 * growth:.2f} ± {1e-6 * error:.2f}"]


def run_nodes(minutes: float) -> Soak:
    """Run the nodes for some minutes.

    :raises HmtSlamError: where one of them dies.
    """
    lap = open_log(f"{SIMULATION_PREFIX}{WORLD},laps=1")
    name = f"{SIMULATION_PREFIX}{WORLD},laps={math.ceil(60.0 * minutes * RATE / lap.duration) + 1}"
    laser = next(r.measurement.laser_pose for r in lap.records() if isinstance(r.measurement, Scan)).tolist()
    nodes = (*process_names(), "robot")
    found = Soak(resident={node: [] for node in nodes}, proportional={node: [] for node in nodes})
    with (
        tempfile.TemporaryDirectory(prefix="hmt_slam_soak_") as scratch,
        own_domain() as domain,
        _listen(domain, found) as executor,
    ):
        with NodeProcesses(Path(scratch), (), print) as children:
            own = [] if TFMessage is not None else ["-p", f"laser_pose:={laser}"]
            environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
            for node in process_names():
                words = ["-p", f"recovery:={scratch}/recovery", *(own if node == "slam" else [])]
                children.start(node, words, environment)
            robot = {"log": name, "robot.rate": RATE, "robot.odometry_listeners": 2, "robot.discovery_timeout": 600.0}
            children.start("robot", [w for k, v in robot.items() for w in ("-p", f"{k}:={v}")], environment)
            _observe(executor, children, found, 60.0 * minutes)
        found.statuses = {node: process.returncode for node, process in children.processes.items()}
    found.leaked = {path for path in found.segments if Path(path).exists() and not _is_mapped(path)}
    return found


def _observe(executor: SingleThreadedExecutor, children: NodeProcesses, found: Soak, seconds: float) -> None:
    """Sample the nodes for some seconds since the first scan."""
    begin = next_look = None
    while begin is None or time.monotonic() < begin + seconds:
        executor.spin_once(timeout_sec=_SPIN)
        children.restart_killed()
        now = time.monotonic()
        if begin is None or next_look is None:
            begin = next_look = now if found.scans else None
        elif now >= next_look:
            next_look += _PERIOD
            _sample_processes({name: process.pid for name, process in children.processes.items()}, found)
            found.seconds = now - begin


def _sample_processes(processes: Mapping[str, int], found: Soak) -> None:
    found.hours.append(found.log_seconds / 3600.0)
    for name, pid in processes.items():
        found.resident[name].append(resident_bytes(pid))
        found.proportional[name].append(_proportional_bytes(pid))
        found.segments |= _mapped_segments(pid)
    states = Counter(state for state, parent in _process_states() if parent in (*processes.values(), os.getpid()))
    found.zombies = max(found.zombies, states["Z"])


def _proportional_bytes(pid: int) -> int:
    """PSS of an OS process, bytes."""
    rollup = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()
    return next(1024 * int(line.split()[1]) for line in rollup if line.startswith("Pss:"))


def _mapped_segments(pid: int) -> set[str]:
    """Existing files of shared memory that a process has mapped."""
    try:
        lines = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # ended meanwhile, or another user's
        return set()
    paths = {line.split(maxsplit=5)[-1] for line in lines if _SHARED_MEMORY in line and _PORT not in line}
    return {path for path in paths if not path.endswith("(deleted)")}


def _is_mapped(path: str) -> bool:
    """Whether any process has mapped the segment."""
    return any(path in _mapped_segments(int(entry.name)) for entry in Path("/proc").iterdir() if entry.name.isdecimal())


def _process_states() -> Iterator[tuple[str, int]]:
    """State and parent of every OS process."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                words = (entry / "stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
            except OSError:  # ended meanwhile
                continue
            yield words[0], int(words[1])


@contextmanager
def _listen(domain: int, found: Soak) -> Iterator[SingleThreadedExecutor]:
    """A node that collects the robot's progress, and errors of all nodes."""

    def add_status(message: String) -> None:
        status = decode(message.data, RobotStatus)
        if status.stamp:
            begin = first.setdefault("stamp", status.stamp)
            found.scans, found.log_seconds = status.acknowledged, 1e-9 * (status.stamp - begin)

    def add_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.level == DiagnosticStatus.ERROR:
                found.errors[status.name] = status.message
            values = {entry.key: entry.value for entry in status.values}
            found.dropped = max(found.dropped, int(values.get("dropped scans", 0)))

    first: dict[str, int] = {}
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with ExitStack() as stack:
        context = Context()
        context.init(domain_id=domain)
        stack.callback(context.try_shutdown)
        node = Node("soak", context=context)
        stack.callback(node.destroy_node)
        stack.callback(wait_until_alone, node, _DEPARTURES)
        executor = SingleThreadedExecutor(context=context)
        stack.callback(executor.shutdown)
        executor.add_node(node)
        node.create_subscription(String, ROBOT_STATUS, add_status, topics.LATCHED)
        node.create_subscription(DiagnosticArray, DIAGNOSTICS, add_diagnostics, topics.STREAM)
        yield executor
