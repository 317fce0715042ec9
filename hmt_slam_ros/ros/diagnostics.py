"""What a node counts and measures of itself, and how it tells."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray, MultiArrayDimension, MultiArrayLayout

from hmt_slam_ros.messages.messages import Keyframe, LocalEstimate, Message
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import flatten_rows
from hmt_slam_ros.ros.topics import COST, DIAGNOSTICS

PERIOD = 1.0  # s
STATE, ACTIVE = "state", "active"
"""The line of /diagnostics that has the state of a managed node, and the one in which it takes part."""

_SECOND = 1_000_000_000


class NodeDiagnostics:
    """Counts, durations and the last error of a node, published every second.

    :ivar received: {kind of message: count}.
    :ivar sent: {kind of message: count}.
    :ivar values: further lines, {name: value}.
    :ivar steady_clock: for timers.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.clear()
        self._clock = Clock(clock_type=ClockType.SYSTEM_TIME)
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, topics.STREAM)
        self._cost = node.create_publisher(Float64MultiArray, COST, topics.CHAIN)
        # It also runs while simulated time stands still.
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(PERIOD, self.publish, clock=self.steady_clock)

    def clear(self) -> None:
        """Begin to count anew."""
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
        """Remember and log something that the node survives; the same sentence is logged once."""
        self._record_fault(sentence, DiagnosticStatus.WARN)

    def fail(self, sentence: str) -> None:
        """Remember and log something that the run does not survive."""
        self._record_fault(sentence, DiagnosticStatus.ERROR)

    def note(self, sentence: str) -> None:
        """Log that something is well again; the last error stays to be seen."""
        self._node.get_logger().info(sentence)

    def _record_fault(self, sentence: str, level: bytes) -> None:
        if sentence != self._error:
            self._error, self._level = sentence, max(level, self._level)
            logger = self._node.get_logger()
            # rclpy wants a line of the program of its own for each level, and ends the node otherwise.
            if level == DiagnosticStatus.ERROR:
                logger.error(sentence)
            else:
                logger.warning(sentence)

    @contextmanager
    def measure(self, message: Message, outputs: list[Message]) -> Iterator[None]:
        """Measure how long a message takes, on the account of the scan that it is about.

        :param outputs: filled by the body with the answers.
        """
        begin = time.perf_counter()
        yield
        seconds = time.perf_counter() - begin
        self._handled, self._busy_seconds, self._longest = (
            self._handled + 1,
            self._busy_seconds + seconds,
            max(self._longest, seconds),
        )
        self._last_stamp = _message_stamp(message, self._last_stamp)
        scans = [answer.stamp for answer in outputs if isinstance(answer, LocalEstimate)] or [self._last_stamp]
        self._costs += [(stamp, seconds / len(scans)) for stamp in scans]

    def publish(self) -> None:
        """Say everything now."""
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
        """The state of a node that has states, unless it takes part."""
        state = str(self.values.get(STATE, ACTIVE))
        return "running" if state == ACTIVE else state

    def _counts_and_rates(self) -> dict[str, object]:
        """How many messages of each kind there were, and how many a second since the last time."""
        now = time.monotonic()
        counts = {
            f"{verb} {kind}": count
            for verb, counter in (("received", self.received), ("sent", self.sent))
            for kind, count in sorted(counter.items())
        }
        since, self._previous_counts_at = max(now - self._previous_counts_at, 1e-3), now
        last, self._previous_counts = self._previous_counts, counts
        rates = {f"{name} a second": f"{(count - last.get(name, 0)) / since:.1f}" for name, count in counts.items()}
        return {**counts, **rates}

    def _publish_costs(self) -> None:
        if self._costs:
            self._cost.publish(_cost_message(self._node.get_name(), self._costs))
            self._costs = []


def _message_stamp(message: Message, otherwise: int) -> int:
    """Stamp of the scan or odometry reading that a message is about, ns."""
    if isinstance(message, Keyframe):
        return message.scan.stamp
    return int(getattr(message, "stamp", otherwise))


def _cost_message(name: str, costs: Sequence[tuple[int, float]]) -> Float64MultiArray:
    """Rows of (stamp s, stamp ns, seconds of computing); a stamp as one float64 would lose its last digits."""
    rows = [(*divmod(stamp, _SECOND), seconds) for stamp, seconds in costs]
    layout = [
        MultiArrayDimension(label=name, size=len(rows), stride=3 * len(rows)),
        MultiArrayDimension(label="stamp_sec,stamp_nanosec,seconds", size=3, stride=3),
    ]
    return Float64MultiArray(layout=MultiArrayLayout(dim=layout), data=flatten_rows(rows))


def peak_rss(process: int | str = "self") -> int:
    """Largest resident memory of an OS process, bytes; 0 where the system does not tell."""
    return _memory(process, "VmHWM")


def current_rss(process: int | str = "self") -> int:
    """Resident memory of an OS process now, bytes; 0 where the system does not tell."""
    return _memory(process, "VmRSS")


def _memory(process: int | str, which: str) -> int:
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(which)), 0)
