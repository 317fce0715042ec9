"""Places along hallways: landmarks, the graph of places, and the belief over the robot's position in it."""
