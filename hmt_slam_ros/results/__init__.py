"""The results of a run in either runtime: trajectories, map, report and pictures."""
