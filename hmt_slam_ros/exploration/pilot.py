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
from hmt_slam_ros.exploration.mission_controller import MissionController, Phase
from hmt_slam_ros.exploration.path_follower import motion_limits
from hmt_slam_ros.exploration.rooms import KnownBuilding, named_destinations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.shortest_path import connected_areas
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.map_changes import InitialPose
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe, Message, PoseReset, RealTimePose
from hmt_slam_ros.messages.replica import Replica, ReplicaState
from hmt_slam_ros.messages.tasks import GoalPose, PlaceEstimate, Task, TaskResult, VelocityCommand
from hmt_slam_ros.places.edge_existence import EdgeMonitor
from hmt_slam_ros.places.observation_graph import QUARTER_TURN, QUARTERS
from hmt_slam_ros.places.place_graph import DIRECTION_NAMES, state_of
from hmt_slam_ros.places.policy import MetricInitialPose, metric_initial_pose
from hmt_slam_ros.places.position_belief import PositionBelief, certain_belief, uniform_belief
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.motion_model import NO_MOTION, RelativeMotion, increment_covariance
from hmt_slam_ros.sensors.odometry import OdometryBuffer

# Two beliefs over one pose agree with this probability, both known no better than this, m, m, rad.
_AGREEMENT_GATE = chi_square_gate(0.999)
_MIN_COVARIANCE = np.diag([0.1, 0.1, math.radians(3.0)]) ** 2
# A pose is good for so long, ns.
_MAX_POSE_AGE = NANOSECONDS


class MetricPoseTracker:
    """What RTL said last, at the time of the newest scan, and the map that they have by now.

    Where the robot was lost they map on in new areas, and join these to the map as they recognize it.
    """

    def __init__(self, replica: Replica) -> None:
        """:param replica: their map at first."""
        self._replica = replica
        self._readings = OdometryBuffer()
        self._last_pose: RealTimePose | None = None
        self._predicted_pose: PoseGaussian | None = None

    def on_message(self, message: Message) -> None:
        """Take in what is newest."""
        if isinstance(message, Odometry):
            self._readings.add(message)
        elif isinstance(message, RealTimePose):
            self._last_pose = message
        elif isinstance(message, Keyframe | Hypotheses | ClosureDecision):
            self._replica.apply_message(message)

    def predict_to(self, stamp: int) -> None:
        """Carry the pose on to a time, ns, or back to it."""
        self._predicted_pose = None
        self._readings.pose_at(stamp - _MAX_POSE_AGE)
        newest = self._last_pose
        if newest is not None and abs(stamp - newest.stamp) <= _MAX_POSE_AGE:
            since = se2.exp(self._readings.twist_between(newest.stamp, stamp))
            self._predicted_pose = newest.pose_in_area.compose(PoseGaussian.from_pose(since))

    def pose_in_area(self, area: int) -> PoseGaussian | None:
        """The belief over ``area_T_base``; None where they do not have the robot in the map.

        Metric SLAM lays what is around the robot into the frame of the robot's area as the arcs have it, and matches
        with that. So the pose relative to what is there is as good as the match, however long the way over the arcs is.
        """
        hybrid_map = self._replica.maps[self._replica.best_hypothesis]
        if self._predicted_pose is None or self._last_pose is None or not hybrid_map.has_area(area):
            return None
        frame = connected_areas(hybrid_map, area).get(self._last_pose.area)
        return None if frame is None else PoseGaussian.from_pose(frame.mean).compose(self._predicted_pose)

    def agrees_with(self, area: int, belief: PoseGaussian) -> bool:
        """Whether they have the robot where another belief over ``area_T_base`` has it."""
        told = self.pose_in_area(area)
        if told is None:
            return False
        off = se2.log(se2.between(belief.mean, told.mean))
        spread = belief.covariance + told.covariance + _MIN_COVARIANCE
        return float(off @ np.linalg.solve(spread, off)) <= _AGREEMENT_GATE


# Scans that wait for odometry, at most.
_WAITING = 50
# So far before the door, m, it is out of a room.
_EXIT_DISTANCE = 0.6
# A robot stands that went and turned no more than this since the last scan, m and rad, and waits for so long, ns.
_STANDING_DISTANCE, _STANDING_ANGLE, _RELOCALIZATION_TIMEOUT = 0.01, math.radians(1.0), 3 * NANOSECONDS
# A scan that is stamped so much before the one before, ns, says that time went back.
_TIME_JUMP = NANOSECONDS


class PilotProcess:
    """The pilot as a process. Consumes Task, Odometry, Scan, RealTimePose and the chain; says PoseReset, and what
    tasks.py has.

    :ivar rooms: {name: the place in it} to which it can be sent.
    :ivar controller: that drives.
    """

    def __init__(self, configuration: Configuration, saved: ReplicaState) -> None:
        """:param saved: the map, with which the metric processes begin, too.

        :raises HmtSlamError: where no place is in it.
        """
        replica = Replica.from_state(saved)
        self._configuration = configuration
        self._building = KnownBuilding.from_map(replica.maps[replica.best_hypothesis], replica.scans, configuration)
        self._metric_poses = MetricPoseTracker(Replica.from_state(saved))
        self._limits = motion_limits(configuration.explorer)
        self._task_timeout = round(NANOSECONDS * configuration.pilot.task_timeout)
        self._edge_monitor = EdgeMonitor(self._building.graph, configuration.features)
        self._uniform_belief = uniform_belief(self._building.graph, configuration.places)
        self.rooms = named_destinations(self._building)
        self._reset()

    def _reset(self) -> None:
        """The robot may be anywhere, at any time."""
        self._reset_controller(None)
        self._readings = OdometryBuffer()
        self._waiting: deque[Scan] = deque(maxlen=_WAITING)
        self._stamp, self._odometry = 0, np.zeros(3)
        self._task: Task | None = None
        self._task_start: int | None = None
        self._unconfirmed_pose: MetricInitialPose | None = None
        self._pose_reset_stamp: int | None = None
        self._last_opening: tuple[int, object] | None = None
        self._room_name, self._step = "", NO_MOTION

    def _reset_controller(self, belief: PositionBelief | None) -> None:
        self.controller = MissionController(
            self._building, self._configuration, self._limits, belief, self._edge_monitor
        )

    def handle(self, message: Message) -> list[Message]:
        """Take in one message; a scan is answered as soon as odometry of its time is there."""
        if isinstance(message, Task):
            return self._accept_task(message)
        said: list[Message] = []
        self._metric_poses.on_message(message)
        if isinstance(message, Odometry):
            self._readings.add(message)
        elif isinstance(message, Scan):
            said += self._handle_time_jump(message.stamp)
            self._waiting.append(message)
        while self._waiting and self._readings.covers(self._waiting[0].stamp):
            said += self._process_scan(self._waiting.popleft())
        return said

    def _accept_task(self, task: Task) -> list[Message]:
        """Begin a task in place of the one before."""
        if not self._configuration.pilot.drives:
            return [TaskResult(task, False, "pilot.drives is false, so others drive the robot: set it to true")]
        if task.kind == "go" and task.place not in self.rooms:
            choice = ", ".join(self.rooms) or "none, as the robot was in no room behind a door"
            return [TaskResult(task, False, f"there is no such room: choose from {choice}")]
        if task.kind == "stop":
            return self._stop()
        self._task, self._task_start = task, None
        goal = self.rooms.get(task.place)
        if self.controller.room is None or goal is not None:
            self.controller.start_mission(goal)
        return [] if goal is None else [GoalPose(self._stamp, goal.opening.area, goal.pose)]

    def _stop(self) -> list[Message]:
        """Let the robot stand, if it is on a task."""
        if self._task is None:
            return []
        self.controller.stop()
        self._task = None
        return [VelocityCommand(self._stamp, 0.0, 0.0)]

    def _handle_time_jump(self, stamp: int) -> list[Message]:
        """Begin anew where time went back."""
        if stamp > self._stamp - _TIME_JUMP:
            return []
        task, stopped = self._task, self._stop()
        self._reset()
        ended = [] if task is None else [TaskResult(task, False, "given up: time went back")]
        return [*ended, *stopped]

    def _process_scan(self, scan: Scan) -> list[Message]:
        """Follow the robot, and drive."""
        odometry = self._readings.pose_at(scan.stamp)
        if odometry is None or scan.stamp <= self._stamp:
            return []
        self._predict(odometry[0])
        self._stamp = scan.stamp
        self._metric_poses.predict_to(scan.stamp)
        before = self.controller.initial_pose
        command = self.controller.steer(scan)
        if self.controller.initial_pose is not before:
            self._begin_room(self.controller.initial_pose)
        self._detect_room_exit()
        said = [self._place_estimate(), *self._reset_pose_at_opening(), *self._confirm_room_pose()]
        if self._task is None:
            return said
        ended = self._task_result(self._task)
        if ended is not None:
            return [*said, ended, *self._stop()]
        stands = self._unconfirmed_pose is not None
        return [*said, VelocityCommand(scan.stamp, 0.0, 0.0) if stands else VelocityCommand(scan.stamp, *command[:2])]

    def _predict(self, odometry: Float64) -> None:
        """The robot moved to where odometry has it now, ``odom_T_base`` (3,)."""
        if self._stamp:
            increment = se2.between(self._odometry, odometry)
            self._step = RelativeMotion(increment, increment_covariance(increment, self._configuration.motion))
            self.controller.predict(self._step)
        self._odometry = odometry

    def _begin_room(self, start: MetricInitialPose | None) -> None:
        """The metric filter of a room begins."""
        assert self._task is not None
        self._room_name, self._pose_reset_stamp, self._unconfirmed_pose = self._task.place, None, start

    def _confirm_room_pose(self) -> list[Message]:
        """The robot stands before the door until the metric processes have it there, or do not find it.

        They are told where it is if they do not know, and take that for the place of the next scan. Where they have it
        elsewhere in the map the belief is taken for wrong, since surfaces say more than landmarks.
        """
        entered, room = self._unconfirmed_pose, self.controller.room
        if entered is None or room is None:
            self._unconfirmed_pose = None
            return []
        belief = PoseGaussian(room.pose, entered.pose.covariance)
        late = self._pose_reset_stamp is not None and self._stamp - self._pose_reset_stamp > _RELOCALIZATION_TIMEOUT
        if late or self._metric_poses.agrees_with(entered.area, belief):
            self._unconfirmed_pose = None
        elif self._metric_poses.pose_in_area(entered.area) is not None and self._is_standing:
            self._unconfirmed_pose = None
            self.controller.restart_in_hallway(self._uniform_belief)
        elif self._pose_reset_stamp is None and self._is_standing:
            self._pose_reset_stamp = self._stamp
            return [PoseReset(InitialPose(entered.area, belief))]
        return []

    def _reset_pose_at_opening(self) -> list[Message]:
        """What an opening tells through which a robot looks that others drive, once, unless it is known."""
        estimator = self.controller.estimator
        this = estimator.arrivals, estimator.node_and_direction
        if self._task is not None or self.controller.room is not None or this == self._last_opening or self._is_turning:
            return []
        start = metric_initial_pose(estimator, self._building.chart)
        if start is None:
            return []
        self._last_opening = this
        known = self._metric_poses.pose_in_area(start.area) is not None
        return [] if known else [PoseReset(InitialPose(start.area, start.pose))]

    @property
    def _is_turning(self) -> bool:
        return abs(float(self._step.increment[2])) > _STANDING_ANGLE

    @property
    def _is_standing(self) -> bool:
        return not self._is_turning and float(np.hypot(*self._step.increment[:2])) <= _STANDING_DISTANCE

    def _place_estimate(self) -> PlaceEstimate:
        estimator, chart = self.controller.estimator, self._building.chart
        belief = estimator.belief or self._uniform_belief
        facing = estimator.node_and_direction
        share = float(belief.probabilities.max() if facing else belief.probabilities[-1])
        return PlaceEstimate(
            self._stamp,
            chart.name(facing[0]) if facing else None,
            DIRECTION_NAMES[facing[1]] if facing else None,
            estimator.frame.distance_past_node if facing else 0.0,
            share,
            max(0.0, belief.entropy),
            belief.is_confident,
            None if self.controller.room is None else self._room_name,
        )

    def _detect_room_exit(self) -> None:
        """Where somebody drove the robot out of a room it is at the node before the door."""
        room = self.controller.room
        if room is None or self._task is not None:
            return
        node, opening, _ = self.rooms[self._room_name]
        off = se2.between(opening.landmark.pose.mean, room.pose)
        if off[0] > -_EXIT_DISTANCE:
            return
        state = state_of(node, (opening.direction - round(off[2] / QUARTER_TURN)) % QUARTERS)
        room.release()
        self._reset_controller(certain_belief(self._building.graph, self._configuration.places, state))

    def _is_localized_for(self, task: Task) -> bool:
        """Whether it is known where the robot is, and that was asked."""
        estimator = self.controller.estimator
        known = (
            estimator.belief is not None and estimator.belief.is_confident and estimator.node_and_direction is not None
        )
        return task.kind == "localize" and (known or self.controller.room is not None)

    @property
    def _location_text(self) -> str:
        """Where it is most probably."""
        if self.controller.room is not None:
            return f"in {self._room_name}"
        facing = self.controller.estimator.node_and_direction
        assert facing is not None
        return f"at {self._building.chart.name(facing[0])}, looking {DIRECTION_NAMES[facing[1]]}"

    def _task_result(self, task: Task) -> TaskResult | None:
        """How a task ended, if it did."""
        if self._task_start is None:
            self._task_start = self._stamp
        if self._is_localized_for(task):
            return TaskResult(task, True, f"the robot is {self._location_text}")
        if task.kind == "go" and self.controller.phase is Phase.THERE:
            return TaskResult(task, True, "the robot is there")
        if self.controller.phase is Phase.LOST:
            return TaskResult(task, False, "no way is known that leads there")
        if self._stamp - self._task_start > self._task_timeout:
            return TaskResult(task, False, f"given up after {self._configuration.pilot.task_timeout:g} s")
        return None
