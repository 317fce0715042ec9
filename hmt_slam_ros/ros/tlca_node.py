"""Loop closure acceptance as a node, with the map and the graph for people to see."""

from __future__ import annotations

import sys
from pathlib import Path

from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap
from rclpy.publisher import Publisher
from visualization_msgs.msg import MarkerArray

from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.execution import run
from hmt_slam_ros.ros.map_services import spin
from hmt_slam_ros.ros.map_view import MapRenderer, MapRendererState
from hmt_slam_ros.ros.parameters import declare_frame
from hmt_slam_ros.ros.process_node import ProcessNode
from hmt_slam_ros.ros.recovery import CHECKPOINT
from hmt_slam_ros.ros.topics import GRAPH, MAP
from hmt_slam_ros.saved_map.folder import VERSION, FolderReader

_RENDERER_STATE = "view"
_PERIOD = 3.0  # s between two looks at whether the map has to be drawn anew


class TlcaNode(ProcessNode):
    """The node ``tlca``."""

    def __init__(self) -> None:
        super().__init__("tlca")

    def declare_own_parameters(self) -> None:
        """Declare the name of the frame too."""
        super().declare_own_parameters()
        self._map_frame = declare_frame(self, "map", "map")

    def configure_node(self) -> None:
        """As any process node, and what people see of the map."""
        super().configure_node()
        self._renderer = MapRenderer(
            self.configuration, self._map_frame, MapRendererState.from_document(self.initial_state.map)
        )
        self._grids = self.create_publisher(OccupancyGrid, MAP, topics.LATCHED)
        self._graphs = self.create_publisher(MarkerArray, GRAPH, topics.LATCHED)
        self._published_versions = {GRAPH: 0, MAP: 0}
        self.create_timer(_PERIOD, self._publish_if_changed, clock=self.diagnostics.steady_clock)
        self.create_service(GetMap, "~/get_map", self._get_map)

    def reset(self, folder: str, reset_number: int = 0) -> None:
        """As any process node, and draw what is known then."""
        super().reset(folder, reset_number)
        self._renderer = MapRenderer(
            self.configuration, self._map_frame, MapRendererState.from_document(self.initial_state.map)
        )
        self._published_versions = {GRAPH: -1, MAP: -1}

    def node_state(self) -> dict[str, object]:
        """What people see."""
        return {_RENDERER_STATE: self._renderer.state}

    def restore_node_state(self, state: Path) -> None:
        """Go on showing it."""
        seen = FolderReader(state, CHECKPOINT, VERSION).read(_RENDERER_STATE, MapRendererState)
        self._renderer = MapRenderer(self.configuration, self._map_frame, seen)

    def _get_map(self, _request: GetMap.Request, response: GetMap.Response) -> GetMap.Response:
        """The grid as it would be published now, an empty one where nothing is mapped."""
        response.map = self._renderer.occupancy_grid() or response.map
        return response

    def publish_views(self, heard: Message, said: list[Message]) -> None:
        """Follow what is heard and said."""
        for message in (heard, *said):
            self._renderer.update(message)

    def _publish_if_changed(self) -> None:
        """Publish map and graph where something changed and someone looks."""
        if not self.is_active:
            return
        if self._is_due(GRAPH, self._graphs):
            self._graphs.publish(self._renderer.graph_markers())
        if self._is_due(MAP, self._grids) and (grid := self._renderer.occupancy_grid()) is not None:
            self._grids.publish(grid)

    def _is_due(self, topic: str, publisher: Publisher) -> bool:
        due = self._published_versions[topic] != self._renderer.version and publisher.get_subscription_count() > 0
        if due:
            self._published_versions[topic] = self._renderer.version
        return due


def main() -> None:
    """Run the node."""
    sys.exit(run(TlcaNode, spin))


if __name__ == "__main__":
    main()
