"""What all processes do after one and the same keyframe event, because slam asks them to.

Slam waits until no keyframe event is under way, does its own part and asks the others for theirs; until all have
answered it works on nothing, so that all parts are of one moment.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING

from rclpy.task import Future
from std_msgs.msg import String

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.nodes import qos
from hmt_slam_ros.nodes.figures import PERIOD
from hmt_slam_ros.nodes.part import PARTS
from hmt_slam_ros.processes.documents import BeginRequest, BegunPart, SavedPart, SaveRequest, decode, encode

if TYPE_CHECKING:
    from hmt_slam_ros.nodes.slam_node import SlamNode

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
        topics: tuple[str, str],
        kind: type[SavedPart | BegunPart],
        failing: str,
    ) -> None:
        """Listen.

        :param release: called when slam need not wait any more.
        :param topics: of the requests and of the answers.
        :param kind: of the answers.
        :param failing: what cannot be done where something goes wrong.
        """
        self.holding = False
        self._node, self._release, self._kind, self._failing = node, release, kind, failing
        self._asked: Future | None = None
        self._since, self._number = 0.0, 0
        self._answers: dict[str, SavedPart | BegunPart] = {}
        self._requests = node.create_publisher(String, topics[0], qos.CHAIN)
        node.create_subscription(String, topics[1], self._hear, qos.CHAIN_FROM_NOW)
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
