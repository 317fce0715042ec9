"""Sensor input of the nodes: scans and odometry in the order of their stamps, checks of both, and laser mountings."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import LaserScan

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.mounting import FrameTree, Mounting, frame_name, planar_mounting
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import scan_from_message, stamp_from_time
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.recovery import FrameMounting
from hmt_slam_ros.ros.topics import TFMessage
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.plausibility import (
    MAX_COORDINATE,
    MAX_LASER_OFFSET,
    check_planar_pose,
    check_quaternion,
    check_scan,
)
from hmt_slam_ros.untrusted_input import is_short_text

MessageType = TypeVar("MessageType")

MIN_BACKWARD_JUMP = 1_000_000_000
"""Step back in time above which a bag began again or a clock was set, ns; late messages of one source are within it."""

MAX_FORWARD_JUMP = 600_000_000_000
"""Step ahead in time above which a stamp is believed as one that is far behind, ns; a break of a drive is within it."""

_CHECK_PERIOD = 0.5
"""Time between two checks of messages that wait for others to confirm their stamps, s."""
_SILENT_CHECKS = 4
"""Checks in which no message follows the newest one, after which time has jumped; a busy node makes none."""
_MAX_PENDING = 5000
"""Messages that wait for that."""


class StampOrder(Generic[MessageType]):
    """Passes messages in the order of their stamps, and rejects late and repeated ones.

    One that is far from the newest is damaged, very late or of a second source; or time jumped, since a bag began again
    or nothing came for long. It is pending with those that follow it. The next message near the newest rejects them. If
    none comes for some time, all of them pass.

    :ivar newest_stamp: stamp of the last message that passed, ns; None where the next one may have any.
    :ivar rejected_count: number of rejected messages.
    :ivar last_rejected_stamp: stamp of the last rejected message, ns, None before the first.
    """

    def __init__(self, newest_stamp: int | None = None) -> None:
        """:param newest_stamp: stamp of the last message before, ns, None without."""
        self.newest_stamp, self.rejected_count = newest_stamp, 0
        self.last_rejected_stamp: int | None = None
        self._pending: list[tuple[int, MessageType]] = []
        self._silent_checks = 0

    def reset(self) -> None:
        """Accept any stamp of the next message."""
        self.newest_stamp = None

    def push(self, stamp: int, message: MessageType) -> list[MessageType]:
        """The messages that pass now: mostly ``message`` itself."""
        newest, follows_pending = self.newest_stamp, bool(self._pending) and _follows(stamp, self._pending[-1][0])
        if newest is None or _follows(stamp, newest):
            if newest is not None or not follows_pending:
                self._reject_pending()
            self._pending.append((stamp, message))
            return self._pass_pending()
        if newest - MIN_BACKWARD_JUMP < stamp <= newest or len(self._pending) == _MAX_PENDING:
            self._reject(stamp)
            return []
        if not follows_pending:
            self._reject_pending()
        self._pending.append((stamp, message))
        return []

    def check(self) -> list[MessageType]:
        """The messages that pass as time has jumped; to be called every half a second."""
        self._silent_checks += 1
        has_jumped = self._silent_checks >= _SILENT_CHECKS and len(self._pending) > 1
        return self._pass_pending() if self._pending and (has_jumped or self.newest_stamp is None) else []

    def _pass_pending(self) -> list[MessageType]:
        due, self.newest_stamp = [message for _, message in self._pending], self._pending[-1][0]
        self._pending.clear()
        self._silent_checks = 0
        return due

    def _reject_pending(self) -> None:
        for stamp, _ in self._pending:
            self._reject(stamp)
        self._pending.clear()
        self._silent_checks = 0

    def _reject(self, stamp: int) -> None:
        self.rejected_count, self.last_rejected_stamp = self.rejected_count + 1, stamp


def _follows(stamp: int, newest: int) -> bool:
    return newest < stamp <= newest + MAX_FORWARD_JUMP


_RESEND_TIME = 10.0
"""Time after a subscription in which a latched publisher sends old messages again, s."""


class SensorSubscription:
    """Subscription that starts reliable, and changes to best effort for a publisher that offers no more.

    Late and repeated messages are dropped and counted in /diagnostics.

    :ivar is_best_effort: whether messages may be lost.
    """

    def __init__(
        self,
        node: GuardedNode,
        diagnostics: NodeDiagnostics,
        kind: type,
        topic: str,
        convert: Callable[[Any], Any],
        deliver: Callable[[Any], None],
        resume_stamp: int | None = None,
        receive: Callable[[int, Any], None] | None = None,
    ) -> None:
        """Prepare; :meth:`start` subscribes.

        :param convert: called with each message; returns what is delivered, and raises an error for what is refused.
        :param deliver: called in the order of the stamps.
        :param receive: called with the stamp, ns, and each converted message in the order of arrival; passes them to
            :meth:`push`, now or later. By default now.
        :param resume_stamp: stamp of the last message before, ns, where those missed since are wanted from a latched
            publisher.
        """
        self.is_best_effort = False
        self._node, self._kind, self._topic, self._convert, self._deliver = node, kind, topic, convert, deliver
        self._last_stamp = self._resume_stamp = resume_stamp
        self._started_at = time.monotonic()
        self._receive = receive or self.push
        self._diagnostics, self._order = diagnostics, StampOrder[Any](resume_stamp)
        self._subscription: Any = None
        node.create_timer(_CHECK_PERIOD, self._check_pending, clock=diagnostics.steady_clock)

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
        value = self._convert(message)
        if self._resume_stamp is not None:
            if stamp <= self._resume_stamp and time.monotonic() - self._started_at < _RESEND_TIME:
                return
            if self._profile is not topics.LATCHED_SENSOR:
                self._node.get_logger().warning(
                    f"what came on {self._topic} between the stamps {self._resume_stamp} and {stamp} ns, "
                    f"{(stamp - self._resume_stamp) / 1e9:.1f} s, is lost: the node did not listen"
                )
            self._resume_stamp = None
        self._receive(stamp, value)

    def push(self, stamp: int, value: Any) -> None:  # noqa: ANN401  as converted
        """Deliver what is due after a message; reject it where its stamp is not in order."""
        newest, rejected_count = self._order.newest_stamp, self._order.rejected_count
        self._deliver_due(self._order.push(stamp, value))
        if self._order.rejected_count > rejected_count:
            self._report_rejected(newest, self._order.rejected_count - rejected_count)

    def _check_pending(self) -> None:
        """Deliver what waits, where time has jumped."""
        self._deliver_due(self._order.check())

    def _deliver_due(self, due: list[Any]) -> None:
        if due:
            self._last_stamp = self._order.newest_stamp
        for value in due:
            self._deliver(value)

    def _report_rejected(self, newest: int | None, count: int) -> None:
        order = self._order
        self._diagnostics.count_refused(self._topic, count)
        if order.rejected_count == count:
            self._diagnostics.warn(
                f"on {self._topic} the message of stamp {order.last_rejected_stamp} ns came late, twice or far ahead, "
                f"beside that of {newest} ns, and is left out, as all such: look for a second publisher, or a link "
                "that reorders"
            )

    @property
    def _is_offered_reliably(self) -> bool:
        """Whether another publisher offers the whole profile; one that does not is then left aside."""
        wanted = self._profile.durability
        offers = [end.qos_profile for end in self._node.get_publishers_info_by_topic(self._topic)]
        return any(
            offer.reliability == ReliabilityPolicy.RELIABLE
            and (wanted != DurabilityPolicy.TRANSIENT_LOCAL or offer.durability == wanted)
            for offer in offers
        )

    def _relax_qos(self, _event: object) -> None:
        if self.is_best_effort or self._is_offered_reliably:
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


_TF_STATIC = "tf_static"
_MAX_FRAMES = 10_000
"""Frames on /tf_static that are kept; a robot has some hundred."""
_MAX_TRANSFORMS = 1000
"""Transforms of a message, since all of them are checked."""


def check_scan_message(message: LaserScan) -> LaserScan:
    """The message, where it holds a scan, wherever its laser may be.

    :raises HmtSlamError: names the field, its value and the remedy.
    """
    check_scan(scan_from_message(message, np.zeros(3)))
    if not is_short_text(message.header.frame_id):
        raise HmtSlamError("the frame of a scan is no short text: correct the driver")
    return message


class LaserMountings:
    """Poses of the lasers on the robot, from a parameter or from /tf_static.

    A transform that is none is left out, and so is a message by which a known laser would tilt.
    """

    def __init__(
        self,
        node: GuardedNode,
        diagnostics: NodeDiagnostics,
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
        self._diagnostics, self._base_frame, self._fixed_pose = diagnostics, base_frame, fixed_pose
        self._frames = FrameTree(newest=True)
        self._mountings: dict[str, FrameMounting] = {}
        self._on_change, self._on_new_mounting = on_change, on_new_mounting
        if self._fixed_pose is None and TFMessage is not None:
            node.create_subscription(TFMessage, _TF_STATIC, self._on_transforms, topics.TF_STATIC)

    def _on_transforms(self, message: Any) -> None:  # noqa: ANN401  a TFMessage, where there is one
        count = len(message.transforms)
        if count > _MAX_TRANSFORMS:
            raise HmtSlamError(
                f"{count} transforms in a message are more than {_MAX_TRANSFORMS}: look for who sends them"
            )
        sound = TFMessage(transforms=[stamped for stamped in message.transforms if self._is_sound(stamped)])
        frames = copy.deepcopy(self._frames)
        frames.add(sound)
        try:
            mountings = {frame: self._mounting_in(frames, frame) for frame in self._mountings}
            if frames.size > _MAX_FRAMES:
                raise HmtSlamError(f"{frames.size} frames are more than {_MAX_FRAMES}: look for who sends them")
        except HmtSlamError as fault:
            self._diagnostics.refuse(_TF_STATIC, fault)
            return
        self._frames = frames
        for frame, mounting in mountings.items():
            self._adopt(frame, mounting)
        if self._on_change is not None:
            self._on_change()

    def _is_sound(self, stamped: TransformStamped) -> bool:
        """Whether a transform is one; else it is reported."""
        shift, turn = stamped.transform.translation, stamped.transform.rotation
        try:
            for frame in (stamped.header.frame_id, stamped.child_frame_id):
                if not frame_name(frame) or not is_short_text(frame):
                    raise HmtSlamError("the name of a frame is no short text: correct the publisher of transforms")
            name = f"the transform of '{stamped.child_frame_id}'"
            check_planar_pose(np.array([shift.x, shift.y, shift.z]), name, MAX_COORDINATE)
            check_quaternion((turn.x, turn.y, turn.z, turn.w), name)
        except HmtSlamError as fault:
            self._diagnostics.refuse(_TF_STATIC, fault)
            return False
        return True

    def _mounting_in(self, frames: FrameTree, frame: str) -> Mounting | None:
        """The mounting of a laser by some transforms, None where they do not know it.

        :raises HmtSlamError: where it is tilted or far from the robot.
        """
        transform = frames.lookup_transform(frame_name(self._base_frame), frame_name(frame))
        if transform is None:
            return None
        mounting = planar_mounting(transform, f"the laser '{frame}'")
        check_planar_pose(mounting.laser_pose, f"the pose of the laser '{frame}'", MAX_LASER_OFFSET)
        return mounting

    def _adopt(self, frame: str, mounting: Mounting | None) -> None:
        known = self._mountings.get(frame)
        if mounting is None:
            return
        if known is None or (*known.laser_pose, known.angle_sign) != (*mounting.laser_pose, mounting.angle_sign):
            self._mountings[frame] = FrameMounting(frame, mounting.laser_pose, mounting.angle_sign)
            if self._on_new_mounting is not None:
                self._on_new_mounting(self._mountings[frame])

    def restore(self, mounting: FrameMounting) -> None:
        """Restore a mounting of a node that was killed; its transform may not come again."""
        self._mountings[mounting.frame] = mounting

    def is_known(self, frame: str) -> bool:
        """Whether the pose of a laser is known; it may be one that cannot be used."""
        return (
            self._fixed_pose is not None
            or frame in self._mountings
            or self._frames.lookup_transform(frame_name(self._base_frame), frame_name(frame)) is not None
        )

    def convert_scan(self, message: LaserScan) -> Scan | None:
        """The scan of a message, None as long as the pose of its laser is unknown.

        :raises HmtSlamError: for a tilted laser.
        """
        frame = message.header.frame_id
        if self._fixed_pose is not None:
            return scan_from_message(message, self._fixed_pose)
        if frame not in self._mountings:
            self._adopt(frame, self._mounting_in(self._frames, frame))
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
