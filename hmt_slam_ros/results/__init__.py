"""What a run leaves: trajectories, map, report and pictures, whichever runtime it ran in."""
