"""The belief over places of a robot that drives, from what its wheels and its laser say.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3. The robot's heading between the walls is estimated apart from its
place, Eq. (2), and the openings around it are followed in a frame along the walls, in which odometry is its place for
the few metres that count. A transition is when the robot passes an opening to a side that it believes in, or comes to
the wall at the end of a hallway: then it is at a node, and the way from the last one is known. From there on it is so
far beyond the node as it was driven. A turn is one of the belief as soon as the robot is in a hallway again. In rooms
the belief pauses, for there the metric filter tells where the robot is, and goes on at the door.

Every landmark counts about once: the observation function is asked where the robot arrives, and again when it has gone
on as far as twice its reach. By its place along the hallway the opening at which the robot arrives is known by way of
the distance alone, Eq. (1): the robot's place is set by it, so that in the look it is where every state expects one,
and tells its side and its width. An opening that is more probably none of the map is no transition, but a landmark.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.features.corners import corners_of
from hmt_slam_ros.features.extraction import Lines, extract_lines
from hmt_slam_ros.features.hallway import distances_around, log_odds, sector_of, space_within
from hmt_slam_ros.features.heading import QUARTER, BuildingHeading
from hmt_slam_ros.features.landmark_map import Landmark, LandmarkMap
from hmt_slam_ros.features.landmarks import OPENING, Landmarks, both
from hmt_slam_ros.features.openings import NO_OPENINGS, openings_of
from hmt_slam_ros.features.rays import Rays, rays_of
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.places.chart import BEFORE
from hmt_slam_ros.places.observation import observation_model, place_along
from hmt_slam_ros.places.observation_graph import QUARTERS, observation_graph, of_walls
from hmt_slam_ros.places.observation_graph import Landmarks as Seen
from hmt_slam_ros.places.place_graph import PlaceGraph, heading_of, node_of
from hmt_slam_ros.places.position_belief import PositionBelief, Travel, flat_belief
from hmt_slam_ros.places.walls_around import wall_ahead, wall_beside
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.sensing.motion import Step

# Openings are noticed from this confidence and so many sightings on, more than they were missed, when the robot is so
# far beyond them, m; a robot that begins to turn is at one that is so far ahead, m, as well. They are so far beside it
# at most, m.
_LEAST, _SIGHTINGS, _BEHIND, _AHEAD, _ASIDE = 0.5, 2, 1.0, 1.0, 2.5
# Openings so near to each other along a hallway are one node, m; what is so far away is forgotten, m.
_SAME, _FORGET = 0.6, 8.0
# A robot is along an axis within this angle of it, rad; an opening within this one.
_ALONG, _ASKEW = math.radians(25.0), math.radians(20.0)
# The wall at the end of a hallway is so near before the robot turns, m.
_WALL = 1.35
# A robot turns at its last node up to so far from it, m; where it turns elsewhere it is at one that it did not notice,
# of which it knows the place so well, m.
_THERE, _SOMEWHERE = 1.5, 0.4
# A robot that was in a hallway so far ago, m, turns off it.
_DOORWAY = 1.0
# A chord along a hallway is this share of the longest one.
_LONG = 0.5
# Deviations of a node's place in the map, m; of what is seen of the robot's place in the frame along the walls, m.
_PLACED, _HERE = 0.03, 0.02
# The robot follows one axis to the next node, in known ground and in unknown, so the turn tells nothing: with this
# variance, rad^2, none at all is as probable as any is where the map does not tell it, 1 / (2 pi).
_UNTOLD = 2.0 * math.pi
# Where a robot stands that begins at a node, so exactly, m.
_BEGIN = 0.1


class Noticed(NamedTuple):
    """A node that the robot is at, or that it passed.

    :ivar place: shape (2,), in the frame along the walls, m.
    :ivar variance: of its place along the hallway as seen from the robot now, m^2.
    """

    place: Float64
    variance: float


class PlaceEstimator:
    """Follows a robot through a map of places.

    :ivar belief: None before the first node is noticed.
    :ivar arrivals: how many nodes were noticed.
    :ivar in_hallway: whether the robot is in one, along it.
    :ivar at_wall: whether it is at the wall at the end of one.
    """

    def __init__(self, graph: PlaceGraph, configuration: Configuration, belief: PositionBelief | None = None) -> None:
        """:param belief: of a robot that begins at a node; unless given, nothing is known before one is noticed."""
        self._features, self._places = configuration.features, configuration.places
        self._model = observation_model(configuration.places, configuration.features)
        self._heading = BuildingHeading(configuration.features)
        # Who walks by hides what is there.
        self._around = LandmarkMap(replace(configuration.features, landmark_least=0.0))
        self._first, self._begins_there = belief or flat_belief(graph, configuration.places), belief is not None
        self._pose = np.zeros(3)
        self._quarter, self._middle = 0, np.zeros(2)
        self._last: Noticed | None = None
        self._passed: list[Float64] = []
        self._unlisted: list[Float64] = []
        self._turned_at: Float64 | None = None
        # Where it looked last, where it looked or arrived last, and where it was in a hallway last.
        self._looked: Float64 | None = None
        self._told = np.zeros(2)
        self._in_hallway_at: Float64 | None = None
        self._seen = NO_OPENINGS
        self._distances = np.full(1, np.nan)
        self.belief: PositionBelief | None = None
        self.arrivals = 0
        self.in_hallway, self.at_wall = False, False

    @property
    def away(self) -> float:
        """How far the robot is beyond its last node in its direction of travel, m."""
        assert self._last is not None
        return float((self._pose[:2] - self._last.place) @ self._direction)

    @property
    def aside(self) -> float:
        """How far the robot is to the right of the hallway's middle, m."""
        return float((self._middle - self._pose[:2]) @ self._left)

    @property
    def turning(self) -> bool:
        """Whether the robot is on a turn that is not over yet."""
        return self._turned_at is not None

    @property
    def at_node(self) -> bool:
        """Whether the robot is beside its last node."""
        return self._last is not None and math.dist(self._pose[:2], self._last.place) <= _THERE

    @property
    def axis(self) -> int:
        """Quarters of a turn to the left from the walls' frame to the direction in which the robot travels."""
        return self._quarter

    def along(self, axis: int) -> float:
        """How far the robot came along an axis, from anywhere, m."""
        return float(self._pose[:2] @ _unit(axis))

    def free(self, axis: int) -> float:
        """How far one sees along an axis, m; nan where no beam tells."""
        return float(self._distances[sector_of(np.array(QUARTER * axis - self._pose[2]))])

    def ahead(self, distance: float) -> Float64:
        """The place in the hallway's middle so far ahead of the robot, m, shape (2,), in the frame of the base."""
        return self._seen_from_base(self._beyond(distance))

    def on_line(self, axis: int, distance: float) -> Float64:
        """The place so far ahead of the robot, m, on the line along an axis through its last node; likewise."""
        last = self._node
        along = _unit(axis)
        return self._seen_from_base(last + (float((self._pose[:2] - last) @ along) + distance) * along)

    def beside_node(self, axis: int, distance: float) -> Float64:
        """The place so far from the last node along an axis, m; likewise."""
        return self._seen_from_base(self._node + distance * _unit(axis))

    @property
    def _node(self) -> Float64:
        """Its last node, or where it is, in the walls' frame."""
        return self._pose[:2] if self._last is None else self._last.place

    def _seen_from_base(self, place: Float64) -> Float64:
        return np.asarray(se2.transform(se2.inverse(self._pose), place[None])[0])

    @property
    def facing(self) -> tuple[int, int] | None:
        """The most likely node and the direction in which the robot looks now, also while it turns or is in a room."""
        state = None if self.belief is None else self.belief.most_likely
        if state is None:
            return None
        turned = self._quarter - round(self._pose[2] / QUARTER)
        return node_of(state), (heading_of(state) + turned) % QUARTERS

    def door_ahead(self) -> PoseGaussian | None:
        """The belief over ``base_T_opening`` of the nearest opening that the robot looks through; None for none.

        None, too, for one that it sees less exactly along a wall than walls are square: who hides most of a wall may
        be a part of its line.
        """
        seen = self._seen
        ahead = (seen.confidences >= _LEAST) & (seen.poses[:, 0] > 0.0) & (np.abs(seen.poses[:, 2]) <= _ALONG)
        ahead &= np.abs(seen.poses[:, 1]) <= 0.5 * seen.widths
        if not ahead.any():
            return None
        k = int(np.argmin(np.where(ahead, seen.poses[:, 0], np.inf)))
        if seen.covariances[k, 2, 2] > math.radians(self._features.square_deviation) ** 2:
            return None
        return PoseGaussian(seen.poses[k], seen.covariances[k])

    def moved(self, step: Step) -> None:
        """The robot moved."""
        self._heading.predict(step)
        if not self._heading.known:
            return
        forward = se2.transform(np.array((0.0, 0.0, self._pose[2])), step.increment[None, :2])[0]
        self._pose = np.array((*(self._pose[:2] + forward), self._heading.angle))
        if self._last is not None:
            self._last = self._last._replace(variance=self._last.variance + float(step.covariance[:2, :2].max()))

    def observe(self, scan: Scan) -> PositionBelief | None:
        """The belief after a scan; None before the first node."""
        lines, rays = extract_lines(scan, self._features), rays_of(scan, self._features)
        self._heading.observe(lines)
        if not self._heading.known:
            return None
        self._pose[2] = self._heading.angle
        if self._begins_there and self.belief is None:
            self._last, self.belief = Noticed(self._pose[:2].copy(), _BEGIN**2), self._first
        corners, openings = corners_of(lines, self._features), openings_of(lines, rays, self._features)
        self._seen, self._distances = openings, distances_around(rays)
        self._follow(both(corners, openings), rays)
        nearest = round(self._pose[2] / QUARTER)
        off = self._pose[2] - QUARTER * nearest
        aligned = abs(off) <= _ALONG
        if nearest != self._quarter or not aligned:
            self._turn(nearest, lines if aligned else None)
        else:
            self._turned_at = None
            self.in_hallway = self._is_hallway(lines, nearest)
        if self.in_hallway and nearest == self._quarter and aligned:
            self._notice(0.0)
            self._notice_wall(lines, off)
            self._look(of_walls(observation_graph(corners, openings, -off, self._places)))
        return self.belief

    @property
    def _direction(self) -> Float64:
        """Unit vector along the hallway, as the robot travels."""
        return _unit(self._quarter)

    @property
    def _left(self) -> Float64:
        """Unit vector across it."""
        return _unit(self._quarter + 1)

    def _follow(self, seen: Landmarks, rays: Rays) -> None:
        """Follow the landmarks around."""
        here = np.diag([_HERE**2, _HERE**2, self._heading.variance])
        self._around.observe(PoseGaussian(self._pose.copy(), here), seen, rays)
        near = (one for one in self._around.landmarks if math.dist(one.pose.mean[:2], self._pose[:2]) < _FORGET)
        self._around.landmarks = list(near)

    def _is_hallway(self, lines: Lines, axis: int) -> bool:
        """Whether the robot is in a hallway along an axis. Where both walls are in sight its middle is known, too."""
        space = space_within(self._distances)
        chord = self.free(axis) + self.free(axis + 2)
        if space is None or log_odds(space, self._features) <= 0.0 or not chord >= _LONG * space.length:
            return False
        self._in_hallway_at = self._pose[:2].copy()
        left, right = (wall_beside(lines, QUARTER * side - self._pose[2]) for side in (axis + 1, axis - 1))
        if left is not None and right is not None:
            self._middle = self._pose[:2] + 0.5 * (left - right) * _unit(axis + 1)
        return True

    def _turn(self, nearest: int, lines: Lines | None) -> None:
        """The robot turns, and at last is along another axis.

        :param lines: of the scan, where it is along one.
        """
        if self._turned_at is None:
            self._turned_at = self._pose[:2].copy()
            if self._is_near(self._in_hallway_at, _DOORWAY):
                self._notice(_AHEAD)
        if lines is None or nearest == self._quarter:
            return
        quarters = (self._quarter - nearest) % QUARTERS
        elsewhere = quarters % 2 and self._last is not None and self._turned_off(self._last)
        if elsewhere and self._is_near(self._in_hallway_at, _DOORWAY):
            self._reach(Noticed(self._turned_at, _SOMEWHERE**2))
        if quarters % 2:
            # A node is in the middle of the hallways that meet there.
            self._middle = self._node
        if not self._is_hallway(lines, nearest):
            self.in_hallway = False
            return
        if quarters % 2 and self._last is not None and self._turned_off(self._last):
            # Where another hallway leads off there is a node, whatever was seen of it.
            self._arrive(Noticed(self._turned_at, _SOMEWHERE**2))
            self._middle = self._node
        if self.belief is not None:
            self.belief = self.belief.turned(quarters)
        self._looked = None if quarters % 2 else self._looked
        self._quarter, self._turned_at, self.in_hallway = nearest, None, True
        # What was passed is passed again.
        self._passed, self._unlisted = (
            [place for place in places if math.dist(place, self._pose[:2]) <= _THERE]
            for places in (self._passed, self._unlisted)
        )

    def _is_near(self, place: Float64 | None, distance: float) -> bool:
        """Whether the robot is so near to a place that it was at, m; wheels that stand and roll tell of ways, too."""
        return place is not None and math.dist(self._pose[:2], place) <= distance

    def _turned_off(self, last: Noticed) -> bool:
        """Whether the robot turns elsewhere than at its last node."""
        assert self._turned_at is not None
        return min(math.dist(place, last.place) for place in (self._pose[:2], self._turned_at)) > _THERE

    def _notice(self, ahead: float) -> None:
        """Arrive at the openings that are passed.

        :param ahead: so far ahead of the robot they count already, m.
        """
        found = [(float((one.pose.mean[:2] - self._pose[:2]) @ self._direction), one) for one in self._openings()]
        for away, landmark in sorted(found, key=lambda each: each[0]):
            if -_BEHIND <= away <= ahead:
                variance = float(landmark.pose.covariance[:2, :2].trace())
                self._reach(Noticed(self._beyond(away), variance))

    def _beyond(self, away: float) -> Float64:
        """The place in the hallway's middle so far ahead, m."""
        aside = float((self._middle - self._pose[:2]) @ self._left)
        return np.asarray(self._pose[:2] + away * self._direction + aside * self._left)

    def _openings(self) -> Iterator[Landmark]:
        """The openings to the sides that the robot believes in."""
        for one in self._around.landmarks:
            heading = float(one.pose.mean[2]) - QUARTER * self._quarter
            beside = float((one.pose.mean[:2] - self._pose[:2]) @ self._left)
            side = math.copysign(1.0, beside) * math.sin(heading)
            existence = one.existence
            believed = existence.confidence >= _LEAST and existence.seen >= max(_SIGHTINGS, existence.missed)
            if one.kind == OPENING and believed and abs(beside) <= _ASIDE and side > math.cos(_ASKEW):
                yield one

    def _notice_wall(self, lines: Lines, off: float) -> None:
        """Arrive at the end of a hallway."""
        away = wall_ahead(lines, -off)
        self.at_wall = away is not None and away <= _WALL
        if away is not None and self.at_wall:
            self._reach(Noticed(self._beyond(away - BEFORE), _PLACED**2), end=True)

    def _reach(self, noticed: Noticed, *, end: bool = False) -> None:
        """Arrive at what was noticed, unless it was noticed before, or is none of the map.

        An opening at which the robot is again corrects its place. An end that is so near to an opening is no node. One
        that is none of the map may be another one that somebody half hides, and no end is taken for it.
        """
        known = self._passed if end else self._passed + self._unlisted
        away = [np.abs((place - noticed.place) @ self._direction) for place in known]
        if away and min(away) < _SAME:
            return
        if self._last is not None and abs((noticed.place - self._last.place) @ self._direction) <= _THERE:
            self._last = self._last if end else noticed
            self._passed = [*self._passed[-2:], noticed.place]
        elif self.belief is None or self.belief.is_listed(self._way(noticed)):
            self._arrive(noticed)
        else:
            self._unlisted = [*self._unlisted[-2:], noticed.place]

    def _arrive(self, noticed: Noticed) -> None:
        self._passed = [*self._passed[-2:], noticed.place]
        self.belief = self._first if self.belief is None else self.belief.arrived(self._way(noticed))
        self._last, self._looked, self._told = noticed, None, self._pose[:2].copy()
        self.arrivals += 1

    def _way(self, noticed: Noticed) -> Travel:
        """From the last node."""
        assert self._last is not None
        distance = float((noticed.place - self._last.place) @ self._direction)
        variance = self._last.variance + noticed.variance
        return Travel(max(0.0, distance), 0.0, (variance, _UNTOLD))

    def _look(self, seen: Seen) -> None:
        """Ask the observation function, where as much of the hallway is new as the robot sees of it."""
        if self.belief is None or self._last is None or self._is_near(self._looked, 2.0 * self._places.reach):
            return
        if self.belief.in_room >= 0.5:
            return
        variance = self._last.variance + _PLACED**2
        gone = math.dist(self._pose[:2], self._told)
        self.belief = self.belief.gone_on(gone).observed(seen, self._model, self.away, variance)
        self._looked = self._told = self._pose[:2].copy()
        state = self.belief.most_likely
        if self.belief.confident and state is not None:
            ahead, variance = place_along(seen, self.belief.graph.expected, state, self.away, variance, self._model)
            self._last = Noticed(self._last.place + (self.away - ahead) * self._direction, variance)


def _unit(axis: int) -> Float64:
    """Unit vector so many quarters to the left of the x axis."""
    return np.array((math.cos(QUARTER * axis), math.sin(QUARTER * axis)))
