"""Stochastic line maps of simulated rooms, compared with the truth."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.lines import true_scan, walls_of
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.line_extraction import extract_for_map
from hmt_slam_ros.landmarks.stochastic_map import LineMap
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.sensors.relative_motion import RelativeMotion, increment_covariance
from hmt_slam_ros.simulation.building import Building, FloorPlan, Point
from hmt_slam_ros.simulation.furniture import Rectangle, furnish
from hmt_slam_ros.simulation.scenario import Scenario
from hmt_slam_ros.simulation.settings import Settings, chosen_settings, parse_name

_EVERY = 25  # scans between two checks of the pose
_WALL = 0.2  # m, between two rooms
_INSET = 1.1  # distance of the robot's route from the walls, m
_DOOR = 1.0  # m

KINDS = {
    "room": "a furnished room with an open door",
    "office": "two furnished rooms, one through the other",
    "busy office": "the same with two people on the robot's route",
}
"""{name: description}."""


class LineMapScores(NamedTuple):
    """The scores of the line map of a drive.

    :ivar pose_nees: of the robot's pose, 3 degrees of freedom.
    :ivar pose_sigmas: shape (n, 3), deviations of x, y and heading, m and rad, at the same times.
    :ivar pose_errors: shape (n, 3), in the robot's frame, likewise.
    :ivar strays: number of lines without a wall.
    :ivar bytes: memory of the lines, and with their covariance.
    :ivar floor: m^2.
    """

    pose_nees: NDArray[np.float64]
    pose_sigmas: NDArray[np.float64]
    pose_errors: NDArray[np.float64]
    strays: int
    bytes: tuple[int, int]
    floor: float


def map_rooms(kind: str, seed: int, laser: str, configuration: Configuration) -> LineMapScores:
    """Drive through rooms and map them."""
    scenario, floor = drive_in(kind, seed, laser)
    features = replace(configuration.features, range_deviation=scenario.settings.range_noise)
    room, start = LineMap(features), scenario.poses[0]
    votes: dict[int, Counter[int]] = {}
    poses: list[tuple[float, NDArray[np.float64], NDArray[np.float64]]] = []
    for number in range(len(scenario.scan_stamps)):
        if number:
            room.predict(_odometry_step(scenario, number, configuration))
        scan = true_scan(scenario, number)
        lines = extract_for_map(scan.scan, features)
        walls, observed = walls_of(lines, scan), room.observe(lines)
        for k, line in (*observed.matched, *observed.new):
            votes.setdefault(line, Counter())[int(walls[k])] += 1
        for line, part in observed.merged:
            votes[line] += votes.pop(part)
        if number % _EVERY == _EVERY - 1:
            poses.append(_pose_scores(room, se2.between(start, scenario.poses[number * scenario.settings.readings])))
    strays = sum(votes[known.number].most_common(1)[0][0] < 0 for known in room.walls)
    stored = sum(8 + 8 * len(wall.segments) for wall in room.walls)
    size = room.mean.size
    sizes = stored, stored + 4 * (size * (size + 1) // 2)
    pose_nees, sigmas, errors = (np.array(column) for column in zip(*poses, strict=True))
    return LineMapScores(pose_nees, sigmas, errors, strays, sizes, floor)


def _odometry_step(scenario: Scenario, number: int, configuration: Configuration) -> RelativeMotion:
    """The motion to a scan by odometry."""
    readings = scenario.settings.readings
    before, here = scenario.odometry[(number - 1) * readings], scenario.odometry[number * readings]
    increment = se2.between(before, here)
    return RelativeMotion(increment, increment_covariance(increment, configuration.motion))


def _pose_scores(room: LineMap, truth: NDArray[np.float64]) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """NEES of the robot's pose, its deviations and its error."""
    belief = room.pose
    error = se2.log(se2.between(belief.mean, truth))
    nees = float(error @ np.linalg.solve(belief.covariance, error))
    return nees, np.sqrt(np.diag(belief.covariance)), error


def drive_in(kind: str, seed: int, settings: str) -> tuple[Scenario, float]:
    """A drive of two rounds through rooms of random sizes, and their floor, m^2.

    :param settings: those of the simulated robot that differ from the defaults, as ``name=value,...``.
    """
    draw = random_stream(seed, Purpose.BUILDING, 1)
    first = (0.0, 0.0, draw.uniform(4.5, 7.5), draw.uniform(4.0, 6.0))
    rooms, plan = [first], FloorPlan()
    way = _loop_around(first)
    if kind != "room":
        left = first[2] + _WALL
        second = (left, draw.uniform(-1.0, 0.0), left + draw.uniform(4.0, 6.0), draw.uniform(3.8, 5.5))
        rooms.append(second)
        low = max(first[1], second[1]) + _INSET - 0.5 * _DOOR
        plan.cut_rectangle(first[2] - 0.05, low, left + 0.05, low + _DOOR)
        way = _through_door(way, _loop_around(second), low + 0.5 * _DOOR)
    # A door in the first room's upper wall, and the visible part of the corridor behind it.
    door = draw.uniform(0.5, first[2] - 0.5 - _DOOR)
    plan.cut_rectangle(door, first[3] - 0.05, door + _DOOR, first[3] + _WALL + 0.05)
    plan.cut_rectangle(-2.0, first[3] + _WALL, first[2] + 2.0, first[3] + _WALL + 2.0)
    for room in rooms:
        plan.cut_rectangle(*room)
    route = np.array(way)
    building = Building(plan.walls(), route, furnish(draw, rooms, route))
    floor = sum((room[2] - room[0]) * (room[3] - room[1]) for room in rooms)
    return Scenario(building, _settings(kind, seed, settings)), floor


def _settings(kind: str, seed: int, settings: str) -> Settings:
    own = {"people": 2} if kind == "busy office" else {}
    _, given = parse_name(f"room,{settings}" if settings else "room")
    return chosen_settings({}, {"seed": seed, "speed": 0.4, **own, **given})


def _loop_around(room: Rectangle) -> list[Point]:
    """A counterclockwise loop in a room, from its lower right corner on."""
    x0, y0, x1, y1 = room[0] + _INSET, room[1] + _INSET, room[2] - _INSET, room[3] - _INSET
    return [(x1, y0), (x1, y1), (x0, y1), (x0, y0), (x1, y0)]


def _through_door(first: list[Point], second: list[Point], y: float) -> list[Point]:
    """Around the first room, through the door at ``y`` in its right wall, around the second and back."""
    x = 0.5 * (first[0][0] + second[2][0])
    into = [(first[0][0], y), (x, y), (second[2][0], y)]
    around = [second[3], *second[:4]]
    return [*first, *into, *around, *into[::-1], first[0]]
