"""The pilot: estimates the robot's place, and drives it to rooms by that.

Tomatis, Nourbakhsh and Siegwart (2003), sections 3.3 and 3.4.

1. The belief over places is updated at every scan, also where others drive.
2. At an opening a confident belief gives metric SLAM an initial pose, if that is lost.
3. Behind the door of a task the metric filter of the room steers the robot (rooms.py).
4. There the pose of RTL is compared with that by the door, which shows whether either is wrong.

On its way to a pose the pilot localizes the robot in the same way, if metric SLAM is lost, and then drives as the
explorer does.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.exploration_map import ExplorationMap
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.exploration.local_motion import MotionCommand
from hmt_slam_ros.exploration.mission_controller import MissionController, Phase
from hmt_slam_ros.exploration.path_follower import motion_limits
from hmt_slam_ros.exploration.rooms import KnownBuilding, named_destinations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.shortest_path import connected_areas
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.map_changes import InitialPose
from hmt_slam_ros.messages.messages import Message, PoseReset, RealTimePose
from hmt_slam_ros.messages.replica import Replica, ReplicaState
from hmt_slam_ros.messages.tasks import (
    GoalPose,
    PlaceEstimate,
    Task,
    TaskError,
    TaskProgress,
    TaskResult,
    VelocityCommand,
)
from hmt_slam_ros.places.edge_existence import EdgeMonitor
from hmt_slam_ros.places.observation_graph import QUARTER_TURN, QUARTERS
from hmt_slam_ros.places.place_graph import DIRECTION_NAMES, state_of
from hmt_slam_ros.places.policy import MetricInitialPose, metric_initial_pose
from hmt_slam_ros.places.position_belief import PositionBelief, certain_belief, uniform_belief
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.odometry import OdometryBuffer
from hmt_slam_ros.sensors.relative_motion import NO_MOTION, RelativeMotion, increment_covariance

_AGREEMENT_GATE = chi_square_gate(0.999)
"""Gate of the squared Mahalanobis distance between two beliefs over one pose."""

_MIN_COVARIANCE = np.diag([0.1, 0.1, math.radians(3.0)]) ** 2
"""Covariance that is added to both beliefs, m and rad."""

_MAX_POSE_AGE = NANOSECONDS
"""Age up to which a pose of RTL is used, ns."""

_MAX_WAITING_SCANS = 50
"""Scans that wait for odometry, at most."""

_EXIT_DISTANCE = 0.6
"""Distance before the door at which a robot has left a room, m."""

_STANDING_DISTANCE, _STANDING_ANGLE = 0.01, math.radians(1.0)
"""Largest motion of a standing robot between two scans, m and rad."""

_RELOCALIZATION_TIMEOUT = 3 * NANOSECONDS
"""Time for which the robot waits before a door for metric SLAM, ns."""

_TIME_JUMP = NANOSECONDS
"""Step of the stamps of scans back in time that resets the pilot, ns."""


class MetricPoseTracker:
    """The pose of RTL at the newest scan, in the current map of metric SLAM.

    A lost robot maps new areas, which a loop closure joins to the map later.
    """

    def __init__(self, current_map: ExplorationMap) -> None:
        """:param current_map: the map of metric SLAM, kept up to date."""
        self._map = current_map
        self._readings = OdometryBuffer()
        self._last_pose: RealTimePose | None = None
        self._predicted_pose: PoseGaussian | None = None

    def on_message(self, message: Message) -> None:
        """Process odometry or a pose."""
        if isinstance(message, Odometry):
            self._readings.add(message)
        elif isinstance(message, RealTimePose):
            self._last_pose = message

    def predict_to(self, stamp: int) -> None:
        """Move the pose to a time, ns, by odometry."""
        self._predicted_pose = None
        self._readings.pose_at(stamp - _MAX_POSE_AGE)
        newest = self._last_pose
        if newest is not None and abs(stamp - newest.stamp) <= _MAX_POSE_AGE:
            since = se2.exp(self._readings.twist_between(newest.stamp, stamp))
            self._predicted_pose = newest.pose_in_area.compose(PoseGaussian.from_pose(since))

    def pose_in_area(self, area: int) -> PoseGaussian | None:
        """The belief over ``area_T_base``; None while metric SLAM does not have the robot in the map.

        Metric SLAM matches with a submap that is assembled by the arcs. So the pose relative to an area is as accurate
        as the match, for any number of arcs in between.
        """
        hybrid_map = self._map.hybrid_map
        if self._predicted_pose is None or self._last_pose is None or not hybrid_map.has_area(area):
            return None
        frame = connected_areas(hybrid_map, area).get(self._last_pose.area)
        return None if frame is None else PoseGaussian.from_pose(frame.mean).compose(self._predicted_pose)

    def agrees_with(self, area: int, belief: PoseGaussian) -> bool:
        """Whether another belief over ``area_T_base`` agrees with that of metric SLAM."""
        pose = self.pose_in_area(area)
        if pose is None:
            return False
        difference = se2.log(se2.between(belief.mean, pose.mean))
        covariance = belief.covariance + pose.covariance + _MIN_COVARIANCE
        return float(difference @ np.linalg.solve(covariance, difference)) <= _AGREEMENT_GATE


class PilotProcess:
    """The pilot as a process.

    Consumes Task, Odometry, Scan, RealTimePose and the chain; produces PoseReset and the messages of tasks.py.

    :ivar rooms: {name: destination} of tasks.
    :ivar controller: drives the robot.
    :ivar exploration_map: the map of metric SLAM.
    :ivar task: what it does; None without a task.
    """

    def __init__(self, configuration: Configuration, saved: ReplicaState) -> None:
        """:param saved: the initial map, also of metric SLAM.

        :raises HmtSlamError: for a map without places.
        """
        replica = Replica.from_state(saved)
        self._configuration = configuration
        self._building = KnownBuilding.from_map(replica.maps[replica.best_hypothesis], replica.scans, configuration)
        self._pose_driver = Explorer(configuration, Replica.from_state(saved))
        self.exploration_map = self._pose_driver.exploration_map
        self._metric_poses = MetricPoseTracker(self.exploration_map)
        self._limits = motion_limits(configuration.explorer)
        self._task_timeout = round(NANOSECONDS * configuration.pilot.task_timeout)
        self._edge_monitor = EdgeMonitor(self._building.graph, configuration.features)
        self._uniform_belief = uniform_belief(self._building.graph, configuration.places)
        self.rooms = named_destinations(self._building, self.exploration_map.roadmap.room_numbers())
        self._reset()

    def _reset(self) -> None:
        """Reset pose, place and task."""
        self._reset_controller(None)
        self._readings = OdometryBuffer()
        self._waiting: deque[Scan] = deque(maxlen=_MAX_WAITING_SCANS)
        self._stamp, self._odometry = 0, np.zeros(3)
        self.task: Task | None = None
        self._is_driving_to_pose = False
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
        """Process one message; a scan is answered as soon as odometry covers its stamp."""
        if isinstance(message, Task):
            return self._accept_task(message)
        outputs: list[Message] = []
        self._metric_poses.on_message(message)
        if not isinstance(message, Odometry | Scan):
            self._pose_driver.handle(message)
        if isinstance(message, Odometry):
            self._readings.add(message)
        elif isinstance(message, Scan):
            outputs += self._handle_time_jump(message.stamp)
            self._waiting.append(message)
        while self._waiting and self._readings.covers(self._waiting[0].stamp):
            outputs += self._process_scan(self._waiting.popleft())
        return outputs

    def _accept_task(self, task: Task) -> list[Message]:
        """Begin a task, which replaces the one before."""
        if not self._configuration.pilot.drives:
            return [TaskResult(task, False, "pilot.drives is false, so others drive the robot: set it to true")]
        if task.kind == "go" and task.place not in self.rooms:
            choice = ", ".join(self.rooms) or "none, as the robot was in no room behind a door"
            return [TaskResult(task, False, f"there is no such room: choose from {choice}")]
        if task.kind == "stop":
            return self._stop()
        self.task, self._task_start = task, None
        self._is_driving_to_pose = False
        goal = None if task.kind == "navigate" else self.rooms.get(task.place)
        if task.kind == "navigate":
            self._pose_driver.handle(task)
            self._unconfirmed_pose = None
        if self.controller.room is None or goal is not None:
            self.controller.start_mission(goal)
        return [] if goal is None else [GoalPose(self._stamp, goal.opening.area, goal.pose)]

    def _stop(self) -> list[Message]:
        """Stop the robot, if it has a task."""
        if self.task is None:
            return []
        self.controller.stop()
        self._pose_driver.handle(Task("stop"))
        self.task = None
        return [VelocityCommand(self._stamp, 0.0, 0.0)]

    def _handle_time_jump(self, stamp: int) -> list[Message]:
        """Reset the pilot if time went back."""
        if stamp > self._stamp - _TIME_JUMP:
            return []
        task, commands = self.task, self._stop()
        self._reset()
        results = [] if task is None else [TaskResult(task, False, "given up: time went back")]
        return [*results, *commands]

    def _process_scan(self, scan: Scan) -> list[Message]:
        """Update place and pose by a scan, and drive."""
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
        outputs = [self._place_estimate(), *self._reset_pose_at_opening(), *self._confirm_room_pose()]
        if self.task is None:
            return outputs
        result = self._task_result(self.task)
        if result is not None:
            return [*outputs, result, *self._stop()]
        if self.task.kind == "navigate":
            return [*outputs, *self._drive_to_pose(self.task, scan, command)]
        velocity = command[:2] if self._unconfirmed_pose is None else (0.0, 0.0)
        return [*outputs, VelocityCommand(scan.stamp, *velocity)]

    def _drive_to_pose(self, task: Task, scan: Scan, command: MotionCommand) -> list[Message]:
        """Drive along hallways until metric SLAM has the robot in the map, then to the pose."""
        assert task.goal is not None
        if not self._is_driving_to_pose:
            area = self.exploration_map.area_of(task.goal.keyframe)
            if area is not None and self._metric_poses.pose_in_area(area) is None:
                return [VelocityCommand(scan.stamp, *command[:2])]
            self._is_driving_to_pose = True
            self.controller.stop()
        outputs = self._pose_driver.handle(scan)
        if self._pose_driver.task is None:
            self.task = None
        return outputs

    def named_rooms(self) -> dict[str, int]:
        """{name: keyframe at its destination} of the rooms of tasks."""
        return {name: destination.keyframe for name, destination in self.rooms.items()}

    @property
    def progress(self) -> TaskProgress:
        """How far the task is; the path to a room is not known beforehand."""
        return self._pose_driver.progress if self._is_driving_to_pose else TaskProgress()

    def _predict(self, odometry: Float64) -> None:
        """Move the robot to an odometry pose, ``odom_T_base`` (3,)."""
        if self._stamp:
            increment = se2.between(self._odometry, odometry)
            self._step = RelativeMotion(increment, increment_covariance(increment, self._configuration.motion))
            self.controller.predict(self._step)
        self._odometry = odometry

    def _begin_room(self, start: MetricInitialPose | None) -> None:
        """Note the start of a room's metric filter."""
        assert self.task is not None
        self._room_name, self._pose_reset_stamp, self._unconfirmed_pose = self.task.place, None, start

    def _confirm_room_pose(self) -> list[Message]:
        """Let the robot stand before a door until metric SLAM agrees with its pose there, or does not find it.

        If metric SLAM is lost, it gets this pose. If it has the robot elsewhere in the map, the belief over places is
        reset, since scans say more than landmarks.
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
        """The initial pose by the opening that a robot without a task faces, once, if metric SLAM is lost."""
        estimator = self.controller.estimator
        opening = estimator.arrivals, estimator.node_and_direction
        if self._is_on_mission or self.controller.room is not None:
            return []
        if opening == self._last_opening or self._is_turning:
            return []
        start = metric_initial_pose(estimator, self._building.chart)
        if start is None:
            return []
        self._last_opening = opening
        known = self._metric_poses.pose_in_area(start.area) is not None
        return [] if known else [PoseReset(InitialPose(start.area, start.pose))]

    @property
    def _is_on_mission(self) -> bool:
        """Whether the robot is on its way by the belief over places."""
        return self.task is not None and self.task.kind != "navigate"

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
        """Continue at the node before the door, if the robot was driven out of a room without a task."""
        room = self.controller.room
        if room is None or self._is_on_mission:
            return
        node, opening, *_ = self.rooms[self._room_name]
        offset = se2.between(opening.landmark.pose.mean, room.pose)
        if offset[0] > -_EXIT_DISTANCE:
            return
        state = state_of(node, (opening.direction - round(offset[2] / QUARTER_TURN)) % QUARTERS)
        room.release()
        self._reset_controller(certain_belief(self._building.graph, self._configuration.places, state))

    def _is_localized_for(self, task: Task) -> bool:
        """Whether a task to localize is done."""
        estimator = self.controller.estimator
        known = (
            estimator.belief is not None and estimator.belief.is_confident and estimator.node_and_direction is not None
        )
        return task.kind == "localize" and (known or self.controller.room is not None)

    @property
    def _location_text(self) -> str:
        """The most likely place, in words."""
        if self.controller.room is not None:
            return f"in {self._room_name}"
        facing = self.controller.estimator.node_and_direction
        assert facing is not None
        return f"at {self._building.chart.name(facing[0])}, looking {DIRECTION_NAMES[facing[1]]}"

    def _task_result(self, task: Task) -> TaskResult | None:
        """The result of a task; None if it goes on."""
        if self._task_start is None:
            self._task_start = self._stamp
        if self._is_localized_for(task):
            return TaskResult(task, True, f"the robot is {self._location_text}")
        if task.kind == "go" and self.controller.phase is Phase.THERE:
            return TaskResult(task, True, "the robot is there")
        if self.controller.phase is Phase.LOST:
            return TaskResult(task, False, "no way is known that leads there", TaskError.NO_VALID_PATH)
        if self._stamp - self._task_start > self._task_timeout:
            return TaskResult(
                task, False, f"given up after {self._configuration.pilot.task_timeout:g} s", TaskError.TIMEOUT
            )
        return None
