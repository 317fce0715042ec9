"""Are covariances as large as errors are? Of arcs, of the areas' poses and of RTL's pose, on simulated worlds."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from benchmark.plots import plot_nees
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings, by_family, chosen_seeds, records_of
from benchmark.simulated.records import Record

RUNS = 100
"""Runs that are asked for at least."""

ALLOWED = (2.0, 4.5)
"""Between which the mean NEES has to be."""

COVERED = 7.815
"""Chi-square with 3 degrees of freedom at 95 %."""

POLICY = (
    "NEES: squared Mahalanobis distance of the truth from a belief over a pose, under its covariance; 3 on average "
    "where the covariance is right, smaller where it is too large. An area's true frame follows from the keyframe that "
    "is nearest to its origin. Arcs and the poses of areas in the map are those at the end of the run; RTL's pose, in "
    "the map and in the frame of the robot's area, is taken every two seconds. What is averaged is the mean of each "
    "run, for within a run errors depend on each other; "
    "the mean of 100 independent errors would be between 2.54 and 3.50 in 95 % of the cases. Coverage: share of all "
    "errors within the 95 % ellipsoid."
)

_Samples = Callable[[Record], list[float]]

KINDS: dict[str, _Samples] = {
    "arcs": lambda record: [arc["nees"] for arc in record["arcs"]],
    "arcs that closed no loop": lambda record: [arc["nees"] for arc in record["arcs"] if not arc["closure"]],
    "arcs that closed a loop": lambda record: [arc["nees"] for arc in record["arcs"] if arc["closure"]],
    "poses of areas": lambda record: [area["nees"] for area in record["area_poses"]],
    "RTL's pose in the map": lambda record: [pose["map"]["nees"] for pose in record["poses"]],
    "RTL's pose in its area": lambda record: [pose["local"]["nees"] for pose in record["poses"]],
}
_REQUIRED = ("arcs", "poses of areas", "RTL's pose in the map")


def measure_consistency(settings: Settings) -> Report:
    """Map the worlds and compare covariances with errors."""
    records = records_of(settings)
    report = Report("consistency", "Consistency of the covariances", seeds=chosen_seeds(settings))
    low, high = ALLOWED
    report.requirements.append(Requirement("runs", len(records), math.inf, least=RUNS))
    report.requirements += [
        Requirement(f"NEES of {kind}, mean over runs", mean_nees(records, KINDS[kind]), high, least=low)
        for kind in _REQUIRED
    ]
    report.body += [_table(records), _family_table(records), POLICY]
    report.data["nees"] = {
        kind: {record["world"]: samples(record) for record in records} for kind, samples in KINDS.items()
    }
    report.pictures["nees.png"] = "Share of errors below a NEES; the line is chi-square with 3 degrees of freedom."
    pooled = {kind: [each for record in records for each in KINDS[kind](record)] for kind in _REQUIRED}
    plot_nees(settings.out / "nees.png", pooled)
    return report


def run_means(records: Sequence[Record], samples: _Samples) -> list[float]:
    """The mean NEES of every run that has any."""
    return [float(np.mean(own)) for record in records if (own := samples(record))]


def mean_nees(records: Sequence[Record], samples: _Samples) -> float:
    """Mean over runs of the mean within each."""
    means = run_means(records, samples)
    return float(np.mean(means)) if means else math.nan


def covered(records: Sequence[Record], samples: _Samples) -> float:
    """Share of all errors within the 95 % ellipsoid."""
    pooled = [each <= COVERED for record in records for each in samples(record)]
    return float(np.mean(pooled)) if pooled else math.nan


def _table(records: list[Record]) -> str:
    head = ["of", "runs", "errors", "NEES, mean over runs", "median run", "worst run", "within 95 %"]
    rows = []
    for kind, samples in KINDS.items():
        if means := run_means(records, samples):
            count = sum(len(samples(record)) for record in records)
            figures = [f"{value:.2f}" for value in (np.mean(means), np.median(means), max(means))]
            rows.append([kind, str(len(means)), str(count), *figures, f"{100.0 * covered(records, samples):.1f} %"])
    return table(head, rows)


def _family_table(records: list[Record]) -> str:
    head = ["family", *(word for kind in _REQUIRED for word in (f"NEES of {kind}", "within 95 %"))]
    rows = []
    for family, own in by_family(records).items():
        pairs = [(mean_nees(own, KINDS[kind]), covered(own, KINDS[kind])) for kind in _REQUIRED]
        rows.append([family, *(cell for mean, share in pairs for cell in (f"{mean:.2f}", f"{100.0 * share:.1f} %"))])
    return table(head, rows)
