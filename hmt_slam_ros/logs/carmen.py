"""CARMEN logs: their FLASER, ROBOTLASER1 and ODOM lines."""

from __future__ import annotations

import io
import re
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import InMemoryLog, LeftOut, LogEntry, TimeWindow
from hmt_slam_ros.logs.stamps import stamp_from_seconds
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.plausibility import MAX_COORDINATE, MAX_LASER_OFFSET, check_planar_pose

_MIN_REPEATS = 3
"""Least number of equal readings at the maximum of the sensor."""

_BAND, _BANDS_BELOW = 0.01, 5
"""Width of the band of codes for "no return", as a share of the maximum, and the number of bands below it.

Sensors use 51.09 to 51.16 m, or 81.83 to 81.91 m.
"""

_CROWD_RATIO = 10.0
"""Least ratio of readings in the band of the maximum to those in a band below, for codes of "no return"."""


def no_return_threshold(ranges: NDArray[np.float32]) -> float:
    """The smallest range that means "no return" in a log that states none, m.

    A sensor reports its maximum, or a few values close to it, for every beam without a return. Real distances spread as
    the robot moves, so these readings are a crowd at the far end. The maximum M is the largest reading that occurs
    three times. Readings from 0.99 M on mean "no return" if they are more than ten times as many as in each of the five
    bands of that width below, on average, and not the whole log. Real returns in the last percent are lost with them.

    :param ranges: shape (n,), all readings of the log, m.
    :returns: the smallest reading of that crowd; without one, just beyond the largest reading (inf without readings).
    """
    return _threshold_of_sorted(np.sort(ranges))


def _threshold_of_sorted(ranges: NDArray[np.float32]) -> float:
    """`no_return_threshold` of increasing readings; copies of them would take as much memory as the log.

    :param ranges: shape (n,), m, NaN at the end.
    """
    first, end = np.searchsorted(ranges, np.float32(0.0), "right"), np.searchsorted(ranges, np.float32(np.inf))
    if first == end:
        return float("inf")
    finite = ranges[first:end]
    starts = np.concatenate(([0], np.flatnonzero(finite[1:] != finite[:-1]) + 1))
    values, counts = finite[starts], np.diff(starts, append=finite.size)
    repeated = np.flatnonzero(counts >= _MIN_REPEATS)
    if repeated.size:
        maximum = float(values[repeated[-1]])
        edges = maximum * (1.0 - _BAND * np.array([1 + _BANDS_BELOW, 1]))
        lowest, crowd_from = np.searchsorted(values, edges.astype(np.float32))
        crowd = counts[crowd_from:].sum()
        background = counts[lowest:crowd_from].sum() / _BANDS_BELOW
        if crowd_from > 0 and crowd > _CROWD_RATIO * background:
            return float(values[crowd_from])
    return float(np.nextafter(values[-1], np.float32(np.inf)))


_KNOWN_LINE = re.compile(rb"^(# message_name|(PARAM|SYNC|ODOM|FLASER|RLASER|ROBOTLASER\d|RAWLASER\d|TRUEPOS) )", re.M)
"""Beginning of a line that CARMEN writes."""

_FRONT_LASER_OFFSET = b"robot_frontlaser_offset"
"""Parameter with the laser's distance ahead of the robot's middle, m."""

_TRAILER = 3
"""Fields at the end of each line: ipc_timestamp, ipc_hostname, logger_timestamp."""

_MIN_SCANS_FOR_OFFSET = 10
"""Least number of scans from which the mounting of the laser is found."""

_LARGEST_OFFSET = 2.0
"""Largest distance of the laser from the odometry's pose, m: farther away, the pose is a corrected one."""

_MAX_LINE = 1_000_000
"""Bytes of a line; a scan of 10,000 beams has 100,000."""

_MAX_OFFSETS = 1000
"""Poses of a laser on the robot in one log."""

_SAME_OFFSET = 2e-3
"""Largest difference of equal offsets, m and rad: poses are written with six decimals."""


class _Sweep(NamedTuple):
    """A scan in a line.

    :ivar ranges: shape (n,), float32, m.
    :ivar angle_min: angle of the first beam, rad.
    :ivar increment: angle between beams, rad.
    :ivar stated_max: the sensor's maximum where the line states it, m, else inf.
    :ivar robot_pose: shape (3,), ``odom_T_base``.
    :ivar laser_pose: shape (3,), the line's pose of the laser, in the frame of the odometry or a corrected one.
    :ivar is_front: whether the line is FLASER, which has no angles and no maximum.
    """

    ranges: NDArray[np.float32]
    angle_min: float
    increment: float
    stated_max: float
    robot_pose: NDArray[np.float64]
    laser_pose: NDArray[np.float64]
    is_front: bool


class _StampedLine(NamedTuple):
    """The pose (3,) of an ODOM line, or a scan, with its stamp, ns."""

    stamp: int
    content: NDArray[np.float64] | _Sweep


@dataclass
class _ParsedFile:
    """The content of a file, without the lines of poses that cannot be right."""

    readings: deque[_StampedLine] = field(default_factory=deque)
    left_out: LeftOut = field(default_factory=LeftOut)
    front_laser_offset: float = 0.0


def is_carmen(content: bytes) -> bool:
    """Whether a line of CARMEN is in the first 64 kB."""
    return _KNOWN_LINE.search(content[:65536]) is not None


def open_carmen(path: Path, file: io.BytesIO, window: TimeWindow) -> InMemoryLog:
    """A CARMEN log, in file order.

    Odometry is read from ODOM lines and, with each scan, from the ``odom_*`` fields of FLASER or the robot pose of
    ROBOTLASER1. The stamp is the ``ipc_timestamp``. FLASER states no angles: the sweep begins at -90 degrees; an odd
    number of beams includes both ends of the half circle, an even one excludes the last. Nor does it state the sensor's
    maximum, which `no_return_threshold` finds from all scans together.

    :param path: path of the file, for the name of the log.
    :param file: content of the file, decompressed; closed once it is read, so that it takes no more memory.
    :param window: part of the log to read.
    :raises HmtSlamError: where a line is cut off or malformed, or there is no scan.
    """
    with file, np.errstate(over="ignore"):  # a range beyond float32 is infinite, so there is no return
        parsed = _parse(file, path.name)
    limits, mountings = _common_properties(parsed)
    return InMemoryLog(_stem(path), _entries(parsed.readings, limits, mountings), window, parsed.left_out)


def _stem(path: Path) -> str:
    return Path(path.stem).stem if path.suffix in {".gz", ".xz"} else path.stem


def _common_properties(parsed: _ParsedFile) -> tuple[dict[float, float], _Mountings]:
    """The limits of the ranges and the mountings of the laser, which all scans together show."""
    sweeps = [reading.content for reading in parsed.readings if isinstance(reading.content, _Sweep)]
    return _range_limits(sweeps), _Mountings(sweeps, parsed.front_laser_offset)


def _entries(readings: deque[_StampedLine], limits: dict[float, float], mountings: _Mountings) -> Iterator[LogEntry]:
    """The measurements; the readings are removed one by one, so that the log is not twice in memory."""
    while readings:
        stamp, content = readings.popleft()
        if isinstance(content, _Sweep):
            yield LogEntry(stamp, Odometry, (content.robot_pose,), precedes_its_scan=True)
            limit = limits[content.stated_max]
            geometry = (content.angle_min, content.increment, 0.0, limit, mountings.laser_pose_of(content))
            yield LogEntry(stamp, Scan, (content.ranges, *geometry))
        else:
            yield LogEntry(stamp, Odometry, (content,))


def _parse(file: io.BytesIO, name: str) -> _ParsedFile:
    parsed = _ParsedFile()
    # Line by line: splitting all at once would fragment as much memory as the log takes.
    for number, line in enumerate(file, start=1):
        if len(line) > _MAX_LINE:
            raise HmtSlamError(
                f"line {number} of {name} has {len(line)} bytes, more than {_MAX_LINE}: copy the log anew."
            )
        tokens = line.split()
        if not tokens:
            continue
        try:
            if tokens[0] in _PARSERS:
                reading = _PARSERS[tokens[0]](tokens)
                if parsed.left_out.admits(partial(_check_poses, reading)):
                    parsed.readings.append(reading)
            elif tokens[:2] == [b"PARAM", _FRONT_LASER_OFFSET]:
                parsed.front_laser_offset = _front_laser_offset(tokens)
            elif any(kind.startswith(tokens[0]) for kind in _PARSERS):
                raise ValueError("cut off within its first word")
        except (ValueError, IndexError):
            end = "" if line.endswith(b"\n") else " (the last one)"
            raise HmtSlamError(
                f"line {number}{end} of {name} is cut off or malformed: copy the log anew or remove that line."
            ) from None
    return parsed


def _check_poses(reading: _StampedLine) -> None:
    """Check the poses of a line, before the mounting of the laser is found from all of them.

    :raises HmtSlamError: where one cannot be right.
    """
    if isinstance(reading.content, _Sweep):
        check_planar_pose(reading.content.robot_pose, "the robot's pose", MAX_COORDINATE)
        check_planar_pose(reading.content.laser_pose, "the laser's pose", MAX_COORDINATE)
    else:
        check_planar_pose(reading.content, "pose", MAX_COORDINATE)


def _front_laser_offset(tokens: list[bytes]) -> float:
    offset = float(tokens[2])
    if not abs(offset) <= MAX_LASER_OFFSET:
        raise ValueError("no offset of a laser")
    return offset


def _parse_odom(tokens: list[bytes]) -> _StampedLine:
    """``ODOM x y theta tv rv accel`` and the trailer."""
    return _StampedLine(_stamp(tokens, 7), _pose(tokens, 1))


def _parse_flaser(tokens: list[bytes]) -> _StampedLine:
    """``FLASER n r1..rn x y theta odom_x odom_y odom_theta`` and the trailer."""
    count = _count(tokens[1])
    stamp = _stamp(tokens, 2 + count + 6)
    laser_pose, robot_pose = _pose(tokens, 2 + count), _pose(tokens, 5 + count)
    increment = np.pi / max(count - count % 2, 1)
    ranges = _ranges(tokens, 2, count)
    return _StampedLine(stamp, _Sweep(ranges, -np.pi / 2, increment, np.inf, robot_pose, laser_pose, is_front=True))


def _parse_robotlaser(tokens: list[bytes]) -> _StampedLine:
    """A scan with its geometry.

    ``ROBOTLASER1 type start_angle field_of_view resolution maximum_range accuracy remission_mode n r1..rn
    m s1..sm laser_x laser_y laser_theta robot_x robot_y robot_theta tv rv`` three safety fields and the trailer.
    """
    start, field_of_view, resolution, maximum = map(float, tokens[2:6])
    count = _count(tokens[8])
    poses_at = 10 + count + _count(tokens[9 + count])
    stamp = _stamp(tokens, poses_at + 6 + 5)
    laser_pose, robot_pose = _pose(tokens, poses_at), _pose(tokens, poses_at + 3)
    increment = resolution if resolution > 0.0 else field_of_view / max(count - 1, 1)
    ranges = _ranges(tokens, 9, count)
    limit = maximum if maximum > 0.0 else np.inf
    return _StampedLine(stamp, _Sweep(ranges, start, increment, limit, robot_pose, laser_pose, is_front=False))


_PARSERS: dict[bytes, Callable[[list[bytes]], _StampedLine]] = {
    b"ODOM": _parse_odom,
    b"FLASER": _parse_flaser,
    b"ROBOTLASER1": _parse_robotlaser,
}


def _stamp(tokens: list[bytes], at: int) -> int:
    """The stamp at the beginning of the trailer, which must be complete and end the line."""
    if len(tokens) != at + _TRAILER:
        raise ValueError("wrong number of fields")
    return stamp_from_seconds(tokens[at].decode())


def _count(token: bytes) -> int:
    count = int(token)
    if count < 0:
        raise ValueError("fewer than no readings")
    return count


def _ranges(tokens: list[bytes], begin: int, count: int) -> NDArray[np.float32]:
    return np.fromiter(map(float, tokens[begin : begin + count]), np.float32, count)


def _pose(tokens: list[bytes], begin: int) -> NDArray[np.float64]:
    x, y, theta = tokens[begin : begin + 3]
    return np.array((float(x), float(y), float(theta)))


def _range_limits(sweeps: Sequence[_Sweep]) -> dict[float, float]:
    """{maximum stated by lines, m, inf for none: smallest range that means "no return", m}.

    Sensors that state a maximum often report a smaller value for "no return", which is searched too.
    """
    by_maximum: dict[float, list[NDArray[np.float32]]] = {}
    for sweep in sweeps:
        by_maximum.setdefault(sweep.stated_max, []).append(sweep.ranges)
    limits = {}
    for stated, parts in by_maximum.items():
        ranges = np.concatenate(parts)
        ranges.sort()
        limits[stated] = min(_threshold_of_sorted(ranges), float(np.float32(stated)))
    return limits


class _Mountings:
    """``base_T_laser`` of each scan.

    ROBOTLASER1 has both poses. The first pose of FLASER is the laser's by odometry, or a corrected pose of the robot.
    Only the former has a constant offset from the odometry, which is then the mounting. Otherwise the mounting is the
    robot_frontlaser_offset of the log, or the origin.
    """

    def __init__(self, sweeps: Sequence[_Sweep], front_laser_offset: float) -> None:
        self._known = self._inverses = np.empty((0, 3))
        front = _constant_offset([sweep for sweep in sweeps if sweep.is_front])
        self._front = np.array([front_laser_offset, 0.0, 0.0]) if front is None else front

    def laser_pose_of(self, sweep: _Sweep) -> NDArray[np.float64]:
        """``base_T_laser``, shape (3,); offsets that differ by rounding are replaced by the first of them.

        :raises HmtSlamError: where there are too many.
        """
        if sweep.is_front:
            return self._front
        offset = se2.between(sweep.robot_pose, sweep.laser_pose)
        same = np.flatnonzero((np.abs(se2.compose(self._inverses, offset)) < _SAME_OFFSET).all(axis=1))
        if not same.size:
            if len(self._known) == _MAX_OFFSETS:
                raise HmtSlamError(
                    f"the laser has more than {_MAX_OFFSETS} poses on the robot: give a log with a laser that is fixed."
                )
            self._known = np.vstack([self._known, np.round(offset, 4)])
            self._inverses = se2.inverse(self._known)
            return self._known[-1]
        known: NDArray[np.float64] = self._known[same[0]]
        return known


def _constant_offset(sweeps: Sequence[_Sweep]) -> NDArray[np.float64] | None:
    if len(sweeps) < _MIN_SCANS_FOR_OFFSET:
        return None
    robot = np.array([sweep.robot_pose for sweep in sweeps])
    offsets = se2.between(robot, np.array([sweep.laser_pose for sweep in sweeps]))
    middle = np.round(np.median(offsets, axis=0), 4)
    constant = bool(np.all(np.abs(se2.between(middle, offsets)) < _SAME_OFFSET))
    apart = np.abs(middle).max() > _SAME_OFFSET and np.hypot(*middle[:2]) < _LARGEST_OFFSET
    return middle if constant and apart else None
