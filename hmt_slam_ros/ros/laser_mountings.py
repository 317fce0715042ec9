"""Poses of the lasers on the robot, by which a node makes scans of messages."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from sensor_msgs.msg import LaserScan

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.mounting import FrameTree, Mounting, frame_name, planar_mounting
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import scan_from_message, stamp_from_time
from hmt_slam_ros.ros.diagnostics import NodeDiagnostics
from hmt_slam_ros.ros.guarded_node import GuardedNode
from hmt_slam_ros.ros.odometry_frames import OdometryFrames
from hmt_slam_ros.ros.recovery import FrameMounting
from hmt_slam_ros.ros.topics import ODOM, TFMessage
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.plausibility import (
    MAX_COORDINATE,
    MAX_LASER_OFFSET,
    check_planar_pose,
    check_quaternion,
    check_scan,
)
from hmt_slam_ros.untrusted_input import is_short_text

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
        frames: OdometryFrames,
        fixed_poses: Mapping[str, NDArray[np.float64]],
        on_change: Callable[[], None] | None = None,
        on_new_mounting: Callable[[FrameMounting], None] | None = None,
    ) -> None:
        """Subscribe to /tf_static, unless the pose is given.

        :param frames: that of the robot may be unknown at first.
        :param fixed_poses: {topic of scans: ``base_T_laser`` (3,)}, empty to take them from transforms.
        :param on_change: called after new transforms.
        :param on_new_mounting: called with each new or changed mounting.
        """
        self._diagnostics, self._odometry_frames, self._fixed_poses = diagnostics, frames, fixed_poses
        self._frames = FrameTree(newest=True)
        self._mountings: dict[str, FrameMounting] = {}
        self._on_change, self._on_new_mounting = on_change, on_new_mounting
        if not self._fixed_poses and TFMessage is not None:
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
        transform = self._lookup_transform(frames, frame)
        if transform is None:
            return None
        mounting = planar_mounting(transform, f"the laser '{frame}'")
        check_planar_pose(mounting.laser_pose, f"the pose of the laser '{frame}'", MAX_LASER_OFFSET)
        return mounting

    def _lookup_transform(self, frames: FrameTree, frame: str) -> NDArray[np.float64] | None:
        """The transform from the robot to a frame, shape (4, 4), None while it is unknown."""
        base = self._odometry_frames.base
        return frames.lookup_transform(base, frame_name(frame)) if base else None

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
            bool(self._fixed_poses)
            or frame in self._mountings
            or self._lookup_transform(self._frames, frame) is not None
        )

    def convert_scan(self, message: LaserScan, topic: str) -> Scan | None:
        """The scan of a message, None as long as the pose of its laser is unknown.

        :raises HmtSlamError: for a tilted laser.
        """
        frame = message.header.frame_id
        if self._fixed_poses:
            return scan_from_message(message, self._fixed_poses[topic])
        if frame not in self._mountings:
            self._adopt(frame, self._mounting_in(self._frames, frame))
        mounting = self._mountings.get(frame)
        return None if mounting is None else scan_from_message(message, mounting.laser_pose, mounting.angle_sign)

    def missing_transform_text(self, scan: LaserScan, waiting: int) -> str:
        """One sentence for a scan whose transform is missing; ``waiting`` is the number of such scans."""
        stamp, base = stamp_from_time(scan.header.stamp), self._odometry_frames.base
        if not base:
            return (
                f"no odometry has come, whose child_frame_id is the robot's frame, so {waiting} scans wait, the first "
                f"of stamp {stamp} ns: look at the topic {ODOM}, or set the parameter base_frame"
            )
        cause = "" if TFMessage is not None else " (tf2_msgs is not installed)"
        return (
            f"no transform from '{base}' to '{scan.header.frame_id}' on /tf_static{cause}, so {waiting} "
            f"scans wait, the first of stamp {stamp} ns: publish it, or set the parameter "
            "laser_pose"
        )
