"""Faults of real sensors, planted into recorded and simulated logs."""
