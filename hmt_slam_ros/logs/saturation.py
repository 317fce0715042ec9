"""What a range finder reports for a beam without a return, found from the readings alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_FEWEST_REPEATS = 3
_BAND = 0.01  # a sensor's codes for "no return" lie within one percent: 51.09 ... 51.16 m, 81.83 ... 81.91 m
_BANDS_BELOW = 5
_CROWDING = 10.0


def smallest_saturated(ranges: NDArray[np.float32]) -> float:
    """The smallest range that means "no return" in a log that does not say so, metres.

    A sensor reports its maximum, or a few values close to it, for every beam that meets nothing. Real distances
    spread out as the robot moves, so the maximum stands out as a crowd at the far end. The rule: M is the largest
    reading that occurs three times (a stray larger one is no maximum). The readings at or beyond 0.99 M mean "no
    return" if there are more than ten times as many of them as there are, on average, in each of the five bands of
    the same width below - and if they are not the whole log. Real returns in the last percent of the reach of such
    a sensor are lost with them.

    :param ranges: shape (n,), metres, all readings of the log.
    :returns: the smallest reading of that crowd; where there is none, just beyond the largest reading (inf for no
        finite reading at all).
    """
    values, counts = np.unique(ranges[np.isfinite(ranges) & (ranges > 0.0)], return_counts=True)
    if not values.size:
        return float("inf")
    repeated = np.flatnonzero(counts >= _FEWEST_REPEATS)
    if repeated.size:
        maximum = float(values[repeated[-1]])
        edges = maximum * (1.0 - _BAND * np.array([1 + _BANDS_BELOW, 1]))
        lowest, crowd_from = np.searchsorted(values, edges.astype(np.float32))
        crowd = counts[crowd_from:].sum()
        background = counts[lowest:crowd_from].sum() / _BANDS_BELOW
        if crowd_from > 0 and crowd > _CROWDING * background:
            return float(values[crowd_from])
    return float(np.nextafter(values[-1], np.float32(np.inf)))
