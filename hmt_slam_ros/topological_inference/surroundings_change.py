"""Changed surroundings: what explains scans that contradict the submap of a robot that is not displaced.

In another place both kinds of contradictions occur together: beams end in known free space, and they pass known walls.
In the right place one kind occurs alone. People, closed doors and new objects are in free space. Removed objects are
passed, and so are walls that were none: the floor, seen by a robot that enters a ramp.

A hidden Markov model has these three states of the surroundings (Rabiner 1989, forward algorithm). It gives the
likelihood of every scan; contradictions of one kind alone count up to its onset.
"""

from __future__ import annotations

import math
from typing import NamedTuple

_ONSET_PROBABILITY = 0.002
"""Probability per keyframe event that one kind of contradictions begins.

From docs/decisions/0052-changed-surroundings.md.
"""

_END_PROBABILITY = 0.5
"""Probability per keyframe event that it ends (docs/decisions/0052-changed-surroundings.md)."""


class Surroundings(NamedTuple):
    """Belief over the surroundings of a robot that is not displaced.

    :ivar known: probability that they are as the submap knows them.
    :ivar added: probability that objects are where there was free space.
    :ivar removed: probability that known walls are not there.
    :ivar log_likelihood: log p(scan | not displaced) / p(scan | displaced) of the newest scan, nats.
    """

    known: float = 1.0
    added: float = 0.0
    removed: float = 0.0
    log_likelihood: float = 0.0

    def update(self, log_ends: float, log_walls: float) -> Surroundings:
        """The belief after one more scan.

        :param log_ends: log-likelihood ratio of the ends of its beams, "not displaced" to "displaced", nats.
        :param log_walls: that of the walls that they hit or pass.
        """
        changed = self.added + self.removed
        log_masses = (
            _log(self.known * (1.0 - 2.0 * _ONSET_PROBABILITY) + changed * _END_PROBABILITY) + log_ends + log_walls,
            _log(self.added * (1.0 - _END_PROBABILITY) + self.known * _ONSET_PROBABILITY) + log_walls,
            _log(self.removed * (1.0 - _END_PROBABILITY) + self.known * _ONSET_PROBABILITY) + log_ends,
        )
        largest = max(log_masses)
        known, added, removed = (math.exp(log_mass - largest) for log_mass in log_masses)
        total = known + added + removed
        return Surroundings(known / total, added / total, removed / total, largest + math.log(total))


def _log(probability: float) -> float:
    return math.log(max(probability, 1e-300))
