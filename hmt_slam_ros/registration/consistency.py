"""The same place, or one that looks alike? What contradicts tells: p(z | gamma) / p(z | alike), a factor of Eq. (6).

Corridors look like corridors: that one fits into another says little, however many beams say so, as those that made
buildings put walls beside walls. Whether it is the same one shows in what cannot be: surfaces where the map knows free
space. In the same place few are, as doors move and people walk; in a place that only looks alike, an opening is missing
here and a pillar stands there. Neighbouring samples are of one door or pillar, so that a stretch of wall counts as one;
and some places have changed more than others, so that the share that contradicts is not the same everywhere: both
together are the beta-binomial distribution.
"""

from __future__ import annotations

import math
from typing import NamedTuple


class Agreement(NamedTuple):
    """Surface samples in a map.

    :ivar samples: how many there are.
    :ivar on_surface: how many are on known surfaces.
    :ivar in_free_space: how many contradict: they are in space that is known to be free, or behind a wall that is
        known.
    """

    samples: int
    on_surface: int
    in_free_space: int

    @property
    def matched_share(self) -> float:
        """Share of all samples that are on known surfaces."""
        return self.on_surface / max(1, self.samples)


class ConsistencyTest(NamedTuple):
    """Which share of the samples contradicts a map: beta distributions over independent stretches of wall.

    Both have the same second parameter, so that the ratio falls with every contradiction.

    :ivar extra_rate: by how much the share is larger in a place that looks alike, where the samples fit best.
    :ivar concentration: after about as many stretches a place is known by what contradicts there.
    :ivar correlated_samples: samples that count as one.
    """

    extra_rate: float
    concentration: float
    correlated_samples: float

    def log_likelihood_ratio(self, found: Agreement, usual: float) -> float:
        """log p(found | same place) / p(found | alike), nats.

        :param usual: share that contradicts in the same place.
        """
        on, free = found.on_surface / self.correlated_samples, found.in_free_space / self.correlated_samples
        same, alike = usual * self.concentration, (usual + self.extra_rate) * self.concentration
        return self._log_probability(same, on, free) - self._log_probability(alike, on, free)

    def _log_probability(self, a: float, on: float, free: float) -> float:
        return _log_beta(a + free, self.concentration + on) - _log_beta(a, self.concentration)


MAP_IN_MAP = ConsistencyTest(extra_rate=0.03, concentration=500.0, correlated_samples=5.0)
"""The surfaces of one map, one sample every 0.2 m, in another."""

SCAN_IN_STORED_MAP = ConsistencyTest(extra_rate=0.03, concentration=500.0, correlated_samples=10.0)
"""The surfaces of one scan, one sample every 0.2 m, in a map of long before; the next scan sees half of them again."""

SCAN_IN_SUBMAP = ConsistencyTest(extra_rate=0.03, concentration=500.0, correlated_samples=20.0)
"""The beams of one scan in the map of what the robot saw around: the scans before and after see the same."""

WALLS_OF_SUBMAP = ConsistencyTest(extra_rate=0.1, concentration=500.0, correlated_samples=5.0)
"""The known walls that the beams of one scan end on or pass, one sample every 0.2 m, seen from there or from anywhere
else."""

WALLS_OF_MAP = ConsistencyTest(extra_rate=0.01, concentration=500.0, correlated_samples=20.0)
"""The same of two maps, the walls of each and the scans of the other, where the surfaces fit: most scans of a map see
the same walls, and where another place fits, hardly a wall is not where it should be."""


class OutlierRate(NamedTuple):
    """What contradicted so far where a hypothesis has the robot: some buildings are full of clutter.

    One that is wrong learns from its own contradictions too, but a few scans weigh little against all before.

    :ivar inliers: stretches on known surfaces.
    :ivar outliers: stretches that contradicted.
    """

    inliers: float = 100.0
    outliers: float = 0.75

    @property
    def rate(self) -> float:
        """Share that contradicts."""
        return self.outliers / (self.inliers + self.outliers)

    def update(self, found: Agreement, correlated_samples: float) -> OutlierRate:
        """With one more scan counted."""
        return OutlierRate(
            self.inliers + found.on_surface / correlated_samples,
            self.outliers + found.in_free_space / correlated_samples,
        )


class Clutter(NamedTuple):
    """What speaks against the place in which a hypothesis has the robot, usually.

    :ivar beam_outlier_rate: share of the beams that contradict its map.
    :ivar wall_outlier_rate: share of the known walls that they pass.
    """

    beam_outlier_rate: float = 0.0
    wall_outlier_rate: float = 0.0


NO_CLUTTER = Clutter()


WALLS_OUTLIER_RATE = 0.001
"""Share of the walls that are passed in another map of the same place, at least."""

MAPS_OUTLIER_RATE = OutlierRate().rate
"""Share of a map's surfaces that contradict another map of the same place: as a run begins, since maps are compared too
seldom to learn it."""


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
