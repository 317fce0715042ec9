"""The children of a hypothesis: Eq. (6), summed over the areas gamma that its newest keyframes may lie in.

Every scan counts once. Metric SLAM compares it with the submap. Here the surfaces of several keyframes are compared
with known areas outside the submap: the submap's areas are left out of the candidates' grids, and no keyframe is
compared with an area twice.
"""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import (
    connected_neighbors,
    informative_arc,
    shortest_path_beliefs,
    uninformative_belief,
)
from hmt_slam_ros.hybrid_map.surroundings import keyframe_positions, min_distance
from hmt_slam_ros.messages.map_changes import Arc, MovedKeyframe
from hmt_slam_ros.messages.replica import FIRST_AREA, Replica
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.relative_motion import is_wide
from hmt_slam_ros.topological_inference.area_comparison import (
    AreaComparison,
    ComparisonKind,
    Fit,
    OngoingComparison,
)
from hmt_slam_ros.topological_inference.branches import Branches, Child, Parent
from hmt_slam_ros.topological_inference.candidate_gating import Query
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch, SearchState
from hmt_slam_ros.topological_inference.global_localization import GlobalSearch, LandmarkEvidence, PoseHint
from hmt_slam_ros.topological_inference.hypothesis_tree import (
    Lost,
    PoseInArea,
    Tracking,
    relative_covariance,
)
from hmt_slam_ros.topological_inference.kidnapping_prior import KidnappingPriors
from hmt_slam_ros.topological_inference.pose_distribution import PoseDistribution

MIN_PROPOSAL_PROBABILITY = 0.5
"""Smallest probability of a hypothesis for which landmarks propose loops."""

MIN_EXAMINED_AREAS = 4
"""Known areas that every hypothesis may examine at a cut, however improbable it is.

From docs/decisions/0021-bounded-cost-of-a-cut.md.
"""

_PROMISED_PROBABILITY = 0.8
"""Probability of a known place by the arcs, from which keyframes that fit nothing there make the arcs suspected.

From docs/decisions/0055-suspected-arcs.md.
"""

_ARC_FAULT_PROBABILITY = 0.01
"""Prior probability that the arcs to a promised place are wrong (docs/decisions/0055-suspected-arcs.md)."""

_UNCONFIRMED_INFLATION = 100.0
"""Factor on the covariance of an arc along other arcs that no match confirms: it adds next to nothing to those."""


_MAX_LOCAL_MAP_SHARE = 0.5
"""Share of the half side of the local map within which keyframes wait for their comparison: beyond it nothing is kept.

A laser sees farther than the robot is. From docs/decisions/0063-cut-before-the-end-of-the-map.md.
"""


@dataclass(frozen=True)
class BranchingState:
    """What branching remembers beside the maps of the hypotheses.

    :ivar largest_area: the largest number that an area was given.
    :ivar search: what the closure search learned.
    :ivar unstored_scans: {keyframe event: scan} of scans that no map holds and that may still be matched.
    """

    largest_area: int = FIRST_AREA
    search: SearchState = field(default_factory=SearchState)
    unstored_scans: Mapping[int, Scan] = field(default_factory=dict)


class Branching:
    """Creates the children of hypotheses, and numbers new areas.

    :ivar search: finds and compares known areas.
    :ivar landmarks: their evidence on places and loops, where the configuration asks for it.
    :ivar unstored_scans: {keyframe event: scan} of scans that no map holds and that may still be matched.
    :ivar options: parameters of the inference.
    :ivar kidnapping_priors: of a kidnapping before a keyframe event.
    """

    def __init__(
        self,
        configuration: Configuration,
        replica: Replica,
        landmarks: Callable[[Configuration, Mapping[int, Scan]], LandmarkEvidence | None] | None = None,
    ) -> None:
        """:param landmarks: makes the evidence of landmarks for the scans of keyframes.

        :raises HmtSlamError: where the configuration asks for that and nothing makes it.
        """
        if landmarks is None and (configuration.places.prior or configuration.places.loops):
            raise HmtSlamError("places.prior and places.loops need landmarks: give them to topological inference")
        self.unstored_scans: dict[int, Scan] = {}
        scans = ChainMap(self.unstored_scans, replica.scans)
        self.search = ClosureSearch(configuration, scans)
        self.landmarks = None if landmarks is None else landmarks(configuration, scans)
        self.options = configuration.tsbi
        self.kidnapping_priors = KidnappingPriors.from_configuration(configuration)
        self._filter = configuration.filter
        self._local_map_extent = configuration.local_map.extent
        self._replica = replica
        sigma, angle = configuration.tlca.arc_sigma_floor, math.radians(configuration.tlca.arc_angle_floor)
        self._covariance_floor = np.diag([sigma**2, sigma**2, angle**2])
        self._largest_area = FIRST_AREA
        self._new_areas: dict[tuple[int, ...], int] = {}

    @property
    def state(self) -> BranchingState:
        """What is remembered between two events."""
        return BranchingState(self._largest_area, self.search.state, dict(self.unstored_scans))

    def restore(self, state: BranchingState) -> None:
        """Start from a saved state."""
        self._largest_area = state.largest_area
        self.search.restore(state.search)
        self.unstored_scans.update(state.unstored_scans)

    def localize_globally(
        self, parent: Parent, search: GlobalSearch, pose_hint: PoseHint | None = None
    ) -> PoseDistribution:
        """The distribution of the keyframes' pose in the whole map, as far as it was searched.

        Landmarks count from the second search with a candidate on, since one search alone localizes nobody.

        :param pose_hint: of the reference.
        """
        distribution = self.search.localize_globally(parent.hybrid_map, search, parent.clutter, pose_hint)
        lost = parent.state.localization
        if self.landmarks is None or not isinstance(lost, Lost) or lost.candidate is None:
            return distribution
        return self.landmarks.weigh(distribution, parent.hybrid_map, search.poses, search.before)

    def look_ahead(self, parents: Sequence[Parent]) -> None:
        """Prepare the next search, at an event without one."""
        localizations = [(parent.hybrid_map, parent.state.localization) for parent in parents]
        lost_maps = [(hybrid_map, lost.since) for hybrid_map, lost in localizations if isinstance(lost, Lost)]
        self.search.look_ahead(max(parents, key=lambda parent: parent.log_weight).hybrid_map)
        if lost_maps and self.landmarks is not None:
            self.landmarks.prepare_places(lost_maps)

    def end_global_localization(self) -> None:
        """Free what served global localization."""
        self.search.end_global_localization()
        if self.landmarks is not None:
            self.landmarks.on_localized()

    def forget_scans(self) -> None:
        """Drop what was computed from scans, of which some have changed."""
        self.search.forget_scans()
        if self.landmarks is not None:
            self.landmarks.forget_scans()

    def keep_scans(self, event: int, scan: Scan, wanted: Collection[int]) -> None:
        """Keep the scans of the wanted keyframe events, the newest event's among them, and drop others."""
        for unwanted in self.unstored_scans.keys() - set(wanted):
            del self.unstored_scans[unwanted]
        if event in wanted:
            self.unstored_scans[event] = scan

    def begin_event(self) -> None:
        """Begin an event, in which hypotheses share its work, and the numbers of new areas with the same keyframes."""
        self._new_areas = {}
        self.search.work.begin_event()

    def reweight_by_known_ground(self, parent: Parent, pose: Float64, points: Float64, keyframe: int) -> Parent:
        """The hypothesis with the evidence of the newest scan for the known ground around it.

        :param points: the scan's surface points, shape (n, 2), m, base frame.
        :param pose: ``area_T_base`` of the scan.
        :param keyframe: its number.
        """
        poses = {parent.area: np.zeros(3), **parent.local_area_poses()}
        log_ratio = self.search.known_ground_log_ratio(parent.hybrid_map, poses, points, pose, keyframe)
        return replace(parent, log_weight=parent.log_weight + log_ratio)

    def cut(self, parent: Parent, keyframes: Sequence[int]) -> Branches:
        """Branch over a new area and every known area that the arcs admit, with one child per mode.

        Where the keyframes lie in the place of an area of the submap there is one child: the robot is tracked there.
        Until the comparison with known areas ends nothing is cut: area abstraction repeats the cut. But where the arcs
        are too wide for one area, or the robot comes to the end of its local map, the keyframes begin a new area at
        once, and are compared there.
        """
        query, ongoing = self.query(parent, keyframes), parent.state.comparison
        if is_wide(query.belief.covariance, self._filter):
            found = self._compare_cut(parent, query, {parent.area})
            if isinstance(found, OngoingComparison):
                return Branches([self._enter_meanwhile(parent, query, found)])
            return self._branch_at_cut(parent, query, found)
        is_far = self._is_far_from_origin(parent, keyframes)
        if ongoing is not None and is_far and not _belongs_to_cut(ongoing, keyframes):
            ongoing = None  # of keyframes that stay behind
        if ongoing is None:
            local_areas = parent.local_area_poses()
            tracked = self.search.tracked_area(parent.hybrid_map, parent.area, local_areas, query.poses_in_area)
            if tracked is not None:
                return Branches([self._enter_tracked(parent, query, tracked)])
            found = self._compare_cut(parent, query, {parent.area, *local_areas})
        elif _belongs_to_cut(ongoing, keyframes):
            found = self.search.continue_comparison(parent.hybrid_map, ongoing)
            query = self.query(parent, keyframes, next(iter(ongoing.query.poses)))
        else:
            return self.continue_comparison(parent, ongoing)
        if isinstance(found, OngoingComparison):
            return Branches([self._enter_meanwhile(parent, query, found) if is_far else self._wait(parent, found)])
        return self._branch_at_cut(parent, query, found)

    def _is_far_from_origin(self, parent: Parent, keyframes: Sequence[int]) -> bool:
        """Whether the newest of some keyframes is halfway to the end of the local map or beyond."""
        x, y, _ = parent.hybrid_map.keyframes(parent.area)[max(keyframes)]
        return math.hypot(x, y) > _MAX_LOCAL_MAP_SHARE * self._local_map_extent

    def _compare_cut(
        self, parent: Parent, query: Query, excluded: Collection[int]
    ) -> OngoingComparison | AreaComparison:
        """The comparison of the keyframes that leave the robot's area, after its first event."""
        if self.landmarks is not None and parent.probability >= MIN_PROPOSAL_PROBABILITY:
            parent = replace(parent, hybrid_map=self.landmarks.propose_loop(parent.hybrid_map, parent.area))
        comparison = self._begin_comparison(parent, query, excluded, "cut")
        return self.search.continue_comparison(parent.hybrid_map, comparison)

    def _branch_at_cut(self, parent: Parent, query: Query, found: AreaComparison) -> Branches:
        """The children of a cut after the comparison."""
        compared = parent.state.matched_keyframes
        state = parent.state.after_matching(found.examined_areas, list(query.poses), found.pending_candidates)
        parent = replace(parent, state=state)
        children = [self._enter_new(parent, query, math.log(found.new_probability(compared)))]
        children += [self._enter_known(parent, query, fit) for fit in found.fits]
        children += self._suspect_arcs(parent, query, found, compared)
        return Branches(children, True, _log(found.skipped_weight) + parent.log_weight)

    def recheck(self, parent: Parent, only: Collection[int] = ()) -> Branches:
        """Branch over no change and a further arc from the robot's area to a known one; no keyframe changes its area.

        :param only: the only areas to examine, beside which keyframes fitted; all if empty.
        """
        newest = sorted(parent.state.covariances)[-self.options.recheck_keyframes :]
        own = parent.hybrid_map.keyframes(parent.area)
        keyframes = [k for k in (newest if only else parent.state.unmatched_keyframes) if k in own]
        query = self.query(parent, keyframes)
        if self.landmarks is not None and parent.probability >= MIN_PROPOSAL_PROBABILITY:
            self.landmarks.prepare_loops(parent.hybrid_map, parent.area)
        kind: ComparisonKind = "retry" if only else "recheck"
        if kind == "recheck":
            # Without those that the area lost.
            parent = replace(parent, state=replace(parent.state, unmatched_keyframes=tuple(keyframes)))
        comparison = self._begin_comparison(parent, query, self._joined_areas(parent), kind, only)
        return self.continue_comparison(parent, comparison)

    def continue_comparison(self, parent: Parent, comparison: OngoingComparison) -> Branches:
        """Branch over no change and further arcs from the robot's area, as soon as the comparison has ended."""
        found = self.search.continue_comparison(parent.hybrid_map, comparison)
        if isinstance(found, OngoingComparison):
            return Branches([self._wait(parent, found)])
        is_retry, keyframes = comparison.kind == "retry", list(comparison.query.poses)
        compared = parent.state.matched_keyframes
        state = parent.state.after_matching(
            found.examined_areas, keyframes, found.pending_candidates, all_areas=not is_retry
        )
        parent = replace(parent, state=state)
        # Another event may have joined an area meanwhile.
        joined = self._joined_areas(parent)
        fits = [fit for fit in found.fits if fit.area not in joined]
        # The probability that they are in no place counted when they fitted beside it.
        log_new = 0.0 if is_retry and not fits else math.log(found.new_probability(compared))
        stay = replace(parent.unchanged_child(), log_weight=parent.log_weight + log_new)
        children = [stay, *(self._join(parent, comparison.query, fit) for fit in fits)]
        children += self._suspect_arcs(parent, comparison.query, found, compared)
        return Branches(children, True, _log(found.skipped_weight) + parent.log_weight)

    @staticmethod
    def _wait(parent: Parent, comparison: OngoingComparison) -> Child:
        """The only child while a comparison goes on."""
        return parent.unchanged_child(replace(parent.state, comparison=comparison))

    def _enter_meanwhile(self, parent: Parent, query: Query, comparison: OngoingComparison) -> Child:
        """The only child, in a new area of the keyframes ``query``, while the comparison of some of them goes on."""
        child = self._enter_new(parent, query, 0.0)
        reference = next(iter(comparison.query.poses))
        belief = PoseGaussian(np.zeros(3), child.state.covariances[reference] + self._covariance_floor)
        comparison = replace(comparison, query=Query(belief, comparison.query.poses), kind="recheck")
        return replace(child, state=replace(child.state, comparison=comparison))

    def _joined_areas(self, parent: Parent) -> set[int]:
        """The robot's area and those that are joined to it."""
        return {parent.area, *parent.local_area_poses(), *self._certain_neighbors(parent)}

    def _certain_neighbors(self, parent: Parent) -> set[int]:
        """The areas that an arc joins to the robot's, but none that is too wide for one submap."""
        neighbors = connected_neighbors(parent.hybrid_map, parent.area)
        arcs = {area: informative_arc(parent.hybrid_map, parent.area, area) for area in neighbors}
        return {area for area, arc in arcs.items() if arc is None or not is_wide(arc.covariance, self._filter)}

    def _begin_comparison(
        self,
        parent: Parent,
        query: Query,
        excluded: Collection[int],
        kind: ComparisonKind,
        only: Collection[int] = (),
    ) -> OngoingComparison:
        """The comparison with known areas, more of them the more probable the hypothesis is."""
        excluded = {*excluded, *_searched_areas(parent)}
        most = min(
            self.options.max_candidates,
            max(MIN_EXAMINED_AREAS, math.ceil(self.options.max_comparisons * parent.probability)),
        )
        return self.search.begin_comparison(
            parent.hybrid_map, parent.area, query, parent.state.matched_keyframes, excluded, most, kind, only
        )

    def move(self, parent: Parent, area: int) -> Branches:
        """The robot in a known area; the keyframes stay where they are."""
        child = Child(
            parent.hypothesis,
            parent.log_weight,
            area,
            parent.state.after_area_change({}),
            frame_change=self._belief(parent, area).inverse(),
            reload_local_map=True,
        )
        return Branches([child])

    def find_unlinked_overlap(self, parent: Parent, pose: Float64) -> int | None:
        """The area of the submap in whose place the robot is, where no arc joins it to the robot's area.

        Area abstraction only follows arcs and would not notice.

        :param pose: ``area_T_base``.
        """
        linked = connected_neighbors(parent.hybrid_map, parent.area)
        around = {area: other for area, other in parent.local_area_poses().items() if area not in linked}
        found = self.search.tracked_area(parent.hybrid_map, parent.area, around, pose[None])
        if found is None:
            return None
        own = keyframe_positions(parent.hybrid_map, parent.area)
        other = keyframe_positions(parent.hybrid_map, found, around[found])
        return found if min_distance(pose[None, :2], other) < min_distance(pose[None, :2], own) else None

    def link(self, parent: Parent, area: int, scan: Scan, pose: PoseGaussian) -> Branches:
        """Join the robot's area to one in which it is tracked by the arc that the newest scan measures.

        :param pose: belief over ``area_T_base`` of the scan, in the robot's area.
        """
        belief = self._belief(parent, area)
        prior = belief.inverse().compose(PoseGaussian(pose.mean, pose.covariance + self._covariance_floor))
        measured = self.search.measure_pose(parent.hybrid_map, area, parent.area, scan, prior)
        child = parent.unchanged_child(parent.state.after_overlap(None))
        if measured is not None:
            arc = Arc(parent.area, area, pose.compose(measured.inverse()), closure=True)
            child = replace(child, arcs=(arc,))
        return Branches([child])

    def _belief(self, parent: Parent, area: int) -> PoseGaussian:
        """The belief over ``area_T_other``, with the submap's mean, so that the robot does not jump."""
        arc = informative_arc(parent.hybrid_map, parent.area, area)
        belief = arc or shortest_path_beliefs(parent.hybrid_map, parent.area, targets=(area,))[area]
        return PoseGaussian(parent.state.local_area_poses.get(area, belief.mean), belief.covariance)

    def query(self, parent: Parent, keyframes: Sequence[int], first: int | None = None) -> Query:
        """The query of some keyframes of the robot's area.

        :param first: the reference among them; the first of them if None.
        """
        poses, first = parent.hybrid_map.keyframes(parent.area), keyframes[0] if first is None else first
        reference = poses[first]
        covariance = parent.covariance(first) + self._covariance_floor
        relative_poses = {keyframe: se2.between(reference, poses[keyframe]) for keyframe in keyframes}
        return Query(PoseGaussian(reference, covariance), relative_poses)

    def _enter_new(self, parent: Parent, query: Query, log_factor: float) -> Child:
        """New ground: the reference keyframe becomes the frame of a new area."""
        origin = PoseGaussian.from_pose(np.zeros(3))
        child = self.enter_area(parent, query, self.new_area(parent, query), origin, query.belief, log_factor)
        # Behind so wide an arc, gates admit all places, and a search of the whole map costs less than comparisons.
        is_lost = not child.state.is_lost and is_wide(query.belief.covariance, self._filter)
        return _lose(child, parent, query) if is_lost else child

    def _suspect_arcs(
        self, parent: Parent, query: Query, found: AreaComparison, compared: Collection[int]
    ) -> list[Child]:
        """The child in which the arcs are wrong, where they promise a known place and nothing fits there; or none.

        The ground of that place was mapped twice then, and the two do not agree. The robot may be anywhere.

        :param compared: areas with which earlier keyframes were compared.
        """
        own = sorted(parent.hybrid_map.keyframes(parent.area))
        keyframes = [k for k in own if k >= min(query.poses)]
        if (
            found.fits
            or found.promised_probability(compared) < _PROMISED_PROBABILITY
            or parent.state.is_lost
            or keyframes == own
        ):
            return []
        query = self.query(parent, keyframes)
        origin, arc = PoseGaussian.from_pose(np.zeros(3)), uninformative_belief(query.belief.mean)
        log_fault = math.log(_ARC_FAULT_PROBABILITY)
        child = self.enter_area(parent, query, self.new_area(parent, query), origin, arc, log_fault)
        return [_lose(child, parent, query)]

    def new_area(self, parent: Parent, query: Query) -> int:
        """The number of an area that keyframes begin, the same for all hypotheses of an event."""
        keyframes = tuple(query.poses)
        if keyframes not in self._new_areas:
            self._largest_area = max(self._largest_area, parent.hybrid_map.max_area_id) + 1
            self._new_areas[keyframes] = self._largest_area
        return self._new_areas[keyframes]

    def _enter_tracked(self, parent: Parent, query: Query, area: int) -> Child:
        """A known area in whose place the robot is tracked.

        If no arc joins the two areas, the newest of the keyframes measures a new one.
        """
        belief = self._belief(parent, area)
        entry = belief.inverse().compose(query.belief)
        is_linked = informative_arc(parent.hybrid_map, parent.area, area) is not None
        arc = None if is_linked else self._measure_arc(parent, query, area, belief)
        return self.enter_area(parent, query, area, entry, arc, 0.0)

    def _measure_arc(self, parent: Parent, query: Query, area: int, belief: PoseGaussian) -> PoseGaussian:
        newest, pose = list(query.poses.items())[-1]
        area_T_base = query.belief.compose(PoseGaussian(pose, np.zeros((3, 3))))
        scan, prior = self._replica.scans[newest], belief.inverse().compose(area_T_base)
        measured = self.search.measure_pose(parent.hybrid_map, area, parent.area, scan, prior)
        if measured is None:
            return PoseGaussian(belief.mean, _UNCONFIRMED_INFLATION * belief.covariance)
        return area_T_base.compose(measured.inverse())

    def _enter_known(self, parent: Parent, query: Query, fit: Fit) -> Child:
        """A known area, recognized."""
        arc = query.belief.compose(fit.mode.measured.inverse())
        return self.enter_area(parent, query, fit.area, fit.mode.pose, arc, fit.log_weight)

    def enter_area(
        self, parent: Parent, query: Query, area: int, entry: PoseGaussian, arc: PoseGaussian | None, log_factor: float
    ) -> Child:
        """The robot and the query's keyframes in ``area``, at ``entry`` = ``area_T_reference``.

        :param arc: belief over the pose of ``area`` in the robot's area, if there is a new one.
        :param log_factor: log of the factor on the weight.
        """
        moved = tuple(
            MovedKeyframe(keyframe, parent.area, area, se2.compose(entry.mean, pose))
            for keyframe, pose in query.poses.items()
        )
        covariances = {
            keyframe: entry.compose(self._keyframe_belief(parent, query, keyframe)).covariance
            for keyframe in query.poses
        }
        return Child(
            parent.hypothesis,
            parent.log_weight + log_factor,
            area,
            parent.state.after_area_change(covariances),
            _frame_change(query, entry, covariances),
            moved,
            () if arc is None else (_make_arc(parent, area, arc),),
            reload_local_map=True,
        )

    def _keyframe_belief(self, parent: Parent, query: Query, keyframe: int) -> PoseGaussian:
        """The belief over ``reference_T_base`` of a keyframe."""
        pose, reference = query.poses[keyframe], query.belief.covariance - self._covariance_floor
        return PoseGaussian(pose, relative_covariance(parent.covariance(keyframe), reference, pose, np.zeros((3, 3))))

    @staticmethod
    def _join(parent: Parent, query: Query, fit: Fit) -> Child:
        """The robot in its area, which an arc now joins to a known one."""
        arc = Arc(parent.area, fit.area, query.belief.compose(fit.mode.measured.inverse()), closure=True)
        log_weight = parent.log_weight + fit.log_weight
        is_found = fit.area in _searched_areas(parent)
        state = replace(parent.state, localization=Tracking()) if is_found else parent.state
        return replace(parent.unchanged_child(state), log_weight=log_weight, arcs=(arc,), reload_local_map=True)


def _belongs_to_cut(comparison: OngoingComparison, keyframes: Sequence[int]) -> bool:
    """Whether a comparison is that of a cut, whose keyframes are among these."""
    return comparison.kind == "cut" and comparison.query.poses.keys() <= set(keyframes)


def _lose(child: Child, parent: Parent, query: Query) -> Child:
    """The child, whose keyframes are searched in the map of before."""
    first = next(iter(query.poses))
    lost = Lost(first, tracked_pose=PoseInArea(parent.area, first, query.belief.mean), counted_evidence=None)
    return replace(child, state=replace(child.state, localization=lost))


def _searched_areas(parent: Parent) -> list[int]:
    """The areas from before a robot was lost, in which it is searched: they are not compared with its keyframes."""
    lost, hybrid_map = parent.state.localization, parent.hybrid_map
    if not isinstance(lost, Lost):
        return []
    return [a for a in hybrid_map.area_ids() if min(hybrid_map.keyframes(a), default=lost.since) < lost.since]


def _make_arc(parent: Parent, area: int, belief: PoseGaussian) -> Arc:
    """The arc from the robot's area; it closes a loop where it joins two known areas that no arc joined."""
    known = parent.hybrid_map.arc_value(parent.area, area)
    closure = parent.hybrid_map.has_area(area) if known is None else known.closure
    return Arc(parent.area, area, belief, closure)


def _frame_change(query: Query, entry: PoseGaussian, covariances: Mapping[int, Float64]) -> PoseGaussian:
    """``area_T_previous`` with the uncertainty of the newest keyframe in the area, so that its drift continues."""
    newest, pose = list(query.poses.items())[-1]
    belief = PoseGaussian(se2.compose(entry.mean, pose), covariances[newest])
    return belief.compose(PoseGaussian.from_pose(se2.inverse(se2.compose(query.belief.mean, pose))))


def _log(value: float) -> float:
    return math.log(value) if value > 0.0 else -math.inf
