"""Lock-step runs of a simulated robot that the explorer or the pilot drives."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.exploration.pilot import PilotProcess
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.messages.tasks import Task, TaskResult, VelocityCommand
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.results.output_folder import map_writer
from hmt_slam_ros.results.recorder import Recording
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation.driven_robot import DrivenLog, DrivenRobot


class RobotProcess:
    """The robot as a process: it applies velocity commands, and keeps the last task result."""

    def __init__(self, robot: DrivenRobot) -> None:
        self._robot = robot
        self.outcome: TaskResult | None = None

    def handle(self, message: Message) -> list[Message]:
        """Handle one message."""
        if isinstance(message, VelocityCommand):
            self._robot.set_velocity(message.speed, message.turn_rate)
        elif isinstance(message, TaskResult):
            self.outcome = message
        return []


Driver = TypeVar("Driver", Explorer, PilotProcess)


class DrivenRun(Generic[Driver]):
    """A lock-step run of robot, SLAM and its driver.

    :ivar robot: in its world.
    :ivar driver: the explorer, or the pilot.
    """

    def __init__(
        self,
        robot: DrivenRobot,
        configuration: Configuration,
        driver: Driver,
        state: RunState | None = None,
        records: Iterator[LogRecord] | None = None,
    ) -> None:
        """:param state: to start from; None for none.

        :param records: of the robot, which continue those of the state; None where the state is a saved map, in which
            the robot has no initial pose.
        """
        self.robot = robot
        self.driver: Driver = driver
        self._robot_process = RobotProcess(robot)
        name = "explorer" if isinstance(driver, Explorer) else "pilot"
        self._run = LockStepRun(configuration, state=state, observers={name: driver, "robot": self._robot_process})
        log = DrivenLog("driven", robot)
        new_records = log.records() if state is None or records is not None else self._run.unread_records(log)
        self._records = new_records if records is None else records

    @property
    def processes(self) -> Mapping[str, Process]:
        """{name: process}."""
        return self._run.lock_step.processes

    @property
    def outcome(self) -> TaskResult | None:
        """The result of the last task, None before its end."""
        return self._robot_process.outcome

    def run_task(self, task: Task, seconds: float) -> TaskResult | None:
        """Run a task; return its result, None if it takes too long.

        :param seconds: largest duration of the task.
        """
        for _ in self.drive(task, seconds):
            if self.outcome is not None:
                break
        return self.outcome

    def drive(self, task: Task, seconds: float) -> Iterator[None]:
        """Run a task, and go on after its end; stops after each scan.

        :param seconds: largest duration.
        """
        self._robot_process.outcome = None
        self._run.lock_step.feed(task)
        end = self.robot.stamp + round(seconds * NANOSECONDS)
        for record in self._records:
            self._run.process_record(record)
            if isinstance(record.measurement, Scan):
                self._run.recorder.compact()
                yield
                if self.robot.stamp >= end:
                    return

    def save(self, folder: Path, configuration: Configuration) -> Recording:
        """End the drive, and write its map for nodes to start from.

        :param folder: which is created.
        """
        folder.mkdir(parents=True)
        writer = map_writer(folder)
        writer.write_state(self._run.state)
        result = self._run.finish()
        recording = result.recorder.finish(
            result.log_progress.stamps, result.log_progress.first_scans, result.log_progress.earlier_trajectory
        )
        writer.write_map(
            recording.replica, recording.area_poses, recording.last_estimate, recording.relative_trajectory
        )
        writer.finish(configuration)
        return recording


def true_place(run: DrivenRun[Explorer], name: str) -> NDArray[np.float64]:
    """True pose of the robot at the keyframe of a named place, ``world_T_base`` (3,)."""
    exploration_map = run.driver.exploration_map
    stamp = exploration_map.replica.scans[exploration_map.named_places()[name]].stamp
    true: NDArray[np.float64] = run.robot.true_poses(np.array([stamp]))[0]
    return true
