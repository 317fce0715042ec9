"""Stochastic line maps of simulated rooms, compared with the truth."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.line_rooms import drive_in
from benchmark.line_truth import seen_in
from benchmark.lines import walls_of
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.features.extraction import extract_for_map
from hmt_slam_ros.features.stochastic_map import LineMap
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensing.motion import Step, increment_covariance
from hmt_slam_ros.simulation.scenario import Scenario

_EVERY = 25  # scans between two looks at the pose


class Mapped(NamedTuple):
    """What a drive came to.

    :ivar pose_nees: of the robot's pose, 3 degrees of freedom.
    :ivar pose_sigmas: shape (n, 3), deviations of x, y and heading, m and rad, at the same times.
    :ivar pose_errors: shape (n, 3), in the robot's frame, likewise.
    :ivar strays: lines that have no wall.
    :ivar bytes: of the lines, and with their covariance.
    :ivar floor: m^2.
    """

    pose_nees: NDArray[np.float64]
    pose_sigmas: NDArray[np.float64]
    pose_errors: NDArray[np.float64]
    strays: int
    bytes: tuple[int, int]
    floor: float


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
    strays = sum(votes[known.name].most_common(1)[0][0] < 0 for known in room.walls)
    stored = sum(8 + 8 * len(wall.pieces) for wall in room.walls)
    size = room.mean.size
    sizes = stored, stored + 4 * (size * (size + 1) // 2)
    pose_nees, sigmas, errors = (np.array(column) for column in zip(*poses, strict=True))
    return Mapped(pose_nees, sigmas, errors, strays, sizes, floor)


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
