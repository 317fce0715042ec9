"""Messages as versioned JSON documents, for the topics that no standard ROS type fits.

The form of a document follows from the dataclass that it carries: a dataclass is an object with exactly its fields, a
tuple or an array is a list. A float is written so that it comes back with the same bits. What is received is checked
against the same dataclass, so that nothing malformed reaches a process.
"""

from __future__ import annotations

import json
import math
import types
from collections.abc import Callable, Hashable
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from typing import Any, Literal, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.processes.messages import (
    Accepted,
    AreaEvents,
    Finished,
    Hypotheses,
    Keyframe,
    LeafEstimate,
    LocalEstimate,
    Notice,
)
from hmt_slam_ros.sensing import Scan

Document = TypeVar("Document")
_Decoder = Callable[[object, str], object]


@dataclass(frozen=True, eq=False)
class ScanGeometry:
    """A :class:`~hmt_slam_ros.sensing.Scan` without its ranges, which travel as a LaserScan."""

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
    """A :class:`~hmt_slam_ros.processes.messages.Keyframe` without the ranges of its scan."""

    sequence: int
    scan: ScanGeometry
    travelled: float
    leaves: tuple[LeafEstimate, ...]

    @classmethod
    def of(cls, keyframe: Keyframe) -> KeyframeHead:
        """What is left of a keyframe without the ranges."""
        scan = keyframe.scan
        geometry = ScanGeometry(**{entry.name: getattr(scan, entry.name) for entry in fields(ScanGeometry)})
        return cls(keyframe.sequence, geometry, keyframe.travelled, keyframe.leaves)

    def with_ranges(self, ranges: NDArray[np.float32]) -> Keyframe:
        """The keyframe.

        :param ranges: shape (n,), m.
        """
        geometry = {entry.name: getattr(self.scan, entry.name) for entry in fields(self.scan)}
        return Keyframe(self.sequence, Scan(ranges=ranges, **geometry), self.travelled, self.leaves)


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


# Raise a document's version with every change of its dataclass: a receiver refuses any other.
_DOCUMENTS: dict[type, tuple[str, int]] = {
    KeyframeHead: ("keyframe", 2),
    AreaEvents: ("area_events", 2),
    Hypotheses: ("hypotheses", 3),
    Accepted: ("accepted", 4),
    LocalEstimate: ("local_estimate", 1),
    Notice: ("notice", 1),
    Closing: ("finished", 1),
    RobotStatus: ("robot_status", 1),
}


def encode(message: object) -> str:
    """The JSON document of a message, of a :class:`KeyframeHead`, :class:`Closing` or :class:`RobotStatus`.

    :raises HmtSlamError: where a float is NaN or infinite.
    """
    name, version = _DOCUMENTS[type(message)]
    content = {"document": name, "version": version, **_plain(message)}
    try:
        return json.dumps(content, allow_nan=False, separators=(",", ":"))
    except ValueError as error:
        raise HmtSlamError(f"a {name} holds a number that is not finite: the process that made it is faulty") from error


def decode(text: str, kind: type[Document]) -> Document:
    """The message of a JSON document.

    :param kind: what the document has to be.
    :raises HmtSlamError: where it is something else, of another version, or malformed; names the field.
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
    return cast(Document, _decoder(cast(Hashable, kind))(content, name))


def _plain(value: object) -> Any:  # noqa: ANN401  what JSON can hold
    if is_dataclass(value):
        return {entry.name: _plain(getattr(value, entry.name)) for entry in fields(value)}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value


@cache
def _decoder(kind: Hashable) -> _Decoder:
    """What turns parsed JSON into a value of a type, or refuses it."""
    if kind in _SCALARS:
        return _SCALARS[kind]
    if isinstance(kind, type) and is_dataclass(kind):
        return _object(kind)
    origin, arguments = get_origin(kind), get_args(kind)
    if origin is Literal:
        return _word(arguments)
    if origin is tuple:
        return _list(_decoder(arguments[0]))
    if origin in (Union, types.UnionType):
        return _optional(_decoder(arguments[0]))
    raise TypeError(f"a document cannot hold a {kind}")


def _object(kind: Callable[..., object]) -> _Decoder:
    hints = get_type_hints(kind)
    readers = {entry.name: _field_decoder(entry.name, hints[entry.name]) for entry in fields(kind)}  # type: ignore[arg-type]

    def decoder(value: object, path: str) -> object:
        if not isinstance(value, dict):
            raise _fault(path, value, "an object")
        for name in readers.keys() - value.keys():
            raise HmtSlamError(f"{path}.{name} is missing: see docs/messages.md for the form of the document")
        for name in value.keys() - readers.keys():
            raise HmtSlamError(f"{path}.{name} is unknown: see docs/messages.md for the form of the document")
        return kind(**{name: read(value[name], f"{path}.{name}") for name, read in readers.items()})

    return decoder


def _field_decoder(name: str, kind: Hashable) -> _Decoder:
    """Arrays are poses (3,), but for the fields that are second moments (3, 3)."""
    if get_origin(kind) is np.ndarray:
        return _array((3, 3) if name in ("covariance", "ambiguity") else (3,))
    return _decoder(kind)


def _array(shape: tuple[int, ...]) -> _Decoder:
    def decoder(value: object, path: str) -> object:
        try:
            array = np.array(value)
        except ValueError:  # rows of different lengths
            raise _fault(path, value, f"an array of finite numbers of shape {shape}") from None
        if array.shape != shape or array.dtype.kind not in "if" or not np.isfinite(array).all():
            raise _fault(path, value, f"an array of finite numbers of shape {shape}")
        return array.astype(np.float64, copy=False)

    return decoder


def _list(item: _Decoder) -> _Decoder:
    def decoder(value: object, path: str) -> object:
        if not isinstance(value, list):
            raise _fault(path, value, "a list")
        return tuple(item(entry, f"{path}[{k}]") for k, entry in enumerate(value))

    return decoder


def _optional(some: _Decoder) -> _Decoder:
    def decoder(value: object, path: str) -> object:
        return None if value is None else some(value, path)

    return decoder


def _word(words: tuple[str, ...]) -> _Decoder:
    def decoder(value: object, path: str) -> object:
        if value not in words:
            raise _fault(path, value, " or ".join(words))
        return value

    return decoder


def _scalar(kind: type, name: str) -> _Decoder:
    def decoder(value: object, path: str) -> object:
        if type(value) is not kind:
            raise _fault(path, value, name)
        return value

    return decoder


def _number(value: object, path: str) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise _fault(path, value, "a finite number")
    return float(value)


_SCALARS: dict[Hashable, _Decoder] = {
    bool: _scalar(bool, "true or false"),
    int: _scalar(int, "a whole number"),
    str: _scalar(str, "a text"),
    float: _number,
}


def _fault(path: str, value: object, wanted: str) -> HmtSlamError:
    return HmtSlamError(f"{path} = {str(value)[:60]} is not {wanted}: see docs/messages.md for the document's form")
