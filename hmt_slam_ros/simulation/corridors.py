"""Families of buildings with corridors, rooms and halls."""

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
"""Thickness of walls, m."""

_OVERLAP = 0.05
"""Overlap of an opening with the free space on both of its sides, m."""

_OPEN_PROBABILITY = 0.6
"""Probability that the door of an office is open."""

_TWIN_ROOM = 4.0
"""Side of a twin room, m."""

_TWIN_OFFSET = 4.5
"""Distance of each twin's door from the middle of the wall, m."""

_TWIN_HALF_DOOR = 0.55
"""Half the width of a twin's door, m."""

_TWIN_PASSAGE = 2.0
"""Width of the passage behind the twins, m."""


class Ring(NamedTuple):
    """The middle line of a ring of corridors around the origin, by its half sides, m."""

    half_x: float
    half_y: float

    @property
    def length(self) -> float:
        """Length of the middle line, m."""
        return 4.0 * (self.half_x + self.half_y)

    @property
    def corners(self) -> list[float]:
        """Distances of the corners from the first, (-half_x, -half_y), counterclockwise, m."""
        x, y = 2.0 * self.half_x, 2.0 * self.half_y
        return [x, x + y, 2.0 * x + y, 2.0 * (x + y)]

    def point(self, along: float) -> Point:
        """The point at a distance from the first corner, counterclockwise, m."""
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
        """Way-points between two distances from the first corner, counterclockwise, m."""
        laps = range(int(start // self.length), int(end // self.length) + 1)
        corners = [lap * self.length + corner for lap in laps for corner in self.corners]
        return [self.point(along) for along in (start, *(c for c in corners if start < c < end), end)]


class Plot(NamedTuple):
    """A room and its door along one side of a corridor, m.

    :ivar begin: of the room.
    :ivar end: of the room.
    :ivar depth: of the room.
    :ivar left: begin of its door.
    :ivar door: width of the door.
    """

    begin: float
    end: float
    depth: float
    left: float
    door: float


class Room(NamedTuple):
    """A room beside a corridor.

    :ivar floor: its rectangle, m.
    :ivar along: position of its door along the corridor's side, m.
    :ivar front: point in the corridor's middle before the door, m.
    :ivar inside: point in the room where a robot turns back, m.
    :ivar is_open: whether the door is open.
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
        rooms.append(cut_room(plan, side, plot, width, is_open=bool(draw.random() < _OPEN_PROBABILITY)))
        begin = end + WALL
    return rooms


def cut_room(plan: FloorPlan, side: Side, plot: Plot, width: float, *, is_open: bool) -> Room:
    """Cut a room with its door out of one side of a corridor; of a closed one only the niche of its door.

    :param width: of the corridor, m.
    """
    left, right = plot.left, plot.left + plot.door
    floor = side.rectangle((plot.begin, plot.end), (WALL, WALL + plot.depth))
    if is_open:
        plan.cut_rectangle(*floor)
    plan.cut_rectangle(*side.rectangle((left, right), (-_OVERLAP, WALL + _OVERLAP if is_open else 0.4 * WALL)))
    middle = left + 0.5 * plot.door
    door = (*side.point(left, 0.5 * WALL), *side.point(right, 0.5 * WALL))
    inside = side.point(middle, WALL + 0.5 * plot.depth)
    return Room(floor, middle, side.point(middle, -0.5 * width), inside, is_open, door)


def cut_niches(draw: np.random.Generator, plan: FloorPlan, side: Side, length: float) -> None:
    """Cut random niches out of one side of a corridor, some meters apart."""
    begin = draw.uniform(1.5, 6.0)
    while (end := begin + draw.uniform(0.5, 1.5)) <= length - 1.5:
        plan.cut_rectangle(*side.rectangle((begin, end), (-_OVERLAP, draw.uniform(0.1, 0.4))))
        begin = end + draw.uniform(2.0, 8.0)


def office(draw: np.random.Generator, settings: Settings) -> Building:
    """Offices on both sides of a ring of corridors; the robot enters some of them."""
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
    """``doors`` (n, 4) and ``rooms`` (n, 5) of a `Building` with some open rooms, m."""
    doors = np.array([room.door for room in rooms]).reshape(-1, 4)
    x0, y0, x1, y1 = np.array([room.floor for room in rooms]).reshape(-1, 4).T
    return doors, np.stack((0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0 * x0, x1 - x0, y1 - y0), axis=1)


def nested(draw: np.random.Generator, settings: Settings) -> Building:
    """Concentric rings of corridors, joined below and above; the robot completes each before the next."""
    unit, width = 8.0 * settings.size, 2.0
    rings = [Ring(1.3 * unit * (1 + k), 0.9 * unit * (1 + k)) for k in range(settings.count)]
    plan = FloorPlan()
    for ring in rings:
        plan.cut_ring(*ring, width)
        for outer in (False, True):
            sides = sides_of_ring(*ring, width, outer=outer)
            for side, half in zip(sides, (ring.half_x, ring.half_y) * 2, strict=True):
                cut_niches(draw, plan, side, 2.0 * half + (width if outer else -width))
    # Positions of the passages from the middle of each ring's sides, m.
    below, above = (draw.uniform(-0.6, 0.6, len(rings)) * [ring.half_x for ring in rings] for _ in range(2))
    for k, (ring, next_ring) in enumerate(pairwise(rings)):
        plan.cut_corridor((below[k], -ring.half_y), (below[k], -next_ring.half_y), width)
        plan.cut_corridor((above[k], ring.half_y), (above[k], next_ring.half_y), width)
    return Building(plan.walls(), np.array(_nested_route(rings, below, above)))


def _nested_route(rings: list[Ring], below: NDArray[np.float64], above: NDArray[np.float64]) -> list[Point]:
    """The route around each ring, outwards by the passages below, and back inwards by those above."""
    route: list[Point] = []
    entry = 0.0
    for ring, leave in zip(rings, below.tolist(), strict=True):
        start = ring.half_x + entry
        out = ring.half_x + leave
        route += ring.waypoints(start, start + ring.length)
        # The last ring has no passage to the outside; its route goes on to the top.
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
    """Identical corridors that cross at equal distances; the robot takes a random walk and returns."""
    pitch, last = 9.0 * settings.size, settings.count
    plan = FloorPlan()
    for k in range(last + 1):
        plan.cut_corridor((k * pitch, 0.0), (k * pitch, last * pitch), 2.0)
        plan.cut_corridor((0.0, k * pitch), (last * pitch, k * pitch), 2.0)
    here, before = (0, 0), (0, 0)
    crossings = [here]
    for _ in range(2 * (last + 1) ** 2):
        steps = [(here[0] + dx, here[1] + dy) for dx, dy in ((1, 0), (0, 1), (-1, 0), (0, -1))]
        choices = [way for way in steps if way != before and max(way) <= last and min(way) >= 0]
        here, before = choices[draw.integers(len(choices))], here
        crossings.append(here)
    crossings += [(0, here[1]), (0, 0)]
    return Building(plan.walls(), pitch * np.array(crossings, dtype=np.float64))


def symmetric_ring(_draw: np.random.Generator, settings: Settings) -> Building:
    """A square ring of corridors with four identical sides."""
    half, width = 7.0 * settings.size, 2.0
    plan = FloorPlan()
    plan.cut_ring(half, half, width)
    for side in sides_of_ring(half, half, width, outer=True):
        plan.cut_rectangle(*side.rectangle((half + 0.4, half + 1.6), (-_OVERLAP, 0.5)))
    quarter = 0.5 * np.pi
    frames = {f"side {k}": np.array([0.0, 0.0, k * quarter]) for k in range(4)}
    return Building(plan.walls(), np.array(Ring(half, half).waypoints(half, 9.0 * half)), twin_frames=frames)


def straight(draw: np.random.Generator, settings: Settings) -> Building:
    """Two long empty corridors, joined at both ends by short ones with niches."""
    ring, width = Ring(25.0 * settings.size, 4.0), 2.5
    plan = FloorPlan()
    plan.cut_ring(*ring, width)
    for side in sides_of_ring(*ring, width, outer=True)[1::2]:
        cut_niches(draw, plan, side, 2.0 * ring.half_y + width)
    return Building(plan.walls(), np.array(ring.waypoints(ring.half_x, ring.half_x + ring.length)))


def hall(draw: np.random.Generator, settings: Settings) -> Building:
    """An open hall with walls out of reach from its middle; the robot crosses it between two corners."""
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
    """Two identical rooms side by side, before a hall in which odometry drifts.

    The robot passes both rooms, from the hall and from the passage behind them, makes a tour of the hall without any
    wall in reach, and enters one of the two again. Only the niches of the passage tell which one.
    """
    depth = 68.0 * settings.size
    plan = FloorPlan()
    plan.cut_rectangle(-_TWIN_OFFSET - 9.0, 0.0, _TWIN_OFFSET + 9.0, depth)
    back = -_TWIN_ROOM - 2.0 * WALL
    for x in (-_TWIN_OFFSET, _TWIN_OFFSET):
        plan.cut_rectangle(x - 0.5 * _TWIN_ROOM, -WALL - _TWIN_ROOM, x + 0.5 * _TWIN_ROOM, -WALL)
        plan.cut_rectangle(x - _TWIN_HALF_DOOR, back - 0.1, x + _TWIN_HALF_DOOR, 0.1)
        # A niche on one side only, so that the room has no symmetry of its own.
        plan.cut_rectangle(x + 0.5 * _TWIN_ROOM - 0.1, -2.0, x + 0.5 * _TWIN_ROOM + 0.4, -1.0)
    plan.cut_rectangle(-_TWIN_OFFSET - 5.0, back - _TWIN_PASSAGE, _TWIN_OFFSET + 5.0, back)
    passage = Side((-_TWIN_OFFSET - 5.0, back - _TWIN_PASSAGE), (1.0, 0.0), (0.0, -1.0))
    cut_niches(draw, plan, passage, 2.0 * _TWIN_OFFSET + 10.0)
    far, behind = depth - 8.0, back - 0.5 * _TWIN_PASSAGE
    again = _TWIN_OFFSET if draw.random() < 0.5 else -_TWIN_OFFSET
    route = [
        (-_TWIN_OFFSET, 3.0),
        (-_TWIN_OFFSET, behind),
        (_TWIN_OFFSET, behind),
        (_TWIN_OFFSET, 3.0),
        (_TWIN_OFFSET, behind),
        (-_TWIN_OFFSET, behind),
        (-_TWIN_OFFSET, 8.0),
        (0.0, 14.0),
        (0.0, far),
        (again, far),
        (again, behind),
        (-again, behind),
        (-again, 3.0),
        (-_TWIN_OFFSET, 3.0),
    ]
    offsets = {"first": -_TWIN_OFFSET, "second": _TWIN_OFFSET}
    frames = {name: np.array([x, 0.0, -0.5 * np.pi]) for name, x in offsets.items()}
    return Building(plan.walls(), np.array(route), twin_frames=frames)
