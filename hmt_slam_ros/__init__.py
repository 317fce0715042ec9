"""Hybrid metric-topological SLAM (Blanco, Fernandez-Madrigal, Gonzalez 2008) for ROS 2."""

__version__ = "0.1.0"
