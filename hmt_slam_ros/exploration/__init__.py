"""What a robot does next to get to know a building, and how it gets to places that it knows; without ROS."""
