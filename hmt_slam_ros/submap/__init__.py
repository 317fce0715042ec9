"""The submap of an area: filters that estimate the robot's pose and map it, behind one protocol."""
