"""The evidence of windows for a placement.

Where the placement is false, a window lies in a similar place (S), where its scans are as probable as if it were true,
or in a different one (D), where they have the Bayes factor l of the window. Along the path of the second component that
is a hidden Markov model. It begins in S at the best window, since that one fits, and goes on there with a probability
rho from window to window. The factor of all other windows is the forward algorithm's (Rabiner 1989), both ways:

    S = sum over windows of -log(p + (1 - p) exp(-l)),    p = P(S | windows before)

rho is learned from the other placements, as all but one are false (docs/decisions/0071-similar-windows.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

_SIMILAR_MEAN, _SIMILAR_WEIGHT = math.exp(-8.0 / 5.0), 2.0
"""Prior mean of rho, and its weight: windows have 8 m, and similar surroundings end after 5 m.

From docs/decisions/0068-after-a-gap.md.
"""

AGREES = 0.5
"""Log Bayes factor above which a window of a false placement fits by chance, nats."""


class WindowEvidence(NamedTuple):
    """A window under a placement.

    :ivar log_ratio: log Bayes factor relative to unmapped ground, nats.
    :ivar is_in_place: whether the placement has it in known ground.
    """

    log_ratio: float
    is_in_place: bool


class PlacementEvidence(NamedTuple):
    """Log Bayes factors, nats.

    :ivar best: of the best window.
    :ivar agreement: of the other windows.
    """

    best: float
    agreement: float


def similar_probability(others: Sequence[Mapping[int, WindowEvidence]]) -> float:
    """rho: the probability that the next window of a false placement fits, too.

    :param others: {window: its evidence} of false placements.
    """
    fitting = tested = 0
    for windows in others:
        if not windows:
            continue
        best = _best(windows)
        if windows[best].log_ratio <= AGREES:
            continue
        rest = [own for window, own in windows.items() if window != best and own.is_in_place]
        tested += len(rest)
        fitting += sum(own.log_ratio > AGREES for own in rest)
    return (_SIMILAR_MEAN * _SIMILAR_WEIGHT + fitting) / (_SIMILAR_WEIGHT + tested)


def placement_evidence(windows: Mapping[int, WindowEvidence], similar: float) -> PlacementEvidence:
    """The evidence of the windows of a placement.

    :param windows: {window, numbered along the path: its evidence}, at least one.
    :param similar: rho.
    """
    best = _best(windows)
    order = sorted(windows)
    agreement = 0.0
    for side in (order[order.index(best) + 1 :], order[: order.index(best)][::-1]):
        probability, last = 1.0, best
        for window in side:
            probability *= similar ** abs(window - last)
            # p(window | false) / p(window | true).
            ratio = probability + (1.0 - probability) * math.exp(-windows[window].log_ratio)
            agreement -= math.log(ratio)
            probability, last = probability / ratio, window
    return PlacementEvidence(windows[best].log_ratio, agreement)


def _best(windows: Mapping[int, WindowEvidence]) -> int:
    return min(windows, key=lambda window: (-windows[window].log_ratio, window))
