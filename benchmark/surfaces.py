"""True surfaces of a simulated visit, which of them could be seen, and how a map holds them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.occupancy_map import OCCUPIED, OccupancyImage
from hmt_slam_ros.simulation import SimulatedLog
from hmt_slam_ros.simulation.building import boxes
from hmt_slam_ros.simulation.laser import clear_between, clearance, wall_index

Points = NDArray[np.float64]

_SAMPLE = 0.05  # m, between points of a surface
_REACH, _LOOKS = 8.0, 3  # m from which a surface is seen, and scans of the visit that have to see it
_HELD = 0.1  # m from an occupied cell
_APART = 0.2  # m between surfaces of two visits
_SHORT = 0.02  # m, by which a line of sight ends before the surface
_EVERY = 4  # of the scans


class Surfaces(NamedTuple):
    """What stood in the building at a visit.

    :ivar walls: shape (n, 4), m, x and y of both ends: walls, closed doors and furniture.
    :ivar lasers: shape (k, 3), ``world_T_laser`` of some of the scans, m and rad.
    :ivar half_field: largest angle to either side at which the laser sees, rad.
    """

    walls: NDArray[np.float64]
    lasers: NDArray[np.float64]
    half_field: float

    @classmethod
    def of(cls, log: SimulatedLog) -> Surfaces:
        """Of a visit during which nothing is moved."""
        scenario = log.scenario
        poses = log.true_poses(scenario.scan_stamps[::_EVERY])
        walls = np.concatenate((scenario.walls.walls, boxes(scenario.building.furniture)))
        return cls(walls, se2.compose(poses, scenario.laser.pose), scenario.laser.half_field)

    def points(self) -> Points:
        """Points of all surfaces, shape (m, 2)."""
        parts = []
        for x0, y0, x1, y1 in self.walls:
            steps = np.linspace(0.0, 1.0, 2 + int(np.hypot(x1 - x0, y1 - y0) / _SAMPLE))[:, None]
            parts.append(np.array([x0, y0]) + steps * np.array([x1 - x0, y1 - y0]))
        return np.concatenate(parts)

    def in_view(self, points: Points) -> NDArray[np.bool_]:
        """Which points (m, 2) enough scans have a free line of sight to."""
        index, counts = wall_index(self.walls), np.zeros(len(points), dtype=np.int64)
        for laser in self.lasers:
            seen = se2.transform(se2.inverse(laser), points)
            near = np.flatnonzero(
                (np.hypot(*seen.T) <= _REACH) & (np.abs(np.arctan2(seen[:, 1], seen[:, 0])) <= self.half_field)
            )
            away = points[near] - laser[:2]
            ends = laser[:2] + away * (1.0 - _SHORT / np.hypot(*away.T))[:, None]
            counts[near] += clear_between(index, np.broadcast_to(laser[:2], ends.shape).copy(), ends)
        return counts >= _LOOKS


class Judgement(NamedTuple):
    """How a map follows a change.

    :ivar new: share of the new surfaces that could be seen that is in the map.
    :ivar gone: share of the surfaces in the map before that could be seen to be gone that still is.
    :ivar kept: share of the surfaces in the map before that still stand where they did that is in the map after.
    :ivar metres: of the new ones and of those that could be seen to be gone.
    :ivar hidden: shape (k, 4), the surfaces that are gone and could not be seen to be, as short pieces.
    """

    new: float
    gone: float
    kept: float
    metres: tuple[float, float]
    hidden: NDArray[np.float64]


def judged(images: Sequence[OccupancyImage], frames: Sequence[Points], visits: Sequence[Surfaces]) -> Judgement:
    """How the second of two maps follows what changed between two visits.

    :param frames: ``world_T_map`` of each, shape (3,).
    """
    before, after = visits
    points = after.points()
    new = points[clearance(before.walls, points) > _APART]
    new = new[after.in_view(new)]
    points = before.points()
    points = points[_held(images[0], frames[0], points)]
    apart = clearance(after.walls, points)
    gone, stands = points[apart > _APART], points[apart < _SHORT]
    shown = after.in_view(gone)
    metres = _SAMPLE * len(new), _SAMPLE * int(shown.sum())
    found, ghosts, kept = (_held(images[1], frames[1], part) for part in (new, gone[shown], stands))
    hidden = np.concatenate((gone[~shown], gone[~shown] + 1e-3), axis=1)
    return Judgement(_share(found), _share(ghosts), _share(kept), metres, hidden)


def unexplained(image: OccupancyImage, frame: Points, walls: NDArray[np.float64]) -> float:
    """Share of the occupied cells that are far from all surfaces.

    :param frame: ``world_T_map``, shape (3,).
    """
    return float(np.mean(clearance(np.ascontiguousarray(walls), _cells(image, frame)) > _APART))


def _cells(image: OccupancyImage, frame: Points) -> Points:
    """The middles of the occupied cells, shape (n, 2), world frame."""
    row, column = np.nonzero(image.pixels[::-1] == OCCUPIED)
    cells = image.origin + image.resolution * (np.stack((column, row), axis=1) + 0.5)
    return np.ascontiguousarray(se2.transform(frame, cells))


def _held(image: OccupancyImage, frame: Points, points: Points) -> NDArray[np.bool_]:
    """Which points (n, 2), world frame, have an occupied cell beside them."""
    cells = _cells(image, frame)
    return np.asarray(clearance(np.concatenate((cells, cells), axis=1), points) <= _HELD, dtype=np.bool_)


def _share(found: NDArray[np.bool_]) -> float:
    return float(np.mean(found)) if len(found) else float("nan")
