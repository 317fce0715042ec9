"""The pilot as a node: says where the robot is by the belief over places, tells slam at doors, and drives to rooms."""

from __future__ import annotations

from geometry_msgs.msg import PoseWithCovarianceStamped
from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.map_changes import InitialPose
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe, Message, PoseReset
from hmt_slam_ros.messages.replica import GlobalPoses
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.messages.tasks import PILOT_TASKS, PlaceEstimate
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.initial_state import InitialState
from hmt_slam_ros.ros.task_node import TaskNode, run_task_node
from hmt_slam_ros.ros.topics import INITIAL_POSE, PLACE
from hmt_slam_ros.sensors import Odometry


class PilotNode(TaskNode):
    """The node ``pilot``."""

    def __init__(self) -> None:
        super().__init__("pilot", PILOT_TASKS, (Odometry, Keyframe, Hypotheses, ClosureDecision))

    @property
    def is_driver(self) -> bool:
        """Whether it gives commands."""
        return self.configuration.pilot.drives

    def configure_node(self) -> None:
        """Make the pilot, and all that it hears and says.

        :raises HmtSlamError: where there is no map, or one that cannot be or has no place.
        """
        super().configure_node()
        self._estimates = self.create_publisher(String, PLACE, topics.LATCHED)
        self._initial_pose_publisher = self.create_publisher(PoseWithCovarianceStamped, INITIAL_POSE, topics.STREAM)
        self._stamp = 0

    def make_process(self, beginning: InitialState) -> Process:
        """The pilot of a map.

        :raises HmtSlamError: where there is none, or one that has no place.
        """
        from hmt_slam_ros.exploration.pilot import PilotProcess  # noqa: PLC0415  takes time

        known = beginning.map
        if known is None:
            raise HmtSlamError("the pilot goes by the places of a map, and there is none: set start_from")
        self.area_poses = GlobalPoses(known.area_poses)
        missions = PilotProcess(self.configuration, known.replica)
        self.get_logger().info(f"rooms to go to: {', '.join(missions.rooms) or 'none'}")
        return missions

    def on_message(self, message: Message) -> None:
        """Take in what the inbox delivers; who does not take part needs no odometry."""
        if self.is_active or not isinstance(message, Odometry):
            self.process_message(message)

    def publish_output(self, message: Message) -> None:
        """Publish what the pilot says; where the metric processes begin, as a pose in the map."""
        super().publish_output(message)
        if isinstance(message, PlaceEstimate):
            self._stamp = message.stamp
            self._estimates.publish(String(data=encode(message)))
            self.diagnostics.values["place"] = f"{message.place or 'unknown'}, {message.probability:.3f}"
        elif isinstance(message, PoseReset) and message.initial_pose is not None:
            self._publish_initial_pose(message.initial_pose)

    def _publish_initial_pose(self, place: InitialPose) -> None:
        pose = se2.compose(self.area_poses[place.area].mean, place.pose.mean)
        belief = PoseGaussian(pose, place.pose.covariance)
        self._initial_pose_publisher.publish(
            conversions.pose_with_covariance_message(self._stamp, self.map_frame, belief)
        )


def main() -> None:
    """Run the node."""
    run_task_node(PilotNode)


if __name__ == "__main__":
    main()
