"""Where the laser is on the robot, and /tf, which needs a package that PyPI does not have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.node import Node
from sensor_msgs.msg import LaserScan

from hmt_slam_ros.logs.mounting import FrameTree, frame_name, planar_mounting
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import stamp_from_time
from hmt_slam_ros.ros.recovery import FrameMounting

try:
    from tf2_msgs.msg import TFMessage as TFMessage  # noqa: PLC0414  re-exported
except ImportError:
    TFMessage = None

_MISSING = "tf2_msgs is not installed, so %s; scripts/test.sh builds it, and every ROS installation has it"


def transform_publisher(node: Node, topic: str) -> Callable[[list[TransformStamped]], None]:
    """What publishes transforms on ``tf`` or ``tf_static``; nothing where tf2_msgs is missing, which is told once."""
    if TFMessage is None:
        node.get_logger().warning(_MISSING % f"nothing is published on {topic}")
        return lambda _: None
    publisher = node.create_publisher(TFMessage, topic, topics.LATCHED if topic == "tf_static" else topics.STREAM)
    return lambda transforms: publisher.publish(TFMessage(transforms=transforms))


class LaserMountings:
    """The poses of the lasers, where they are given or from what came last on /tf_static."""

    def __init__(
        self,
        node: Node,
        base: str,
        fixed_pose: NDArray[np.float64] | None,
        on_change: Callable[[], None],
        on_new_mounting: Callable[[FrameMounting], None],
    ) -> None:
        """Listen.

        :param base: the robot's frame.
        :param fixed_pose: ``base_T_laser`` (3,) of all lasers, None where transforms tell.
        :param on_change: called when transforms have come.
        :param on_new_mounting: called with what is new of a laser.
        """
        self._base_frame, self._fixed_pose = base, fixed_pose
        self._frames = FrameTree(newest=True)
        self._mountings: dict[str, FrameMounting] = {}
        self._on_change, self._on_new_mounting = on_change, on_new_mounting
        if self._fixed_pose is None and TFMessage is not None:
            node.create_subscription(TFMessage, "tf_static", self._on_transforms, topics.TF_STATIC)

    def _on_transforms(self, message: Any) -> None:  # noqa: ANN401  a TFMessage, where there is one
        self._frames.add(message)
        for frame in self._mountings:
            self._look_up(frame)
        self._on_change()

    def _look_up(self, frame: str) -> None:
        transform = self._frames.lookup_transform(frame_name(self._base_frame), frame_name(frame))
        if transform is None:
            return
        mounting, known = planar_mounting(transform, f"the laser '{frame}'"), self._mountings.get(frame)
        if known is None or (*known.laser_pose, known.angle_sign) != (*mounting.laser_pose, mounting.angle_sign):
            self._mountings[frame] = FrameMounting(frame, mounting.laser_pose, mounting.angle_sign)
            self._on_new_mounting(self._mountings[frame])

    def restore(self, mounted: FrameMounting) -> None:
        """Take over what a node that was killed had heard; its transforms may not come again."""
        self._mountings[mounted.frame] = mounted

    def mounting_of(self, frame: str) -> FrameMounting | None:
        """Where the laser of a frame is, None as long as no transform tells.

        :raises HmtSlamError: for a laser that is tilted.
        """
        if self._fixed_pose is not None:
            return FrameMounting(frame, self._fixed_pose, 1.0)
        if frame not in self._mountings:
            self._look_up(frame)
        return self._mountings.get(frame)

    def missing_transform_text(self, scan: LaserScan, waiting: int) -> str:
        """One sentence for a scan whose transform is missing."""
        cause = "" if TFMessage is not None else " (tf2_msgs is not installed)"
        return (
            f"no transform from '{self._base_frame}' to '{scan.header.frame_id}' on /tf_static{cause}, so {waiting} "
            f"scans wait, the first of stamp {stamp_from_time(scan.header.stamp)} ns: publish it, or set the parameter "
            "laser_pose"
        )
