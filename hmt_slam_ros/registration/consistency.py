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
    :ivar on: how many are on known surfaces.
    :ivar free: how many contradict: they are in space that is known to be free, or behind a wall that is known.
    """

    samples: int
    on: int
    free: int

    @property
    def share(self) -> float:
        """Share of all samples that are on known surfaces."""
        return self.on / max(1, self.samples)


class Contradiction(NamedTuple):
    """Which share of the samples contradicts a map: beta distributions over independent stretches of wall.

    Both have the same second parameter, so that the ratio falls with every contradiction.

    :ivar extra: by how much the share is larger in a place that looks alike, where the samples fit best.
    :ivar strength: after about as many stretches a place is known by what contradicts there.
    :ivar stretch: samples that count as one.
    """

    extra: float
    strength: float
    stretch: float

    def log_ratio(self, found: Agreement, usual: float) -> float:
        """log p(found | same place) / p(found | alike), nats.

        :param usual: share that contradicts in the same place.
        """
        on, free = found.on / self.stretch, found.free / self.stretch
        same, alike = usual * self.strength, (usual + self.extra) * self.strength
        return self._log_probability(same, on, free) - self._log_probability(alike, on, free)

    def _log_probability(self, a: float, on: float, free: float) -> float:
        return _log_beta(a + free, self.strength + on) - _log_beta(a, self.strength)


MAPS = Contradiction(extra=0.03, strength=500.0, stretch=5.0)
"""The surfaces of one map, one sample every 0.2 m, in another."""

KNOWN = Contradiction(extra=0.03, strength=500.0, stretch=10.0)
"""The surfaces of one scan, one sample every 0.2 m, in a map of long before; the next scan sees half of them again."""

SCAN = Contradiction(extra=0.03, strength=500.0, stretch=20.0)
"""The beams of one scan in the map of what the robot saw around: the scans before and after see the same."""

SIGHT = Contradiction(extra=0.1, strength=500.0, stretch=5.0)
"""The known walls that the beams of one scan end on or pass, one sample every 0.2 m, seen from there or from anywhere
else."""

WALLS = Contradiction(extra=0.01, strength=500.0, stretch=20.0)
"""The same of two maps, the walls of each and the scans of the other, where the surfaces fit: most scans of a map see
the same walls, and where another place fits, hardly a wall is not where it should be."""


class Usual(NamedTuple):
    """What contradicted so far where a hypothesis has the robot: some buildings are full of clutter.

    One that is wrong learns from its own contradictions too, but a few scans weigh little against all before.

    :ivar on: stretches on known surfaces.
    :ivar free: stretches that contradicted.
    """

    on: float = 100.0
    free: float = 0.75

    @property
    def share(self) -> float:
        """Share that contradicts."""
        return self.free / (self.on + self.free)

    def after(self, found: Agreement, stretch: float) -> Usual:
        """With one more scan counted."""
        return Usual(self.on + found.on / stretch, self.free + found.free / stretch)


class Clutter(NamedTuple):
    """What speaks against the place in which a hypothesis has the robot, usually.

    :ivar ends: share of the beams that contradict its map.
    :ivar walls: share of the known walls that they pass.
    """

    ends: float = 0.0
    walls: float = 0.0


NO_CLUTTER = Clutter()


WALLS_USUAL = 0.001
"""Share of the walls that are passed in another map of the same place, at least."""

MAPS_USUAL = Usual().share
"""Share of a map's surfaces that contradict another map of the same place: as a run begins, since maps are compared too
seldom to learn it."""


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
