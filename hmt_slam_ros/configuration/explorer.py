"""Parameters of those who drive the robot: the explorer and the pilot."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class Exploration:
    """The explorer: the robot, which the pilot drives as well, and when it gives something up."""

    drive: str = parameter(
        "velocities",
        "How the robot is driven: by velocities on cmd_vel, or by goals on goal_pose to which another program drives, "
        "such as nav2.",
        choices=("velocities", "goals"),
    )
    explores: bool = parameter(True, "Explore from the start on; otherwise wait for an errand.")
    backtracks: bool = parameter(
        False,
        "Go back along the robot's own path where the probability of topological paths has several peaks, until "
        "its entropy is below `places.max_entropy`, before it explores on.",
    )
    speed: float = parameter(0.6, "Speed at most.", unit="m/s", low=0.05, high=5.0)
    turn_rate: float = parameter(45.0, "Turn rate at most.", unit="deg/s", low=1.0, high=360.0)
    acceleration: float = parameter(0.5, "Acceleration at most, to brake as well.", unit="m/s^2", low=0.05, high=10.0)
    turn_acceleration: float = parameter(90.0, "Acceleration of a turn at most.", unit="deg/s^2", low=1.0, high=1000.0)
    radius: float = parameter(0.25, "Radius of the robot.", unit="m", low=0.01, high=2.0)
    margin: float = parameter(0.05, "Distance that it keeps from what it sees.", unit="m", low=0.0, high=1.0)
    door: float = parameter(
        1.75, "An opening up to so wide is a door, a wider one a hallway.", unit="m", low=0.5, high=5.0
    )
    patience: float = parameter(
        15.0, "A goal is given up to which the robot has not come nearer for so long.", unit="s", low=1.0, high=600.0
    )


@dataclass(frozen=True)
class Piloting:
    """The pilot, who goes by the belief over places: whether it drives the robot, and when it gives up."""

    drives: bool = parameter(True, "Take errands and drive; otherwise only say where the robot is that others drive.")
    patience: float = parameter(300.0, "An errand is given up that takes longer.", unit="s", low=1.0, high=1e5)
