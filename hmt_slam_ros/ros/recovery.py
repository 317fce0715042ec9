"""Recovery of a node that was killed: from its last checkpoint and a journal of its inputs since.

A process is a value machine: the same state and the same inputs in the same order give the same result, bit for bit. So
a node writes every input to the journal before its process handles it, and at times the state of its process. Its
successor, of the same name and folder, starts with that state and handles the inputs again. What it sends again the
others recognize by sequence numbers. docs/decisions/0033-journal-recovery.md has the reasons.

Each value is a line of JSON that names its type. Arrays are in a file beside it, written before the line. An incomplete
last line is ignored. Nothing is flushed to the disk, since the system keeps what a killed process has written.
"""

from __future__ import annotations

import json
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from hmt_slam_ros.configuration.documents import ros_yaml
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.messages import Message, RealTimePose, TrackingReset
from hmt_slam_ros.plain_data import PlainDataReader, to_plain
from hmt_slam_ros.ros.lifecycle import ManagedNode
from hmt_slam_ros.saved_map.arrays import ArrayReader, ArrayWriter
from hmt_slam_ros.saved_map.folder import CONFIGURATION, VERSION, FolderWriter
from hmt_slam_ros.sensors import Odometry, Scan

_LINES, _ARRAYS = "jsonl", "bin"
_FORMAT_DOC = "docs/decisions/0033-journal-recovery.md"


class JournalEntry(NamedTuple):
    """A value in a journal with its role: header, output or input."""

    role: str
    value: object


class Journal:
    """Writer of a journal, the files ``<stem>.jsonl`` and ``<stem>.bin``.

    :ivar size: bytes written.
    """

    def __init__(self, folder: Path, stem: str) -> None:
        """Create the files.

        :raises OSError: where that fails.
        """
        self.size = 0
        self._lines = (folder / f"{stem}.{_LINES}").open("xb", buffering=0)
        self._bytes = (folder / f"{stem}.{_ARRAYS}").open("xb")
        self._arrays = ArrayWriter(self._bytes)

    def append(self, role: str, value: object) -> None:
        """Write a value.

        :raises OSError: where that fails.
        """
        content = to_plain(value, {np.ndarray: self._arrays.store})
        self._bytes.flush()
        entry = {"role": role, "kind": type(value).__name__, "value": content}
        line = json.dumps(entry, separators=(",", ":")).encode() + b"\n"
        if self._lines.write(line) != len(line):
            raise OSError(0, "the disk is full")
        self.size = self._bytes.tell() + self._lines.tell()

    def close(self) -> None:
        """Close the files."""
        self._lines.close()
        with suppress(OSError):  # a full disk refused bytes that no line refers to
            self._bytes.close()


def read_journal(folder: Path, stem: str, kinds: Mapping[str, type]) -> Iterator[JournalEntry]:
    """The values of a journal in their order.

    :param kinds: {name: type} of the allowed values.
    :raises HmtSlamError: where the journal is damaged.
    """
    arrays = ArrayReader((folder / f"{stem}.{_ARRAYS}").read_bytes())
    values = PlainDataReader(_FORMAT_DOC, {np.ndarray: arrays.reader})
    content = (folder / f"{stem}.{_LINES}").read_bytes()
    for number, line in enumerate(content.split(b"\n")[:-1]):
        path = f"{folder / stem}.{_LINES}[{number}]"
        try:
            entry = json.loads(line)
            role, kind = entry["role"], kinds[entry["kind"]]
        except (ValueError, KeyError) as fault:
            raise HmtSlamError(f"{path} is damaged ({fault}): remove {folder.parent}, and restart all nodes") from fault
        yield JournalEntry(role, values.read(entry["value"], kind, path))


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
_HEADER, _OUTPUT, _INPUT = "base", "said", "heard"
_STATE, _PARTIAL = "state", ".partial"


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
    inputs: list[Message | ControlEvent]
    was_active: bool | None


_JOURNAL_TYPES: dict[str, type] = {
    kind.__name__: kind for kind in (JournalHeader, *get_args(ControlEvent), *get_args(Message))
}


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
        entries = [e for number in range(self._segment) for e in read_journal(newest, str(number), _JOURNAL_TYPES)]
        header = entries[0].value
        assert isinstance(header, JournalHeader)
        self.stamps, self.tracking_reset = dict(header.stamps), header.tracking_reset
        for entry in entries:
            self._track(entry)
        inputs = [e.value for e in entries if e.role == _INPUT]
        activation = self._control_state.get((ActivationChange, ""))
        active = activation.active if isinstance(activation, ActivationChange) else None
        return RecoveredState(header, newest / _STATE, list(self._recent_outputs), inputs, active)  # type: ignore[arg-type]

    def _track(self, entry: JournalEntry) -> None:
        """Keep what the next generation starts with."""
        value = entry.value
        if isinstance(value, ControlEvent):
            self._control_state[type(value), _subject(value)] = value
        elif entry.role == _OUTPUT:
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
        entry = JournalEntry(_INPUT, value)
        self._track(entry)
        self._append(entry)

    def record_output(self, message: Message) -> None:
        """Keep an output to send it again, unless it is a pose by dead reckoning, which would be outdated."""
        if not isinstance(message, RealTimePose):
            self._recent_outputs.append(message)

    def add_busy_time(self, seconds: float) -> None:
        """Add to the computing time since the last checkpoint."""
        self._busy_seconds += seconds

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
        partial.mkdir(parents=True)
        write(partial)
        journal = Journal(partial, "0")
        journal.append(_HEADER, header)
        for event in self._control_state.values():
            journal.append(_INPUT, event)
        for message in self._recent_outputs:
            journal.append(_OUTPUT, message)
        partial.rename(complete)
        before, self._journal = self._journal, journal
        if before is not None:
            before.close()
        shutil.rmtree(self._folder / str(self._generation), ignore_errors=True)
        self._generation, self._segment = self._generation + 1, 1

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
