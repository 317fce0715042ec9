"""What all processes do after one and the same keyframe event, because slam asks them to.

Slam waits until no keyframe event is under way, does its own part and asks the others for theirs; until all have
answered it works on nothing, so that all parts are of one moment.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from pathlib import Path

from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import ResetRequest, ResetResponse, SaveRequest, SaveResponse, decode, encode
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.routing import SUBSCRIPTIONS
from hmt_slam_ros.process_table import participant_names
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.diagnostics import PERIOD
from hmt_slam_ros.ros.inbox import CHAIN
from hmt_slam_ros.ros.node_interfaces import CoordinatorNode, ParticipantNode
from hmt_slam_ros.ros.topics import RESET_REQUEST, RESET_RESPONSE, SAVE_REQUEST, SAVE_RESPONSE
from hmt_slam_ros.saved_map.folder import FileRecord, FolderWriter

PARTICIPANTS = participant_names()
"""The processes that slam asks."""


class RequestParticipant:
    """Answers slam when the node's process has heard as many keyframe events as slam says."""

    def __init__(self, node: ParticipantNode, name: str) -> None:
        """Listen to slam.

        :param name: of the process.
        """
        self._node, self._name = node, name
        # The last message of an event that the process hears.
        self._last_event_type = [kind for kind in CHAIN if kind in SUBSCRIPTIONS[name]][-1]
        self._events = node.initial_state.events
        self._requests: deque[SaveRequest | ResetRequest] = deque()
        self._final_part_saved_at: float | None = None
        self._save_response_publisher = node.create_publisher(String, SAVE_RESPONSE, topics.CHAIN)
        self._reset_response_publisher = node.create_publisher(String, RESET_RESPONSE, topics.CHAIN)
        self._subscribe(SAVE_REQUEST, SaveRequest, topics.VOLATILE_CHAIN)
        # Who was not there hears of it all the same.
        self._subscribe(RESET_REQUEST, ResetRequest, topics.CHAIN)

    def _subscribe(self, topic: str, kind: type[SaveRequest | ResetRequest], profile: QoSProfile) -> None:
        def hear(message: String) -> None:
            try:
                request = decode(message.data, kind)
            except HmtSlamError as error:
                self._node.diagnostics.fail(f"{topic}: {error}")
            else:
                self._on_request(request)

        self._node.create_subscription(String, topic, hear, profile)

    def _on_request(self, request: SaveRequest | ResetRequest) -> None:
        """Take note of a request, unless it was answered before."""
        if isinstance(request, SaveRequest) or request.number > self._node.reset_number:
            self._requests.append(request)
            self.answer_due_requests()

    def on_delivered(self, message: Message) -> None:
        """Count an event that the process has worked off; do what waits for it."""
        if isinstance(message, self._last_event_type):
            self._events += 1
            self.answer_due_requests()

    def has_saved_final_part(self, linger: float) -> bool:
        """Whether the part of the last map was written, at least some seconds ago, or there is nothing to be saved."""
        return not self._events or (
            self._final_part_saved_at is not None and time.monotonic() - self._final_part_saved_at >= linger
        )

    def answer_due_requests(self) -> None:
        """Answer what is due, and what would never be as nothing is heard."""
        while self._requests and (self._events >= self._requests[0].events or self._node.inbox.is_holding):
            self._answer(self._requests.popleft())

    def _answer(self, request: SaveRequest | ResetRequest) -> None:
        fault = self._event_mismatch(request)
        if isinstance(request, ResetRequest):
            fault = fault or self._reset(request)
            self._reset_response_publisher.publish(
                String(data=encode(ResetResponse(request.number, self._name, fault)))
            )
            self._node.inbox.deliver_early()
            return
        files: tuple[FileRecord, ...] = ()
        if not fault:
            files, fault = self._write_part(request)
        self._save_response_publisher.publish(
            String(data=encode(SaveResponse(request.number, self._name, files, fault)))
        )
        if request.shutdown:
            self._final_part_saved_at = time.monotonic()

    def _event_mismatch(self, request: SaveRequest | ResetRequest) -> str:
        """What is wrong where the process heard more keyframe events than slam, or less; who forgets may lack some."""
        if self._events > request.events:
            return f"it is at keyframe event {self._events}, not {request.events}: restart all nodes"
        if self._events < request.events and isinstance(request, SaveRequest):
            return f"it is inactive, at keyframe event {self._events} of {request.events}: activate it"
        return ""

    def _reset(self, request: ResetRequest) -> str:
        """Begin anew; what went wrong."""
        try:
            self._node.reset(request.folder, request.number)
        except HmtSlamError as fault:
            return f"{fault}; restart all nodes"
        self._events = self._node.initial_state.events
        return ""

    def _write_part(self, request: SaveRequest) -> tuple[tuple[FileRecord, ...], str]:
        """What was written, or what went wrong."""
        folder = Path(request.folder)
        if not folder.is_dir():
            return (), f"it does not see the folder {folder}: run all nodes where that is, or set save_to of slam"
        try:
            writer = FolderWriter(folder)
            writer.write(self._name, self._node.process.state)
        except OSError as error:
            return (), f"{folder} cannot be written ({error.strerror})"
        return writer.files, ""


_REQUEST_TIMEOUT = 60.0  # s, for the end of a keyframe event and for the answers of the others, who may compile kernels
_DISCOVERY_TIMEOUT = 5.0  # s, until DDS has made processes known to each other that just began


class RequestCoordinator(ABC):
    """Asks the other processes for something.

    :ivar is_blocking: whether slam has to wait with what it hears.
    """

    def __init__(
        self,
        node: CoordinatorNode,
        on_release: Callable[[], None],
        topic_names: tuple[str, str],
        kind: type[SaveResponse | ResetResponse],
        failure: str,
    ) -> None:
        """Listen.

        :param on_release: called when slam need not wait any more.
        :param topic_names: of the topics of the requests and of the answers.
        :param kind: of the answers.
        :param failure: what cannot be done where something goes wrong.
        """
        self.is_blocking = False
        self._node, self._on_release, self._kind, self._failure = node, on_release, kind, failure
        self._outcome: Future | None = None
        self._requested_at, self._number = 0.0, 0
        self._answers: dict[str, SaveResponse | ResetResponse] = {}
        self._request_publisher = node.create_publisher(String, topic_names[0], topics.CHAIN)
        node.create_subscription(String, topic_names[1], self._on_response, topics.VOLATILE_CHAIN)
        node.create_timer(PERIOD, self._check_timeout, clock=node.diagnostics.steady_clock)

    @property
    def is_busy(self) -> bool:
        """Whether something is asked for."""
        return self._outcome is not None

    def request(self) -> Future:
        """The outcome of what is begun now: whether it was done, and a sentence."""
        asked = self._outcome = Future()
        self._requested_at = time.monotonic()
        self.start_if_ready()
        return asked

    def start_if_ready(self) -> None:
        """Begin where that is asked for and no keyframe event is under way."""
        if self._outcome is None or self.is_blocking or self._node.process.is_awaiting_decision:
            return
        listening = self._request_publisher.get_subscription_count()
        if listening < len(PARTICIPANTS) and time.monotonic() - self._requested_at < _DISCOVERY_TIMEOUT:
            return
        self._answers = {}
        # Also above those of a slam that was killed.
        self._number = max(self._number + 1, time.time_ns())
        try:
            self.is_blocking = True
            request = self._make_request(self._number, self._node.process.keyframe_events)
            if listening < len(PARTICIPANTS):
                raise HmtSlamError(f"{listening} of {', '.join(PARTICIPANTS)} are running: start all of them")
        except (HmtSlamError, OSError) as fault:
            self._end(f"{self._failure}: {fault}")
        else:
            self._request_publisher.publish(String(data=encode(request)))

    @abstractmethod
    def _make_request(self, number: int, events: int) -> SaveRequest | ResetRequest:
        """Do slam's own part, and make the request to the others.

        :param number: of the request.
        :param events: keyframe events after which all are.
        :raises HmtSlamError: where it cannot be done.
        """

    @abstractmethod
    def _finish(self) -> str:
        """Do what is left when all have answered; return the sentence that it was done.

        :raises HmtSlamError: where it cannot be done.
        """

    @abstractmethod
    def _clean_up(self) -> None:
        """Forget what was needed on the way, however it ended."""

    def _on_response(self, message: String) -> None:
        part = decode(message.data, self._kind)
        if not self.is_blocking or part.number != self._number:
            return
        self._answers[part.process] = part
        if part.error:
            self._end(f"{self._failure}: {part.process} says that {part.error}")
        elif set(PARTICIPANTS) <= self._answers.keys():
            try:
                done = self._finish()
            except HmtSlamError as fault:
                self._end(str(fault))
            else:
                self._end(None, done)

    def _check_timeout(self) -> None:
        self.start_if_ready()
        if self._outcome is None or time.monotonic() - self._requested_at < _REQUEST_TIMEOUT:
            return
        missing = [name for name in PARTICIPANTS if self.is_blocking and name not in self._answers]
        late = f"{' and '.join(missing)} did not answer" if missing else "a keyframe event is not answered"
        self._end(f"{self._failure}: {late} within {_REQUEST_TIMEOUT:g} s, look at /diagnostics")

    def _end(self, fault: str | None, done: str = "") -> None:
        """Answer, and let slam go on."""
        self._clean_up()
        self.is_blocking = False
        if fault is not None:
            self._node.diagnostics.warn(fault)
        asked, self._outcome = self._outcome, None
        if asked is not None:
            asked.set_result((fault is None, fault or done))
        self._on_release()
