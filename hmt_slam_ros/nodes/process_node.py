"""The shell that all five process nodes share: convert, call the process once, publish."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from rclpy.node import Node

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.nodes.figures import Figures
from hmt_slam_ros.nodes.inbox import Inbox
from hmt_slam_ros.nodes.outbox import Outbox
from hmt_slam_ros.nodes.parameters import declare_configuration
from hmt_slam_ros.processes.messages import Message, Notice
from hmt_slam_ros.processes.routing import HEARD_BY, Process


class ProcessNode(Node):
    """A process of :mod:`hmt_slam_ros.processes` as a node of the same name."""

    def __init__(
        self,
        name: str,
        make_process: Callable[[Configuration], Process],
        said: Iterable[type],
        changeable: Iterable[str] = (),
    ) -> None:
        """Make the process with the configuration from the node's parameters.

        :param name: one of those in ``HEARD_BY``.
        :param said: kinds of messages that the process says.
        :param changeable: parameters that may change while the node runs.
        :raises HmtSlamError: for a parameter that cannot be.
        """
        super().__init__(name)
        self.configuration = declare_configuration(self, tuple(changeable), self.configuration_changed)
        self.figures = Figures(self)
        self.process = make_process(self.configuration)
        self.outbox = Outbox(self, (*said, Notice))
        self.inbox = Inbox(self, HEARD_BY[name], self.deliver, self.figures)

    def configuration_changed(self, configuration: Configuration) -> None:
        """Take note of new values of the parameters that may change."""
        self.configuration = configuration

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

    def show(self, _heard: Message, _said: list[Message]) -> None:
        """Publish what is for people to see; nothing, unless a node has something."""
