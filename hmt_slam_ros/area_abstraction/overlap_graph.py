"""Overlap of keyframes, the overlap graph of an area, and its normalized cut.

The overlap of scans i and j is the mean of two shares: of the points of i that have a point of j within a radius, and
of the points of j that have one of i (Blanco, Gonzalez, Fernandez-Madrigal, IROS 2006, symmetrized by averaging).
Scans in the middle of a hall have no points; the overlap of their free space falls with their distance.

The normalized cut (Shi and Malik, PAMI 2000), with similarities A, cut(P1, P2) the sum of A over the pairs between the
parts, and assoc(P, V) the sum over all pairs from P to the whole graph, pairs within P in both directions:

    NCut(P1, P2) = cut(P1, P2) / assoc(P1, V) + cut(P1, P2) / assoc(P2, V),    in [0, 2].

It is 0 where nothing is cut, also of a node without any similarity. A diagonal entry A_ii is what node i holds within
itself: contracting nodes into one keeps the value of every cut that does not split them.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Bool, Float64, Int32, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors import Scan

_MAX_CELLS = 64
"""Most cells along an edge of a point grid."""

_CHAIN_SIMILARITY = 1e-6
"""Similarity of neighbors in time, relative to the largest, that connects a graph that is not connected."""

_MIN_IMPROVEMENT = 1e-12
"""Smallest difference of two normalized cuts that counts."""

_OLD_GROUND = -1
"""Node of the contracted old ground."""


def sensed_points(scan: Scan, max_range: float, count: int = 180) -> Float64:
    """At most ``count`` end points of a scan, evenly over its returns no farther than ``max_range`` from the laser.

    :returns: shape (k, 2), m, robot base frame.
    """
    near = scan.points[np.hypot(*scan.beams.T) <= max_range]
    if len(near) <= count:
        return near
    return near[np.linspace(0.0, len(near) - 1.0, count).round().astype(np.int64)]


class SensedSpace(NamedTuple):
    """The space that a scan sensed.

    :ivar points: of :func:`sensed_points`, shape (k, 2), m.
    :ivar max_range: largest range of points, m.
    """

    points: Float64
    max_range: float

    @classmethod
    def from_scan(cls, scan: Scan, max_range: float, count: int = 180) -> SensedSpace:
        """The space of a scan; parameters as for :func:`sensed_points`."""
        return cls(sensed_points(scan, max_range, count), min(max_range, scan.range_max))


def sensed_overlaps(
    one: SensedSpace, pose: Float64, others: Sequence[SensedSpace], other_poses: Float64, radius: float
) -> Float64:
    """Overlap of one scan with each of several others as :func:`overlaps`, or of free space if neither has points.

    The latter falls linearly from 1 to 0 at the sum of their ranges, nearly as the common part of two discs.

    :param others: m scans.
    :returns: shape (m,), values in [0, 1].
    """
    shares = overlaps(one.points, pose, [other.points for other in others], other_poses, radius)
    empty = [j for j, other in enumerate(others) if not len(other.points)]
    if empty and not len(one.points):
        distances = np.hypot(*(other_poses[empty, :2] - pose[:2]).T)
        ranges = one.max_range + np.array([others[j].max_range for j in empty])
        shares[empty] = np.maximum(0.0, 1.0 - distances / ranges)
    return shares


def overlaps(points: Float64, pose: Float64, others: Sequence[Float64], other_poses: Float64, radius: float) -> Float64:
    """Overlap of one scan with each of several others.

    :param points: shape (k, 2), m, base frame of the one scan.
    :param pose: shape (3,), pose of its base in a common frame, m and rad.
    :param others: m arrays (k_j, 2), m, each in its own base frame.
    :param other_poses: shape (m, 3), poses of their bases in the common frame.
    :param radius: two points no farther apart than this are the same sensed space, m.
    :returns: shape (m,), values in [0, 1]; 0 where a scan has no points.
    """
    if not others:
        return np.zeros(0)
    ends = np.cumsum([len(other) for other in others])
    return _overlaps(np.ascontiguousarray(points), pose, np.concatenate(others), ends, other_poses, radius)


@njit(cache=True)
def _overlaps(
    points: Float64, pose: Float64, stacked: Float64, ends: Int64, other_poses: Float64, radius: float
) -> Float64:
    """:func:`overlaps` for points stacked over the others, each ending before ``ends[j]``."""
    result = np.zeros(ends.size)
    if not len(points):
        return result
    grid = _fill_grid(points, radius)
    # The last scan that matched each of the points, so that nothing has to be cleared in between.
    matched_by, start = np.full(len(points), -1), 0
    for j in range(ends.size):
        if ends[j] > start:
            transformed = _transform_points(stacked[start : ends[j]], pose, other_poses[j])
            result[j] = _overlap(points, grid, transformed, radius, matched_by, j)
        start = ends[j]
    return result


@njit(cache=True)
def _transform_points(points: Float64, pose: Float64, other_pose: Float64) -> Float64:
    """Points of the base at ``other_pose`` in the frame of the base at ``pose``."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x, y = se2.rotate_back(cos, sin, other_pose[0] - pose[0], other_pose[1] - pose[1])
    cos, sin = np.cos(other_pose[2] - pose[2]), np.sin(other_pose[2] - pose[2])
    transformed = np.empty_like(points)
    for i in range(len(points)):
        transformed[i, 0], transformed[i, 1] = se2.transform_point(x, y, cos, sin, points[i, 0], points[i, 1])
    return transformed


class _PointGrid(NamedTuple):
    """Points in square cells.

    :ivar low_x: lower edge of the grid, m; ``low_y`` likewise.
    :ivar edge: of a cell, m.
    :ivar last_point: shape (rows, columns), the newest point of each cell, -1 for none.
    :ivar previous_point: shape (n,), for each point the one before it in its cell, -1 for none.
    """

    low_x: float
    low_y: float
    edge: float
    last_point: Int32
    previous_point: Int32


@njit(cache=True)
def _fill_grid(points: Float64, radius: float) -> _PointGrid:
    low_x, low_y = points[:, 0].min(), points[:, 1].min()
    extent = max(points[:, 0].max() - low_x, points[:, 1].max() - low_y)
    edge = max(2.0 * radius, extent / _MAX_CELLS)
    size = int(extent / edge) + 1
    last_point, previous_point = np.full((size, size), -1, np.int32), np.empty(len(points), np.int32)
    for k in range(len(points)):
        column, row = int((points[k, 0] - low_x) / edge), int((points[k, 1] - low_y) / edge)
        previous_point[k] = last_point[row, column]
        last_point[row, column] = k
    return _PointGrid(low_x, low_y, edge, last_point, previous_point)


@njit(cache=True)
def _overlap(
    points: Float64, grid: _PointGrid, others: Float64, radius: float, matched_by: Int64, number: int
) -> float:
    """Overlap of the points in the grid with others in the same frame.

    :param matched_by: for each of the points the number of the last scan that matched it, changed in place.
    :param number: of this one.
    """
    size = len(grid.last_point)
    # Rounding must not hide a point at just this distance.
    reach = radius * (1.0 + 1e-9)
    matched = others_matched = 0
    for i in range(len(others)):
        x, y = others[i, 0] - grid.low_x, others[i, 1] - grid.low_y
        left, right = int(np.floor((x - reach) / grid.edge)), int(np.floor((x + reach) / grid.edge))
        bottom, top = int(np.floor((y - reach) / grid.edge)), int(np.floor((y + reach) / grid.edge))
        is_matched = False
        for r in range(max(0, bottom), min(size, top + 1)):
            for c in range(max(0, left), min(size, right + 1)):
                k = grid.last_point[r, c]
                while k >= 0:
                    dx, dy = points[k, 0] - others[i, 0], points[k, 1] - others[i, 1]
                    if dx * dx + dy * dy <= radius * radius:
                        is_matched = True
                        if matched_by[k] != number:
                            matched_by[k] = number
                            matched += 1
                    k = grid.previous_point[k]
        others_matched += is_matched
    return 0.5 * (matched / len(points) + others_matched / len(others))


class Cut(NamedTuple):
    """A bipartition.

    :ivar side: shape (n,), True for the part P2; node 0 is always in P1.
    :ivar value: NCut(P1, P2).
    """

    side: Bool
    value: float


@njit(cache=True)
def ncut(similarity: Float64, side: Bool) -> float:
    """NCut of a given bipartition.

    :param similarity: shape (n, n), symmetric, not negative.
    :param side: shape (n,), True for one part.
    """
    cut, assoc, other_assoc = 0.0, 0.0, 0.0
    for i in range(len(side)):
        for j in range(len(side)):
            if side[i]:
                assoc += similarity[i, j]
                cut += 0.0 if side[j] else similarity[i, j]
            else:
                other_assoc += similarity[i, j]
    return _ncut_value(cut, assoc, other_assoc)


@njit(cache=True)
def _ncut_value(cut: float, assoc: float, other_assoc: float) -> float:
    return (cut / assoc if assoc > 0.0 else 0.0) + (cut / other_assoc if other_assoc > 0.0 else 0.0)


def normalized_cut(similarity: Float64, min_size: int = 1, sizes: Int64 | None = None) -> Cut | None:
    """The best bipartition found: every prefix of every leading eigenvector's order is tried (a sweep cut).

    :param similarity: shape (n, n), symmetric, not negative, in the order of time. That decides only where the graph
        is not connected: a node without similarities stays with its neighbors in time.
    :param min_size: smallest part allowed, in units of ``sizes``.
    :param sizes: shape (n,), the size of each node; None for one each.
    :returns: None if no bipartition has parts large enough.
    """
    n = len(similarity)
    sizes = np.ones(n, np.int64) if sizes is None else sizes
    if n < 2:
        return None
    best: Cut | None = None
    for order in _orders(similarity):
        cut = _sweep(similarity, order, min_size, sizes)
        if cut is not None and (best is None or cut.value < best.value - _MIN_IMPROVEMENT):
            best = cut
    return best


def _orders(similarity: Float64) -> list[NDArray[np.intp]]:
    """Orders of the nodes along the leading solutions of (D - A) x = lambda D x, shape (n,) each."""
    n = len(similarity)
    chain = _CHAIN_SIMILARITY * max(float(similarity.max()), _CHAIN_SIMILARITY)
    joined = similarity + chain * (np.eye(n, k=1) + np.eye(n, k=-1))
    scale = 1.0 / np.sqrt(joined.sum(axis=1))
    # x = D^-1/2 y with y an eigenvector of the symmetric I - D^-1/2 A D^-1/2.
    laplacian = np.eye(n) - scale[:, None] * joined * scale
    # Each component beyond the first has an eigenvalue near 0; the next solution bisects a component.
    last = min(n - 1, _count_components(similarity) + 1)
    vectors = scipy.linalg.eigh(laplacian, subset_by_index=(0, last))[1]
    return [np.argsort(scale * vector, kind="stable") for vector in vectors.T]


@njit(cache=True)
def _count_components(similarity: Float64) -> int:
    """Number of connected components of a graph."""
    n = len(similarity)
    is_reached, stack, components = np.zeros(n, np.bool_), np.empty(n, np.int64), 0
    for start in range(n):
        components += not is_reached[start]
        size = int(not is_reached[start])
        is_reached[start], stack[0] = True, start
        while size > 0:
            size -= 1
            node = stack[size]
            for other in range(n):
                if similarity[node, other] > 0.0 and not is_reached[other]:
                    is_reached[other], stack[size] = True, other
                    size += 1
    return components


def _sweep(similarity: Float64, order: NDArray[np.intp], min_size: int, sizes: Int64) -> Cut | None:
    """The best of the bipartitions that divide ``order`` in two, or None if each has too small a part."""
    size = np.cumsum(sizes[order])
    allowed = (size[:-1] >= min_size) & (size[-1] - size[:-1] >= min_size)
    if not allowed.any():
        return None
    values = np.where(allowed, _prefix_ncuts(similarity, order), np.inf)
    prefix = order[: int(np.argmin(values)) + 1]
    side = np.zeros(len(order), np.bool_)
    side[prefix] = True
    side ^= side[0]
    return Cut(side, ncut(similarity, side))


@njit(cache=True)
def _prefix_ncuts(similarity: Float64, order: NDArray[np.intp]) -> Float64:
    """NCut of the first 1, 2, ... n - 1 nodes of an order and the others, shape (n - 1,)."""
    values, to_prefix = np.empty(len(order) - 1), np.zeros(len(order))
    total, assoc, within = similarity.sum(), 0.0, 0.0
    for k in range(len(order) - 1):
        node = order[k]
        within += 2.0 * to_prefix[node] + similarity[node, node]
        to_prefix += similarity[node]
        assoc += similarity[node].sum()
        values[k] = _ncut_value(max(assoc - within, 0.0), assoc, total - assoc)
    return values


def recursive_cut(similarity: Float64, threshold: float, min_size: int = 1, sizes: Int64 | None = None) -> Int64:
    """The partition by cutting each part again, as a graph of its own, while its NCut is at most ``threshold``.

    :param similarity: as for :func:`normalized_cut`.
    :param threshold: largest NCut at which a part is cut, in [0, 2].
    :param min_size: smallest part allowed, in units of ``sizes``.
    :param sizes: shape (n,), the size of each node; None for one each.
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
    """Keyframes and the overlaps of their sensed spaces; a value, so that hypotheses may share one.

    :ivar keyframes: ids, ascending, that is, in order of time.
    :ivar similarity: shape (n, n), symmetric, in [0, 1], zero diagonal.
    """

    keyframes: tuple[int, ...] = ()
    similarity: Float64 = field(default_factory=lambda: np.zeros((0, 0)))

    def subgraph(self, keep: Collection[int]) -> OverlapGraph:
        """The graph of those of its keyframes that are in ``keep``."""
        rows = [i for i, keyframe in enumerate(self.keyframes) if keyframe in keep]
        if len(rows) == len(self.keyframes):
            return self
        return OverlapGraph(tuple(self.keyframes[i] for i in rows), self.similarity[np.ix_(rows, rows)])

    def without_keyframes(self, removed: Collection[int]) -> OverlapGraph:
        """The graph without those of its keyframes that are in ``removed``."""
        return self.subgraph(set(self.keyframes).difference(removed))

    def weaken_across_doors(self, segment_labels: Mapping[int, int], factor: float) -> OverlapGraph:
        """The graph with the similarities of keyframes in different segments multiplied by a factor.

        :param segment_labels: {keyframe: number of its segment}, 0 of those that are not in it.
        """
        labels = np.array([segment_labels.get(keyframe, 0) for keyframe in self.keyframes])
        return OverlapGraph(self.keyframes, np.where(labels[:, None] == labels, 1.0, factor) * self.similarity)

    def overlaps_with(self, keyframe: int, others: Sequence[int]) -> Float64:
        """Overlaps of a keyframe with others, shape (number of others,), NaN where either is not in this graph."""
        if keyframe not in self.keyframes:
            return np.full(len(others), np.nan)
        keyframes, wanted = np.array(self.keyframes), np.array(others, dtype=np.int64)
        columns = np.minimum(np.searchsorted(keyframes, wanted), len(keyframes) - 1)
        similarity = self.similarity[self.keyframes.index(keyframe), columns]
        return np.where(keyframes[columns] == wanted, similarity, np.nan)


MeasureOverlaps = Callable[[int, tuple[int, ...]], Float64]


def synchronize_graph(
    graph: OverlapGraph, keyframes: Collection[int], measure: MeasureOverlaps, *others: OverlapGraph
) -> OverlapGraph:
    """The graph of exactly ``keyframes``, measuring only overlaps that neither ``graph`` nor one of ``others`` holds.

    :param graph: of the area before.
    :param keyframes: the area's keyframes now.
    :param measure: (keyframe, others) -> overlaps, shape (number of others,).
    :param others: the graphs of areas from which keyframes came over.
    """
    graph = graph.subgraph(keyframes)
    old, new = graph.keyframes, sorted(set(keyframes) - set(graph.keyframes))
    if not new:
        return graph
    ids = (*old, *new)
    similarity = np.zeros((len(ids), len(ids)))
    similarity[: len(old), : len(old)] = graph.similarity
    for k, keyframe in enumerate(new, start=len(old)):
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
    """The part of the new keyframes, the newest among them, that separates from its area.

    Old ground, the keyframes that the area held before the robot entered it, is contracted into one node of their
    number: it is never split. The graph is cut recursively, and the part of the newest keyframe leaves. Parts between
    it and the old ground stay with the old ground, since nothing shows that they form an area. If the part does not
    separate well from all the rest, the first bipartition stands.

    :param new_keyframes: the keyframes stored since the robot entered the area.
    :param newest: the newest keyframe, one of ``new_keyframes``.
    :param threshold: largest NCut at which keyframes separate.
    :param min_size: fewest keyframes on each side.
    :returns: None if nothing separates, or the newest keyframe is on the side of the old ground.
    """
    similarity, sizes, nodes = _contract(graph, new_keyframes)
    node = nodes.index(newest)
    first = normalized_cut(similarity, min_size, sizes)
    if first is None or first.value > threshold:
        return None
    parts = recursive_cut(similarity, threshold, min_size, sizes)
    for side in (parts == parts[node], first.side):
        value = ncut(similarity, side)
        if side[node] and not side[0] and value <= threshold:
            return Separation(tuple(int(nodes[i]) for i in np.flatnonzero(side)), value)
    return None


def min_ncut(graph: OverlapGraph, part: Collection[int], min_size: int) -> float:
    """The smallest NCut of a graph: that of a given part, or a better one.

    :param part: some of its keyframes.
    :param min_size: fewest keyframes on each side of any other cut.
    """
    side = np.array([keyframe in part for keyframe in graph.keyframes], dtype=np.bool_)
    cut = normalized_cut(graph.similarity, min_size)
    return min(ncut(graph.similarity, side), np.inf if cut is None else cut.value)


def _contract(graph: OverlapGraph, new_keyframes: Collection[int]) -> tuple[Float64, Int64, list[int]]:
    """Similarities (m, m), sizes (m,) and ids of the old ground, if there is any, and the new keyframes."""
    nodes = [keyframe for keyframe in graph.keyframes if keyframe in new_keyframes]
    is_new = np.array([keyframe in new_keyframes for keyframe in graph.keyframes])
    if not is_new.all():
        nodes.insert(0, _OLD_GROUND)
    membership = np.zeros((len(is_new), len(nodes)))
    membership[~is_new, 0] = 1.0
    membership[is_new, len(nodes) - np.arange(is_new.sum(), 0, -1)] = 1.0
    return membership.T @ graph.similarity @ membership, membership.sum(axis=0).astype(np.int64), nodes
