"""Another map while the nodes run: a saved one by the service ``load_map`` of slam, none at all by ``reset``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from nav_msgs.srv import LoadMap
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from std_srvs.srv import Trigger

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes.beginning import Beginning
from hmt_slam_ros.nodes.map_view import MapView, Seen
from hmt_slam_ros.nodes.part import PARTS
from hmt_slam_ros.nodes.round import Round
from hmt_slam_ros.nodes.topics import BEGIN, BEGUN
from hmt_slam_ros.processes.documents import BeginRequest, BegunPart

if TYPE_CHECKING:
    from hmt_slam_ros.nodes.slam_node import SlamNode

_FILE = "file://"


class MapChanger(Round):
    """Answers the services ``load_map`` and ``reset``."""

    def __init__(self, node: SlamNode, release: Callable[[], None]) -> None:
        """Offer the services.

        :param release: called when slam need not wait any more.
        """
        super().__init__(node, release, (BEGIN, BEGUN), BegunPart, "the map cannot be exchanged")
        self._folder = ""
        # A group of its own, so that the node goes on while the answer is awaited.
        group = MutuallyExclusiveCallbackGroup()
        node.create_service(LoadMap, "~/load_map", self._load, callback_group=group)
        node.create_service(Trigger, "~/reset", self._reset, callback_group=group)

    async def _reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._node.busy:
            response.message = "a map is being saved or loaded: ask again"
            return response
        if not self._node.process.mapping:
            response.message = "mode = localization keeps the map: set mode of slam to mapping first"
            return response
        response.success, response.message = await self.ask()
        return response

    async def _load(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        """As the result code of nav2's map_server, which has no sentence; that is in the log and in /diagnostics."""
        response.result = LoadMap.Response.RESULT_UNDEFINED_FAILURE
        if self._node.busy:
            self._node.figures.warn("a map is being saved or loaded, so no other one is loaded: ask again")
            return response
        folder = Path(request.map_url.removeprefix(_FILE)).absolute()
        if not folder.is_dir():
            self._node.figures.warn(f"there is no folder {folder}: set map_url to an output folder or hmt_map")
            response.result = LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
            return response
        try:
            known = self._check(folder).map
        except HmtSlamError as fault:
            self._node.figures.warn(f"{folder} is not loaded: {fault}")
            response.result = LoadMap.Response.RESULT_INVALID_MAP_DATA
            return response
        self._folder = str(folder)
        done, _ = await self.ask()
        if done:
            response.result = LoadMap.Response.RESULT_SUCCESS
            view = MapView(self._node.configuration, self._node.map_frame, Seen.of(known))
            response.map = view.grid() or response.map
        return response

    def _check(self, folder: Path) -> Beginning:
        """A map of which all parts can be read, so that either all processes begin with it or none does."""
        from hmt_slam_ros.offline.saved_map import PARTS as KINDS  # noqa: PLC0415  only where something is loaded

        beginning = Beginning(self._node, str(folder), carried=True)
        for name in PARTS:
            beginning.part(name, KINDS[name])
        return beginning

    def _begin(self, number: int, events: int) -> BeginRequest:
        return BeginRequest(number, events, self._folder)

    def _finish(self) -> str:
        self._node.begin_anew(self._folder, self._number)
        return f"goes on from {self._folder}" if self._folder else "the map is forgotten, a new one begins"

    def _clean_up(self) -> None:
        self._folder = ""
