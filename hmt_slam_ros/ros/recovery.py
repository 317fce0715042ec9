"""How a node that was killed goes on: from its last checkpoint, with what it heard since.

Each value is a line of JSON that names its type; arrays are in a file beside it, written before the line. A line that
was not written to its end, as the process was killed, is no line. Nothing is flushed to the disk itself: a process that
is killed takes nothing with it that the system has taken over.

A process is a value machine: from the same state and the same messages in the same order it goes on to the same bit. So
a node writes down every message before its process hears it, and now and then the state of its process. Another node of
the same name and folder begins with that state, hears the messages again and says what it said again, which the others
recognize by its numbers. docs/decisions/0033-journal-recovery.md has the reasons.
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
    """A value in a journal.

    :ivar role: what it is there for.
    :ivar value: itself.
    """

    role: str
    value: object


class Journal:
    """A journal that is written, a pair of files ``<stem>.jsonl`` and ``<stem>.bin``.

    :ivar size: bytes written.
    """

    def __init__(self, folder: Path, stem: str) -> None:
        """Begin it.

        :raises OSError: where it cannot be written.
        """
        self.size = 0
        self._lines = (folder / f"{stem}.{_LINES}").open("xb", buffering=0)
        self._bytes = (folder / f"{stem}.{_ARRAYS}").open("xb")
        self._arrays = ArrayWriter(self._bytes)

    def append(self, role: str, value: object) -> None:
        """Write a value.

        :raises OSError: where it cannot be written.
        """
        content = to_plain(value, {np.ndarray: self._arrays.store})
        self._bytes.flush()
        entry = {"role": role, "kind": type(value).__name__, "value": content}
        line = json.dumps(entry, separators=(",", ":")).encode() + b"\n"
        if self._lines.write(line) != len(line):
            raise OSError(0, "the disk is full")
        self.size = self._bytes.tell() + self._lines.tell()

    def close(self) -> None:
        """Write nothing more."""
        self._lines.close()
        with suppress(OSError):  # what a full disk did not take, of which there is no line either
            self._bytes.close()


def read_journal(folder: Path, stem: str, kinds: Mapping[str, type]) -> Iterator[JournalEntry]:
    """The values of a journal in their order.

    :param kinds: {name: type} of those that it may hold.
    :raises HmtSlamError: where it holds something else.
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
"""The format of the folder of a checkpoint."""

# A checkpoint is due when the node computed this many times as long as the last one took, which bounds what checkpoints
# cost, and how long another node takes to catch up.
_CHECKPOINT_RATIO = 20.0
_FIRST_COST = 0.05  # s, before one was written
_LARGEST = 64_000_000  # bytes of a journal, for a robot that stands still
# What the node said last may not have reached the others when it was killed: it is said again. More than DDS has under
# way at any time.
_RESENT_MESSAGES = 64
_HEADER, _OUTPUT, _INPUT = "base", "said", "heard"
_STATE, _PARTIAL = "state", ".partial"


@dataclass(frozen=True, eq=False)
class JournalHeader:
    """What a node was when its journal began.

    :ivar has_checkpoint: whether its state is beside the journal; else the process began with ``folder``.
    :ivar events: keyframe events that it had heard to the end.
    :ivar folder: of the map that it began with, empty without.
    :ivar lost: whether the robot may be anywhere in that.
    :ivar previous_scans: scans that had a pose before.
    :ivar reset_number: number of the last request to begin anew that it answered.
    :ivar received: {kind of message: how many it heard}.
    :ivar sent: {kind of message: how many it said}, of those that are counted for the others.
    :ivar stamps: {kind of measurement: stamp of the last one that it heard, ns}.
    :ivar tracking_reset: the last such message that it heard, if any.
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
    """A parameter that was changed while the node ran.

    :ivar name: of the parameter.
    :ivar value: the new one, in YAML.
    """

    name: str
    value: str


@dataclass(frozen=True)
class PauseChange:
    """Slam was told to pass scans over, or to go on.

    :ivar paused: whether it passes them over.
    """

    paused: bool


@dataclass(frozen=True)
class ActivationChange:
    """The node was activated, or deactivated.

    :ivar active: whether it takes part.
    """

    active: bool


@dataclass(frozen=True, eq=False)
class FrameMounting:
    """Slam heard where a laser is on the robot.

    :ivar frame: of the frame of its scans.
    :ivar laser_pose: shape (3,), ``base_T_laser`` as (x, y, theta) in m and rad.
    :ivar angle_sign: 1.0, or -1.0 for a laser mounted upside down.
    """

    frame: str
    laser_pose: NDArray[np.float64]
    angle_sign: float


# What a node is told beside messages, and knows until it is told otherwise.
ControlEvent = ParameterChange | PauseChange | ActivationChange | FrameMounting


@dataclass(frozen=True, eq=False)
class RecoveredState:
    """What a node of the same name left behind.

    :ivar header: what it was when its journal began.
    :ivar checkpoint_folder: the folder of its checkpoint.
    :ivar outputs: what it said last before that.
    :ivar inputs: what it heard since, in its order.
    :ivar was_active: whether it took part when it was killed, None where nobody had told it so far.
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
    """What a control event is about: the parameter, the frame, or the node itself."""
    if isinstance(event, ParameterChange):
        return event.name
    return event.frame if isinstance(event, FrameMounting) else ""


class Recovery:
    """Checkpoints and journal of a node; nothing where the parameter ``recovery`` is not set.

    A generation is a folder with a journal and mostly the checkpoint that it goes on from. The newest one that is
    complete counts; it gets its name when it is.

    :ivar recovered_state: what a node of the same name left behind, None where this one is the first.
    """

    def __init__(self, node: ManagedNode, folder: str) -> None:
        """Look for what was left behind.

        :param folder: of all nodes, empty for none.
        :raises HmtSlamError: where it is damaged.
        """
        self._node = node
        name = node.get_fully_qualified_name().strip("/").replace("/", ".")
        self._folder = Path(folder).absolute() / name if folder else None
        self._generation = self._segment = 0
        self._journal: Journal | None = None
        self._recent_outputs: deque[Message] = deque(maxlen=_RESENT_MESSAGES)
        self._control_state: dict[tuple[type, str], ControlEvent] = {}
        self._stamps: dict[str, int] = {}
        self._tracking_reset: TrackingReset | None = None
        self._checkpoint_seconds, self._busy_seconds = _FIRST_COST, 0.0
        self.recovered_state = None if self._folder is None else self._read_recovered_state(self._folder)

    def _read_recovered_state(self, folder: Path) -> RecoveredState | None:
        folders = {int(path.name): path for path in folder.glob("*") if path.name.isdecimal()}
        if not folders:
            return None
        self._generation = max(folders)
        newest = folders[self._generation]
        self._segment = len(list(newest.glob("*.jsonl")))
        entries = [e for number in range(self._segment) for e in read_journal(newest, str(number), _JOURNAL_TYPES)]
        base = entries[0].value
        assert isinstance(base, JournalHeader)
        self._stamps, self._tracking_reset = dict(base.stamps), base.tracking_reset
        for entry in entries:
            self._track(entry)
        heard = [e.value for e in entries if e.role == _INPUT]
        told = self._control_state.get((ActivationChange, ""))
        active = told.active if isinstance(told, ActivationChange) else None
        return RecoveredState(base, newest / _STATE, list(self._recent_outputs), heard, active)  # type: ignore[arg-type]

    def _track(self, entry: JournalEntry) -> None:
        """Keep what the next generation begins with."""
        value = entry.value
        if isinstance(value, ControlEvent):
            self._control_state[type(value), _subject(value)] = value
        elif entry.role == _OUTPUT:
            self._recent_outputs.append(value)  # type: ignore[arg-type]
        elif isinstance(value, TrackingReset):
            self._tracking_reset = value
        elif isinstance(value, Scan | Odometry):
            self._stamps[type(value).__name__] = value.stamp

    @property
    def stamps(self) -> Mapping[str, int]:
        """{kind of measurement: stamp of the last one that was heard, ns}."""
        return dict(self._stamps)

    @property
    def tracking_reset(self) -> TrackingReset | None:
        """The last such message that was heard, if any."""
        return self._tracking_reset

    def is_repeated_reset(self, tracking_reset: TrackingReset) -> bool:
        """Whether the robot arrived so before: slam says it again when it was killed, and DDS when this node was."""
        last = self._tracking_reset
        return last is not None and (tracking_reset.scans_before, tracking_reset.event) <= (
            last.scans_before,
            last.event,
        )

    def record_input(self, value: Message | ControlEvent) -> None:
        """Write down what the process is about to hear."""
        entry = JournalEntry(_INPUT, value)
        self._track(entry)
        self._append(entry)

    def record_output(self, message: Message) -> None:
        """Keep what the process says; a pose by dead reckoning is past when it is said again."""
        if not isinstance(message, RealTimePose):
            self._recent_outputs.append(message)

    def add_busy_time(self, seconds: float) -> None:
        """Count the time of computing."""
        self._busy_seconds += seconds

    @property
    def is_checkpoint_due(self) -> bool:
        """Whether a checkpoint is worth what it costs."""
        return self._journal is not None and (
            self._busy_seconds > _CHECKPOINT_RATIO * self._checkpoint_seconds or self._journal.size > _LARGEST
        )

    def start_journal(self, header: JournalHeader) -> None:
        """Begin a journal without a checkpoint; what was heard and said before is of no use any more."""
        self._recent_outputs.clear()
        self._tracking_reset = None
        try:
            self._start_generation(header, lambda _: None)
        except OSError as fault:
            self._disable(fault)

    def write_checkpoint(self, header: JournalHeader, documents: Mapping[str, object]) -> None:
        """Write the state of the node and go on with a new journal.

        :param documents: {name: value} of which the state consists.
        """
        begin = time.perf_counter()

        def write(folder: Path) -> None:
            writer = FolderWriter(folder / _STATE)
            for name, document in documents.items():
                writer.write(name, document)
            writer.write_text(CONFIGURATION, ros_yaml(self._node.configuration))
            writer.finish(CHECKPOINT, VERSION)

        with suppress(OSError):  # the journal goes on; where there is no room for that either, it tells
            self._start_generation(header, write)
        self._checkpoint_seconds, self._busy_seconds = time.perf_counter() - begin, 0.0

    def resume_journal(self) -> None:
        """Go on with the journal that was found."""
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
        """Leave nothing behind, as the node ends in good order."""
        if self._journal is not None:
            self._journal.close()
            self._journal = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _start_generation(self, base: JournalHeader, write: Callable[[Path], None]) -> None:
        """Begin the next generation, and remove the one before.

        :raises OSError: where it cannot be written; the one before is as it was.
        """
        if self._folder is None:
            return
        made = self._folder / str(self._generation + 1)
        partial = made.with_suffix(_PARTIAL)
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        write(partial)
        journal = Journal(partial, "0")
        journal.append(_HEADER, base)
        for told in self._control_state.values():
            journal.append(_INPUT, told)
        for message in self._recent_outputs:
            journal.append(_OUTPUT, message)
        partial.rename(made)
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
        """Go on without; what is there would lack what comes now."""
        self.discard()
        self._node.diagnostics.warn(
            f"{self._folder} cannot be written ({fault.strerror}): the node goes on, but if it is killed all have to "
            "be restarted; make room there, or set recovery to another folder"
        )


def declare_recovery(node: Node) -> str:
    """The folder, from the parameter ``recovery``."""
    return str(node.declare_parameter("recovery", "", _DESCRIPTOR).value)


_DESCRIPTOR = ParameterDescriptor(
    description="Folder in which the node keeps what another one of its name needs to go on where it was killed; empty "
    "for none.",
    read_only=True,
)
