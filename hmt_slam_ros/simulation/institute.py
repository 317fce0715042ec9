"""The floor of an institute, like that of the experiments of Tomatis et al. (2003), section 4 and Fig. 7.

It has 50 m x 25 m of hallways with offices and meeting rooms beside them. Open doors and crossings are the states.
Theirs has no large loop; here two passages make one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.simulation.building import Building, FloorPlan, Point, Side, TopologicalStates
from hmt_slam_ros.simulation.corridors import WALL, Plot, Room, cut_room, doors_and_floors
from hmt_slam_ros.simulation.furniture import furnish
from hmt_slam_ros.simulation.settings import Settings

_HALF_X, _HALF_Y = 25.0, 12.5
"""Half the size of the floor, m."""

_OPEN_ROOMS = 9
"""Number of open rooms: 13 states with the crossings, as in the paper."""

_OFFICE_LENGTHS, _MEETING_LENGTHS = (3.0, 5.0), (6.0, 9.0)
"""Smallest and largest lengths of rooms along the hallway, m."""

_OFFICE_DOORS, _MEETING_DOORS = (0.9, 1.1), (1.2, 1.8)
"""Smallest and largest widths of their doors, m."""

_MIN_DOOR_DISTANCE, _MIN_CROSSING_DISTANCE, _MIN_END_DISTANCE = 2.5, 3.0, 2.0
"""Smallest distances of an open door from the next one, from a crossing, and from the end of the hallway, m."""

_TURN_DISTANCE = 1.0
"""Distance from the end of a hallway at which the robot turns, m."""


class HallwayLayout(NamedTuple):
    """Two hallways along x, and two passages that join them along y.

    :ivar end: x of the hallways' ends, of both signs, m.
    :ivar ys: of the middles of the hallways, the southern first, m.
    :ivar xs: of the middles of the passages, the western first, m.
    :ivar hallways: widths of the hallways, m.
    :ivar passages: widths of the passages, m.
    """

    end: float
    ys: Point
    xs: Point
    hallways: Point
    passages: Point


class Site(NamedTuple):
    """A possible room: a plot on a side of a hallway.

    :ivar hallway: number of the hallway, 0 for the southern.
    :ivar side: of the hallway.
    :ivar plot: on it.
    :ivar meeting: whether it is a meeting room; else it is an office.
    """

    hallway: int
    side: Side
    plot: Plot
    meeting: bool

    @property
    def door(self) -> float:
        """x of the middle of the door, m."""
        return self.side.origin[0] + self.plot.left + 0.5 * self.plot.door


def institute(draw: np.random.Generator, settings: Settings) -> Building:
    """Offices and meeting rooms beside two hallways, of which later visits find others open.

    The robot drives along all hallways and enters all open rooms.
    """
    floor, sites = _draw_layout(draw, settings.size)
    opened = _draw_open_doors(draw, floor, sites, settings)
    plan = FloorPlan()
    for y, width in zip(floor.ys, floor.hallways, strict=True):
        plan.cut_rectangle(-floor.end, y - 0.5 * width, floor.end, y + 0.5 * width)
    for x, width in zip(floor.xs, floor.passages, strict=True):
        plan.cut_rectangle(x - 0.5 * width, floor.ys[0], x + 0.5 * width, floor.ys[1])
    rooms = [
        cut_room(plan, site.side, site.plot, floor.hallways[site.hallway], is_open=k in opened)
        for k, site in enumerate(sites)
    ]
    # Furniture is off the route for any choice of open doors.
    pieces = furnish(draw, [room.floor for room in rooms], np.array(_route(floor, sites, rooms)))
    entered = [room for room in rooms if room.is_open]
    furniture = np.array([piece for piece in pieces if any(_contains(room, piece) for room in entered)])
    places = [sites[k] for k in sorted(opened)]
    route, states = np.array(_route(floor, places, entered)), _states(floor, places, entered)
    return Building(plan.walls(), route, furniture.reshape(-1, 5), *doors_and_floors(entered), states=states)


def _draw_layout(draw: np.random.Generator, size: float) -> tuple[HallwayLayout, list[Site]]:
    """Hallways and all possible rooms."""
    y0, y1 = -size * draw.uniform(4.6, 5.2), size * draw.uniform(4.6, 5.2)
    x0, x1 = -size * draw.uniform(12.0, 16.0), size * draw.uniform(12.0, 16.0)
    (w0, w1), (p0, p1) = draw.uniform(1.8, 2.4, 2).tolist(), draw.uniform(1.8, 2.4, 2).tolist()
    floor = HallwayLayout(size * _HALF_X, (y0, y1), (x0, x1), (w0, w1), (p0, p1))
    inner = 0.5 * (y1 - y0 - 0.5 * (w0 + w1) - 3.0 * WALL)
    blocks = [(-floor.end, x0 - 0.5 * p0), (x0 + 0.5 * p0, x1 - 0.5 * p1), (x1 + 0.5 * p1, floor.end)]
    sites: list[Site] = []
    for hallway, out in ((0, -1.0), (1, 1.0)):
        middle, half = floor.ys[hallway], 0.5 * floor.hallways[hallway]
        outer = size * _HALF_Y - abs(middle) - half - WALL
        side = Side((-floor.end, middle + out * half), (1.0, 0.0), (0.0, out))
        sites += _draw_sites(draw, hallway, side, 2.0 * floor.end, outer, int(draw.integers(1, 6)))
        for begin, end in blocks:
            side = Side((begin, middle - out * half), (1.0, 0.0), (0.0, -out))
            sites += _draw_sites(draw, hallway, side, end - begin, inner, None)
    return floor, sites


def _draw_sites(
    draw: np.random.Generator, hallway: int, side: Side, length: float, depth: float, meeting: int | None
) -> list[Site]:
    """Rooms along a side.

    :param length: of the side, m.
    :param depth: of the deepest room, m.
    :param meeting: number of the meeting room, None for none.
    """
    sites: list[Site] = []
    begin = WALL
    while True:
        is_meeting = len(sites) == meeting
        end = begin + draw.uniform(*(_MEETING_LENGTHS if is_meeting else _OFFICE_LENGTHS))
        door = draw.uniform(*(_MEETING_DOORS if is_meeting else _OFFICE_DOORS))
        if end > length - WALL:
            return sites
        left, deep = draw.uniform(begin + 0.4, end - 0.4 - door), depth * draw.uniform(0.8, 1.0)
        sites.append(Site(hallway, side, Plot(begin, end, deep, left, door), is_meeting))
        begin = end + WALL


def _draw_open_doors(
    draw: np.random.Generator, floor: HallwayLayout, sites: Sequence[Site], settings: Settings
) -> set[int]:
    """Numbers of the open rooms: meeting rooms first, and at a later visit with some replaced by others."""
    wanted = round(_OPEN_ROOMS * settings.size)
    order = sorted(draw.permutation(len(sites)).tolist(), key=lambda k: not sites[k].meeting)
    opened = _open_doors(floor, sites, [], order, wanted)
    if settings.visit:
        change = random_stream(settings.run_seed, Purpose.CHANGES, 1)
        closed = change.random(len(opened)) < settings.changed
        stay = [k for k, is_closed in zip(opened, closed.tolist(), strict=True) if not is_closed]
        others = [k for k in change.permutation(len(sites)).tolist() if k not in opened]
        opened = _open_doors(floor, sites, stay, others, wanted)
    return set(opened)


def _open_doors(
    floor: HallwayLayout, sites: Sequence[Site], opened: Sequence[int], order: Sequence[int], wanted: int
) -> list[int]:
    """Open more doors in an order, far enough from others, crossings and ends, up to the wanted number."""
    filled = list(opened)
    for k in order:
        door = sites[k].door
        beside = [sites[other].door for other in filled if sites[other].hallway == sites[k].hallway]
        free = all(abs(door - x) >= _MIN_DOOR_DISTANCE for x in beside)
        free &= all(abs(door - x) >= _MIN_CROSSING_DISTANCE for x in floor.xs)
        if free and abs(door) <= floor.end - _MIN_END_DISTANCE and len(filled) < wanted:
            filled.append(k)
    return filled


def _route(floor: HallwayLayout, sites: Sequence[Site], rooms: Sequence[Room]) -> list[Point]:
    """The route east along the southern hallway, west along the northern one and back, with visits of rooms."""
    end = floor.end - _TURN_DISTANCE
    (x0, x1), (y0, y1) = floor.xs, floor.ys
    visits: tuple[list[Point], list[Point]] = ([], [])
    for site, room in sorted(zip(sites, rooms, strict=True), key=lambda pair: pair[0].door):
        visits[site.hallway].extend((room.front, room.inside, room.front))
    return [
        (-end, y0),
        *visits[0],
        (end, y0),
        (x1, y0),
        (x1, y1),
        (end, y1),
        *visits[1][::-1],
        (-end, y1),
        (x0, y1),
        (x0, y0),
        (-end, y0),
    ]


def _states(floor: HallwayLayout, sites: Sequence[Site], rooms: Sequence[Room]) -> TopologicalStates:
    """The states of the four crossings, then of open rooms."""
    up = 0.5 * math.pi
    rows = [
        (x, y, heading, 0.5 * hallway, passage, True)
        for y, heading, hallway in zip(floor.ys, (up, -up), floor.hallways, strict=True)
        for x, passage in zip(floor.xs, floor.passages, strict=True)
    ]
    for site, room in zip(sites, rooms, strict=True):
        heading = math.copysign(up, site.side.out[1])
        rows.append((*room.front, heading, 0.5 * floor.hallways[site.hallway], site.plot.door, False))
    table = np.array(rows, dtype=np.float64)
    return TopologicalStates(table[:, :3], table[:, 3], table[:, 4], table[:, 5].astype(np.bool_))


def _contains(room: Room, piece: NDArray[np.float64]) -> bool:
    """Whether the middle of a piece of furniture (5,) is in a room."""
    x0, y0, x1, y1 = room.floor
    return bool(x0 <= piece[0] <= x1 and y0 <= piece[1] <= y1)
