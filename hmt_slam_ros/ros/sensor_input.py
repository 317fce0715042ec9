"""Sensor input of the nodes: scans and odometry in the order of their stamps, checks of both, and laser mountings."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import LaserScan

from hmt_slam_ros.logs.mounting import FrameTree, frame_name, planar_mounting
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import scan_from_message, stamp_from_time
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.recovery import FrameMounting
from hmt_slam_ros.ros.topics import TFMessage
from hmt_slam_ros.sensors import Odometry, Scan

MessageType = TypeVar("MessageType")

MIN_BACKWARD_JUMP = 1_000_000_000
"""Step back in time above which a bag began again or a clock was set, ns; late messages of one source are within it."""


class StampOrder(Generic[MessageType]):
    """Passes messages in the order of their stamps, and rejects late and repeated ones.

    :ivar newest_stamp: stamp of the last message that passed, ns; None where the next one may have any.
    :ivar rejected_count: number of rejected messages.
    :ivar last_rejected_stamp: stamp of the last rejected message, ns, None before the first.
    """

    def __init__(self, newest_stamp: int | None = None) -> None:
        """:param newest_stamp: stamp of the last message before, ns, None without."""
        self.newest_stamp, self.rejected_count = newest_stamp, 0
        self.last_rejected_stamp: int | None = None
        self._pending: tuple[int, MessageType] | None = None

    def reset(self) -> None:
        """Accept any stamp of the next message."""
        self.newest_stamp = self._pending = None

    def push(self, stamp: int, message: MessageType) -> list[MessageType]:
        """The messages that pass now: mostly ``message`` itself.

        One that is far before the newest is very late, or time went back. It is pending until the next one decides.
        """
        newest, pending = self.newest_stamp, self._pending
        due = [message]
        if newest is not None and stamp <= newest:
            if stamp > newest - MIN_BACKWARD_JUMP:
                self._reject(stamp)
                return []
            due = []
            if pending is not None and stamp > pending[0]:
                due, pending = [pending[1], message], None
        if pending is not None:
            self._reject(pending[0])
        self._pending = None if due else (stamp, message)
        self.newest_stamp = stamp if due else newest
        return due

    def _reject(self, stamp: int) -> None:
        self.rejected_count, self.last_rejected_stamp = self.rejected_count + 1, stamp


_RESEND_TIME = 10.0
"""Time after a subscription in which a latched publisher sends old messages again, s."""


class SensorSubscription:
    """Subscription that starts reliable, and changes to best effort for a publisher that offers no more.

    Late and repeated messages are dropped and counted in /diagnostics.

    :ivar is_best_effort: whether messages may be lost.
    """

    def __init__(
        self,
        node: Node,
        diagnostics: NodeDiagnostics,
        kind: type,
        topic: str,
        deliver: Callable[[Any], None],
        resume_stamp: int | None = None,
    ) -> None:
        """Prepare; :meth:`start` subscribes.

        :param deliver: called with the messages in the order of their stamps.
        :param resume_stamp: stamp of the last message before, ns, where those missed since are wanted from a latched
            publisher.
        """
        self.is_best_effort = False
        self._node, self._kind, self._topic, self._deliver = node, kind, topic, deliver
        self._last_stamp = self._resume_stamp = resume_stamp
        self._started_at = time.monotonic()
        self._diagnostics, self._order = diagnostics, StampOrder[Any](resume_stamp)
        self._subscription: Any = None

    def start(self) -> None:
        """Subscribe; what was missed since :meth:`stop` comes first, where the publisher is latched."""
        self._resume_stamp, self._started_at = self._last_stamp, time.monotonic()
        reliable = topics.SENSOR if self._resume_stamp is None else topics.LATCHED_SENSOR
        self._subscribe(topics.LIVE_SENSOR if self.is_best_effort else reliable)

    def stop(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)

    def reset_order(self) -> None:
        """Accept any stamp of the next message."""
        self._order.reset()

    def _subscribe(self, profile: QoSProfile) -> None:
        self._profile = profile
        events = SubscriptionEventCallbacks(incompatible_qos=self._relax_qos)
        self._subscription = self._node.create_subscription(
            self._kind, self._topic, self._on_message, profile, event_callbacks=events
        )

    def _on_message(self, message: Any) -> None:  # noqa: ANN401  a ROS message with a header
        stamp = stamp_from_time(message.header.stamp)
        if self._resume_stamp is not None:
            if stamp <= self._resume_stamp and time.monotonic() - self._started_at < _RESEND_TIME:
                return
            if self._profile is not topics.LATCHED_SENSOR:
                self._node.get_logger().warning(
                    f"what came on {self._topic} between the stamps {self._resume_stamp} and {stamp} ns, "
                    f"{(stamp - self._resume_stamp) / 1e9:.1f} s, is lost: the node did not listen"
                )
            self._resume_stamp = None
        newest, rejected_count = self._order.newest_stamp, self._order.rejected_count
        for due in self._order.push(stamp, message):
            self._last_stamp = stamp
            self._deliver(due)
        if self._order.rejected_count > rejected_count:
            self._report_rejected(newest)

    def _report_rejected(self, newest: int | None) -> None:
        order = self._order
        self._diagnostics.values[f"refused on {self._topic}"] = order.rejected_count
        if order.rejected_count == 1:
            self._diagnostics.warn(
                f"on {self._topic} the message of stamp {order.last_rejected_stamp} ns came late or twice, after that "
                f"of {newest} ns, and is left out, as all such: look for a second publisher, or a link that reorders"
            )

    def _relax_qos(self, _event: object) -> None:
        if self.is_best_effort:
            return
        self._node.destroy_subscription(self._subscription)
        if self._profile is topics.LATCHED_SENSOR:
            self._subscribe(topics.SENSOR)
            return
        self.is_best_effort = True
        self._node.get_logger().info(f"{self._topic} comes from a live driver (best effort): messages may be lost")
        self._subscribe(topics.LIVE_SENSOR)


_SILENCE_TIMEOUT = 3.0
"""Time without scans, while odometry comes, after which a laser is silent, s; much longer than any sweep."""
_BUSY_TIME = 2.0
"""Time since the last check, once a second, above which the node itself was busy, s."""
_MAX_CLOCK_OFFSET = 5_000_000_000
"""Largest offset of the best of :data:`_COMPARED_SCANS` scans from the newest odometry, for one clock, ns.

Scans may take longer than odometry on their way, but not all of them.
"""
_COMPARED_SCANS = 50
"""Scans in a comparison of clocks."""


class SensorMonitor:
    """Checks stamps and rates of the sensors: backward jumps, different clocks, a silent laser."""

    def __init__(self, diagnostics: NodeDiagnostics) -> None:
        self._diagnostics = diagnostics
        self._newest_stamps: dict[type, int] = {}
        self._last_scan_at = self._checked_at = time.monotonic()
        self._reading_count = 0
        self._is_silent = False
        self._clock_offset, self._compared_scans = math.inf, 0

    def reset(self) -> None:
        """Accept any stamps of the next measurements."""
        self._newest_stamps.clear()
        self._clock_offset, self._compared_scans = math.inf, 0

    def detect_backward_jump(self, measurement: Scan | Odometry) -> bool:
        """Check a measurement; return whether time went back, which is also reported."""
        kind, stamp = type(measurement), measurement.stamp
        newest = self._newest_stamps.get(kind, stamp)
        self._newest_stamps[kind] = max(stamp, newest)
        if kind is Scan:
            self._compare_clocks(stamp)
        if stamp > newest - MIN_BACKWARD_JUMP:
            return False
        self.reset()
        self._newest_stamps[kind] = stamp
        self._diagnostics.warn(
            f"time went back by {(newest - stamp) / 1e9:.1f} s, to {stamp} ns: assuming the robot was moved; starting "
            "global localization; if this is another drive through a place that is new, call slam/reset"
        )
        return True

    def _compare_clocks(self, stamp: int) -> None:
        reading = self._newest_stamps.get(Odometry)
        if reading is None:
            return
        self._clock_offset = min(self._clock_offset, stamp - reading, key=abs)
        self._compared_scans += 1
        if self._compared_scans == _COMPARED_SCANS:
            if abs(self._clock_offset) > _MAX_CLOCK_OFFSET:
                self._diagnostics.warn(
                    f"scans are stamped {abs(self._clock_offset) / 1e9:.1f} s "
                    f"{'after' if self._clock_offset > 0 else 'before'} the odometry that comes with them: let both "
                    "computers have one clock (NTP, PTP), or correct the stamps; until then odometry does not help"
                )
            self._clock_offset, self._compared_scans = math.inf, 0

    def start(self) -> None:
        """Expect scans from now on."""
        self._last_scan_at = time.monotonic()

    def note_scan(self) -> None:
        """Take note that a scan has come."""
        now = time.monotonic()
        if self._is_silent:
            self._is_silent = False
            self._diagnostics.note(f"scans come again, after {now - self._last_scan_at:.1f} s")
        self._last_scan_at = now

    def check_silence(self, reading_count: int) -> None:
        """Report a silent laser; to be called once a second.

        After a busy time of the node, as by compilation, the check is skipped: scans may wait in DDS.

        :param reading_count: number of odometry readings so far.
        """
        now = time.monotonic()
        has_odometry, self._reading_count = reading_count > self._reading_count, reading_count
        if now - self._checked_at > _BUSY_TIME and not self._is_silent:
            self._last_scan_at = now
        self._checked_at = now
        if has_odometry and not self._is_silent and now - self._last_scan_at > _SILENCE_TIMEOUT:
            self._is_silent = True
            self._diagnostics.warn(
                f"no scan came for {_SILENCE_TIMEOUT:g} s, while odometry does: look at the laser, and at the name and "
                "the type of the topic scan; meanwhile the pose goes on by odometry"
            )


class LaserMountings:
    """Poses of the lasers on the robot, from a parameter or from /tf_static."""

    def __init__(
        self,
        node: Node,
        base_frame: str,
        fixed_pose: NDArray[np.float64] | None,
        on_change: Callable[[], None] | None = None,
        on_new_mounting: Callable[[FrameMounting], None] | None = None,
    ) -> None:
        """Subscribe to /tf_static, unless the pose is given.

        :param base_frame: the robot's frame.
        :param fixed_pose: ``base_T_laser`` (3,) of all lasers, None to take it from transforms.
        :param on_change: called after new transforms.
        :param on_new_mounting: called with each new or changed mounting.
        """
        self._base_frame, self._fixed_pose = base_frame, fixed_pose
        self._frames = FrameTree(newest=True)
        self._mountings: dict[str, FrameMounting] = {}
        self._on_change, self._on_new_mounting = on_change, on_new_mounting
        if self._fixed_pose is None and TFMessage is not None:
            node.create_subscription(TFMessage, "tf_static", self._on_transforms, topics.TF_STATIC)

    def _on_transforms(self, message: Any) -> None:  # noqa: ANN401  a TFMessage, where there is one
        self._frames.add(message)
        for frame in self._mountings:
            self._look_up(frame)
        if self._on_change is not None:
            self._on_change()

    def _look_up(self, frame: str) -> None:
        transform = self._frames.lookup_transform(frame_name(self._base_frame), frame_name(frame))
        if transform is None:
            return
        mounting, known = planar_mounting(transform, f"the laser '{frame}'"), self._mountings.get(frame)
        if known is None or (*known.laser_pose, known.angle_sign) != (*mounting.laser_pose, mounting.angle_sign):
            self._mountings[frame] = FrameMounting(frame, mounting.laser_pose, mounting.angle_sign)
            if self._on_new_mounting is not None:
                self._on_new_mounting(self._mountings[frame])

    def restore(self, mounting: FrameMounting) -> None:
        """Restore a mounting of a node that was killed; its transform may not come again."""
        self._mountings[mounting.frame] = mounting

    def convert_scan(self, message: LaserScan) -> Scan | None:
        """The scan of a message, None as long as the pose of its laser is unknown.

        :raises HmtSlamError: for a tilted laser.
        """
        frame = message.header.frame_id
        if self._fixed_pose is not None:
            return scan_from_message(message, self._fixed_pose)
        if frame not in self._mountings:
            self._look_up(frame)
        mounting = self._mountings.get(frame)
        return None if mounting is None else scan_from_message(message, mounting.laser_pose, mounting.angle_sign)

    def missing_transform_text(self, scan: LaserScan, waiting: int) -> str:
        """One sentence for a scan whose transform is missing; ``waiting`` is the number of such scans."""
        cause = "" if TFMessage is not None else " (tf2_msgs is not installed)"
        return (
            f"no transform from '{self._base_frame}' to '{scan.header.frame_id}' on /tf_static{cause}, so {waiting} "
            f"scans wait, the first of stamp {stamp_from_time(scan.header.stamp)} ns: publish it, or set the parameter "
            "laser_pose"
        )
