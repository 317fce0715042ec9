"""Places: landmarks along hallways, their graph, and the robot's belief over where in it it is."""
