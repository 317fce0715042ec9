"""The lines of single scans against the true walls, on simulated worlds, for lasers of several kinds."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.line_truth import Seen, difference, seen_in
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_families, chosen_seeds
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.configuration.landmarks import Features
from hmt_slam_ros.landmarks.line_extraction import Lines, extract_lines
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.scenario import Scenario

SEEDS = 4
"""Worlds of every family."""

FAMILIES = ("office", "busy", "nested", "twins", "hall")

LASERS = {
    "180°, 361 beams, 15 mm": "",
    "180°, 91 beams, 15 mm": "beams=91",
    "360°, 720 beams, 10 mm": "field_of_view=360,beams=720,range_noise=0.01",
    "240°, 683 beams to 5.6 m, 30 mm": "field_of_view=240,beams=683,range=5.6,range_noise=0.03",
    "270°, 1081 beams in 25 ms, 30 mm": (
        "field_of_view=270,beams=1081,range=30,range_noise=0.03,sweep=0.025,forward=0.2"
    ),
}
"""{name: settings of the simulated robot}."""

ALLOWED = (1.8, 2.2)
"""Between which the mean NEES has to be."""

COVERED = 5.991
"""Chi-square with 2 degrees of freedom at 95 %."""

_SCANS = 60  # of every drive
_STRAY = 0.01  # share of the lines that may lie on no wall
_FASTEST = 2.0  # ms a scan

POLICY = (
    f"{_SCANS} scans of every drive, evenly spread, each for itself; features.range_deviation is that of the laser. A "
    "line's wall is the one that most of its beams truly met, furniture being walls and walls on one line being one; "
    "where most met a person, or none has half of them, the line is on no wall. NEES: squared Mahalanobis distance of "
    "the true (alpha, r) from the line, under its covariance; 2 on average where the covariance is right. No line is "
    "left out, however far off. What averages are of is the mean of each drive; noise is drawn anew for every scan, so "
    "that errors of scans are independent. Found: share of the length of walls that beams truly met that lies within "
    "what was seen of a line of that wall."
)


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


def measure_lines(settings: Settings) -> Report:
    """Extract the lines of scans of simulated drives and compare them with the walls."""
    chosen = chosen_families(settings, FAMILIES)
    seeds = chosen_seeds(settings, SEEDS)
    features = load_configuration(PARAMETERS, list(settings.changes)).features
    drives = {
        (laser, family, seed): list(scans_of(World(family, seed), own, features))
        for laser, own in LASERS.items()
        for family in chosen
        for seed in seeds
    }
    report = Report("lines", "Lines of scans", seeds=seeds)
    low, high = ALLOWED
    everything = list(drives.values())
    for laser in LASERS:
        own = [drive for (name, _, _), drive in drives.items() if name == laser]
        report.requirements.append(Requirement(f"NEES of lines, {laser}", mean_nees(own), high, least=low))
    report.requirements += [
        Requirement("share of lines on no wall", stray_share(everything), _STRAY),
        Requirement("time of a scan", milliseconds(everything), _FASTEST, "ms"),
    ]
    for column, name in ((0, "laser"), (1, "family")):
        groups: dict[str, list[Sequence[Scanned]]] = {}
        for key, drive in drives.items():
            groups.setdefault(str(key[column]), []).append(drive)
        report.body.append(_table(name, groups))
    report.body.append(POLICY)
    report.data["nees"] = {
        ", ".join(map(str, key)): [line.nees for scan in drive for line in scan.lines] for key, drive in drives.items()
    }
    return report


def scans_of(world: World, laser: str, features: Features) -> Iterator[Scanned]:
    """What is found in scans of a drive.

    :param laser: settings that differ from the world's.
    """
    scenario = open_simulated(",".join(filter(None, (world.log, laser)))).scenario
    features = replace(features, range_deviation=scenario.settings.range_noise)
    extract_lines(scenario.scan(0), features)
    for number in np.unique(np.linspace(0, len(scenario.scan_stamps) - 1, _SCANS).astype(np.int64)).tolist():
        yield _scanned(scenario, number, features)


def _scanned(scenario: Scenario, number: int, features: Features) -> Scanned:
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
    for (begin, end), owner in zip(lines.pieces, lines.owners, strict=True):
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


def _table(name: str, groups: dict[str, list[Sequence[Scanned]]]) -> str:
    head = [name, "lines", "NEES, mean over drives", "worst drive", "within 95 %", "on no wall", "found"]
    head += ["2 sigma of alpha, mean [°]", "median", "2 sigma of r, mean [cm]", "median", "a scan [ms]"]
    rows = []
    for group, drives in groups.items():
        lines = np.array([line for drive in drives for scan in drive for line in scan.lines]).reshape(-1, 3)
        nees, alphas, radii = lines.T
        alphas, radii = 2.0 * np.degrees(alphas), 200.0 * radii
        shown, found = np.array([[scan.shown, scan.found] for drive in drives for scan in drive]).sum(axis=0)
        worst = max(mean_nees([drive]) for drive in drives)
        figures = [f"{mean_nees(drives):.2f}", f"{worst:.2f}", f"{100.0 * np.mean(nees <= COVERED):.1f} %"]
        shares = [f"{100.0 * stray_share(drives):.2f} %", f"{100.0 * found / shown:.1f} %"]
        sizes = [f"{value:.2f}" for values in (alphas, radii) for value in (values.mean(), np.median(values))]
        rows.append([group, str(len(lines)), *figures, *shares, *sizes, f"{milliseconds(drives):.2f}"])
    return table(head, rows)
