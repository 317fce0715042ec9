"""Families of buildings made of corridors, and those with halls larger than the laser's reach."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.simulation.building import Building, FloorPlan, Point, Side, sides_of_ring
from hmt_slam_ros.simulation.furniture import Rectangle, furnish
from hmt_slam_ros.simulation.settings import Settings

WALL = 0.2
"""Between two rooms, m."""

_OVERLAP = 0.05  # m, by which an opening reaches into what it opens to


class Ring(NamedTuple):
    """The middle of a ring of corridors around the origin: half sides, m."""

    half_x: float
    half_y: float

    @property
    def length(self) -> float:
        """Once around, m."""
        return 4.0 * (self.half_x + self.half_y)

    @property
    def corners(self) -> list[float]:
        """Where the corners are behind the first, (-half_x, -half_y), counter-clockwise, m."""
        x, y = 2.0 * self.half_x, 2.0 * self.half_y
        return [x, x + y, 2.0 * x + y, 2.0 * (x + y)]

    def point(self, along: float) -> Point:
        """The point some way behind the first corner, counter-clockwise, m."""
        along %= self.length
        x, y = self.half_x, self.half_y
        first, second, third, _ = self.corners
        if along <= first:
            return along - x, -y
        if along <= second:
            return x, along - first - y
        if along <= third:
            return x - (along - second), y
        return -x, y - (along - third)

    def waypoints(self, start: float, end: float) -> list[Point]:
        """Way-points counter-clockwise from one place to a later one, the first corner being at 0; m."""
        laps = range(int(start // self.length), int(end // self.length) + 1)
        corners = [lap * self.length + corner for lap in laps for corner in self.corners]
        return [self.point(along) for along in (start, *(c for c in corners if start < c < end), end)]


class Plot(NamedTuple):
    """Where a room and its door are to be, along one side of a corridor, m.

    :ivar begin: of the room.
    :ivar end: of the room.
    :ivar depth: of the room.
    :ivar left: where its door begins.
    :ivar door: width of the door.
    """

    begin: float
    end: float
    depth: float
    left: float
    door: float


class Room(NamedTuple):
    """A room beside a corridor.

    :ivar floor: its rectangle.
    :ivar along: where its door is on the corridor's side, m.
    :ivar front: in the corridor's middle before the door.
    :ivar inside: where a visitor turns back.
    :ivar is_open: whether the door is.
    :ivar door: x and y of both ends of the door, m.
    """

    floor: Rectangle
    along: float
    front: Point
    inside: Point
    is_open: bool
    door: tuple[float, float, float, float]


def cut_rooms(
    draw: np.random.Generator, plan: FloorPlan, side: Side, length: float, depths: tuple[float, float], width: float
) -> list[Room]:
    """Cut rooms with doors out of one side of a corridor.

    :param length: of the side, m.
    :param depths: smallest and largest depth of a room, m.
    :param width: of the corridor, m.
    """
    rooms = []
    begin = WALL
    while (end := begin + draw.uniform(3.0, 5.5)) <= length - WALL:
        depth, door = draw.uniform(*depths), draw.uniform(0.9, 1.1)
        plot = Plot(begin, end, depth, draw.uniform(begin + 0.4, end - 0.4 - door), door)
        rooms.append(cut_room(plan, side, plot, width, is_open=bool(draw.random() < 0.6)))
        begin = end + WALL
    return rooms


def cut_room(plan: FloorPlan, side: Side, plot: Plot, width: float, *, is_open: bool) -> Room:
    """Cut a room with its door out of one side of a corridor; of a closed one, the niche before its door.

    :param width: of the corridor, m.
    """
    left, right = plot.left, plot.left + plot.door
    floor = side.rectangle((plot.begin, plot.end), (WALL, WALL + plot.depth))
    if is_open:
        plan.cut_rectangle(*floor)
    plan.cut_rectangle(*side.rectangle((left, right), (-_OVERLAP, WALL + _OVERLAP if is_open else 0.4 * WALL)))
    middle = left + 0.5 * plot.door
    leaf = (*side.point(left, 0.5 * WALL), *side.point(right, 0.5 * WALL))
    inside = side.point(middle, WALL + 0.5 * plot.depth)
    return Room(floor, middle, side.point(middle, -0.5 * width), inside, is_open, leaf)


def cut_niches(draw: np.random.Generator, plan: FloorPlan, side: Side, length: float) -> None:
    """Cut niches out of one side of a corridor, some metres apart, no two alike."""
    begin = draw.uniform(1.5, 6.0)
    while (end := begin + draw.uniform(0.5, 1.5)) <= length - 1.5:
        plan.cut_rectangle(*side.rectangle((begin, end), (-_OVERLAP, draw.uniform(0.1, 0.4))))
        begin = end + draw.uniform(2.0, 8.0)


def office(draw: np.random.Generator, settings: Settings) -> Building:
    """Offices on both sides of a ring of corridors; the robot looks into some of them."""
    ring = Ring(settings.size * draw.uniform(10.0, 14.0), settings.size * draw.uniform(6.0, 8.0))
    width = draw.uniform(1.8, 2.4)
    plan = FloorPlan()
    plan.cut_ring(*ring, width)
    lengths = [2.0 * half + width for half in (ring.half_x, ring.half_y) * 2]
    outer = [
        cut_rooms(draw, plan, side, length, (3.0, 5.0), width)
        for side, length in zip(sides_of_ring(*ring, width, outer=True), lengths, strict=True)
    ]
    depth = ring.half_y - 0.5 * width - 1.5 * WALL
    inner = [
        cut_rooms(draw, plan, side, 2.0 * ring.half_x - width, (0.8 * depth, depth), width)
        for side in sides_of_ring(*ring, width, outer=False)[::2]
    ]
    route: list[Point] = []
    for k, rooms in enumerate(outer):
        route.append(ring.point(([0.0, *ring.corners])[k]))
        for room in rooms:
            if room.is_open and 1.0 < room.along - 0.5 * width < lengths[k] - width - 1.0 and draw.random() < 0.5:
                route += [room.front, room.inside, room.front]
    route.append(route[0])
    offices = [room for rooms in (*outer, *inner) for room in rooms if room.is_open]
    furniture = furnish(draw, [room.floor for room in offices], np.array(route))
    return Building(plan.walls(), np.array(route), furniture, *doors_and_floors(offices))


def doors_and_floors(rooms: Sequence[Room]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """``doors`` (n, 4) and ``rooms`` (n, 5) of a `Building` with these open rooms."""
    doors = np.array([room.door for room in rooms]).reshape(-1, 4)
    x0, y0, x1, y1 = np.array([room.floor for room in rooms]).reshape(-1, 4).T
    return doors, np.stack((0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0 * x0, x1 - x0, y1 - y0), axis=1)


def nested(draw: np.random.Generator, settings: Settings) -> Building:
    """Rings of corridors, one inside the other, joined below and above; each is driven around before the next."""
    unit, width = 8.0 * settings.size, 2.0
    rings = [Ring(1.3 * unit * (1 + k), 0.9 * unit * (1 + k)) for k in range(settings.count)]
    plan = FloorPlan()
    for ring in rings:
        plan.cut_ring(*ring, width)
        for outer in (False, True):
            sides = sides_of_ring(*ring, width, outer=outer)
            for side, half in zip(sides, (ring.half_x, ring.half_y) * 2, strict=True):
                cut_niches(draw, plan, side, 2.0 * half + (width if outer else -width))
    # Where the passages leave each ring, from the middle of its sides, m.
    below, above = (draw.uniform(-0.6, 0.6, len(rings)) * [ring.half_x for ring in rings] for _ in range(2))
    for k, (ring, next_ring) in enumerate(pairwise(rings)):
        plan.cut_corridor((below[k], -ring.half_y), (below[k], -next_ring.half_y), width)
        plan.cut_corridor((above[k], ring.half_y), (above[k], next_ring.half_y), width)
    return Building(plan.walls(), np.array(_nested_route(rings, below, above)))


def _nested_route(rings: list[Ring], below: NDArray[np.float64], above: NDArray[np.float64]) -> list[Point]:
    """Around each ring, out by the passages below, and from the outermost back in by those above."""
    route: list[Point] = []
    entry = 0.0
    for ring, leave in zip(rings, below.tolist(), strict=True):
        start = ring.half_x + entry
        out = ring.half_x + leave
        route += ring.waypoints(start, start + ring.length)
        # The last ring has no passage to the outside; there the way goes on to the top.
        if ring is not rings[-1]:
            route += ring.waypoints(start, out) if out >= start else [ring.point(out)]
        entry = leave
    at = rings[-1].half_x + (below[-2] if len(rings) > 1 else 0.0)
    for k in reversed(range(len(rings))):
        ring = rings[k]
        top = ring.corners[1] + ring.half_x
        down = top - above[k - 1] if k else ring.length + ring.half_x
        route += ring.waypoints(at, down) if down >= at else [ring.point(at), ring.point(down)]
        at = rings[k - 1].corners[1] + rings[k - 1].half_x - above[k - 1] if k else at
    return route


def grid(draw: np.random.Generator, settings: Settings) -> Building:
    """Corridors that cross at equal distances, all alike; the robot strolls through them and returns."""
    pitch, last = 9.0 * settings.size, settings.count
    plan = FloorPlan()
    for k in range(last + 1):
        plan.cut_corridor((k * pitch, 0.0), (k * pitch, last * pitch), 2.0)
        plan.cut_corridor((0.0, k * pitch), (last * pitch, k * pitch), 2.0)
    here, before = (0, 0), (0, 0)
    crossings = [here]
    for _ in range(2 * (last + 1) ** 2):
        steps = [(here[0] + dx, here[1] + dy) for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1))]
        ways = [way for way in steps if way != before and max(way) <= last and min(way) >= 0]
        here, before = ways[draw.integers(len(ways))], here
        crossings.append(here)
    crossings += [(0, here[1]), (0, 0)]
    return Building(plan.walls(), pitch * np.array(crossings, dtype=np.float64))


def symmetric_ring(_draw: np.random.Generator, settings: Settings) -> Building:
    """A square ring of corridors, each side like the others: a quarter turn changes nothing."""
    half, width = 7.0 * settings.size, 2.0
    plan = FloorPlan()
    plan.cut_ring(half, half, width)
    for side in sides_of_ring(half, half, width, outer=True):
        plan.cut_rectangle(*side.rectangle((half + 0.4, half + 1.6), (-_OVERLAP, 0.5)))
    quarter = 0.5 * np.pi
    places = {f"side {k}": np.array([0.0, 0.0, k * quarter]) for k in range(4)}
    return Building(plan.walls(), np.array(Ring(half, half).waypoints(half, 9.0 * half)), twin_frames=places)


def straight(draw: np.random.Generator, settings: Settings) -> Building:
    """Two long halls with nothing in them, joined at both ends by short corridors with niches."""
    ring, width = Ring(25.0 * settings.size, 4.0), 2.5
    plan = FloorPlan()
    plan.cut_ring(*ring, width)
    for side in sides_of_ring(*ring, width, outer=True)[1::2]:
        cut_niches(draw, plan, side, 2.0 * ring.half_y + width)
    return Building(plan.walls(), np.array(ring.waypoints(ring.half_x, ring.half_x + ring.length)))


_ROOM = 4.0  # m, side of a twin room
_OFF = 4.5  # m, from the middle of the wall to each twin's door
_HALF_DOOR = 0.55  # m
_WALL = 0.2  # m
_BACK = 2.0  # m, width of the passage behind the twins


def hall(draw: np.random.Generator, settings: Settings) -> Building:
    """An open hall in whose middle the laser reaches no wall; the robot crosses it between two corners."""
    half_x, half_y = 22.0 * settings.size, 18.0 * settings.size
    plan = FloorPlan()
    plan.cut_rectangle(-half_x, -half_y, half_x, half_y)
    corners = [(-half_x, -half_y), (half_x, -half_y), (half_x, half_y), (-half_x, half_y)]
    ways = [((1.0, 0.0), (0.0, -1.0)), ((0.0, 1.0), (1.0, 0.0)), ((-1.0, 0.0), (0.0, 1.0)), ((0.0, -1.0), (-1.0, 0.0))]
    for corner, (along, out), half in zip(corners, ways, (half_x, half_y) * 2, strict=True):
        cut_niches(draw, plan, Side(corner, along, out), 2.0 * half)
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
    plan.cut_rectangle(-_OFF - 9.0, 0.0, _OFF + 9.0, depth)
    back = -_ROOM - 2.0 * _WALL
    for x in (-_OFF, _OFF):
        plan.cut_rectangle(x - 0.5 * _ROOM, -_WALL - _ROOM, x + 0.5 * _ROOM, -_WALL)
        plan.cut_rectangle(x - _HALF_DOOR, back - 0.1, x + _HALF_DOOR, 0.1)
        # A niche on one side only, so that the room has no symmetry of its own.
        plan.cut_rectangle(x + 0.5 * _ROOM - 0.1, -2.0, x + 0.5 * _ROOM + 0.4, -1.0)
    plan.cut_rectangle(-_OFF - 5.0, back - _BACK, _OFF + 5.0, back)
    cut_niches(draw, plan, Side((-_OFF - 5.0, back - _BACK), (1.0, 0.0), (0.0, -1.0)), 2.0 * _OFF + 10.0)
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
    return Building(plan.walls(), np.array(route), twin_frames=places)
