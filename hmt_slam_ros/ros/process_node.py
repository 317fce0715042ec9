"""The shell that all process nodes share: convert, call the process once, publish."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping
from pathlib import Path

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.parameter import Parameter

from hmt_slam_ros.compilation import report_compilation
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.flat import as_flat
from hmt_slam_ros.messages.messages import Message, Notice, RealTimePose, TrackingReset
from hmt_slam_ros.messages.routing import SUBSCRIPTIONS, Checkpointable, message_types
from hmt_slam_ros.process_table import process_row
from hmt_slam_ros.ros.coordinated_request import PARTICIPANTS, RequestParticipant
from hmt_slam_ros.ros.inbox import Inbox
from hmt_slam_ros.ros.initial_state import InitialState, declare_initial_state
from hmt_slam_ros.ros.lifecycle import ManagedNode
from hmt_slam_ros.ros.outbox import Outbox
from hmt_slam_ros.ros.recovery import (
    ActivationChange,
    ControlEvent,
    JournalHeader,
    ParameterChange,
    RecoveredState,
    Recovery,
    declare_recovery,
)

SAVE_TIMEOUT = 8.0
"""Seconds for the last map: a launch tells its nodes to end once more after 5 s, and kills them after 10 s."""

# What a node said last has to reach the others before it takes leave.
_LINGER = 0.5  # s
_POLL = 0.05  # s
_SAVE_ON_SHUTDOWN = ParameterDescriptor(
    description="Whether all nodes save the map to save_to of slam when they are told to end.", read_only=True
)


class ProcessNode(ManagedNode):
    """A process of :mod:`hmt_slam_ros.messages` as a node of the same name.

    :ivar is_always_listening: whether the process hears all the same while the node is inactive, and says what it has
        to.
    :ivar save_on_shutdown: whether it stays for that when it is told to end.
    """

    is_always_listening = False
    save_on_shutdown = False

    def __init__(
        self,
        name: str,
        changeable: Iterable[str] = (),
    ) -> None:
        """Declare the parameters.

        :param name: of a process in the process table.
        :param changeable: parameters that may change while the node runs.
        """
        self._name, self._output_types = name, (*message_types(process_row(name).produces), Notice)
        super().__init__(name, changeable)

    def declare_own_parameters(self) -> None:
        """Declare those of all processes, and look for what a node of the same name left behind.

        :raises HmtSlamError: where that is damaged.
        """
        self.save_on_shutdown = bool(self.declare_parameter("save_on_shutdown", False, _SAVE_ON_SHUTDOWN).value)
        self.start_from, self._start_lost = declare_initial_state(self)
        self._recovery_folder = declare_recovery(self)
        self.recovery = Recovery(self, self._recovery_folder)

    @property
    def startup_states(self) -> tuple[bool, bool]:
        """Those in which a node of the same name was when it was killed, if one was."""
        found, (configure, activate) = self.recovery.recovered_state, super().startup_states
        if found is None:
            return configure, activate
        return True, activate if found.was_active is None else found.was_active

    def configure_node(self) -> None:
        """Make the process with what it begins with or what was left behind, and all that it hears and says.

        :raises HmtSlamError: for a map that cannot be.
        """
        found = self.recovery.recovered_state
        self._reset_number, self._checkpoint_count, self._is_recovering = 0, 0, found is not None
        if found is None:
            self.initial_state = InitialState(self, self.start_from, lost=self._start_lost)
        else:
            self.initial_state = self._recovered_initial_state(found)
        self.process = self._create_process()
        if found is None:
            self.recovery.start_journal(self._journal_header())
        report_compilation(self.get_logger().info)
        self.outbox = Outbox(self, self._output_types, self._reset_number)
        self.inbox = Inbox(
            self,
            SUBSCRIPTIONS[self._name],
            self.deliver,
            self.diagnostics,
            first_event=self.initial_state.events,
            reset_number=self._reset_number,
            resume_stamps=self.resume_stamps,
        )
        self._participant = RequestParticipant(self, self._name) if self._name in PARTICIPANTS else None

    def activate_node(self) -> None:
        """Let the process hear what has come."""
        self.recovery.record_input(ActivationChange(True))
        self.inbox.release()

    def deactivate_node(self) -> None:
        """Let the process hear nothing, unless it hears on."""
        self.recovery.record_input(ActivationChange(False))
        if not self.is_always_listening:
            self.inbox.hold()
        if self._participant is not None:
            self._participant.answer_due_requests()

    def clean_up_node(self) -> None:
        """Leave nothing behind: what the process knows is forgotten."""
        self.recovery.discard()
        self.recovery = Recovery(self, self._recovery_folder)

    def abandon_configuration(self) -> None:
        """As any managed node; what another node left behind stays for the next try."""
        super().abandon_configuration()
        if self.recovery.recovered_state is None:
            self.recovery.discard()

    def shut_down_node(self) -> None:
        """As when the node is told to end: after its part of the last map is saved, if one is to be."""
        if not self.save_on_shutdown:
            self.tear_down()
            return
        begin = time.monotonic()

        def look() -> None:
            if self.poll_final_save() or time.monotonic() - begin > SAVE_TIMEOUT:
                self.tear_down()

        self.create_timer(_POLL, look, clock=self.diagnostics.steady_clock)

    def discard_recovery(self) -> None:
        """Leave nothing behind for a node of the same name, unless it was left by another one."""
        if self.is_configured:
            self.recovery.discard()

    def make_process(self, beginning: InitialState) -> Checkpointable:
        """The process, made from the map that the node begins with.

        :raises HmtSlamError: where the map lacks the state of the process.
        """
        # It takes time, in which a signal has to be heard.
        row = process_row(self._name)
        process: Checkpointable = row.make(self.configuration, beginning.read_part(self._name, row.state_class))
        return process

    def _create_process(self) -> Checkpointable:
        """The process, made from the beginning."""
        process = self.make_process(self.initial_state)
        if self.initial_state.lost and TrackingReset in SUBSCRIPTIONS[self._name]:
            # Slam says so too, but not before this node could say otherwise.
            process.handle(TrackingReset(self.initial_state.events, 0))
        return process

    def reset(self, folder: str, reset_number: int = 0) -> None:
        """Forget all, and go on from a map in which the robot may be anywhere, or from nothing.

        :param folder: of the map, empty for nothing.
        :param reset_number: number of the request that the node answers by that.
        :raises HmtSlamError: where it is damaged, or the node's parameters do not go with it.
        """
        self.initial_state = InitialState(self, folder, lost=True, previous_scans=self.scans)
        self.process = self._create_process()
        self.inbox.reset(self.initial_state.events, reset_number)
        self._reset_number = self.outbox.reset_number = reset_number
        self.recovery.start_journal(self._journal_header())

    def _journal_header(self) -> JournalHeader:
        """What the node is that begins anew."""
        beginning = self.initial_state
        return JournalHeader(
            False,
            beginning.events,
            str(beginning.folder or ""),
            beginning.lost,
            beginning.previous_scans,
            self._reset_number,
            received=dict(self.diagnostics.received),
            stamps=self.recovery.stamps,
        )

    def _recovered_initial_state(self, recovered: RecoveredState) -> InitialState:
        """The beginning of a node that goes on for another one that was killed."""
        base = recovered.header
        self._reset_number = base.reset_number
        self.diagnostics.received.update(base.received)
        if base.has_checkpoint:
            return InitialState.from_checkpoint(self, recovered.checkpoint_folder, base)
        return InitialState(self, base.folder, lost=base.lost, previous_scans=base.previous_scans)

    @property
    def resume_stamps(self) -> Mapping[str, int]:
        """{kind of measurement: stamp from which on the node wants them, ns}, also of the past; else the next ones."""
        return {}

    @property
    def reset_number(self) -> int:
        """Number of the last request to begin anew that was answered."""
        return self._reset_number

    @property
    def is_recovering(self) -> bool:
        """Whether the node hears again what another one of its name heard that was killed."""
        return self._is_recovering

    def _configure(self) -> None:
        """As any managed node, up to where a node of the same name was killed, if one was."""
        super()._configure()
        if self.recovery.recovered_state is not None:
            self._recover(self.recovery.recovered_state)
        if not self.is_always_listening:
            self.inbox.hold()

    def _recover(self, recovered: RecoveredState) -> None:
        begin = time.monotonic()
        if recovered.header.has_checkpoint:
            self.restore_node_state(recovered.checkpoint_folder)
        self.outbox.sent.update(recovered.header.sent)
        for message in recovered.outputs:
            self.outbox.resend(message)
        for value in recovered.inputs:
            self.replay_input(value)
        self._is_recovering = False
        self.recovery.resume_journal()
        self.get_logger().warning(
            f"{self._name} was killed and goes on where it was: at keyframe event {recovered.header.events} and "
            f"{len(recovered.inputs)} messages, {time.monotonic() - begin:.1f} s"
        )

    def replay_input(self, value: Message | ControlEvent) -> None:
        """Do what was done with what was heard."""
        if isinstance(value, ParameterChange):
            self.set_parameters([Parameter(value.name, value=json.loads(value.value))])
        elif not isinstance(value, ControlEvent):
            self.inbox.receive(value)

    def node_state(self) -> dict[str, object]:
        """{name: document} of what the node remembers beside its process."""
        return {}

    def restore_node_state(self, state: Path) -> None:
        """Take over what :meth:`node_state` gave.

        :param state: the folder in which it is.
        """

    @property
    def is_quiescent(self) -> bool:
        """Whether process and memory are all that there is."""
        return True

    def on_configuration_changed(self, configuration: Configuration) -> None:
        """Take note of new values, also for one that goes on where this node is killed."""
        before, now = as_flat(self.configuration), as_flat(configuration)
        super().on_configuration_changed(configuration)
        if not self.is_configured:
            return
        for name in now:
            if now[name] != before[name]:
                self.recovery.record_input(ParameterChange(name, json.dumps(now[name])))

    def deliver(self, message: Message) -> None:
        """Let the process handle a message and publish its answers."""
        if isinstance(message, TrackingReset) and not self._is_recovering and self.recovery.is_repeated_reset(message):
            return
        self.recovery.record_input(message)
        said: list[Message] = []
        begin = time.perf_counter()
        with self.diagnostics.measure(message, said):
            said += self.process.handle(message)
        self.recovery.add_busy_time(time.perf_counter() - begin)
        for answer in said:
            self._publish_output(answer)
        self.publish_views(message, said)
        if self._participant is not None:
            self._participant.on_delivered(message)
        self._write_due_checkpoint()

    def _publish_output(self, answer: Message) -> None:
        if isinstance(answer, RealTimePose) and not self.is_active:
            return  # neither of a moment that is over, nor of a node that takes no part
        self.outbox.send(answer)
        self.recovery.record_output(answer)
        self.diagnostics.sent[type(answer).__name__] += 1
        if isinstance(answer, Notice):
            self.diagnostics.warn(answer.text)

    def _write_due_checkpoint(self) -> None:
        """Write a checkpoint where one is due and the state is a whole."""
        events = self.inbox.events
        if not self.recovery.is_checkpoint_due or events is None or not self.is_quiescent:
            return
        base = JournalHeader(
            True,
            events,
            str(self.initial_state.folder or ""),
            False,
            0,
            self._reset_number,
            dict(self.diagnostics.received),
            dict(self.outbox.sent),
            self.recovery.stamps,
            self.recovery.tracking_reset,
        )
        begin = time.perf_counter()
        self.recovery.write_checkpoint(base, {self._name: self.process.state, **self.node_state()})
        self._checkpoint_count += 1
        self.diagnostics.values["checkpoints"] = (
            f"{self._checkpoint_count}, the last in {time.perf_counter() - begin:.3f} s"
        )

    @property
    def scans(self) -> int:
        """Scans that have a pose, as far as the node gives it."""
        return 0

    def poll_final_save(self) -> bool:
        """Whether the node's part of the last map is saved, and the others had time to hear of it.

        So that all come to the same keyframe event, an inactive node goes on for that.
        """
        if not self.is_configured:
            return True
        self.inbox.release()
        return self._participant is not None and self._participant.has_saved_final_part(_LINGER)

    def publish_views(self, _heard: Message, _said: list[Message]) -> None:
        """Publish what is for people to see; nothing, unless a node has something."""
