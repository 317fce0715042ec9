"""Local motion: from what the laser sees now, and a goal, to velocities that touch nothing."""

from hmt_slam_ros.motion.driver import Command, Limits, command_towards

__all__ = ["Command", "Limits", "command_towards"]
