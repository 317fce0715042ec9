"""The live page: what the nodes say, folded into a snapshot, and served to browsers. Knows no ROS."""
