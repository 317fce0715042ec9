"""Lines of single simulated scans, compared with the true walls."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.line_truth import Seen, difference, seen_in
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.landmarks.line_extraction import Lines, extract_lines
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.scenario import Scenario

_SCANS = 60  # of every drive


class Line(NamedTuple):
    """A line that has a wall.

    :ivar nees: of alpha and r.
    :ivar alpha: deviation, rad.
    :ivar r: deviation, m.
    """

    nees: float
    alpha: float
    r: float


class Scanned(NamedTuple):
    """What was found in one scan.

    :ivar lines: those that have a wall.
    :ivar strays: number of those on none.
    :ivar shown: length of the walls that beams met, m.
    :ivar found: what of it is on lines, m.
    :ivar seconds: of CPU time.
    """

    lines: tuple[Line, ...]
    strays: int
    shown: float
    found: float
    seconds: float


def scans_of(world: World, laser: str, features: FeatureParameters) -> Iterator[Scanned]:
    """What is found in scans of a drive.

    :param laser: settings that differ from the world's.
    """
    scenario = open_simulated(",".join(filter(None, (world.log, laser)))).scenario
    features = replace(features, range_deviation=scenario.settings.range_noise)
    extract_lines(scenario.scan(0), features)
    for number in np.unique(np.linspace(0, len(scenario.scan_stamps) - 1, _SCANS).astype(np.int64)).tolist():
        yield _scanned(scenario, number, features)


def _scanned(scenario: Scenario, number: int, features: FeatureParameters) -> Scanned:
    seen = seen_in(scenario, number)
    begin = time.process_time()
    lines = extract_lines(seen.scan, features)
    seconds = time.process_time() - begin
    walls = walls_of(lines, seen)
    errors = difference(lines.parameters, seen.lines[walls])
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(lines.covariances), errors)
    deviations = np.sqrt(np.diagonal(lines.covariances, axis1=1, axis2=2))
    rows = np.column_stack((nees, deviations))[walls >= 0]
    shown, found = _lengths(lines, walls, seen)
    return Scanned(tuple(Line(*row) for row in rows.tolist()), int(np.sum(walls < 0)), shown, found, seconds)


def walls_of(lines: Lines, seen: Seen) -> NDArray[np.int64]:
    """The true line of each line, shape (n,), -1 where it has none."""
    walls = np.full(len(lines), -1)
    for k in range(len(lines)):
        numbers, counts = np.unique(seen.met[lines.labels == k], return_counts=True)
        most = int(np.argmax(counts))
        walls[k] = numbers[most] if 2 * counts[most] >= counts.sum() else -1
    return walls


def _lengths(lines: Lines, walls: NDArray[np.int64], seen: Seen) -> tuple[float, float]:
    """Length of walls between neighbouring beams that met the same one, and what of it is on a line of that wall, m."""
    own = seen.met[1:]
    same = (own == seen.met[:-1]) & (own >= 0)
    first, second, own = seen.ends[:-1][same], seen.ends[1:][same], own[same]
    middles, lengths = 0.5 * (first + second), np.hypot(*(second - first).T)
    found = np.zeros(len(own), dtype=np.bool_)
    for (begin, end), owner in zip(lines.segments, lines.owners, strict=True):
        alpha = lines.parameters[owner, 0]
        along = middles @ np.array([-math.sin(alpha), math.cos(alpha)])
        found |= (own == walls[owner]) & (along >= begin) & (along <= end)
    return float(lengths.sum()), float(lengths[found].sum())


def mean_nees(drives: Sequence[Sequence[Scanned]]) -> float:
    """Mean over drives of the mean within each."""
    means = [np.mean(own) for drive in drives if (own := [line.nees for scan in drive for line in scan.lines])]
    return float(np.mean(means)) if means else math.nan


def stray_share(drives: Sequence[Sequence[Scanned]]) -> float:
    """Of all lines, those on no wall."""
    strays = sum(scan.strays for drive in drives for scan in drive)
    lines = sum(len(scan.lines) for drive in drives for scan in drive)
    return strays / (lines + strays) if lines + strays else math.nan


def milliseconds(drives: Sequence[Sequence[Scanned]]) -> float:
    """CPU time of a scan, mean."""
    return 1e3 * float(np.mean([scan.seconds for drive in drives for scan in drive]))
