"""Parameters of real-time localization, of the simulated robot, and of the explorer and the pilot."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class RealTimeParameters:
    """RTL: the pose at the rate of the odometry."""

    publish_tf: bool = parameter(True, "Publish map -> odom on /tf.")
    correction_time: float = parameter(
        0.0,
        "Time in which a correction of map -> odom falls to a third, for those who steer by it; 0 corrects at once.",
        unit="s",
        low=0.0,
        high=60.0,
    )
    realtime_priority: bool = parameter(
        True, "Let the node come before all that computes for long (SCHED_RR), where the system permits it."
    )
    max_speed: float = parameter(
        10.0, "Odometry that moves faster than this between two readings was reset.", unit="m/s", low=0.1, high=1000.0
    )
    max_turn_rate: float = parameter(
        720.0, "Odometry that turns faster than this between two readings was reset.", unit="deg/s", low=1.0, high=1e5
    )


@dataclass(frozen=True)
class RobotParameters:
    """The simulated robot that replays a log, or drives."""

    drive: str = parameter(
        "log",
        "What the robot node does: it replays its log, a simulated drive as it is scripted, or is driven through a "
        "simulated world by the velocities on cmd_vel.",
        choices=("log", "commands"),
    )
    rate: float = parameter(
        1.0, "Speed of the replay relative to real time; 0 is as fast as possible.", low=0.0, high=1000.0
    )
    start: float = parameter(0.0, "Seconds of the log to skip.", unit="s", low=0.0, high=1e6)
    duration: float = parameter(0.0, "Seconds of the log to play; 0 plays all of it.", unit="s", low=0.0, high=1e6)
    loop: bool = parameter(False, "Start again at the end of the log; the stamps go on increasing.")
    flow_control: bool = parameter(True, "Wait for the acknowledgement of earlier scans, so that none is lost.")
    max_unacknowledged_scans: int = parameter(
        20, "Scans under way without an acknowledgement, when paced.", low=1, high=10000
    )
    scan_listeners: int = parameter(
        1,
        "Start when this many subscribers of the scans are there, when paced also slam; 0 waits for none.",
        low=0,
        high=100,
    )
    odometry_listeners: int = parameter(
        1, "Start when this many subscribers of the odometry are there; 0 waits for none.", low=0, high=100
    )
    discovery_timeout: float = parameter(10.0, "Wait this long for the subscribers.", unit="s", low=0.0, high=3600.0)


@dataclass(frozen=True)
class ExplorerParameters:
    """The explorer: the robot, which the pilot drives as well, and when it gives something up."""

    drive: str = parameter(
        "velocities",
        "How the robot is driven: by velocities on cmd_vel, or by goals on goal_pose to which another program drives, "
        "such as nav2.",
        choices=("velocities", "goals"),
    )
    explores: bool = parameter(True, "Explore from the start on; otherwise wait for a task.")
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
    stuck_timeout: float = parameter(
        15.0, "A goal is given up to which the robot has not come nearer for so long.", unit="s", low=1.0, high=600.0
    )


@dataclass(frozen=True)
class PilotParameters:
    """The pilot, who goes by the belief over places: whether it drives the robot, and when it gives up."""

    drives: bool = parameter(True, "Take tasks and drive; otherwise only say where the robot is that others drive.")
    task_timeout: float = parameter(300.0, "A task is given up that takes longer.", unit="s", low=1.0, high=1e5)
