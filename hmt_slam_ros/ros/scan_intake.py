"""From the laser to slam's process: scans wait for the laser's transform, are passed over, or are too many."""

from __future__ import annotations

import time
from collections import deque

from sensor_msgs.msg import LaserScan

from hmt_slam_ros.ros import conversions
from hmt_slam_ros.ros.diagnostics import PERIOD
from hmt_slam_ros.ros.node_interfaces import ScanReceiver
from hmt_slam_ros.ros.sensor_input import SensorMonitor, SensorSubscription
from hmt_slam_ros.ros.topics import SCAN
from hmt_slam_ros.ros.transforms import LaserMountings

# Live, scans beyond this many in the queue are dropped; a replay never drops one.
_LIVE_QUEUE = 200


class ScanIntake:
    """Subscription to the scans, and what becomes of them before the process hears them.

    :ivar monitor: what the stamps of the sensors tell.
    :ivar dropped_count: scans that the process does not hear.
    :ivar is_paused: whether they are passed over.
    :ivar last_scan_at: when the last one came, by the monotonic clock, s.
    """

    def __init__(self, node: ScanReceiver, mounting: LaserMountings, resume_stamp: int | None) -> None:
        """Listen to nothing yet.

        :param mounting: where the lasers are.
        :param resume_stamp: stamp of the last scan that was heard before, ns, as of ``SensorSubscription``.
        """
        self._node, self._mountings = node, mounting
        self.monitor = SensorMonitor(node.diagnostics)
        self.dropped_count, self.is_paused = 0, False
        self.last_scan_at = self._waiting_since = time.monotonic()
        self._waiting: deque[LaserScan] = deque()
        self._skipped: LaserScan | None = None
        self._has_warned = False
        self._subscription = SensorSubscription(node, node.diagnostics, LaserScan, SCAN, self._on_scan, resume_stamp)

    @property
    def waiting_count(self) -> int:
        """Scans whose laser's place is not known yet."""
        return len(self._waiting)

    def start(self) -> None:
        """Listen, first to what was missed since :meth:`stop`, where the publisher kept it."""
        self.last_scan_at = time.monotonic()
        self.monitor.start()
        self._subscription.start()

    def stop(self) -> None:
        """Listen no more."""
        self._subscription.stop()

    def discard_waiting(self) -> None:
        """What waits is of no use any more."""
        self._waiting.clear()

    def reset_stamp_order(self) -> None:
        """What comes next may be of any time."""
        self.monitor.reset()
        self._subscription.reset_order()

    def pause(self, *, on: bool) -> None:
        """Pass scans over, but for the last, by which the robot is found when it goes on; or go on."""
        self.is_paused = on
        self._node.diagnostics.values["paused"] = "yes, scans are passed over" if on else "no"

    def process_skipped(self) -> None:
        """Work on the last scan that was passed over, if none is any more."""
        skipped, self._skipped = self._skipped, None
        if skipped is not None and not self.is_paused:
            self._enqueue(skipped)

    def count_scan(self) -> None:
        """A scan has come."""
        self.last_scan_at = time.monotonic()
        self.monitor.note_scan()
        self._node.diagnostics.received["Scan"] += 1

    def _on_scan(self, message: LaserScan) -> None:
        self.count_scan()
        if self.is_paused:
            self._count_dropped(self._skipped is not None)
            self._skipped = message
            return
        self._enqueue(message)

    def _enqueue(self, message: LaserScan) -> None:
        """Work on a scan as soon as its laser's place is known."""
        if self._subscription.is_best_effort and self._node.process.queued_scans + self.waiting_count >= _LIVE_QUEUE:
            self._count_dropped(1)
            self._node.diagnostics.warn(
                "scans come faster than they can be worked off: some are dropped, lower filter.particles"
            )
            return
        if not self._waiting:
            self._waiting_since, self._has_warned = time.monotonic(), False
        self._waiting.append(message)
        self._node.deliver_ready_scans()

    def _count_dropped(self, count: int) -> None:
        self.dropped_count += count
        self._node.diagnostics.values["dropped scans"] = self.dropped_count

    def deliver_ready(self) -> None:
        """Deliver the scans whose laser's place is known."""
        while self._waiting:
            message = self._waiting[0]
            mounted = self._mountings.mounting_of(message.header.frame_id)
            if mounted is None:
                return
            self._waiting.popleft()
            self._node.deliver(conversions.scan_from_message(message, mounted.laser_pose, mounted.angle_sign))

    def warn_if_waiting(self) -> None:
        """Tell of scans that wait for long."""
        now = time.monotonic()
        if not self._waiting or now - self._waiting_since <= 2 * PERIOD:
            return
        # Amid a start of many nodes DDS may take that long to bring what is latched: an error where it stays so.
        tell = self._node.diagnostics.fail if self._has_warned else self._node.diagnostics.warn
        tell(self._mountings.missing_transform_text(self._waiting[0], self.waiting_count))
        self._has_warned = True
        self._waiting_since = now + 10 * PERIOD
