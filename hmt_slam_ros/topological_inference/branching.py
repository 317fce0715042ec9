"""The children of a hypothesis, where its newest keyframes may lie in known areas: Eq. (6), summed over gamma.

Every scan is counted once. Metric SLAM's evidence counts it against the local map. Here the surfaces of several
keyframes are compared with known areas of which the local map did not know: what that map holds is left out of the
candidates' grids, and no keyframe is compared with an area twice.
"""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import connected_neighbors, informative_arc, shortest_path_beliefs
from hmt_slam_ros.hybrid_map.surroundings import keyframe_positions, min_distance
from hmt_slam_ros.messages.map_changes import Arc, ArcEnds, AreaMerge, MovedKeyframe
from hmt_slam_ros.messages.messages import Hypothesis
from hmt_slam_ros.messages.replica import FIRST_AREA, Replica
from hmt_slam_ros.registration.consistency import NO_CLUTTER, Clutter
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.topological_inference.candidate_gating import Query
from hmt_slam_ros.topological_inference.closure_search import AreaComparison, ClosureSearch, Fit, SearchState
from hmt_slam_ros.topological_inference.global_localization import LandmarkEvidence, PoseDistribution, PoseHint
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState, Lost, relative_covariance


@dataclass(frozen=True, eq=False)
class Parent:
    """A hypothesis before the event.

    :ivar log_weight: log of its probability, the newest scan's evidence included.
    :ivar probability: its probability before, by which hypotheses share the areas that are examined at an event.
    :ivar clutter: what contradicts its map usually.
    """

    hypothesis: int
    area: int
    hybrid_map: HybridMap
    state: HypothesisState
    log_weight: float
    probability: float = 1.0
    clutter: Clutter = NO_CLUTTER

    def local_area_poses(self) -> dict[int, NDArray[np.float64]]:
        """{area: ``area_T_other``} of the local map's other areas."""
        return {area: pose for area, pose in self.state.local_area_poses.items() if self.hybrid_map.has_area(area)}

    def covariance(self, keyframe: int) -> NDArray[np.float64]:
        """Of a keyframe's pose in the robot's area, shape (3, 3)."""
        return self.state.covariances.get(keyframe, np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Child:
    """One continuation of a hypothesis.

    :ivar parent: id of the hypothesis that it continues.
    :ivar log_weight: log of its weight, unnormalized.
    :ivar reload_local_map: whether the local map has to be loaded anew.
    """

    parent: int
    log_weight: float
    area: int
    state: HypothesisState
    frame_change: PoseGaussian | None = None
    moved_keyframes: tuple[MovedKeyframe, ...] = ()
    arcs: tuple[Arc, ...] = ()
    reload_local_map: bool = False
    removed_arcs: tuple[ArcEnds, ...] = ()
    area_merge: AreaMerge | None = None


class Branches(NamedTuple):
    """All continuations of one hypothesis.

    :ivar closures_searched: whether known areas were looked for.
    :ivar log_skipped_weight: log of the weight of those that were not looked at.
    :ivar pose_distribution: where in the map a robot may be of which nothing told how it came there, if that was asked.
    """

    children: list[Child]
    closures_searched: bool = False
    log_skipped_weight: float = -math.inf
    pose_distribution: PoseDistribution | None = None


MIN_HYPOTHESIS_PROBABILITY = 0.5
"""Hypotheses of this probability are asked for loops that landmarks propose."""

MIN_EXAMINED_AREAS = 4
"""Known areas that every hypothesis may examine at a cut, however improbable it is."""

# Factor on the covariance of an arc along other arcs, where no match confirms it: it adds next to nothing to those.
_UNCONFIRMED = 100.0


@dataclass(frozen=True)
class BranchingState:
    """What is known of areas beside the maps of the hypotheses.

    :class:`Branching` does not hold it, as its search reads the scans from a table that changes in place.

    :ivar largest_area: the largest number that an area was given.
    :ivar search: what was learnt by comparing areas.
    :ivar unstored_scans: {keyframe event: scan} of those that no map holds and that may be looked for.
    """

    largest_area: int = FIRST_AREA
    search: SearchState = field(default_factory=SearchState)
    unstored_scans: Mapping[int, Scan] = field(default_factory=dict)


class Branching:
    """Makes the children of hypotheses; numbers new areas.

    :ivar search: finds and compares known areas.
    :ivar landmarks: what they say of places and loops, where they are asked.
    :ivar unstored_scans: {keyframe event: scan} of those that no map holds and that may be looked for.
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
        self._options = configuration.tsbi
        self._replica = replica
        sigma, angle = configuration.tlca.arc_sigma_floor, math.radians(configuration.tlca.arc_angle_floor)
        self._covariance_floor = np.diag([sigma**2, sigma**2, angle**2])
        self._largest_area = FIRST_AREA
        self._new_areas: dict[tuple[int, ...], int] = {}

    @property
    def state(self) -> BranchingState:
        """All that is known between two events."""
        return BranchingState(self._largest_area, self.search.state, dict(self.unstored_scans))

    def restore(self, state: BranchingState) -> None:
        """Take over what was known before the first event."""
        self._largest_area = state.largest_area
        self.search.restore(state.search)
        self.unstored_scans.update(state.unstored_scans)

    def localize_globally(
        self, parent: Parent, poses: Mapping[int, NDArray[np.float64]], before: int, pose_hint: PoseHint | None = None
    ) -> PoseDistribution:
        """Where in the map keyframes lie of which the arcs tell nothing.

        Landmarks are asked after a look that found a place: one look alone finds nobody, and by then they are gathered.

        :param poses: {keyframe: ``reference_T_base``}.
        :param before: the map is that of the keyframes before this one.
        :param pose_hint: where the reference is, if somebody says so.
        """
        where = self.search.localize_globally(parent.hybrid_map, poses, before, parent.clutter, pose_hint)
        lost = parent.state.localization
        if self.landmarks is None or not isinstance(lost, Lost) or lost.candidate is None:
            return where
        return self.landmarks.weigh(where, parent.hybrid_map, poses, before)

    def look_ahead(self, parents: Sequence[Parent]) -> None:
        """At an event at which nothing was looked for, prepare what the next look will ask for."""
        self.search.look_ahead(max(parents, key=lambda parent: parent.log_weight).hybrid_map)
        found = [(one.hybrid_map, one.state.localization) for one in parents]
        lost = [(hybrid_map, one.since) for hybrid_map, one in found if isinstance(one, Lost)]
        if lost and self.landmarks is not None:
            self.landmarks.prepare_places(lost)

    def end_global_localization(self) -> None:
        """It is known where the robot is."""
        self.search.end_global_localization()
        if self.landmarks is not None:
            self.landmarks.localized()

    def forget_scans(self) -> None:
        """Work out anew what is made of scans, of which some have changed."""
        self.search.forget_scans()
        if self.landmarks is not None:
            self.landmarks.forget_scans()

    def keep_scans(self, event: int, scan: Scan, wanted: Collection[int]) -> None:
        """Keep the scan of a keyframe event, and of those that were kept the ones that are wanted."""
        for late in self.unstored_scans.keys() - set(wanted):
            del self.unstored_scans[late]
        if event in wanted:
            self.unstored_scans[event] = scan

    def begin_event(self) -> None:
        """Forget which new areas were named; within one event hypotheses share the ids of the same new area."""
        self._new_areas = {}

    def reweight_by_known_ground(
        self, parent: Parent, pose: NDArray[np.float64], points: NDArray[np.float64], keyframe: int
    ) -> Parent:
        """The hypothesis weighed by what the newest scan says for the known ground that it has the robot in.

        :param points: its surface points, shape (n, 2), m, base frame.
        :param pose: ``area_T_base`` of the scan.
        :param keyframe: its number.
        """
        poses = {parent.area: np.zeros(3), **parent.local_area_poses()}
        log_ratio = self.search.known_ground_log_ratio(parent.hybrid_map, poses, points, pose, keyframe)
        return replace(parent, log_weight=parent.log_weight + log_ratio)

    def cut(self, parent: Parent, keyframes: Sequence[int]) -> Branches:
        """{new area} and every known area that the arcs admit, with one child a mode.

        Where the keyframes lie in the place of an area of the local map there is nothing to ask: the robot tracks its
        pose there, and "new" would be the same metric map under another name.
        """
        query = self.query(parent, keyframes)
        tracked = self.search.tracked_area(
            parent.hybrid_map, parent.area, parent.local_area_poses(), query.poses_in_area
        )
        if tracked is not None:
            return Branches([self._enter_tracked(parent, query, tracked)])
        excluded = {parent.area, *parent.local_area_poses()}
        supposed = parent
        if self.landmarks is not None and parent.probability >= MIN_HYPOTHESIS_PROBABILITY:
            supposed = replace(parent, hybrid_map=self.landmarks.propose_loop(parent.hybrid_map, parent.area))
        found = self._compare_areas(supposed, query, excluded)
        noted = replace(
            parent, state=parent.state.after_matching(found.examined_areas, keyframes, found.pending_candidates)
        )
        children = [self._enter_new(noted, query, math.log(found.transition.new))]
        children += [self._enter_known(noted, query, fit) for fit in found.fits]
        return Branches(children, True, _log(found.skipped_weight) + parent.log_weight)

    def recheck(self, parent: Parent, only: Collection[int] = ()) -> Branches:
        """Stay as it is, or join the robot's area to a known one by a further arc; no keyframe changes its area.

        :param only: known areas beside which keyframes fitted: whether the newest are in one of them now.
        """
        newest = sorted(parent.state.covariances)[-self._options.recheck_keyframes :]
        placed = parent.hybrid_map.keyframes(parent.area)
        keyframes = [k for k in (newest if only else parent.state.unmatched_keyframes) if k in placed]
        query = self.query(parent, keyframes)
        excluded = {parent.area, *parent.local_area_poses(), *connected_neighbors(parent.hybrid_map, parent.area)}
        if self.landmarks is not None and parent.probability >= MIN_HYPOTHESIS_PROBABILITY:
            self.landmarks.prepare_loops(parent.hybrid_map, parent.area)
        found = self._compare_areas(parent, query, excluded, only)
        notes = parent.state.after_matching(
            found.examined_areas, keyframes, found.pending_candidates, all_areas=not only
        )
        noted = replace(parent, state=notes)
        # That none is in the place was weighed when they fitted beside it.
        log_new = 0.0 if only and not found.fits else math.log(found.transition.new)
        stay = parent.log_weight + log_new
        children = [Child(parent.hypothesis, stay, parent.area, noted.state)]
        children += [self._join(noted, query, fit) for fit in found.fits]
        return Branches(children, True, _log(found.skipped_weight) + parent.log_weight)

    def _compare_areas(
        self, parent: Parent, query: Query, excluded: Collection[int], only: Collection[int] = ()
    ) -> AreaComparison:
        """The comparison with known areas, of which a hypothesis may examine the more the more probable it is."""
        most = min(
            self._options.max_candidates,
            max(MIN_EXAMINED_AREAS, math.ceil(self._options.max_comparisons * parent.probability)),
        )
        return self.search.compare(
            parent.hybrid_map, parent.area, query, parent.state.matched_keyframes, excluded, most, only
        )

    def move(self, parent: Parent, area: int) -> Branches:
        """The robot went into a known area; the keyframes stay where they are."""
        belief, notes = self._belief(parent, area), parent.state.after_area_change({})
        return Branches(
            [
                Child(
                    parent.hypothesis,
                    parent.log_weight,
                    area,
                    notes,
                    frame_change=belief.inverse(),
                    reload_local_map=True,
                )
            ]
        )

    def find_unlinked_overlap(self, parent: Parent, pose: NDArray[np.float64]) -> int | None:
        """The area of the local map in whose place the robot is, where no arc joins that to the robot's own area.

        Area abstraction looks along the arcs and would not notice.

        :param pose: ``area_T_base``.
        """
        joined = connected_neighbors(parent.hybrid_map, parent.area)
        around = {area: at for area, at in parent.local_area_poses().items() if area not in joined}
        found = self.search.tracked_area(parent.hybrid_map, parent.area, around, pose[None])
        if found is None:
            return None
        here = keyframe_positions(parent.hybrid_map, parent.area, np.zeros(3))
        there = keyframe_positions(parent.hybrid_map, found, around[found])
        return found if min_distance(pose[None, :2], there) < min_distance(pose[None, :2], here) else None

    def link(self, parent: Parent, area: int, scan: Scan, pose: PoseGaussian) -> Branches:
        """Join the robot's area to one in which it is tracked by the arc that the newest scan measures.

        :param pose: belief over ``area_T_base`` of the scan, in the robot's area.
        """
        belief = self._belief(parent, area)
        prior = belief.inverse().compose(PoseGaussian(pose.mean, pose.covariance + self._covariance_floor))
        found = self.search.measure_pose(parent.hybrid_map, area, parent.area, scan, prior)
        notes = parent.state.after_overlap(None)
        if found is None:
            return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, notes)])
        arc = Arc(parent.area, area, pose.compose(found.inverse()), closure=True)
        return Branches([Child(parent.hypothesis, parent.log_weight, parent.area, notes, arcs=(arc,))])

    def _belief(self, parent: Parent, area: int) -> PoseGaussian:
        """The belief over ``area_T_other``, its mean as the local map has it, so that the robot does not jump."""
        arc = informative_arc(parent.hybrid_map, parent.area, area)
        found = arc or shortest_path_beliefs(parent.hybrid_map, parent.area, targets=(area,))[area]
        return PoseGaussian(parent.state.local_area_poses.get(area, found.mean), found.covariance)

    def query(self, parent: Parent, keyframes: Sequence[int]) -> Query:
        """Keyframes of a hypothesis as TSBI asks for them."""
        placed = parent.hybrid_map.keyframes(parent.area)
        reference = placed[keyframes[0]]
        covariance = parent.covariance(keyframes[0]) + self._covariance_floor
        poses = {keyframe: se2.between(reference, placed[keyframe]) for keyframe in keyframes}
        return Query(PoseGaussian(reference, covariance), poses)

    def _enter_new(self, parent: Parent, query: Query, log_factor: float) -> Child:
        """New ground: the reference keyframe becomes the frame of a new area."""
        origin = PoseGaussian.from_pose(np.zeros(3))
        return self.enter_area(parent, query, self.new_area(parent, query), origin, query.belief, log_factor)

    def new_area(self, parent: Parent, query: Query) -> int:
        """The number of an area that keyframes begin, the same for all hypotheses of an event."""
        keyframes = tuple(query.poses)
        if keyframes not in self._new_areas:
            self._largest_area = max(self._largest_area, parent.hybrid_map.max_area_id) + 1
            self._new_areas[keyframes] = self._largest_area
        return self._new_areas[keyframes]

    def _enter_tracked(self, parent: Parent, query: Query, area: int) -> Child:
        """A known area in whose place the robot is known to be.

        The arc is new only where none joined the two; then the newest of the keyframes measures it.
        """
        belief = self._belief(parent, area)
        entry = belief.inverse().compose(query.belief)
        joined = informative_arc(parent.hybrid_map, parent.area, area) is not None
        arc = None if joined else self._measure_arc(parent, query, area, belief)
        return self.enter_area(parent, query, area, entry, arc, 0.0)

    def _measure_arc(self, parent: Parent, query: Query, area: int, belief: PoseGaussian) -> PoseGaussian:
        newest, pose = list(query.poses.items())[-1]
        here = query.belief.compose(PoseGaussian(pose, np.zeros((3, 3))))
        scan, prior = self._replica.scans[newest], belief.inverse().compose(here)
        found = self.search.measure_pose(parent.hybrid_map, area, parent.area, scan, prior)
        if found is None:
            return PoseGaussian(belief.mean, _UNCONFIRMED * belief.covariance)
        return here.compose(found.inverse())

    def _enter_known(self, parent: Parent, query: Query, fit: Fit) -> Child:
        """A known area, recognized."""
        arc = query.belief.compose(fit.mode.measured.inverse())
        return self.enter_area(parent, query, fit.area, fit.mode.pose, arc, fit.log_weight)

    def enter_area(
        self, parent: Parent, query: Query, area: int, entry: PoseGaussian, arc: PoseGaussian | None, log_factor: float
    ) -> Child:
        """The robot and the query's keyframes are in ``area``, at ``entry`` = ``area_T_reference``."""
        relabelled = tuple(
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
            relabelled,
            () if arc is None else (self._make_arc(parent, area, arc),),
            reload_local_map=True,
        )

    def _keyframe_belief(self, parent: Parent, query: Query, keyframe: int) -> PoseGaussian:
        """The belief over ``reference_T_base`` of a keyframe."""
        pose, reference = query.poses[keyframe], query.belief.covariance - self._covariance_floor
        return PoseGaussian(pose, relative_covariance(parent.covariance(keyframe), reference, pose, np.zeros((3, 3))))

    @staticmethod
    def _make_arc(parent: Parent, area: int, belief: PoseGaussian) -> Arc:
        """The arc from the robot's area; it closes a loop where it joins two known areas that no arc joined."""
        known = parent.hybrid_map.arc_value(parent.area, area)
        revisited = parent.hybrid_map.has_area(area)
        return Arc(parent.area, area, belief, closure=revisited if known is None else known.closure)

    @staticmethod
    def _join(parent: Parent, query: Query, fit: Fit) -> Child:
        """The robot stays in its area, which an arc now joins to a known one."""
        arc = Arc(parent.area, fit.area, query.belief.compose(fit.mode.measured.inverse()), closure=True)
        log_weight = parent.log_weight + fit.log_weight
        return Child(parent.hypothesis, log_weight, parent.area, parent.state, arcs=(arc,), reload_local_map=True)


def _frame_change(query: Query, entry: PoseGaussian, covariances: Mapping[int, NDArray[np.float64]]) -> PoseGaussian:
    """``area_T_previous``, as uncertain as the newest of the keyframes is in the area, so that its drift goes on."""
    newest, pose = list(query.poses.items())[-1]
    belief = PoseGaussian(se2.compose(entry.mean, pose), covariances[newest])
    return belief.compose(PoseGaussian.from_pose(se2.inverse(se2.compose(query.belief.mean, pose))))


def _log(value: float) -> float:
    return math.log(value) if value > 0.0 else -math.inf


def merge_areas(parent: Parent, area: int, into: int, search: ClosureSearch) -> Child:
    """The child in which ``area`` is part of ``into``, or which stays as it is where their surfaces contradict.

    :param search: which compares them.
    """
    child = Child(parent.hypothesis, parent.log_weight, parent.area, parent.state)
    belief = parent.hybrid_map.arc(into, area)
    if belief is None or not search.is_same_place(parent.hybrid_map, into, area, belief.mean):
        return child
    child = replace(child, reload_local_map=True, area_merge=AreaMerge(area, into, belief))
    if parent.area != area:
        return child
    placed = parent.hybrid_map.keyframes(area)
    covariances = {
        k: belief.compose(PoseGaussian(placed[k], covariance)).covariance
        for k, covariance in parent.state.covariances.items()
        if k in placed
    }
    return replace(child, area=into, state=parent.state.after_area_change(covariances), frame_change=belief)


def apply_revision(parent: Parent, leaf: Hypothesis, newest: int) -> Child:
    """The child that believes one of TLCA's explanations; all areas may be compared again.

    :param leaf: the explanation; of the keyframes that came since TLCA spoke it does not know.
    :param newest: the newest keyframe.
    """
    relabelled = leaf.moved_keyframes
    if leaf.frame_change is not None and newest in parent.hybrid_map.keyframes(parent.area):
        pose = se2.compose(leaf.frame_change.mean, parent.hybrid_map.keyframes(parent.area)[newest])
        relabelled += (MovedKeyframe(newest, parent.area, leaf.area, pose),)
    return Child(
        parent.hypothesis,
        parent.log_weight + math.log(leaf.probability),
        leaf.area,
        _state_after_revision(parent, leaf, {r.keyframe for r in relabelled if r.area == leaf.area}),
        leaf.frame_change,
        relabelled,
        leaf.arcs,
        reload_local_map=True,
        removed_arcs=leaf.removed_arcs,
    )


def _state_after_revision(parent: Parent, leaf: Hypothesis, moved: set[int]) -> HypothesisState:
    """Without what was compared; where the robot is in another area now, of the keyframes that it took along."""
    notes = replace(parent.state, matched_keyframes={}, unlinked_overlap=None)
    if leaf.area == parent.area:
        return notes
    covariances = {keyframe: covariance for keyframe, covariance in notes.covariances.items() if keyframe in moved}
    return HypothesisState(
        covariances, unmatched_keyframes=tuple(keyframe for keyframe in notes.unmatched_keyframes if keyframe in moved)
    )
