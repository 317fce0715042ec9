"""Simulated drives: keyframes, depths in rooms, and heading estimates from lines compared with the truth."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from benchmark.lines import true_lines
from benchmark.simulated.worlds import World
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.line_extraction import extract_lines
from hmt_slam_ros.places.corridor_frame import BuildingHeading
from hmt_slam_ros.places.observation_graph import QUARTER_TURN
from hmt_slam_ros.sensors.relative_motion import RelativeMotion, increment_covariance
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.scenario import Scenario

_TIMES = 400  # in a drive at which the heading is compared
_SAME = 1e-6  # rad


def heading_errors(world: World, laser: str, configuration: Configuration) -> Float64:
    """Error of the filter, its deviation, error of odometry (rad) and number of lines along a drive, shape (n, 4)."""
    scenario = open_simulated(",".join(filter(None, (world.log, laser)))).scenario
    features = replace(configuration.features, range_deviation=scenario.settings.range_noise)
    heading, count, readings = BuildingHeading(features), len(scenario.scan_stamps), scenario.settings.readings
    sampled = set(np.linspace(0, count - 1, _TIMES).astype(np.int64).tolist())
    rows, begin, axis = [], math.nan, _wall_direction(scenario)
    for number in range(count):
        if number:
            before, here = scenario.odometry[(number - 1) * readings], scenario.odometry[number * readings]
            increment = se2.between(before, here)
            heading.predict(RelativeMotion(increment, increment_covariance(increment, configuration.motion)))
        used = heading.observe(extract_lines(scenario.scan(number), features))
        true, odometry = scenario.poses[number * readings][2] - axis, scenario.odometry[number * readings][2]
        if heading.is_known and math.isnan(begin):
            begin = QUARTER_TURN * round((true - heading.angle) / QUARTER_TURN)
            odometry_offset = odometry - true
        if heading.is_known and number in sampled:
            error = float(se2.wrap(heading.angle + begin - true))
            rows.append([error, math.sqrt(heading.variance), float(se2.wrap(odometry - true - odometry_offset)), used])
    return np.array(rows).reshape(-1, 4)


def _wall_direction(scenario: Scenario) -> float:
    """Direction of most of the walls of a building, up to quarter turns, rad."""
    alphas = true_lines(scenario, int(scenario.scan_stamps[0]), np.zeros(3))[:, 0] % QUARTER_TURN
    apart = np.abs(alphas[:, None] - alphas[None, :])
    return float(alphas[np.argmax((np.minimum(apart, QUARTER_TURN - apart) < _SAME).sum(axis=1))])


def keyframes_of(poses: Float64, configuration: Configuration) -> list[int]:
    """Numbers of the scans of a drive that are keyframes, by the distances of metric SLAM."""
    options, found = configuration.filter, [0]
    for k in range(1, len(poses)):
        away = se2.between(poses[found[-1]], poses[k])
        turned = abs(away[2]) > math.radians(options.keyframe_angle)
        if turned or math.hypot(away[0], away[1]) > options.keyframe_distance:
            found.append(k)
    return found


def depth_in_rooms(scenario: Scenario, poses: Float64) -> Float64:
    """How deep poses (n, 3) are in a room, m, shape (n,); below 0 for those outside of all, by the distance."""
    deepest = np.full(len(poses), -np.inf)
    for room in scenario.building.rooms:
        local = np.abs(se2.transform(se2.inverse(room[:3]), poses[:, :2]))
        deepest = np.maximum(deepest, (0.5 * room[3:] - local).min(axis=1))
    return deepest
