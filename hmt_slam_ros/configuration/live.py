"""Parameters of real-time localization and of the simulated robot."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.configuration.parameter import parameter


@dataclass(frozen=True)
class RealTimeLocalization:
    """RTL: the pose at the rate of the odometry."""

    publish_tf: bool = parameter(True, "Publish map -> odom on /tf.")
    correction_time: float = parameter(
        0.0,
        "Time in which a correction of map -> odom falls to a third, for those who steer by it; 0 corrects at once.",
        unit="s",
        low=0.0,
        high=60.0,
    )
    precedence: bool = parameter(
        True, "Let the node come before all that computes for long (SCHED_RR), where the system permits it."
    )
    max_speed: float = parameter(
        10.0, "Odometry that moves faster than this between two readings was reset.", unit="m/s", low=0.1, high=1000.0
    )
    max_turn_rate: float = parameter(
        720.0, "Odometry that turns faster than this between two readings was reset.", unit="deg/s", low=1.0, high=1e5
    )


@dataclass(frozen=True)
class Robot:
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
    paced: bool = parameter(True, "Wait for the acknowledgement of earlier scans, so that none is lost.")
    window: int = parameter(20, "Scans under way without an acknowledgement, when paced.", low=1, high=10000)
    scan_listeners: int = parameter(
        1,
        "Start when this many subscribers of the scans are there, when paced also slam; 0 waits for none.",
        low=0,
        high=100,
    )
    odometry_listeners: int = parameter(
        1, "Start when this many subscribers of the odometry are there; 0 waits for none.", low=0, high=100
    )
    patience: float = parameter(10.0, "Wait this long for the subscribers.", unit="s", low=0.0, high=3600.0)
