"""Node of a process: convert inputs, call the process once, publish outputs; with saves, resets and recovery."""

from __future__ import annotations

import json
import signal
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from rclpy.signals import uninstall_signal_handlers

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.flat import as_flat
from hmt_slam_ros.errors import EarlierSystemError, HmtSlamError
from hmt_slam_ros.messages.gate import ChainGate
from hmt_slam_ros.messages.messages import Message, Notice, RealTimePose, TrackingReset
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS
from hmt_slam_ros.messages.routing import SUBSCRIPTIONS, Checkpointable, message_types
from hmt_slam_ros.process_table import participant_names, process_row
from hmt_slam_ros.ros.execution import force_exit_after, lower_priority, spin_until
from hmt_slam_ros.ros.initial_state import InitialState, declare_start_from, declare_start_lost
from hmt_slam_ros.ros.journal import UnreadableInput
from hmt_slam_ros.ros.message_io import Inbox, Outbox
from hmt_slam_ros.ros.odometry_frames import OdometryFrames
from hmt_slam_ros.ros.publisher_monitor import PublisherMonitor
from hmt_slam_ros.ros.recovery import (
    ActivationChange,
    ControlEvent,
    JournalHeader,
    ParameterChange,
    RecoveredState,
    Recovery,
    declare_recovery,
)
from hmt_slam_ros.ros.request_participant import ParticipantNode, RequestParticipant
from hmt_slam_ros.sensors import MarkObservation, Odometry, Scan
from hmt_slam_ros.sensors.mark import check_mark
from hmt_slam_ros.sensors.plausibility import check_odometry, check_scan
from hmt_slam_ros.untrusted_input import shorten

SAVE_TIMEOUT = 8.0
"""Time for the last save, s: launch sends SIGTERM 5 s after SIGINT, and SIGKILL 5 s later."""
_LINGER = 0.5
"""Time from a node's part of the last save to its end, s, in which DDS delivers the response."""
_POLL = 0.05  # s
_MAX_REBUILDS, _REBUILD_WINDOW = 3, 60.0
"""Most rebuilds of a process within this many seconds."""
_SAVE_ON_SHUTDOWN = ParameterDescriptor(
    description="Whether all nodes save the map to save_to of slam when they are told to end.", read_only=True
)


class ProcessNode(ParticipantNode):
    """Node of a process of the process table, with the same name.

    :cvar is_always_listening: whether the process also gets messages while the node is inactive.
    :cvar team_types: classes of messages between robots, for which the node has subscriptions and writers of its own.
    :ivar odometry_frames: frames of the odometry, where the node needs them.
    :ivar save_on_shutdown: whether the map is saved before the node ends.
    :ivar process: the process, from :meth:`configure_node` on.
    :ivar reset_number: number of the last reset request that was answered, 0 before the first.
    :ivar is_recovering: whether the node handles inputs from the journal of a killed node.
    """

    is_always_listening = False
    team_types: tuple[type, ...] = ()
    odometry_frames: OdometryFrames | None = None
    save_on_shutdown = False

    def __init__(self, name: str) -> None:
        """Declare the parameters, and read what a killed node of the same name left."""
        self._name, self._output_types = name, (*message_types(process_row(name).produces), Notice)
        super().__init__(name)
        lower_priority(process_row(name).niceness)  # after DDS has started its threads

    def declare_own_parameters(self) -> None:
        """Declare the parameters of all processes.

        :raises HmtSlamError: where a journal is damaged.
        """
        self.save_on_shutdown = bool(self.declare_parameter("save_on_shutdown", False, _SAVE_ON_SHUTDOWN).value)
        self.start_from, self._start_lost = declare_start_from(self), declare_start_lost(self)
        self._recovery_folder = declare_recovery(self)
        self.recovery = Recovery(self, self._recovery_folder)

    def spin(self) -> None:
        """Run until the node is to end, and its part of the last map is saved where that is wanted.

        With ``save_on_shutdown`` rclpy's signal handlers are replaced, as they would end all communication at once.

        :raises HmtSlamError: where the node cannot start, or gives way to an earlier system.
        """
        self.enter_startup_states()
        has_ended = False
        try:
            if self.save_on_shutdown and rclpy.ok():
                self._spin_until_saved()
            else:
                spin_until(self)
            has_ended = True
        except EarlierSystemError:
            has_ended = True
            raise
        finally:
            if has_ended or not rclpy.ok():
                self.discard_recovery()

    def _spin_until_saved(self) -> None:
        first_signal = _FirstSignal()

        def is_done() -> bool:
            return first_signal.has_timed_out or (first_signal.received_at is not None and self.poll_final_save())

        try:
            spin_until(self, is_done)
        except EarlierSystemError:
            first_signal(signal.SIGINT, None)
            spin_until(self, is_done)
            raise

    @property
    def startup_states(self) -> tuple[bool, bool]:
        """As any managed node; after a kill those of the killed node."""
        recovered, (configure, activate) = self.recovery.recovered_state, super().startup_states
        if recovered is None:
            return configure, activate
        return True, activate if recovered.was_active is None else recovered.was_active

    @property
    def continues_killed_node(self) -> bool:
        """Whether the journal of a killed node was found."""
        return self.recovery.recovered_state is not None

    def configure_node(self) -> None:
        """Make the process, inbox and outbox.

        :raises HmtSlamError: for a map or journal that is damaged or does not match.
        """
        recovered = self.recovery.recovered_state
        self.reset_number, self._checkpoint_count, self.is_recovering = 0, 0, recovered is not None
        if recovered is None:
            self.initial_state = InitialState(self, self.start_from, lost=self._start_lost)
        else:
            self.initial_state = self._recovered_initial_state(recovered)
        self._replayed: list[Message | ControlEvent | UnreadableInput] = []
        self._rebuild_times: deque[float] = deque(maxlen=_MAX_REBUILDS)
        self.process = self._create_process(self.initial_state)
        if recovered is None:
            self._start_journal()
        self.outbox = Outbox(self, self._without_team(self._output_types), self.reset_number)
        self.inbox = Inbox(
            self,
            self._without_team(SUBSCRIPTIONS[self._name]),
            self.deliver,
            self.diagnostics,
            first_event=self.initial_state.events,
            reset_number=self.reset_number,
            resume_stamps=self.resume_stamps,
            gate=_gate(self.initial_state),
            odometry_frames=self.odometry_frames,
        )
        self._publisher_monitor = PublisherMonitor(self, self.diagnostics, self._name)
        self._participant = RequestParticipant(self, self._name) if self._name in participant_names() else None

    def _without_team(self, message_types: Sequence[type]) -> list[type]:
        return [kind for kind in message_types if kind not in self.team_types]

    def activate_node(self) -> None:
        """Deliver what has come, and all from now on."""
        self.recovery.record_input(ActivationChange(True))
        self.inbox.release()

    def deactivate_node(self) -> None:
        """Deliver nothing from now on, unless the process is always listening."""
        self.recovery.record_input(ActivationChange(False))
        if not self.is_always_listening:
            self.inbox.hold()
        if self._participant is not None:
            self._participant.answer_due_requests()

    def clean_up_node(self) -> None:
        """Forget all, also for recovery."""
        self.recovery.discard()
        self.recovery = Recovery(self, self._recovery_folder)

    def abandon_configuration(self) -> None:
        """As any managed node; what a killed node left stays for the next try."""
        super().abandon_configuration()
        if self.recovery.recovered_state is None:
            self.recovery.discard()

    def shut_down_node(self) -> None:
        """As any managed node, but after the last save, if one is wanted."""
        if not self.save_on_shutdown:
            self.tear_down()
            return
        begin = time.monotonic()

        def tear_down_if_saved() -> None:
            if self.poll_final_save() or time.monotonic() - begin > SAVE_TIMEOUT:
                self.tear_down()

        self.create_timer(_POLL, tear_down_if_saved, clock=self.diagnostics.steady_clock)

    def discard_recovery(self) -> None:
        """Remove journal and checkpoint, unless they are those of a killed node that was not recovered."""
        if self.is_configured:
            self.recovery.discard()

    def make_process(self, initial_state: InitialState) -> Checkpointable:
        """The process in an initial state.

        :raises HmtSlamError: where the map lacks the state of the process.
        """
        row = process_row(self._name)
        process: Checkpointable = row.make(self.configuration, initial_state.read_part(self._name, row.state_class))
        return process

    def _create_process(self, initial_state: InitialState) -> Checkpointable:
        process = self.make_process(initial_state)
        if initial_state.lost and TrackingReset in SUBSCRIPTIONS[self._name]:
            # The one that slam sends may come after this node's first output.
            process.handle(TrackingReset(initial_state.events, 0))
        return process

    def reset(self, folder: str, reset_number: int = 0) -> None:
        """As its requests need it; also start a new journal.

        :raises HmtSlamError: for a map that is damaged or does not match.
        """
        self.initial_state = InitialState(self, folder, lost=True, previous_scans=self.scans)
        self.process = self._create_process(self.initial_state)
        self.inbox.reset(self.initial_state.events, reset_number, _gate(self.initial_state))
        self.reset_number = self.outbox.reset_number = reset_number
        self._start_journal()

    def _start_journal(self) -> None:
        initial_state = self.initial_state
        self.recovery.start_journal(
            self._journal_header(
                events=initial_state.events, lost=initial_state.lost, previous_scans=initial_state.previous_scans
            )
        )

    def _journal_header(self, **fields: Any) -> JournalHeader:  # noqa: ANN401  of the header
        return JournalHeader(
            folder=str(self.initial_state.folder or ""),
            reset_number=self.reset_number,
            received=dict(self.diagnostics.received),
            stamps=self.recovery.stamps,
            **fields,
        )

    def _recovered_initial_state(self, recovered: RecoveredState) -> InitialState:
        self.reset_number = recovered.header.reset_number
        self.diagnostics.received.update(recovered.header.received)
        return self._journal_initial_state(recovered)

    def _journal_initial_state(self, recovered: RecoveredState) -> InitialState:
        """State of the process at the start of a journal."""
        header = recovered.header
        if header.has_checkpoint:
            return InitialState.from_checkpoint(self, recovered.checkpoint_folder, header)
        return InitialState(self, header.folder, lost=header.lost, previous_scans=header.previous_scans)

    @property
    def resume_stamps(self) -> Mapping[str, int]:
        """{measurement type: stamp, ns} after which past measurements are wanted too; empty for new ones alone."""
        return {}

    def _configure(self) -> None:
        """As any managed node; then recover the state of a killed node."""
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
            try:
                self.replay_input(_checked_input(value))
            except HmtSlamError as fault:
                self.diagnostics.refuse("the journal", fault)
                self.recovery.require_checkpoint()
        self.is_recovering = False
        self._replayed.clear()
        self.recovery.resume_journal()
        self._write_due_checkpoint()
        self.get_logger().warning(
            f"{self._name} was killed and goes on where it was: at keyframe event {recovered.header.events} and "
            f"{len(recovered.inputs)} messages, {time.monotonic() - begin:.1f} s"
        )

    def replay_input(self, value: Message | ControlEvent) -> None:
        """Handle an input from the journal."""
        if isinstance(value, ParameterChange):
            self._replayed.append(value)
            self.set_parameters([Parameter(value.name, value=json.loads(value.value))])
        elif not isinstance(value, ControlEvent):
            self.inbox.receive(value)

    def node_state(self) -> dict[str, object]:
        """{name: document} of what the node remembers beside its process."""
        return {}

    def restore_node_state(self, folder: Path) -> None:
        """Restore :meth:`node_state` from the folder of a checkpoint."""

    @property
    def is_quiescent(self) -> bool:
        """Whether the state of the process and :meth:`node_state` are the whole state of the node."""
        return True

    def on_configuration_changed(self, configuration: Configuration) -> None:
        """Apply and record new values of parameters."""
        before, now = as_flat(self.configuration), as_flat(configuration)
        super().on_configuration_changed(configuration)
        if not self.is_configured:
            return
        for name in now:
            if now[name] != before[name]:
                self.recovery.record_input(ParameterChange(name, json.dumps(now[name])))

    def deliver(self, message: Message) -> None:
        """Let the process handle a message, and publish its outputs."""
        if isinstance(message, TrackingReset) and not self.is_recovering and self.recovery.is_repeated_reset(message):
            return
        self.recovery.record_input(message)
        if not self.compute(message, lambda: self.process.handle(message)):
            return
        if self.is_recovering:
            self._replayed.append(message)
        if self._participant is not None:
            self._participant.on_delivered(message)
        self._write_due_checkpoint()

    def compute(self, message: Message, work: Callable[[], list[Message]]) -> bool:
        """Do work of the process, and publish its outputs.

        :param message: the last input, which is set aside where the work fails.
        :param work: returns the outputs.
        :returns: whether it did not fail.
        """
        outputs: list[Message] = []
        begin = time.perf_counter()
        try:
            with self.diagnostics.measure(message, outputs):
                outputs += work()
        except Exception as fault:
            self._set_aside(message, fault)
            return False
        self.recovery.add_busy_time(time.perf_counter() - begin)
        self._publish_all(message, outputs)
        return True

    def _publish_all(self, message: Message, outputs: list[Message]) -> None:
        """Publish outputs and views; a fault in that changes nothing in the process."""
        try:
            for output in outputs:
                self.inbox.gate.note(output)
                self._publish_output(output)
            self.publish_views(message, outputs)
        except ExternalShutdownException:
            raise
        except Exception as fault:
            if not rclpy.ok():
                raise
            self.get_logger().error("".join(traceback.format_exception(fault)))
            self.diagnostics.warn(
                f"{self._name} could not publish all that follows from a {type(message).__name__} "
                f"({shorten(repr(fault))}): report the fault with the log"
            )

    def _set_aside(self, message: Message, fault: Exception) -> None:
        """Go on without a message that the process could not handle: rebuild the process as it was before it."""
        kind = type(message).__name__
        kept = self.recovery.quarantine(message)
        self.get_logger().error("".join(traceback.format_exception(fault)))
        self.diagnostics.count_refused(f"{kind}, set aside")
        self.diagnostics.warn(
            f"{self._name} could not handle a {kind} ({shorten(repr(fault))}) and goes on without it: report the fault "
            f"with {kept or 'the log'}"
        )
        try:
            recovered = self.recovery.recovered_state if self.is_recovering else self.recovery.withdraw_input()
            if recovered is not None:
                self._check_rebuild_budget()
                self.process = self._rebuilt_process(recovered, self._replayed if self.is_recovering else None)
        except Exception as error:
            self.diagnostics.warn(
                f"{self._name} could not be rebuilt ({shorten(repr(error))}) and goes on as it is: restart all nodes"
            )
        self.recovery.require_checkpoint()
        self.inbox.withdraw(message)

    def _check_rebuild_budget(self) -> None:
        """Count a rebuild, which takes as long as all since the last checkpoint.

        :raises HmtSlamError: where there were too many lately.
        """
        now = time.monotonic()
        if len(self._rebuild_times) == _MAX_REBUILDS and now - self._rebuild_times[0] < _REBUILD_WINDOW:
            raise HmtSlamError(f"{_MAX_REBUILDS} rebuilds within {_REBUILD_WINDOW:g} s are the most")
        self._rebuild_times.append(now)

    def _rebuilt_process(
        self, recovered: RecoveredState, inputs: Sequence[Message | ControlEvent | UnreadableInput] | None
    ) -> Checkpointable:
        """The process after some inputs; its outputs were published before.

        :param inputs: None for those of the journal.
        """
        process = self._create_process(self._journal_initial_state(recovered))
        for value in recovered.inputs if inputs is None else inputs:
            if isinstance(value, ParameterChange) and hasattr(process, value.name):
                setattr(process, value.name, json.loads(value.value))
            elif not isinstance(value, ControlEvent | UnreadableInput):
                process.handle(value)
        return process

    def _publish_output(self, output: Message) -> None:
        if isinstance(output, RealTimePose) and not self.is_active:
            return
        self.outbox.send(output)
        self.recovery.record_output(output)
        self.diagnostics.sent[type(output).__name__] += 1
        if isinstance(output, Notice):
            self.diagnostics.warn(output.text)

    def _write_due_checkpoint(self) -> None:
        """Write a checkpoint where one is due, between keyframe events of a quiescent node."""
        events = self.inbox.order.events
        if not self.recovery.is_checkpoint_due or events is None or not self.is_quiescent:
            return
        header = self._journal_header(
            has_checkpoint=True,
            events=events,
            sent=dict(self.outbox.sent),
            tracking_reset=self.recovery.tracking_reset,
        )
        begin = time.perf_counter()
        self.recovery.write_checkpoint(header, {self._name: self.process.state, **self.node_state()})
        self._checkpoint_count += 1
        self.diagnostics.values["checkpoints"] = (
            f"{self._checkpoint_count}, the last in {time.perf_counter() - begin:.3f} s"
        )

    @property
    def scans(self) -> int:
        """Number of scans with a pose, where the node gives them one."""
        return 0

    def poll_final_save(self) -> bool:
        """Whether the node's part of the last map is saved, and its response delivered.

        An inactive node takes messages again for that, so that all nodes reach the same keyframe event.
        """
        if not self.is_configured:
            return True
        self.inbox.release()
        return self._participant is not None and self._participant.has_saved_final_part(_LINGER)

    def publish_views(self, message: Message, outputs: list[Message]) -> None:
        """Publish what people see after a message and its outputs; by default nothing."""


def _gate(initial_state: InitialState) -> ChainGate:
    """The gate of a process in an initial state; the hypotheses of a map or checkpoint are not known to it."""
    return ChainGate(None if initial_state.events else (FIRST_HYPOTHESIS,))


def _checked_input(value: Message | ControlEvent | UnreadableInput) -> Message | ControlEvent:
    """An input of a journal.

    :raises HmtSlamError: where it could not be read, or is a measurement that is none.
    """
    if isinstance(value, UnreadableInput):
        raise HmtSlamError(value.fault)
    if isinstance(value, Scan):
        check_scan(value)
    elif isinstance(value, Odometry):
        check_odometry(value)
    elif isinstance(value, MarkObservation):
        check_mark(value)
    return value


class _FirstSignal:
    """Handler of SIGINT and SIGTERM in place of rclpy's; later signals are ignored.

    :ivar received_at: time of the first signal by the monotonic clock, s, None before.
    """

    def __init__(self) -> None:
        self.received_at: float | None = None
        uninstall_signal_handlers()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self)

    @property
    def has_timed_out(self) -> bool:
        """Whether the time for the last save is over."""
        return self.received_at is not None and time.monotonic() - self.received_at > SAVE_TIMEOUT

    def __call__(self, _number: int, _frame: object) -> None:
        if self.received_at is None:
            self.received_at = time.monotonic()
            force_exit_after(SAVE_TIMEOUT + 1.0, 0)
