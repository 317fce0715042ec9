"""The overlap graph of one area's keyframes, and its normalized cut (Shi and Malik, PAMI 2000).

With similarities A, cut(P1, P2) the sum of A over the pairs between the parts, and assoc(P, V) the sum over all pairs
from P to the whole graph, pairs within P counting in both directions:

    NCut(P1, P2) = cut(P1, P2) / assoc(P1, V) + cut(P1, P2) / assoc(P2, V),    in [0, 2].

It is NCut = 0 where nothing is cut, also of a node without any similarity. A diagonal entry A_ii is what node i holds
within itself: contracting nodes into one keeps the value of every cut that does not split them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import eigh

# Similarity of neighbors in the order of the nodes, relative to the largest, that joins what is not connected.
_CHAIN = 1e-6


class Cut(NamedTuple):
    """A bipartition.

    :ivar side: shape (n,), True for the part P2; node 0 is always in P1.
    :ivar value: NCut(P1, P2).
    """

    side: NDArray[np.bool_]
    value: float


@njit(cache=True)
def ncut(similarity: NDArray[np.float64], side: NDArray[np.bool_]) -> float:
    """NCut of a given bipartition.

    :param similarity: shape (n, n), symmetric, not negative.
    :param side: shape (n,), True for one part.
    """
    between, one, other = 0.0, 0.0, 0.0
    for i in range(len(side)):
        for j in range(len(side)):
            if side[i]:
                one += similarity[i, j]
                between += 0.0 if side[j] else similarity[i, j]
            else:
                other += similarity[i, j]
    return _value(between, one, other)


@njit(cache=True)
def _value(between: float, one: float, other: float) -> float:
    return (between / one if one > 0.0 else 0.0) + (between / other if other > 0.0 else 0.0)


def normalized_cut(
    similarity: NDArray[np.float64], min_size: int = 1, sizes: NDArray[np.int64] | None = None
) -> Cut | None:
    """The best bipartition found: every prefix of every leading eigenvector's order is tried (a sweep cut).

    :param similarity: shape (n, n), symmetric, not negative. The order of the nodes is that of time: only where the
        graph falls apart does it decide, then a node without similarities stays with its neighbors in time.
    :param min_size: smallest part allowed, in units of ``sizes``.
    :param sizes: shape (n,), what each node counts; None for one each.
    :returns: None where no bipartition has parts large enough.
    """
    n = len(similarity)
    sizes = np.ones(n, np.int64) if sizes is None else sizes
    if n < 2:
        return None
    best: Cut | None = None
    for order in _orders(similarity):
        cut = _sweep(similarity, order, min_size, sizes)
        if cut is not None and (best is None or cut.value < best.value - 1e-12):
            best = cut
    return best


def _orders(similarity: NDArray[np.float64]) -> list[NDArray[np.intp]]:
    """Orders of the nodes along the leading solutions of (D - A) x = lambda D x, shape (n,) each."""
    n = len(similarity)
    chain = _CHAIN * max(float(similarity.max()), _CHAIN)
    joined = similarity + chain * (np.eye(n, k=1) + np.eye(n, k=-1))
    scale = 1.0 / np.sqrt(joined.sum(axis=1))
    # x = D^-1/2 y with y an eigenvector of the symmetric I - D^-1/2 A D^-1/2.
    laplacian = np.eye(n) - scale[:, None] * joined * scale
    # Each component beyond the first has an eigenvalue near 0; the next solution bisects a component.
    last = min(n - 1, _component_count(similarity) + 1)
    vectors = eigh(laplacian, subset_by_index=(0, last))[1]
    return [np.argsort(scale * vector, kind="stable") for vector in vectors.T]


@njit(cache=True)
def _component_count(similarity: NDArray[np.float64]) -> int:
    """How many parts the graph falls into."""
    n = len(similarity)
    seen, waiting = np.zeros(n, np.bool_), np.empty(n, np.int64)
    components = 0
    for root in range(n):
        if seen[root]:
            continue
        components += 1
        seen[root], waiting[0], count = True, root, 1
        while count:
            count -= 1
            node = waiting[count]
            for other in range(n):
                if similarity[node, other] > 0.0 and not seen[other]:
                    seen[other], waiting[count] = True, other
                    count += 1
    return components


def _sweep(
    similarity: NDArray[np.float64], order: NDArray[np.intp], min_size: int, sizes: NDArray[np.int64]
) -> Cut | None:
    """The best of the bipartitions that divide ``order`` in two, or None where each has too small a part."""
    size = np.cumsum(sizes[order])
    allowed = (size[:-1] >= min_size) & (size[-1] - size[:-1] >= min_size)
    if not allowed.any():
        return None
    values = np.where(allowed, _values_of_prefixes(similarity, order), np.inf)
    prefix = order[: int(np.argmin(values)) + 1]
    side = np.zeros(len(order), np.bool_)
    side[prefix] = True
    side ^= side[0]
    return Cut(side, ncut(similarity, side))


@njit(cache=True)
def _values_of_prefixes(similarity: NDArray[np.float64], order: NDArray[np.intp]) -> NDArray[np.float64]:
    """NCut of the first 1, 2, ... n - 1 nodes of an order and the others, shape (n - 1,)."""
    values, to_prefix = np.empty(len(order) - 1), np.zeros(len(order))
    total, assoc, within = similarity.sum(), 0.0, 0.0
    for k in range(len(order) - 1):
        node = order[k]
        within += 2.0 * to_prefix[node] + similarity[node, node]
        to_prefix += similarity[node]
        assoc += similarity[node].sum()
        values[k] = _value(max(assoc - within, 0.0), assoc, total - assoc)
    return values


def recursive_cut(
    similarity: NDArray[np.float64], threshold: float, min_size: int = 1, sizes: NDArray[np.int64] | None = None
) -> NDArray[np.int64]:
    """Partition by cutting each part again, as a graph of its own, while its NCut is at most ``threshold``.

    :param similarity: as for :func:`normalized_cut`.
    :param threshold: largest NCut at which a part is cut, in [0, 2].
    :param min_size: smallest part allowed, in units of ``sizes``.
    :param sizes: shape (n,), what each node counts; None for one each.
    :returns: shape (n,), the part of each node; parts are numbered in the order of their first nodes.
    """
    sizes = np.ones(len(similarity), np.int64) if sizes is None else sizes
    labels = np.zeros(len(similarity), np.int64)
    waiting, parts = [np.arange(len(similarity))], 0
    while waiting:
        nodes = waiting.pop()
        cut = normalized_cut(similarity[np.ix_(nodes, nodes)], min_size, sizes[nodes])
        if cut is not None and cut.value <= threshold:
            waiting += [nodes[cut.side], nodes[~cut.side]]
        else:
            labels[nodes] = parts
            parts += 1
    first = np.unique(labels, return_index=True)[1]
    rank = np.argsort(np.argsort(first))
    return rank[labels]


@dataclass(frozen=True, eq=False)
class OverlapGraph:
    """Keyframes and the overlaps of their sensed space; a value, so that hypotheses may share one.

    :ivar keyframes: ids, ascending, that is, in order of time.
    :ivar similarity: shape (n, n), symmetric, in [0, 1], zero diagonal.
    """

    keyframes: tuple[int, ...] = ()
    similarity: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 0)))

    def subgraph(self, keep: Collection[int]) -> OverlapGraph:
        """The graph of those of its keyframes that are in ``keep``."""
        rows = [i for i, keyframe in enumerate(self.keyframes) if keyframe in keep]
        if len(rows) == len(self.keyframes):
            return self
        return OverlapGraph(tuple(self.keyframes[i] for i in rows), self.similarity[np.ix_(rows, rows)])

    def without_keyframes(self, gone: Collection[int]) -> OverlapGraph:
        """The graph without those of its keyframes that are in ``gone``."""
        return self.subgraph(set(self.keyframes).difference(gone))

    def weaken_across_doors(self, segment_labels: Mapping[int, int], factor: float) -> OverlapGraph:
        """The graph with the similarities of keyframes in different segments multiplied by a factor.

        :param segment_labels: {keyframe: number of its segment}, 0 of those that are not in it.
        """
        own = np.array([segment_labels.get(keyframe, 0) for keyframe in self.keyframes])
        return OverlapGraph(self.keyframes, np.where(own[:, None] == own, 1.0, factor) * self.similarity)

    def overlaps_with(self, keyframe: int, others: Sequence[int]) -> NDArray[np.float64]:
        """Overlaps of a keyframe with others, NaN where either is not in this graph."""
        if keyframe not in self.keyframes:
            return np.full(len(others), np.nan)
        known, wanted = np.array(self.keyframes), np.array(others, dtype=np.int64)
        at = np.minimum(np.searchsorted(known, wanted), len(known) - 1)
        return np.where(known[at] == wanted, self.similarity[self.keyframes.index(keyframe), at], np.nan)


MeasureOverlaps = Callable[[int, tuple[int, ...]], NDArray[np.float64]]


def synchronize_graph(
    graph: OverlapGraph, keyframes: Collection[int], measure: MeasureOverlaps, *others: OverlapGraph
) -> OverlapGraph:
    """The graph of exactly ``keyframes``, measuring only overlaps that neither ``graph`` nor one of ``others`` holds.

    :param graph: what was known of the area.
    :param keyframes: the area's keyframes now.
    :param measure: (keyframe, others) -> overlaps, shape (number of others,).
    :param others: the graphs of areas from which keyframes came over.
    """
    graph = graph.subgraph(keyframes)
    held, new = graph.keyframes, sorted(set(keyframes) - set(graph.keyframes))
    if not new:
        return graph
    ids = (*held, *new)
    similarity = np.zeros((len(ids), len(ids)))
    similarity[: len(held), : len(held)] = graph.similarity
    for k, keyframe in enumerate(new, start=len(held)):
        row = np.full(k, np.nan)
        for other in others:
            row = np.where(np.isnan(row), other.overlaps_with(keyframe, ids[:k]), row)
        unknown = np.flatnonzero(np.isnan(row))
        row[unknown] = measure(keyframe, tuple(ids[i] for i in unknown))
        similarity[k, :k] = similarity[:k, k] = row
    order = np.argsort(ids)
    return OverlapGraph(tuple(sorted(ids)), similarity[np.ix_(order, order)])


class Separation(NamedTuple):
    """Keyframes that separate from their area, ascending, and the normalized cut that sets them apart."""

    keyframes: tuple[int, ...]
    ncut: float


def find_separation(
    graph: OverlapGraph, new_keyframes: Collection[int], newest: int, threshold: float, min_size: int
) -> Separation | None:
    """The part of the robot's own keyframes, the newest among them, that separates from its area.

    Keyframes that are not the robot's own, that is, that the area held before the robot entered it, are contracted
    into one node: known ground is never split, and the node counts as many as it contracts. The graph is cut
    recursively, and the part of the newest keyframe leaves; parts between it and the old ground stay with the old
    ground, since they were passed before and nothing says that they form a place of their own. Where the part so found
    does not separate well from all the rest, the first bipartition stands.

    :param new_keyframes: the keyframes stored since the robot entered the area.
    :param newest: the newest keyframe, one of ``new_keyframes``.
    :param threshold: largest NCut at which keyframes separate.
    :param min_size: keyframes on each side at least.
    :returns: None where nothing separates, or the newest keyframe is on the side of the old ground.
    """
    similarity, sizes, nodes = _contract(graph, new_keyframes)
    at = nodes.index(newest)
    first = normalized_cut(similarity, min_size, sizes)
    if first is None or first.value > threshold:
        return None
    parts = recursive_cut(similarity, threshold, min_size, sizes)
    for side in (parts == parts[at], first.side):
        value = ncut(similarity, side)
        if side[at] and not side[0] and value <= threshold:
            return Separation(tuple(int(nodes[i]) for i in np.flatnonzero(side)), value)
    return None


def min_ncut(graph: OverlapGraph, part: Collection[int], min_size: int) -> float:
    """The least NCut at which a graph falls into two: that which sets ``part`` apart, or a better one.

    :param part: some of its keyframes.
    :param min_size: keyframes on each side at least, of any other cut.
    """
    side = np.array([keyframe in part for keyframe in graph.keyframes], dtype=np.bool_)
    found = normalized_cut(graph.similarity, min_size)
    return min(ncut(graph.similarity, side), np.inf if found is None else found.value)


_OLD_GROUND = -1


def _contract(
    graph: OverlapGraph, new_keyframes: Collection[int]
) -> tuple[NDArray[np.float64], NDArray[np.int64], list[int]]:
    """Similarities, shape (m, m), and sizes, shape (m,), of the old ground (where there is any) and own keyframes."""
    nodes = [keyframe for keyframe in graph.keyframes if keyframe in new_keyframes]
    is_own = np.array([keyframe in new_keyframes for keyframe in graph.keyframes])
    if not is_own.all():
        nodes.insert(0, _OLD_GROUND)
    membership = np.zeros((len(is_own), len(nodes)))
    membership[~is_own, 0] = 1.0
    membership[is_own, len(nodes) - np.arange(is_own.sum(), 0, -1)] = 1.0
    return membership.T @ graph.similarity @ membership, membership.sum(axis=0).astype(np.int64), nodes
