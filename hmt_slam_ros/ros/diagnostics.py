"""Diagnostics of a node: counts, durations, memory and the last fault, on /diagnostics and /hmt/cost."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.messages import Keyframe, LocalEstimate, Message
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import table_message
from hmt_slam_ros.ros.topics import COST, DIAGNOSTICS

PERIOD = 1.0
"""Time between two messages on /diagnostics, s."""
STATE, ACTIVE = "state", "active"
"""Key of the lifecycle state in /diagnostics, and its value for an active node."""


class NodeDiagnostics:
    """Counts, durations and the last fault of a node, published once a second.

    :ivar received: {message type: count}.
    :ivar sent: {message type: count}.
    :ivar values: further entries, {name: value}.
    :ivar steady_clock: clock for timers that run while simulated time stands still.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.clear()
        self._clock = Clock(clock_type=ClockType.SYSTEM_TIME)
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
        self._cost = node.create_publisher(Float64MultiArray, COST, topics.CHAIN)
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(PERIOD, self.publish, clock=self.steady_clock)

    def clear(self) -> None:
        """Reset all counts and faults."""
        self.received: Counter[str] = Counter()
        self.sent: Counter[str] = Counter()
        self.values: dict[str, object] = {}
        self._error = ""
        self._level = DiagnosticStatus.OK
        self._last_stamp = 0
        self._previous_counts: dict[str, int] = {}
        self._previous_counts_at = time.monotonic()
        self._costs: list[tuple[int, float]] = []
        self._handled, self._busy_seconds, self._longest = 0, 0.0, 0.0

    def warn(self, sentence: str) -> None:
        """Record and log a fault that the node survives; a repeated sentence is logged once."""
        self._record_fault(sentence, DiagnosticStatus.WARN)

    def fail(self, sentence: str) -> None:
        """Record and log a fault that the run does not survive."""
        self._record_fault(sentence, DiagnosticStatus.ERROR)

    def note(self, sentence: str) -> None:
        """Log information; the last fault stays in /diagnostics."""
        self._node.get_logger().info(sentence)

    def _record_fault(self, sentence: str, level: bytes) -> None:
        if sentence != self._error:
            self._error, self._level = sentence, max(level, self._level)
            logger = self._node.get_logger()
            # rclpy raises where two levels are logged from one line of code.
            if level == DiagnosticStatus.ERROR:
                logger.error(sentence)
            else:
                logger.warning(sentence)

    @contextmanager
    def measure(self, message: Message, outputs: list[Message]) -> Iterator[None]:
        """Measure the time that a message takes, and assign it to its scan.

        :param message: the input.
        :param outputs: filled by the body with the outputs.
        """
        begin = time.perf_counter()
        yield
        seconds = time.perf_counter() - begin
        self._handled += 1
        self._busy_seconds += seconds
        self._longest = max(self._longest, seconds)
        self._last_stamp = _message_stamp(message, self._last_stamp)
        stamps = [output.stamp for output in outputs if isinstance(output, LocalEstimate)] or [self._last_stamp]
        self._costs += [(stamp, seconds / len(stamps)) for stamp in stamps]

    def publish(self) -> None:
        """Publish diagnostics and costs now."""
        self._publish_costs()
        values = {
            **self._counts_and_rates(),
            **self.values,
            "messages handled": self._handled,
            "busy": f"{self._busy_seconds:.3f} s",
            "longest message": f"{1e3 * self._longest:.1f} ms",
            "memory": f"{current_rss() / 1e6:.0f} MB",
            "peak memory": f"{peak_rss() / 1e6:.0f} MB",
            "last error": self._error,
        }
        status = DiagnosticStatus(
            level=self._level,
            name=self._node.get_fully_qualified_name(),
            message=self._error or self._status_text,
            hardware_id="hmt_slam_ros",
            values=[KeyValue(key=name, value=str(value)) for name, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._clock.now().to_msg()
        self._publisher.publish(message)

    @property
    def _status_text(self) -> str:
        """The lifecycle state, or "running" for an active node and for one without lifecycle."""
        state = str(self.values.get(STATE, ACTIVE))
        return "running" if state == ACTIVE else state

    def _counts_and_rates(self) -> dict[str, object]:
        """Counts by message type, and their rates since the last call."""
        now = time.monotonic()
        counts = {
            f"{verb} {kind}": count
            for verb, counter in (("received", self.received), ("sent", self.sent))
            for kind, count in sorted(counter.items())
        }
        seconds, self._previous_counts_at = max(now - self._previous_counts_at, 1e-3), now
        last, self._previous_counts = self._previous_counts, counts
        rates = {f"{name} a second": f"{(count - last.get(name, 0)) / seconds:.1f}" for name, count in counts.items()}
        return {**counts, **rates}

    def _publish_costs(self) -> None:
        if self._costs:
            self._cost.publish(_cost_message(self._node.get_name(), self._costs))
            self._costs = []


def _message_stamp(message: Message, default: int) -> int:
    """Stamp of the scan or odometry reading of a message, ns."""
    if isinstance(message, Keyframe):
        return message.scan.stamp
    return int(getattr(message, "stamp", default))


def _cost_message(name: str, costs: Sequence[tuple[int, float]]) -> Float64MultiArray:
    """Rows of (stamp in s, its rest in ns, seconds of computing); one float64 cannot hold a stamp exactly."""
    rows = [(*divmod(stamp, NANOSECONDS), seconds) for stamp, seconds in costs]
    return table_message(name, ("stamp_sec", "stamp_nanosec", "seconds"), rows)


def peak_rss(process: int | str = "self") -> int:
    """Largest resident memory of an OS process, bytes; 0 where it is unknown."""
    return _memory(process, "VmHWM")


def current_rss(process: int | str = "self") -> int:
    """Current resident memory of an OS process, bytes; 0 where it is unknown."""
    return _memory(process, "VmRSS")


def _memory(process: int | str, key: str) -> int:
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(key)), 0)
