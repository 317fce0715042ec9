"""Simulation with ground truth: buildings, a robot that drives through them, and its measurements."""

from hmt_slam_ros.simulation.simulated_log import SimulatedLog, open_simulated
from hmt_slam_ros.simulation.worlds import FAMILIES

__all__ = ["FAMILIES", "SimulatedLog", "open_simulated"]
