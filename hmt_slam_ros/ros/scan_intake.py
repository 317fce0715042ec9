"""Scans on their way to metric SLAM: in the order of their stamps, with the pose of their laser, or not at all."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from sensor_msgs.msg import LaserScan

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.ros.diagnostics import PERIOD
from hmt_slam_ros.ros.laser_mountings import LaserMountings, check_scan_message
from hmt_slam_ros.ros.map_services import MapServicesNode
from hmt_slam_ros.ros.scan_merge import ScanMerge
from hmt_slam_ros.ros.sensor_input import SensorSubscription
from hmt_slam_ros.ros.sensor_monitor import SensorMonitor
from hmt_slam_ros.sensors import Scan

_LIVE_QUEUE = 200
"""Scans of a live laser that wait at most; each quarter of them halves the rate at which more are accepted."""
_MAX_WAITING = 10_000
"""Scans of a reliable publisher, such as a replay, that wait at most; all are accepted until then."""
_TOPOLOGY_BEHIND = (
    "scans wait for topology, so that not all are accepted until it has caught up: drive slower, and see /diagnostics "
    "for the node whose load is high"
)
_SLAM_BEHIND = "scans come faster than they can be worked off, so that not all are accepted: lower filter.particles"
_TRANSFORM_TIMEOUT = 3.0
"""Time for which the scans of an unknown frame hold up those of known ones, s."""
_REPORT_PERIOD = 10 * PERIOD
"""Time between two reports of scans that wait, s."""
_MAX_UNKNOWN_FRAMES = 4
"""Unknown frames for whose transform scans wait."""


class _WaitingScan(NamedTuple):
    """A scan that waits for the transform of its laser, and its topic."""

    topic: str
    message: LaserScan


class ScanIntake:
    """Scans on their way to metric SLAM: they wait for the laser's transform, are skipped in a pause, or dropped.

    :ivar monitor: checks of stamps and rates.
    :ivar dropped_count: number of scans that the process does not get.
    :ivar is_paused: whether scans are skipped.
    :ivar last_scan_at: time of the last scan by the monotonic clock, s.
    """

    def __init__(
        self,
        node: MapServicesNode,
        mountings: LaserMountings,
        on_received: Callable[[], None],
        resume_stamp: int | None,
    ) -> None:
        """Prepare; :meth:`start` subscribes.

        :param on_received: called after each scan, to deliver what is ready.
        :param resume_stamp: stamp of the last scan before, ns, as in :class:`SensorSubscription`.
        """
        self._node, self._mountings, self._on_received = node, mountings, on_received
        topics = node.configuration.sensors.topics
        self.monitor = SensorMonitor(node.diagnostics, topics)
        self.dropped_count, self.is_paused = 0, False
        self.last_scan_at = self._waiting_since = time.monotonic()
        self._waiting: deque[_WaitingScan] = deque()
        self._skipped: Scan | None = None
        self._since_accepted = 0
        self._has_warned = False
        self._unknown_since: dict[str, float] = {}
        self._merge = ScanMerge(topics, resume_stamp)
        self._subscriptions = {topic: self._subscription_to(topic, resume_stamp) for topic in topics}

    def _subscription_to(self, topic: str, resume_stamp: int | None) -> SensorSubscription:
        return SensorSubscription(
            self._node,
            self._node.diagnostics,
            LaserScan,
            topic,
            check_scan_message,
            partial(self._merge_scan, topic),
            resume_stamp,
            partial(self._receive, topic),
        )

    @property
    def waiting_count(self) -> int:
        """Number of scans that wait for the laser's transform, or for the scans of other topics."""
        return len(self._waiting) + self._merge.waiting_count

    def start(self) -> None:
        """Subscribe; what was missed since :meth:`stop` comes first, where the publisher is latched."""
        self.last_scan_at = time.monotonic()
        self.monitor.start()
        for subscription in self._subscriptions.values():
            subscription.start()

    def stop(self) -> None:
        """Unsubscribe."""
        for subscription in self._subscriptions.values():
            subscription.stop()

    def discard_waiting(self) -> None:
        """Drop the scans that wait."""
        self._waiting.clear()
        self._merge.reset()

    def reset_stamp_order(self) -> None:
        """Accept any stamp of the next scan."""
        self.monitor.reset()
        self._merge.reset()
        for subscription in self._subscriptions.values():
            subscription.reset_order()

    def pause(self, *, on: bool) -> None:
        """Skip scans from now on, or resume."""
        self.is_paused = on
        self._node.diagnostics.values["paused"] = "yes, scans are passed over" if on else "no"

    def process_skipped(self) -> None:
        """After a pause, process its last scan, by which the robot is found again."""
        skipped, self._skipped = self._skipped, None
        if skipped is not None and not self.is_paused:
            self._node.deliver(skipped)

    def count_scan(self) -> None:
        """Count a scan that has come."""
        self._node.diagnostics.received["Scan"] += 1

    def _merge_scan(self, topic: str, scan: Scan) -> None:
        """Process the scans that are due, now that one more of a topic has come, whose stamp is in order there."""
        due = self._merge.push(topic, scan)
        if due is None:
            self._node.diagnostics.count_refused(topic)
        for each in due or ():
            self._on_scan(each)

    def _on_scan(self, scan: Scan) -> None:
        """Process a scan whose stamp is in order."""
        self.count_scan()
        if self.is_paused:
            self._count_dropped(self._skipped is not None)
            self._skipped = scan
            return
        self._node.deliver(scan)

    def _receive(self, topic: str, _stamp: int, message: LaserScan) -> None:
        """Let a scan wait until its laser's transform is known."""
        self.last_scan_at = time.monotonic()
        self.monitor.note_scan(topic)
        if not self._is_accepted(self._subscriptions[topic].is_best_effort):
            self._count_dropped(1)
            return
        if not self._waiting:
            self._waiting_since, self._has_warned = time.monotonic(), False
        self._waiting.append(_WaitingScan(topic, message))
        self._on_received()

    def _is_accepted(self, is_live: bool) -> bool:
        """Whether a scan may wait beside those that do: the more wait the fewer are accepted, evenly spread."""
        queued = self._node.process.queued_scans
        waiting = queued + self.waiting_count
        spacing = 2 ** (4 * waiting // _LIVE_QUEUE) if is_live else 1
        self._since_accepted += 1
        if waiting < (_LIVE_QUEUE if is_live else _MAX_WAITING) and self._since_accepted >= spacing:
            self._since_accepted = 0
            return True
        if queued > self.waiting_count:
            self._node.diagnostics.warn(_TOPOLOGY_BEHIND if self._node.process.is_awaiting_decision else _SLAM_BEHIND)
        return False

    def _count_dropped(self, count: int) -> None:
        self.dropped_count += count
        self._node.diagnostics.values["dropped scans"] = self.dropped_count

    def deliver_ready(self) -> None:
        """Deliver the scans whose laser's transform is known; one that cannot be used is refused.

        Only those that can be used have a say in the order of stamps.
        """
        while self._waiting:
            topic, message = self._waiting[0]
            frame = message.header.frame_id
            try:
                scan = self._mountings.convert_scan(message, topic)
                if scan is None:
                    if self._is_awaited(frame):
                        return
                    raise HmtSlamError(f"nobody knows the frame '{frame}' of a scan: publish its transform")
            except HmtSlamError as fault:
                self._waiting.popleft()
                self._node.diagnostics.refuse(topic, fault)
                continue
            self._unknown_since.pop(frame, None)
            self._waiting.popleft()
            self._subscriptions[topic].push(scan.stamp, scan)

    def _is_awaited(self, frame: str) -> bool:
        """Whether the transform of a frame is awaited: for some time, or as long as no other frame's scan waits."""
        if frame not in self._unknown_since and len(self._unknown_since) == _MAX_UNKNOWN_FRAMES:
            return False
        since = self._unknown_since.setdefault(frame, time.monotonic())
        return time.monotonic() - since < _TRANSFORM_TIMEOUT or not any(
            self._mountings.is_known(waiting.message.header.frame_id) for waiting in self._waiting
        )

    def warn_if_waiting(self) -> None:
        """Report scans that wait for long: first as a warning, then as a fault.

        When many nodes start, DDS may take that long to bring latched transforms.
        """
        now = time.monotonic()
        if not self._waiting or now - self._waiting_since <= 2 * PERIOD:
            return
        sentence = self._mountings.missing_transform_text(self._waiting[0].message, len(self._waiting))
        if self._has_warned:
            self._node.diagnostics.fail(sentence, lifetime=2 * _REPORT_PERIOD)
        else:
            self._node.diagnostics.warn(sentence)
        self._has_warned = True
        self._waiting_since = now + _REPORT_PERIOD
