"""MRPT rawlogs: actions and observations in turn, or observations alone.

An object is: one byte with bit 7 set and the length of the class name in the others; the name; one byte with the
version; the fields, little endian, which may be objects themselves; the byte 0x88. The fields of each class and
version follow MRPT's documentation and source (``serializeFrom`` of each class).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.mounting import planar_mounting, transform_from_quaternion
from hmt_slam_ros.logs.records import InMemoryLog, LeftOut, LogEntry, TimeWindow
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.plausibility import (
    MAX_COORDINATE,
    MAX_LASER_OFFSET,
    QUATERNION_TOLERANCE,
    check_planar_pose,
)

_END_OF_OBJECT = 0x88
"""Byte at the end of an object."""

_ODOMETRY_METHOD = 0
"""Value of a movement's method for wheel odometry."""

_TICKS_TO_1970 = 116_444_736_000_000_000
"""MRPT counts ticks of 100 ns from the year 1601: ticks until 1970."""

_MAX_DEPTH = 16
"""Objects within each other; the deepest of a rawlog has 5."""

_Kind = TypeVar("_Kind")


@dataclass(frozen=True, eq=False)
class RangeScan:
    """A planar scan.

    :ivar ticks: time in units of 100 ns since 1601.
    :ivar ranges: shape (n,), float32, m.
    :ivar valid: shape (n,), uint8, 0 for a faulty beam.
    :ivar aperture: angle from the first beam to the last, rad.
    :ivar right_to_left: whether angles increase from beam to beam.
    :ivar max_range: largest range of the sensor, m.
    :ivar sensor_pose: ``base_T_laser``, shape (4, 4), m.
    :ivar sweep_duration: time from the first beam to the last, s, 0 where unknown.
    """

    ticks: int
    ranges: NDArray[np.float32]
    valid: NDArray[np.uint8]
    aperture: float
    right_to_left: bool
    max_range: float
    sensor_pose: NDArray[np.float64]
    sweep_duration: float


@dataclass(frozen=True, eq=False)
class OdometryReading:
    """An absolute odometry reading: ``ticks`` of 100 ns since 1601, ``pose`` (3,) in m and rad."""

    ticks: int
    pose: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RobotMovement:
    """A movement of the robot: ``increment`` (3,) in m and rad, in the frame of the pose before it."""

    is_odometry: bool
    increment: NDArray[np.float64]


@dataclass(frozen=True)
class ActionCollection:
    """The movements of the robot between two frames."""

    actions: list[object]


@dataclass(frozen=True)
class SensoryFrame:
    """Observations made together."""

    observations: list[object]


def is_rawlog(content: bytes) -> bool:
    """Whether the content begins like an object, with the marked length of a class name and that name."""
    length = content[0] & 0x7F if content else 0
    name = content[1 : 1 + length]
    return bool(content) and content[0] > 0x80 and name.replace(b":", b"").isalnum() and len(name) == length


class ObjectStream:
    """The top-level objects of a rawlog, in order.

    :param content: content of the file, decompressed.
    :param name: name of the log, for error messages.
    """

    def __init__(self, content: bytes, name: str) -> None:
        self._content = content
        self._name = name
        self._offset = 0
        self._depth = 0

    def __iter__(self) -> Iterator[object]:
        """All objects.

        :raises HmtSlamError: where the content ends inside an object or is of an unknown class or version.
        """
        while self._offset < len(self._content):
            yield self.next_object()

    def next_object(self) -> object:
        """The object at the current offset."""
        name_length = self.integer("B") & 0x7F
        class_name = self._read_bytes(name_length).decode("ascii", "replace").removeprefix("mrpt::").split("::")[-1]
        reader = _READERS.get(class_name)
        if reader is None:
            raise HmtSlamError(
                f"{self._name} holds an object of class {class_name!r}, which is not known here: "
                "remove such objects with MRPT's rawlog-edit first."
            )
        if self._depth == _MAX_DEPTH:
            raise HmtSlamError(
                f"{self._name} is damaged, its objects nest deeper than {_MAX_DEPTH}: copy the file anew."
            )
        self._depth += 1
        result = reader(self, self.integer("B"))
        self._depth -= 1
        if self.integer("B") != _END_OF_OBJECT:
            raise HmtSlamError(f"{self._name} is damaged inside an object of class {class_name}: copy the file anew.")
        return result

    def nested_object(self, kind: type[_Kind]) -> _Kind:
        """The object at the current offset, which must be of a given kind.

        :raises HmtSlamError: where it is of another kind.
        """
        result = self.next_object()
        if not isinstance(result, kind):
            raise HmtSlamError(f"{self._name} is damaged, one object lies where another belongs: copy the file anew.")
        return result

    def pose(self, *shape: int) -> NDArray[np.float64]:
        """A nested object that is a pose or a matrix of a shape.

        :raises HmtSlamError: where it is of another kind or shape.
        """
        pose = self.nested_object(np.ndarray)
        if pose.shape != shape:
            raise HmtSlamError(
                f"{self._name} is damaged, a matrix of {pose.shape} lies where {shape} belongs: copy the file anew."
            )
        return pose

    def integer(self, code: str) -> int:
        """An integer, by its code in the struct module."""
        return int(struct.unpack("<" + code, self._read_bytes(struct.calcsize(code)))[0])

    def real(self, code: str) -> float:
        """A floating-point number, by its code in the struct module."""
        return float(struct.unpack("<" + code, self._read_bytes(struct.calcsize(code)))[0])

    def numbers(self, dtype: str, count: int) -> NDArray[Any]:
        """``count`` numbers of a little-endian numpy type."""
        kind = np.dtype(dtype).newbyteorder("<")
        return np.frombuffer(self._read_bytes(kind.itemsize * count), dtype=kind)

    def skip_text(self) -> None:
        """Skip a character string."""
        self._read_bytes(self.integer("I"))

    def check_version(self, class_name: str, version: int, newest: int, oldest: int = 0) -> None:
        """Check that the version of a class is known.

        :raises HmtSlamError: where it is not.
        """
        if not oldest <= version <= newest:
            raise HmtSlamError(
                f"{self._name} holds version {version} of {class_name}, and {oldest} to {newest} are known here: "
                "convert the log with MRPT's rawlog-edit."
            )

    def _read_bytes(self, count: int) -> bytes:
        piece = self._content[self._offset : self._offset + count]
        if len(piece) < count:
            raise HmtSlamError(f"{self._name} is truncated: it ends inside an object; copy the file anew.")
        self._offset += count
        return piece


def _matrix(dtype: str) -> Callable[[ObjectStream, int], NDArray[np.float64]]:
    def read(stream: ObjectStream, version: int) -> NDArray[np.float64]:
        stream.check_version("CMatrix", version, newest=0)
        rows, columns = stream.numbers("u4", 2).tolist()
        return stream.numbers(dtype, rows * columns).reshape(rows, columns).astype(np.float64)

    return read


def _pose_2d(stream: ObjectStream, version: int) -> NDArray[np.float64]:
    stream.check_version("CPose2D", version, newest=1)
    return stream.numbers("f8" if version else "f4", 3).astype(np.float64)


def _pose_3d(stream: ObjectStream, version: int) -> NDArray[np.float64]:
    """Homogeneous transform, shape (4, 4)."""
    stream.check_version("CPose3D", version, newest=3)
    if version < 2:
        return stream.pose(4, 4)
    translation = stream.numbers("f8", 3)
    if version == 2:
        w, x, y, z = stream.numbers("f8", 4)
        norm = float(np.linalg.norm((x, y, z, w)))
        return transform_from_quaternion(translation, (x, y, z, w)) if norm > 0.0 else np.full((4, 4), np.nan)
    transform = np.eye(4)
    transform[:3, 3] = translation
    transform[:3, :3] = stream.numbers("f8", 9).reshape(3, 3)
    return transform


def _pose_gaussian(stream: ObjectStream, version: int) -> NDArray[np.float64]:
    """The mean, shape (3,)."""
    stream.check_version("CPosePDFGaussian", version, newest=2)
    mean = stream.pose(3)
    if version == 0:
        stream.pose(3, 3)
    else:
        stream.numbers("f8" if version == 2 else "f4", 6)  # upper triangle of the covariance
    return mean


def _movement(stream: ObjectStream, version: int) -> RobotMovement:
    stream.check_version("CActionRobotMovement2D", version, newest=7, oldest=4)
    method = stream.integer("i")
    increment = stream.pose(3)
    if method == _ODOMETRY_METHOD:
        stream.numbers("i4", 1)  # the motion model: its choice, ...
        stream.numbers("f4", 6)  # ... Gaussian parameters, ...
        stream.numbers("i4", 1)  # ... number of particles ...
        stream.numbers("f4", 6 if version >= 5 else 4)  # ... and the parameters of the other model
    _skip_velocities_and_encoders(stream, old=version < 7)
    if version >= 6:
        stream.integer("Q")
    return RobotMovement(method == _ODOMETRY_METHOD, increment)


def _skip_velocities_and_encoders(stream: ObjectStream, *, old: bool) -> None:
    """Skip velocities and encoder ticks. Old versions always store both, velocities as two floats."""
    has_velocities = stream.integer("?")
    if old:
        stream.numbers("f4", 2)
    elif has_velocities:
        stream.numbers("f8", 3)
    has_encoders = stream.integer("?")
    if old or has_encoders:
        stream.numbers("i4", 2)


def _odometry_reading(stream: ObjectStream, version: int) -> OdometryReading:
    stream.check_version("CObservationOdometry", version, newest=2)
    pose = stream.pose(3)
    stream.skip_text()
    ticks = stream.integer("Q")
    if version >= 1:
        has_encoders = stream.integer("?")
        if has_encoders or version < 2:
            stream.numbers("i4", 2)
        has_velocities = stream.integer("?")
        if version < 2:
            stream.numbers("f4", 2)
        elif has_velocities:
            stream.numbers("f8", 3)
    return OdometryReading(ticks, pose)


def _range_scan(stream: ObjectStream, version: int) -> RangeScan:
    stream.check_version("CObservation2DRangeScan", version, newest=8, oldest=4)
    aperture, right_to_left, max_range = stream.real("f"), bool(stream.integer("?")), stream.real("f")
    sensor_pose = stream.pose(4, 4)
    if version < 6:
        stream.nested_object(np.ndarray)  # covariance of the sensor's pose
    count = stream.integer("I")
    ranges, valid = stream.numbers("f4", count), stream.numbers("u1", count)
    stream.real("f")  # standard deviation of a range
    ticks = stream.integer("Q")
    stream.real("f")  # opening angle of a beam
    if version >= 5:
        stream.skip_text()
        stream.real("d")  # a pitch that the sensor's pose already contains
    if version >= 7 and stream.integer("?"):
        stream.numbers("i4", count)  # intensities
    sweep_duration = stream.real("f") if version >= 8 else 0.0
    return RangeScan(ticks, ranges, valid, aperture, right_to_left, max_range, sensor_pose, sweep_duration)


def _frame(stream: ObjectStream, version: int) -> SensoryFrame:
    stream.check_version("CSensoryFrame", version, newest=2, oldest=1)
    if version == 1:
        stream.integer("I")  # a number of the frame
    return SensoryFrame([stream.next_object() for _ in range(stream.integer("I"))])


def _actions(stream: ObjectStream, version: int) -> ActionCollection:
    stream.check_version("CActionCollection", version, newest=0)
    return ActionCollection([stream.next_object() for _ in range(stream.integer("I"))])


_READERS: dict[str, Callable[[ObjectStream, int], object]] = {
    "CMatrixD": _matrix("f8"),
    "CMatrixDouble": _matrix("f8"),
    "CMatrixF": _matrix("f4"),
    "CMatrix": _matrix("f4"),
    "CPose2D": _pose_2d,
    "CPose3D": _pose_3d,
    "CPosePDFGaussian": _pose_gaussian,
    "CActionRobotMovement2D": _movement,
    "CActionCollection": _actions,
    "CObservation2DRangeScan": _range_scan,
    "CObservationOdometry": _odometry_reading,
    "CSensoryFrame": _frame,
}


def open_rawlog(path: Path, content: bytes, window: TimeWindow) -> InMemoryLog:
    """An MRPT rawlog.

    In the action-observation form, the odometry increments of the actions are composed from the origin on. The sum is
    the odometry reading of the first scan after an action. Where the log has absolute odometry readings, these replace
    the increments.

    :param path: path of the file, for the name of the log.
    :param content: content of the file, decompressed.
    :param window: part of the log to read.
    :raises HmtSlamError: where the file is truncated, holds an object of an unknown class or version, or no scan.
    """
    objects = list(ObjectStream(content, path.name))
    absolute = any(isinstance(reading, OdometryReading) for reading in _observations(objects))
    left_out = LeftOut()
    entries = _entries(objects, path.name, left_out, with_increments=not absolute)
    return InMemoryLog(path.stem, entries, window, left_out)


def _observations(objects: Iterable[object]) -> Iterator[object]:
    for item in objects:
        if isinstance(item, SensoryFrame):
            yield from item.observations
        else:
            yield item


def _entries(objects: Iterable[object], name: str, left_out: LeftOut, *, with_increments: bool) -> Iterator[LogEntry]:
    odom_T_base = np.zeros(3)
    due = with_increments  # at the first scan, and at the first one after an action
    for item in _observations(objects):
        if isinstance(item, ActionCollection) and with_increments:
            increment = _increment(item, name)
            if left_out.admits(partial(check_planar_pose, increment, "a movement", MAX_COORDINATE)):
                odom_T_base = se2.compose(odom_T_base, increment)
                due = True
        elif isinstance(item, OdometryReading):
            yield LogEntry(_stamp(item.ticks, name), Odometry, (item.pose,))
        elif isinstance(item, RangeScan):
            stamp = _stamp(item.ticks, name)
            if not left_out.admits(partial(_check_sensor_pose, item)):
                continue
            if due:
                yield LogEntry(stamp, Odometry, (odom_T_base,), precedes_its_scan=True)
            due = False
            yield LogEntry(stamp, Scan, _scan_fields(item, name))


def _check_sensor_pose(scan: RangeScan) -> None:
    """Check that the laser's pose is finite; where it is tilted, the log is refused.

    :raises HmtSlamError: where it is not.
    """
    check_planar_pose(scan.sensor_pose[:2, 3], "the laser's position", MAX_LASER_OFFSET)
    check_planar_pose(scan.sensor_pose[:3, :3].ravel(), "the laser's rotation", 1.0 + QUATERNION_TOLERANCE)


def _stamp(ticks: int, name: str) -> int:
    if ticks <= _TICKS_TO_1970:
        raise HmtSlamError(f"{name} has a measurement without a time stamp: give a log that was recorded with stamps.")
    return (ticks - _TICKS_TO_1970) * 100


def _increment(actions: ActionCollection, name: str) -> NDArray[np.float64]:
    """The first movement by wheel odometry, else the first of any kind, shape (3,)."""
    movements = [action for action in actions.actions if isinstance(action, RobotMovement)]
    movements.sort(key=lambda movement: not movement.is_odometry)
    if not movements:
        raise HmtSlamError(f"{name} has an action without a movement of the robot: give a log with wheel odometry.")
    return movements[0].increment


def _scan_fields(scan: RangeScan, name: str) -> tuple[object, ...]:
    """The fields of `Scan` after the stamp. The beams span the aperture, both ends included."""
    mounting = planar_mounting(scan.sensor_pose, f"the laser of {name}")
    side = mounting.angle_sign if scan.right_to_left else -mounting.angle_sign
    ranges = scan.ranges.copy()
    # Some faulty beams have ranges inside the limits: only the flag marks them.
    ranges[(scan.valid == 0) & (ranges < scan.max_range)] = np.nan
    increment = scan.aperture / max(ranges.size - 1, 1)
    time_increment = scan.sweep_duration / max(ranges.size - 1, 1)
    angle_min = -0.5 * side * scan.aperture
    return ranges, angle_min, side * increment, 0.0, scan.max_range, mounting.laser_pose, time_increment
