"""What every live hypothesis agrees on: areas and arcs, with the arcs also in arrays for searches over all of them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Float64, Int32
from hmt_slam_ros.geometry.gaussian import PoseGaussian

Keyframes = Mapping[int, NDArray[np.float64]]
Pair = tuple[int, int]

Array = TypeVar("Array", Int32, Float64)

_NONE = -1
_FIRST_ROOM = 16


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
    :ivar following: shape (sides,), the next side at the same area, or -1.
    :ivar beyond: shape (sides,), the area at the other end.
    :ivar means: shape (arcs, 3), ``a_T_b``.
    :ivar covariances: shape (arcs, 3, 3), right tangent frame.
    """

    first: Int32
    following: Int32
    beyond: Int32
    means: Float64
    covariances: Float64


class CommonMap:
    """Areas and arcs that are definite. They change in place, for all hypotheses that share them.

    What is asked of one area takes the same time however many there are.

    :ivar areas: {area: {keyframe: ``area_T_base`` (3,)}}.
    :ivar arcs: {(smaller area, larger area): arc}.
    :ivar largest: the largest area that there ever was, -1 where there was none.
    """

    def __init__(self) -> None:
        self.areas: dict[int, Keyframes] = {}
        self.arcs: dict[Pair, ArcValue] = {}
        self.largest = _NONE
        self._row: dict[Pair, int] = {}
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

    def set_area(self, area: int, keyframes: Keyframes) -> None:
        """Set or replace an area with its keyframes."""
        self._make_room(area)
        self.areas[area] = keyframes
        self.largest = max(self.largest, area)
        self._extents[area] = extent(keyframes)

    def remove_area(self, area: int) -> None:
        """Take an area out that no arc joins to another; no other area gets its number."""
        del self.areas[area]
        self._extents[area] = 0.0

    def set_arc(self, pair: Pair, arc: ArcValue) -> None:
        """Set or replace the arc of (smaller area, larger area), which become areas where they are none."""
        for area in pair:
            if area not in self.areas:
                self.set_area(area, {})
        if pair not in self._row:
            self._link(pair)
        row = self._row[pair]
        self.arcs[pair] = arc
        self._table.means[row], self._table.covariances[row] = arc.pose.mean, arc.pose.covariance

    def _link(self, pair: Pair) -> None:
        """Give a new arc a row, and its sides a place among those of its areas."""
        row = self._row[pair] = self._rows
        self._rows += 1
        table = self._table
        if row >= len(table.means):
            table = self._table = ArcTable(
                table.first,
                _doubled(table.following),
                _doubled(table.beyond),
                _doubled(table.means),
                _doubled(table.covariances),
            )
        for side, (area, other) in enumerate((pair, pair[::-1]), 2 * row):
            table.beyond[side], table.following[side] = other, table.first[area]
            table.first[area] = side

    def remove_arc(self, pair: Pair) -> None:
        """Take an arc out, if it is there; its row in the table is not used again."""
        if self.arcs.pop(pair, None) is None:
            return
        row = self._row.pop(pair)
        first, following = self._table.first, self._table.following
        for side, area in enumerate(pair, 2 * row):
            if first[area] == side:
                first[area] = following[side]
                continue
            before = int(first[area])
            while following[before] != side:
                before = int(following[before])
            following[before] = following[side]

    def neighbours(self, area: int) -> list[int]:
        """The areas one arc away, in no order."""
        found: list[int] = []
        side = int(self._table.first[area]) if area in self.areas else _NONE
        while side != _NONE:
            found.append(int(self._table.beyond[side]))
            side = int(self._table.following[side])
        return found

    def _make_room(self, area: int) -> None:
        while area >= len(self._extents):
            self._extents = _doubled(self._extents)
            self._table = self._table._replace(first=_doubled(self._table.first))


def extent(keyframes: Keyframes) -> float:
    """Largest distance of keyframes from the origin of their area, m."""
    return max((math.hypot(pose[0], pose[1]) for pose in keyframes.values()), default=0.0)


def _empty_table(room: int) -> ArcTable:
    first, sides = np.full(room, _NONE, dtype=np.int32), np.full(2 * room, _NONE, dtype=np.int32)
    return ArcTable(first, sides, sides.copy(), np.zeros((room, 3)), np.zeros((room, 3, 3)))


def _doubled(array: Array) -> Array:
    """The same array with room for as much again; numbers of sides and areas in it are -1."""
    return np.concatenate((array, np.full_like(array, _NONE)))
