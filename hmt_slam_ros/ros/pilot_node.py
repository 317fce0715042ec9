"""The pilot as a node: says where the robot is by the belief over places, tells slam at doors, and drives to rooms."""

from __future__ import annotations

from geometry_msgs.msg import PoseWithCovarianceStamped
from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.map_changes import Place
from hmt_slam_ros.messages.messages import Accepted, Carried, Hypotheses, Keyframe, Message
from hmt_slam_ros.messages.replica import GlobalPoses
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.messages.tasks import OF_PILOT, PlaceEstimate
from hmt_slam_ros.ros import conversions, topics
from hmt_slam_ros.ros.initial_state import Beginning
from hmt_slam_ros.ros.task_node import ErrandNode, run_errands
from hmt_slam_ros.ros.topics import INITIAL_POSE, PLACE
from hmt_slam_ros.sensors import Odometry


class PilotNode(ErrandNode):
    """The node ``pilot``."""

    def __init__(self) -> None:
        super().__init__("pilot", OF_PILOT, (Odometry, Keyframe, Hypotheses, Accepted))

    @property
    def drives(self) -> bool:
        """Whether it gives commands."""
        return self.configuration.pilot.drives

    def set_up(self) -> None:
        """Make the pilot, and all that it hears and says.

        :raises HmtSlamError: where there is no map, or one that cannot be or has no place.
        """
        super().set_up()
        self._estimates = self.create_publisher(String, PLACE, topics.LATCHED)
        self._starts = self.create_publisher(PoseWithCovarianceStamped, INITIAL_POSE, topics.STREAM)
        self._stamp = 0

    def make(self, beginning: Beginning) -> Process:
        """The pilot of a map.

        :raises HmtSlamError: where there is none, or one that has no place.
        """
        from hmt_slam_ros.exploration.pilot import Missions  # noqa: PLC0415  takes time

        known = beginning.map
        if known is None:
            raise HmtSlamError("the pilot goes by the places of a map, and there is none: set start_from")
        self.areas = GlobalPoses(known.area_poses)
        missions = Missions(self.configuration, known.replica)
        self.get_logger().info(f"rooms to go to: {', '.join(missions.rooms) or 'none'}")
        return missions

    def receive(self, message: Message) -> None:
        """Take in what the inbox delivers; who does not take part needs no odometry."""
        if self.active or not isinstance(message, Odometry):
            self.hear(message)

    def say(self, message: Message) -> None:
        """Publish what the pilot says; where the metric processes begin, as a pose in the map."""
        super().say(message)
        if isinstance(message, PlaceEstimate):
            self._stamp = message.stamp
            self._estimates.publish(String(data=encode(message)))
            self.figures.state["place"] = f"{message.place or 'unknown'}, {message.probability:.3f}"
        elif isinstance(message, Carried) and message.place is not None:
            self._begin_at(message.place)

    def _begin_at(self, place: Place) -> None:
        pose = se2.compose(self.areas[place.area].mean, place.pose.mean)
        belief = PoseGaussian(pose, place.pose.covariance)
        self._starts.publish(conversions.pose_with_covariance(self._stamp, self.map_frame, belief))


def main() -> None:
    """Run the node."""
    run_errands(PilotNode)


if __name__ == "__main__":
    main()
