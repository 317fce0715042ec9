"""Measurements of the whole system on logs: accuracy, robustness, speed."""
