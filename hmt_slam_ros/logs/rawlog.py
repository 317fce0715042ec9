"""MRPT rawlogs: scans with the actions between them, or a plain sequence of observations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.entries import Entry, EntryLog, Window
from hmt_slam_ros.logs.mounting import planar_mounting
from hmt_slam_ros.logs.mrpt_objects import Actions, Frame, Movement, ObjectStream, OdometryReading, RangeScan
from hmt_slam_ros.sensing import Odometry, Scan

_TICKS_TO_1970 = 116_444_736_000_000_000  # MRPT counts 100 ns ticks from the year 1601


def open_rawlog(path: Path, content: bytes, window: Window) -> EntryLog:
    """An MRPT rawlog.

    In the action-observation form, the odometry increments of the actions are summed up from the origin; the sum is
    the odometry reading of the first scan of the observations that follow. Where the log also has absolute
    odometry readings, those are used and the increments are left out.

    :param path: for the name.
    :param content: the file, decompressed.
    :param window: the part wanted.
    :raises HmtSlamError: where the file is truncated, holds an object of an unknown class or version, or no scan.
    """
    objects = list(ObjectStream(content, path.name))
    absolute = any(isinstance(reading, OdometryReading) for reading in _observations(objects))
    entries = _entries(objects, path.name, with_increments=not absolute)
    return EntryLog(path.stem, list(entries), window)


def _observations(objects: Iterable[object]) -> Iterator[object]:
    for item in objects:
        if isinstance(item, Frame):
            yield from item.observations
        else:
            yield item


def _entries(objects: Iterable[object], name: str, *, with_increments: bool) -> Iterator[Entry]:
    odom_T_base = np.zeros(3)
    due = with_increments  # an odometry reading is due at the first scan behind an action, and at the first of all
    for item in _observations(objects):
        if isinstance(item, Actions) and with_increments:
            odom_T_base = se2.compose(odom_T_base, _increment(item, name))
            due = True
        elif isinstance(item, OdometryReading):
            yield Entry(_stamp(item.ticks, name), Odometry, (item.pose,))
        elif isinstance(item, RangeScan):
            stamp = _stamp(item.ticks, name)
            if due:
                yield Entry(stamp, Odometry, (odom_T_base,), precedes_its_scan=True)
            due = False
            yield Entry(stamp, Scan, _scan_fields(item, name))


def _stamp(ticks: int, name: str) -> int:
    if ticks <= _TICKS_TO_1970:
        raise HmtSlamError(f"{name} has a measurement without a time stamp: give a log that was recorded with stamps.")
    return (ticks - _TICKS_TO_1970) * 100


def _increment(actions: Actions, name: str) -> NDArray[np.float64]:
    """The movement by wheel odometry where there is one, else the first of any kind, shape (3,)."""
    movements = [action for action in actions.actions if isinstance(action, Movement)]
    movements.sort(key=lambda movement: not movement.by_odometry)
    if not movements:
        raise HmtSlamError(f"{name} has an action without a movement of the robot: give a log with wheel odometry.")
    return movements[0].increment


def _scan_fields(scan: RangeScan, name: str) -> tuple[object, ...]:
    """The fields of `Scan` behind the stamp. The beams span the aperture, ends included."""
    mounting = planar_mounting(scan.sensor_pose, f"the laser of {name}")
    side = mounting.side if scan.right_to_left else -mounting.side
    ranges = scan.ranges.copy()
    # The flag is the only mark of some faulty beams: their range lies inside the limits.
    ranges[(scan.valid == 0) & (ranges < scan.max_range)] = np.nan
    increment = scan.aperture / max(ranges.size - 1, 1)
    time_increment = scan.sweep_duration / max(ranges.size - 1, 1)
    angle_min = -0.5 * side * scan.aperture
    return ranges, angle_min, side * increment, 0.0, scan.max_range, mounting.laser_pose, time_increment
