"""The HMT map of one hypothesis, or what all of them share, as a few arrays."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.topology.common_map import ArcValue, Keyframes, Pair


@dataclass(frozen=True, eq=False)
class GraphState:
    """Areas with their keyframes, and arcs, in the order in which they came.

    :ivar areas: shape (n,), ids.
    :ivar sizes: shape (n,), how many keyframes each has.
    :ivar keyframes: shape (k,), ids, area by area.
    :ivar poses: shape (k, 3), ``area_T_base`` of each keyframe, m and rad.
    :ivar arcs: shape (m, 2), smaller and larger area.
    :ivar means: shape (m, 3), ``smaller_T_larger`` of each arc, m and rad.
    :ivar covariances: shape (m, 3, 3), right tangent frame.
    :ivar closures: shape (m,), whether the arc closed a loop.
    :ivar withdrawn: shape (m,), whether a hypothesis lacks an arc that all others have; its belief is zeros then.
    """

    areas: Int64
    sizes: Int64
    keyframes: Int64
    poses: Float64
    arcs: Int64
    means: Float64
    covariances: Float64
    closures: Bool
    withdrawn: Bool

    @classmethod
    def empty(cls) -> GraphState:
        """No area and no arc."""
        return cls.of({}, {})

    @classmethod
    def of(cls, areas: Mapping[int, Keyframes], arcs: Mapping[Pair, ArcValue | None]) -> GraphState:
        """The state of areas and arcs, None for one that is withdrawn."""
        none = ArcValue(PoseGaussian.exactly(np.zeros(3)), closure=False)
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
        sizes = zip(self.areas.tolist(), self.sizes.tolist(), strict=True)
        return {area: dict(itertools.islice(placed, size)) for area, size in sizes}

    def arc_values(self) -> dict[Pair, ArcValue | None]:
        """{(smaller area, larger area): arc}, None for one that is withdrawn."""
        columns = (self.arcs.tolist(), self.means, self.covariances, self.closures.tolist(), self.withdrawn.tolist())
        return {
            (a, b): None if withdrawn else ArcValue(PoseGaussian(mean, covariance), closure)
            for (a, b), mean, covariance, closure, withdrawn in zip(*columns, strict=True)
        }
