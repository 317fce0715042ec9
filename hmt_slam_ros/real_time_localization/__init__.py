"""Real-time localization, process 5 of the paper: the pose at the rate of the odometry."""
