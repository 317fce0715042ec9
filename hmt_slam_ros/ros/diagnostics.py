"""Diagnostics of a node: counts, durations, memory and the last fault, on /diagnostics and /hmt/cost."""

from __future__ import annotations

import math
import re
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.messages import Keyframe, LocalEstimate, Message
from hmt_slam_ros.messages.system_name import REMEDY, SystemName
from hmt_slam_ros.process_memory import current_rss, peak_rss
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import cost_message
from hmt_slam_ros.ros.topics import AGGREGATED, COST, DIAGNOSTICS
from hmt_slam_ros.untrusted_input import shorten

PERIOD = 1.0
"""Time between two messages on /diagnostics, s."""
STATE, ACTIVE = "state", "active"
"""Key of the lifecycle state in /diagnostics, and its value for an active node."""
STARTED = "started at"
"""Key of the time at which a node started, by which two nodes of one name differ."""
SYSTEM_STARTED = "system started at"
"""Key of the earliest start of a node of its system that a node knows, by which two systems differ."""
SYSTEM, SECOND_SYSTEM = "system", "second system"
"""Keys of the name of a node's system in /diagnostics, and of another system that speaks on its topics."""
WAITS_FOR = "waits for"
"""Key of the earlier system for whose end a node waits."""
KERNELS = "kernels"
"""Key of the kernels of a node in /diagnostics: how long they are compiled yet, or how many are loaded."""
LOADING = ("compiling", "loading")
"""Beginnings of that value before the kernels are loaded."""
HARDWARE_ID = "hmt_slam_ros"
"""Name in /diagnostics by which the nodes of the package are known."""
WARNING_LIFETIME = 60.0
"""Time for which a warning holds after it was last given, s; ``last error`` keeps it."""
_MAX_CAUSES = 20
"""Different causes of refusals on a topic that are logged; more are only counted."""
_MAX_SENTENCE = 400
"""Characters of a refusal, whatever a message holds."""
_CAUSE = re.compile(r"[^=(\d'\[]*")
"""The beginning of a sentence, up to the first value in it."""


class _Fault(NamedTuple):
    """A warning or an error, and until when it holds by the monotonic clock, s."""

    sentence: str
    until: float


class NodeDiagnostics:
    """Counts, durations and the last fault of a node, published once a second.

    :ivar received: {message type: count}.
    :ivar sent: {message type: count}.
    :ivar values: further entries, {name: value}.
    :ivar kernels: describes the kernels of the node for an entry; empty for none.
    :ivar progress: describes what has to be done before the node can process messages; empty without.
    :ivar system: the system that the node belongs to.
    :ivar started: time at which the node started, in ISO 8601.
    :ivar system_started: the earliest such time of a node of its system.
    :ivar crowded_topic: a topic with more publishers than one system has, and their number; empty without.
    :ivar steady_clock: clock for timers that run while simulated time stands still.
    """

    def __init__(self, node: Node, system: SystemName) -> None:
        self._node, self.system, self.crowded_topic = node, system, ""
        self.started = datetime.now(UTC).isoformat(timespec="microseconds")
        self.system_started: Callable[[], str] = lambda: self.started
        self.kernels: Callable[[], str] = str
        self.progress: Callable[[], str] = str
        self.clear()
        self._clock = Clock(clock_type=ClockType.SYSTEM_TIME)
        names = {node.resolve_topic_name(name): None for name in (DIAGNOSTICS, AGGREGATED)}
        self._publishers = [node.create_publisher(DiagnosticArray, name, topics.STREAM) for name in names]
        self._cost = node.create_publisher(Float64MultiArray, COST, topics.COST_HISTORY)
        self.steady_clock = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(PERIOD, self.publish, clock=self.steady_clock)

    def clear(self) -> None:
        """Reset all counts and faults."""
        self.received: Counter[str] = Counter()
        self.sent: Counter[str] = Counter()
        self.values: dict[str, object] = {}
        self._refused: Counter[str] = Counter()
        self._causes: defaultdict[str, set[str]] = defaultdict(set)
        self._error, self._error_at = "", ""
        self._faults: dict[bytes, _Fault] = {}
        self._last_stamp = 0
        self._previous_counts: dict[str, int] = {}
        self._previous_counts_at = time.monotonic()
        self._costs: list[tuple[int, float]] = []
        self._handled, self._busy_seconds, self._longest = 0, 0.0, 0.0

    def warn(self, sentence: str, lifetime: float | None = None) -> None:
        """Record and log a fault that the node survives; a repeated sentence is logged once.

        :param lifetime: time for which it holds, s; None for :data:`WARNING_LIFETIME`.
        """
        self._record_fault(sentence, DiagnosticStatus.WARN, WARNING_LIFETIME if lifetime is None else lifetime)

    def refuse(self, topic: str, fault: HmtSlamError) -> None:
        """Count a message that is left out, and log the first one of each cause.

        :param topic: name of its topic or service.
        :param fault: names the value and the remedy.
        """
        self.count_refused(topic)
        sentence = str(fault)[:_MAX_SENTENCE]
        if self.is_new_cause(topic, shorten(_CAUSE.match(sentence)[0])):  # type: ignore[index]
            self.warn(f"{topic} is left out: {sentence}")

    def is_new_cause(self, topic: str, cause: str) -> bool:
        """Whether a cause of refusals on a topic is the first of its kind, and is to be logged."""
        causes = self._causes[topic]
        if cause in causes or len(causes) == _MAX_CAUSES:
            return False
        causes.add(cause)
        return True

    def count_refused(self, topic: str, count: int = 1) -> None:
        """Count messages of a topic that are left out."""
        self._refused[topic] += count
        self.values[f"refused on {topic}"] = self._refused[topic]

    def fail(self, sentence: str, lifetime: float = math.inf) -> None:
        """Record and log a fault that the run does not survive.

        :param lifetime: time for which it holds, s, of one that is reported again while it lasts.
        """
        self._record_fault(sentence, DiagnosticStatus.ERROR, lifetime)

    def note(self, sentence: str) -> None:
        """Log information; the last fault stays in /diagnostics."""
        self._node.get_logger().info(sentence)

    def _record_fault(self, sentence: str, level: bytes, lifetime: float) -> None:
        self._faults[level] = _Fault(sentence, time.monotonic() + lifetime)
        self._error_at = datetime.now(UTC).isoformat(timespec="seconds")
        if sentence != self._error:
            self._error = sentence
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
            **self._optional_values(),
            "messages handled": self._handled,
            "busy": f"{self._busy_seconds:.3f} s",
            "longest message": f"{1e3 * self._longest:.1f} ms",
            "memory": f"{current_rss() / 1e6:.0f} MB",
            "peak memory": f"{peak_rss() / 1e6:.0f} MB",
            STARTED: self.started,
            SYSTEM_STARTED: self.system_started(),
            "last error": self._error,
            "last error at": self._error_at,
        }
        level, sentence = self._condition()
        status = DiagnosticStatus(
            level=level,
            name=self._node.get_fully_qualified_name(),
            message=sentence or self.progress() or self._status_text,
            hardware_id=HARDWARE_ID,
            values=[KeyValue(key=name, value=str(value)) for name, value in values.items()],
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._clock.now().to_msg()
        for publisher in self._publishers:
            publisher.publish(message)

    def _condition(self) -> tuple[bytes, str]:
        """The level of the node, and a sentence where it is not that all is well."""
        now = time.monotonic()
        for level in (DiagnosticStatus.ERROR, DiagnosticStatus.WARN):
            fault = self._faults.get(level)
            if fault is not None and now < fault.until:
                return level, fault.sentence
        if self._second_system:
            return DiagnosticStatus.WARN, self.second_system_text
        return DiagnosticStatus.OK, ""

    @property
    def second_system_text(self) -> str:
        """A sentence about the second system."""
        return f"a second system runs here, {self._second_system}: {REMEDY}"

    @property
    def _second_system(self) -> str:
        """Another system that speaks on the topics of the node, or a topic with more publishers; empty without."""
        return self.system.other or self.crowded_topic

    def _optional_values(self) -> dict[str, object]:
        """The system of the node, another one that speaks on its topics, and kernels; an entry where there is one.

        They outlast :meth:`clear`.
        """
        values = {
            SYSTEM: self.system.name,
            SECOND_SYSTEM: self._second_system,
            KERNELS: self.kernels(),
        }
        return {key: value for key, value in values.items() if value}

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
            self._cost.publish(cost_message(self._node.get_name(), self.system.name, self._costs))
            self._costs = []


def _message_stamp(message: Message, default: int) -> int:
    """Stamp of the scan or odometry reading of a message, ns."""
    if isinstance(message, Keyframe):
        return message.scan.stamp
    return int(getattr(message, "stamp", default))


def is_of_other_namespace(status: DiagnosticStatus, node: Node) -> bool:
    """Whether a node of the package that has another namespace sent a status; all of them send to one topic, too."""
    return status.hardware_id == HARDWARE_ID and (status.name.rpartition("/")[0] or "/") != node.get_namespace()
