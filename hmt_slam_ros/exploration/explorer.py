"""The explorer: drives the robot until the building is known, hallways first and then rooms, and to named places.

Tomatis, Nourbakhsh and Siegwart (2003): all hallways depth first, then the rooms by backtracking. What is depth first
in a building, whose crossings have few arms, is to go to the nearest end of known ground: behind a crossing that is the
hallway ahead, in a dead end the arm of the last crossing that was left out.
"""

from __future__ import annotations

import math

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.exploration_map import Atlas
from hmt_slam_ros.exploration.path_follower import Pilot, Route, limits_of
from hmt_slam_ros.exploration.roadmap import Here, Opened
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.tasks import Errand, Heading, Outcome, Steering
from hmt_slam_ros.sensors import Scan

# So near a frontier and a place are reached, m.
_AT_FRONTIER, _AT_PLACE = 0.5, 0.15
# So near a frontier nothing more is seen from it where the robot does not get nearer, m.
_BESIDE_FRONTIER = 1.0
# So near to a frontier in a hallway it is chosen anew, since it moves on, m.
_MOVES_ON = 3.0
# Frontiers nearer to each other than this, m, are one.
_SAME = 0.7
# How often a way to a place is looked for anew where the robot is held up.
_TRIES = 3
_STAND = (0.0, 0.0)


class Explorer:
    """The explorer as a process. Consumes Errand, Scan, RealTimePose and the chain; says what tasks.py has.

    :ivar atlas: what it knows.
    """

    def __init__(self, configuration: Configuration, known: Replica | None = None) -> None:
        """:param known: the map at first, None for none."""
        own = configuration.explorer
        self._limits = limits_of(own)
        self._patience = round(NANOSECONDS * own.patience)
        self.atlas = Atlas(configuration, known)
        self._errand: Errand | None = None
        self._tries = 0
        self._target: Opened | None = None
        self._route: Route | None = None
        self._pilot = Pilot(self._limits, _AT_PLACE)
        self._velocity = _STAND
        # Frontiers where it was, and others that it did not reach: each a place in the frame of a keyframe.
        self._reached: list[tuple[int, Float64]] = []
        self._given_up: list[tuple[int, Float64]] = []
        self._again = True
        self._single = configuration.places.max_entropy if own.backtracks else math.inf
        self._backs = False

    def handle(self, message: Message) -> list[Message]:
        """Take in one message; a scan is answered with velocities."""
        if isinstance(message, Errand):
            self._errand = None if message.kind == "stop" else message
            self._route, self._tries, self._again = None, 0, True
        elif isinstance(message, Scan):
            return self._drive(message)
        else:
            self.atlas.hear(message)
        return []

    def _drive(self, scan: Scan) -> list[Message]:
        said: list[Message] = []
        ready = self.atlas.ready(scan.stamp)
        if ready and self._errand is not None:
            if self.atlas.changed and not self._holds():
                self._route = None
            if self._route is None:
                said += self._decide(self._errand, scan.stamp)
        self._velocity = self._steered(scan, said) if ready and self._route is not None else _STAND
        return [*said, Steering(scan.stamp, *self._velocity)]

    def _holds(self) -> bool:
        """Whether it goes on to where it went."""
        if self._route is None or not self.atlas.frames.knows(self._route):
            return False
        if self._backs or self._unclear:
            return self._backs and self._unclear
        return not (self._exploring and self._target and self._target.hallway and self._pilot.left < _MOVES_ON)

    @property
    def _exploring(self) -> bool:
        return self._errand is not None and self._errand.kind == "explore"

    @property
    def _unclear(self) -> bool:
        """Whether it turns back until one topological path has nearly all of the probability, as the paper's robot."""
        return self._exploring and self.atlas.entropy >= self._single

    def _steered(self, scan: Scan, said: list[Message]) -> tuple[float, float]:
        """The velocities along the route; where that ends, what there is to say is added."""
        assert self._route is not None
        command = self._pilot.steer(scan, self.atlas.way(self._route), self._velocity)
        if self._pilot.arrived or self._pilot.stuck(scan.stamp, self._patience):
            # What is to be seen at a frontier is seen from beside it.
            near = self._exploring and self._pilot.left <= _BESIDE_FRONTIER
            said += self._end(reached=self._pilot.arrived or near)
        return command.speed, command.turn_rate

    def _end(self, *, reached: bool) -> list[Message]:
        """The route is at its end."""
        self._route = None
        if self._backs:
            return []
        if self._exploring:
            assert self._target is not None
            (self._reached if reached else self._given_up).append((self._target.keyframe, self._target.way[-1]))
            self._again |= reached
            if reached and not self._target.hallway:
                self.atlas.enter()
            return []
        self._tries += 1
        if reached:
            return self._done("the robot is there", reached=True)
        if self._tries >= _TRIES:
            return self._done("given up: something is in the way", reached=False)
        return []

    def _done(self, text: str, *, reached: bool) -> list[Message]:
        assert self._errand is not None
        outcome = Outcome(self._errand, reached, text)
        self._errand = self._route = None
        return [outcome]

    def _decide(self, errand: Errand, stamp: int) -> list[Message]:
        """Choose where to go."""
        here = self.atlas.look()
        if here is None:
            return []
        self._backs = self._unclear
        choose = {"explore": self._to_frontier, "go": self._to_place, "backtrack": self._back}[errand.kind]
        said = self._back(here) if self._backs else choose(here)
        if self._route is not None:
            area, goal = self.atlas.goal(self._route)
            said.append(Heading(stamp, area, goal))
        return said

    def _take(self, here: Here, keyframes: list[int], last: Float64, tolerance: float) -> None:
        self._route = Route.over(here.way, keyframes, last)
        self._pilot = Pilot(self._limits, tolerance)

    def _to_frontier(self, here: Here) -> list[Message]:
        """Choose the nearest frontier in a hallway, else the nearest one."""
        survey = self.atlas.survey
        distances = survey.distances(here.keyframe)
        choices = [
            (not one.hallway, distances[one.keyframe] + one.length, number)
            for number, one in enumerate(survey.frontiers)
            if one.keyframe in distances and not self._was_tried(one)
        ]
        if not choices:
            return self._all_tried()
        target = self._target = survey.frontiers[min(choices)[2]]
        self._take(here, survey.path(here.keyframe, target.keyframe), target.way, _AT_FRONTIER)
        return []

    def _all_tried(self) -> list[Message]:
        """Nothing is left; what was given up, maybe because of people, is tried anew until none of it is reached."""
        if self._given_up and self._again:
            self._again, self._given_up = False, []
            return []
        left = len(self._given_up)
        return self._done(f"all is known that can be reached; {left} places were given up", reached=True)

    def _was_tried(self, one: Opened) -> bool:
        frames = self.atlas.frames
        place = se2.transform(frames.pose(one.keyframe), one.way[-1])
        return any(
            math.dist(place, se2.transform(frames.pose(keyframe), point)) < _SAME
            for keyframe, point in self._reached + self._given_up
            if keyframe in frames
        )

    def _to_place(self, here: Here) -> list[Message]:
        assert self._errand is not None
        places, survey = self.atlas.places(), self.atlas.survey
        keyframe = places.get(self._errand.place)
        if keyframe is None:
            return self._done(f"there is no such place: choose from {', '.join(places)}", reached=False)
        if keyframe not in survey.distances(here.keyframe):
            return self._done("no way is known that leads there", reached=False)
        self._take(here, survey.path(here.keyframe, keyframe), here.way[:0], _AT_PLACE)
        return []

    def _back(self, here: Here) -> list[Message]:
        """Back along the robot's own path."""
        self._take(here, self.atlas.survey.way_back(here.keyframe), here.way[:0], _AT_PLACE)
        return []
