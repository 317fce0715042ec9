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
from hmt_slam_ros.messages.map_changes import Outdated, Place
from hmt_slam_ros.messages.messages import (
    Accepted,
    AreaEvents,
    Arriving,
    Finished,
    Hypotheses,
    Keyframe,
    LeafEstimate,
    LocalEstimate,
    Notice,
)
from hmt_slam_ros.messages.tasks import PlaceEstimate
from hmt_slam_ros.plain_data import Reader, Values, plain
from hmt_slam_ros.saved_map.folder import File
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
class KeyframeHead:
    """A :class:`~hmt_slam_ros.messages.messages.Keyframe` without the ranges of its scan."""

    sequence: int
    scan: ScanGeometry
    travelled: float
    leaves: tuple[LeafEstimate, ...]
    carried: bool
    place: Place | None
    mapping: bool
    outdated: tuple[Outdated, ...]

    @classmethod
    def of(cls, keyframe: Keyframe) -> KeyframeHead:
        """What is left of a keyframe without the ranges."""
        scan = keyframe.scan
        geometry = ScanGeometry(**{entry.name: getattr(scan, entry.name) for entry in fields(ScanGeometry)})
        return cls(
            keyframe.sequence,
            geometry,
            keyframe.travelled,
            keyframe.leaves,
            keyframe.carried,
            keyframe.place,
            keyframe.mapping,
            keyframe.outdated,
        )

    def with_ranges(self, ranges: NDArray[np.float32]) -> Keyframe:
        """The keyframe.

        :param ranges: shape (n,), m.
        """
        geometry = {entry.name: getattr(self.scan, entry.name) for entry in fields(self.scan)}
        scan = Scan(ranges=ranges, **geometry)
        return Keyframe(
            self.sequence,
            scan,
            self.travelled,
            self.leaves,
            self.carried,
            self.place,
            self.mapping,
            self.outdated,
        )


@dataclass(frozen=True, eq=False)
class Closing:
    """slam's last word, and what it had said until then.

    :ivar totals: the message itself.
    :ivar keyframes: keyframe events.
    :ivar trails: trails.
    """

    totals: Finished
    keyframes: int
    trails: int


@dataclass(frozen=True, eq=False)
class RobotStatus:
    """Progress of the robot node.

    :ivar state: "waiting" for subscribers, "playing", "paused", or "ended": no more scans will come.
    :ivar log: name of the log.
    :ivar stamp: of the last record sent, ns, 0 before the first.
    :ivar scans: scans sent.
    :ivar scans_in_log: scans that one pass over the log has.
    :ivar odometry: odometry readings sent.
    :ivar acknowledged: scans for which slam gave a pose.
    """

    state: Literal["waiting", "playing", "paused", "ended"]
    log: str
    stamp: int
    scans: int
    scans_in_log: int
    odometry: int
    acknowledged: int


@dataclass(frozen=True, eq=False)
class SaveRequest:
    """slam asks the others for their parts of a map.

    :ivar number: of the request, larger than those before.
    :ivar events: keyframe events after which all parts are.
    :ivar folder: into which they are written.
    :ivar last: whether all nodes end afterwards.
    """

    number: int
    events: int
    folder: str
    last: bool


@dataclass(frozen=True, eq=False)
class SavedPart:
    """The answer to a :class:`SaveRequest`.

    :ivar number: of the request.
    :ivar part: the process that answers.
    :ivar files: what it wrote.
    :ivar fault: what went wrong, empty where nothing did.
    """

    number: int
    part: str
    files: tuple[File, ...]
    fault: str = ""


@dataclass(frozen=True, eq=False)
class BeginRequest:
    """slam asks the others to begin anew.

    :ivar number: of the request, larger than those before.
    :ivar events: keyframe events after which all do.
    :ivar folder: the map with which they begin, empty where with none.
    """

    number: int
    events: int
    folder: str


@dataclass(frozen=True, eq=False)
class BegunPart:
    """The answer to a :class:`BeginRequest`.

    :ivar number: of the request.
    :ivar part: the process that answers.
    :ivar fault: what went wrong, empty where nothing did.
    """

    number: int
    part: str
    fault: str = ""


# Raise a document's version with every change of its dataclass: a receiver refuses any other.
_DOCUMENTS: dict[type, tuple[str, int]] = {
    KeyframeHead: ("keyframe", 9),
    AreaEvents: ("area_events", 3),
    Hypotheses: ("hypotheses", 8),
    Accepted: ("accepted", 4),
    LocalEstimate: ("local_estimate", 1),
    Arriving: ("arriving", 1),
    Notice: ("notice", 1),
    Closing: ("finished", 1),
    RobotStatus: ("robot_status", 1),
    SaveRequest: ("save_request", 1),
    SavedPart: ("saved_part", 1),
    BeginRequest: ("begin_request", 1),
    BegunPart: ("begun_part", 1),
    PlaceEstimate: ("place_estimate", 1),
}


def encode(message: object, begun: int = 0) -> str:
    """The JSON document of a message, of a :class:`KeyframeHead`, :class:`Closing` or :class:`RobotStatus`.

    :param begun: number of the request after which all began anew, 0 before the first.
    :raises HmtSlamError: where a float is NaN or infinite.
    """
    name, version = _DOCUMENTS[type(message)]
    content = {"document": name, "version": version, **plain(message, {np.ndarray: np.ndarray.tolist})}
    if begun:
        content["begun"] = begun
    try:
        return json.dumps(content, allow_nan=False, separators=(",", ":"))
    except ValueError as error:
        raise HmtSlamError(f"a {name} holds a number that is not finite: the process that made it is faulty") from error


def decode(text: str, kind: type[Document]) -> Document:
    """The message of a JSON document.

    :param kind: what the document has to be.
    :raises HmtSlamError: where it is something else, of another version, or malformed; names the field.
    """
    return decode_numbered(text, kind)[0]


def decode_numbered(text: str, kind: type[Document]) -> tuple[Document, int]:
    """The message of a JSON document, and the number of the request after which its sender had begun anew.

    :raises HmtSlamError: as :func:`decode`.
    """
    name, version = _DOCUMENTS[kind]
    try:
        content = json.loads(text)
    except ValueError as error:
        raise HmtSlamError(f"a {name} document is no JSON ({error}): see docs/messages.md for its form") from error
    if not isinstance(content, dict) or content.pop("document", None) != name:
        raise HmtSlamError(f"a document that is no {name} came on its topic: see docs/messages.md for its form")
    if (found := content.pop("version", None)) != version:
        raise HmtSlamError(
            f"a {name} document has version {found}, not {version}: run the same version of hmt_slam_ros everywhere"
        )
    begun = _VALUES.value(content.pop("begun", 0), int, f"{name}.begun")
    return _VALUES.value(content, kind, name), begun


def _array_reader(field: str, kind: Hashable) -> Reader:  # noqa: ARG001  all are of one kind
    """Arrays are poses (3,), but for the fields that are second moments (3, 3)."""
    shape = (3, 3) if field in ("covariance", "ambiguity") else (3,)
    wanted = f"an array of finite numbers of shape {shape}"

    def read(content: object, path: str) -> object:
        try:
            array = np.array(content)
        except ValueError:  # rows of different lengths
            raise _VALUES.fault(path, content, wanted) from None
        if array.shape != shape or array.dtype.kind not in "if" or not np.isfinite(array).all():
            raise _VALUES.fault(path, content, wanted)
        return array.astype(np.float64, copy=False)

    return read


_VALUES = Values("docs/messages.md", {np.ndarray: _array_reader})
