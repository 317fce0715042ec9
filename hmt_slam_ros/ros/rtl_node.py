"""Real-time localisation as a node: /hmt/pose, /pose and map -> odom at the rate of the odometry."""

from __future__ import annotations

import sys

from geometry_msgs.msg import PoseWithCovarianceStamped

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.messages.messages import RealTimePose
from hmt_slam_ros.messages.routing import Remembering
from hmt_slam_ros.real_time_localization.correction import Correction
from hmt_slam_ros.real_time_localization.rtl import Rtl, RtlState
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.execution import run, take_precedence
from hmt_slam_ros.ros.initial_state import Beginning
from hmt_slam_ros.ros.map_services import spin
from hmt_slam_ros.ros.parameters import declare_frame
from hmt_slam_ros.ros.process_node import ProcessNode
from hmt_slam_ros.ros.topics import HMT_POSE, POSE
from hmt_slam_ros.ros.transforms import transform_publisher


class RtlNode(ProcessNode):
    """The node ``rtl``."""

    # Nobody waits for it, and dead reckoning has no gap to bridge.
    hears_on = True

    def __init__(self) -> None:
        super().__init__("rtl", _make_process, (), changeable=("rtl.publish_tf", "rtl.correction_time"))

    def declare(self) -> None:
        """Declare the names of the frames too."""
        super().declare()
        self._map, self._odom = declare_frame(self, "map", "map"), declare_frame(self, "odom", "odom")

    def set_up(self) -> None:
        """As any process node, and the poses for people and other programs."""
        super().set_up()
        self._hmt_poses = self.create_publisher(PoseWithCovarianceStamped, HMT_POSE, topics.STREAM)
        self._poses = self.create_publisher(PoseWithCovarianceStamped, POSE, topics.STREAM)
        self._correction = Correction()
        self._send_transforms = transform_publisher(self, "tf")
        self.outbox.add(RealTimePose, self._publish)
        if self.configuration.rtl.precedence:
            self.figures.state["real-time scheduling"] = "yes" if take_precedence() else "not permitted"

    def _publish(self, pose: RealTimePose) -> None:
        area = conversions.area_frame(pose.area)
        self._hmt_poses.publish(conversions.pose_with_covariance(pose.stamp, area, pose.local))
        self._poses.publish(conversions.pose_with_covariance(pose.stamp, self._map, pose.map_pose))
        settings = self.configuration.rtl
        if settings.publish_tf:
            shown = self._correction.shown(pose.stamp, pose.map_T_odom, pose.odometry, settings.correction_time)
            joint = conversions.transform_message(pose.stamp, self._map, self._odom, shown)
            self._send_transforms([joint])


def _make_process(configuration: Configuration, beginning: Beginning) -> Remembering:
    return Rtl(configuration, beginning.part("rtl", RtlState))


def main() -> None:
    """Run the node."""
    sys.exit(run(RtlNode, spin))


if __name__ == "__main__":
    main()
