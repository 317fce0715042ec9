"""True walls of simulated scans as lines, and the extracted lines compared with them."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.simulated.worlds import World
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.line_extraction import Lines, extract_lines
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.building import furniture_walls
from hmt_slam_ros.simulation.scenario import Scenario

_SCANS = 60  # of every drive
_ON = 1e-4  # largest distance of a hit from its wall, m
_DECIMALS = 6  # of radians and meters, to which walls on one line agree


class Line(NamedTuple):
    """A line on a true wall.

    :ivar nees: of alpha and r.
    :ivar alpha: deviation, rad.
    :ivar r: deviation, m.
    """

    nees: float
    alpha: float
    r: float


class ScanLines(NamedTuple):
    """The scores of the lines of one scan.

    :ivar lines: on true walls.
    :ivar strays: number of lines on no wall.
    :ivar visible_length: of the walls that beams hit, m.
    :ivar found_length: part of it that is on lines, m.
    :ivar seconds: of CPU time.
    """

    lines: tuple[Line, ...]
    strays: int
    visible_length: float
    found_length: float
    seconds: float


def extract_scans(world: World, laser: str, features: FeatureParameters) -> Iterator[ScanLines]:
    """The lines of scans of a drive.

    :param laser: settings that differ from the world's.
    """
    scenario = open_simulated(",".join(filter(None, (world.log, laser)))).scenario
    features = replace(features, range_deviation=scenario.settings.range_noise)
    extract_lines(scenario.scan(0), features)
    for number in np.unique(np.linspace(0, len(scenario.scan_stamps) - 1, _SCANS).astype(np.int64)).tolist():
        yield _extract_scan(scenario, number, features)


def _extract_scan(scenario: Scenario, number: int, features: FeatureParameters) -> ScanLines:
    scan = true_scan(scenario, number)
    begin = time.process_time()
    lines = extract_lines(scan.scan, features)
    seconds = time.process_time() - begin
    walls = walls_of(lines, scan)
    errors = line_difference(lines.parameters, scan.lines[walls])
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(lines.covariances), errors)
    deviations = np.sqrt(np.diagonal(lines.covariances, axis1=1, axis2=2))
    rows = np.column_stack((nees, deviations))[walls >= 0]
    visible_length, found_length = _wall_lengths(lines, walls, scan)
    return ScanLines(
        tuple(Line(*row) for row in rows.tolist()), int(np.sum(walls < 0)), visible_length, found_length, seconds
    )


def walls_of(lines: Lines, scan: TrueScan) -> NDArray[np.int64]:
    """The true line of each line, shape (n,), -1 for none."""
    walls = np.full(len(lines), -1)
    for k in range(len(lines)):
        numbers, counts = np.unique(scan.hit_lines[lines.labels == k], return_counts=True)
        most = int(np.argmax(counts))
        walls[k] = numbers[most] if 2 * counts[most] >= counts.sum() else -1
    return walls


def _wall_lengths(lines: Lines, walls: NDArray[np.int64], scan: TrueScan) -> tuple[float, float]:
    """Length of walls between adjacent beams that hit the same one, and the part on a line of that wall, m."""
    own = scan.hit_lines[1:]
    same = (own == scan.hit_lines[:-1]) & (own >= 0)
    first, second, own = scan.ends[:-1][same], scan.ends[1:][same], own[same]
    middles, lengths = 0.5 * (first + second), np.hypot(*(second - first).T)
    found = np.zeros(len(own), dtype=np.bool_)
    for (begin, end), owner in zip(lines.segments, lines.owners, strict=True):
        alpha = lines.parameters[owner, 0]
        along = middles @ np.array([-math.sin(alpha), math.cos(alpha)])
        found |= (own == walls[owner]) & (along >= begin) & (along <= end)
    return float(lengths.sum()), float(lengths[found].sum())


def mean_nees(drives: Sequence[Sequence[ScanLines]]) -> float:
    """Mean over drives of the mean within each."""
    means = [np.mean(own) for drive in drives if (own := [line.nees for scan in drive for line in scan.lines])]
    return float(np.mean(means)) if means else math.nan


def stray_share(drives: Sequence[Sequence[ScanLines]]) -> float:
    """Share of the lines on no wall."""
    strays = sum(scan.strays for drive in drives for scan in drive)
    lines = sum(len(scan.lines) for drive in drives for scan in drive)
    return strays / (lines + strays) if lines + strays else math.nan


def mean_milliseconds(drives: Sequence[Sequence[ScanLines]]) -> float:
    """Mean CPU time of a scan, ms."""
    return 1e3 * float(np.mean([scan.seconds for drive in drives for scan in drive]))


class TrueScan(NamedTuple):
    """A scan with the true lines.

    :ivar scan: of the laser, corrected for the true motion during its sweep.
    :ivar lines: shape (n, 2), alpha and r of the lines on which walls and furniture lie, in the robot's frame, rad, m;
        with the same numbers at all times without a change of furniture.
    :ivar hit_lines: shape (k,), the line that each beam with a return hits, -1 for a person.
    :ivar ends: shape (k, 2), true end points of these beams, m, in that frame.
    """

    scan: Scan
    lines: Float64
    hit_lines: NDArray[np.int64]
    ends: Float64


def lines_of(walls: Float64) -> Float64:
    """alpha in [-pi, pi) and r >= 0, shape (n, 2), rad and m, of the lines through walls (n, 4)."""
    alpha = np.arctan2(walls[:, 2] - walls[:, 0], walls[:, 1] - walls[:, 3])
    r = walls[:, 0] * np.cos(alpha) + walls[:, 1] * np.sin(alpha)
    return np.stack((se2.wrap(np.where(r < 0.0, alpha + np.pi, alpha)), np.abs(r)), axis=1)


def line_difference(line: Float64, other: Float64) -> Float64:
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


def true_lines(scenario: Scenario, stamp: int, pose: Float64) -> Float64:
    """alpha and r (n, 2), rad and m, of the lines of `Seen` at a stamp, in the frame of a pose (3,)."""
    return _surfaces(scenario, stamp, pose)[2]


def _surfaces(scenario: Scenario, stamp: int, pose: Float64) -> tuple[Float64, NDArray[np.int64], Float64]:
    """Walls and furniture (m, 4) in a frame, the number of the line of each, (m,), and those lines, (n, 2)."""
    world = np.concatenate((scenario.building.walls, furniture_walls(scenario.furniture(stamp))))
    _, numbers = np.unique(np.round(lines_of(world), _DECIMALS), axis=0, return_inverse=True)
    walls, numbers = se2.transform(se2.inverse(pose), world.reshape(-1, 2)).reshape(-1, 4), numbers.reshape(-1)
    lines = np.empty((numbers.max() + 1, 2))
    lines[numbers] = lines_of(walls)
    return walls, numbers, lines


def _hit_walls(walls: Float64, ends: Float64) -> NDArray[np.int64]:
    """The index of the wall (n, 4) on which each point (k, 2) lies, shape (k,), -1 for none."""
    starts, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    away = ends[:, None] - starts[None]
    share = np.clip((away * along).sum(axis=2) / (along**2).sum(axis=1), 0.0, 1.0)
    off = np.linalg.norm(away - share[..., None] * along, axis=2)
    nearest = np.argmin(off, axis=1)
    return np.where(off[np.arange(len(ends)), nearest] < _ON, nearest, -1)
