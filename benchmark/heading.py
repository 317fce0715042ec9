"""The heading by the lines of walls alone, against the truth, on simulated drives."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from benchmark.line_truth import true_lines
from benchmark.linemap import LASERS
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_families, chosen_seeds
from benchmark.simulated.worlds import World
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.heading import QUARTER, BuildingHeading
from hmt_slam_ros.landmarks.line_extraction import extract_lines
from hmt_slam_ros.sensors.motion_model import Step, increment_covariance
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.scenario import Scenario

SEEDS = 4
"""Drives of every family."""

FAMILIES = ("office", "busy", "nested")

_TIMES = 400  # in a drive at which the heading is compared
_LARGEST = 2.0  # degrees
_SAME = 1e-6  # rad
_WITHIN = 0.95  # of two deviations

POLICY = (
    f"At {_TIMES} times of every drive, evenly spread. The heading begins unknown; which of the four quarters is meant "
    "follows from the first lines. Error: from the true heading, of the filter and of the odometry alone, which begins "
    "with the same. Walls of simulated buildings are exactly square, so that of the filter's deviation only the noise "
    "is put to the test. Used: lines of a scan that are along or across the building."
)


def measure_heading(settings: Settings) -> Report:
    """Estimate the heading along simulated drives."""
    chosen = chosen_families(settings, FAMILIES)
    seeds = chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    drives = {
        (family, laser): [headings(World(family, seed), LASERS[laser], configuration) for seed in seeds]
        for family, laser in product(chosen, LASERS)
    }
    every = np.concatenate([drive for own in drives.values() for drive in own])
    report = Report("heading", "The heading by lines", seeds=seeds)
    report.requirements = [
        Requirement("largest error", _degrees(np.abs(every[:, 0]).max()), _LARGEST, "°"),
        Requirement("share of errors within 2 sigma", _within(every), 1.0, least=_WITHIN),
    ]
    report.body += [_table(drives), POLICY]
    return report


def headings(world: World, laser: str, configuration: Configuration) -> NDArray[np.float64]:
    """Along a drive: error of the filter, its deviation, error of the odometry, rad, and lines used, shape (n, 4)."""
    scenario = open_simulated(",".join(filter(None, (world.log, laser)))).scenario
    features = replace(configuration.features, range_deviation=scenario.settings.range_noise)
    heading, count, readings = BuildingHeading(features), len(scenario.scan_stamps), scenario.settings.readings
    judged = set(np.linspace(0, count - 1, _TIMES).astype(np.int64).tolist())
    rows, begin, axis = [], math.nan, _axis(scenario)
    for number in range(count):
        if number:
            before, here = scenario.odometry[(number - 1) * readings], scenario.odometry[number * readings]
            increment = se2.between(before, here)
            heading.predict(Step(increment, increment_covariance(increment, configuration.motion)))
        used = heading.observe(extract_lines(scenario.scan(number), features))
        true, odometry = scenario.poses[number * readings][2] - axis, scenario.odometry[number * readings][2]
        if heading.known and math.isnan(begin):
            begin = QUARTER * round((true - heading.angle) / QUARTER)
            ahead = odometry - true
        if heading.known and number in judged:
            error = float(se2.wrap(heading.angle + begin - true))
            rows.append([error, math.sqrt(heading.variance), float(se2.wrap(odometry - true - ahead)), used])
    return np.array(rows).reshape(-1, 4)


def _axis(scenario: Scenario) -> float:
    """Direction in which a building's walls run, up to quarters, rad; of its lines that of most."""
    alphas = true_lines(scenario, int(scenario.scan_stamps[0]), np.zeros(3))[:, 0] % QUARTER
    apart = np.abs(alphas[:, None] - alphas[None, :])
    return float(alphas[np.argmax((np.minimum(apart, QUARTER - apart) < _SAME).sum(axis=1))])


def _within(rows: NDArray[np.float64]) -> float:
    return float(np.mean(np.abs(rows[:, 0]) <= 2.0 * rows[:, 1]))


def _degrees(angle: float) -> float:
    return math.degrees(float(angle))


def _table(drives: Mapping[tuple[str, str], Sequence[NDArray[np.float64]]]) -> str:
    head = ["drives and laser", "drives", "error, rms [°]", "largest", "2 sigma, mean [°]", "within 2 sigma"]
    head += ["odometry alone, rms [°]", "largest", "lines used"]
    return table(head, [_row(", ".join(key), own) for key, own in drives.items()])


def _row(name: str, drives: Sequence[NDArray[np.float64]]) -> list[str]:
    rows = np.concatenate(drives)
    errors, odometry = np.abs(rows[:, 0]), np.abs(rows[:, 2])
    angles = [np.sqrt(np.mean(errors**2)), errors.max(), 2.0 * rows[:, 1].mean()]
    others = [np.sqrt(np.mean(odometry**2)), odometry.max()]
    figures = [*(f"{_degrees(a):.2f}" for a in angles), f"{100.0 * _within(rows):.1f} %"]
    return [name, str(len(drives)), *figures, *(f"{_degrees(a):.1f}" for a in others), f"{rows[:, 3].mean():.1f}"]
