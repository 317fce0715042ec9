"""Corners and openings against the true ones, in real scans all around and in virtual ones from half a circle."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from benchmark.evidence import fitted
from benchmark.landmark_scans import (
    AROUND,
    BEAMS,
    CORNERS,
    FAR,
    LASERS,
    OPENINGS,
    SCANS,
    UNKNOWN,
    VIRTUAL,
    Found,
    Landmark,
    Scanned,
    scans_of,
)
from benchmark.landmark_truth import REACH
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_families, chosen_seeds
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration import load_configuration

SEEDS = 8
"""Worlds of every family."""

FAMILIES = ("office", "busy", "nested")

COVERED = 7.815
"""Chi-square with 3 degrees of freedom at 95 %."""

# What is asked of landmarks of either kind and of any laser.
_FOUND, _FALSE, _NEES, _CALIBRATED = 0.8, 0.03, (2.4, 3.6), 0.05
_CAST, _EXTRACTED = 2.0, 5.0  # ms
_CONFIDENT = 0.5

POLICY = (
    f"{SCANS} scans of every drive, evenly spread. Virtual scans, {BEAMS} beams up to {FAR:g} m, are cast in a map "
    f"of the keyframes so far within {AROUND:g} m, at true poses with deviations of 1 cm and 0.2 degrees each. A "
    "landmark is true where there is one of its kind within 0.3 m (corners) or 0.5 m (openings) and half a radian; "
    "furniture makes corners, and no openings. NEES is that of x, y and heading, 3 on average where the covariance is "
    f"right. Had to be found: true landmarks within {REACH:g} m that are in sight: both walls of a corner for 0.5 m "
    "and under 3 degrees, a quarter of an opening's width and both its jambs; for virtual scans, where at most "
    f"{100.0 * UNKNOWN:g} % of the beams to it come into unknown ground before it. Expected calibration error: mean "
    "distance between confidence and share of true ones over ten bins of equal width, weighted by what is in them."
)


def measure_landmarks(settings: Settings) -> Report:
    """Extract landmarks in simulated drives and compare them with the true ones."""
    chosen = chosen_families(settings, FAMILIES)
    seeds = chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    drives = {
        (laser, family): [scan for seed in seeds for scan in scans_of(World(family, seed), laser, configuration)]
        for laser in LASERS
        for family in chosen
    }
    report = Report("landmarks", "Corners and openings", seeds=seeds)
    for kind in (CORNERS, OPENINGS):
        for laser in LASERS:
            scans = [scan for (name, _), own in drives.items() if name == laser for scan in own]
            report.requirements += _requirements(kind, laser, [scan[kind] for scan in scans])
    seconds = [scan[CORNERS].seconds for scans in drives.values() for scan in scans]
    virtual = [scan[CORNERS].cast for (laser, _), scans in drives.items() if laser == VIRTUAL for scan in scans]
    report.requirements += [
        Requirement("time of a virtual scan", 1e3 * float(np.mean(virtual)), _CAST, "ms"),
        Requirement("time of lines and landmarks", 1e3 * float(np.mean(seconds)), _EXTRACTED, "ms"),
    ]
    report.body += [_table(kind, drives) for kind in (CORNERS, OPENINGS)]
    report.body += [_calibration(kind, drives) for kind in (CORNERS, OPENINGS)]
    if settings.training:
        openings = [one for scans in drives.values() for scan in scans for one in scan[OPENINGS].landmarks]
        report.body.append(_fit(openings))
    report.body.append(POLICY)
    return report


def _requirements(kind: str, laser: str, found: Sequence[Found]) -> list[Requirement]:
    landmarks = [landmark for one in found for landmark in one.landmarks]
    name = f"{kind}, {laser.partition(',')[0]}"
    return [
        Requirement(f"{name}: found", found_share(found), 1.0, least=_FOUND),
        Requirement(f"{name}: false, of those of confidence {_CONFIDENT:g} and more", false_share(landmarks), _FALSE),
        Requirement(f"{name}: NEES, mean", nees_of(landmarks), _NEES[1], least=_NEES[0]),
        Requirement(f"{name}: expected calibration error", calibration_error(landmarks), _CALIBRATED),
    ]


def found_share(found: Sequence[Found]) -> float:
    """Of the landmarks that had to be found those that were."""
    due = sum(one.due for one in found)
    return sum(one.met for one in found) / due if due else math.nan


def false_share(landmarks: Sequence[Landmark]) -> float:
    """Of the confident ones those that are none."""
    own = [landmark.is_true for landmark in landmarks if landmark.confidence >= _CONFIDENT]
    return 1.0 - float(np.mean(own)) if own else math.nan


def nees_of(landmarks: Sequence[Landmark]) -> float:
    """Mean over the true and confident ones."""
    own = [landmark.nees for landmark in landmarks if landmark.is_true and landmark.confidence >= _CONFIDENT]
    return float(np.mean(own)) if own else math.nan


def calibration_error(landmarks: Sequence[Landmark]) -> float:
    """Mean distance between confidence and share of true ones, over the deciles."""
    off = [abs(sum(one.confidence - one.is_true for one in own)) for own in _deciles(landmarks)]
    return sum(off) / len(landmarks) if landmarks else math.nan


def _deciles(landmarks: Sequence[Landmark]) -> list[list[Landmark]]:
    """Landmarks by their confidences in ten bins; empty ones are left out."""
    bins: dict[int, list[Landmark]] = {}
    for landmark in landmarks:
        bins.setdefault(min(9, int(10.0 * landmark.confidence)), []).append(landmark)
    return [bins[k] for k in sorted(bins)]


def _table(kind: str, drives: dict[tuple[str, str], list[Scanned]]) -> str:
    head = [kind, "family", "found", "of them true", f"confidence from {_CONFIDENT:g}", "of them true"]
    head += ["had to be found", "were", "error, median [cm]", "95 % [cm]", "heading, median [°]", "95 % [°]"]
    head += ["NEES, median", "mean", "within 95 %"]
    rows = []
    for (laser, family), scans in drives.items():
        found = [scan[kind] for scan in scans]
        every = [landmark for one in found for landmark in one.landmarks]
        sure = [landmark for landmark in every if landmark.confidence >= _CONFIDENT]
        values = np.array([one[2:5] for one in sure if one.is_true]).reshape(-1, 3)
        rows.append(
            [
                laser,
                family,
                str(len(every)),
                _percent([one.is_true for one in every]),
                str(len(sure)),
                _percent([one.is_true for one in sure]),
                str(sum(one.due for one in found)),
                f"{100.0 * found_share(found):.1f} %",
                *(f"{q:.1f}" for q in 100.0 * np.quantile(values[:, 1], (0.5, 0.95))),
                *(f"{q:.2f}" for q in np.degrees(np.quantile(values[:, 2], (0.5, 0.95)))),
                f"{np.median(values[:, 0]):.2f}",
                f"{values[:, 0].mean():.2f}",
                _percent(list(values[:, 0] <= COVERED)),
            ]
        )
    return table(head, rows)


def _calibration(kind: str, drives: dict[tuple[str, str], list[Scanned]]) -> str:
    head, rows = [f"{kind} of confidence", "found", "confidence, mean", "true"], []
    every = [landmark for scans in drives.values() for scan in scans for landmark in scan[kind].landmarks]
    for own in _deciles(every):
        low = min(9, int(10.0 * own[0].confidence))
        mean = float(np.mean([one.confidence for one in own]))
        rows.append([f"0.{low} on", str(len(own)), f"{mean:.2f}", _percent([one.is_true for one in own])])
    return table(head, rows)


def _fit(openings: Sequence[Landmark]) -> str:
    """The parameters that explain best which openings are true, all scans weighing alike."""
    evidence, right = np.array([one.evidence for one in openings]), np.array([one.is_true for one in openings])
    weights, surprise = fitted(evidence, right)
    names = ("opening_bias", "opening_wall", "opening_jambs", "opening_share")
    return f"Fitted to {len(openings)} openings, log score {surprise:.3f}: " + ", ".join(
        f"features.{name} {weight:.2f}" for name, weight in zip(names, weights, strict=True)
    )


def _percent(values: Sequence[bool]) -> str:
    return f"{100.0 * float(np.mean(values)):.1f} %" if len(values) else "-"
