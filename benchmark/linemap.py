"""Stochastic maps of rooms against the truth: is the filter as far off as it says, and how much does a map take?"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.line_rooms import KINDS, drive_in
from benchmark.line_truth import difference, seen_in, true_lines
from benchmark.lines import COVERED, walls_of
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_seeds
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.line_extraction import extract_for_map
from hmt_slam_ros.landmarks.stochastic_map import LineMap
from hmt_slam_ros.sensors.motion_model import Step, increment_covariance
from hmt_slam_ros.simulation.scenario import Scenario

SEEDS = 8
"""Drives through rooms of every kind, with every laser."""

LASERS = {
    "180°, 361 beams, 15 mm": "",
    "360°, 720 beams, 10 mm": "field_of_view=360,beams=720,range_noise=0.01",
}
"""{name: settings of the simulated robot}."""

_EVERY = 25  # scans between two looks at the pose
_WIDEST = 1.5  # cm and degrees, 2 sigma of the pose on average
_BAND = 0.95  # of runs whose mean NEES would be in the band by chance

POLICY = (
    "The robot drives twice around furnished rooms of random sizes; it begins at the origin of its map, for certain. "
    "NEES: squared Mahalanobis distance of the truth, of the robot's pose every five seconds (3 on average) and of "
    "each line of the map at the end (2 on average), whose wall is the one that most scans saw where it was observed; "
    "none is left out. Errors of one drive depend on each other, so what is averaged is the mean of each drive, and "
    "the band is where the mean of as many independent errors as there are drives would be in "
    f"{100.0 * _BAND:.0f} % of the cases. Lines: of walls and furniture, some of which are one wall's. Bytes: alpha, r "
    "and the ends of what was seen as 32-bit floats, and with the covariance of all of them (its upper triangle)."
)


class Mapped(NamedTuple):
    """What a drive came to.

    :ivar pose_nees: of the robot's pose, 3 degrees of freedom.
    :ivar pose_sigmas: shape (n, 3), deviations of x, y and heading, m and rad, at the same times.
    :ivar pose_errors: shape (n, 3), in the robot's frame, likewise.
    :ivar line_nees: of the lines that have a wall, 2 degrees of freedom.
    :ivar strays: lines that have none.
    :ivar bytes: of the lines, and with their covariance.
    :ivar floor: m^2.
    """

    pose_nees: NDArray[np.float64]
    pose_sigmas: NDArray[np.float64]
    pose_errors: NDArray[np.float64]
    line_nees: NDArray[np.float64]
    strays: int
    bytes: tuple[int, int]
    floor: float


def measure_linemap(settings: Settings) -> Report:
    """Map rooms by their lines and compare with the truth."""
    kinds = settings.logs_or(tuple(KINDS))
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise HmtSlamError(f"there is no {unknown[0]!r} here: choose from {', '.join(KINDS)}")
    seeds = chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    drives = {
        (kind, laser): [mapped(kind, seed, LASERS[laser], configuration) for seed in seeds]
        for kind, laser in product(kinds, LASERS)
    }
    every = [drive for own in drives.values() for drive in own]
    report = Report("linemap", "Stochastic maps of rooms", seeds=seeds)
    report.requirements = [
        _nees_requirement("the robot's pose", [drive.pose_nees for drive in every], 3),
        _nees_requirement("lines", [drive.line_nees for drive in every], 2),
        Requirement("2 sigma of x and y, mean", 200.0 * _mean(every, 0, 2), _WIDEST, "cm"),
        Requirement("2 sigma of the heading, mean", 2.0 * math.degrees(_mean(every, 2, 3)), _WIDEST, "°"),
    ]
    report.body += [_table(drives), POLICY]
    report.data["drives"] = {
        ", ".join(key): [[drive.pose_nees.tolist(), drive.line_nees.tolist()] for drive in own]
        for key, own in drives.items()
    }
    return report


def mapped(kind: str, seed: int, laser: str, configuration: Configuration) -> Mapped:
    """Drive through rooms and map them."""
    scenario, floor = drive_in(kind, seed, laser)
    features = replace(configuration.features, range_deviation=scenario.settings.range_noise)
    room, start = LineMap(features), scenario.poses[0]
    votes: dict[int, Counter[int]] = {}
    poses: list[tuple[float, NDArray[np.float64], NDArray[np.float64]]] = []
    for number in range(len(scenario.scan_stamps)):
        if number:
            room.predict(_step(scenario, number, configuration))
        seen = seen_in(scenario, number)
        lines = extract_for_map(seen.scan, features)
        walls, observed = walls_of(lines, seen), room.observe(lines)
        for k, line in (*observed.known, *observed.new):
            votes.setdefault(line, Counter())[int(walls[k])] += 1
        for line, part in observed.joined:
            votes[line] += votes.pop(part)
        if number % _EVERY == _EVERY - 1:
            poses.append(_judged_pose(room, se2.between(start, scenario.poses[number * scenario.settings.readings])))
    nees, strays = _judged_lines(room, votes, true_lines(scenario, int(scenario.scan_stamps[0]), start))
    stored = sum(8 + 8 * len(wall.pieces) for wall in room.walls)
    size = room.mean.size
    sizes = stored, stored + 4 * (size * (size + 1) // 2)
    pose_nees, sigmas, errors = (np.array(column) for column in zip(*poses, strict=True))
    return Mapped(pose_nees, sigmas, errors, nees, strays, sizes, floor)


def _step(scenario: Scenario, number: int, configuration: Configuration) -> Step:
    """What odometry says of the motion to a scan."""
    readings = scenario.settings.readings
    before, here = scenario.odometry[(number - 1) * readings], scenario.odometry[number * readings]
    increment = se2.between(before, here)
    return Step(increment, increment_covariance(increment, configuration.motion))


def _judged_pose(room: LineMap, truth: NDArray[np.float64]) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """NEES of the robot's pose, its deviations and its error."""
    belief = room.pose
    error = se2.log(se2.between(belief.mean, truth))
    nees = float(error @ np.linalg.solve(belief.covariance, error))
    return nees, np.sqrt(np.diag(belief.covariance)), error


def _judged_lines(
    room: LineMap, votes: dict[int, Counter[int]], walls: NDArray[np.float64]
) -> tuple[NDArray[np.float64], int]:
    """NEES of the lines that have a wall, and how many have none.

    :param votes: {name of a line: how many of its observations each wall had}.
    :param walls: true lines in the frame of the map, (n, 2).
    """
    nees, strays = [], 0
    for line, known in enumerate(room.walls):
        wall = votes[known.name].most_common(1)[0][0]
        if wall < 0:
            strays += 1
            continue
        error = difference(room.lines[line], walls[wall])
        nees.append(float(error @ np.linalg.solve(room.line_covariance(line), error)))
    return np.array(nees), strays


def _nees_requirement(name: str, drives: Sequence[NDArray[np.float64]], freedom: int) -> Requirement:
    """That the mean over drives of the mean within each is in its band."""
    from scipy.stats import chi2  # noqa: PLC0415  half a second, which no other measurement needs

    low, high = chi2.ppf([0.5 - 0.5 * _BAND, 0.5 + 0.5 * _BAND], freedom * len(drives)) / len(drives)
    mean = float(np.mean([own.mean() for own in drives]))
    return Requirement(f"NEES of {name}, mean over {len(drives)} drives", mean, float(high), least=float(low))


def _mean(drives: Sequence[Mapped], first: int, last: int) -> float:
    return float(np.mean([drive.pose_sigmas[:, first:last].mean() for drive in drives]))


def _table(drives: dict[tuple[str, str], list[Mapped]]) -> str:
    head = ["rooms and laser", "drives", "NEES of the pose", "worst drive", "NEES of lines", "worst drive"]
    head += ["lines within 95 %", "2 sigma of x, y [cm]", "of the heading [°]", "error of x, y, rms [cm]", "lines"]
    head += ["on no wall", "bytes a m^2", "with covariance"]
    return table(head, [_row(", ".join(key), own) for key, own in drives.items()])


def _row(name: str, drives: list[Mapped]) -> list[str]:
    poses = [float(drive.pose_nees.mean()) for drive in drives]
    lines = [float(drive.line_nees.mean()) for drive in drives]
    covered = 100.0 * np.mean(np.concatenate([drive.line_nees for drive in drives]) <= COVERED)
    nees = [f"{figure:.2f}" for figure in (np.mean(poses), max(poses), np.mean(lines), max(lines))]
    errors = np.concatenate([drive.pose_errors[:, :2] for drive in drives])
    sizes = [200.0 * _mean(drives, 0, 2), 2.0 * math.degrees(_mean(drives, 2, 3)), 100.0 * np.sqrt(np.mean(errors**2))]
    floor, strays = sum(drive.floor for drive in drives), sum(drive.strays for drive in drives)
    stored, whole = (sum(drive.bytes[k] for drive in drives) / floor for k in (0, 1))
    count = np.mean([len(drive.line_nees) + drive.strays for drive in drives])
    figures = [f"{covered:.1f} %", *(f"{size:.2f}" for size in sizes), f"{count:.1f}", str(strays)]
    return [name, str(len(drives)), *nees, *figures, f"{stored:.1f}", f"{whole:.0f}"]
