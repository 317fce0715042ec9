"""The pilot: says where the robot is by the belief over places, and gets it to rooms by that.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.4: the metric filter starts with what the door tells. RTL tells the
pose in which metric SLAM has the robot; whether that agrees with the door shows whether either is wrong.

Tomatis, Nourbakhsh and Siegwart (2003), sections 3.3 and 3.4. The belief is followed at every scan, whoever drives. At
an opening, where it is confident, it tells metric SLAM where the robot is, if that does not know. Behind the door of a
mission the robot is steered by the metric filter of the room, see rooms.py.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.mission_controller import MissionPilot, Phase
from hmt_slam_ros.exploration.path_follower import limits_of
from hmt_slam_ros.exploration.rooms import KnownBuilding, rooms
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, gate
from hmt_slam_ros.hybrid_map.shortest_path import joined
from hmt_slam_ros.landmarks.heading import QUARTER
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.map_changes import Place
from hmt_slam_ros.messages.messages import Accepted, Carried, Hypotheses, Keyframe, Message, RealTimePose
from hmt_slam_ros.messages.replica import Replica, ReplicaState
from hmt_slam_ros.messages.tasks import Errand, Heading, Outcome, PlaceEstimate, Steering
from hmt_slam_ros.places.edge_existence import WatchedWays
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import DIRECTION_NAMES, state_of
from hmt_slam_ros.places.policy import MetricStart, metric_start
from hmt_slam_ros.places.position_belief import PositionBelief, certain_belief, flat_belief
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.motion_model import NO_STEP, Step, increment_covariance
from hmt_slam_ros.sensors.odometry import OdometryBuffer

# Two beliefs over one pose agree with this probability, both known no better than this, m, m, rad.
_AGREES = gate(0.999)
_LEAST = np.diag([0.1, 0.1, math.radians(3.0)]) ** 2
# A pose is good for so long, ns.
_FRESH = NANOSECONDS


class MetricProcesses:
    """What RTL said last, at the time of the newest scan, and the map that they have by now.

    Where the robot was lost they map on in new areas, and join these to the map as they recognize it.
    """

    def __init__(self, replica: Replica) -> None:
        """:param replica: their map at first."""
        self._replica = replica
        self._readings = OdometryBuffer()
        self._newest: RealTimePose | None = None
        self._now: PoseGaussian | None = None

    def hear(self, message: Message) -> None:
        """Take in what is newest."""
        if isinstance(message, Odometry):
            self._readings.add(message)
        elif isinstance(message, RealTimePose):
            self._newest = message
        elif isinstance(message, Keyframe | Hypotheses | Accepted):
            self._replica.hear(message)

    def carry(self, stamp: int) -> None:
        """Carry the pose on to a time, ns, or back to it."""
        self._now = None
        self._readings.at(stamp - _FRESH)
        newest = self._newest
        if newest is not None and abs(stamp - newest.stamp) <= _FRESH:
            since = se2.exp(self._readings.motion(newest.stamp, stamp))
            self._now = newest.local.compose(PoseGaussian.exactly(since))

    def told(self, area: int) -> PoseGaussian | None:
        """The belief over ``area_T_base``; None where they do not have the robot in the map.

        Metric SLAM lays what is around the robot into the frame of the robot's area as the arcs have it, and matches
        with that. So the pose relative to what is there is as good as the match, however long the way over the arcs is.
        """
        hybrid_map = self._replica.maps[self._replica.best]
        if self._now is None or self._newest is None or not hybrid_map.has_area(area):
            return None
        frame = joined(hybrid_map, area).get(self._newest.area)
        return None if frame is None else PoseGaussian.exactly(frame.mean).compose(self._now)

    def agree(self, area: int, belief: PoseGaussian) -> bool:
        """Whether they have the robot where another belief over ``area_T_base`` has it."""
        told = self.told(area)
        if told is None:
            return False
        off = se2.log(se2.between(belief.mean, told.mean))
        spread = belief.covariance + told.covariance + _LEAST
        return float(off @ np.linalg.solve(spread, off)) <= _AGREES


# Scans that wait for odometry, at most.
_WAITING = 50
# So far before the door, m, it is out of a room.
_OUT = 0.6
# A robot stands that went and turned no more than this since the last scan, m and rad, and waits for so long, ns.
_GOES, _TURNS, _WAITS = 0.01, math.radians(1.0), 3 * NANOSECONDS
# A scan that is stamped so much before the one before, ns, says that time went back.
_BACK = NANOSECONDS


class Missions:
    """The pilot as a process. Consumes Errand, Odometry, Scan, RealTimePose and the chain; says Carried, and what
    tasks.py has.

    :ivar rooms: {name: the place in it} to which it can be sent.
    :ivar pilot: that drives.
    """

    def __init__(self, configuration: Configuration, saved: ReplicaState) -> None:
        """:param saved: the map, with which the metric processes begin, too.

        :raises HmtSlamError: where no place is in it.
        """
        replica = Replica.of(saved)
        self._configuration = configuration
        self._known = KnownBuilding.of(replica.maps[replica.best], replica.scans, configuration)
        self._metric = MetricProcesses(Replica.of(saved))
        self._limits = limits_of(configuration.explorer)
        self._patience = round(NANOSECONDS * configuration.pilot.patience)
        self._ways = WatchedWays(self._known.graph, configuration.features)
        self._nothing = flat_belief(self._known.graph, configuration.places)
        self.rooms = rooms(self._known)
        self._begin()

    def _begin(self) -> None:
        """The robot may be anywhere, at any time."""
        self._drive_anew(None)
        self._readings = OdometryBuffer()
        self._waiting: deque[Scan] = deque(maxlen=_WAITING)
        self._stamp, self._odometry = 0, np.zeros(3)
        self._errand: Errand | None = None
        self._since: int | None = None
        self._entered: MetricStart | None = None
        self._told_at: int | None = None
        self._seen_through: tuple[int, object] | None = None
        self._room, self._step = "", NO_STEP

    def _drive_anew(self, belief: PositionBelief | None) -> None:
        self.pilot = MissionPilot(self._known, self._configuration, self._limits, belief, self._ways)

    def handle(self, message: Message) -> list[Message]:
        """Take in one message; a scan is answered as soon as odometry of its time is there."""
        if isinstance(message, Errand):
            return self._take(message)
        said: list[Message] = []
        self._metric.hear(message)
        if isinstance(message, Odometry):
            self._readings.add(message)
        elif isinstance(message, Scan):
            said += self._back_in_time(message.stamp)
            self._waiting.append(message)
        while self._waiting and self._readings.covers(self._waiting[0].stamp):
            said += self._see(self._waiting.popleft())
        return said

    def _take(self, errand: Errand) -> list[Message]:
        """Begin an errand in place of the one before."""
        if not self._configuration.pilot.drives:
            return [Outcome(errand, False, "pilot.drives is false, so others drive the robot: set it to true")]
        if errand.kind == "go" and errand.place not in self.rooms:
            choice = ", ".join(self.rooms) or "none, as the robot was in no room behind a door"
            return [Outcome(errand, False, f"there is no such room: choose from {choice}")]
        if errand.kind == "stop":
            return self._stop()
        self._errand, self._since = errand, None
        goal = self.rooms.get(errand.place)
        if self.pilot.room is None or goal is not None:
            self.pilot.go(goal)
        return [] if goal is None else [Heading(self._stamp, goal.opening.area, goal.pose)]

    def _stop(self) -> list[Message]:
        """Let the robot stand, if it is on an errand."""
        if self._errand is None:
            return []
        self.pilot.stop()
        self._errand = None
        return [Steering(self._stamp, 0.0, 0.0)]

    def _back_in_time(self, stamp: int) -> list[Message]:
        """Begin anew where time went back."""
        if stamp > self._stamp - _BACK:
            return []
        errand, stopped = self._errand, self._stop()
        self._begin()
        ended = [] if errand is None else [Outcome(errand, False, "given up: time went back")]
        return [*ended, *stopped]

    def _see(self, scan: Scan) -> list[Message]:
        """Follow the robot, and drive."""
        odometry = self._readings.at(scan.stamp)
        if odometry is None or scan.stamp <= self._stamp:
            return []
        self._move(odometry[0])
        self._stamp = scan.stamp
        self._metric.carry(scan.stamp)
        before = self.pilot.started
        command = self.pilot.steer(scan)
        if self.pilot.started is not before:
            self._enter(self.pilot.started)
        self._follow_out()
        said = [self._estimate(), *self._at_opening(), *self._at_goal()]
        if self._errand is None:
            return said
        ended = self._ended(self._errand)
        if ended is not None:
            return [*said, ended, *self._stop()]
        stands = self._entered is not None
        return [*said, Steering(scan.stamp, 0.0, 0.0) if stands else Steering(scan.stamp, *command[:2])]

    def _move(self, odometry: Float64) -> None:
        """The robot moved to where odometry has it now, ``odom_T_base`` (3,)."""
        if self._stamp:
            increment = se2.between(self._odometry, odometry)
            self._step = Step(increment, increment_covariance(increment, self._configuration.motion))
            self.pilot.moved(self._step)
        self._odometry = odometry

    def _enter(self, start: MetricStart | None) -> None:
        """The metric filter of a room begins."""
        assert self._errand is not None
        self._room, self._told_at, self._entered = self._errand.place, None, start

    def _at_goal(self) -> list[Message]:
        """The robot stands before the door until the metric processes have it there, or do not find it.

        They are told where it is if they do not know, and take that for the place of the next scan. Where they have it
        elsewhere in the map the belief is taken for wrong, since surfaces say more than landmarks.
        """
        entered, room = self._entered, self.pilot.room
        if entered is None or room is None:
            self._entered = None
            return []
        belief = PoseGaussian(room.pose, entered.pose.covariance)
        late = self._told_at is not None and self._stamp - self._told_at > _WAITS
        if late or self._metric.agree(entered.area, belief):
            self._entered = None
        elif self._metric.told(entered.area) is not None and self._stands:
            self._entered = None
            self.pilot.begin_anew(self._nothing)
        elif self._told_at is None and self._stands:
            self._told_at = self._stamp
            return [Carried(Place(entered.area, belief))]
        return []

    def _at_opening(self) -> list[Message]:
        """What an opening tells through which a robot looks that others drive, once, unless it is known."""
        estimator = self.pilot.estimator
        this = estimator.arrivals, estimator.facing
        if self._errand is not None or self.pilot.room is not None or this == self._seen_through or self._turns:
            return []
        start = metric_start(estimator, self._known.chart)
        if start is None:
            return []
        self._seen_through = this
        known = self._metric.told(start.area) is not None
        return [] if known else [Carried(Place(start.area, start.pose))]

    @property
    def _turns(self) -> bool:
        return abs(float(self._step.increment[2])) > _TURNS

    @property
    def _stands(self) -> bool:
        return not self._turns and float(np.hypot(*self._step.increment[:2])) <= _GOES

    def _estimate(self) -> PlaceEstimate:
        estimator, chart = self.pilot.estimator, self._known.chart
        belief = estimator.belief or self._nothing
        facing = estimator.facing
        share = float(belief.probabilities.max() if facing else belief.probabilities[-1])
        return PlaceEstimate(
            self._stamp,
            chart.name(facing[0]) if facing else None,
            DIRECTION_NAMES[facing[1]] if facing else None,
            estimator.frame.away if facing else 0.0,
            share,
            max(0.0, belief.entropy),
            belief.confident,
            None if self.pilot.room is None else self._room,
        )

    def _follow_out(self) -> None:
        """Where somebody drove the robot out of a room it is at the node before the door."""
        room = self.pilot.room
        if room is None or self._errand is not None:
            return
        node, opening, _ = self.rooms[self._room]
        off = se2.between(opening.landmark.pose.mean, room.pose)
        if off[0] > -_OUT:
            return
        state = state_of(node, (opening.direction - round(off[2] / QUARTER)) % QUARTERS)
        room.release()
        self._drive_anew(certain_belief(self._known.graph, self._configuration.places, state))

    def _found(self, errand: Errand) -> bool:
        """Whether it is known where the robot is, and that was asked."""
        estimator = self.pilot.estimator
        known = estimator.belief is not None and estimator.belief.confident and estimator.facing is not None
        return errand.kind == "find" and (known or self.pilot.room is not None)

    @property
    def _somewhere(self) -> str:
        """Where it is most probably."""
        if self.pilot.room is not None:
            return f"in {self._room}"
        facing = self.pilot.estimator.facing
        assert facing is not None
        return f"at {self._known.chart.name(facing[0])}, looking {DIRECTION_NAMES[facing[1]]}"

    def _ended(self, errand: Errand) -> Outcome | None:
        """How an errand ended, if it did."""
        if self._since is None:
            self._since = self._stamp
        if self._found(errand):
            return Outcome(errand, True, f"the robot is {self._somewhere}")
        if errand.kind == "go" and self.pilot.phase is Phase.THERE:
            return Outcome(errand, True, "the robot is there")
        if self.pilot.phase is Phase.LOST:
            return Outcome(errand, False, "no way is known that leads there")
        if self._stamp - self._since > self._patience:
            return Outcome(errand, False, f"given up after {self._configuration.pilot.patience:g} s")
        return None
