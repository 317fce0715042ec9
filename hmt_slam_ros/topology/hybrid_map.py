"""The HMT map of one hypothesis: areas with their keyframes, and arcs, Eq. (2).

What all hypotheses agree on stands once, in a shared networkx graph; a hypothesis holds only what it changed.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry.gaussian import PoseGaussian

Keyframes = Mapping[int, NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class ArcValue:
    """What the map stores of an arc: the belief over ``a_T_b`` (a < b) and whether it closed a loop."""

    pose: PoseGaussian
    closure: bool


def _stored_direction(a: int, b: int) -> tuple[int, int]:
    return (a, b) if a < b else (b, a)


@dataclass
class HybridMap:
    """Areas, keyframes and arcs under one topological hypothesis.

    :ivar common: what every live hypothesis agrees on. Node attribute ``keyframes``: {keyframe: ``area_T_base`` (3,)};
        edge attribute ``arc``: :class:`ArcValue`.
    :ivar areas: the areas in which this hypothesis differs from the common map, with all their keyframes.
    :ivar arcs: likewise the arcs, keyed by (smaller area, larger area).
    """

    common: nx.Graph = field(default_factory=nx.Graph)
    areas: dict[int, dict[int, NDArray[np.float64]]] = field(default_factory=dict)
    arcs: dict[tuple[int, int], ArcValue] = field(default_factory=dict)

    def branch(self) -> HybridMap:
        """A child that may change without its parent noticing."""
        return HybridMap(self.common, {a: dict(k) for a, k in self.areas.items()}, dict(self.arcs))

    def absorb(self) -> None:
        """Make this hypothesis's changes common; valid only when it is the one live hypothesis of ``common``."""
        for area, keyframes in self.areas.items():
            self.common.add_node(area, keyframes=keyframes)
        for (a, b), arc in self.arcs.items():
            self.common.add_edge(a, b, arc=arc)
        self.areas, self.arcs = {}, {}

    def area_ids(self) -> list[int]:
        """All areas, ascending."""
        return sorted(self.common.nodes | self.areas.keys())

    def keyframes(self, area: int) -> Keyframes:
        """{keyframe: ``area_T_base`` (3,)} of an area, in the order of insertion.

        :raises KeyError: where there is no such area.
        """
        own = self.areas.get(area)
        return self.common.nodes[area]["keyframes"] if own is None else own

    def place(self, keyframe: int, area: int, pose: NDArray[np.float64]) -> None:
        """Put a keyframe into an area, made where missing, at ``area_T_base``."""
        self._own(area)[keyframe] = pose

    def remove(self, keyframe: int, area: int) -> None:
        """Take a keyframe out of an area."""
        del self._own(area)[keyframe]

    def _own(self, area: int) -> dict[int, NDArray[np.float64]]:
        if area not in self.areas:
            self.areas[area] = dict(self.common.nodes[area]["keyframes"]) if area in self.common else {}
        return self.areas[area]

    def arc(self, a: int, b: int) -> PoseGaussian | None:
        """The belief over ``a_T_b``, or None where no arc joins the two."""
        value = self.arc_value(a, b)
        if value is None:
            return None
        return value.pose if a < b else value.pose.inverse()

    def arc_value(self, a: int, b: int) -> ArcValue | None:
        """The arc as stored, from the smaller to the larger area, or None."""
        key = _stored_direction(a, b)
        own = self.arcs.get(key)
        if own is None and self.common.has_edge(*key):
            return self.common.edges[key]["arc"]
        return own

    def set_arc(self, a: int, b: int, pose: PoseGaussian, *, closure: bool) -> None:
        """Set or replace the arc between a and b from the belief over ``a_T_b``."""
        self.arcs[_stored_direction(a, b)] = ArcValue(pose if a < b else pose.inverse(), closure)

    def neighbours(self, area: int) -> list[int]:
        """The areas one arc away, ascending."""
        found = set(self.common.adj[area]) if area in self.common else set()
        for a, b in self.arcs:
            if a == area:
                found.add(b)
            elif b == area:
                found.add(a)
        return sorted(found)

    def all_arcs(self) -> Iterator[tuple[int, int, ArcValue]]:
        """All arcs as (a, b, value) with a < b, ascending."""
        keys = {_stored_direction(a, b) for a, b in self.common.edges} | self.arcs.keys()
        for a, b in sorted(keys):
            value = self.arc_value(a, b)
            assert value is not None
            yield a, b, value
