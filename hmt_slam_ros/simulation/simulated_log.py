"""Simulated logs, made while they are read, and the truth about their loop closures.

The truth is by walls alone: which poses are in one place, and how much of the walls they see in common.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import SIMULATION_PREFIX, LogRecord, TimeWindow, require_scans
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.simulation.laser import Laser, WallIndex, has_line_of_sight
from hmt_slam_ros.simulation.scenario import Scenario
from hmt_slam_ros.simulation.settings import chosen_settings, parse_name
from hmt_slam_ros.simulation.worlds import FAMILIES, read_world

_SHORT_OF_WALL = 0.01
"""Distance before a point on a wall at which its line of sight ends, m."""

_STAMP_STEP = 1_000
"""Time between the stamps of two scans at one time, ns."""

_SLACK = 1e-9
"""Tolerance of the field of view, which includes the outermost beams, rad."""


def same_place(
    walls: WallIndex, poses: NDArray[np.float64], others: NDArray[np.float64], radius: float
) -> NDArray[np.bool_]:
    """Whether two poses are within a radius of each other with no wall between them.

    :param poses: shape (n, 3), m and rad.
    :param others: shape (m, 3).
    :param radius: m.
    :returns: shape (n, m).
    """
    one, other = poses[:, :2], others[:, :2]
    near = np.hypot(*(one[:, None] - other[None]).transpose(2, 0, 1)) <= radius
    rows, columns = np.nonzero(near)
    near[rows, columns] = has_line_of_sight(walls, one[rows], other[columns])
    return near


def shared_view(
    walls: WallIndex, laser: Laser, poses: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Share of the visible walls that two poses of a laser have in common.

    It is the mean of two shares: of the points visible from the one that are visible from the other, and vice versa; 0
    if one of them sees no wall.

    :param poses: shape (n, 3), ``world_T_base``, m and rad.
    :param others: shape (m, 3).
    :returns: shape (n, m), from 0 to 1.
    """
    lasers, other_lasers = se2.compose(poses, laser.pose), se2.compose(others, laser.pose)
    points, other_points = (_visible_wall_points(walls, laser, p) for p in (poses, others))
    shares = np.zeros((len(poses), len(others)))
    near = np.hypot(*(lasers[:, None, :2] - other_lasers[None, :, :2]).transpose(2, 0, 1)) < 2.0 * laser.reach
    for i, k in zip(*np.nonzero(near), strict=True):
        if len(points[i]) and len(other_points[k]):
            there = _is_visible(walls, laser, other_lasers[k], points[i])
            here = _is_visible(walls, laser, lasers[i], other_points[k])
            shares[i, k] = 0.5 * (there.mean() + here.mean())
    return shares


def _visible_wall_points(walls: WallIndex, laser: Laser, poses: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """End points on walls of the beams of each pose, (k, 2) each, m, in the world."""
    ends = []
    for pose in poses:
        distances = laser.distances(pose[None], walls, np.empty((0, 3)))
        met = np.isfinite(distances)
        angles, ranges = laser.angles[met], distances[met]
        local = np.stack((ranges * np.cos(angles), ranges * np.sin(angles)), axis=1)
        ends.append(se2.transform(se2.compose(pose, laser.pose), local))
    return ends


def _is_visible(
    walls: WallIndex, laser: Laser, eye: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether points on walls (k, 2) are visible to a laser at ``world_T_laser`` (3,), shape (k,)."""
    local = se2.transform(se2.inverse(eye), points)
    distances = np.hypot(local[:, 0], local[:, 1])
    in_field = np.abs(np.arctan2(local[:, 1], local[:, 0])) <= laser.half_field + _SLACK
    ends = points + (eye[:2] - points) * np.minimum(1.0, _SHORT_OF_WALL / np.maximum(distances, 1e-9))[:, None]
    starts = np.tile(eye[:2], (len(points), 1))
    return in_field & (distances < laser.reach) & has_line_of_sight(walls, starts, ends)


class SimulatedLog:
    """A simulated drive as a log; every record has the true pose.

    :ivar name: world and settings.
    :ivar scenario: the simulated world.
    :ivar scan_count: number of scans.
    :ivar duration: from the first to the last record, s.
    """

    def __init__(self, name: str, scenario: Scenario, window: TimeWindow) -> None:
        self.name, self.scenario = name, scenario
        self._part = window.select(scenario.stamps)
        rows = np.arange(scenario.stamps.size)[self._part]
        between = rows % scenario.settings.readings
        self.scan_count = int((between == 0).sum())
        if scenario.rear_laser is not None:
            self.scan_count += int((between == scenario.settings.readings // 2).sum())
        require_scans(name, self.scan_count, scenario.stamps.size)
        self.duration = float(scenario.stamps[rows[-1]] - scenario.stamps[rows[0]]) / NANOSECONDS

    def true_poses(self, stamps: NDArray[np.int64]) -> NDArray[np.float64]:
        """``world_T_base`` (n, 3), m and rad, at any stamps (n,), ns."""
        return self.scenario.true_poses(stamps)

    def same_place(self, stamps: NDArray[np.int64], others: NDArray[np.int64], radius: float) -> NDArray[np.bool_]:
        """Whether the robot was in the same place at two times: within a radius, with no wall between.

        :param stamps: shape (n,), ns.
        :param others: shape (m,), ns.
        :param radius: m, such as ``tsbi.place_radius``.
        :returns: shape (n, m).
        """
        return same_place(self.scenario.walls, self.true_poses(stamps), self.true_poses(others), radius)

    def shared_view(self, stamps: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.float64]:
        """Share of visible walls that two times have in common, from 0 to 1; shapes as of `same_place`."""
        scenario = self.scenario
        return shared_view(scenario.walls, scenario.laser, self.true_poses(stamps), self.true_poses(others))

    def records(self) -> Iterator[LogRecord]:
        """All measurements in the order of time, each scan after the odometry and the marks of the same stamp."""
        scenario = self.scenario
        for k in range(self._part.start, self._part.stop):
            stamp, truth = int(scenario.stamps[k]), scenario.poses[k]
            yield LogRecord(stamp, Odometry(stamp, scenario.odometry[k]), truth)
            scan, between = divmod(k, scenario.settings.readings)
            if not between:
                yield from (LogRecord(stamp, mark) for mark in scenario.marks.observe(scan, stamp))
                yield LogRecord(stamp, scenario.scan(scan), truth)
            if scenario.rear_laser is not None and between == scenario.settings.readings // 2:
                # Of two scans at one time, the stamp of the second is the next one.
                own_stamp = stamp if between else stamp + _STAMP_STEP
                yield LogRecord(own_stamp, scenario.rear_scan(scan, own_stamp), truth)


def open_simulated(log: str | Path, window: TimeWindow | None = None) -> SimulatedLog:
    """Make the drive that ``sim:WORLD,name=value,...`` names.

    :param log: WORLD is the name of a family or the path of a world file (.yaml).
    :param window: the part wanted, None for all.
    :raises HmtSlamError: for an unknown world or setting, or a route too close to a wall.
    """
    world, given = parse_name(log)
    if world in FAMILIES:
        family = FAMILIES[world]
        settings = chosen_settings(family.default_settings, given)
        draw = random_stream(settings.seed, Purpose.BUILDING, 0)
        building = family.build(draw, settings)
        # The axes and origin of the world differ from those of the map.
        building = building.transform(np.array([*draw.uniform(-50.0, 50.0, 2), draw.uniform(-np.pi, np.pi)]))
    elif Path(world).suffix in {".yaml", ".yml"}:
        building, own = read_world(Path(world))
        settings = chosen_settings(own, given)
    else:
        raise HmtSlamError(
            f"there is no simulated world {world!r}: choose one of {', '.join(FAMILIES)}, or give a .yaml file."
        )
    return SimulatedLog(str(log).removeprefix(SIMULATION_PREFIX), Scenario(building, settings), window or TimeWindow())
