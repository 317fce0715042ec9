"""Grids: occupancy and distance to the nearest surface, in patches that many maps share."""
