"""The hybrid map of one hypothesis, Eq. (2): areas with keyframes, and arcs.

What all hypotheses agree on is stored once, in a shared common map. A hybrid map stores what differs.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, TypeVar

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int32, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, fuse

KeyframePoses = Mapping[int, Float64]
AreaPair = tuple[int, int]

Array = TypeVar("Array", Int32, Float64)

NO_KEYFRAME = -1
"""Stands for no keyframe. Those of other robots have smaller numbers: they are older than all of the robot's own."""

_NONE = -1
"""Stands for no area or no side in arrays."""

_INITIAL_CAPACITY = 16
"""Areas and arcs for which memory is allocated at first."""

_DEGREES_OF_FREEDOM = 3
"""Degrees of freedom of a pose."""


def area_pair(a: int, b: int) -> AreaPair:
    """The arc between two areas, whatever its direction."""
    return min(a, b), max(a, b)


def has_foreign_keyframes(keyframes: Iterable[int]) -> bool:
    """Whether other robots mapped some of these keyframes."""
    return any(keyframe < NO_KEYFRAME for keyframe in keyframes)


@dataclass(frozen=True, eq=False, slots=True)
class ArcValue:
    """An arc of the map.

    :ivar pose: belief over ``a_T_b``, a < b.
    :ivar closure: whether the arc closed a loop.
    """

    pose: PoseGaussian
    closure: bool


class ArcTable(NamedTuple):
    """Arcs as arrays. Arc k has two sides: 2 k at its smaller area a, 2 k + 1 at its larger area b.

    :ivar first: shape (areas,), a side at every area, or -1.
    :ivar next_side: shape (sides,), the next side at the same area, or -1.
    :ivar opposite_area: shape (sides,), the area at the other end.
    :ivar means: shape (arcs, 3), ``a_T_b``.
    :ivar covariances: shape (arcs, 3, 3), right tangent frame.
    """

    first: Int32
    next_side: Int32
    opposite_area: Int32
    means: Float64
    covariances: Float64


class CommonMap:
    """Definite areas and arcs. They change in place, for all hypotheses that share them.

    A query of one area takes constant time, whatever the size of the map.

    :ivar areas: {area: {keyframe: ``area_T_base`` (3,)}}.
    :ivar arcs: {(smaller area, larger area): arc}.
    :ivar max_area_id: the largest area that there ever was, -1 if there was none.
    """

    def __init__(self) -> None:
        self.areas: dict[int, KeyframePoses] = {}
        self.arcs: dict[AreaPair, ArcValue] = {}
        self.max_area_id = _NONE
        self._row: dict[AreaPair, int] = {}
        self._rows = 0
        self._extents = np.zeros(_INITIAL_CAPACITY)
        self._table = _empty_table(_INITIAL_CAPACITY)

    @property
    def table(self) -> ArcTable:
        """The arcs, valid until the next change; the arrays may be longer than their content."""
        return self._table

    @property
    def extents(self) -> Float64:
        """Largest distance of an area's keyframes from its origin, m; shape (n,), n above the largest area."""
        return self._extents

    def set_area(self, area: int, keyframes: KeyframePoses) -> None:
        """Set or replace an area with its keyframes."""
        self._ensure_capacity(area)
        self.areas[area] = keyframes
        self.max_area_id = max(self.max_area_id, area)
        self._extents[area] = extent(keyframes)

    def remove_area(self, area: int) -> None:
        """Remove an area without arcs; its number is not used again."""
        del self.areas[area]
        self._extents[area] = 0.0

    def set_arc(self, pair: AreaPair, arc: ArcValue) -> None:
        """Set or replace the arc of (smaller area, larger area); areas that do not exist are created."""
        for area in pair:
            if area not in self.areas:
                self.set_area(area, {})
        if pair not in self._row:
            self._insert_arc(pair)
        row = self._row[pair]
        self.arcs[pair] = arc
        self._table.means[row], self._table.covariances[row] = arc.pose.mean, arc.pose.covariance

    def _insert_arc(self, pair: AreaPair) -> None:
        """Give a new arc a row, and link its sides to those of its areas."""
        row = self._row[pair] = self._rows
        self._rows += 1
        table = self._table
        if row >= len(table.means):
            table = self._table = ArcTable(
                table.first,
                _double_capacity(table.next_side),
                _double_capacity(table.opposite_area),
                _double_capacity(table.means),
                _double_capacity(table.covariances),
            )
        for side, (area, other) in enumerate((pair, pair[::-1]), 2 * row):
            table.opposite_area[side], table.next_side[side] = other, table.first[area]
            table.first[area] = side

    def remove_arc(self, pair: AreaPair) -> None:
        """Remove an arc, if it exists; its row in the table is not used again."""
        if self.arcs.pop(pair, None) is None:
            return
        row = self._row.pop(pair)
        first, following = self._table.first, self._table.next_side
        for side, area in enumerate(pair, 2 * row):
            if first[area] == side:
                first[area] = following[side]
                continue
            before = int(first[area])
            while following[before] != side:
                before = int(following[before])
            following[before] = following[side]

    def neighbors(self, area: int) -> list[int]:
        """The areas one arc away, in no order."""
        neighbors: list[int] = []
        side = int(self._table.first[area]) if area in self.areas else _NONE
        while side != _NONE:
            neighbors.append(int(self._table.opposite_area[side]))
            side = int(self._table.next_side[side])
        return neighbors

    def _ensure_capacity(self, area: int) -> None:
        while area >= len(self._extents):
            self._extents = _double_capacity(self._extents)
            self._table = self._table._replace(first=_double_capacity(self._table.first))


def extent(keyframes: KeyframePoses) -> float:
    """Largest distance of keyframes from the origin of their area, m."""
    return max((math.hypot(pose[0], pose[1]) for pose in keyframes.values()), default=0.0)


def _empty_table(capacity: int) -> ArcTable:
    first, sides = np.full(capacity, _NONE, dtype=np.int32), np.full(2 * capacity, _NONE, dtype=np.int32)
    return ArcTable(first, sides, sides.copy(), np.zeros((capacity, 3)), np.zeros((capacity, 3, 3)))


def _double_capacity(array: Array) -> Array:
    """The array with twice its capacity, filled up with -1."""
    return np.concatenate((array, np.full_like(array, _NONE)))


@dataclass(frozen=True, eq=False)
class GraphState:
    """Areas with their keyframes, and arcs, in the order of insertion.

    :ivar areas: shape (n,), ids.
    :ivar keyframe_counts: shape (n,), number of keyframes of each.
    :ivar keyframes: shape (k,), ids, area by area.
    :ivar poses: shape (k, 3), ``area_T_base`` of each keyframe, m and rad.
    :ivar arcs: shape (m, 2), smaller and larger area.
    :ivar means: shape (m, 3), ``smaller_T_larger`` of each arc, m and rad.
    :ivar covariances: shape (m, 3, 3), right tangent frame.
    :ivar closures: shape (m,), whether the arc closed a loop.
    :ivar removed: shape (m,), whether the hypothesis lacks an arc of the common map; its belief is zeros then.
    """

    areas: Int64
    keyframe_counts: Int64
    keyframes: Int64
    poses: Float64
    arcs: Int64
    means: Float64
    covariances: Float64
    closures: Bool
    removed: Bool

    @classmethod
    def empty(cls) -> GraphState:
        """No area and no arc."""
        return cls.from_areas_and_arcs({}, {})

    @classmethod
    def from_areas_and_arcs(
        cls, areas: Mapping[int, KeyframePoses], arcs: Mapping[AreaPair, ArcValue | None]
    ) -> GraphState:
        """The state of areas and arcs, None for one that is removed."""
        removed = ArcValue(PoseGaussian.from_pose(np.zeros(3)), closure=False)
        values = [removed if arc is None else arc for arc in arcs.values()]
        return cls(
            np.array(list(areas), dtype=np.int64),
            np.array([len(keyframes) for keyframes in areas.values()], dtype=np.int64),
            np.array([k for keyframes in areas.values() for k in keyframes], dtype=np.int64),
            np.array([pose for keyframes in areas.values() for pose in keyframes.values()]).reshape(-1, 3),
            np.array(list(arcs), dtype=np.int64).reshape(-1, 2),
            np.array([arc.pose.mean for arc in values]).reshape(-1, 3),
            np.array([arc.pose.covariance for arc in values]).reshape(-1, 3, 3),
            np.array([arc.closure for arc in values], dtype=np.bool_),
            np.array([arc is None for arc in arcs.values()], dtype=np.bool_),
        )

    def area_keyframes(self) -> dict[int, dict[int, Float64]]:
        """{area: {keyframe: ``area_T_base``}}."""
        poses = zip(self.keyframes.tolist(), self.poses, strict=True)
        counts = zip(self.areas.tolist(), self.keyframe_counts.tolist(), strict=True)
        return {area: dict(itertools.islice(poses, count)) for area, count in counts}

    def arc_values(self) -> dict[AreaPair, ArcValue | None]:
        """{(smaller area, larger area): arc}, None for one that is removed."""
        columns = (self.arcs.tolist(), self.means, self.covariances, self.closures.tolist(), self.removed.tolist())
        return {
            (a, b): None if removed else ArcValue(PoseGaussian(mean, covariance), closure)
            for (a, b), mean, covariance, closure, removed in zip(*columns, strict=True)
        }


def fuse_traversals(old: PoseGaussian, new: PoseGaussian, shared: float) -> PoseGaussian:
    """The belief over ``a_T_b`` from two traversals of an arc.

    Eq. (10) assumes that the traversals are independent. Two effects violate that, and inflate both covariances:

    * shared scans: the factor is 2 if all are shared, so that equal beliefs gain no certainty, as in covariance
      intersection with equal weights;
    * a disagreement beyond the covariances: the factor is the chi-square per degree of freedom (Birge's ratio).

    :param shared: share of the new observation's keyframes that the old one had too, in [0, 1].
    """
    inflation = (1.0 + shared) * max(1.0, old.mahalanobis2(new) / _DEGREES_OF_FREEDOM)
    return fuse([PoseGaussian(belief.mean, inflation * belief.covariance) for belief in (old, new)])  # Eq. (10)


def apply_sigma_floor(belief: PoseGaussian, sigma: float, angle: float) -> PoseGaussian:
    """The belief with the given smallest deviations, as maps of walls are no more precise.

    :param sigma: smallest deviation of the translation along each axis, m.
    :param angle: smallest deviation of the heading, rad.
    """
    missing = np.array([sigma, sigma, angle]) ** 2 - np.diag(belief.covariance)
    covariance: Float64 = belief.covariance + np.diag(np.maximum(missing, 0.0))
    return PoseGaussian(belief.mean, covariance)


@dataclass
class HybridMap:
    """Areas, keyframes and arcs under one topological hypothesis.

    :ivar common: what all live hypotheses agree on.
    :ivar changed_areas: the areas that differ from the common map, with all their keyframes.
    :ivar changed_arcs: the arcs that differ, {(smaller area, larger area): arc}; None for one that is removed.
    """

    common: CommonMap = field(default_factory=CommonMap)
    changed_areas: dict[int, dict[int, Float64]] = field(default_factory=dict)
    changed_arcs: dict[AreaPair, ArcValue | None] = field(default_factory=dict)

    def branch(self) -> HybridMap:
        """A copy that shares the common map."""
        return HybridMap(self.common, {a: dict(k) for a, k in self.changed_areas.items()}, dict(self.changed_arcs))

    def subgraph(self, areas: Collection[int]) -> HybridMap:
        """A separate map of some areas and the arcs between them."""
        subgraph = HybridMap(changed_areas={area: dict(self.keyframes(area)) for area in areas})
        subgraph.changed_arcs |= {(a, b): arc for a, b, arc in self.all_arcs() if a in areas and b in areas}
        subgraph.commit()
        return subgraph

    def commit(self) -> None:
        """Move the changes to the common map; only valid if no other live hypothesis shares it."""
        for area, keyframes in self.changed_areas.items():
            self.common.set_area(area, keyframes)
        for pair, arc in self.changed_arcs.items():
            if arc is None:
                self.common.remove_arc(pair)
            else:
                self.common.set_arc(pair, arc)
        self.changed_areas, self.changed_arcs = {}, {}

    def area_ids(self) -> list[int]:
        """All areas, ascending."""
        return sorted(self.common.areas.keys() | self.changed_areas.keys())

    def has_area(self, area: int) -> bool:
        """Whether there is such an area."""
        return area in self.changed_areas or area in self.common.areas

    @property
    def max_area_id(self) -> int:
        """The largest area that there ever was, -1 if there was none."""
        return max(self.common.max_area_id, max(self.changed_areas, default=-1))

    def keyframes(self, area: int) -> KeyframePoses:
        """{keyframe: ``area_T_base`` (3,)} of an area, in the order of insertion.

        :raises KeyError: if there is no such area.
        """
        changed = self.changed_areas.get(area)
        return self.common.areas[area] if changed is None else changed

    def extents(self, areas: Int64) -> Float64:
        """Largest distance of each area's keyframes from its origin, m, shape (n,) as ``areas``."""
        extents = np.zeros(len(areas))
        is_common = areas < len(self.common.extents)
        extents[is_common] = self.common.extents[areas[is_common]]
        is_changed = np.isin(areas, list(self.changed_areas))
        extents[is_changed] = [extent(self.changed_areas[area]) for area in areas[is_changed].tolist()]
        return extents

    def set_keyframe(self, keyframe: int, area: int, pose: Float64) -> None:
        """Put a keyframe into an area at ``area_T_base``; an area that does not exist is created."""
        self._writable_area(area)[keyframe] = pose

    def remove_keyframe(self, keyframe: int, area: int) -> None:
        """Remove a keyframe from an area."""
        del self._writable_area(area)[keyframe]

    def _writable_area(self, area: int) -> dict[int, Float64]:
        if area not in self.changed_areas:
            self.changed_areas[area] = dict(self.common.areas.get(area, {}))
        return self.changed_areas[area]

    def arc(self, a: int, b: int) -> PoseGaussian | None:
        """The belief over ``a_T_b``, or None if no arc joins the two."""
        value = self.arc_value(a, b)
        if value is None:
            return None
        return value.pose if a < b else value.pose.inverse()

    def arc_value(self, a: int, b: int) -> ArcValue | None:
        """The arc as stored, from the smaller to the larger area, or None."""
        pair = area_pair(a, b)
        return self.changed_arcs[pair] if pair in self.changed_arcs else self.common.arcs.get(pair)

    @property
    def pending_closures(self) -> dict[AreaPair, ArcValue]:
        """The arcs by which this hypothesis closed loops, and which are not definite."""
        return {
            pair: arc
            for pair, arc in self.changed_arcs.items()
            if arc is not None and arc.closure and pair not in self.common.arcs
        }

    def set_arc(self, a: int, b: int, pose: PoseGaussian, *, closure: bool) -> None:
        """Set or replace the arc between a and b from the belief over ``a_T_b``."""
        self.changed_arcs[area_pair(a, b)] = ArcValue(pose if a < b else pose.inverse(), closure)

    def remove_arc(self, a: int, b: int) -> None:
        """Remove the arc between a and b, if there is one."""
        self.changed_arcs[area_pair(a, b)] = None

    def merge(self, area: int, into: int, into_T_area: PoseGaussian) -> None:
        """Make an area part of another; only valid if no other live hypothesis shares the common map.

        Its keyframes and arcs move to the other area. Where both had an arc to a third area the two are fused, Eq.
        (10), as if from the same scans, since refinement makes them agree. If the arc between the two closed a loop,
        the arc by which the area was first entered closes it now.

        :param into_T_area: the belief over it.
        """
        self.commit()
        between = self.arc_value(into, area)
        for keyframe, pose in self.keyframes(area).items():
            self.set_keyframe(keyframe, into, se2.compose(into_T_area.mean, pose))
        self.remove_arc(area, into)
        arcs = {other: self.common.arcs[area_pair(area, other)] for other in self.neighbors(area)}
        entered_from = min((other for other, arc in arcs.items() if not arc.closure), default=None)
        closed_loop = between is None or between.closure
        for other, arc in arcs.items():
            belief = into_T_area.compose(arc.pose if area < other else arc.pose.inverse())
            closure = arc.closure or (closed_loop and other == entered_from)
            known, value = self.arc(into, other), self.arc_value(into, other)
            if known is not None and value is not None:
                belief, closure = fuse_traversals(known, belief, shared=1.0), value.closure and closure
            self.remove_arc(area, other)
            self.set_arc(into, other, belief, closure=closure)
        self.commit()
        self.common.remove_area(area)

    def neighbors(self, area: int) -> list[int]:
        """The areas one arc away, ascending."""
        neighbors = set(self.common.neighbors(area))
        for (a, b), arc in self.changed_arcs.items():
            if area in (a, b):
                (neighbors.discard if arc is None else neighbors.add)(b if a == area else a)
        return sorted(neighbors)

    def all_arcs(self) -> Iterator[tuple[int, int, ArcValue]]:
        """All arcs as (a, b, value) with a < b, ascending."""
        for a, b in sorted(self.common.arcs.keys() | self.changed_arcs.keys()):
            value = self.arc_value(a, b)
            if value is not None:
                yield a, b, value
