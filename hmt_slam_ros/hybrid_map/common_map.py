"""What every live hypothesis agrees on: areas and arcs, with the arcs also in arrays for searches over all of them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Bool, Float64, Int32, Int64
from hmt_slam_ros.geometry.gaussian import PoseGaussian

KeyframePoses = Mapping[int, NDArray[np.float64]]
AreaPair = tuple[int, int]

Array = TypeVar("Array", Int32, Float64)

_NONE = -1
_FIRST_ROOM = 16


def area_pair(a: int, b: int) -> AreaPair:
    """The arc between two areas, whatever its direction."""
    return min(a, b), max(a, b)


@dataclass(frozen=True, eq=False, slots=True)
class ArcValue:
    """What the map stores of an arc.

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
    """Areas and arcs that are definite. They change in place, for all hypotheses that share them.

    What is asked of one area takes the same time however many there are.

    :ivar areas: {area: {keyframe: ``area_T_base`` (3,)}}.
    :ivar arcs: {(smaller area, larger area): arc}.
    :ivar max_area_id: the largest area that there ever was, -1 where there was none.
    """

    def __init__(self) -> None:
        self.areas: dict[int, KeyframePoses] = {}
        self.arcs: dict[AreaPair, ArcValue] = {}
        self.max_area_id = _NONE
        self._row: dict[AreaPair, int] = {}
        self._rows = 0
        self._extents = np.zeros(_FIRST_ROOM)
        self._table = _empty_table(_FIRST_ROOM)

    @property
    def table(self) -> ArcTable:
        """The arcs; its arrays may be longer than what they hold, and are only good until the next change."""
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
        """Take an area out that no arc joins to another; no other area gets its number."""
        del self.areas[area]
        self._extents[area] = 0.0

    def set_arc(self, pair: AreaPair, arc: ArcValue) -> None:
        """Set or replace the arc of (smaller area, larger area), which become areas where they are none."""
        for area in pair:
            if area not in self.areas:
                self.set_area(area, {})
        if pair not in self._row:
            self._insert_arc(pair)
        row = self._row[pair]
        self.arcs[pair] = arc
        self._table.means[row], self._table.covariances[row] = arc.pose.mean, arc.pose.covariance

    def _insert_arc(self, pair: AreaPair) -> None:
        """Give a new arc a row, and its sides a place among those of its areas."""
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
        """Take an arc out, if it is there; its row in the table is not used again."""
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
        found: list[int] = []
        side = int(self._table.first[area]) if area in self.areas else _NONE
        while side != _NONE:
            found.append(int(self._table.opposite_area[side]))
            side = int(self._table.next_side[side])
        return found

    def _ensure_capacity(self, area: int) -> None:
        while area >= len(self._extents):
            self._extents = _double_capacity(self._extents)
            self._table = self._table._replace(first=_double_capacity(self._table.first))


def extent(keyframes: KeyframePoses) -> float:
    """Largest distance of keyframes from the origin of their area, m."""
    return max((math.hypot(pose[0], pose[1]) for pose in keyframes.values()), default=0.0)


def _empty_table(room: int) -> ArcTable:
    first, sides = np.full(room, _NONE, dtype=np.int32), np.full(2 * room, _NONE, dtype=np.int32)
    return ArcTable(first, sides, sides.copy(), np.zeros((room, 3)), np.zeros((room, 3, 3)))


def _double_capacity(array: Array) -> Array:
    """The same array with room for as much again; numbers of sides and areas in it are -1."""
    return np.concatenate((array, np.full_like(array, _NONE)))


@dataclass(frozen=True, eq=False)
class GraphState:
    """Areas with their keyframes, and arcs, in the order in which they came.

    :ivar areas: shape (n,), ids.
    :ivar keyframe_counts: shape (n,), how many keyframes each has.
    :ivar keyframes: shape (k,), ids, area by area.
    :ivar poses: shape (k, 3), ``area_T_base`` of each keyframe, m and rad.
    :ivar arcs: shape (m, 2), smaller and larger area.
    :ivar means: shape (m, 3), ``smaller_T_larger`` of each arc, m and rad.
    :ivar covariances: shape (m, 3, 3), right tangent frame.
    :ivar closures: shape (m,), whether the arc closed a loop.
    :ivar removed: shape (m,), whether a hypothesis lacks an arc that all others have; its belief is zeros then.
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
        """The state of areas and arcs, None for one that is withdrawn."""
        none = ArcValue(PoseGaussian.from_pose(np.zeros(3)), closure=False)
        values = [none if arc is None else arc for arc in arcs.values()]
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
        placed = zip(self.keyframes.tolist(), self.poses, strict=True)
        sizes = zip(self.areas.tolist(), self.keyframe_counts.tolist(), strict=True)
        return {area: dict(itertools.islice(placed, size)) for area, size in sizes}

    def arc_values(self) -> dict[AreaPair, ArcValue | None]:
        """{(smaller area, larger area): arc}, None for one that is withdrawn."""
        columns = (self.arcs.tolist(), self.means, self.covariances, self.closures.tolist(), self.removed.tolist())
        return {
            (a, b): None if withdrawn else ArcValue(PoseGaussian(mean, covariance), closure)
            for (a, b), mean, covariance, closure, withdrawn in zip(*columns, strict=True)
        }
