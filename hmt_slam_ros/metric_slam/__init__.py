"""Metric SLAM, process 1 of the paper: localization and mapping within the current area."""
