"""The mounting of a laser on the robot, from transforms."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.sensors.plausibility import MAX_COORDINATE, check_planar_pose, check_quaternion

if TYPE_CHECKING:
    from hmt_slam_ros.logs.ros_types import RosMessage

_MAX_CHAIN = 100
"""Frames from one to the root of a tree."""

_LARGEST_TILT = np.deg2rad(10.0)
"""Largest tilt of a scan plane, rad: beyond it, ranges differ too much from distances on the floor plan."""


class Mounting(NamedTuple):
    """The planar mounting of a laser.

    :ivar laser_pose: shape (3,), ``base_T_laser`` as (x, y, theta) in m and rad.
    :ivar angle_sign: 1.0, or -1.0 for a laser that is upside down, whose angles increase clockwise.
    """

    laser_pose: NDArray[np.float64]
    angle_sign: float


def planar_mounting(base_T_laser: ArrayLike, laser_name: str) -> Mounting:
    """The planar mounting of a level laser, upright or upside down.

    :param base_T_laser: shape (4, 4), homogeneous transform, meters.
    :param laser_name: name for the error message.
    :raises HmtSlamError: where the scan plane is tilted by more than 10 degrees.
    """
    transform = np.asarray(base_T_laser, dtype=np.float64)
    upright = float(transform[2, 2])  # cosine between the laser's z axis and the robot's
    tilt = float(np.arccos(min(abs(upright), 1.0)))
    if not tilt <= _LARGEST_TILT:
        raise HmtSlamError(
            f"{laser_name} is tilted by {np.rad2deg(tilt):.0f} degrees, and only a level laser can be used: "
            "choose another scan or correct its mounting."
        )
    heading = float(np.arctan2(transform[1, 0], transform[0, 0]))
    return Mounting(np.array([transform[0, 3], transform[1, 3], heading]), 1.0 if upright > 0.0 else -1.0)


def transform_from_quaternion(translation: ArrayLike, quaternion: ArrayLike) -> NDArray[np.float64]:
    """The homogeneous transform, shape (4, 4), m.

    :param translation: (x, y, z), m.
    :param quaternion: (x, y, z, w), of any norm but zero.
    """
    x, y, z, w = np.asarray(quaternion, dtype=np.float64) / np.linalg.norm(quaternion)
    transform = np.eye(4)
    transform[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    transform[:3, 3] = translation
    return transform


def transform_from_message(transform: RosMessage) -> NDArray[np.float64]:
    """The homogeneous transform, shape (4, 4), m, of a geometry_msgs/Transform.

    :raises HmtSlamError: where a number is not finite or the rotation is none.
    """
    shift, turn = transform.translation, transform.rotation
    check_quaternion((turn.x, turn.y, turn.z, turn.w), "rotation")
    for part in (shift.x, shift.y, shift.z):
        check_planar_pose(np.array([part, 0.0]), "translation", MAX_COORDINATE)
    return transform_from_quaternion((shift.x, shift.y, shift.z), (turn.x, turn.y, turn.z, turn.w))


def heading_from_quaternion(quaternion: ArrayLike) -> float:
    """The rotation about z, rad; exact where the rotation is about z alone.

    :param quaternion: (x, y, z, w), of any norm but zero.
    """
    x, y, z, w = np.asarray(quaternion, dtype=np.float64).tolist()
    # numpy 1.26 computes arctan2 with errors of several ulp on processors with AVX-512; math.atan2 is exact.
    if x == 0.0 and y == 0.0:
        heading = 2.0 * math.atan2(z, w)
        return heading - 2.0 * math.pi * round(heading / (2.0 * math.pi))
    return math.atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)


class FrameTree:
    """A tree of frames and the transforms between them.

    Of several transforms of a child frame, the first counts in a log and the newest on a robot.
    """

    def __init__(self, *, newest: bool = False) -> None:
        """:param newest: whether the newest transform of a child frame counts, else the first."""
        self._newest = newest
        self._parents: dict[str, tuple[str, NDArray[np.float64]]] = {}

    @property
    def size(self) -> int:
        """Number of frames with a parent."""
        return len(self._parents)

    def add(self, message: RosMessage) -> None:
        """Add a tf2_msgs/TFMessage."""
        for stamped in message.transforms:
            child = frame_name(stamped.child_frame_id)
            if self._newest or child not in self._parents:
                parent = frame_name(stamped.header.frame_id)
                self._parents[child] = (parent, transform_from_message(stamped.transform))

    def lookup_transform(self, base: str, frame: str) -> NDArray[np.float64] | None:
        """``base_T_frame``, shape (4, 4), m; None where no chain of transforms connects the two."""
        to_frame, to_base = self._ancestor_transforms(frame), self._ancestor_transforms(base)
        for ancestor, ancestor_T_frame in to_frame.items():
            if ancestor in to_base:
                pose: NDArray[np.float64] = np.linalg.inv(to_base[ancestor]) @ ancestor_T_frame
                return pose
        return None

    def _ancestor_transforms(self, frame: str) -> dict[str, NDArray[np.float64]]:
        """{ancestor: ``ancestor_T_frame``}, from the frame itself to the root."""
        chain = {frame: np.eye(4)}
        while frame in self._parents and self._parents[frame][0] not in chain and len(chain) < _MAX_CHAIN:
            parent, transform = self._parents[frame]
            chain[parent] = transform @ chain[frame]
            frame = parent
        return chain


def frame_name(frame: str) -> str:
    """The name of a frame without the leading slash of ROS 1."""
    return frame.lstrip("/")
