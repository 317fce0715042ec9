"""The explorer as a node: drives the robot by cmd_vel, or has another program drive to goal_pose."""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe, Message
from hmt_slam_ros.messages.replica import FIRST_AREA, GlobalPoses, Replica
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.messages.tasks import EXPLORER_TASKS, Task
from hmt_slam_ros.ros.initial_state import InitialState
from hmt_slam_ros.ros.task_node import TaskNode, run_task_node

# The map's frame is the first area's: known before TLCA has spoken.
_FIRST_AREA_POSE = AreaPose(FIRST_AREA, PoseGaussian.from_pose(np.zeros(3)))


class ExplorerNode(TaskNode):
    """The node ``explorer``."""

    def __init__(self) -> None:
        super().__init__("explorer", EXPLORER_TASKS, (Keyframe, Hypotheses, ClosureDecision))

    @property
    def is_driver(self) -> bool:
        """Whether it gives commands."""
        return self.configuration.explorer.drive == "velocities"

    def make_process(self, beginning: InitialState) -> Process:
        """The explorer of a map."""
        from hmt_slam_ros.exploration.explorer import Explorer  # noqa: PLC0415  takes time

        known = beginning.map
        self.area_poses = GlobalPoses((_FIRST_AREA_POSE,) if known is None else known.area_poses)
        explorer = Explorer(self.configuration, None if known is None else Replica.from_state(known.replica))
        if self.configuration.explorer.explores:
            explorer.handle(Task("explore"))
        return explorer

    def on_message(self, message: Message) -> None:
        """Take in what the inbox delivers, and where in the map the areas are."""
        if isinstance(message, ClosureDecision) and message.global_poses:
            self.area_poses = GlobalPoses(message.global_poses)
        self.process_message(message)


def main() -> None:
    """Run the node."""
    run_task_node(ExplorerNode)


if __name__ == "__main__":
    main()
