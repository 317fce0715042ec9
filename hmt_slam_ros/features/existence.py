"""Whether a landmark of the map is there: its probability p_lmap by all visits, and when it is deleted.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.3, Eqs. (4) and (5). Every visit at which a landmark should be seen
adds what it says: the extraction confidence p_l where it is observed, else 1 - p_lmap of before. Taken literally, what
is missed draws p_lmap towards 1/2 and never below: a minimum has to lie above that, and a landmark that is less
confident than the minimum is not taken into the map. The mean over n visits also says that what was seen often has to
be missed about as often before it is deleted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

_LIMIT = 0.5  # of p_lmap where it is missed again and again


@dataclass(frozen=True)
class Existence:
    """What is known of whether something is there, be it a landmark or an arc.

    :ivar probability: p_lmap, in [0, 1].
    :ivar visits: n, number of visits at which it should have been seen, 1 or more.
    """

    probability: float
    visits: int = 1

    def observed(self, confidence: float) -> Existence:
        """It was seen, with an extraction confidence p_l."""
        return self._averaged(confidence)

    def missed(self) -> Existence:
        """It should have been seen and was not, Eq. (5)."""
        return self._averaged(1.0 - self.probability)

    def _averaged(self, value: float) -> Existence:
        """Eq. (4), from visit to visit: p_n = p_(n-1) + (p_l(t_n) - p_(n-1)) / n."""
        visits = self.visits + 1
        return Existence(self.probability + (value - self.probability) / visits, visits)


def after_visit(
    known: Mapping[int, Existence], expected: Sequence[int], confidences: Mapping[int, float], least: float
) -> dict[int, Existence]:
    """What is left of the landmarks of a map after a visit.

    :param known: {number of a landmark: its existence}.
    :param expected: those that should have been seen, if they are there.
    :param confidences: {number: p_l} of those that were observed, whether expected or not.
    :param least: p_lmap below which what was missed is deleted, above 0.5 and below 1.
    :raises ValueError: for another ``least``.
    """
    if not _LIMIT < least < 1.0:
        raise ValueError(f"a least existence of {least:g} deletes nothing or all: choose one above 0.5 and below 1")
    after = dict(known)
    after |= {number: known[number].observed(confidence) for number, confidence in confidences.items()}
    for number in expected:
        if number not in confidences:
            after[number] = known[number].missed()
            if after[number].probability < least:
                del after[number]
    return after
