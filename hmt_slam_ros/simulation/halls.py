"""Families of buildings with halls larger than the laser's reach."""

from __future__ import annotations

import numpy as np

from hmt_slam_ros.simulation.building import Building, FloorPlan, Side
from hmt_slam_ros.simulation.corridors import niches_along
from hmt_slam_ros.simulation.settings import Settings

_ROOM = 4.0  # m, side of a twin room
_OFF = 4.5  # m, from the middle of the wall to each twin's door
_HALF_DOOR = 0.55  # m
_WALL = 0.2  # m
_BACK = 2.0  # m, width of the passage behind the twins


def hall(draw: np.random.Generator, settings: Settings) -> Building:
    """An open hall in whose middle the laser reaches no wall; the robot crosses it between two corners."""
    half_x, half_y = 22.0 * settings.size, 18.0 * settings.size
    plan = FloorPlan()
    plan.free(-half_x, -half_y, half_x, half_y)
    corners = [(-half_x, -half_y), (half_x, -half_y), (half_x, half_y), (-half_x, half_y)]
    ways = [((1.0, 0.0), (0.0, -1.0)), ((0.0, 1.0), (1.0, 0.0)), ((-1.0, 0.0), (0.0, 1.0)), ((0.0, -1.0), (-1.0, 0.0))]
    for corner, (along, out), half in zip(corners, ways, (half_x, half_y) * 2, strict=True):
        niches_along(draw, plan, Side(corner, along, out), 2.0 * half)
    x, y = half_x - 2.5, half_y - 2.5
    middle_x, middle_y = half_x - 11.0, half_y - 11.0
    route = [
        (-x, -y),
        (-0.5 * x, -y),
        (-middle_x, -middle_y),
        (middle_x, -middle_y),
        (middle_x, middle_y),
        (0.5 * x, y),
        (x, y),
        (x, 0.5 * y),
        (middle_x, -middle_y),
        (-middle_x, -middle_y),
        (-middle_x, middle_y),
        (-x, -0.5 * y),
        (-x, -y),
    ]
    return Building(plan.walls(), np.array(route))


def twins(draw: np.random.Generator, settings: Settings) -> Building:
    """Two identical rooms side by side, and before them a hall so large that the robot loses count of where it is.

    It goes through both rooms, from the hall and from the passage behind them, makes a tour of the hall, in which it
    sees nothing, and enters one of the two again. Which one, the niches of the passage tell.
    """
    depth = 68.0 * settings.size
    plan = FloorPlan()
    plan.free(-_OFF - 9.0, 0.0, _OFF + 9.0, depth)
    back = -_ROOM - 2.0 * _WALL
    for x in (-_OFF, _OFF):
        plan.free(x - 0.5 * _ROOM, -_WALL - _ROOM, x + 0.5 * _ROOM, -_WALL)
        plan.free(x - _HALF_DOOR, back - 0.1, x + _HALF_DOOR, 0.1)
        # A niche on one side only, so that the room has no symmetry of its own.
        plan.free(x + 0.5 * _ROOM - 0.1, -2.0, x + 0.5 * _ROOM + 0.4, -1.0)
    plan.free(-_OFF - 5.0, back - _BACK, _OFF + 5.0, back)
    niches_along(draw, plan, Side((-_OFF - 5.0, back - _BACK), (1.0, 0.0), (0.0, -1.0)), 2.0 * _OFF + 10.0)
    far, behind = depth - 8.0, back - 0.5 * _BACK
    again = _OFF if draw.random() < 0.5 else -_OFF
    route = [
        (-_OFF, 3.0),
        (-_OFF, behind),
        (_OFF, behind),
        (_OFF, 3.0),
        (_OFF, behind),
        (-_OFF, behind),
        (-_OFF, 8.0),
        (0.0, 14.0),
        (0.0, far),
        (again, far),
        (again, behind),
        (-again, behind),
        (-again, 3.0),
        (-_OFF, 3.0),
    ]
    places = {name: np.array([x, 0.0, -0.5 * np.pi]) for name, x in (("first", -_OFF), ("second", _OFF))}
    return Building(plan.walls(), np.array(route), places=places)
