"""The services of slam that save the map of all nodes, load another one, or begin anew.

When the parts of all processes are there, the folder takes the place of the one before.

rclpy's own handler of signals takes the context away at once, and with it all talk among the nodes. So these nodes do
without it: the one that is told goes on until the map is saved, or some seconds are over.
"""

from __future__ import annotations

import shutil
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import rclpy
from nav_msgs.srv import LoadMap
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.signals import uninstall_signal_handlers
from rclpy.task import Future
from std_srvs.srv import Trigger

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import ResetRequest, ResetResponse, SaveRequest, SaveResponse
from hmt_slam_ros.ros.coordinated_request import PARTICIPANTS, RequestCoordinator
from hmt_slam_ros.ros.execution import force_exit_after, spin_until
from hmt_slam_ros.ros.initial_state import InitialState
from hmt_slam_ros.ros.map_view import MapRenderer, MapRendererState
from hmt_slam_ros.ros.node_interfaces import MapServicesNode
from hmt_slam_ros.ros.process_node import SAVE_TIMEOUT, ProcessNode
from hmt_slam_ros.ros.topics import RESET_REQUEST, RESET_RESPONSE, SAVE_REQUEST, SAVE_RESPONSE
from hmt_slam_ros.saved_map.folder import HMT_MAP, MANIFEST, replace_folder

if TYPE_CHECKING:
    from hmt_slam_ros.results.hmt_map import MapWriter

_REMEDY = "the map of before stays; make room, or set save_to of slam to another folder"


class _PendingSave(NamedTuple):
    """A map that is being saved.

    :ivar scratch: folder that vanishes at the end.
    :ivar writer: of the map in it.
    """

    scratch: Path
    writer: MapWriter

    @property
    def folder(self) -> Path:
        return self.scratch / "new"


class MapSaver(RequestCoordinator):
    """Answers the service ``save``."""

    _node: MapServicesNode

    def __init__(self, node: MapServicesNode, on_release: Callable[[], None]) -> None:
        """Offer the service.

        :param on_release: called when slam need not wait any more.
        """
        self._target = node.save_to
        super().__init__(
            node, on_release, (SAVE_REQUEST, SAVE_RESPONSE), SaveResponse, f"{self._target} cannot be saved"
        )
        self._final_save: Future | None = None
        self._is_shutting_down = False
        self._pending_save: _PendingSave | None = None
        # A group of its own, so that the node goes on while the answer is awaited.
        group = MutuallyExclusiveCallbackGroup()
        node.create_service(Trigger, "~/save", self._answer, callback_group=group)

    async def _answer(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._node.is_busy:
            response.message = "a map is being saved or loaded already: ask again"
            return response
        response.success, response.message = await self.request()
        return response

    def poll_final_save(self) -> bool:
        """Whether the map of a node that was told to end is saved, or cannot be; the first call asks for it."""
        self._is_shutting_down = True
        if self._final_save is None and not self._node.is_busy:
            self._final_save = self.request()
        return self._final_save is not None and self._final_save.done()

    def _make_request(self, number: int, events: int) -> SaveRequest:
        """Write the part of slam, and ask the others for theirs."""
        from hmt_slam_ros.results.hmt_map import MapWriter  # noqa: PLC0415  only where something is saved

        if self._node.estimate is None:
            raise HmtSlamError("nothing is mapped yet, drive first")
        if self._target.exists() and not (self._target / MANIFEST).is_file():
            raise HmtSlamError("something else than a map stands there, set save_to of slam to another folder")
        try:
            self._target.parent.mkdir(parents=True, exist_ok=True)
            scratch = Path(tempfile.mkdtemp(prefix=f".{self._target.name}.partial-", dir=self._target.parent))
            self._pending_save = _PendingSave(scratch, MapWriter(scratch / "new"))
            self._pending_save.writer.write_slam_state(self._node.process.state)
            self._node.write_map(self._pending_save.writer)
        except OSError as fault:
            raise HmtSlamError(f"{fault.strerror}; {_REMEDY}") from fault
        return SaveRequest(number, events, str(self._pending_save.folder), self._is_shutting_down)

    def _finish(self) -> str:
        assert self._pending_save is not None
        try:
            for part in self._answers.values():
                assert isinstance(part, SaveResponse)
                self._pending_save.writer.add_files(part.files)
            self._pending_save.writer.finish(self._node.configuration)
            replace_folder(self._copy_unchanged_map() or self._pending_save.folder, self._target)
        except OSError as fault:
            raise HmtSlamError(f"{self._target} cannot be saved: {fault.strerror}; {_REMEDY}") from fault
        return f"saved to {self._target}"

    def _copy_unchanged_map(self) -> Path | None:
        """A copy of the map that was loaded, where the robot was only localized in it, without what it saw since."""
        assert self._pending_save is not None
        loaded = self._node.unchanged_map_folder
        return None if loaded is None else Path(shutil.copytree(loaded, self._pending_save.scratch / "kept"))

    def _clean_up(self) -> None:
        if self._pending_save is not None:
            shutil.rmtree(self._pending_save.scratch, ignore_errors=True)
        self._pending_save = None


def declare_save_to(node: Node) -> Path:
    """The folder for the map, from the parameter ``save_to``."""
    return Path(node.declare_parameter("save_to", HMT_MAP, _DESCRIPTOR).value).absolute()


_DESCRIPTOR = ParameterDescriptor(description="Folder into which the service save writes the map.", read_only=True)


_FILE = "file://"


class MapLoader(RequestCoordinator):
    """Answers the services ``load_map`` and ``reset``."""

    _node: MapServicesNode

    def __init__(self, node: MapServicesNode, on_release: Callable[[], None]) -> None:
        """Offer the services.

        :param on_release: called when slam need not wait any more.
        """
        super().__init__(
            node, on_release, (RESET_REQUEST, RESET_RESPONSE), ResetResponse, "the map cannot be exchanged"
        )
        self._folder = ""
        # A group of its own, so that the node goes on while the answer is awaited.
        group = MutuallyExclusiveCallbackGroup()
        node.create_service(LoadMap, "~/load_map", self._load, callback_group=group)
        node.create_service(Trigger, "~/reset", self._reset, callback_group=group)

    async def _reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._node.is_busy:
            response.message = "a map is being saved or loaded: ask again"
            return response
        if not self._node.process.is_mapping:
            response.message = "mode = localization keeps the map: set mode of slam to mapping first"
            return response
        response.success, response.message = await self.request()
        return response

    async def _load(self, request: LoadMap.Request, response: LoadMap.Response) -> LoadMap.Response:
        """As the result code of nav2's map_server, which has no sentence; that is in the log and in /diagnostics."""
        response.result = LoadMap.Response.RESULT_UNDEFINED_FAILURE
        if self._node.is_busy:
            self._node.diagnostics.warn("a map is being saved or loaded, so no other one is loaded: ask again")
            return response
        folder = Path(request.map_url.removeprefix(_FILE)).absolute()
        if not folder.is_dir():
            self._node.diagnostics.warn(f"there is no folder {folder}: set map_url to an output folder or hmt_map")
            response.result = LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
            return response
        try:
            known = self._read_checked_map(folder).map
        except HmtSlamError as fault:
            self._node.diagnostics.warn(f"{folder} is not loaded: {fault}")
            response.result = LoadMap.Response.RESULT_INVALID_MAP_DATA
            return response
        self._folder = str(folder)
        done, _ = await self.request()
        if done:
            response.result = LoadMap.Response.RESULT_SUCCESS
            view = MapRenderer(self._node.configuration, self._node.map_frame, MapRendererState.from_document(known))
            response.map = view.occupancy_grid() or response.map
        return response

    def _read_checked_map(self, folder: Path) -> InitialState:
        """A map of which all parts can be read, so that either all processes begin with it or none does."""
        from hmt_slam_ros.results.hmt_map import PARTS as KINDS  # noqa: PLC0415  only where something is loaded

        beginning = InitialState(self._node, str(folder), lost=True)
        for name in PARTICIPANTS:
            beginning.read_part(name, KINDS[name])
        return beginning

    def _make_request(self, number: int, events: int) -> ResetRequest:
        return ResetRequest(number, events, self._folder)

    def _finish(self) -> str:
        self._node.reset(self._folder, self._number)
        return f"goes on from {self._folder}" if self._folder else "the map is forgotten, a new one begins"

    def _clean_up(self) -> None:
        self._folder = ""


def spin(node: ProcessNode) -> None:
    """Begin and spin a node until it is told to end and its part of the last map is saved, if one is to be.

    :raises HmtSlamError: where it cannot begin.
    """
    node.enter_startup_states()
    ended = False
    try:
        _spin(node)
        ended = True
    finally:
        if ended or not rclpy.ok():
            node.discard_recovery()


def _spin(node: ProcessNode) -> None:
    if not node.save_on_shutdown or not rclpy.ok():
        spin_until(node)
        return
    told = _FirstSignal()
    spin_until(node, lambda: told.has_timed_out or (told.received_at is not None and node.poll_final_save()))


class _FirstSignal:
    """Takes note of the first signal in place of rclpy's handler; more of them change nothing.

    :ivar received_at: when that was, by the monotonic clock, None before.
    """

    def __init__(self) -> None:
        self.received_at: float | None = None
        uninstall_signal_handlers()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self)

    @property
    def has_timed_out(self) -> bool:
        """Whether there is no time left."""
        return self.received_at is not None and time.monotonic() - self.received_at > SAVE_TIMEOUT

    def __call__(self, _number: int, _frame: object) -> None:
        if self.received_at is None:
            self.received_at = time.monotonic()
            force_exit_after(SAVE_TIMEOUT + 1.0, 0)


# Until DDS tells that a subscription is gone.
_UNSUBSCRIBE_TIMEOUT = 2.0  # s
_POLL = 0.02  # s


class StaleSubscribers:
    """Those that are asked for their part of a map; a node that is configured anew is another one."""

    def __init__(self, node: Node) -> None:
        """Nothing was given up yet."""
        self._node = node
        self._stale: set[bytes] = set()

    def mark_current(self) -> None:
        """All that there are now have a map that is given up."""
        self._stale = set(self._current_subscribers())

    def check_gone(self) -> None:
        """See whether a map can begin.

        :raises HmtSlamError: where others have what was given up.
        """
        deadline = time.monotonic() + _UNSUBSCRIBE_TIMEOUT
        while left := self._stale & self._current_subscribers().keys():
            if time.monotonic() > deadline:
                names = sorted(self._current_subscribers()[one] for one in left)
                raise HmtSlamError(
                    f"{', '.join(names)} still have the map that slam gave up: clean these up too, then configure slam"
                )
            time.sleep(_POLL)

    def _current_subscribers(self) -> dict[bytes, str]:
        """{identity of a subscription: name of its node}."""
        there = self._node.get_subscriptions_info_by_topic(self._node.resolve_topic_name(SAVE_REQUEST))
        return {bytes(one.endpoint_gid): one.node_name for one in there}
