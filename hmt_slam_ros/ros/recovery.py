"""How a node that was killed goes on: from its last checkpoint, with what it heard since.

Each value is a line of JSON that names its type; arrays are in a file beside it, written before the line. A line that
was not written to its end, as the process was killed, is no line. Nothing is flushed to the disk itself: a process that
is killed takes nothing with it that the system has taken over.

A process is a value machine: from the same state and the same messages in the same order it goes on to the same bit. So
a node writes down every message before its process hears it, and now and then the state of its process. Another node of
the same name and folder begins with that state, hears the messages again and says what it said again, which the others
recognize by its numbers. docs/architecture.md has the reasons.
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
from typing import TYPE_CHECKING, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from hmt_slam_ros.configuration.documents import ros_yaml
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.messages import Arriving, Message, RealTimePose
from hmt_slam_ros.plain_data import Values, plain
from hmt_slam_ros.saved_map.arrays import ReadArrays, WrittenArrays
from hmt_slam_ros.saved_map.folder import CONFIGURATION, VERSION, FolderWriter
from hmt_slam_ros.sensors import Odometry, Scan

if TYPE_CHECKING:
    from hmt_slam_ros.ros.process_node import ProcessNode

_LINES, _ARRAYS = "jsonl", "bin"
_DESCRIBED = "docs/architecture.md"


class Entry(NamedTuple):
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
        self._arrays = WrittenArrays(self._bytes)

    def append(self, role: str, value: object) -> None:
        """Write a value.

        :raises OSError: where it cannot be written.
        """
        content = plain(value, {np.ndarray: self._arrays.plain})
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


def journal_entries(folder: Path, stem: str, kinds: Mapping[str, type]) -> Iterator[Entry]:
    """The values of a journal in their order.

    :param kinds: {name: type} of those that it may hold.
    :raises HmtSlamError: where it holds something else.
    """
    arrays = ReadArrays((folder / f"{stem}.{_ARRAYS}").read_bytes())
    values = Values(_DESCRIBED, {np.ndarray: arrays.reader})
    content = (folder / f"{stem}.{_LINES}").read_bytes()
    for number, line in enumerate(content.split(b"\n")[:-1]):
        path = f"{folder / stem}.{_LINES}[{number}]"
        try:
            entry = json.loads(line)
            role, kind = entry["role"], kinds[entry["kind"]]
        except (ValueError, KeyError) as fault:
            raise HmtSlamError(f"{path} is damaged ({fault}): remove {folder.parent}, and restart all nodes") from fault
        yield Entry(role, values.value(entry["value"], kind, path))


CHECKPOINT = "hmt_checkpoint"
"""The format of the folder of a checkpoint."""

# A checkpoint is due when the node computed this many times as long as the last one took, which bounds what checkpoints
# cost, and how long another node takes to catch up.
_WORTH = 20.0
_FIRST_COST = 0.05  # s, before one was written
_LARGEST = 64_000_000  # bytes of a journal, for a robot that stands still
# What the node said last may not have reached the others when it was killed: it is said again. More than DDS has under
# way at any time.
_SAID_AGAIN = 64
_BASE, _SAID, _HEARD = "base", "said", "heard"
_STATE, _PARTIAL = "state", ".partial"


@dataclass(frozen=True, eq=False)
class Base:
    """What a node was when its journal began.

    :ivar checkpoint: whether its state is beside the journal; else the process began with ``folder``.
    :ivar events: keyframe events that it had heard to the end.
    :ivar folder: of the map that it began with, empty without.
    :ivar carried: whether the robot may be anywhere in that.
    :ivar scans: scans that had a pose before.
    :ivar request: number of the last request to begin anew that it answered.
    :ivar received: {kind of message: how many it heard}.
    :ivar sent: {kind of message: how many it said}, of those that are counted for the others.
    :ivar stamps: {kind of measurement: stamp of the last one that it heard, ns}.
    :ivar arriving: the last such message that it heard, if any.
    """

    checkpoint: bool = False
    events: int = 0
    folder: str = ""
    carried: bool = False
    scans: int = 0
    request: int = 0
    received: Mapping[str, int] = field(default_factory=dict)
    sent: Mapping[str, int] = field(default_factory=dict)
    stamps: Mapping[str, int] = field(default_factory=dict)
    arriving: Arriving | None = None


@dataclass(frozen=True)
class Setting:
    """A parameter that was changed while the node ran.

    :ivar name: of the parameter.
    :ivar value: the new one, in YAML.
    """

    name: str
    value: str


@dataclass(frozen=True)
class Paused:
    """Slam was told to pass scans over, or to go on.

    :ivar on: whether it passes them over.
    """

    on: bool


@dataclass(frozen=True)
class Active:
    """The node was activated, or deactivated.

    :ivar on: whether it takes part.
    """

    on: bool


@dataclass(frozen=True, eq=False)
class Mounted:
    """Slam heard where a laser is on the robot.

    :ivar name: of the frame of its scans.
    :ivar laser_pose: shape (3,), ``base_T_laser`` as (x, y, theta) in m and rad.
    :ivar side: 1.0, or -1.0 for a laser mounted upside down.
    """

    name: str
    laser_pose: NDArray[np.float64]
    side: float


# What a node is told beside messages, and knows until it is told otherwise.
Told = Setting | Paused | Active | Mounted


@dataclass(frozen=True, eq=False)
class Found:
    """What a node of the same name left behind.

    :ivar base: what it was when its journal began.
    :ivar state: the folder of its checkpoint.
    :ivar said: what it said last before that.
    :ivar heard: what it heard since, in its order.
    :ivar active: whether it took part when it was killed, None where nobody had told it so far.
    """

    base: Base
    state: Path
    said: list[Message]
    heard: list[Message | Told]
    active: bool | None


_KINDS: dict[str, type] = {kind.__name__: kind for kind in (Base, *get_args(Told), *get_args(Message))}


class Recovery:
    """Checkpoints and journal of a node; nothing where the parameter ``recovery`` is not set.

    A generation is a folder with a journal and mostly the checkpoint that it goes on from. The newest one that is
    complete counts; it gets its name when it is.

    :ivar found: what a node of the same name left behind, None where this one is the first.
    """

    def __init__(self, node: ProcessNode, folder: str) -> None:
        """Look for what was left behind.

        :param folder: of all nodes, empty for none.
        :raises HmtSlamError: where it is damaged.
        """
        self._node = node
        name = node.get_fully_qualified_name().strip("/").replace("/", ".")
        self._folder = Path(folder).absolute() / name if folder else None
        self._generation = self._segment = 0
        self._journal: Journal | None = None
        self._said: deque[Message] = deque(maxlen=_SAID_AGAIN)
        self._told: dict[tuple[type, str], Told] = {}
        self._stamps: dict[str, int] = {}
        self._arriving: Arriving | None = None
        self._cost, self._worked = _FIRST_COST, 0.0
        self.found = None if self._folder is None else self._find(self._folder)

    def _find(self, folder: Path) -> Found | None:
        folders = {int(path.name): path for path in folder.glob("*") if path.name.isdecimal()}
        if not folders:
            return None
        self._generation = max(folders)
        newest = folders[self._generation]
        self._segment = len(list(newest.glob("*.jsonl")))
        entries = [e for number in range(self._segment) for e in journal_entries(newest, str(number), _KINDS)]
        base = entries[0].value
        assert isinstance(base, Base)
        self._stamps, self._arriving = dict(base.stamps), base.arriving
        for entry in entries:
            self._follow(entry)
        heard = [e.value for e in entries if e.role == _HEARD]
        told = self._told.get((Active, ""))
        active = told.on if isinstance(told, Active) else None
        return Found(base, newest / _STATE, list(self._said), heard, active)  # type: ignore[arg-type]

    def _follow(self, entry: Entry) -> None:
        """Keep what the next generation begins with."""
        value = entry.value
        if isinstance(value, Told):
            self._told[type(value), "" if isinstance(value, Paused | Active) else value.name] = value
        elif entry.role == _SAID:
            self._said.append(value)  # type: ignore[arg-type]
        elif isinstance(value, Arriving):
            self._arriving = value
        elif isinstance(value, Scan | Odometry):
            self._stamps[type(value).__name__] = value.stamp

    @property
    def stamps(self) -> Mapping[str, int]:
        """{kind of measurement: stamp of the last one that was heard, ns}."""
        return dict(self._stamps)

    @property
    def arriving(self) -> Arriving | None:
        """The last such message that was heard, if any."""
        return self._arriving

    def is_past(self, arriving: Arriving) -> bool:
        """Whether the robot arrived so before: slam says it again when it was killed, and DDS when this node was."""
        last = self._arriving
        return last is not None and (arriving.scans, arriving.event) <= (last.scans, last.event)

    def heard(self, value: Message | Told) -> None:
        """Write down what the process is about to hear."""
        entry = Entry(_HEARD, value)
        self._follow(entry)
        self._write(entry)

    def said(self, message: Message) -> None:
        """Keep what the process says; a pose by dead reckoning is past when it is said again."""
        if not isinstance(message, RealTimePose):
            self._said.append(message)

    def worked(self, seconds: float) -> None:
        """Count the time of computing."""
        self._worked += seconds

    @property
    def due(self) -> bool:
        """Whether a checkpoint is worth what it costs."""
        return self._journal is not None and (self._worked > _WORTH * self._cost or self._journal.size > _LARGEST)

    def begin(self, base: Base) -> None:
        """Begin a journal without a checkpoint; what was heard and said before is of no use any more."""
        self._said.clear()
        self._arriving = None
        try:
            self._next(base, lambda _: None)
        except OSError as fault:
            self._give_up(fault)

    def checkpoint(self, base: Base, documents: Mapping[str, object]) -> None:
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
            self._next(base, write)
        self._cost, self._worked = time.perf_counter() - begin, 0.0

    def resume(self) -> None:
        """Go on with the journal that was found."""
        assert self._folder is not None
        newest = self._folder / str(self._generation)
        for other in self._folder.iterdir():
            if other != newest:
                shutil.rmtree(other, ignore_errors=True)
        try:
            self._journal = Journal(newest, str(self._segment))
        except OSError as fault:
            self._give_up(fault)

    def clear(self) -> None:
        """Leave nothing behind, as the node ends in good order."""
        if self._journal is not None:
            self._journal.close()
            self._journal = None
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _next(self, base: Base, write: Callable[[Path], None]) -> None:
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
        journal.append(_BASE, base)
        for told in self._told.values():
            journal.append(_HEARD, told)
        for message in self._said:
            journal.append(_SAID, message)
        partial.rename(made)
        before, self._journal = self._journal, journal
        if before is not None:
            before.close()
        shutil.rmtree(self._folder / str(self._generation), ignore_errors=True)
        self._generation, self._segment = self._generation + 1, 1

    def _write(self, entry: Entry) -> None:
        if self._journal is None:
            return
        try:
            self._journal.append(*entry)
        except OSError as fault:
            self._give_up(fault)

    def _give_up(self, fault: OSError) -> None:
        """Go on without; what is there would lack what comes now."""
        self.clear()
        self._node.figures.warn(
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
