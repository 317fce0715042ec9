"""The overlap graph of one area's keyframes, and what in it separates from the ground known before."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.area_abstraction.normalized_cut import ncut, normalized_cut, recursive_cut


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
