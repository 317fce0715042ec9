"""The explorer as a node: drives the robot by cmd_vel, or has another program drive to goal_pose."""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.nodes.errand_node import ErrandNode, run_errands
from hmt_slam_ros.nodes.inbox import Inbox
from hmt_slam_ros.processes.errands import OF_EXPLORER, Errand
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
        self.areas = GlobalPoses((_FIRST,) if known is None else known.area_poses)
        explorer = Explorer(self.configuration, None if known is None else Replica.of(known.replica))
        if own.explores:
            explorer.handle(Errand("explore"))
        self.listen(explorer, drives=own.drive == "velocities")
        self._inbox = Inbox(
            self, (Keyframe, Hypotheses, Accepted), self._hear, self.figures, first=beginning.events, begun=None
        )

    def _hear(self, message: Message) -> None:
        if isinstance(message, Accepted) and message.global_poses:
            self.areas = GlobalPoses(message.global_poses)
        self.hear(message)


def main() -> None:
    """Run the node."""
    run_errands(ExplorerNode)


if __name__ == "__main__":
    main()
