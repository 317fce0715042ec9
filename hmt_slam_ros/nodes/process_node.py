"""The shell that all five process nodes share: convert, call the process once, publish."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.parameter import Parameter

from hmt_slam_ros.compilation import tell_of_compilation
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.flat import as_flat
from hmt_slam_ros.nodes.beginning import Beginning, declare_beginning
from hmt_slam_ros.nodes.figures import Figures
from hmt_slam_ros.nodes.inbox import Inbox
from hmt_slam_ros.nodes.outbox import Outbox
from hmt_slam_ros.nodes.parameters import ConfiguredNode
from hmt_slam_ros.nodes.part import PARTS, Part
from hmt_slam_ros.nodes.recovery import Base, Found, Recovery, Setting, Told
from hmt_slam_ros.processes.messages import Arriving, Message, Notice, RealTimePose
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
        self.recovery = Recovery(self)
        self._answered, self._checkpoints, self._recovering = 0, 0, self.recovery.found is not None
        if self.recovery.found is None:
            self.recovery.begin(self._base())
        else:
            self.beginning = self._where_it_was(self.recovery.found)
        self.process = self._made()
        tell_of_compilation(self.get_logger().info)
        self.outbox = Outbox(self, (*said, Notice), self._answered)
        self.inbox = Inbox(
            self, HEARD_BY[name], self.deliver, self.figures, first=self.beginning.events, begun=self._answered,
            after=self.after,
        )  # fmt: skip
        self._part = Part(self, name) if name in PARTS else None

    def _made(self) -> Remembering:
        """The process, made from the beginning."""
        process = self._make_process(self.configuration, self.beginning)
        if self.beginning.carried and Arriving in HEARD_BY[self._name]:
            # Slam says so too, but not before this node could say otherwise.
            process.handle(Arriving(self.beginning.events, 0))
        return process

    def begin_anew(self, folder: str, request: int = 0) -> None:
        """Forget all, and go on from a map in which the robot may be anywhere, or from nothing.

        :param folder: of the map, empty for nothing.
        :param request: number of the request that the node answers by that.
        :raises HmtSlamError: where it is damaged, or the node's parameters do not go with it.
        """
        self.beginning = Beginning(self, folder, carried=True, scans=self.scans)
        self.process = self._made()
        self.inbox.begin_anew(self.beginning.events, request)
        self._answered = self.outbox.begun = request
        self.recovery.begin(self._base())

    def _base(self) -> Base:
        """What the node is that begins anew."""
        beginning = self.beginning
        return Base(
            False, beginning.events, str(beginning.folder or ""), beginning.carried, beginning.scans, self._answered,
            received=dict(self.figures.received), stamps=self.recovery.stamps,
        )  # fmt: skip

    def _where_it_was(self, found: Found) -> Beginning:
        """The beginning of a node that goes on for another one that was killed."""
        base = found.base
        self._answered = base.request
        self.figures.received.update(base.received)
        if base.checkpoint:
            return Beginning.at_checkpoint(self, found.state, base)
        return Beginning(self, base.folder, carried=base.carried, scans=base.scans)

    @property
    def after(self) -> Mapping[str, int]:
        """{kind of measurement: stamp from which on the node wants them, ns}, also of the past; else the next ones."""
        return {}

    @property
    def answered(self) -> int:
        """Number of the last request to begin anew that was answered."""
        return self._answered

    @property
    def recovering(self) -> bool:
        """Whether the node hears again what another one of its name heard that was killed."""
        return self._recovering

    def recover(self) -> None:
        """Go on where a node of the same name was killed, if one was."""
        found = self.recovery.found
        if found is None:
            return
        begin = time.monotonic()
        if found.base.checkpoint:
            self.remember(found.state)
        self.outbox.sent.update(found.base.sent)
        for message in found.said:
            self.outbox.repeat(message)
        for value in found.heard:
            self.hear_again(value)
        self._recovering = False
        self.recovery.resume()
        self.get_logger().warning(
            f"{self._name} was killed and goes on where it was: at keyframe event {found.base.events} and "
            f"{len(found.heard)} messages, {time.monotonic() - begin:.1f} s"
        )

    def hear_again(self, value: Message | Told) -> None:
        """Do what was done with what was heard."""
        if isinstance(value, Setting):
            self.set_parameters([Parameter(value.name, value=json.loads(value.value))])
        elif not isinstance(value, Told):
            self.inbox.receive(value)

    def memory(self) -> dict[str, object]:
        """{name: document} of what the node remembers beside its process."""
        return {}

    def remember(self, state: Path) -> None:
        """Take over what :meth:`memory` gave.

        :param state: the folder in which it is.
        """

    @property
    def at_rest(self) -> bool:
        """Whether process and memory are all that there is."""
        return True

    def configuration_changed(self, configuration: Configuration) -> None:
        """Take note of new values, also for one that goes on where this node is killed."""
        before, now = as_flat(self.configuration), as_flat(configuration)
        super().configuration_changed(configuration)
        for name in now:
            if now[name] != before[name]:
                self.recovery.heard(Setting(name, json.dumps(now[name])))

    def deliver(self, message: Message) -> None:
        """Let the process handle a message and publish its answers."""
        if isinstance(message, Arriving) and not self._recovering and self.recovery.is_past(message):
            return
        self.recovery.heard(message)
        said: list[Message] = []
        begin = time.perf_counter()
        with self.figures.timed(message, said):
            said += self.process.handle(message)
        self.recovery.worked(time.perf_counter() - begin)
        for answer in said:
            self._say(answer)
        self.show(message, said)
        if self._part is not None:
            self._part.delivered(message)
        self._keep_checkpoint()

    def _say(self, answer: Message) -> None:
        if self._recovering and isinstance(answer, RealTimePose):
            return  # that moment is over
        self.outbox.send(answer)
        self.recovery.said(answer)
        self.figures.sent[type(answer).__name__] += 1
        if isinstance(answer, Notice):
            self.figures.warn(answer.text)

    def _keep_checkpoint(self) -> None:
        """Write a checkpoint where one is due and the state is a whole."""
        events = self.inbox.events
        if not self.recovery.due or events is None or not self.at_rest:
            return
        base = Base(
            True, events, str(self.beginning.folder or ""), False, 0, self._answered, dict(self.figures.received),
            dict(self.outbox.sent), self.recovery.stamps, self.recovery.arriving,
        )  # fmt: skip
        begin = time.perf_counter()
        self.recovery.checkpoint(base, {self._name: self.process.state, **self.memory()})
        self._checkpoints += 1
        self.figures.state["checkpoints"] = f"{self._checkpoints}, the last in {time.perf_counter() - begin:.3f} s"

    @property
    def scans(self) -> int:
        """Scans that have a pose, as far as the node gives it."""
        return 0

    def saved_last(self, linger: float) -> bool:
        """Whether the node's part of the last map is saved, and the others had some seconds to hear of it."""
        return self._part is not None and self._part.gave_last(linger)

    def show(self, _heard: Message, _said: list[Message]) -> None:
        """Publish what is for people to see; nothing, unless a node has something."""
