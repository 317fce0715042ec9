"""Exploration of buildings and missions to known places, without ROS."""
