"""The robot's motion by scans alone: each is registered with one of a moment before, from no prediction at all.

Odometry must not help here, since it is what shall be judged. Where the robot turned, the ranges of one scan are those
of the other some beams further on; that turn is searched for, and point-to-line registration does the rest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from hmt_slam_ros.arrays import Float32
from hmt_slam_ros.configuration.topology import RefinementParameters
from hmt_slam_ros.doctor.statistics import ScanMotions
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.registration.scan_to_scan import Weighting, extract_surfaces, normal_equations
from hmt_slam_ros.sensors import Scan

# Scans closer in time are passed over: over a shorter time, a robot moves no farther than the match errs, s.
_LEAST_TIME = 0.15
_BATCH = 256  # scans that are held at a time
_MAX_RANGE, _MAX_POINTS = 30.0, 180
# What fewer points fit to is no match.
_FEWEST_POINTS = 40
# Turns that are searched, to each side, and the step between them, rad; beams that are compared at most.
_MOST_TURN, _TURN_STEP, _COMPARED = math.radians(80.0), math.radians(1.0), 180
# Share of the beams that have to be seen in both scans; ranges that differ by more are no nearer to the truth, m.
_MIN_OVERLAP, _MAX_DIFFERENCE = 0.4, 1.0
# Points farther apart than this do not meet, from step to step, m.
_GATES = (1.5, 1.0, 1.0, 0.7, 0.5, 0.4, 0.3, 0.3, 0.2, 0.2)
# What keeps a direction from running away that the scans do not show: deviations of 1 m, 1 m and 30 degrees.
_WEAK_PRIOR = np.diag([1.0, 1.0, math.radians(30.0) ** -2])


class _Pair(NamedTuple):
    start: Scan
    end: Scan
    guess: float


class ScanMotionFinder:
    """Takes one scan after the other."""

    def __init__(self) -> None:
        self._last: Scan | None = None
        self._pairs: list[_Pair] = []
        self._motions: list[ScanMotions] = []

    def add(self, scan: Scan) -> None:
        """Register a scan with the last one that was at least a moment before."""
        last = self._last
        if last is not None and 0 < scan.stamp - last.stamp < _LEAST_TIME * 1e9:
            return
        self._last = scan
        if last is None:
            return
        self._pairs.append(_Pair(last, scan, turn_between(last, scan)))
        if len(self._pairs) == _BATCH:
            self._register()

    def finish(self) -> ScanMotions:
        """All motions."""
        self._register()
        empty = ScanMotions(
            np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)
        )
        parts = [empty, *self._motions]
        return ScanMotions(
            *(np.concatenate([getattr(part, name) for part in parts]) for name in ScanMotions.__dataclass_fields__)
        )

    def _register(self) -> None:
        pairs, self._pairs = self._pairs, []
        if not pairs:
            return
        scans = [pairs[0].start, *(pair.end for pair in pairs)]
        surfaces = extract_surfaces(scans, _MAX_RANGE, _MAX_POINTS)
        starts, ends = np.arange(len(pairs)), np.arange(1, len(pairs) + 1)
        options = RefinementParameters()
        guess = np.zeros((len(pairs), 3))
        guess[:, 2] = [pair.guess for pair in pairs]
        motions = guess
        for gate in _GATES:
            weights = Weighting(options.sigma, max(options.robust_scale, 0.3 * gate), 1.0)
            information, gradient, matched = normal_equations(
                surfaces, ends, surfaces, starts, motions, gate, weights, 1
            )
            slope = gradient + se2.log(se2.between(guess, motions)) @ _WEAK_PRIOR
            step = np.linalg.solve(information + _WEAK_PRIOR, slope[..., None])[..., 0]
            motions = se2.compose(motions, se2.exp(-np.clip(step, -1.0, 1.0)))
        matched[np.diff(surfaces.starts)[1:] < _FEWEST_POINTS] = 0.0
        stamps = np.array([scan.stamp for scan in scans])
        self._motions.append(ScanMotions(stamps[:-1], stamps[1:], motions, information, matched))


def turn_between(start: Scan, end: Scan) -> float:
    """By how much the robot turned from one scan to the other, rad, to about a degree; 0 for scans of two kinds."""
    if start.ranges.size != end.ranges.size or start.angle_increment != end.angle_increment or not end.angle_increment:
        return 0.0
    size, increment = end.ranges.size, end.angle_increment
    around = size * abs(increment) > 2.0 * math.pi - 1.5 * abs(increment)
    shift = max(1, round(_TURN_STEP / abs(increment)))
    steps = int(_MOST_TURN / abs(increment)) // shift
    best = _best_shift(_capped_ranges(start), _capped_ranges(end), shift, steps, max(1, size // _COMPARED), around)
    return best * increment + start.angle_min - end.angle_min


def _capped_ranges(scan: Scan) -> Float32:
    """Ranges (n,), m, capped, the cap also where there is no return."""
    return np.where(scan.valid, np.minimum(scan.ranges, _MAX_RANGE), np.float32(_MAX_RANGE)).astype(np.float32)


@njit(cache=True)
def _best_shift(start: Float32, end: Float32, shift: int, steps: int, every: int, around: bool) -> int:
    """The number of beams by which the ranges (n,) of the start lie further on than those of the end."""
    best, least, size = 0, np.inf, end.size
    for k in range(-steps, steps + 1):
        total, seen = 0.0, 0
        for i in range(0, size, every):
            j = i + k * shift
            if around:
                j %= size
            elif j < 0 or j >= size:
                continue
            total += min(abs(start[j] - end[i]), _MAX_DIFFERENCE)
            seen += 1
        if seen * every >= _MIN_OVERLAP * size and total < least * seen:
            best, least = k * shift, total / seen
    return best
