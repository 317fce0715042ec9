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
from hmt_slam_ros.messages.messages import Arriving, Message, Notice, RealTimePose
from hmt_slam_ros.messages.routing import HEARD_BY, Remembering
from hmt_slam_ros.ros.coordinated_request import PARTS, Part
from hmt_slam_ros.ros.inbox import Inbox
from hmt_slam_ros.ros.initial_state import Beginning, declare_beginning
from hmt_slam_ros.ros.lifecycle import ManagedNode
from hmt_slam_ros.ros.outbox import Outbox
from hmt_slam_ros.ros.recovery import Active, Base, Found, Recovery, Setting, Told, declare_recovery

SAVING_PATIENCE = 8.0
"""Seconds for the last map: a launch tells its nodes to end once more after 5 s, and kills them after 10 s."""

# What a node said last has to reach the others before it takes leave.
_LINGER = 0.5  # s
_POLL = 0.05  # s
_SAVE_AT_END = ParameterDescriptor(
    description="Whether all nodes save the map to save_to of slam when they are told to end.", read_only=True
)


class ProcessNode(ManagedNode):
    """A process of :mod:`hmt_slam_ros.messages` as a node of the same name.

    :ivar hears_on: whether the process hears all the same while the node is inactive, and says what it has to.
    :ivar saves_at_end: whether it stays for that when it is told to end.
    """

    hears_on = False
    saves_at_end = False

    def __init__(
        self,
        name: str,
        make_process: Callable[[Configuration, Beginning], Remembering],
        said: Iterable[type],
        changeable: Iterable[str] = (),
    ) -> None:
        """Declare the parameters.

        :param name: one of those in ``HEARD_BY``.
        :param make_process: makes it from what the node begins with.
        :param said: kinds of messages that the process says.
        :param changeable: parameters that may change while the node runs.
        """
        self._make_process, self._name, self._said = make_process, name, (*said, Notice)
        super().__init__(name, changeable)

    def declare(self) -> None:
        """Declare those of all processes, and look for what a node of the same name left behind.

        :raises HmtSlamError: where that is damaged.
        """
        self.saves_at_end = bool(self.declare_parameter("save_at_end", False, _SAVE_AT_END).value)
        self.start_from, self._start_carried = declare_beginning(self)
        self._recovery_folder = declare_recovery(self)
        self.recovery = Recovery(self, self._recovery_folder)

    @property
    def first_states(self) -> tuple[bool, bool]:
        """Those in which a node of the same name was when it was killed, if one was."""
        found, (configure, activate) = self.recovery.found, super().first_states
        if found is None:
            return configure, activate
        return True, activate if found.active is None else found.active

    def set_up(self) -> None:
        """Make the process with what it begins with or what was left behind, and all that it hears and says.

        :raises HmtSlamError: for a map that cannot be.
        """
        found = self.recovery.found
        self._answered, self._checkpoints, self._recovering = 0, 0, found is not None
        if found is None:
            self.beginning = Beginning(self, self.start_from, carried=self._start_carried)
        else:
            self.beginning = self._where_it_was(found)
        self.process = self._made()
        if found is None:
            self.recovery.begin(self._base())
        tell_of_compilation(self.get_logger().info)
        self.outbox = Outbox(self, self._said, self._answered)
        self.inbox = Inbox(
            self,
            HEARD_BY[self._name],
            self.deliver,
            self.figures,
            first=self.beginning.events,
            begun=self._answered,
            after=self.after,
        )
        self._part = Part(self, self._name) if self._name in PARTS else None

    def take_part(self) -> None:
        """Let the process hear what has come."""
        self.recovery.heard(Active(True))
        self.inbox.go_on()

    def stand_still(self) -> None:
        """Let the process hear nothing, unless it hears on."""
        self.recovery.heard(Active(False))
        if not self.hears_on:
            self.inbox.wait()
        if self._part is not None:
            self._part.look()

    def give_up(self) -> None:
        """Leave nothing behind: what the process knows is forgotten."""
        self.recovery.clear()
        self.recovery = Recovery(self, self._recovery_folder)

    def abandon(self) -> None:
        """As any managed node; what another node left behind stays for the next try."""
        super().abandon()
        if self.recovery.found is None:
            self.recovery.clear()

    def leave(self) -> None:
        """As when the node is told to end: after its part of the last map is saved, if one is to be."""
        if not self.saves_at_end:
            self.take_down()
            return
        begin = time.monotonic()

        def look() -> None:
            if self.saved_last() or time.monotonic() - begin > SAVING_PATIENCE:
                self.take_down()

        self.create_timer(_POLL, look, clock=self.figures.steady_clock)

    def depart(self) -> None:
        """Leave nothing behind for a node of the same name, unless it was left by another one."""
        if self.configured:
            self.recovery.clear()

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
            False,
            beginning.events,
            str(beginning.folder or ""),
            beginning.carried,
            beginning.scans,
            self._answered,
            received=dict(self.figures.received),
            stamps=self.recovery.stamps,
        )

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

    def _configure(self) -> None:
        """As any managed node, up to where a node of the same name was killed, if one was."""
        super()._configure()
        if self.recovery.found is not None:
            self._recover(self.recovery.found)
        if not self.hears_on:
            self.inbox.wait()

    def _recover(self, found: Found) -> None:
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
        if not self.configured:
            return
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
        if isinstance(answer, RealTimePose) and not self.active:
            return  # neither of a moment that is over, nor of a node that takes no part
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
            True,
            events,
            str(self.beginning.folder or ""),
            False,
            0,
            self._answered,
            dict(self.figures.received),
            dict(self.outbox.sent),
            self.recovery.stamps,
            self.recovery.arriving,
        )
        begin = time.perf_counter()
        self.recovery.checkpoint(base, {self._name: self.process.state, **self.memory()})
        self._checkpoints += 1
        self.figures.state["checkpoints"] = f"{self._checkpoints}, the last in {time.perf_counter() - begin:.3f} s"

    @property
    def scans(self) -> int:
        """Scans that have a pose, as far as the node gives it."""
        return 0

    def saved_last(self) -> bool:
        """Whether the node's part of the last map is saved, and the others had time to hear of it.

        So that all come to the same keyframe event, an inactive node goes on for that.
        """
        if not self.configured:
            return True
        self.inbox.go_on()
        return self._part is not None and self._part.gave_last(_LINGER)

    def show(self, _heard: Message, _said: list[Message]) -> None:
        """Publish what is for people to see; nothing, unless a node has something."""
