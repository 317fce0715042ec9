"""Counter-based random streams: a draw depends on purpose and step, never on the order of execution."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Purpose(IntEnum):
    """The purpose of random numbers."""

    PARTICLES = 1
    RESAMPLING = 2
    HYPOTHESES = 3
    BUILDING = 101
    FURNITURE = 102
    PEOPLE = 103
    WHEELS = 104
    LASER = 105
    CHANGES = 106
    MARKS = 107
    REAR_LASER = 108


def random_stream(seed: int, purpose: Purpose, step: int) -> np.random.Generator:
    """The generator for one purpose at one step.

    All hypotheses draw the same numbers. Those with the same map and past stay equal, and the ratio of their evidence
    has no sampling noise.

    :param seed: seed of the run, below 2**64.
    :param purpose: purpose of the numbers.
    :param step: number of the keyframe event, scan, piece of furniture or person, from 0.
    """
    return np.random.Generator(np.random.Philox(key=[seed, int(purpose)], counter=[0, 0, 0, step]))
