"""Two lasers of a robot compared: does each see the surfaces of the other where their mountings put them?"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.doctor.finding import Finding, grade
from hmt_slam_ros.doctor.statistics import ScanPair, register_pairs
from hmt_slam_ros.geometry import se2

_MIN_MATCHED = 0.3
"""Least share of the points of a scan on a surface of the other one."""

_DETERMINED = np.array([0.05, 0.05, math.radians(1.0)])
"""Deviation of a registration up to which it shows a component of the offset, m, m, rad."""

_MIN_PAIRS = 20
"""Least number of pairs that show a component."""

_MEDIAN_DEVIATION, _MEDIAN_ERROR = 1.4826, 1.2533
"""Deviation by the median absolute one, and error of a median by that of a mean, for normal errors."""

_CORRELATED = 4.0
"""Pairs that count as one, as they share scans and odometry."""

_SIGNIFICANCE = 3.0
"""Standard deviations that are subtracted from an offset before it is judged."""

_PLACE, _ODOMETRY_SHARE, _YAW, _WRONG_FACTOR = 0.05, 0.05, math.radians(1.5), 2.5
"""Least offsets that count, m, as a share of the way between the scans, and rad; factor from which they are wrong."""


class LaserOffset(NamedTuple):
    """Where a laser sees the surfaces of another one, relative to where its stated mounting puts them.

    :ivar offset: ``true_T_stated`` of the mountings in the robot's frame, shape (3,), m and rad; NaN where unknown.
    :ivar deviation: of the offset, shape (3,).
    :ivar distance: mean way between the two scans, m.
    """

    offset: Float64
    deviation: Float64
    distance: float


def laser_findings(pairs: Sequence[ScanPair]) -> Iterator[Finding]:
    """A finding for every two lasers, by pairs of their scans."""
    grouped: defaultdict[tuple[bytes, bytes], list[ScanPair]] = defaultdict(list)
    for pair in pairs:
        one, other = pair.start.laser_pose.tobytes(), pair.end.laser_pose.tobytes()
        grouped[one, other].append(pair)
    for key in sorted(grouped, key=lambda key: list(grouped).index(key)):
        if key[::-1] not in grouped or key <= key[::-1]:
            yield _finding(grouped[key], grouped.get(key[::-1], []))


def laser_name(pose: Float64) -> str:
    """A laser by its stated mounting."""
    x, y, theta = pose.tolist()
    return f"the laser at ({x:.2f} m, {y:.2f} m, {math.degrees(theta):.0f} degrees)"


def measure_offset(pairs: Sequence[ScanPair], reverse: Sequence[ScanPair]) -> LaserOffset:
    """The offset of the second laser of ``pairs``.

    :param reverse: pairs whose first scan is of the second laser.
    """
    offsets, deviations, distances = [], [], []
    for chosen, is_reverse in ((pairs, False), (reverse, True)):
        if not chosen:
            continue
        guesses = np.array([pair.guess for pair in chosen])
        found = register_pairs(chosen)
        own = se2.between(guesses, found.motions)
        # Seen from the other laser, the offset is the inverse, before the motion instead of after it.
        own = se2.inverse(se2.compose(found.motions, se2.inverse(guesses))) if is_reverse else own
        covariances = np.linalg.inv(found.information + np.diag(_DETERMINED**-2) * 1e-2)
        own_deviations = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
        matched = found.matched >= _MIN_MATCHED
        offsets.append(own[matched])
        deviations.append(own_deviations[matched])
        distances.append(np.hypot(guesses[matched, 0], guesses[matched, 1]))
    return _summarize(np.concatenate(offsets), np.concatenate(deviations), np.concatenate(distances))


def _summarize(offsets: Float64, deviations: Float64, distances: Float64) -> LaserOffset:
    offset, deviation = np.full(3, np.nan), np.full(3, np.inf)
    for column in range(3):
        chosen = offsets[deviations[:, column] <= _DETERMINED[column], column]
        if len(chosen) >= _MIN_PAIRS:
            offset[column] = np.median(chosen)
            scatter = _MEDIAN_DEVIATION * float(np.median(np.abs(chosen - offset[column])))
            deviation[column] = _MEDIAN_ERROR * scatter * math.sqrt(_CORRELATED / len(chosen))
    return LaserOffset(offset, deviation, float(distances.mean()) if len(distances) else 0.0)


def _finding(pairs: Sequence[ScanPair], reverse: Sequence[ScanPair]) -> Finding:
    first, second = pairs[0].start.laser_pose, pairs[0].end.laser_pose
    names = f"{laser_name(second)} and {laser_name(first)}"
    found = measure_offset(pairs, reverse)
    if np.isnan(found.offset).any():
        text = f"{names[0].upper()}{names[1:]} see too few surfaces in common to compare their mountings."
        return Finding("fine", "two lasers", text)
    tolerances = np.array([_PLACE + _ODOMETRY_SHARE * found.distance] * 2 + [_YAW])
    excess = np.maximum(0.0, np.abs(found.offset) - _SIGNIFICANCE * found.deviation) / tolerances
    severity = grade(float(excess.max()), 1.0, _WRONG_FACTOR)
    if severity == "fine":
        text = f"{names[0].upper()}{names[1:]} see the same surfaces in the same places."
        return Finding("fine", "two lasers", text)
    x, y, turn = found.offset.tolist()
    fitting = laser_name(se2.compose(found.offset, second)).removeprefix("the laser at ")
    text = (
        f"{names[0].upper()}{names[1:]} see the same surfaces {math.hypot(x, y):.2f} m and "
        f"{abs(math.degrees(turn)):.1f} degrees apart: measure their mountings anew; if the second one is right, the "
        f"first one is at {fitting}."
    )
    return Finding(severity, "two lasers", text)
