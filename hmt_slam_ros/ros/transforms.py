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
from hmt_slam_ros.ros.conversions import stamp_of
from hmt_slam_ros.ros.recovery import Mounted

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


class LaserMounting:
    """The poses of the lasers, where they are given or from what came last on /tf_static."""

    def __init__(
        self,
        node: Node,
        base: str,
        given: NDArray[np.float64] | None,
        changed: Callable[[], None],
        learned: Callable[[Mounted], None],
    ) -> None:
        """Listen.

        :param base: the robot's frame.
        :param given: ``base_T_laser`` (3,) of all lasers, None where transforms tell.
        :param changed: called when transforms have come.
        :param learned: called with what is new of a laser.
        """
        self._base, self._given = base, given
        self._frames = FrameTree(newest=True)
        self._known: dict[str, Mounted] = {}
        self._changed, self._learned = changed, learned
        if self._given is None and TFMessage is not None:
            node.create_subscription(TFMessage, "tf_static", self._hear, topics.TF_STATIC)

    def _hear(self, message: Any) -> None:  # noqa: ANN401  a TFMessage, where there is one
        self._frames.add(message)
        for frame in self._known:
            self._look_up(frame)
        self._changed()

    def _look_up(self, frame: str) -> None:
        transform = self._frames.pose(frame_name(self._base), frame_name(frame))
        if transform is None:
            return
        mounting, known = planar_mounting(transform, f"the laser '{frame}'"), self._known.get(frame)
        if known is None or (*known.laser_pose, known.side) != (*mounting.laser_pose, mounting.side):
            self._known[frame] = Mounted(frame, mounting.laser_pose, mounting.side)
            self._learned(self._known[frame])

    def remember(self, mounted: Mounted) -> None:
        """Take over what a node that was killed had heard; its transforms may not come again."""
        self._known[mounted.name] = mounted

    def of(self, frame: str) -> Mounted | None:
        """Where the laser of a frame is, None as long as no transform tells.

        :raises HmtSlamError: for a laser that is tilted.
        """
        if self._given is not None:
            return Mounted(frame, self._given, 1.0)
        if frame not in self._known:
            self._look_up(frame)
        return self._known.get(frame)

    def complaint(self, scan: LaserScan, waiting: int) -> str:
        """One sentence for a scan whose transform is missing."""
        cause = "" if TFMessage is not None else " (tf2_msgs is not installed)"
        return (
            f"no transform from '{self._base}' to '{scan.header.frame_id}' on /tf_static{cause}, so {waiting} scans "
            f"wait, the first of stamp {stamp_of(scan.header.stamp)} ns: publish it, or set the parameter laser_pose"
        )
