"""Rooms in which a robot drives around, for maps of lines."""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.random_streams import Purpose, stream
from hmt_slam_ros.simulation.building import Building, FloorPlan, Point
from hmt_slam_ros.simulation.furniture import Rectangle, furnish
from hmt_slam_ros.simulation.scenario import Scenario
from hmt_slam_ros.simulation.settings import Settings, chosen_settings, parse_name

_WALL = 0.2  # m, between two rooms
_INSET = 1.1  # m, of the robot's way from the walls
_DOOR = 1.0  # m

KINDS = {
    "room": "a furnished room with an open door",
    "office": "two furnished rooms, one through the other",
    "busy office": "the same with two people on the robot's way",
}
"""{name: what it is}."""


def drive_in(kind: str, seed: int, settings: str) -> tuple[Scenario, float]:
    """A drive of two rounds through rooms of random sizes, and their floor, m^2.

    :param settings: those of the simulated robot that differ from the defaults, as ``name=value,...``.
    """
    draw = stream(seed, Purpose.BUILDING, 1)
    first = (0.0, 0.0, draw.uniform(4.5, 7.5), draw.uniform(4.0, 6.0))
    rooms, plan = [first], FloorPlan()
    way = _around(first)
    if kind != "room":
        left = first[2] + _WALL
        second = (left, draw.uniform(-1.0, 0.0), left + draw.uniform(4.0, 6.0), draw.uniform(3.8, 5.5))
        rooms.append(second)
        low = max(first[1], second[1]) + _INSET - 0.5 * _DOOR
        plan.free(first[2] - 0.05, low, left + 0.05, low + _DOOR)
        way = _through(way, _around(second), low + 0.5 * _DOOR)
    # A door in the first room's upper wall, and what is seen of the corridor behind it.
    door = draw.uniform(0.5, first[2] - 0.5 - _DOOR)
    plan.free(door, first[3] - 0.05, door + _DOOR, first[3] + _WALL + 0.05)
    plan.free(-2.0, first[3] + _WALL, first[2] + 2.0, first[3] + _WALL + 2.0)
    for room in rooms:
        plan.free(*room)
    route = np.array(way)
    building = Building(plan.walls(), route, furnish(draw, rooms, route))
    floor = sum((room[2] - room[0]) * (room[3] - room[1]) for room in rooms)
    return Scenario(building, _settings(kind, seed, settings)), floor


def _settings(kind: str, seed: int, settings: str) -> Settings:
    own = {"people": 2} if kind == "busy office" else {}
    _, given = parse_name(f"room,{settings}" if settings else "room")
    return chosen_settings({}, {"seed": seed, "speed": 0.4, **own, **given})


def _around(room: Rectangle) -> list[Point]:
    """Once around a room, from its lower right corner on, counter-clockwise."""
    x0, y0, x1, y1 = room[0] + _INSET, room[1] + _INSET, room[2] - _INSET, room[3] - _INSET
    return [(x1, y0), (x1, y1), (x0, y1), (x0, y0), (x1, y0)]


def _through(first: list[Point], second: list[Point], y: float) -> list[Point]:
    """Around the first room, through the door at ``y`` in its right wall, around the second and back."""
    x = 0.5 * (first[0][0] + second[2][0])
    into = [(first[0][0], y), (x, y), (second[2][0], y)]
    around = [second[3], *second[:4]]
    return [*first, *into, *around, *into[::-1], first[0]]
