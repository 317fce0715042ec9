"""Sources of scans and odometry: rosbag2, CARMEN, MRPT rawlog."""
