"""True relative poses of scans of a recorded log, by chains of its true relations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from benchmark.awakening import path_lengths
from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.evaluation import Relations, StampedPoses
from hmt_slam_ros.evaluation.relations import MAX_TIME_GAP
from hmt_slam_ros.geometry import se2

LONGEST = 5.0
"""Longest chain, m: in longer ones the errors of relations add up."""

BESIDE = 2.0
"""Longest path between a scan and one with a relation, m, over which the log's trajectory is trusted."""

_LINK = 0.05  # m, added to the length of each link


class TruePair(NamedTuple):
    """Two scans whose relative pose is known.

    :ivar scans: their numbers.
    :ivar pose: of the second in the frame of the first, shape (3,).
    """

    scans: tuple[int, int]
    pose: Float64


class RelationChains:
    """Relative poses of scans by chains of relations.

    A scan without a relation joins the nearest ones before and after it, by the log's own trajectory.
    """

    def __init__(self, relations: Relations, source_stamps: Int64, trajectory: Float64) -> None:
        """:param source_stamps: shape (n,), of the scans, ns.

        :param trajectory: shape (n, 3), ``map_T_base`` of the scans.
        """
        self._links: dict[tuple[int, int], tuple[float, Float64]] = {}
        ends = self._add_relations(relations, source_stamps)
        self._add_neighbors(np.unique(ends), trajectory)
        pairs, values = np.array(list(self._links)).reshape(-1, 2), [link[0] for link in self._links.values()]
        shape = (len(trajectory), len(trajectory))
        self._graph = csr_array((values, (pairs[:, 0], pairs[:, 1])), shape=shape)

    def _add_relations(self, relations: Relations, source_stamps: Int64) -> Int64:
        """Add a link for each relation; return the scans (m,) that have one."""
        own = StampedPoses(source_stamps, np.zeros((len(source_stamps), 3)))
        starts, ends = own.nearest_indices(relations.starts), own.nearest_indices(relations.ends)
        gaps = np.maximum(
            np.abs(source_stamps[starts] - relations.starts), np.abs(source_stamps[ends] - relations.ends)
        )
        near = gaps <= MAX_TIME_GAP
        for a, b, pose in zip(starts[near].tolist(), ends[near].tolist(), relations.poses[near], strict=True):
            self._add(a, b, pose, float(np.hypot(pose[0], pose[1])))
        return np.concatenate((starts[near], ends[near])).astype(np.int64)

    def _add_neighbors(self, known: Int64, trajectory: Float64) -> None:
        """Link every scan with the nearest of some before and after it."""
        travel = np.array(list(path_lengths(trajectory)))
        scans = np.arange(len(trajectory))
        after = np.searchsorted(known, scans, side="left")
        for at in (after - 1, after):
            for scan in scans[(at >= 0) & (at < known.size)].tolist():
                other = int(known[at[scan]])
                way = abs(float(travel[scan] - travel[other]))
                if other != scan and way <= BESIDE:
                    self._add(scan, other, se2.between(trajectory[scan], trajectory[other]), way)

    def _add(self, a: int, b: int, pose: Float64, length: float) -> None:
        if a != b and length + _LINK < self._links.get((a, b), (np.inf,))[0]:
            self._links[a, b] = (length + _LINK, pose)
            self._links[b, a] = (length + _LINK, se2.inverse(pose))

    def nearest_pair(self, known: Sequence[int], query: Sequence[int]) -> TruePair | None:
        """Of the pairs of two groups of scans that a chain joins, that of the smallest distance; None without one."""
        lengths, before = dijkstra(self._graph, indices=list(known), limit=LONGEST, return_predecessors=True)
        pairs = [
            TruePair((known[row], scan), self._compose_chain(before[row], known[row], scan))
            for row in range(len(known))
            for scan in query
            if np.isfinite(lengths[row, scan])
        ]
        return min(pairs, key=lambda pair: float(np.hypot(pair.pose[0], pair.pose[1])), default=None)

    def _compose_chain(self, before: Int64, first: int, last: int) -> Float64:
        """The pose of the last scan of a chain in the frame of the first, shape (3,).

        :param before: shape (n,), the scan before each on its chain from the first.
        """
        pose, scan = np.zeros(3), last
        while scan != first:
            pose = se2.compose(self._links[int(before[scan]), scan][1], pose)
            scan = int(before[scan])
        return pose
