"""The belief over places of a robot that drives, from what its wheels and its laser say.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3. A transition is when the robot passes an opening to a side that
it believes in, or comes to the wall at the end of a hallway: then it is at a node, and the way from the last one is
known. From there on it is so far beyond the node as it was driven. A turn is one of the belief as soon as the robot is
in a hallway again. In rooms the belief pauses, for there the metric filter tells where the robot is, and goes on at the
door.

Every landmark counts about once: the observation function is asked where the robot arrives, and again when it has gone
on as far as twice its reach. By its place along the hallway the opening at which the robot arrives is known by way of
the distance alone, Eq. (1): the robot's place is set by it, so that in the look it is where every state expects one,
and tells its side and its width. An opening that is more probably none of the map is no transition, but a landmark.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import Features
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.landmarks.beam_labels import Rays, rays_of
from hmt_slam_ros.landmarks.corners import NO_CORNERS, corners_of
from hmt_slam_ros.landmarks.heading import QUARTER
from hmt_slam_ros.landmarks.landmark_map import LandmarkMap
from hmt_slam_ros.landmarks.landmarks import OPENING, both
from hmt_slam_ros.landmarks.line_extraction import Lines, extract_lines
from hmt_slam_ros.landmarks.openings import NO_OPENINGS, Openings, openings_of
from hmt_slam_ros.places.chart import BEFORE
from hmt_slam_ros.places.corridor_frame import ALONG, Noticed, WallFrame, wall_ahead
from hmt_slam_ros.places.observation import observation_model, place_along
from hmt_slam_ros.places.observation_graph import QUARTERS, Landmarks, observation_graph, of_walls
from hmt_slam_ros.places.place_graph import PlaceGraph, heading_of, node_of
from hmt_slam_ros.places.position_belief import PositionBelief, Travel, flat_belief
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import Step

# One believes in openings from this confidence and so many sightings on, more than they were missed. They are so far
# beside the robot at most, m, within this angle of square to its hallway, rad.
_LEAST, _SIGHTINGS, _ASIDE, _ASKEW = 0.5, 2, 2.5, math.radians(20.0)
# What is so far away is forgotten, m.
_FORGET = 8.0


class OpeningsAround:
    """Openings around a robot.

    :ivar seen: in the last scan, the frame of the base.
    """

    def __init__(self, features: Features) -> None:
        self._features = features
        # Who walks by hides what is there.
        self._around = LandmarkMap(replace(features, landmark_least=0.0))
        self.seen = NO_OPENINGS

    def observe(self, frame: WallFrame, openings: Openings, rays: Rays) -> None:
        """Follow what a scan shows.

        :param frame: where it was taken.
        :param rays: its beams.
        """
        self.seen = openings
        self._around.observe(frame.pose_belief, both(NO_CORNERS, openings), rays)
        near = (one for one in self._around.landmarks if math.dist(one.pose.mean[:2], frame.place) < _FORGET)
        self._around.landmarks = list(near)

    def beside(self, frame: WallFrame) -> Iterator[Landmark]:
        """The openings to the sides of a robot's hallway that one believes in, in the frame along the walls."""
        for one in self._around.landmarks:
            heading = float(one.pose.mean[2]) - QUARTER * frame.axis
            beside = float((one.pose.mean[:2] - frame.place) @ frame.left)
            side = math.copysign(1.0, beside) * math.sin(heading)
            existence = one.existence
            believed = existence.confidence >= _LEAST and existence.seen >= max(_SIGHTINGS, existence.missed)
            if one.kind == OPENING and believed and abs(beside) <= _ASIDE and side > math.cos(_ASKEW):
                yield one

    def door_ahead(self) -> PoseGaussian | None:
        """The belief over ``base_T_opening`` of the nearest opening that the robot looks through; None for none.

        None, too, for one that it sees less exactly along a wall than walls are square: who hides most of a wall may
        be a part of its line.
        """
        seen = self.seen
        ahead = (seen.confidences >= _LEAST) & (seen.poses[:, 0] > 0.0) & (np.abs(seen.poses[:, 2]) <= ALONG)
        ahead &= np.abs(seen.poses[:, 1]) <= 0.5 * seen.widths
        if not ahead.any():
            return None
        k = int(np.argmin(np.where(ahead, seen.poses[:, 0], np.inf)))
        if seen.covariances[k, 2, 2] > math.radians(self._features.square_deviation) ** 2:
            return None
        return PoseGaussian(seen.poses[k], seen.covariances[k])


# Openings are noticed when the robot is so far beyond them, m; a robot that begins to turn is at one that is so far
# ahead, m, as well.
_BEHIND, _AHEAD = 1.0, 1.0
# Openings so near to each other along a hallway are one node, m.
_SAME = 0.6
# The wall at the end of a hallway is so near before the robot turns, m.
_WALL = 1.35
# A robot turns at its last node up to so far from it, m; where it turns elsewhere it is at one that it did not notice,
# of which it knows the place so well, m.
_THERE, _SOMEWHERE = 1.5, 0.4
# A robot that was in a hallway so far ago, m, turns off it.
_DOORWAY = 1.0
# Deviation of a node's place in the map, m.
_PLACED = 0.03
# The robot follows one axis to the next node, in known ground and in unknown, so the turn tells nothing: with this
# variance, rad^2, none at all is as probable as any is where the map does not tell it, 1 / (2 pi).
_UNTOLD = 2.0 * math.pi
# Where a robot stands that begins at a node, so exactly, m.
_BEGIN = 0.1


class PlaceEstimator:
    """Follows a robot through a map of places.

    :ivar frame: where it is along the walls, and its last node.
    :ivar openings: those around it.
    :ivar belief: None before the first node is noticed.
    :ivar arrivals: how many nodes were noticed.
    :ivar in_hallway: whether the robot is in one, along it.
    :ivar at_wall: whether it is at the wall at the end of one.
    """

    def __init__(self, graph: PlaceGraph, configuration: Configuration, belief: PositionBelief | None = None) -> None:
        """:param belief: of a robot that begins at a node; unless given, nothing is known before one is noticed."""
        self._features, self._places = configuration.features, configuration.places
        self._model = observation_model(configuration.places, configuration.features)
        self._first, self._begins_there = belief or flat_belief(graph, configuration.places), belief is not None
        self._passed: list[Float64] = []
        self._unlisted: list[Float64] = []
        self._turned_at: Float64 | None = None
        # Where it looked last, where it looked or arrived last, and where it was in a hallway last.
        self._looked: Float64 | None = None
        self._told = np.zeros(2)
        self._in_hallway_at: Float64 | None = None
        self.frame = WallFrame(configuration.features)
        self.openings = OpeningsAround(configuration.features)
        self.belief: PositionBelief | None = None
        self.arrivals = 0
        self.in_hallway, self.at_wall = False, False

    @property
    def turning(self) -> bool:
        """Whether the robot is on a turn that is not over yet."""
        return self._turned_at is not None

    @property
    def at_node(self) -> bool:
        """Whether the robot is beside its last node."""
        return self.frame.node is not None and self.frame.is_near(self.frame.node.place, _THERE)

    @property
    def facing(self) -> tuple[int, int] | None:
        """The most likely node and the direction in which the robot looks now, also while it turns or is in a room."""
        state = None if self.belief is None else self.belief.most_likely
        if state is None:
            return None
        return node_of(state), (heading_of(state) + self.frame.axis - self.frame.looks) % QUARTERS

    def moved(self, step: Step) -> None:
        """The robot moved."""
        self.frame.moved(step)

    def observe(self, scan: Scan) -> PositionBelief | None:
        """The belief after a scan; None before the first node."""
        frame, features = self.frame, self._features
        lines, rays = extract_lines(scan, features), rays_of(scan, features)
        frame.observe(lines, rays)
        if not frame.known:
            return None
        if self._begins_there and self.belief is None:
            frame.node, self.belief = Noticed(frame.place, _BEGIN**2), self._first
        corners, openings = corners_of(lines, features), openings_of(lines, rays, features)
        self.openings.observe(frame, openings, rays)
        if frame.looks_ahead:
            self._turned_at = None
            self.in_hallway = self._is_in_hallway(lines)
        else:
            self._turn(lines)
        if self.in_hallway and frame.looks_ahead:
            self._notice(0.0)
            self._notice_wall(lines)
            self._look(of_walls(observation_graph(corners, openings, -frame.askew, self._places)))
        return self.belief

    def _is_in_hallway(self, lines: Lines) -> bool:
        """Whether the robot is in a hallway along which it looks. Where both walls are in sight its middle is known."""
        if not self.frame.sees_hallway:
            return False
        self._in_hallway_at = self.frame.place
        self.frame.find_middle(lines)
        return True

    def _turn(self, lines: Lines) -> None:
        """The robot turns, and at last is along another axis."""
        frame = self.frame
        if self._turned_at is None:
            self._turned_at = frame.place
            if frame.is_near(self._in_hallway_at, _DOORWAY):
                self._notice(_AHEAD)
        if not frame.aligned or frame.looks == frame.axis:
            return
        quarters = (frame.axis - frame.looks) % QUARTERS
        if quarters % 2:
            if self._turns_elsewhere and frame.is_near(self._in_hallway_at, _DOORWAY):
                self._reach(Noticed(self._turned_at, _SOMEWHERE**2))
            # A node is in the middle of the hallways that meet there.
            frame.middle = frame.node_place
        if not self._is_in_hallway(lines):
            self.in_hallway = False
            return
        if quarters % 2 and self._turns_elsewhere:
            # Where another hallway leads off there is a node, whatever was seen of it.
            self._arrive(Noticed(self._turned_at, _SOMEWHERE**2))
            frame.middle = frame.node_place
        if self.belief is not None:
            self.belief = self.belief.turned(quarters)
        self._looked = None if quarters % 2 else self._looked
        frame.axis, self._turned_at, self.in_hallway = frame.looks, None, True
        # What was passed is passed again.
        self._passed, self._unlisted = (
            [place for place in places if frame.is_near(place, _THERE)] for places in (self._passed, self._unlisted)
        )

    @property
    def _turns_elsewhere(self) -> bool:
        """Whether the robot turns elsewhere than at its last node."""
        node, turned_at = self.frame.node, self._turned_at
        assert turned_at is not None
        return node is not None and min(math.dist(at, node.place) for at in (self.frame.place, turned_at)) > _THERE

    def _notice(self, ahead: float) -> None:
        """Arrive at the openings that are passed.

        :param ahead: so far ahead of the robot they count already, m.
        """
        frame = self.frame
        openings = self.openings.beside(frame)
        found = [(float((one.pose.mean[:2] - frame.place) @ frame.direction), one) for one in openings]
        for away, landmark in sorted(found, key=lambda each: each[0]):
            if -_BEHIND <= away <= ahead:
                variance = float(landmark.pose.covariance[:2, :2].trace())
                self._reach(Noticed(frame.beyond(away), variance))

    def _notice_wall(self, lines: Lines) -> None:
        """Arrive at the end of a hallway."""
        away = wall_ahead(lines, -self.frame.askew)
        self.at_wall = away is not None and away <= _WALL
        if away is not None and self.at_wall:
            self._reach(Noticed(self.frame.beyond(away - BEFORE), _PLACED**2), end=True)

    def _reach(self, noticed: Noticed, *, end: bool = False) -> None:
        """Arrive at what was noticed, unless it was noticed before, or is none of the map.

        An opening at which the robot is again corrects its place. An end that is so near to an opening is no node. One
        that is none of the map may be another one that somebody half hides, and no end is taken for it.
        """
        frame = self.frame
        known = self._passed if end else self._passed + self._unlisted
        away = [np.abs((place - noticed.place) @ frame.direction) for place in known]
        if away and min(away) < _SAME:
            return
        if frame.node is not None and abs((noticed.place - frame.node.place) @ frame.direction) <= _THERE:
            frame.node = frame.node if end else noticed
            self._passed = [*self._passed[-2:], noticed.place]
        elif self.belief is None or self.belief.is_listed(self._way(noticed)):
            self._arrive(noticed)
        else:
            self._unlisted = [*self._unlisted[-2:], noticed.place]

    def _arrive(self, noticed: Noticed) -> None:
        self._passed = [*self._passed[-2:], noticed.place]
        self.belief = self._first if self.belief is None else self.belief.arrived(self._way(noticed))
        self.frame.node, self._looked, self._told = noticed, None, self.frame.place
        self.arrivals += 1

    def _way(self, noticed: Noticed) -> Travel:
        """From the last node."""
        last = self.frame.node
        assert last is not None
        distance = float((noticed.place - last.place) @ self.frame.direction)
        return Travel(max(0.0, distance), 0.0, (last.variance + noticed.variance, _UNTOLD))

    def _look(self, seen: Landmarks) -> None:
        """Ask the observation function, where as much of the hallway is new as the robot sees of it."""
        frame, last = self.frame, self.frame.node
        if self.belief is None or last is None or frame.is_near(self._looked, 2.0 * self._places.reach):
            return
        if self.belief.in_room >= 0.5:
            return
        variance = last.variance + _PLACED**2
        gone = math.dist(frame.place, self._told)
        self.belief = self.belief.gone_on(gone).observed(seen, self._model, frame.away, variance)
        self._looked = self._told = frame.place
        state = self.belief.most_likely
        if self.belief.confident and state is not None:
            ahead, variance = place_along(seen, self.belief.graph.expected, state, frame.away, variance, self._model)
            frame.node = Noticed(last.place + (frame.away - ahead) * frame.direction, variance)
