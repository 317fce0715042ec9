"""The metric map of one area: occupancy grid, distance field, scan matching, particle filter."""
