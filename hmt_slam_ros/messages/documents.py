"""Messages as versioned JSON documents, for topics without a standard ROS type.

The form of a document follows from the class of its message (:mod:`hmt_slam_ros.plain_data`); an array is a list, and
the ranges of a scan are the text of their bytes. A received document is checked against that class, so that no
malformed message reaches a process.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Hashable
from dataclasses import dataclass, fields
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.map_changes import InitialPose, StaleBeams
from hmt_slam_ros.messages.messages import EndOfRun, HypothesisEstimate, Keyframe, MotionCondition
from hmt_slam_ros.plain_data import PlainDataReader, Reader, to_plain
from hmt_slam_ros.process_table import DOCUMENTS
from hmt_slam_ros.saved_map.folder import FileRecord
from hmt_slam_ros.sensors import MarkObservation, Scan
from hmt_slam_ros.untrusted_input import parse_json, shorten

Document = TypeVar("Document")


class DocumentVersionError(HmtSlamError):
    """A document has another version.

    :ivar difference: which document, with both versions.
    """

    def __init__(self, difference: str) -> None:
        super().__init__(f"{difference}: run the same version of hmt_slam_ros everywhere")
        self.difference = difference


@dataclass(frozen=True, eq=False)
class ScanGeometry:
    """A :class:`~hmt_slam_ros.sensors.Scan` without its ranges, which travel as a LaserScan."""

    stamp: int
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    laser_pose: NDArray[np.float64]
    time_increment: float
    motion: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class KeyframeHeader:
    """A :class:`~hmt_slam_ros.messages.messages.Keyframe` without the ranges of its scan."""

    sequence: int
    scan: ScanGeometry
    path_length: float
    estimates: tuple[HypothesisEstimate, ...]
    motion_unknown: bool
    initial_pose: InitialPose | None
    mapping: bool
    stale_beams: tuple[StaleBeams, ...]
    motion_condition: MotionCondition
    marks: tuple[MarkObservation, ...]

    @classmethod
    def from_keyframe(cls, keyframe: Keyframe) -> KeyframeHeader:
        """The header of a keyframe."""
        geometry = {entry.name: getattr(keyframe.scan, entry.name) for entry in fields(ScanGeometry)}
        header = {entry.name: getattr(keyframe, entry.name) for entry in fields(cls)}
        return cls(**header | {"scan": ScanGeometry(**geometry)})

    def to_keyframe(self, ranges: NDArray[np.float32]) -> Keyframe:
        """The keyframe with its ranges.

        :param ranges: shape (n,), m.
        """
        geometry = {entry.name: getattr(self.scan, entry.name) for entry in fields(self.scan)}
        header = {entry.name: getattr(self, entry.name) for entry in fields(self)}
        return Keyframe(**header | {"scan": Scan(ranges=ranges, **geometry)})


@dataclass(frozen=True, eq=False)
class FinalCounts:
    """The last message of slam, with the numbers of its messages before.

    :ivar totals: the last message.
    :ivar keyframes: number of ``Keyframe`` messages.
    :ivar scan_poses: number of ``ScanPoses`` messages.
    """

    totals: EndOfRun
    keyframes: int
    scan_poses: int


@dataclass(frozen=True, eq=False)
class RobotStatus:
    """Progress of the robot node.

    :ivar state: "waiting" for subscribers, "playing", "paused", or "ended" where no more scans follow.
    :ivar log: name of the log.
    :ivar stamp: stamp of the last record sent, ns, 0 before the first.
    :ivar scans: number of scans sent.
    :ivar scans_in_log: number of scans in the log.
    :ivar odometry_readings: number of odometry readings sent.
    :ivar acknowledged: number of scans for which slam sent a pose.
    """

    state: Literal["waiting", "playing", "paused", "ended"]
    log: str
    stamp: int
    scans: int
    scans_in_log: int
    odometry_readings: int
    acknowledged: int


@dataclass(frozen=True, eq=False)
class SaveRequest:
    """slam requests that all processes save their parts of a map.

    :ivar number: number of the request, larger than those before.
    :ivar events: number of keyframe events after which each process saves.
    :ivar folder: folder for the files.
    :ivar shutdown: whether all nodes end afterwards.
    """

    number: int
    events: int
    folder: str
    shutdown: bool


@dataclass(frozen=True, eq=False)
class SaveResponse:
    """The answer to a :class:`SaveRequest`.

    :ivar number: number of the request.
    :ivar process: name of the process that answers.
    :ivar files: files that it wrote.
    :ivar error: sentence about a fault, empty without one.
    """

    number: int
    process: str
    files: tuple[FileRecord, ...]
    error: str = ""


@dataclass(frozen=True, eq=False)
class ResetRequest:
    """slam requests that all processes reset.

    :ivar number: number of the request, larger than those before.
    :ivar events: number of keyframe events after which each process resets.
    :ivar folder: folder of the map to load, empty for none.
    """

    number: int
    events: int
    folder: str


@dataclass(frozen=True, eq=False)
class ResetResponse:
    """The answer to a :class:`ResetRequest`.

    :ivar number: number of the request.
    :ivar process: name of the process that answers.
    :ivar error: sentence about a fault, empty without one.
    """

    number: int
    process: str
    error: str = ""


_DOCUMENTS: dict[type, tuple[str, int]] = {row.message_class: (row.document, row.version) for row in DOCUMENTS}
"""{class of a message: (name, version) of its document}."""


def encode(message: object, reset_number: int = 0, system: str = "") -> str:
    """The JSON document of a message, of a :class:`KeyframeHeader`, :class:`FinalCounts` or :class:`RobotStatus`.

    :param reset_number: number of the last reset, 0 before the first.
    :param system: name of the sender's system, empty where it has none.
    :raises HmtSlamError: where a float is NaN or infinite.
    """
    name, version = _DOCUMENTS[type(message)]
    content = {"document": name, "version": version, **to_plain(message, {np.ndarray: _array_form})}
    if reset_number:
        content["reset"] = reset_number
    if system:
        content["system"] = system
    try:
        return json.dumps(content, allow_nan=False, separators=(",", ":"))
    except ValueError as error:
        raise HmtSlamError(f"a {name} holds a number that is not finite: the process that made it is faulty") from error


def decode(text: str, kind: type[Document]) -> Document:
    """The message of a JSON document.

    :param kind: class of the message.
    :raises HmtSlamError: where the document is of another class or version, or malformed; names the field.
    """
    return decode_with_reset(text, kind)[0]


def decode_with_reset(
    text: str, kind: type[Document], admit: Callable[[str], None] = lambda _: None
) -> tuple[Document, int]:
    """The message of a JSON document, and the reset number of its sender.

    :param admit: called with the name of the sender's system before the message is read; raises an error to refuse it.
    :raises HmtSlamError: as :func:`decode`.
    """
    name, version = _DOCUMENTS[kind]
    content = parse_json(text, f"a {name} document")
    if not isinstance(content, dict) or content.pop("document", None) != name:
        raise HmtSlamError(
            f"a document that is no {name} came on its topic: see docs/reference/messages.md for its form"
        )
    if (found := content.pop("version", None)) != version:
        raise DocumentVersionError(f"a {name} document has version {shorten(found)}, not {version}")
    admit(_VALUES.read(content.pop("system", ""), str, f"{name}.system"))
    reset_number = _VALUES.read(content.pop("reset", 0), int, f"{name}.reset")
    return _VALUES.read(content, kind, name), reset_number


_FLOAT32 = np.dtype("<f4")


def _array_form(array: NDArray[np.generic]) -> object:
    """An array in a document: a list of numbers, or of ranges the text of their bytes."""
    if array.dtype == np.float32:
        return base64.b64encode(array.astype(_FLOAT32, copy=False).tobytes()).decode("ascii")
    return array.tolist()


def _read_ranges(content: object, path: str) -> object:
    """The float32 numbers of a text; NaN and infinite ones are beams without a return."""
    try:
        return np.frombuffer(base64.b64decode(str(content), validate=True), _FLOAT32).astype(np.float32)
    except ValueError:
        raise _VALUES.error_at(path, content, "the bytes of float32 numbers in base64") from None


def array_shape(field: str) -> tuple[int, ...] | None:
    """The shape of the array in a field, by its name: a second moment, or else a pose; None for float32 numbers."""
    if field in ("ranges", "starts"):
        return None
    return (3, 3) if field in ("covariance", "ambiguity") else (3,)


def _array_reader(field: str, kind: Hashable) -> Reader:  # noqa: ARG001  all arrays have one type
    """The reader of an array."""
    shape = array_shape(field)
    if shape is None:
        return _read_ranges
    wanted = f"an array of finite numbers of shape {shape}"

    def read(content: object, path: str) -> object:
        try:
            array = np.array(content)
        except ValueError:  # rows of different lengths
            raise _VALUES.error_at(path, content, wanted) from None
        if array.shape != shape or array.dtype.kind not in "if" or not np.isfinite(array).all():
            raise _VALUES.error_at(path, content, wanted)
        return array.astype(np.float64, copy=False)

    return read


_VALUES = PlainDataReader("docs/reference/messages.md", {np.ndarray: _array_reader})
