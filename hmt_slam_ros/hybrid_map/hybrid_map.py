"""The HMT map of one hypothesis: areas with their keyframes, and arcs, Eq. (2).

What all hypotheses agree on stands once, in a shared common map; a hypothesis holds only what it changed.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, fuse
from hmt_slam_ros.hybrid_map.common_map import ArcValue, CommonMap, KeyframePoses, extent

_DEGREES_OF_FREEDOM = 3


def fuse_traversals(old: PoseGaussian, new: PoseGaussian, shared: float) -> PoseGaussian:
    """The belief over ``a_T_b`` from two traversals of an arc.

    Eq. (10) takes the traversals for independent. Two things speak against it, and both inflate the two covariances:

    * the same scans in both: with all of them shared the factor is 2, and the product of equal beliefs is then no more
      certain than one of them, as in covariance intersection with equal weights;
    * a disagreement beyond what the covariances admit: then at least one of them is too small, and both are scaled by
      their chi-square per degree of freedom (Birge's ratio).

    :param shared: share of the new observation's keyframes that the old one had too, in [0, 1].
    """
    inflation = (1.0 + shared) * max(1.0, old.mahalanobis2(new) / _DEGREES_OF_FREEDOM)
    return fuse([PoseGaussian(belief.mean, inflation * belief.covariance) for belief in (old, new)])  # Eq. (10)


def apply_sigma_floor(belief: PoseGaussian, sigma: float, angle: float) -> PoseGaussian:
    """A belief no more certain than the maps that both traversals were matched against.

    :param sigma: smallest deviation of the translation along each axis, m.
    :param angle: smallest deviation of the heading, rad.
    """
    lack = np.array([sigma, sigma, angle]) ** 2 - np.diag(belief.covariance)
    covariance: NDArray[np.float64] = belief.covariance + np.diag(np.maximum(lack, 0.0))
    return PoseGaussian(belief.mean, covariance)


def _arc_key(a: int, b: int) -> tuple[int, int]:
    return (a, b) if a < b else (b, a)


@dataclass
class HybridMap:
    """Areas, keyframes and arcs under one topological hypothesis.

    :ivar common: what every live hypothesis agrees on.
    :ivar changed_areas: the areas in which this hypothesis differs from the common map, with all their keyframes.
    :ivar changed_arcs: likewise the arcs, keyed by (smaller area, larger area); None for one that this hypothesis
        lacks.
    """

    common: CommonMap = field(default_factory=CommonMap)
    changed_areas: dict[int, dict[int, NDArray[np.float64]]] = field(default_factory=dict)
    changed_arcs: dict[tuple[int, int], ArcValue | None] = field(default_factory=dict)

    def branch(self) -> HybridMap:
        """A child that may change without its parent noticing."""
        return HybridMap(self.common, {a: dict(k) for a, k in self.changed_areas.items()}, dict(self.changed_arcs))

    def subgraph(self, areas: Collection[int]) -> HybridMap:
        """A map of its own of some areas, and of the arcs between them."""
        part = HybridMap(changed_areas={area: dict(self.keyframes(area)) for area in areas})
        part.changed_arcs |= {(a, b): arc for a, b, arc in self.all_arcs() if a in areas and b in areas}
        part.commit()
        return part

    def commit(self) -> None:
        """Make this hypothesis's changes common; valid only when it is the one live hypothesis of ``common``."""
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
        """The largest area that there ever was, -1 where there was none."""
        return max(self.common.max_area_id, max(self.changed_areas, default=-1))

    def keyframes(self, area: int) -> KeyframePoses:
        """{keyframe: ``area_T_base`` (3,)} of an area, in the order of insertion.

        :raises KeyError: where there is no such area.
        """
        own = self.changed_areas.get(area)
        return self.common.areas[area] if own is None else own

    def extents(self, areas: Int64) -> Float64:
        """Largest distance of each area's keyframes from its origin, m, shape (n,) as ``areas``."""
        common = areas < len(self.common.extents)
        found = np.zeros(len(areas))
        found[common] = self.common.extents[areas[common]]
        own = np.isin(areas, list(self.changed_areas))
        found[own] = [extent(self.changed_areas[area]) for area in areas[own].tolist()]
        return found

    def set_keyframe(self, keyframe: int, area: int, pose: NDArray[np.float64]) -> None:
        """Put a keyframe into an area, made where missing, at ``area_T_base``."""
        self._writable_area(area)[keyframe] = pose

    def remove_keyframe(self, keyframe: int, area: int) -> None:
        """Take a keyframe out of an area."""
        del self._writable_area(area)[keyframe]

    def _writable_area(self, area: int) -> dict[int, NDArray[np.float64]]:
        if area not in self.changed_areas:
            self.changed_areas[area] = dict(self.common.areas.get(area, {}))
        return self.changed_areas[area]

    def arc(self, a: int, b: int) -> PoseGaussian | None:
        """The belief over ``a_T_b``, or None where no arc joins the two."""
        value = self.arc_value(a, b)
        if value is None:
            return None
        return value.pose if a < b else value.pose.inverse()

    def arc_value(self, a: int, b: int) -> ArcValue | None:
        """The arc as stored, from the smaller to the larger area, or None."""
        key = _arc_key(a, b)
        return self.changed_arcs[key] if key in self.changed_arcs else self.common.arcs.get(key)

    @property
    def pending_closures(self) -> dict[tuple[int, int], ArcValue]:
        """The arcs by which this hypothesis closed loops that the common map leaves open."""
        return {
            pair: arc
            for pair, arc in self.changed_arcs.items()
            if arc is not None and arc.closure and pair not in self.common.arcs
        }

    def set_arc(self, a: int, b: int, pose: PoseGaussian, *, closure: bool) -> None:
        """Set or replace the arc between a and b from the belief over ``a_T_b``."""
        self.changed_arcs[_arc_key(a, b)] = ArcValue(pose if a < b else pose.inverse(), closure)

    def remove_arc(self, a: int, b: int) -> None:
        """Take the arc between a and b out, if there is one."""
        self.changed_arcs[_arc_key(a, b)] = None

    def merge(self, area: int, into: int, into_T_area: PoseGaussian) -> None:
        """Make an area part of another; valid only when this is the one live hypothesis of ``common``.

        Its keyframes lie there, and its arcs begin there. Where both had an arc to a third area these are fused, Eq.
        (10), as if the same scans had told both, since refinement lets them agree. Where the arc between the two closed
        a loop, that by which the area was first entered closes it now.

        :param into_T_area: the belief over it.
        """
        self.commit()
        between = self.arc_value(into, area)
        for keyframe, pose in self.keyframes(area).items():
            self.set_keyframe(keyframe, into, se2.compose(into_T_area.mean, pose))
        self.remove_arc(area, into)
        arcs = {other: self.common.arcs[_arc_key(area, other)] for other in self.neighbors(area)}
        entered = min((other for other, arc in arcs.items() if not arc.closure), default=None)
        loop = between is None or between.closure
        for other, arc in arcs.items():
            seen = into_T_area.compose(arc.pose if area < other else arc.pose.inverse())
            closure = arc.closure or (loop and other == entered)
            known, value = self.arc(into, other), self.arc_value(into, other)
            if known is not None and value is not None:
                seen, closure = fuse_traversals(known, seen, shared=1.0), value.closure and closure
            self.remove_arc(area, other)
            self.set_arc(into, other, seen, closure=closure)
        self.commit()
        self.common.remove_area(area)

    def neighbors(self, area: int) -> list[int]:
        """The areas one arc away, ascending."""
        found = set(self.common.neighbors(area))
        for (a, b), arc in self.changed_arcs.items():
            if area in (a, b):
                (found.discard if arc is None else found.add)(b if a == area else a)
        return sorted(found)

    def all_arcs(self) -> Iterator[tuple[int, int, ArcValue]]:
        """All arcs as (a, b, value) with a < b, ascending."""
        keys = self.common.arcs.keys() | self.changed_arcs.keys()
        for a, b in sorted(keys):
            value = self.arc_value(a, b)
            if value is not None:
                yield a, b, value
