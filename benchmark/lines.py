"""Lines of single simulated scans, compared with the true walls."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.line_truth import TrueScan, line_difference, true_scan
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.landmarks.line_extraction import Lines, extract_lines
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.scenario import Scenario

_SCANS = 60  # of every drive


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
