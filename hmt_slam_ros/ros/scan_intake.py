"""From the laser to slam's process: scans wait for the laser's transform, are passed over, or are too many."""

from __future__ import annotations

import time
from collections import deque
from typing import TYPE_CHECKING

from sensor_msgs.msg import LaserScan

from hmt_slam_ros.ros import conversions
from hmt_slam_ros.ros.diagnostics import PERIOD
from hmt_slam_ros.ros.sensor_input import SensorSubscription, SensorWatch
from hmt_slam_ros.ros.topics import SCAN
from hmt_slam_ros.ros.transforms import LaserMounting

if TYPE_CHECKING:
    from hmt_slam_ros.ros.slam_node import SlamNode

# Live, scans beyond this many in the queue are dropped; a replay never drops one.
_LIVE_QUEUE = 200


class ScanIntake:
    """Subscription to the scans, and what becomes of them before the process hears them.

    :ivar watch: what the stamps of the sensors tell.
    :ivar dropped: scans that the process does not hear.
    :ivar paused: whether they are passed over.
    :ivar last: when the last one came, by the monotonic clock, s.
    """

    def __init__(self, node: SlamNode, mounting: LaserMounting, after: int | None) -> None:
        """Listen to nothing yet.

        :param mounting: where the lasers are.
        :param after: stamp of the last scan that was heard before, ns, as of ``SensorSubscription``.
        """
        self._node, self._mounting = node, mounting
        self.watch = SensorWatch(node.figures)
        self.dropped, self.paused = 0, False
        self.last = self._waiting_since = time.monotonic()
        self._waiting: deque[LaserScan] = deque()
        self._skipped: LaserScan | None = None
        self._complained = False
        self._laser = SensorSubscription(node, node.figures, LaserScan, SCAN, self._hear, after)

    @property
    def waiting(self) -> int:
        """Scans whose laser's place is not known yet."""
        return len(self._waiting)

    def begin(self) -> None:
        """Listen, first to what was missed since :meth:`end`, where the publisher kept it."""
        self.last = time.monotonic()
        self.watch.begin()
        self._laser.begin()

    def end(self) -> None:
        """Listen no more."""
        self._laser.end()

    def forget(self) -> None:
        """What waits is of no use any more."""
        self._waiting.clear()

    def forget_time(self) -> None:
        """What comes next may be of any time."""
        self.watch.forget()
        self._laser.forget()

    def pause(self, *, on: bool) -> None:
        """Pass scans over, but for the last, by which the robot is found when it goes on; or go on."""
        self.paused = on
        self._node.figures.state["paused"] = "yes, scans are passed over" if on else "no"

    def take_skipped(self) -> None:
        """Work on the last scan that was passed over, if none is any more."""
        skipped, self._skipped = self._skipped, None
        if skipped is not None and not self.paused:
            self._take(skipped)

    def count(self) -> None:
        """A scan has come."""
        self.last = time.monotonic()
        self.watch.hear_scan()
        self._node.figures.received["Scan"] += 1

    def _hear(self, message: LaserScan) -> None:
        self.count()
        if self.paused:
            self._drop(self._skipped is not None)
            self._skipped = message
            return
        self._take(message)

    def _take(self, message: LaserScan) -> None:
        """Work on a scan as soon as its laser's place is known."""
        if self._laser.live and self._node.process.waiting_scans + self.waiting >= _LIVE_QUEUE:
            self._drop(1)
            self._node.figures.warn(
                "scans come faster than they can be worked off: some are dropped, lower filter.particles"
            )
            return
        if not self._waiting:
            self._waiting_since, self._complained = time.monotonic(), False
        self._waiting.append(message)
        self._node.work_off()

    def _drop(self, count: int) -> None:
        self.dropped += count
        self._node.figures.state["dropped scans"] = self.dropped

    def work_off(self) -> None:
        """Deliver the scans whose laser's place is known."""
        while self._waiting:
            message = self._waiting[0]
            mounted = self._mounting.of(message.header.frame_id)
            if mounted is None:
                return
            self._waiting.popleft()
            self._node.deliver(conversions.scan_from(message, mounted.laser_pose, mounted.side))

    def complain(self) -> None:
        """Tell of scans that wait for long."""
        now = time.monotonic()
        if not self._waiting or now - self._waiting_since <= 2 * PERIOD:
            return
        # Amid a start of many nodes DDS may take that long to bring what is latched: an error where it stays so.
        tell = self._node.figures.fail if self._complained else self._node.figures.warn
        tell(self._mounting.complaint(self._waiting[0], self.waiting))
        self._complained = True
        self._waiting_since = now + 10 * PERIOD
