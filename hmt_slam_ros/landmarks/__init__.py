"""Features of scans: the lines of walls, with covariances, and the stochastic map of a room that they make."""
