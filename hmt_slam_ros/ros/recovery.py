"""Recovery of a node that was killed: from its last checkpoint and a journal of its inputs since.

A process is a value machine: the same state and the same inputs in the same order give the same result, bit for bit. So
a node writes every input to the journal before its process handles it, and at times the state of its process. Its
successor, of the same name and folder, starts with that state and handles the inputs again. What it sends again the
others recognize by sequence numbers. docs/decisions/0033-journal-recovery.md has the reasons.
"""

from __future__ import annotations

import math
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from hmt_slam_ros.configuration.documents import ros_yaml
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.messages import Message, RealTimePose, TrackingReset
from hmt_slam_ros.messages.team import TeamMessage
from hmt_slam_ros.ros.journal import (
    HEADER,
    INPUT,
    LINES,
    OUTPUT,
    Journal,
    JournalEntry,
    UnreadableInput,
    is_in_use,
    read_journal,
)
from hmt_slam_ros.ros.lifecycle import ManagedNode
from hmt_slam_ros.saved_map.folder import CONFIGURATION, VERSION, FolderWriter
from hmt_slam_ros.sensors import Odometry, Scan

CHECKPOINT = "hmt_checkpoint"
"""Format of the folder of a checkpoint."""

_CHECKPOINT_RATIO = 20.0
"""Computing time in a journal, in durations of the last checkpoint, after which one is due.

It bounds the cost of checkpoints, and the time that a successor takes to catch up.
"""
_FIRST_CHECKPOINT_SECONDS = 0.05
"""Assumed duration of the first checkpoint, s."""
_MAX_JOURNAL_SIZE = 64_000_000
"""Size of a journal above which a checkpoint is due, bytes; for a robot that stands still."""
_RESENT_MESSAGES = 64
"""Outputs that are sent again, as they may not have reached the others; more than DDS has under way at any time."""
_NOT_RESENT = (RealTimePose, *get_args(TeamMessage))
"""Poses by dead reckoning, and messages between robots."""
_STATE, _PARTIAL = "state", ".partial"
_QUARANTINE = ".quarantine"
"""Suffix of the folder with the messages that a process could not handle."""
_MAX_QUARANTINED = 100
"""Messages that are kept there; more are only counted."""


@dataclass(frozen=True, eq=False)
class JournalHeader:
    """A node at the start of a journal.

    :ivar has_checkpoint: whether a checkpoint is beside the journal; else the process started from ``folder``.
    :ivar events: number of complete keyframe events.
    :ivar folder: of the map that the node started from, empty without.
    :ivar lost: whether the robot may be anywhere in that map.
    :ivar previous_scans: number of scans with a pose before.
    :ivar reset_number: number of the last reset request that was answered.
    :ivar received: {message type: number received}.
    :ivar sent: {message type: number sent}, as in ``Outbox.sent``.
    :ivar stamps: {measurement type: stamp of the last one received, ns}.
    :ivar tracking_reset: the last one received, if any.
    """

    has_checkpoint: bool = False
    events: int = 0
    folder: str = ""
    lost: bool = False
    previous_scans: int = 0
    reset_number: int = 0
    received: Mapping[str, int] = field(default_factory=dict)
    sent: Mapping[str, int] = field(default_factory=dict)
    stamps: Mapping[str, int] = field(default_factory=dict)
    tracking_reset: TrackingReset | None = None


@dataclass(frozen=True)
class ParameterChange:
    """A parameter was changed; ``value`` is JSON."""

    name: str
    value: str


@dataclass(frozen=True)
class PauseChange:
    """Slam was paused or resumed."""

    paused: bool


@dataclass(frozen=True)
class ActivationChange:
    """The node was activated or deactivated."""

    active: bool


@dataclass(frozen=True, eq=False)
class FrameMounting:
    """The pose of a laser on the robot was received.

    :ivar frame: of its scans.
    :ivar laser_pose: ``base_T_laser`` (3,), (x, y, theta) in m and rad.
    :ivar angle_sign: 1.0, or -1.0 for a laser mounted upside down.
    """

    frame: str
    laser_pose: NDArray[np.float64]
    angle_sign: float


@dataclass(frozen=True)
class Withdrawal:
    """The input before this one is withdrawn: its process could not handle it."""


ControlEvent = ParameterChange | PauseChange | ActivationChange | FrameMounting
"""An input beside messages, which holds until the next one of its kind."""


@dataclass(frozen=True, eq=False)
class RecoveredState:
    """State of a node of the same name that was killed.

    :ivar header: of the journal.
    :ivar checkpoint_folder: folder of the checkpoint.
    :ivar outputs: the last ones before the journal.
    :ivar inputs: the journal's, in their order.
    :ivar was_active: whether the node was active when it was killed, None before the first lifecycle transition.
    """

    header: JournalHeader
    checkpoint_folder: Path
    outputs: list[Message]
    inputs: list[Message | ControlEvent | UnreadableInput]
    was_active: bool | None


_JOURNAL_TYPES: dict[str, type] = {
    kind.__name__: kind for kind in (JournalHeader, Withdrawal, *get_args(ControlEvent), *get_args(Message))
}


def _read_generation(folder: Path) -> tuple[JournalHeader, list[JournalEntry]]:
    """The header and all entries of a generation.

    :raises HmtSlamError: where a journal is damaged.
    """
    segments = len(list(folder.glob(f"*.{LINES}")))
    entries = [entry for number in range(segments) for entry in read_journal(folder, str(number), _JOURNAL_TYPES)]
    if not entries or not isinstance(entries[0].value, JournalHeader):
        raise HmtSlamError(f"{folder} has no journal: remove {folder.parent}, and restart all nodes")
    return entries[0].value, entries


def _valid_inputs(entries: Iterable[JournalEntry]) -> list[Message | ControlEvent | UnreadableInput]:
    """The inputs that were not withdrawn, in their order."""
    inputs: list[Message | ControlEvent | UnreadableInput] = []
    for entry in entries:
        if isinstance(entry.value, Withdrawal):
            del inputs[-1:]
        elif entry.role == INPUT:
            inputs.append(entry.value)  # type: ignore[arg-type]
    return inputs


def _subject(event: ControlEvent) -> str:
    """Parameter or frame of a control event, empty for the node itself."""
    if isinstance(event, ParameterChange):
        return event.name
    return event.frame if isinstance(event, FrameMounting) else ""


class Recovery:
    """Checkpoints and journal of a node; none where the parameter ``recovery`` is not set.

    A generation is a folder with a journal and mostly the checkpoint before it. It gets its final name when it is
    complete; the newest such one counts.

    :ivar recovered_state: state of a node of the same name that was killed, None without.
    :ivar stamps: {measurement type: stamp of the last one received, ns}.
    :ivar tracking_reset: the last one received, None without.
    """

    def __init__(self, node: ManagedNode, folder: str) -> None:
        """Read what a killed node left.

        :param folder: of all nodes, empty for none.
        :raises HmtSlamError: where a journal is damaged.
        """
        self._node = node
        name = node.get_fully_qualified_name().strip("/").replace("/", ".")
        self._folder = Path(folder).absolute() / name if folder else None
        self._generation = self._segment = 0
        self._journal: Journal | None = None
        self._recent_outputs: deque[Message] = deque(maxlen=_RESENT_MESSAGES)
        self._control_state: dict[tuple[type, str], ControlEvent] = {}
        self.stamps: dict[str, int] = {}
        self.tracking_reset: TrackingReset | None = None
        self._checkpoint_seconds, self._busy_seconds = _FIRST_CHECKPOINT_SECONDS, 0.0
        self.recovered_state = None if self._folder is None else self._read_recovered_state(self._folder)

    def _read_recovered_state(self, folder: Path) -> RecoveredState | None:
        folders = {int(path.name): path for path in folder.glob("*") if path.name.isdecimal()}
        if not folders:
            return None
        self._generation = max(folders)
        newest = folders[self._generation]
        self._segment = len(list(newest.glob("*.jsonl")))
        if any(is_in_use(path) for path in newest.glob(f"*.{LINES}")):
            raise HmtSlamError(f"{folder} is in use by another node: give each system a folder recovery of its own")
        header, entries = _read_generation(newest)
        self.stamps, self.tracking_reset = dict(header.stamps), header.tracking_reset
        for entry in entries:
            self._track(entry)
        inputs = _valid_inputs(entries)
        activation = self._control_state.get((ActivationChange, ""))
        active = activation.active if isinstance(activation, ActivationChange) else None
        return RecoveredState(header, newest / _STATE, list(self._recent_outputs), inputs, active)

    def withdraw_input(self) -> RecoveredState | None:
        """Withdraw the last input from the journal; return what the process stood on before it, None without a journal.

        :raises HmtSlamError: where the journal is damaged.
        """
        self._append(JournalEntry(INPUT, Withdrawal()))
        if self._journal is None or self._folder is None:
            return None
        newest = self._folder / str(self._generation)
        header, entries = _read_generation(newest)
        return RecoveredState(header, newest / _STATE, [], _valid_inputs(entries), None)

    def quarantine(self, message: Message) -> str:
        """Keep a message that its process could not handle; return where, empty where it is not kept.

        Beside the folder of the journal is one that stays after the end of the node.
        """
        if self._folder is None:
            return ""
        folder = self._folder.with_name(f"{self._folder.name}{_QUARANTINE}")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            number = len(list(folder.glob(f"*.{LINES}")))
            if number >= _MAX_QUARANTINED:
                return ""
            journal = Journal(folder, f"{number}-{type(message).__name__}")
            journal.append(INPUT, message)
            journal.close()
        except OSError:  # a full disk, or a name that is taken
            return ""
        return str(folder / f"{number}-{type(message).__name__}.{LINES}")

    def _track(self, entry: JournalEntry) -> None:
        """Keep what the next generation starts with."""
        value = entry.value
        if isinstance(value, ControlEvent):
            self._control_state[type(value), _subject(value)] = value
        elif entry.role == OUTPUT:
            self._recent_outputs.append(value)  # type: ignore[arg-type]
        elif isinstance(value, TrackingReset):
            self.tracking_reset = value
        elif isinstance(value, Scan | Odometry):
            self.stamps[type(value).__name__] = value.stamp

    def is_repeated_reset(self, tracking_reset: TrackingReset) -> bool:
        """Whether this one was received before: a killed slam sends it again, and so does DDS to a killed node."""
        last = self.tracking_reset
        return last is not None and (tracking_reset.scans_before, tracking_reset.event) <= (
            last.scans_before,
            last.event,
        )

    def record_input(self, value: Message | ControlEvent) -> None:
        """Write an input to the journal, before it is handled."""
        entry = JournalEntry(INPUT, value)
        self._track(entry)
        self._append(entry)

    def record_output(self, message: Message) -> None:
        """Keep an output to send it again, unless it would be outdated or is requested where it was lost."""
        if not isinstance(message, _NOT_RESENT):
            self._recent_outputs.append(message)

    def add_busy_time(self, seconds: float) -> None:
        """Add to the computing time since the last checkpoint."""
        self._busy_seconds += seconds

    def require_checkpoint(self) -> None:
        """Let a checkpoint be due, so that no successor meets the inputs of the journal again."""
        self._busy_seconds = math.inf

    @property
    def is_checkpoint_due(self) -> bool:
        """Whether a checkpoint is worth its cost."""
        return self._journal is not None and (
            self._busy_seconds > _CHECKPOINT_RATIO * self._checkpoint_seconds or self._journal.size > _MAX_JOURNAL_SIZE
        )

    def start_journal(self, header: JournalHeader) -> None:
        """Start a journal without a checkpoint, and forget earlier outputs."""
        self._recent_outputs.clear()
        self.tracking_reset = None
        try:
            self._start_generation(header, lambda _: None)
        except OSError as fault:
            self._disable(fault)

    def write_checkpoint(self, header: JournalHeader, documents: Mapping[str, object]) -> None:
        """Write a checkpoint, and start a new journal.

        :param header: of the journal.
        :param documents: {name: value}, the state of the node.
        """
        begin = time.perf_counter()

        def write(folder: Path) -> None:
            writer = FolderWriter(folder / _STATE)
            for name, document in documents.items():
                writer.write(name, document)
            writer.write_text(CONFIGURATION, ros_yaml(self._node.configuration))
            writer.finish(CHECKPOINT, VERSION)

        with suppress(OSError):  # the old journal goes on, and reports a full disk itself
            self._start_generation(header, write)
        self._checkpoint_seconds, self._busy_seconds = time.perf_counter() - begin, 0.0

    def resume_journal(self) -> None:
        """Continue the journal of the killed node."""
        assert self._folder is not None
        newest = self._folder / str(self._generation)
        for other in self._folder.iterdir():
            if other != newest:
                shutil.rmtree(other, ignore_errors=True)
        try:
            self._journal = Journal(newest, str(self._segment))
        except OSError as fault:
            self._disable(fault)

    def discard(self) -> None:
        """Remove journal and checkpoint, as the node ends in good order."""
        if self._journal is not None:
            self._journal.close()
            self._journal = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _start_generation(self, header: JournalHeader, write: Callable[[Path], None]) -> None:
        """Start the next generation, and remove the one before.

        :raises OSError: where that fails; the one before is kept.
        """
        if self._folder is None:
            return
        complete = self._folder / str(self._generation + 1)
        partial = complete.with_suffix(_PARTIAL)
        shutil.rmtree(partial, ignore_errors=True)
        try:
            journal = self._write_generation(partial, header, write)
            partial.rename(complete)
        except OSError:
            shutil.rmtree(partial, ignore_errors=True)
            raise
        before, self._journal = self._journal, journal
        if before is not None:
            before.close()
        shutil.rmtree(self._folder / str(self._generation), ignore_errors=True)
        self._generation, self._segment = self._generation + 1, 1

    def _write_generation(self, folder: Path, header: JournalHeader, write: Callable[[Path], None]) -> Journal:
        """Write a checkpoint and the beginning of a journal into a new folder.

        :raises OSError: where that fails.
        """
        folder.mkdir(parents=True)
        write(folder)
        journal = Journal(folder, "0")
        try:
            journal.append(HEADER, header)
            for event in self._control_state.values():
                journal.append(INPUT, event)
            for message in self._recent_outputs:
                journal.append(OUTPUT, message)
        except OSError:
            journal.close()
            raise
        return journal

    def _append(self, entry: JournalEntry) -> None:
        if self._journal is None:
            return
        try:
            self._journal.append(*entry)
        except OSError as fault:
            self._disable(fault)

    def _disable(self, fault: OSError) -> None:
        """Continue without recovery, since the journal would have a gap."""
        self.discard()
        self._node.diagnostics.warn(
            f"{self._folder} cannot be written ({fault.strerror}): the node goes on, but if it is killed all have to "
            "be restarted; make room there, or set recovery to another folder"
        )


def declare_recovery(node: Node) -> str:
    """Declare ``recovery``, and return the folder, empty for none."""
    descriptor = ParameterDescriptor(
        description="Folder in which the node keeps what another one of its name needs to go on where it was killed; "
        "empty for none.",
        read_only=True,
    )
    return str(node.declare_parameter("recovery", "", descriptor).value)
