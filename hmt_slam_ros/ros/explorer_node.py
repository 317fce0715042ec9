"""The explorer as a node: drives the robot by cmd_vel, or has another program drive to goal_pose."""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.messages import Accepted, Hypotheses, Keyframe, Message
from hmt_slam_ros.messages.replica import FIRST_AREA, GlobalPoses, Replica
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.messages.tasks import OF_EXPLORER, Errand
from hmt_slam_ros.ros.initial_state import Beginning
from hmt_slam_ros.ros.task_node import ErrandNode, run_errands

# The map's frame is the first area's: known before TLCA has spoken.
_FIRST = AreaPose(FIRST_AREA, PoseGaussian.exactly(np.zeros(3)))


class ExplorerNode(ErrandNode):
    """The node ``explorer``."""

    def __init__(self) -> None:
        super().__init__("explorer", OF_EXPLORER, (Keyframe, Hypotheses, Accepted))

    @property
    def drives(self) -> bool:
        """Whether it gives commands."""
        return self.configuration.explorer.drive == "velocities"

    def make(self, beginning: Beginning) -> Process:
        """The explorer of a map."""
        from hmt_slam_ros.exploration.explorer import Explorer  # noqa: PLC0415  takes time

        known = beginning.map
        self.areas = GlobalPoses((_FIRST,) if known is None else known.area_poses)
        explorer = Explorer(self.configuration, None if known is None else Replica.of(known.replica))
        if self.configuration.explorer.explores:
            explorer.handle(Errand("explore"))
        return explorer

    def receive(self, message: Message) -> None:
        """Take in what the inbox delivers, and where in the map the areas are."""
        if isinstance(message, Accepted) and message.global_poses:
            self.areas = GlobalPoses(message.global_poses)
        self.hear(message)


def main() -> None:
    """Run the node."""
    run_errands(ExplorerNode)


if __name__ == "__main__":
    main()
