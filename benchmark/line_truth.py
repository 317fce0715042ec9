"""True walls of a simulated scan as lines, and the line that each beam hits."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation.building import furniture_walls
from hmt_slam_ros.simulation.scenario import Scenario

Array = NDArray[np.float64]

_ON = 1e-4  # largest distance of a hit from its wall, m
_DECIMALS = 6  # of radians and meters, to which walls on one line agree


class TrueScan(NamedTuple):
    """A scan with the true lines.

    :ivar scan: of the laser, corrected for the true motion during its sweep.
    :ivar lines: shape (n, 2), alpha and r of the lines on which walls and furniture lie, in the robot's frame, rad, m;
        with the same numbers at all times without a change of furniture.
    :ivar hit_lines: shape (k,), the line that each beam with a return hits, -1 for a person.
    :ivar ends: shape (k, 2), true end points of these beams, m, in that frame.
    """

    scan: Scan
    lines: Array
    hit_lines: NDArray[np.int64]
    ends: Array


def lines_of(walls: Array) -> Array:
    """alpha in [-pi, pi) and r >= 0, shape (n, 2), rad and m, of the lines through walls (n, 4)."""
    alpha = np.arctan2(walls[:, 2] - walls[:, 0], walls[:, 1] - walls[:, 3])
    r = walls[:, 0] * np.cos(alpha) + walls[:, 1] * np.sin(alpha)
    return np.stack((se2.wrap(np.where(r < 0.0, alpha + np.pi, alpha)), np.abs(r)), axis=1)


def line_difference(line: Array, other: Array) -> Array:
    """other - line, both (..., 2), in the representation of the other line with the nearer angle."""
    turn = se2.wrap(other[..., 0] - line[..., 0])
    opposite = np.abs(turn) > 0.5 * np.pi
    away = np.where(opposite, -other[..., 1], other[..., 1]) - line[..., 1]
    return np.stack((np.where(opposite, se2.wrap(turn - np.pi), turn), away), axis=-1)


def true_scan(scenario: Scenario, number: int) -> TrueScan:
    """A scan of a drive by its number, with the true lines."""
    scan, laser = scenario.scan(number), scenario.laser
    poses = scenario.true_poses(scan.stamp + np.round(1e9 * laser.times).astype(np.int64))
    scan = replace(scan, motion=se2.log(se2.between(poses[0], poses[-1])))
    distances = scenario.distances(number)[scan.valid]
    angles = laser.angles[scan.valid]
    local = np.stack((distances * np.cos(angles), distances * np.sin(angles)), axis=1)
    at_beams = poses[scan.valid] if len(poses) > 1 else poses
    ends = se2.transform(se2.compose(se2.between(poses[0], at_beams), laser.pose), local)
    walls, numbers, lines = _surfaces(scenario, scan.stamp, poses[0])
    wall = _hit_walls(walls, ends)
    return TrueScan(scan, lines, np.where(wall < 0, -1, numbers[wall]), ends)


def true_lines(scenario: Scenario, stamp: int, pose: Array) -> Array:
    """alpha and r (n, 2), rad and m, of the lines of `Seen` at a stamp, in the frame of a pose (3,)."""
    return _surfaces(scenario, stamp, pose)[2]


def _surfaces(scenario: Scenario, stamp: int, pose: Array) -> tuple[Array, NDArray[np.int64], Array]:
    """Walls and furniture (m, 4) in a frame, the number of the line of each, (m,), and those lines, (n, 2)."""
    world = np.concatenate((scenario.building.walls, furniture_walls(scenario.furniture(stamp))))
    _, numbers = np.unique(np.round(lines_of(world), _DECIMALS), axis=0, return_inverse=True)
    walls, numbers = se2.transform(se2.inverse(pose), world.reshape(-1, 2)).reshape(-1, 4), numbers.reshape(-1)
    lines = np.empty((numbers.max() + 1, 2))
    lines[numbers] = lines_of(walls)
    return walls, numbers, lines


def _hit_walls(walls: Array, ends: Array) -> NDArray[np.int64]:
    """The index of the wall (n, 4) on which each point (k, 2) lies, shape (k,), -1 for none."""
    starts, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    away = ends[:, None] - starts[None]
    share = np.clip((away * along).sum(axis=2) / (along**2).sum(axis=1), 0.0, 1.0)
    off = np.linalg.norm(away - share[..., None] * along, axis=2)
    nearest = np.argmin(off, axis=1)
    return np.where(off[np.arange(len(ends)), nearest] < _ON, nearest, -1)
