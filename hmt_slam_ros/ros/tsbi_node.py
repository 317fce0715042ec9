"""Topological inference as a node, with the distribution of Eq. (14) for people to see."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from std_msgs.msg import Bool, Float64, Float64MultiArray, MultiArrayDimension, MultiArrayLayout

from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Message, TrackingReset
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.conversions import flatten_rows
from hmt_slam_ros.ros.execution import run
from hmt_slam_ros.ros.map_services import spin
from hmt_slam_ros.ros.process_node import ProcessNode
from hmt_slam_ros.ros.topics import ENTROPY, IS_LOCALIZED, PMF

if TYPE_CHECKING:
    from hmt_slam_ros.topological_inference.tsbi import Tsbi


class TsbiNode(ProcessNode):
    """The node ``tsbi``."""

    process: Tsbi

    def __init__(self) -> None:
        super().__init__("tsbi")

    def configure_node(self) -> None:
        """As any process node, and say whether the robot's place is known."""
        super().configure_node()
        self._pmf = self.create_publisher(Float64MultiArray, PMF, topics.LATCHED)
        self._localized_publisher = self.create_publisher(Bool, IS_LOCALIZED, topics.LATCHED)
        self._entropy_publisher = self.create_publisher(Float64, ENTROPY, topics.LATCHED)
        self._publish_localization()

    def publish_views(self, heard: Message, said: list[Message]) -> None:
        """Publish the distribution over the topological paths, Eq. (14), and whether the robot's place is known."""
        if said or isinstance(heard, ClosureDecision | TrackingReset):
            self._publish_localization()
        for message in said:
            if isinstance(message, Hypotheses):
                self._pmf.publish(pmf_message(message))

    def reset(self, folder: str, reset_number: int = 0) -> None:
        """As any process node, and say that the robot's place is not known."""
        super().reset(folder, reset_number)
        self._publish_localization()

    def _publish_localization(self) -> None:
        found = self.process.localization
        self._localized_publisher.publish(Bool(data=found.localized))
        self._entropy_publisher.publish(Float64(data=found.entropy))
        self.diagnostics.values["localized"] = "yes" if found.localized else "no, the robot may be anywhere in the map"
        self.diagnostics.values["entropy of the area"] = f"{found.entropy:.3f} nats"


def pmf_message(hypotheses: Hypotheses) -> Float64MultiArray:
    """Rows of (hypothesis, area, probability), the most probable first; the last is (-1, -1, what was not examined)."""
    leaves = sorted(hypotheses.hypotheses, key=lambda leaf: (-leaf.probability, leaf.id))
    rows = [(leaf.id, leaf.area, leaf.probability) for leaf in leaves] + [(-1, -1, hypotheses.unexamined)]
    layout = [
        MultiArrayDimension(label="hypothesis", size=len(rows), stride=3 * len(rows)),
        MultiArrayDimension(label="hypothesis,area,probability", size=3, stride=3),
    ]
    return Float64MultiArray(layout=MultiArrayLayout(dim=layout), data=flatten_rows(rows))


def main() -> None:
    """Run the node."""
    sys.exit(run(TsbiNode, spin))


if __name__ == "__main__":
    main()
