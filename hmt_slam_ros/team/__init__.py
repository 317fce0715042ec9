"""A team of robots: the maps of several as components of one hybrid map, and where one lies in another."""
