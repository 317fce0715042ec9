"""Counter-based random streams: what is drawn depends on who draws and when, never on the order of execution."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Purpose(IntEnum):
    """Who draws."""

    PARTICLES = 1
    RESAMPLING = 2
    HYPOTHESES = 3


def stream(seed: int, purpose: Purpose, hypothesis: int, step: int) -> np.random.Generator:
    """The generator of one decision.

    :param seed: seed of the run.
    :param purpose: what the numbers are for.
    :param hypothesis: id of the hypothesis that draws, 0 where it concerns all.
    :param step: keyframe event, from 0.
    """
    return np.random.Generator(np.random.Philox(key=[seed, int(purpose)], counter=[0, 0, hypothesis, step]))
