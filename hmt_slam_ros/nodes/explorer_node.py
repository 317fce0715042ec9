"""The explorer as a node: drives the robot by cmd_vel, or has another program drive to goal_pose."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseStamped

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.nodes import conversions, qos
from hmt_slam_ros.nodes.errand_node import ErrandNode, run_errands
from hmt_slam_ros.nodes.inbox import Inbox
from hmt_slam_ros.nodes.topics import GOALS
from hmt_slam_ros.processes.errands import OF_EXPLORER, Errand, Heading
from hmt_slam_ros.processes.global_poses import GlobalPoses
from hmt_slam_ros.processes.map_parts import AreaPose
from hmt_slam_ros.processes.messages import Accepted, Hypotheses, Keyframe, Message
from hmt_slam_ros.processes.replica import FIRST_AREA, Replica

# The map's frame is the first area's: known before TLCA has spoken.
_FIRST = AreaPose(FIRST_AREA, PoseGaussian.exactly(np.zeros(3)))


class ExplorerNode(ErrandNode):
    """The node ``explorer``."""

    def __init__(self) -> None:
        super().__init__("explorer", OF_EXPLORER)

    def set_up(self) -> None:
        """Make the explorer, and all that it hears and says.

        :raises HmtSlamError: for a map that cannot be.
        """
        from hmt_slam_ros.exploration.explorer import Explorer  # noqa: PLC0415  takes time

        beginning, own = self.beginning(), self.configuration.explorer
        known = beginning.map
        self._areas = GlobalPoses((_FIRST,) if known is None else known.area_poses)
        explorer = Explorer(self.configuration, None if known is None else Replica.of(known.replica))
        if own.explores:
            explorer.handle(Errand("explore"))
        self._goals = self.create_publisher(PoseStamped, GOALS, qos.STREAM)
        self.listen(explorer, drives=own.drive == "velocities")
        self._inbox = Inbox(
            self, (Keyframe, Hypotheses, Accepted), self._hear, self.figures, first=beginning.events, begun=None
        )

    def _hear(self, message: Message) -> None:
        if isinstance(message, Accepted) and message.global_poses:
            self._areas = GlobalPoses(message.global_poses)
        self.hear(message)

    def say(self, message: Message) -> None:
        """Publish what the explorer says; a goal as soon as its area has a place in the map."""
        super().say(message)
        area = self._areas.get(message.area) if isinstance(message, Heading) else None
        if isinstance(message, Heading) and area is not None:
            goal = se2.compose(area.mean, message.goal)
            header = conversions.header(message.stamp, self.map_frame)
            self._goals.publish(PoseStamped(header=header, pose=conversions.pose_message(goal)))


def main() -> None:
    """Run the node."""
    run_errands(ExplorerNode)


if __name__ == "__main__":
    main()
