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
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import (
    connected_neighbors,
    informative_arc,
)
from hmt_slam_ros.hybrid_map.surroundings import keyframe_positions, min_distance
from hmt_slam_ros.messages.map_changes import Arc
from hmt_slam_ros.messages.replica import FIRST_AREA, Replica
from hmt_slam_ros.messages.statements import StatementEvidence
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.relative_motion import is_wide
from hmt_slam_ros.topological_inference.area_comparison import (
    AreaComparison,
    ComparisonKind,
    Fit,
    OngoingComparison,
    StatedPair,
)
from hmt_slam_ros.topological_inference.area_entry import AreaEntry, lose
from hmt_slam_ros.topological_inference.branches import Branches, Child, Parent
from hmt_slam_ros.topological_inference.candidate_gating import Query
from hmt_slam_ros.topological_inference.closure_search import (
    ClosureSearch,
    SearchState,
    first_new_keyframe,
    known_ground_log_ratio,
)
from hmt_slam_ros.topological_inference.global_localization import GlobalSearch, LandmarkEvidence
from hmt_slam_ros.topological_inference.hypothesis_tree import (
    Lost,
    Tracking,
)
from hmt_slam_ros.topological_inference.kidnapping_prior import KidnappingPriors
from hmt_slam_ros.topological_inference.map_search import MapSearch
from hmt_slam_ros.topological_inference.marked_places import MarkedPlaceFinder
from hmt_slam_ros.topological_inference.marks import AreaMark, MarkEvidence, MarkMemory
from hmt_slam_ros.topological_inference.pose_distribution import PoseDistribution
from hmt_slam_ros.topological_inference.search_prior import FLAT_PRIOR, SearchPrior
from hmt_slam_ros.topological_inference.statements import (
    PlaceStatements,
    StatementQueue,
    area_query,
)

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
    :ivar marks: the visits of marks.
    :ivar statements: what people stated about places and waits for the next event.
    """

    largest_area: int = FIRST_AREA
    search: SearchState = field(default_factory=SearchState)
    unstored_scans: Mapping[int, Scan] = field(default_factory=dict)
    marks: MarkMemory = field(default_factory=MarkMemory)
    statements: StatementQueue = field(default_factory=StatementQueue)


class Branching:
    """Creates the children of hypotheses.

    :ivar entry: makes those that enter an area.
    :ivar search: finds and compares known areas.
    :ivar map_search: searches the whole map for a lost robot.
    :ivar landmarks: their evidence on places and loops, where the configuration asks for it.
    :ivar unstored_scans: {keyframe event: scan} of scans that no map holds and that may still be matched.
    :ivar marks: the visits of marks.
    :ivar statements: what people stated about places.
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
        self.map_search = MapSearch(configuration, scans, self.search.work)
        self.landmarks = None if landmarks is None else landmarks(configuration, scans)
        self.marks = MarkMemory()
        self._mark_evidence, self._marked_places = MarkEvidence(configuration), MarkedPlaceFinder(configuration)
        self.statements = PlaceStatements(StatementEvidence(configuration.tsbi), replica)
        self.options = configuration.tsbi
        self.kidnapping_priors = KidnappingPriors.from_configuration(configuration)
        self._filter = configuration.filter
        self._local_map_extent = configuration.local_map.extent
        self.entry = AreaEntry(configuration, replica, self.search)

    @property
    def state(self) -> BranchingState:
        """What is remembered between two events."""
        search = replace(self.search.state, region_maps=self.map_search.state)
        return BranchingState(
            self.entry.largest_area, search, dict(self.unstored_scans), self.marks, self.statements.queue
        )

    def restore(self, state: BranchingState) -> None:
        """Start from a saved state."""
        self.entry.largest_area = state.largest_area
        self.search.restore(state.search)
        self.map_search.restore(state.search.region_maps)
        self.unstored_scans.update(state.unstored_scans)
        self.marks = state.marks
        self.statements.queue = state.statements

    def localize_globally(
        self, parent: Parent, search: GlobalSearch, prior: SearchPrior = FLAT_PRIOR
    ) -> PoseDistribution:
        """The distribution of the keyframes' pose in the whole map, as far as it was searched.

        Landmarks count from the second search with a candidate on, since one search alone localizes nobody.

        :param prior: of the reference.
        """
        distribution = self.map_search.localize(parent.hybrid_map, search, parent.clutter, prior)
        lost = parent.state.localization
        if self.landmarks is None or not isinstance(lost, Lost) or lost.candidate is None:
            return distribution
        return self.landmarks.weigh(distribution, parent.hybrid_map, search.poses, search.before)

    def find_search_prior(self, parent: Parent, lost: Lost, poses: Mapping[int, Float64]) -> SearchPrior:
        """What is known of the pose of keyframes beside scans: by the hint for one of them, or else by marks.

        :param poses: {keyframe: ``reference_T_base`` (3,)}; the reference is the first.
        """
        hint = None if lost.pose_hint is None else lost.pose_hint.at_first(poses)
        if hint is not None:
            return SearchPrior(hint)
        return SearchPrior(marks=self._marked_places.find(parent.hybrid_map, poses, lost.since, self.marks))

    def is_marked(self, keyframes: Collection[int], before: int) -> bool:
        """Whether a mark is visited at one of some keyframes that was visited before another one."""
        repeated = self.marks.repeated_visits(keyframes)
        return any(one.keyframe < before for _, earlier in repeated for one in earlier)

    def look_ahead(self, parents: Sequence[Parent]) -> None:
        """Prepare the next search, at an event without one."""
        localizations = [(parent.hybrid_map, parent.state.localization) for parent in parents]
        lost_maps = [(hybrid_map, lost.since) for hybrid_map, lost in localizations if isinstance(lost, Lost)]
        self.search.look_ahead(max(parents, key=lambda parent: parent.log_weight).hybrid_map)
        if lost_maps and self.landmarks is not None:
            self.landmarks.prepare_places(lost_maps)

    def end_global_localization(self) -> None:
        """Free what served global localization."""
        self.map_search.end()
        if self.landmarks is not None:
            self.landmarks.on_localized()

    def forget_scans(self) -> None:
        """Drop what was computed from scans, of which some have changed."""
        self.search.forget_scans()
        self.map_search.forget_scans()
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
        self.entry.begin_event()
        self.search.work.begin_event()

    def reweight_by_known_ground(
        self, parent: Parent, pose: Float64, points: Float64, keyframe: int, kidnapped: int | None = None
    ) -> Parent:
        """The hypothesis with the evidence of the newest scan for the known ground around it.

        After a kidnapping known ground is all from before, and counts where the scan agrees with it: contradictions
        count by the submap, beams and walls.

        :param points: the scan's surface points, shape (n, 2), m, base frame.
        :param pose: ``area_T_base`` of the scan.
        :param keyframe: its number.
        :param kidnapped: the first keyframe after a kidnapping under one of the hypotheses.
        """
        poses = {parent.area: np.zeros(3), **parent.local_area_poses()}
        before = first_new_keyframe(keyframe) if kidnapped is None else kidnapped
        agreement = self.search.known_ground_agreement(parent.hybrid_map, poses, points, pose, before)
        log_ratio = known_ground_log_ratio(agreement, parent.clutter.beam_outlier_rate)
        if kidnapped is not None:
            log_ratio = max(0.0, log_ratio)
        return replace(parent, log_weight=parent.log_weight + log_ratio)

    def reweight_by_marks(self, parent: Parent, pose: PoseGaussian, keyframe: int) -> Parent:
        """The hypothesis with the evidence of the visits of marks that begin at the newest keyframe.

        :param pose: belief over ``area_T_base``.
        :param keyframe: its number.
        """
        log_likelihood = sum(
            self._mark_evidence.log_likelihood(parent.hybrid_map, parent.area, pose, visit, before)
            for visit, before in self.marks.beginning_visits(keyframe)
        )
        return replace(parent, log_weight=parent.log_weight + log_likelihood)

    def leads_elsewhere(self, parent: Parent) -> bool:
        """Whether a mark puts keyframes that were not compared into an area that is not joined to the robot's."""
        own = parent.hybrid_map.keyframes(parent.area)
        keyframes = [k for k in parent.state.unmatched_keyframes if k in own]
        if not any(self.marks.repeated_visits(keyframes)):
            return False
        excluded = {*self._joined_areas(parent), *_searched_areas(parent)}
        return bool(self._find_marked_areas(parent, self.entry.query(parent, keyframes), excluded))

    def _find_marked_areas(self, parent: Parent, query: Query, excluded: Collection[int]) -> dict[int, AreaMark]:
        return self._mark_evidence.find_areas(parent.hybrid_map, parent.area, query, self.marks, excluded)

    def cut(self, parent: Parent, keyframes: Sequence[int]) -> Branches:
        """Branch over a new area and every known area that the arcs admit, with one child per mode.

        Where the keyframes lie in the place of an area of the submap there is one child: the robot is tracked there.
        Until the comparison with known areas ends nothing is cut: area abstraction repeats the cut. But where the arcs
        are too wide for one area, or the robot comes to the end of its local map, the keyframes begin a new area at
        once, and are compared there.
        """
        query, ongoing = self.entry.query(parent, keyframes), parent.state.comparison
        if is_wide(query.belief.covariance, self._filter):
            return self._cut_behind_wide_arc(parent, query)
        is_far = self._is_far_from_origin(parent, keyframes)
        if ongoing is not None and is_far and not _belongs_to_cut(ongoing, keyframes):
            ongoing = None  # of keyframes that stay behind
        if ongoing is None:
            local_areas = parent.local_area_poses()
            tracked = self.search.tracked_area(parent.hybrid_map, parent.area, local_areas, query.poses_in_area)
            if tracked is not None:
                return Branches([self.entry.enter_tracked(parent, query, tracked)])
            found = self._compare_cut(parent, query, {parent.area, *local_areas})
        elif _belongs_to_cut(ongoing, keyframes):
            found = self.search.continue_comparison(parent.hybrid_map, ongoing)
            query = self.entry.query(parent, keyframes, next(iter(ongoing.query.poses)))
        else:
            return self.continue_comparison(parent, ongoing)
        if isinstance(found, OngoingComparison):
            return Branches([self.entry.enter_meanwhile(parent, query, found) if is_far else self._wait(parent, found)])
        return self._branch_at_cut(parent, query, found)

    def _cut_behind_wide_arc(self, parent: Parent, query: Query) -> Branches:
        """The children of a cut to which a wide motion led.

        A robot that is lost after a fault of odometry or a gap is searched, not compared: arcs may say where it is not.
        """
        is_after_fault = next(iter(query.poses)) in parent.state.onset_conditions
        if is_after_fault and self.entry.is_lost_beyond(parent, query):
            return Branches([self.entry.enter_new(parent, query, 0.0)])
        found = self._compare_cut(parent, query, {parent.area})
        if isinstance(found, OngoingComparison):
            return Branches([self.entry.enter_meanwhile(parent, query, found)])
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
        children = [self.entry.enter_new(parent, query, math.log(found.new_probability(compared)))]
        children += [self.entry.enter_known(parent, query, fit) for fit in found.fits]
        children += self._suspect_arcs(parent, query, found, compared)
        return Branches(children, True, _log(found.skipped_weight) + parent.log_weight)

    def recheck(self, parent: Parent, only: Collection[int] = ()) -> Branches:
        """Branch over no change and a further arc from the robot's area to a known one; no keyframe changes its area.

        :param only: the only areas to examine, beside which keyframes fitted; all if empty.
        """
        newest = sorted(parent.state.covariances)[-self.options.recheck_keyframes :]
        own = parent.hybrid_map.keyframes(parent.area)
        keyframes = [k for k in (newest if only else parent.state.unmatched_keyframes) if k in own]
        query = self.entry.query(parent, keyframes)
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
        pair = comparison.stated_pair
        if pair is not None and not parent.hybrid_map.has_area(pair.area):
            return Branches([parent.unchanged_child(replace(parent.state, comparison=None))])
        found = self.search.continue_comparison(parent.hybrid_map, comparison)
        if isinstance(found, OngoingComparison):
            return Branches([self._wait(parent, found)])
        if pair is not None:
            return self._join_stated(parent, comparison.query, pair, found)
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
        children = [stay, *(self._join(parent, comparison.query, fit, parent.area) for fit in fits)]
        children += self._suspect_arcs(parent, comparison.query, found, compared)
        return Branches(children, True, _log(found.skipped_weight) + parent.log_weight)

    def compare_stated(self, parent: Parent, pair: StatedPair) -> Branches:
        """Branch over no change and an arc between two areas that a person states to be one place."""
        query = area_query(parent.hybrid_map, pair.area, self.entry.covariance_floor)
        excluded = {pair.area, *connected_neighbors(parent.hybrid_map, pair.area)}
        comparison = self.search.begin_comparison(
            parent.hybrid_map, pair.area, query, {}, excluded, 1, "stated", (pair.other,)
        )
        return self.continue_comparison(parent, replace(comparison, stated_pair=pair))

    def _join_stated(self, parent: Parent, query: Query, pair: StatedPair, found: AreaComparison) -> Branches:
        """The children after the comparison of two areas that a person states to be one place."""
        state = replace(parent.state, comparison=None, compared_statement=pair.statement)
        parent = replace(parent, state=state)
        # Another event may have joined them meanwhile.
        is_joined = pair.other in connected_neighbors(parent.hybrid_map, pair.area)
        stay = replace(parent.unchanged_child(), log_weight=parent.log_weight + math.log(found.new_probability(())))
        joined = [] if is_joined else [self._join(parent, query, fit, pair.area) for fit in found.fits]
        return Branches([stay, *joined], True, _log(found.skipped_weight) + parent.log_weight)

    @staticmethod
    def _wait(parent: Parent, comparison: OngoingComparison) -> Child:
        """The only child while a comparison goes on."""
        return parent.unchanged_child(replace(parent.state, comparison=comparison))

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
        marks = self._find_marked_areas(parent, query, excluded)
        return self.search.begin_comparison(
            parent.hybrid_map, parent.area, query, parent.state.matched_keyframes, excluded, most, kind, only, marks
        )

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
        query = self.entry.query(parent, keyframes)
        child = self.entry.enter_unknown(parent, query, math.log(_ARC_FAULT_PROBABILITY))
        return [lose(child, parent, query)]

    @staticmethod
    def _join(parent: Parent, query: Query, fit: Fit, area: int) -> Child:
        """The robot in its area, and an arc that now joins a known one with the area of the query."""
        arc = Arc(area, fit.area, query.belief.compose(fit.mode.measured.inverse()), closure=True)
        log_weight = parent.log_weight + fit.log_weight
        is_found = fit.area in _searched_areas(parent)
        state = replace(parent.state, localization=Tracking()) if is_found else parent.state
        child = replace(parent.unchanged_child(state), log_weight=log_weight, arcs=(arc,), reload_local_map=True)
        return replace(child, fit=fit)


def _belongs_to_cut(comparison: OngoingComparison, keyframes: Sequence[int]) -> bool:
    """Whether a comparison is that of a cut, whose keyframes are among these."""
    return comparison.kind == "cut" and comparison.query.poses.keys() <= set(keyframes)


def _searched_areas(parent: Parent) -> list[int]:
    """The areas from before a robot was lost, in which it is searched: they are not compared with its keyframes."""
    lost, hybrid_map = parent.state.localization, parent.hybrid_map
    if not isinstance(lost, Lost):
        return []
    return [a for a in hybrid_map.area_ids() if min(hybrid_map.keyframes(a), default=lost.since) < lost.since]


def _log(value: float) -> float:
    return math.log(value) if value > 0.0 else -math.inf
