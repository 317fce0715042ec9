"""A small building that a robot explores with the package's own SLAM in the loop."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np

from benchmark.driven_run import DrivenRun
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.flat import with_changes
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.exploration.laser_views import LaserViews, ObstacleView
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.tasks import Task, TaskResult
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation.building import Building, FloorPlan
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.laser import Laser, wall_index
from hmt_slam_ros.simulation.scenario import START, Scenario
from hmt_slam_ros.simulation.settings import Settings

ROOMS = np.array([[3.0, -3.2], [9.0, -3.2]])
"""Middles of the rooms, m."""

ORIGIN = np.array([1.0, 0.0, 0.0])
"""Where the robot begins, m and rad."""

LASER = Settings(field_of_view=360.0, beams=720)


def small_floor() -> Building:
    """A hallway along x with an arm to the north, and two rooms to the south; the robot begins at its western end."""
    plan = FloorPlan()
    plan.cut_rectangle(0.0, -1.0, 12.0, 1.0)
    plan.cut_rectangle(5.0, 1.0, 7.0, 9.0)
    for x, y in ROOMS:
        plan.cut_rectangle(x - 1.5, y - 2.0, x + 1.5, y + 2.0)
        plan.cut_rectangle(x - 0.5, y + 1.9, x + 0.5, -0.9)
    return Building(plan.walls(), np.array([[1.0, 0.0], [11.0, 0.0]]))


def scan_at(pose: tuple[float, float, float]) -> Scan:
    """What a laser all around sees of that floor."""
    laser = Laser(LASER)
    return laser.scan(0, 0, laser.distances(np.array([pose]), wall_index(small_floor().walls), np.empty((0, 3))))


def view_of(scan: Scan) -> ObstacleView:
    """What a robot with one laser sees."""
    return LaserViews().add(scan)


def with_keyframes(poses: dict[int, tuple[float, float, float]]) -> HybridMap:
    """A map of one area that has these keyframes."""
    hybrid_map = HybridMap()
    for keyframe, pose in poses.items():
        hybrid_map.set_keyframe(keyframe, 0, np.array(pose))
    return hybrid_map


class Explored:
    """The floor after a robot explored it."""

    def __init__(self, *, explore: bool = True, changes: Mapping[str, bool] | None = None, robot: str = "") -> None:
        scenario = Scenario(small_floor(), Settings(seed=5, laps=1, field_of_view=360.0, beams=720))
        self.robot = DrivenRobot(scenario)
        configuration = with_changes(Configuration(), changes or {})
        self.run = DrivenRun(self.robot, configuration, Explorer(configuration, robot=robot))
        self.outcome = self.run.run_task(Task("explore"), 400.0) if explore else None
        self.length = len(path_of(self))


@cache
def explore(number: int = 0) -> Explored:
    """One and the same exploration for all tests that request this number."""
    del number
    return Explored()


def path_of(own: Explored) -> Float64:
    """True poses of the robot up to now, (n, 3), five a second."""
    return own.robot.true_poses(np.arange(START, own.robot.stamp, NANOSECONDS // 5))


def completed_task(outcome: TaskResult | None) -> TaskResult:
    """An outcome that is there."""
    assert outcome is not None
    return outcome
