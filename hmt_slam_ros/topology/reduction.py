"""Keep N of many weighted hypotheses: optimal resampling of a discrete distribution (Fearnhead and Clifford 2003)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Reduction(NamedTuple):
    """The hypotheses that stay.

    :ivar kept: shape (n,), int64, ascending indices, each once.
    :ivar weights: shape (n,), their new weights, with the sum of all the old ones.
    """

    kept: NDArray[np.int64]
    weights: NDArray[np.float64]


def reduce_hypotheses(weights: NDArray[np.float64], most: int, generator: np.random.Generator) -> Reduction:
    """Keep at most ``most`` hypotheses.

    Those heavier than a threshold c keep their weight; of the others a stratified draw keeps some at weight c. No
    hypothesis appears twice, the expected weight of each is what it was, and no other such scheme has a smaller
    squared error.

    :param weights: shape (m,), not negative, of distinct hypotheses; those with weight 0 are dropped.
    :param most: N, at least 1.
    :param generator: gives one number where a draw is needed.
    """
    alive = np.flatnonzero(weights > 0.0)
    if alive.size <= most:
        return Reduction(alive, weights[alive])
    c = threshold(weights[alive], most)
    heavy = weights[alive] >= c
    light = alive[~heavy]
    draws = most - int(heavy.sum())
    drawn = light[_stratified(weights[light], draws, float(generator.random()))]
    kept = np.sort(np.concatenate((alive[heavy], drawn)))
    return Reduction(kept, np.where(weights[kept] >= c, weights[kept], weights[light].sum() / max(1, draws)))


def threshold(weights: NDArray[np.float64], most: int) -> float:
    """The c with sum of min(w / c, 1) = N, for more than N positive weights, shape (m,)."""
    falling = np.sort(weights)[::-1]
    rest = np.cumsum(falling[::-1])[::-1]
    # With the k heaviest kept, c = rest / (N - k); k is right where the next weight is below that c.
    for k in range(most):
        c = rest[k] / (most - k)
        if falling[k] < c:
            return float(c)
    return float(falling[most - 1])


def _stratified(weights: NDArray[np.float64], count: int, offset: float) -> NDArray[np.int64]:
    """``count`` different indices, each drawn in proportion to its weight, none of which exceeds the stride."""
    edges = np.cumsum(weights) / weights.sum() * count
    edges[-1] = count
    return np.searchsorted(edges, np.arange(count) + offset, side="right").astype(np.int64)
