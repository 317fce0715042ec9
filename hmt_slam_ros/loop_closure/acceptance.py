"""Acceptance of a path: its pending arcs become definite, and keyframes move to where their scans match."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate, fuse, match_moments
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

PlacedScan: TypeAlias = tuple[Scan, Float64]
KeyframeScans: TypeAlias = Mapping[int, Scan]
ArcKeyframes: TypeAlias = dict[AreaPair, frozenset[int]]


_HELD_INFORMATION = 1e8
"""Information along a direction that is held, 1 / m^2: a tenth of a millimeter."""


class AreaAlignment:
    """Aligns several scans as one rigid body with several others.

    First a global search covers all poses that the closure's covariance admits, since a local one would end at the next
    similar structure. From its best pose, Gauss-Newton steps on the distance field of the map with Cauchy weights go
    below the width of the search's cells. Along a direction in which the search finds no position to a cell, its mean
    counts as it compares with the belief by which the scans were placed. There the steps would follow the noise of the
    normals, and are left out (solution remapping, Zhang et al. 2016; docs/decisions/0072-open-directions.md).
    """

    def __init__(self, configuration: Configuration) -> None:
        self._model = GridModel.from_configuration(configuration)
        self._settings = MatchSettings.from_options(configuration.tsbi)
        self._inflation = configuration.tlca.alignment_inflation
        self._mapping = LocalMapping(configuration)
        self._alignment = self._mapping.alignment._replace(inflation=1.0 / configuration.matching.temper)
        self._gate = chi_square_gate(configuration.tsbi.gate_probability)

    def align(
        self,
        known: Sequence[PlacedScan],
        joined: Sequence[PlacedScan],
        closure: PoseGaussian,
        replaced: PoseGaussian | None = None,
    ) -> PoseGaussian | None:
        """The belief over ``known_T_joined`` by the scans, as the moments of all modes.

        :param known: (scan, ``known_T_base``) of the keyframes that the area held before.
        :param joined: (scan, ``joined_T_base``) of those that joined it.
        :param closure: belief over ``known_T_joined`` by TSBI, which also matched the surroundings.
        :param replaced: the same of before, None for a new loop.
        :returns: None if the scans determine the pose no better than the closure did.
        """
        modes = match_areas(self._build_grid(joined), self._build_grid(known), closure, self._settings).modes
        matched = match_moments([(mode.measured, mode.log_mass) for mode in modes]) if modes else closure
        if np.linalg.det(matched.covariance) >= np.linalg.det(closure.covariance):
            return None
        placed = closure if replaced is None else fuse([PoseGaussian(closure.mean, replaced.covariance), closure])
        middle = np.mean([pose[:2] for _, pose in joined], axis=0)
        open_directions = self._open_directions(matched, middle)
        matched = _weigh_position(matched, PoseGaussian(closure.mean, placed.covariance), middle, open_directions)
        table = self._mapping.pool.empty_table()
        for scan, pose in known:
            self._mapping.insert_scan(table[None], pose[None], scan)
        surfels = [
            transform_surfels(se2.compose(matched.mean, pose), self._mapping.matching_surfels(scan))
            for scan, pose in joined
        ]
        view, place = self._mapping.pool.view(table), se2.transform(matched.mean, middle[None])[0]
        offset = self._refine_offset(
            np.concatenate(surfels), closure, matched, view, _held_information(open_directions, place)
        )
        self._mapping.pool.release(table)
        covariance = min(self._inflation * matched.covariance, closure.covariance, key=np.linalg.det)
        return PoseGaussian(se2.compose(offset, matched.mean), covariance)

    def _build_grid(self, scans: Sequence[PlacedScan]) -> AreaGrid:
        poses = np.array([pose for _, pose in scans]).reshape(-1, 3)
        return build_area_grid([scan for scan, _ in scans], poses, self._model)

    def _open_directions(self, matched: PoseGaussian, middle: Float64) -> Float64:
        """Unit vectors, shape (k, 2), known area's frame, along which a match leaves the middle of the scans open.

        :param middle: in the frame of the scans, shape (2,), m.
        """
        at_middle = matched.compose(PoseGaussian.from_pose(np.array([*middle, 0.0])))
        values, vectors = np.linalg.eigh(at_middle.covariance[:2, :2])
        heading = np.array([0.0, 0.0, at_middle.mean[2]])
        return se2.transform(heading, vectors.T[values > self._model.cell**2])

    def _refine_offset(
        self, points: Float64, closure: PoseGaussian, matched: PoseGaussian, view: GridView, held: Float64
    ) -> Float64:
        """The motion in the area's frame, shape (3,), that improves the match, or none if it leaves its gate.

        :param held: information (3, 3) by which open directions are held; the closure holds what walls show little of.
        """
        closure_information, matched_information = (
            np.linalg.inv(belief.inverse().covariance) for belief in (closure, matched)
        )
        no_motion = np.zeros(3)
        prior = scan_to_map.Prior(no_motion, (closure_information + held).astype(np.float64, copy=False))
        offset, _ = scan_to_map.align(points, no_motion, prior, view, self._alignment)
        return offset if offset @ matched_information @ offset <= self._gate else no_motion


def _weigh_position(matched: PoseGaussian, placed: PoseGaussian, middle: Float64, directions: Float64) -> PoseGaussian:
    """A match whose middle is between its own place and that before, by their variances, along some directions.

    :param directions: unit vectors, shape (k, 2).
    """
    at_middle = PoseGaussian.from_pose(np.array([*middle, 0.0]))
    before, after = placed.compose(at_middle), matched.compose(at_middle)
    mean = matched.mean.copy()
    for direction in directions:
        variances = [_variance_along(direction, belief) for belief in (before, after)]
        off = float(direction @ (before.mean - after.mean)[:2])
        mean[:2] += direction * off * variances[1] / (variances[0] + variances[1])
    return PoseGaussian(mean, matched.covariance)


def _variance_along(direction: Float64, belief: PoseGaussian) -> float:
    """Variance of a position along a unit vector (2,), m^2."""
    own = se2.transform(np.array([0.0, 0.0, -belief.mean[2]]), direction[None])[0]
    return float(own @ belief.covariance[:2, :2] @ own)


def _held_information(directions: Float64, place: Float64) -> Float64:
    """The information of a motion, shape (3, 3), that holds a place along unit vectors (k, 2).

    :param place: shape (2,), m.
    """
    rows = np.column_stack((directions, directions @ np.array([-place[1], place[0]])))
    return _HELD_INFORMATION * rows.T @ rows


@dataclass(frozen=True, eq=False)
class PendingArc:
    """An arc that TSBI set and that is not definite yet.

    :ivar event: at which it was observed.
    :ivar near: the robot's area before that event, or the source of an arc that is not of the robot's area.
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
        is_from_source = self.near == self.source
        far, pose = (self.target, self.pose) if is_from_source else (self.source, self.pose.inverse())
        return Closure((self.event, self.pair), self.near, far, pose, log_odds, snapshot)


def pending_arc(arc: Arc, hypothesis: Hypothesis, event: int, near: int, hybrid_map: HybridMap) -> PendingArc:
    """The pending arc of an arc that a hypothesis set.

    :param near: the robot's area before the event.
    :param hybrid_map: of the hypothesis's parent.
    """
    source, target, pose = arc.source, arc.target, arc.pose
    if target != hypothesis.area:
        source, target, pose = target, source, pose.inverse()
    value, before = hybrid_map.arc_value(source, target), hybrid_map.arc(source, target)
    replaced = None if value is None or before is None else Arc(source, target, before, value.closure)
    joined = tuple(sorted(moved.keyframe for moved in hypothesis.moved_keyframes if moved.area == target))
    near = near if near in (source, target) else arc.source
    return PendingArc(event, near, source, target, pose, arc.closure, replaced, joined, frozenset(joined or [event]))


def _replaced_pose(pending: PendingArc) -> PoseGaussian | None:
    """The belief of the arc that one replaces, None where that one was uninformative."""
    replaced = pending.replaced_arc
    return None if replaced is None or is_uninformative(replaced.pose) else replaced.pose


@dataclass(frozen=True, eq=False)
class AcceptanceResult:
    """What became definite.

    :ivar arcs: those observed, and those around the areas that closures joined.
    :ivar moved_keyframes: the keyframes that moved.
    :ivar arc_keyframes: {arc: the keyframes by which it was observed}, of all definite arcs.
    :ivar arcs_before: the arcs around the areas that closures joined, before these were refined.
    """

    arcs: dict[AreaPair, Arc]
    moved_keyframes: list[MovedKeyframe]
    arc_keyframes: ArcKeyframes
    arcs_before: dict[AreaPair, ArcValue]


class Acceptance:
    """Aligns closures, fuses arcs with earlier traversals, and refines the areas that closures joined."""

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
        """The result of accepting a path; changes its map.

        :param scans: of all keyframes.
        :param pending_arcs: of the path, in order.
        :param arc_keyframes: {arc: the keyframes by which it was observed}, of the definite arcs.
        :param closed_areas: the areas that closures joined.
        """
        arcs: dict[AreaPair, Arc] = {}
        moved: list[MovedKeyframe] = []
        arcs_before: dict[AreaPair, ArcValue] = {}
        observers = dict(arc_keyframes)
        for pending in pending_arcs:
            aligned, aligned_keyframes = self._align(hybrid_map, scans, pending)
            moved += aligned_keyframes
            old, old_observers = arcs.get(pending.pair, pending.replaced_arc), observers.get(pending.pair, frozenset())
            arcs[pending.pair] = self._fuse_arc(aligned, old, old_observers)
            observers[pending.pair] = old_observers | pending.observing_keyframes
        if closed_areas:
            moved, arcs_before = self._refine_closed_areas(hybrid_map, scans, closed_areas, arcs, moved)
        return AcceptanceResult(arcs, moved, observers, arcs_before)

    def _refine_closed_areas(
        self,
        hybrid_map: HybridMap,
        scans: KeyframeScans,
        closed_areas: Collection[int],
        arcs: dict[AreaPair, Arc],
        moved: list[MovedKeyframe],
    ) -> tuple[list[MovedKeyframe], dict[AreaPair, ArcValue]]:
        """All moved keyframes after the refinement, and the arcs around the areas before it; updates ``arcs``."""
        for arc in arcs.values():
            hybrid_map.set_arc(arc.source, arc.target, arc.pose, closure=arc.closure)
        refined = self._refinement.refine(hybrid_map, scans, closed_areas)
        arcs_before = {(a, b): value for a, b, value in hybrid_map.all_arcs() if (a, b) in refined.arcs}
        for (a, b), value in arcs_before.items():
            arcs[a, b] = Arc(a, b, self._apply_sigma_floor(refined.arcs[a, b]), value.closure)
        moved_by_keyframe = {one.keyframe: one for one in moved} | {
            keyframe: MovedKeyframe(keyframe, area, area, pose)
            for area, keyframes in refined.keyframes.items()
            for keyframe, pose in keyframes.items()
        }
        return list(moved_by_keyframe.values()), arcs_before

    def _align(
        self, hybrid_map: HybridMap, scans: KeyframeScans, pending: PendingArc
    ) -> tuple[PendingArc, list[MovedKeyframe]]:
        """A closure with its aligned pose, and the keyframes that move with it; other arcs as they are."""
        if not pending.closure:
            return pending, []
        if pending.joined_keyframes:
            return self._align_joined_keyframes(hybrid_map, scans, pending)
        return self._align_areas(hybrid_map, scans, pending), []

    def _align_joined_keyframes(
        self, hybrid_map: HybridMap, scans: KeyframeScans, pending: PendingArc
    ) -> tuple[PendingArc, list[MovedKeyframe]]:
        """The arc and the keyframes that joined a known area, aligned with the area's own keyframes.

        Keyframes stored in the area since then are on neither side, as they were matched against both.
        """
        poses = hybrid_map.keyframes(pending.target)
        joined = [keyframe for keyframe in pending.joined_keyframes if keyframe in poses]
        known = [keyframe for keyframe in poses if keyframe < pending.joined_keyframes[0]]
        motion = self._alignment.align(
            [(scans[keyframe], poses[keyframe]) for keyframe in known],
            [(scans[keyframe], poses[keyframe]) for keyframe in joined],
            PoseGaussian(np.zeros(3), pending.pose.covariance),
            _replaced_pose(pending),
        )
        if motion is None:
            return pending, []
        moved = [
            MovedKeyframe(keyframe, pending.target, pending.target, se2.compose(motion.mean, poses[keyframe]))
            for keyframe in joined
        ]
        for keyframe in moved:
            hybrid_map.set_keyframe(keyframe.keyframe, keyframe.area, keyframe.pose)
        return replace(pending, pose=PoseGaussian.from_pose(pending.pose.mean).compose(motion.inverse())), moved

    def _align_areas(self, hybrid_map: HybridMap, scans: KeyframeScans, pending: PendingArc) -> PendingArc:
        """An arc between areas that keep their keyframes, as the scans of both measure it."""
        source_scans, target_scans = (
            [(scans[keyframe], pose) for keyframe, pose in hybrid_map.keyframes(area).items()]
            for area in (pending.source, pending.target)
        )
        aligned = self._alignment.align(source_scans, target_scans, pending.pose, _replaced_pose(pending))
        return pending if aligned is None else replace(pending, pose=aligned)

    def _fuse_arc(self, pending: PendingArc, old: Arc | None, observers: frozenset[int]) -> Arc:
        """The definite arc from a new observation and the old arc, which decides whether it closed a loop.

        An uninformative one replaces the old arc.

        :param observers: the keyframes by which the old arc was observed.
        """
        belief, closure = pending.pose, pending.closure
        if old is not None and not is_uninformative(old.pose) and not is_uninformative(belief):
            shared = len(pending.observing_keyframes & observers) / len(pending.observing_keyframes)
            known = old.pose if old.source == pending.source else old.pose.inverse()
            belief, closure = fuse_traversals(known, belief, shared), old.closure
        return Arc(pending.source, pending.target, self._apply_sigma_floor(belief), closure)

    def _apply_sigma_floor(self, belief: PoseGaussian) -> PoseGaussian:
        return apply_sigma_floor(belief, self._options.arc_sigma_floor, math.radians(self._options.arc_angle_floor))
