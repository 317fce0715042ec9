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
from typing import TYPE_CHECKING

from rclpy.qos import QoSProfile
from rclpy.task import Future
from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.documents import BeginRequest, BegunPart, SavedPart, SaveRequest, decode, encode
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.routing import HEARD_BY
from hmt_slam_ros.ros import topics
from hmt_slam_ros.ros.diagnostics import PERIOD
from hmt_slam_ros.ros.inbox import CHAIN
from hmt_slam_ros.ros.topics import BEGIN, BEGUN, SAVE, SAVED
from hmt_slam_ros.saved_map.folder import File, FolderWriter

if TYPE_CHECKING:
    from hmt_slam_ros.ros.process_node import ProcessNode
    from hmt_slam_ros.ros.slam_node import SlamNode

PARTS = ("aam", "tsbi", "tlca", "rtl")
"""The nodes that slam asks."""


class Part:
    """Answers slam when the node's process has heard as many keyframe events as slam says."""

    def __init__(self, node: ProcessNode, name: str) -> None:
        """Listen to slam.

        :param name: of the process.
        """
        self._node, self._name = node, name
        # The last message of an event that the process hears.
        self._last = [kind for kind in CHAIN if kind in HEARD_BY[name]][-1]
        self._events = node.beginning.events
        self._requests: deque[SaveRequest | BeginRequest] = deque()
        self._gave_last: float | None = None
        self._saved = node.create_publisher(String, SAVED, topics.CHAIN)
        self._begun = node.create_publisher(String, BEGUN, topics.CHAIN)
        self._listen(SAVE, SaveRequest, topics.CHAIN_FROM_NOW)
        # Who was not there hears of it all the same.
        self._listen(BEGIN, BeginRequest, topics.CHAIN)

    def _listen(self, topic: str, kind: type[SaveRequest | BeginRequest], profile: QoSProfile) -> None:
        def hear(message: String) -> None:
            try:
                request = decode(message.data, kind)
            except HmtSlamError as error:
                self._node.figures.fail(f"{topic}: {error}")
            else:
                self._hear(request)

        self._node.create_subscription(String, topic, hear, profile)

    def _hear(self, request: SaveRequest | BeginRequest) -> None:
        """Take note of a request, unless it was answered before."""
        if isinstance(request, SaveRequest) or request.number > self._node.answered:
            self._requests.append(request)
            self.look()

    def delivered(self, message: Message) -> None:
        """Count an event that the process has worked off; do what waits for it."""
        if isinstance(message, self._last):
            self._events += 1
            self.look()

    def gave_last(self, linger: float) -> bool:
        """Whether the part of the last map was written, at least some seconds ago, or there is nothing to be saved."""
        return not self._events or (self._gave_last is not None and time.monotonic() - self._gave_last >= linger)

    def look(self) -> None:
        """Answer what is due, and what would never be as nothing is heard."""
        while self._requests and (self._events >= self._requests[0].events or self._node.inbox.waits):
            self._answer(self._requests.popleft())

    def _answer(self, request: SaveRequest | BeginRequest) -> None:
        fault = self._apart(request)
        if isinstance(request, BeginRequest):
            fault = fault or self._begin(request)
            self._begun.publish(String(data=encode(BegunPart(request.number, self._name, fault))))
            self._node.inbox.catch_up()
            return
        files: tuple[File, ...] = ()
        if not fault:
            files, fault = self._written(request)
        self._saved.publish(String(data=encode(SavedPart(request.number, self._name, files, fault))))
        if request.last:
            self._gave_last = time.monotonic()

    def _apart(self, request: SaveRequest | BeginRequest) -> str:
        """What is wrong where the process heard more keyframe events than slam, or less; who forgets may lack some."""
        if self._events > request.events:
            return f"it is at keyframe event {self._events}, not {request.events}: restart all nodes"
        if self._events < request.events and isinstance(request, SaveRequest):
            return f"it is inactive, at keyframe event {self._events} of {request.events}: activate it"
        return ""

    def _begin(self, request: BeginRequest) -> str:
        """Begin anew; what went wrong."""
        try:
            self._node.begin_anew(request.folder, request.number)
        except HmtSlamError as fault:
            return f"{fault}; restart all nodes"
        self._events = self._node.beginning.events
        return ""

    def _written(self, request: SaveRequest) -> tuple[tuple[File, ...], str]:
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


_PATIENCE = 60.0  # s, for the end of a keyframe event and for the answers of the others, who may compile kernels
_DISCOVERY = 5.0  # s, until DDS has made processes known to each other that just began


class Round(ABC):
    """Asks the other processes for something.

    :ivar holding: whether slam has to wait with what it hears.
    """

    def __init__(
        self,
        node: SlamNode,
        release: Callable[[], None],
        names: tuple[str, str],
        kind: type[SavedPart | BegunPart],
        failing: str,
    ) -> None:
        """Listen.

        :param release: called when slam need not wait any more.
        :param names: of the topics of the requests and of the answers.
        :param kind: of the answers.
        :param failing: what cannot be done where something goes wrong.
        """
        self.holding = False
        self._node, self._release, self._kind, self._failing = node, release, kind, failing
        self._asked: Future | None = None
        self._since, self._number = 0.0, 0
        self._answers: dict[str, SavedPart | BegunPart] = {}
        self._requests = node.create_publisher(String, names[0], topics.CHAIN)
        node.create_subscription(String, names[1], self._hear, topics.CHAIN_FROM_NOW)
        node.create_timer(PERIOD, self._look_at_clock, clock=node.figures.steady_clock)

    @property
    def busy(self) -> bool:
        """Whether something is asked for."""
        return self._asked is not None

    def ask(self) -> Future:
        """The outcome of what is begun now: whether it was done, and a sentence."""
        asked = self._asked = Future()
        self._since = time.monotonic()
        self.look()
        return asked

    def look(self) -> None:
        """Begin where that is asked for and no keyframe event is under way."""
        if self._asked is None or self.holding or self._node.process.waiting:
            return
        listening = self._requests.get_subscription_count()
        if listening < len(PARTS) and time.monotonic() - self._since < _DISCOVERY:
            return
        self._answers = {}
        # Also above those of a slam that was killed.
        self._number = max(self._number + 1, time.time_ns())
        try:
            self.holding = True
            request = self._begin(self._number, self._node.process.events)
            if listening < len(PARTS):
                raise HmtSlamError(f"{listening} of {', '.join(PARTS)} are running: start all of them")
        except (HmtSlamError, OSError) as fault:
            self._end(f"{self._failing}: {fault}")
        else:
            self._requests.publish(String(data=encode(request)))

    @abstractmethod
    def _begin(self, number: int, events: int) -> SaveRequest | BeginRequest:
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

    def _hear(self, message: String) -> None:
        part = decode(message.data, self._kind)
        if not self.holding or part.number != self._number:
            return
        self._answers[part.part] = part
        if part.fault:
            self._end(f"{self._failing}: {part.part} says that {part.fault}")
        elif set(PARTS) <= self._answers.keys():
            try:
                done = self._finish()
            except HmtSlamError as fault:
                self._end(str(fault))
            else:
                self._end(None, done)

    def _look_at_clock(self) -> None:
        self.look()
        if self._asked is None or time.monotonic() - self._since < _PATIENCE:
            return
        missing = [name for name in PARTS if self.holding and name not in self._answers]
        late = f"{' and '.join(missing)} did not answer" if missing else "a keyframe event is not answered"
        self._end(f"{self._failing}: {late} within {_PATIENCE:g} s, look at /diagnostics")

    def _end(self, fault: str | None, done: str = "") -> None:
        """Answer, and let slam go on."""
        self._clean_up()
        self.holding = False
        if fault is not None:
            self._node.figures.warn(fault)
        asked, self._asked = self._asked, None
        if asked is not None:
            asked.set_result((fault is None, fault or done))
        self._release()
