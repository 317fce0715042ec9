"""Loop closure acceptance as a node, with the map and the graph for people to see."""

from __future__ import annotations

import sys
from pathlib import Path

from nav_msgs.msg import OccupancyGrid
from nav_msgs.srv import GetMap
from rclpy.publisher import Publisher
from visualization_msgs.msg import MarkerArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.messages.messages import Accepted, Message
from hmt_slam_ros.messages.routing import Remembering
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.execution import run
from hmt_slam_ros.ros.initial_state import Beginning
from hmt_slam_ros.ros.map_services import spin
from hmt_slam_ros.ros.map_view import MapView, Seen
from hmt_slam_ros.ros.parameters import declare_frame
from hmt_slam_ros.ros.process_node import ProcessNode
from hmt_slam_ros.ros.recovery import CHECKPOINT
from hmt_slam_ros.ros.topics import GRAPH, MAP
from hmt_slam_ros.saved_map.folder import VERSION, FolderReader

_VIEW = "view"
_PERIOD = 3.0  # s between two looks at whether the map has to be drawn anew


class TlcaNode(ProcessNode):
    """The node ``tlca``."""

    def __init__(self) -> None:
        super().__init__("tlca", _make_process, (Accepted,))

    def declare(self) -> None:
        """Declare the name of the frame too."""
        super().declare()
        self._map = declare_frame(self, "map", "map")

    def set_up(self) -> None:
        """As any process node, and what people see of the map."""
        super().set_up()
        self._view = MapView(self.configuration, self._map, Seen.of(self.beginning.map))
        self._grids = self.create_publisher(OccupancyGrid, MAP, topics.LATCHED)
        self._graphs = self.create_publisher(MarkerArray, GRAPH, topics.LATCHED)
        self._drawn = {GRAPH: 0, MAP: 0}
        self.create_timer(_PERIOD, self._draw, clock=self.figures.steady_clock)
        self.create_service(GetMap, "~/get_map", self._get_map)

    def begin_anew(self, folder: str, request: int = 0) -> None:
        """As any process node, and draw what is known then."""
        super().begin_anew(folder, request)
        self._view = MapView(self.configuration, self._map, Seen.of(self.beginning.map))
        self._drawn = {GRAPH: -1, MAP: -1}

    def memory(self) -> dict[str, object]:
        """What people see."""
        return {_VIEW: self._view.seen}

    def remember(self, state: Path) -> None:
        """Go on showing it."""
        seen = FolderReader(state, CHECKPOINT, VERSION).read(_VIEW, Seen)
        self._view = MapView(self.configuration, self._map, seen)

    def _get_map(self, _request: GetMap.Request, response: GetMap.Response) -> GetMap.Response:
        """The grid as it would be published now, an empty one where nothing is mapped."""
        response.map = self._view.grid() or response.map
        return response

    def show(self, heard: Message, said: list[Message]) -> None:
        """Follow what is heard and said."""
        for message in (heard, *said):
            self._view.hear(message)

    def _draw(self) -> None:
        """Publish map and graph where something changed and someone looks."""
        if not self.active:
            return
        if self._due(GRAPH, self._graphs):
            self._graphs.publish(self._view.graph())
        if self._due(MAP, self._grids) and (grid := self._view.grid()) is not None:
            self._grids.publish(grid)

    def _due(self, topic: str, publisher: Publisher) -> bool:
        due = self._drawn[topic] != self._view.version and publisher.get_subscription_count() > 0
        if due:
            self._drawn[topic] = self._view.version
        return due


def _make_process(configuration: Configuration, beginning: Beginning) -> Remembering:
    # It takes time, in which a signal has to be heard.
    from hmt_slam_ros.loop_closure.tlca import Tlca, TlcaState  # noqa: PLC0415

    return Tlca(configuration, beginning.part("tlca", TlcaState))


def main() -> None:
    """Run the node."""
    sys.exit(run(TlcaNode, spin))


if __name__ == "__main__":
    main()
