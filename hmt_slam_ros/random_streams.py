"""Counter-based random streams: what is drawn depends on what for and when, never on the order of execution."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Purpose(IntEnum):
    """What the numbers are for."""

    PARTICLES = 1
    RESAMPLING = 2
    HYPOTHESES = 3
    BUILDING = 101
    FURNITURE = 102
    PEOPLE = 103
    WHEELS = 104
    LASER = 105
    CHANGES = 106


def random_stream(seed: int, purpose: Purpose, step: int) -> np.random.Generator:
    """The generator of one decision.

    All hypotheses draw the same numbers: where two have the same map and the same past they stay the same, and the
    ratio of their evidence carries no noise of sampling.

    :param seed: seed of the run, below 2**64.
    :param purpose: what the numbers are for.
    :param step: keyframe event, scan, piece of furniture or person, from 0.
    """
    return np.random.Generator(np.random.Philox(key=[seed, int(purpose)], counter=[0, 0, 0, step]))
