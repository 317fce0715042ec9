"""The transforms of a bag, as far as they tell where the laser is on the robot."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.logs.mounting import transform_from_quaternion
from hmt_slam_ros.logs.ros_types import RosMessage


class FrameTree:
    """Frames and the transforms that join them.

    Of several transforms of one child frame the first counts, as in a log, which is read from its beginning for every
    scan, or the newest, as in a robot.
    """

    def __init__(self, *, newest: bool = False) -> None:
        """:param newest: whether the newest counts."""
        self._newest = newest
        self._parents: dict[str, tuple[str, NDArray[np.float64]]] = {}

    def add(self, message: RosMessage) -> None:
        """Take in a tf2_msgs/TFMessage."""
        for joint in message.transforms:
            child = frame_name(joint.child_frame_id)
            if self._newest or child not in self._parents:
                move, turn = joint.transform.translation, joint.transform.rotation
                transform = transform_from_quaternion((move.x, move.y, move.z), (turn.x, turn.y, turn.z, turn.w))
                self._parents[child] = (frame_name(joint.header.frame_id), transform)

    def pose(self, base: str, frame: str) -> NDArray[np.float64] | None:
        """``base_T_frame``, shape (4, 4), metres; None where no chain of transforms joins the two."""
        to_frame, to_base = self._chain(frame), self._chain(base)
        for ancestor, ancestor_T_frame in to_frame.items():
            if ancestor in to_base:
                pose: NDArray[np.float64] = np.linalg.inv(to_base[ancestor]) @ ancestor_T_frame
                return pose
        return None

    def _chain(self, frame: str) -> dict[str, NDArray[np.float64]]:
        """Each ancestor of a frame, itself included, with ``ancestor_T_frame``, nearest first."""
        chain = {frame: np.eye(4)}
        while frame in self._parents and self._parents[frame][0] not in chain:
            parent, transform = self._parents[frame]
            chain[parent] = transform @ chain[frame]
            frame = parent
        return chain


def frame_name(frame: str) -> str:
    """A frame without the leading slash that ROS 1 wrote."""
    return frame.lstrip("/")
