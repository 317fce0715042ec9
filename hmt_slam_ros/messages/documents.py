"""Messages as versioned JSON documents, for the topics that no standard ROS type fits.

The form of a document follows from the dataclass that it carries (:mod:`hmt_slam_ros.plain_data`); an array is a list.
What is received is checked against the same dataclass, so that nothing malformed reaches a process.
"""

from __future__ import annotations

import json
from collections.abc import Hashable
from dataclasses import dataclass, fields
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.map_changes import InitialPose, StaleBeams
from hmt_slam_ros.messages.messages import EndOfRun, HypothesisEstimate, Keyframe
from hmt_slam_ros.plain_data import PlainDataReader, Reader, to_plain
from hmt_slam_ros.process_table import DOCUMENTS
from hmt_slam_ros.saved_map.folder import FileRecord
from hmt_slam_ros.sensors import Scan

Document = TypeVar("Document")


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

    @classmethod
    def from_keyframe(cls, keyframe: Keyframe) -> KeyframeHeader:
        """What is left of a keyframe without the ranges."""
        scan = keyframe.scan
        geometry = ScanGeometry(**{entry.name: getattr(scan, entry.name) for entry in fields(ScanGeometry)})
        return cls(
            keyframe.sequence,
            geometry,
            keyframe.path_length,
            keyframe.estimates,
            keyframe.motion_unknown,
            keyframe.initial_pose,
            keyframe.mapping,
            keyframe.stale_beams,
        )

    def to_keyframe(self, ranges: NDArray[np.float32]) -> Keyframe:
        """The keyframe.

        :param ranges: shape (n,), m.
        """
        geometry = {entry.name: getattr(self.scan, entry.name) for entry in fields(self.scan)}
        scan = Scan(ranges=ranges, **geometry)
        return Keyframe(
            self.sequence,
            scan,
            self.path_length,
            self.estimates,
            self.motion_unknown,
            self.initial_pose,
            self.mapping,
            self.stale_beams,
        )


@dataclass(frozen=True, eq=False)
class FinalCounts:
    """slam's last word, and what it had said until then.

    :ivar totals: the message itself.
    :ivar keyframes: keyframe events.
    :ivar scan_poses: trails.
    """

    totals: EndOfRun
    keyframes: int
    scan_poses: int


@dataclass(frozen=True, eq=False)
class RobotStatus:
    """Progress of the robot node.

    :ivar state: "waiting" for subscribers, "playing", "paused", or "ended": no more scans will come.
    :ivar log: name of the log.
    :ivar stamp: of the last record sent, ns, 0 before the first.
    :ivar scans: scans sent.
    :ivar scans_in_log: scans that one pass over the log has.
    :ivar odometry_readings: odometry readings sent.
    :ivar acknowledged: scans for which slam gave a pose.
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
    """slam asks the others for their parts of a map.

    :ivar number: of the request, larger than those before.
    :ivar events: keyframe events after which all parts are.
    :ivar folder: into which they are written.
    :ivar shutdown: whether all nodes end afterwards.
    """

    number: int
    events: int
    folder: str
    shutdown: bool


@dataclass(frozen=True, eq=False)
class SaveResponse:
    """The answer to a :class:`SaveRequest`.

    :ivar number: of the request.
    :ivar process: the process that answers.
    :ivar files: what it wrote.
    :ivar error: what went wrong, empty where nothing did.
    """

    number: int
    process: str
    files: tuple[FileRecord, ...]
    error: str = ""


@dataclass(frozen=True, eq=False)
class ResetRequest:
    """slam asks the others to begin anew.

    :ivar number: of the request, larger than those before.
    :ivar events: keyframe events after which all do.
    :ivar folder: the map with which they begin, empty where with none.
    """

    number: int
    events: int
    folder: str


@dataclass(frozen=True, eq=False)
class ResetResponse:
    """The answer to a :class:`ResetRequest`.

    :ivar number: of the request.
    :ivar process: the process that answers.
    :ivar error: what went wrong, empty where nothing did.
    """

    number: int
    process: str
    error: str = ""


_DOCUMENTS: dict[type, tuple[str, int]] = {row.message_class: (row.document, row.version) for row in DOCUMENTS}


def encode(message: object, reset_number: int = 0) -> str:
    """The JSON document of a message, of a :class:`KeyframeHeader`, :class:`FinalCounts` or :class:`RobotStatus`.

    :param reset_number: number of the request after which all began anew, 0 before the first.
    :raises HmtSlamError: where a float is NaN or infinite.
    """
    name, version = _DOCUMENTS[type(message)]
    content = {"document": name, "version": version, **to_plain(message, {np.ndarray: np.ndarray.tolist})}
    if reset_number:
        content["reset"] = reset_number
    try:
        return json.dumps(content, allow_nan=False, separators=(",", ":"))
    except ValueError as error:
        raise HmtSlamError(f"a {name} holds a number that is not finite: the process that made it is faulty") from error


def decode(text: str, kind: type[Document]) -> Document:
    """The message of a JSON document.

    :param kind: what the document has to be.
    :raises HmtSlamError: where it is something else, of another version, or malformed; names the field.
    """
    return decode_with_reset(text, kind)[0]


def decode_with_reset(text: str, kind: type[Document]) -> tuple[Document, int]:
    """The message of a JSON document, and the number of the request after which its sender had begun anew.

    :raises HmtSlamError: as :func:`decode`.
    """
    name, version = _DOCUMENTS[kind]
    try:
        content = json.loads(text)
    except ValueError as error:
        raise HmtSlamError(
            f"a {name} document is no JSON ({error}): see docs/reference/messages.md for its form"
        ) from error
    if not isinstance(content, dict) or content.pop("document", None) != name:
        raise HmtSlamError(
            f"a document that is no {name} came on its topic: see docs/reference/messages.md for its form"
        )
    if (found := content.pop("version", None)) != version:
        raise HmtSlamError(
            f"a {name} document has version {found}, not {version}: run the same version of hmt_slam_ros everywhere"
        )
    reset_number = _VALUES.read(content.pop("reset", 0), int, f"{name}.reset")
    return _VALUES.read(content, kind, name), reset_number


def _array_reader(field: str, kind: Hashable) -> Reader:  # noqa: ARG001  all are of one kind
    """Arrays are poses (3,), but for the fields that are second moments (3, 3)."""
    shape = (3, 3) if field in ("covariance", "ambiguity") else (3,)
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
