"""The shell that all five process nodes share: convert, call the process once, publish."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from rcl_interfaces.msg import ParameterDescriptor

from hmt_slam_ros.compilation import tell_of_compilation
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.nodes.beginning import Beginning, declare_beginning
from hmt_slam_ros.nodes.figures import Figures
from hmt_slam_ros.nodes.inbox import Inbox
from hmt_slam_ros.nodes.outbox import Outbox
from hmt_slam_ros.nodes.parameters import ConfiguredNode
from hmt_slam_ros.nodes.part import PARTS, Part
from hmt_slam_ros.processes.messages import Arriving, Message, Notice
from hmt_slam_ros.processes.routing import HEARD_BY, Remembering

_SAVE_AT_END = ParameterDescriptor(
    description="Whether all nodes save the map to save_to of slam when they are told to end.", read_only=True
)


class ProcessNode(ConfiguredNode):
    """A process of :mod:`hmt_slam_ros.processes` as a node of the same name.

    :ivar saves_at_end: whether it stays for that when it is told to end.
    """

    def __init__(
        self,
        name: str,
        make_process: Callable[[Configuration, Beginning], Remembering],
        said: Iterable[type],
        changeable: Iterable[str] = (),
    ) -> None:
        """Make the process with the configuration from the node's parameters.

        :param name: one of those in ``HEARD_BY``.
        :param make_process: makes it from what the node begins with.
        :param said: kinds of messages that the process says.
        :param changeable: parameters that may change while the node runs.
        :raises HmtSlamError: for a parameter that cannot be.
        """
        super().__init__(name, changeable)
        self.saves_at_end = bool(self.declare_parameter("save_at_end", False, _SAVE_AT_END).value)
        self.figures = Figures(self)
        self._make_process, self._name = make_process, name
        self.beginning = declare_beginning(self)
        self.process = self._made()
        tell_of_compilation(self.get_logger().info)
        self.outbox = Outbox(self, (*said, Notice))
        self.inbox = Inbox(self, HEARD_BY[name], self.deliver, self.figures, first=self.beginning.events)
        self._part = Part(self, name) if name in PARTS else None

    def _made(self) -> Remembering:
        """The process, made from the beginning."""
        process = self._make_process(self.configuration, self.beginning)
        if self.beginning.carried and Arriving in HEARD_BY[self._name]:
            # Slam says so too, but not before this node could say otherwise.
            process.handle(Arriving(self.beginning.events, 0))
        return process

    def begin_anew(self, folder: str) -> None:
        """Forget all, and go on from a map in which the robot may be anywhere, or from nothing.

        :param folder: of the map, empty for nothing.
        :raises HmtSlamError: where it is damaged, or the node's parameters do not go with it.
        """
        self.beginning = Beginning(self, folder, carried=True, scans=self.scans)
        self.process = self._made()
        self.inbox.begin_anew(self.beginning.events)

    def deliver(self, message: Message) -> None:
        """Let the process handle a message and publish its answers."""
        said: list[Message] = []
        with self.figures.timed(message, said):
            said += self.process.handle(message)
        for answer in said:
            self.outbox.send(answer)
            self.figures.sent[type(answer).__name__] += 1
            if isinstance(answer, Notice):
                self.figures.warn(answer.text)
        self.show(message, said)
        if self._part is not None:
            self._part.delivered(message)

    @property
    def scans(self) -> int:
        """Scans that have a pose, as far as the node gives it."""
        return 0

    def saved_last(self, linger: float) -> bool:
        """Whether the node's part of the last map is saved, and the others had some seconds to hear of it."""
        return self._part is not None and self._part.gave_last(linger)

    def show(self, _heard: Message, _said: list[Message]) -> None:
        """Publish what is for people to see; nothing, unless a node has something."""
