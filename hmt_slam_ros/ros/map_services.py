"""Services of slam that save the map of all nodes, load another one, or reset.

A save or a reset is a coordinated request: slam waits for the end of a keyframe event, does its part and asks the other
processes for theirs. It handles nothing until all have answered, so that all parts are of one moment.
"""

from __future__ import annotations

import shutil
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_msgs.msg import String
from std_srvs.srv import Trigger

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import ResetRequest, ResetResponse, SaveRequest, SaveResponse, encode
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.own_files import ScratchFolder, replace_folder
from hmt_slam_ros.process_table import COORDINATOR, participant_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.diagnostics import PERIOD
from hmt_slam_ros.ros.initial_state import InitialState
from hmt_slam_ros.ros.message_io import subscribe_document
from hmt_slam_ros.ros.process_node import ProcessNode
from hmt_slam_ros.ros.topics import DOCUMENTS
from hmt_slam_ros.saved_map.folder import FORMAT, HMT_MAP, foreign_entry
from hmt_slam_ros.saved_map.validation import check_process_states
from hmt_slam_ros.untrusted_input import shorten

if TYPE_CHECKING:
    from hmt_slam_ros.metric_slam.speculation import SpeculativeSlam
    from hmt_slam_ros.results.hmt_map import MapWriter

_REQUEST_TIMEOUT = 60.0
"""Time for the end of a keyframe event and the responses of the others, which may compile kernels, s."""
_DISCOVERY_TIMEOUT = 5.0
"""Time until DDS has found processes that just started, s."""
_UNSUBSCRIBE_TIMEOUT = 2.0
"""Time until DDS reports that a subscription is gone, s."""
_POLL = 0.02  # s
SAVE_TO, LOAD_FROM = "save_to", "load_from"
"""Parameters that name the folders of a save and of a load; they may change while slam runs."""
_REMEDY = "the map of before stays; make room, or set save_to of slam to another folder"


class MapServicesNode(ProcessNode):
    """The node ``slam``, as far as the services need it.

    :ivar map_frame: name of the map's frame.
    :ivar estimate: the last estimate of metric SLAM, None before the first.
    """

    process: SpeculativeSlam
    map_frame: str
    estimate: LocalEstimate | None

    @property
    def is_busy(self) -> bool:
        """Whether a map is being saved or exchanged."""
        raise NotImplementedError

    @property
    def unchanged_map_folder(self) -> Path | None:
        """Folder of the loaded map where the run did not change it, else None."""
        raise NotImplementedError

    def write_map(self, writer: MapWriter) -> None:
        """Write the current map."""
        raise NotImplementedError


class RequestCoordinator(ABC):
    """Slam's side of a kind of coordinated request.

    :ivar is_blocking: whether slam may not handle messages.
    """

    def __init__(
        self,
        node: MapServicesNode,
        on_release: Callable[[], None],
        request_type: type[SaveRequest | ResetRequest],
        response_type: type[SaveResponse | ResetResponse],
    ) -> None:
        """Make publisher, subscription and timer.

        :param on_release: called when slam may handle messages again.
        """
        self.is_blocking = False
        self._node, self._on_release = node, on_release
        self._outcome: Future | None = None
        self._requested_at, self._number = 0.0, 0
        self._responses: dict[str, SaveResponse | ResetResponse] = {}
        self._request_publisher = node.create_publisher(String, DOCUMENTS[request_type], topics.CHAIN)
        # A process that just started may have answered before DDS has made this reader known to it.
        subscribe_document(node, response_type, self._on_response, topics.CHAIN)
        node.create_timer(PERIOD, self._check_timeout, clock=node.diagnostics.steady_clock)

    @property
    @abstractmethod
    def _failure(self) -> str:
        """What cannot be done, the start of each sentence about a fault."""

    @property
    def is_busy(self) -> bool:
        """Whether a request is under way."""
        return self._outcome is not None

    def request(self) -> Future:
        """Start a request; its outcome is whether it succeeded, and a sentence."""
        outcome = self._outcome = Future()
        self._requested_at = time.monotonic()
        self.start_if_ready()
        return outcome

    def start_if_ready(self) -> None:
        """Start a requested operation where no keyframe event is under way and all processes are there."""
        process = self._node.process
        if self._outcome is None or self.is_blocking or process.is_awaiting_decision or process.is_interrupted:
            return
        participants, subscribers = participant_names(), self._request_publisher.get_subscription_count()
        if subscribers < len(participants) and time.monotonic() - self._requested_at < _DISCOVERY_TIMEOUT:
            return
        self._responses = {}
        # Larger than those of a slam that was killed.
        self._number = max(self._number + 1, time.time_ns())
        try:
            self.is_blocking = True
            request = self._make_request(self._number, process.keyframe_events)
            if subscribers < len(participants):
                raise HmtSlamError(f"{subscribers} of {', '.join(participants)} are running: start all of them")
        except (HmtSlamError, OSError) as fault:
            self._end(f"{self._failure}: {fault}")
        else:
            self._request_publisher.publish(String(data=encode(request, system=self._node.system.name)))

    @abstractmethod
    def _make_request(self, number: int, events: int) -> SaveRequest | ResetRequest:
        """Do slam's part, and make the request to the others.

        :param number: of the request.
        :param events: number of keyframe events after which it is due.
        :raises HmtSlamError: where it cannot be done.
        """

    @abstractmethod
    def _finish(self) -> str:
        """Complete the request after all responses; return a sentence.

        :raises HmtSlamError: where it cannot be done.
        """

    @abstractmethod
    def _clean_up(self) -> None:
        """Remove temporary data, whatever the outcome."""

    def _on_response(self, response: SaveResponse | ResetResponse) -> None:
        if not self.is_blocking or response.number != self._number:
            return
        self._responses[response.process] = response
        if response.error:
            self._end(f"{self._failure}: {response.process} says that {response.error}")
        elif set(participant_names()) <= self._responses.keys():
            try:
                sentence = self._finish()
            except HmtSlamError as fault:
                self._end(str(fault))
            else:
                self._end(None, sentence)

    def _check_timeout(self) -> None:
        self.start_if_ready()
        if self._outcome is None or time.monotonic() - self._requested_at < _REQUEST_TIMEOUT:
            return
        missing = [name for name in participant_names() if self.is_blocking and name not in self._responses]
        cause = f"{' and '.join(missing)} did not answer" if missing else "a keyframe event is not answered"
        self._end(f"{self._failure}: {cause} within {_REQUEST_TIMEOUT:g} s, look at /diagnostics")

    def _end(self, fault: str | None, sentence: str = "") -> None:
        """Set the outcome, and release slam."""
        self._clean_up()
        self.is_blocking = False
        if fault is not None:
            self._node.diagnostics.warn(fault)
        outcome, self._outcome = self._outcome, None
        if outcome is not None:
            outcome.set_result((fault is None, fault or sentence))
        self._on_release()

    def _offer(self, kind: type, name: str, callback: Callable[..., Any]) -> None:
        """Offer a service in a callback group of its own, so that the node spins while the outcome is awaited."""
        self._node.create_service(kind, name, callback, callback_group=MutuallyExclusiveCallbackGroup())


class _PendingSave(NamedTuple):
    """A save under way: a temporary folder, and the writer of the map in it."""

    scratch: ScratchFolder
    writer: MapWriter

    @classmethod
    def begin(cls, target: Path) -> _PendingSave:
        """A save to a folder.

        :raises OSError: where nothing can be written beside it; no temporary folder is left then.
        """
        from hmt_slam_ros.results.hmt_map import MapWriter  # noqa: PLC0415  only for a save

        target.parent.mkdir(parents=True, exist_ok=True)
        scratch = ScratchFolder(target, target.parent)
        try:
            return cls(scratch, MapWriter(scratch.path / "new"))
        except OSError:
            scratch.remove()
            raise

    @property
    def folder(self) -> Path:
        return self.scratch.path / "new"


def check_map_is_replaceable(target: Path) -> None:
    """Check that a save to a folder removes nothing but a map.

    :raises HmtSlamError: unless there is nothing, or a folder with the files of a map and nothing else.
    :raises OSError: where it cannot be read.
    """
    if not target.exists() and not target.is_symlink():
        return
    foreign = target if target.is_symlink() or not target.is_dir() else foreign_entry(target, FORMAT)
    if foreign is not None:
        raise HmtSlamError(
            f"something else than a map stands there, {foreign} is none of its files: set save_to of slam to another "
            "folder"
        )


class MapSaver(RequestCoordinator):
    """The service ``save``, and the last save at shutdown."""

    def __init__(self, node: MapServicesNode, on_release: Callable[[], None]) -> None:
        """Offer the service."""
        self._target = _folder_of(node, SAVE_TO)
        super().__init__(node, on_release, SaveRequest, SaveResponse)
        self._final_save: Future | None = None
        self._is_shutting_down = False
        self._pending_save: _PendingSave | None = None
        self._offer(Trigger, "~/save", self._save)

    @property
    def _failure(self) -> str:
        return f"{self._target} cannot be saved"

    def request(self) -> Future:
        """As any request; into the folder that the parameter names by now."""
        self._target = _folder_of(self._node, SAVE_TO)
        return super().request()

    async def _save(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._node.is_busy:
            response.message = "a map is being saved or loaded already: ask again"
            return response
        response.success, response.message = await self.request()
        return response

    def poll_final_save(self) -> bool:
        """Whether the last save has ended; the first call requests it."""
        self._is_shutting_down = True
        if self._final_save is None and not self._node.is_busy:
            self._final_save = self.request()
        return self._final_save is not None and self._final_save.done()

    def _make_request(self, number: int, events: int) -> SaveRequest:
        if self._node.estimate is None:
            raise HmtSlamError("nothing is mapped yet, drive first")
        try:
            check_map_is_replaceable(self._target)
            self._pending_save = _PendingSave.begin(self._target)
            self._pending_save.writer.write_slam_state(self._node.process.state)
            self._node.write_map(self._pending_save.writer)
        except OSError as fault:
            raise HmtSlamError(f"{fault.strerror}; {_REMEDY}") from fault
        return SaveRequest(number, events, str(self._pending_save.folder), self._is_shutting_down)

    def _finish(self) -> str:
        assert self._pending_save is not None
        try:
            for response in self._responses.values():
                assert isinstance(response, SaveResponse)
                self._pending_save.writer.add_files(response.files)
            self._pending_save.writer.finish(self._node.configuration)
            check_map_is_replaceable(self._target)
            replace_folder(self._copy_unchanged_map() or self._pending_save.folder, self._target)
        except OSError as fault:
            raise HmtSlamError(f"{self._target} cannot be saved: {fault.strerror}; {_REMEDY}") from fault
        return f"saved to {self._target}"

    def _copy_unchanged_map(self) -> Path | None:
        """A copy of the loaded map where the robot was only localized in it, else None."""
        assert self._pending_save is not None
        loaded, kept = self._node.unchanged_map_folder, self._pending_save.scratch.path / "kept"
        if loaded is None:
            return None
        kept.mkdir()
        for file in loaded.iterdir():
            if file.is_file():
                shutil.copyfile(file, kept / file.name)
        return kept

    def _clean_up(self) -> None:
        if self._pending_save is not None:
            self._pending_save.scratch.remove()
        self._pending_save = None


def declare_folders(node: Node) -> None:
    """Declare the parameters of the folders that the services read at each request."""
    for name, default, description in (
        (SAVE_TO, HMT_MAP, "Folder into which the service save writes the map."),
        (LOAD_FROM, "", "Output folder or hmt_map from which the service load goes on."),
    ):
        node.declare_parameter(name, default, ParameterDescriptor(description=description))


def _folder_of(node: Node, parameter: str) -> Path:
    """The folder that a parameter names."""
    return Path(node.get_parameter(parameter).value).absolute()


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):  # such as a name that is too long
        return False


class MapLoader(RequestCoordinator):
    """The services ``load`` and ``reset``."""

    def __init__(self, node: MapServicesNode, on_release: Callable[[], None]) -> None:
        """Offer the services."""
        super().__init__(node, on_release, ResetRequest, ResetResponse)
        self._folder = ""
        self._offer(Trigger, "~/load", self._load)
        self._offer(Trigger, "~/reset", self._reset)

    @property
    def _failure(self) -> str:
        return "the map cannot be exchanged"

    async def _reset(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._node.is_busy:
            response.message = "a map is being saved or loaded: ask again"
            return response
        if not self._node.process.is_mapping:
            response.message = "mode = localization keeps the map: set mode of slam to mapping first"
            return response
        response.success, response.message = await self.request()
        return response

    async def _load(self, _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._node.is_busy:
            response.message = "a map is being saved or loaded, so no other one is loaded: ask again"
            return response
        try:
            folder = self._checked_folder()
        except HmtSlamError as fault:
            response.message = str(fault)
            return response
        self._folder = str(folder)
        response.success, response.message = await self.request()
        return response

    def _checked_folder(self) -> Path:
        """The folder of ``load_from``, whose map can be loaded.

        :raises HmtSlamError: where it cannot.
        """
        name = str(self._node.get_parameter(LOAD_FROM).value)
        folder = _folder_of(self._node, LOAD_FROM)
        if not name or not _is_folder(folder):
            raise HmtSlamError(
                f"there is no folder {shorten(repr(name))}: set load_from of slam to an output folder or hmt_map"
            )
        try:
            self._check_map(folder)
        except HmtSlamError as fault:
            raise HmtSlamError(f"{folder} is not loaded: {fault}") from fault
        return folder

    def _check_map(self, folder: Path) -> None:
        """Check that all parts of a map can be read, so that either all processes start with it or none does.

        :raises HmtSlamError: where one cannot.
        """
        from hmt_slam_ros.results.hmt_map import PARTS  # noqa: PLC0415  only for a load

        initial_state = InitialState(self._node, str(folder), lost=True)
        parts = {name: initial_state.read_part(name, PARTS[name]) for name in (COORDINATOR, *participant_names())}
        check_process_states(parts, self._node.configuration)

    def _make_request(self, number: int, events: int) -> ResetRequest:
        return ResetRequest(number, events, self._folder)

    def _finish(self) -> str:
        self._node.reset(self._folder, self._number)
        return f"goes on from {self._folder}" if self._folder else "the map is forgotten, a new one begins"

    def _clean_up(self) -> None:
        self._folder = ""


class StaleSubscribers:
    """Subscribers to save requests that still have a map that slam gave up.

    A node that is configured again has a new subscription, which is not stale.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._stale: set[bytes] = set()

    def mark_current(self) -> None:
        """Mark all current subscribers as stale."""
        self._stale = set(self._current_subscribers())

    def check_gone(self) -> None:
        """Check that no stale subscriber is left, so that slam can start a map.

        :raises HmtSlamError: where one is left.
        """
        deadline = time.monotonic() + _UNSUBSCRIBE_TIMEOUT
        while stale := self._stale & self._current_subscribers().keys():
            if time.monotonic() > deadline:
                names = sorted(self._current_subscribers()[gid] for gid in stale)
                raise HmtSlamError(
                    f"{', '.join(names)} still have the map that slam gave up: clean these up too, then configure slam"
                )
            time.sleep(_POLL)

    def _current_subscribers(self) -> dict[bytes, str]:
        """{gid of a subscription: name of its node}."""
        topic = self._node.resolve_topic_name(DOCUMENTS[SaveRequest])
        endpoints = self._node.get_subscriptions_info_by_topic(topic)
        return {bytes(endpoint.endpoint_gid): endpoint.node_name for endpoint in endpoints}
