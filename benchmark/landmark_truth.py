"""True corners and openings around a simulated robot, by the definitions of `hmt_slam_ros.features`."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.simulation.building import furniture_walls
from hmt_slam_ros.simulation.laser import WallIndex, has_line_of_sight, wall_index
from hmt_slam_ros.simulation.scenario import Scenario

REACH = 6.0
"""Landmarks farther away, m, do not have to be found."""

_LEAST_ARM = 0.2  # smallest length of the arms of a corner, m
_BESIDE = 0.03  # distance from a surface of the points that are checked for visibility, m
_WIDE = math.radians(3.0)  # smallest visible angle of a wall
_CLEAR = 0.25  # smallest visible share of an opening's width
_JAMB = 0.3  # smallest visible length of wall beside it, m


_SAMPLES = 20  # over the width of an opening
_FLAT = 0.05  # sine of the smallest viewing angle through an opening
_ON = 1e-6  # m
_COS, _SIN = math.cos(0.1234), math.sin(0.1234)


class TrueLandmarks(NamedTuple):
    """Landmarks in the robot's frame.

    :ivar poses: shape (n, 3), as of `Corners` or `Openings`, m and rad.
    :ivar kinds: shape (n,), of a corner whether it is convex, of an opening its width, m.
    :ivar due: shape (n,), whether enough of it is visible that it has to be found.
    """

    poses: Float64
    kinds: Float64
    due: NDArray[np.bool_]


_NOTHING = TrueLandmarks(np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.bool_))


class Surroundings:
    """Walls, panels of closed doors and furniture around the robot, in its frame."""

    def __init__(self, scenario: Scenario, stamp: int, pose: Float64) -> None:
        building = scenario.building.walls
        everything = np.concatenate((building, furniture_walls(scenario.furniture(stamp))))
        is_panel = (building[:, None] == scenario.building.doors[None]).all(axis=2).any(axis=1)
        self.building, self._door_panels = _to_frame(building[~is_panel], pose), _to_frame(building[is_panel], pose)
        self.surfaces = _to_frame(everything, pose)
        self.index: WallIndex = wall_index(self.surfaces)

    def is_visible(self, points: Float64) -> NDArray[np.bool_]:
        """Which points (..., 2) are visible from the robot, shape (...)."""
        flat = np.ascontiguousarray(points.reshape(-1, 2))
        visible: NDArray[np.bool_] = has_line_of_sight(self.index, np.zeros_like(flat), flat)
        return visible.reshape(points.shape[:-1])

    def corners(self, features: FeatureParameters) -> TrueLandmarks:
        """All corners of surfaces at right angles, on the sides that face the robot."""
        parts = [self._corners_of(sign_a, sign_b, features) for sign_a in (1.0, -1.0) for sign_b in (1.0, -1.0)]
        return _concatenate(parts)

    def _corners_of(self, sign_a: float, sign_b: float, features: FeatureParameters) -> TrueLandmarks:
        walls = self.surfaces
        i, k = np.triu_indices(len(walls), 1)
        a, b = walls[i], walls[k]
        u, v = sign_a * _directions(a), sign_b * _directions(b)
        right = np.abs((u * v).sum(axis=1)) <= math.sin(math.radians(features.corner_angle))
        a, b, u, v = a[right], b[right], u[right], v[right]
        cross = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
        away = b[:, :2] - a[:, :2]
        share = (away[:, 0] * v[:, 1] - away[:, 1] * v[:, 0]) / cross
        at = a[:, :2] + share[:, None] * u
        arms = np.stack(
            [_arm_lengths(at, wall, along, features.corner_gap) for wall, along in ((a, u), (b, v))], axis=1
        )
        there = (arms >= _LEAST_ARM).all(axis=1)
        at, u, v, arms = at[there], u[there], v[there], arms[there]
        found = []
        for side in (1.0, -1.0):
            bisector = side * (u + v) / np.linalg.norm(u + v, axis=1)[:, None]
            visible = self.is_visible(at + 1.5 * _BESIDE * bisector)
            due = visible & (np.hypot(*at.T) <= REACH) & (arms >= features.min_length).all(axis=1)
            for along, other in ((u, v), (v, u)):
                due &= self._is_shown(at, along, side * other, features.min_length)
            heading = np.arctan2(bisector[:, 1], bisector[:, 0])
            poses = np.column_stack((at, heading))
            found.append(TrueLandmarks(poses[visible], np.full(visible.sum(), float(side < 0.0)), due[visible]))
        return _concatenate(found)

    def _is_shown(self, at: Float64, along: Float64, beside: Float64, length: float) -> NDArray[np.bool_]:
        """Whether a stretch of a surface is visible under a sufficient angle."""
        places = np.linspace(0.05, length, 8)
        points = at[:, None] + places[:, None] * along[:, None] + _BESIDE * beside[:, None]
        bearing = np.arctan2(points[..., 1], points[..., 0])
        return self.is_visible(points).all(axis=1) & (np.abs(se2.wrap(bearing[:, -1] - bearing[:, 0])) >= _WIDE)

    def openings(self, features: FeatureParameters) -> TrueLandmarks:
        """All deep gaps between the end of a wall and the next surface on its line, without furniture."""
        lengths = np.hypot(*(self.building[:, 2:] - self.building[:, :2]).T)
        walls = self.building[lengths >= features.min_length]
        ends = np.concatenate((walls[:, 2:], walls[:, :2]))
        units = np.concatenate((_directions(walls), -_directions(walls)))
        gaps = [gap for end, unit in zip(ends, units, strict=True) if (gap := self._gap(end, unit, features))]
        return _without_repetitions(_concatenate([_NOTHING, *gaps]))

    def _gap(self, end: Float64, along: Float64, features: FeatureParameters) -> TrueLandmarks | None:
        """The opening that begins at the end of a wall, None without one."""
        normal = np.array([-along[1], along[0]]) * (1.0 if along[0] * end[1] - along[1] * end[0] > 0.0 else -1.0)
        width, wall = self._next_on_line(end, along, normal)
        if not features.opening_min <= width <= features.opening_max:
            return None
        beside = _BESIDE * normal
        middle = end + 0.5 * width * along
        places = end + (np.arange(_SAMPLES) + 0.5)[:, None] / _SAMPLES * width * along
        is_free = np.stack((places - beside, places + beside, np.tile(end - 0.1 * along - beside, (_SAMPLES, 1))))
        behind = middle + features.opening_depth * normal
        if not self.is_free(np.concatenate((is_free.reshape(-1, 2), behind[None]))).all() or self._is_closed(
            middle, behind
        ):
            return None
        facing = places @ normal / np.hypot(*places.T)
        beyond = places * (1.0 + features.opening_depth / np.maximum(places @ normal, 1e-6))[:, None]
        through = self.is_visible(beyond) & (facing > _FLAT)
        jambs = end + np.array([-_JAMB, width + _JAMB])[: 1 + wall, None] * along - beside
        due = through.mean() >= _CLEAR and self.is_visible(jambs).all() and np.hypot(*middle) <= REACH
        pose = np.array([[*middle, math.atan2(normal[1], normal[0])]])
        return TrueLandmarks(pose, np.array([width]), np.array([due]))

    def _next_on_line(self, end: Float64, along: Float64, normal: Float64) -> tuple[float, bool]:
        """Distance from the end of a wall to the next surface on its line, m, and whether that is a wall."""
        ends = self.building.reshape(-1, 2, 2) - end
        at, off = ends @ along, ends @ normal
        on = np.abs(off) < _ON
        collinear = at[on.all(axis=1)].min(axis=1)
        crossing = ~on.all(axis=1) & (on.any(axis=1) | (off[:, 0] * off[:, 1] < 0.0))
        share = off[crossing, 0] / (off[crossing, 0] - off[crossing, 1])
        crossed = at[crossing, 0] + share * (at[crossing, 1] - at[crossing, 0])
        first = [part[part > _ON].min(initial=np.inf) for part in (collinear, crossed)]
        return float(min(first)), bool(first[0] <= first[1] + _ON)

    def _is_closed(self, before: Float64, behind: Float64) -> bool:
        """Whether a door panel is between two points."""
        ends, way = self._door_panels.reshape(-1, 2, 2) - before, behind - before
        sides = ends[..., 1] * way[0] - ends[..., 0] * way[1]
        across = sides[:, 0] * sides[:, 1] < 0.0
        a, b = ends[across, 0], ends[across, 1]
        share = sides[across, 0] / (sides[across, 0] - sides[across, 1])
        crossing_share = (a + share[:, None] * (b - a)) @ way / (way @ way)
        return bool(((crossing_share > 0.0) & (crossing_share < 1.0)).any())

    def is_free(self, points: Float64) -> NDArray[np.bool_]:
        """Which points (n, 2) are on the free side of the walls, (n,): rays from there cross an odd number of walls."""
        a, b = self.building[None, :, :2] - points[:, None], self.building[None, :, 2:] - points[:, None]
        # Rays have a slant that no wall has.
        turned = [part @ np.array([[_COS, -_SIN], [_SIN, _COS]]) for part in (a, b)]
        (ax, ay), (bx, by) = (np.moveaxis(part, -1, 0) for part in turned)
        over = (ay > 0.0) != (by > 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            x = ax - ay * (bx - ax) / (by - ay)
        return np.asarray((over & (x > 0.0)).sum(axis=1) % 2 == 1)


def _to_frame(walls: Float64, pose: Float64) -> Float64:
    """Walls (n, 4) in the frame of a pose (3,)."""
    return se2.transform(se2.inverse(pose), walls.reshape(-1, 2)).reshape(-1, 4)


def _directions(walls: Float64) -> Float64:
    """Unit vectors (n, 2) along walls (n, 4)."""
    away = walls[:, 2:] - walls[:, :2]
    return np.asarray(away / np.linalg.norm(away, axis=1)[:, None])


def _arm_lengths(at: Float64, walls: Float64, along: Float64, gap: float) -> Float64:
    """Lengths of walls (n, 4) from points (n, 2) on, m; 0 for those that begin beyond the gap."""
    ends = np.stack([((walls[:, k : k + 2] - at) * along).sum(axis=1) for k in (0, 2)], axis=1)
    return np.where(ends.min(axis=1) <= gap, ends.max(axis=1), 0.0)


def _concatenate(parts: list[TrueLandmarks]) -> TrueLandmarks:
    return TrueLandmarks(
        np.concatenate([part.poses for part in parts]),
        np.concatenate([part.kinds for part in parts]),
        np.concatenate([part.due for part in parts]),
    )


def _without_repetitions(truth: TrueLandmarks) -> TrueLandmarks:
    """Each opening once, due ones first."""
    kept: list[int] = []
    for k in np.argsort(~truth.due, kind="stable").tolist():
        if not np.any(are_near(truth.poses[kept], truth.poses[k], 0.1, 0.1)):
            kept.append(k)
    return TrueLandmarks(truth.poses[kept], truth.kinds[kept], truth.due[kept])


def are_near(poses: Float64, pose: Float64, distance: float, turn: float) -> NDArray[np.bool_]:
    """Which poses (n, 3) are within a distance, m, and an angle, rad, of another (3,)."""
    near = np.hypot(*(poses[:, :2] - pose[:2]).T) <= distance
    return np.asarray(near & (np.abs(se2.wrap(poses[:, 2] - pose[2])) <= turn))
