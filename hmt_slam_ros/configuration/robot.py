"""Parameters of real-time localization, of the simulated robot, and of the explorer and the pilot."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class RealTimeParameters:
    """RTL: the pose at the rate of the odometry."""

    publish_tf: bool = parameter(True, "Publish map -> odom on /tf.")
    correction_time: float = parameter(
        0.0, "Time in which a correction of map -> odom decays to 1/e; 0 corrects at once.", 0.0, 60.0, "s"
    )
    realtime_priority: bool = parameter(
        True, "Run the node with real-time priority (SCHED_RR), where the system permits it."
    )
    max_speed: float = parameter(
        10.0, "Odometry that moves faster than this between two readings was reset.", 0.1, 1000.0, "m/s"
    )
    max_turn_rate: float = parameter(
        720.0, "Odometry that turns faster than this between two readings was reset.", 1.0, 1e5, "deg/s"
    )


@dataclass(frozen=True)
class RobotParameters:
    """The robot node, which replays a log or simulates a driven robot."""

    drive: str = parameter(
        "log",
        "Whether the robot node replays its log, or is driven through its simulated world by cmd_vel.",
        choices=("log", "commands"),
    )
    rate: float = parameter(1.0, "Speed of the replay relative to real time; 0 is as fast as possible.", 0.0, 1000.0)
    start: float = parameter(0.0, "Seconds of the log to skip.", 0.0, 1e6, "s")
    duration: float = parameter(0.0, "Seconds of the log to play; 0 plays all of it.", 0.0, 1e6, "s")
    loop: bool = parameter(False, "Start again at the end of the log; the stamps go on increasing.")
    flow_control: bool = parameter(True, "Wait for the acknowledgement of earlier scans, so that none is lost.")
    max_unacknowledged_scans: int = parameter(20, "Scans under way without an acknowledgement, when paced.", 1, 10000)
    scan_listeners: int = parameter(
        1, "Start when this many subscribers of the scans are there, when paced also slam; 0 waits for none.", 0, 100
    )
    odometry_listeners: int = parameter(
        1, "Start when this many subscribers of the odometry are there; 0 waits for none.", 0, 100
    )
    discovery_timeout: float = parameter(10.0, "Wait this long for the subscribers.", 0.0, 3600.0, "s")


@dataclass(frozen=True)
class ExplorerParameters:
    """The explorer, and the robot that explorer and pilot drive."""

    drive: str = parameter(
        "velocities",
        "Output of the explorer: velocities on cmd_vel, or goals on goal_pose for a program such as nav2.",
        choices=("velocities", "goals"),
    )
    explores: bool = parameter(True, "Explore from the start on; otherwise wait for a task.")
    backtracks: bool = parameter(
        False, "Drive back along the own path while the entropy of the topological paths is above `places.max_entropy`."
    )
    disambiguates: bool = parameter(
        False, "Interrupt an exploration to drive to where a look decides between topological hypotheses."
    )
    speed: float = parameter(0.6, "Speed at most.", 0.05, 5.0, "m/s")
    turn_rate: float = parameter(45.0, "Turn rate at most.", 1.0, 360.0, "deg/s")
    acceleration: float = parameter(0.5, "Acceleration at most, to brake as well.", 0.05, 10.0, "m/s^2")
    turn_acceleration: float = parameter(90.0, "Acceleration of a turn at most.", 1.0, 1000.0, "deg/s^2")
    radius: float = parameter(0.25, "Radius of the robot.", 0.01, 2.0, "m")
    margin: float = parameter(0.05, "Distance that it keeps from obstacles.", 0.0, 1.0, "m")
    door: float = parameter(1.75, "An opening up to this wide is a door, a wider one a hallway.", 0.5, 5.0, "m")
    stuck_timeout: float = parameter(
        15.0, "A goal is given up if the robot has not come nearer for this long.", 1.0, 600.0, "s"
    )


@dataclass(frozen=True)
class PilotParameters:
    """The pilot, which localizes and drives by the belief over places."""

    drives: bool = parameter(
        True, "Take tasks and drive; otherwise only publish the place of a robot that others drive."
    )
    task_timeout: float = parameter(300.0, "A task is given up that takes longer.", 1.0, 1e5, "s")
