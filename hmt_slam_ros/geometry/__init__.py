"""Rigid motions of the plane, SE(2), with and without Gaussian uncertainty."""
