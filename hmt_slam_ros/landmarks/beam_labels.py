"""Beams as free space around the robot, and what each says of the line of a wall."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Bool, Float64, Int8, Int64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.landmarks.line_fit import variance_at
from hmt_slam_ros.sensors import Scan


class Rays(NamedTuple):
    """How far beams go through free space, in the order of their bearing.

    :ivar origins: shape (n, 2), where they begin, m.
    :ivar directions: shape (n, 2), unit vectors.
    :ivar free_range: shape (n,), m.
    :ivar deviations: shape (n,), of these, m.
    :ivar hit: shape (n,), whether there is a surface; else it is not known how the beam goes on.
    """

    origins: Float64
    directions: Float64
    free_range: Float64
    deviations: Float64
    hit: Bool


def rays_from_scan(scan: Scan, features: FeatureParameters) -> Rays:
    """The beams of a scan with a return."""
    beams = scan.beams
    lengths = np.hypot(*beams.T)
    deviations = np.full(len(beams), features.range_deviation)
    directions = beams / np.maximum(lengths, 1e-9)[:, None]
    return Rays(scan.origins, directions, lengths, deviations, np.ones(len(beams), np.bool_))


NO_INFORMATION, ON_LINE, SHALLOW_BEHIND, DEEP_BEHIND, IN_FRONT = range(5)
"""What a beam says of a line."""

STRAY_DEVIATIONS = 3.5
"""A beam ends on a wall within so many deviations of its line."""

# The line has to be known so well there, m.
_MAX_LINE_DEVIATION = 0.06
# A beam flatter to a line than this (sine) says nothing of it.
_GRAZING = 0.05


class BeamLabels(NamedTuple):
    """What beams say of a line, in the order of their bearing.

    :ivar labels: shape (n,), one of the constants above.
    :ivar along: shape (n,), where on the line they meet it, m.
    :ivar behind: shape (n,), how far they go behind it, m.
    :ivar beams: shape (n,), their numbers.
    """

    labels: Int8
    along: Float64
    behind: Float64
    beams: Int64


@njit(cache=True)
def empty_beam_labels(beams: int) -> BeamLabels:
    """Room for what so many beams say."""
    return BeamLabels(np.empty(beams, np.int8), np.empty(beams), np.empty(beams), np.empty(beams, np.int64))


@njit(cache=True)
def label_beams(line: Float64, covariance: Float64, rays: Rays, depth: float, told: BeamLabels) -> int:
    """Write what beams say of a line, and return how many say something."""
    cos, sin = math.cos(line[0]), math.sin(line[0])
    beams, count, start, least = len(rays.free_range), 0, 0, 0.0
    for k in range(beams):
        facing = cos * rays.directions[k, 0] + sin * rays.directions[k, 1]
        if facing < least:
            start, least = k, facing
    for n in range(beams):
        k = (start + n) % beams
        facing = cos * rays.directions[k, 0] + sin * rays.directions[k, 1]
        if facing < _GRAZING:
            continue
        x, y = rays.origins[k, 0], rays.origins[k, 1]
        way = (line[1] - cos * x - sin * y) / facing
        along = cos * (y + way * rays.directions[k, 1]) - sin * (x + way * rays.directions[k, 0])
        behind = (rays.free_range[k] - way) * facing
        variance = variance_at(covariance[0, 0], covariance[0, 1], covariance[1, 1], along)
        near = STRAY_DEVIATIONS * math.sqrt(variance + (rays.deviations[k] * facing) ** 2)
        kind = _label_beam(behind, near, rays.hit[k], depth)
        if variance <= _MAX_LINE_DEVIATION * _MAX_LINE_DEVIATION and kind != NO_INFORMATION:
            told.labels[count], told.along[count], told.behind[count], told.beams[count] = kind, along, behind, k
            count += 1
    return count


@njit(cache=True)
def _label_beam(behind: float, near: float, met: bool, depth: float) -> int:
    """What a beam says of a line that it goes ``behind`` it, m, where within ``near`` is on it."""
    if behind >= depth:
        return DEEP_BEHIND
    if not met:
        return NO_INFORMATION
    if behind > near:
        return SHALLOW_BEHIND
    return ON_LINE if behind >= -near else IN_FRONT


@njit(cache=True)
def last_beam_behind(told: BeamLabels, first: int, end: int) -> int:
    """The last of the beams from the first on that all go behind the line; before the first where that does not."""
    last = first - 1
    while last + 1 < end and (told.labels[last + 1] == SHALLOW_BEHIND or told.labels[last + 1] == DEEP_BEHIND):
        last += 1
    return last


@njit(cache=True)
def deviation_across(line: Float64, rays: Rays, beam: int) -> float:
    """Deviation of the end of a beam across a line, m."""
    facing = math.cos(line[0]) * rays.directions[beam, 0] + math.sin(line[0]) * rays.directions[beam, 1]
    return rays.deviations[beam] * facing
