"""What acceptance makes of a path's pending arcs: definite arcs, and keyframes that lie where their scans fit."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate, match_moments
from hmt_slam_ros.grids.patches import GridView
from hmt_slam_ros.hybrid_map.hybrid_map import (
    ArcValue,
    AreaPair,
    HybridMap,
    apply_sigma_floor,
    area_pair,
    fuse_traversals,
)
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative
from hmt_slam_ros.loop_closure.closure_history import Closure, MapSnapshot
from hmt_slam_ros.loop_closure.closure_refinement import ClosureRefinement
from hmt_slam_ros.messages.map_changes import Arc, MovedKeyframe
from hmt_slam_ros.messages.messages import Hypothesis
from hmt_slam_ros.registration import scan_to_map
from hmt_slam_ros.registration.area_to_area import MatchSettings, match_areas
from hmt_slam_ros.registration.likelihood_grid import AreaGrid, GridModel, build_area_grid
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.scan import transform_surfels
from hmt_slam_ros.submap.local_mapping import LocalMapping

# Factor on the covariance of what the match of two whole areas says: they are not quite rigid, and bend by more than
# the width of their walls.
_NONRIGID_INFLATION = 10.0

PlacedScan: TypeAlias = tuple[Scan, NDArray[np.float64]]


class AreaAlignment:
    """Lays several scans as one rigid body onto several others.

    First all poses are searched that the closure's own uncertainty admits: a step downhill from where it put the scans
    ends at the next likeness, which along a bare wall or across a hall may be meters away. From the best of them,
    Gauss-Newton on the map's distance field with Cauchy weights goes on below the width of the search's cells.
    """

    def __init__(self, configuration: Configuration) -> None:
        self._model = GridModel.from_configuration(configuration)
        self._settings = MatchSettings.from_options(configuration.tsbi)
        self._mapping = LocalMapping(configuration)
        self._alignment = self._mapping.alignment._replace(inflation=1.0 / configuration.matching.temper)
        self._gate = chi_square_gate(configuration.tsbi.gate_probability)

    def align(
        self, known: Sequence[PlacedScan], joined: Sequence[PlacedScan], closure: PoseGaussian
    ) -> PoseGaussian | None:
        """The belief over ``known_T_joined`` by the scans alone, all ways to fit taken together.

        :param known: (scan, ``known_T_base``) of the keyframes that the area held before.
        :param joined: (scan, ``joined_T_base``) of those that joined it.
        :param closure: belief over ``known_T_joined``, as TSBI found it with what is around the area as well.
        :returns: None where the scans tell no more than the closure did.
        """
        modes = match_areas(self._build_grid(joined), self._build_grid(known), closure, self._settings).modes
        found = match_moments([(mode.measured, mode.log_mass) for mode in modes]) if modes else closure
        if np.linalg.det(found.covariance) >= np.linalg.det(closure.covariance):
            return None
        table = self._mapping.pool.empty_table()
        for scan, pose in known:
            self._mapping.insert_scan(table[None], pose[None], scan)
        start = [
            transform_surfels(se2.compose(found.mean, pose), self._mapping.matching_surfels(scan))
            for scan, pose in joined
        ]
        offset = self._refine_offset(np.concatenate(start), closure, found, self._mapping.pool.view(table))
        self._mapping.pool.release(table)
        covariance = min(_NONRIGID_INFLATION * found.covariance, closure.covariance, key=np.linalg.det)
        return PoseGaussian(se2.compose(offset, found.mean), covariance)

    def _build_grid(self, placed: Sequence[PlacedScan]) -> AreaGrid:
        poses = np.array([pose for _, pose in placed]).reshape(-1, 3)
        return build_area_grid([scan for scan, _ in placed], poses, self._model)

    def _refine_offset(
        self, points: NDArray[np.float64], closure: PoseGaussian, found: PoseGaussian, view: GridView
    ) -> NDArray[np.float64]:
        """The motion ``D`` in the area's frame, shape (3,), that makes ``found`` fit better.

        What walls leave open the closure holds, and what was found is not left for another likeness.
        """
        held, near = (np.linalg.inv(belief.inverse().covariance) for belief in (closure, found))
        stay = np.zeros(3)
        prior = scan_to_map.Prior(stay, held.astype(np.float64, copy=False))
        offset, _ = scan_to_map.align(points, stay, prior, view, self._alignment)
        return offset if offset @ near @ offset <= self._gate else stay


@dataclass(frozen=True, eq=False)
class PendingArc:
    """An arc that TSBI set and that is not definite yet.

    :ivar event: at which it was observed.
    :ivar near: the robot's area before that event.
    :ivar source: area a.
    :ivar target: area b, the one that the robot entered.
    :ivar pose: belief over ``a_T_b`` as observed.
    :ivar closure: whether it closed a loop.
    :ivar replaced_arc: the definite arc ``a_T_b`` that it replaced, or None.
    :ivar joined_keyframes: the keyframes that moved into area b.
    :ivar observing_keyframes: the keyframes by which it was observed.
    """

    event: int
    near: int
    source: int
    target: int
    pose: PoseGaussian
    closure: bool
    replaced_arc: Arc | None
    joined_keyframes: tuple[int, ...]
    observing_keyframes: frozenset[int]

    @property
    def pair(self) -> AreaPair:
        """The arc, whatever its direction."""
        return area_pair(self.source, self.target)

    def to_closure(self, log_odds: float, snapshot: MapSnapshot) -> Closure:
        """The closure that it becomes."""
        far = self.target if self.near == self.source else self.source
        pose = self.pose if self.near == self.source else self.pose.inverse()
        return Closure((self.event, self.pair), self.near, far, pose, log_odds, snapshot)


def pending_arc(arc: Arc, leaf: Hypothesis, event: int, near: int, hybrid_map: HybridMap) -> PendingArc:
    """What TLCA keeps of a leaf's arc.

    :param near: the robot's area before the event.
    :param hybrid_map: of the leaf's parent.
    """
    inwards = arc.target == leaf.area
    source, target, pose = (
        (arc.source, arc.target, arc.pose) if inwards else (arc.target, arc.source, arc.pose.inverse())
    )
    value, before = hybrid_map.arc_value(source, target), hybrid_map.arc(source, target)
    old = None if value is None or before is None else Arc(source, target, before, value.closure)
    joined = tuple(sorted(r.keyframe for r in leaf.moved_keyframes if r.area == target))
    witnesses = frozenset(joined or [event])
    return PendingArc(event, near, source, target, pose, arc.closure, old, joined, witnesses)


KeyframeScans: TypeAlias = Mapping[int, Scan]
ArcKeyframes: TypeAlias = dict[AreaPair, frozenset[int]]


@dataclass(frozen=True, eq=False)
class AcceptanceResult:
    """What became definite.

    :ivar arcs: those observed, and those around the areas that closures joined.
    :ivar moved_keyframes: the keyframes that moved.
    :ivar arc_keyframes: {arc: the keyframes by which it was observed}, of all definite arcs.
    :ivar arcs_before: the arcs around the areas that closures joined as they were before these were refined.
    """

    arcs: dict[AreaPair, Arc]
    moved_keyframes: list[MovedKeyframe]
    arc_keyframes: ArcKeyframes
    arcs_before: dict[AreaPair, ArcValue]


class Acceptance:
    """Closures are finely aligned, arcs that were traveled before are fused with what was known of them, and the
    areas refined that closures joined.
    """

    def __init__(self, configuration: Configuration) -> None:
        self._options = configuration.tlca
        self._alignment = AreaAlignment(configuration)
        self._refinement = ClosureRefinement(configuration)

    def accept(
        self,
        hybrid_map: HybridMap,
        scans: KeyframeScans,
        pending_arcs: Iterable[PendingArc],
        arc_keyframes: Mapping[AreaPair, frozenset[int]],
        closed_areas: Collection[int],
    ) -> AcceptanceResult:
        """What becomes of a path that is accepted, changing its map.

        :param scans: of all keyframes.
        :param pending_arcs: that wait for it, in order.
        :param arc_keyframes: {arc: the keyframes by which it was observed}, of the arcs that are definite already.
        :param closed_areas: the areas that closures joined.
        """
        arcs: dict[AreaPair, Arc] = {}
        relabelled: list[MovedKeyframe] = []
        before: dict[AreaPair, ArcValue] = {}
        observed = dict(arc_keyframes)
        for seen in pending_arcs:
            aligned, moved = self._align(hybrid_map, scans, seen)
            relabelled += moved
            old = arcs.get(seen.pair, seen.replaced_arc)
            arcs[seen.pair] = self._fuse_arc(aligned, old, observed.get(seen.pair, frozenset()))
            observed[seen.pair] = observed.get(seen.pair, frozenset()) | seen.observing_keyframes
        if closed_areas:
            relabelled, before = self._refine_closed_areas(hybrid_map, scans, closed_areas, arcs, relabelled)
        return AcceptanceResult(arcs, relabelled, observed, before)

    def _refine_closed_areas(
        self,
        hybrid_map: HybridMap,
        scans: KeyframeScans,
        closed: Collection[int],
        arcs: dict[AreaPair, Arc],
        relabelled: list[MovedKeyframe],
    ) -> tuple[list[MovedKeyframe], dict[AreaPair, ArcValue]]:
        """Refine the areas that closures joined; the arcs around them follow.

        Returns the keyframes that moved, and the arcs as they were before.
        """
        for arc in arcs.values():
            hybrid_map.set_arc(arc.source, arc.target, arc.pose, closure=arc.closure)
        found = self._refinement.refine(hybrid_map, scans, closed)
        before = {(a, b): value for a, b, value in hybrid_map.all_arcs() if (a, b) in found.arcs}
        for (a, b), value in before.items():
            arcs[a, b] = Arc(a, b, self._apply_sigma_floor(found.arcs[a, b]), value.closure)
        moved = {
            keyframe: MovedKeyframe(keyframe, area, area, pose)
            for area, keyframes in found.keyframes.items()
            for keyframe, pose in keyframes.items()
        }
        return list(({r.keyframe: r for r in relabelled} | moved).values()), before

    def _align(
        self, hybrid_map: HybridMap, scans: KeyframeScans, seen: PendingArc
    ) -> tuple[PendingArc, list[MovedKeyframe]]:
        """A closure that was found by matching areas, finely aligned."""
        if not seen.closure:
            return seen, []
        if seen.joined_keyframes:
            return self._align_joined_keyframes(hybrid_map, scans, seen)
        return self._align_areas(hybrid_map, scans, seen), []

    def _align_joined_keyframes(
        self, hybrid_map: HybridMap, scans: KeyframeScans, seen: PendingArc
    ) -> tuple[PendingArc, list[MovedKeyframe]]:
        """The keyframes that joined a known area, moved to where their scans fit the area's own, and the arc likewise.

        Keyframes that the robot stored in the area since then are on neither side: they were matched against both.
        """
        placed = hybrid_map.keyframes(seen.target)
        joined = [keyframe for keyframe in seen.joined_keyframes if keyframe in placed]
        known = [keyframe for keyframe in placed if keyframe < seen.joined_keyframes[0]]
        motion = self._alignment.align(
            [(scans[keyframe], placed[keyframe]) for keyframe in known],
            [(scans[keyframe], placed[keyframe]) for keyframe in joined],
            PoseGaussian(np.zeros(3), seen.pose.covariance),
        )
        if motion is None:
            return seen, []
        moved = [
            MovedKeyframe(keyframe, seen.target, seen.target, se2.compose(motion.mean, placed[keyframe]))
            for keyframe in joined
        ]
        for r in moved:
            hybrid_map.set_keyframe(r.keyframe, r.area, r.pose)
        return replace(seen, pose=PoseGaussian.from_pose(seen.pose.mean).compose(motion.inverse())), moved

    def _align_areas(self, hybrid_map: HybridMap, scans: KeyframeScans, seen: PendingArc) -> PendingArc:
        """An arc between areas that keep their keyframes, as the scans of both measure it."""
        known, others = (
            [(scans[keyframe], pose) for keyframe, pose in hybrid_map.keyframes(area).items()]
            for area in (seen.source, seen.target)
        )
        found = self._alignment.align(known, others, seen.pose)
        return seen if found is None else replace(seen, pose=found)

    def _fuse_arc(self, seen: PendingArc, old: Arc | None, witnesses: frozenset[int]) -> Arc:
        """The definite arc from an observation and what was known before, which tells whether it closed a loop."""
        belief, closure = seen.pose, seen.closure
        if old is not None and not is_uninformative(old.pose):
            shared = len(seen.observing_keyframes & witnesses) / len(seen.observing_keyframes)
            known = old.pose if old.source == seen.source else old.pose.inverse()
            belief, closure = fuse_traversals(known, belief, shared), old.closure
        return Arc(seen.source, seen.target, self._apply_sigma_floor(belief), closure)

    def _apply_sigma_floor(self, belief: PoseGaussian) -> PoseGaussian:
        return apply_sigma_floor(belief, self._options.arc_sigma_floor, math.radians(self._options.arc_angle_floor))
