"""Real-time localization as a node: /hmt/pose, /pose and map -> odom at the rate of the odometry."""

from __future__ import annotations

import sys

from geometry_msgs.msg import PoseWithCovarianceStamped

from hmt_slam_ros.messages.messages import RealTimePose
from hmt_slam_ros.real_time_localization.rtl import CorrectionSmoother
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.execution import run, set_realtime_priority
from hmt_slam_ros.ros.map_services import spin
from hmt_slam_ros.ros.parameters import declare_frame
from hmt_slam_ros.ros.process_node import ProcessNode
from hmt_slam_ros.ros.topics import HMT_POSE, POSE
from hmt_slam_ros.ros.transforms import transform_publisher


class RtlNode(ProcessNode):
    """The node ``rtl``."""

    # Nobody waits for it, and dead reckoning has no gap to bridge.
    is_always_listening = True

    def __init__(self) -> None:
        super().__init__("rtl", changeable=("rtl.publish_tf", "rtl.correction_time"))

    def declare_own_parameters(self) -> None:
        """Declare the names of the frames too."""
        super().declare_own_parameters()
        self._map_frame, self._odom_frame = declare_frame(self, "map", "map"), declare_frame(self, "odom", "odom")

    def configure_node(self) -> None:
        """As any process node, and the poses for people and other programs."""
        super().configure_node()
        self._hmt_poses = self.create_publisher(PoseWithCovarianceStamped, HMT_POSE, topics.STREAM)
        self._poses = self.create_publisher(PoseWithCovarianceStamped, POSE, topics.STREAM)
        self._correction = CorrectionSmoother()
        self._send_transforms = transform_publisher(self, "tf")
        self.outbox.set_writer(RealTimePose, self._publish)
        if self.configuration.rtl.realtime_priority:
            self.diagnostics.values["real-time scheduling"] = "yes" if set_realtime_priority() else "not permitted"

    def _publish(self, pose: RealTimePose) -> None:
        area = conversions.area_frame(pose.area)
        self._hmt_poses.publish(conversions.pose_with_covariance_message(pose.stamp, area, pose.pose_in_area))
        self._poses.publish(conversions.pose_with_covariance_message(pose.stamp, self._map_frame, pose.map_pose))
        settings = self.configuration.rtl
        if settings.publish_tf:
            shown = self._correction.smooth(pose.stamp, pose.map_T_odom, pose.odometry, settings.correction_time)
            joint = conversions.transform_message(pose.stamp, self._map_frame, self._odom_frame, shown)
            self._send_transforms([joint])


def main() -> None:
    """Run the node."""
    sys.exit(run(RtlNode, spin))


if __name__ == "__main__":
    main()
