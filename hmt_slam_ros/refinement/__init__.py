"""Refinement of poses by registering the scans themselves with each other, free of the cells of any grid."""
