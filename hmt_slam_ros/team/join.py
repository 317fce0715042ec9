"""Joins: arcs between two components where a placement is sure enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.topology import LoopClosureParameters
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_quantile
from hmt_slam_ros.hybrid_map.hybrid_map import AreaPair, HybridMap, apply_sigma_floor, fuse_traversals
from hmt_slam_ros.hybrid_map.pose_graph import total_arc_chi2
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative
from hmt_slam_ros.loop_closure.closure_refinement import ClosureRefinement
from hmt_slam_ros.messages.team import Verdict
from hmt_slam_ros.team.components import Component, ComponentPair, combine
from hmt_slam_ros.team.placement import Placement, PlacementDistribution, is_same_placement
from hmt_slam_ros.team.placement_search import PlacementSearch
from hmt_slam_ros.team.repetition import add_repetition
from hmt_slam_ros.team.windows import Window

MIN_WINDOWS = 2
"""Fewest windows that have to agree on a placement: one alone may be a place that looks alike."""

_POSE_DOF = 3
"""Degrees of freedom of a pose."""


@dataclass(frozen=True, eq=False)
class Meeting:
    """Two components, and how one lies in the other.

    :ivar pair: both as one hybrid map.
    :ivar windows: of the second component.
    :ivar distribution: PMF over placements.
    :ivar verdict: joined; apart, as the placements together are less probable than that; open, as none is sure;
        or contradictory, as the arcs of a sure placement contradict one another.
    :ivar joined: the two with the arcs of the join, None unless they were joined.
    """

    pair: ComponentPair
    windows: tuple[Window, ...]
    distribution: PlacementDistribution
    verdict: Verdict
    joined: HybridMap | None = None

    def refine(self, configuration: Configuration) -> Component:
        """The two that were joined as one component, with the keyframes of the joined areas registered."""
        assert self.joined is not None
        return self.pair.as_one(_refine(self.pair, self.joined, configuration))


def meet(first: Component, second: Component, configuration: Configuration) -> Meeting:
    """Find how the second component lies in the first, and join them where that is sure."""
    first, second = add_repetition(first, configuration), add_repetition(second, configuration)
    pair, search = combine(first, second), PlacementSearch(configuration)
    search.update(pair)
    while search.step() is not None:
        pass
    return judge(search, configuration)


def judge(search: PlacementSearch, configuration: Configuration) -> Meeting:
    """What a search tells about its two components, as far as it came."""
    pair, windows, distribution = search.pair, search.windows, search.distribution()
    verdict, joined = decide(pair, windows, distribution, configuration)
    return Meeting(pair, windows, distribution, verdict, joined)


def was_sure(search: PlacementSearch, meeting: Meeting, configuration: Configuration) -> bool:
    """Whether the placement that joins two components was sure before the newest window of the second, too."""
    if meeting.verdict is not Verdict.JOINED:
        return False
    before, now = search.distribution(left_out=1).best, meeting.distribution.best
    if before is None or now is None or not is_same_placement(before.pose, now.pose):
        return False
    return _is_sure(before, configuration.tlca)


def _is_sure(placement: Placement, options: LoopClosureParameters) -> bool:
    return placement.probability >= options.accept_probability and len(placement.matches) >= MIN_WINDOWS


def decide(
    pair: ComponentPair, windows: Sequence[Window], distribution: PlacementDistribution, configuration: Configuration
) -> tuple[Verdict, HybridMap | None]:
    """What becomes of two components, and both with the arcs of the join where they are joined."""
    best, options = distribution.best, configuration.tlca
    if best is None or distribution.apart >= 0.5:
        return Verdict.APART, None
    if not _is_sure(best, options):
        return Verdict.OPEN, None
    joined = join_at(pair, windows, best, options)
    if _is_contradictory(pair, joined, options):
        return Verdict.CONTRADICTORY, None
    return Verdict.JOINED, joined


def join_at(
    pair: ComponentPair, windows: Sequence[Window], placement: Placement, options: LoopClosureParameters
) -> HybridMap:
    """The hybrid map with an arc for every window that agrees on a placement, fused where they join the same areas."""
    joined = pair.hybrid_map.subgraph(pair.hybrid_map.area_ids())
    joined.remove_arc(*pair.joint)
    joined.commit()
    drift = _drift_per_meter(pair)
    for number, match in placement.matches.items():
        window = windows[number]
        in_known = PoseGaussian(match.belief.mean, match.belief.covariance + _drift_at(match.belief.mean, drift))
        in_area = PoseGaussian(window.reference, _drift_at(window.reference, drift))
        belief = _with_floor(in_known.compose(in_area.inverse()), options)
        known = joined.arc(match.area, window.area)
        arc = belief if known is None else fuse_traversals(known, belief, shared=0.0)
        joined.set_arc(match.area, window.area, arc, closure=True)
    joined.commit()
    return joined


def _drift_per_meter(pair: ComponentPair) -> Float64:
    """Covariance of the pose of a keyframe in its area, per meter from the origin, shape (3, 3).

    Areas bend inside as paths do from one to the next: it is that of the arcs of both components, on average. Without
    arcs it is zero, as nothing can contradict then.
    """
    inside = [arc.pose for a, b, arc in pair.hybrid_map.all_arcs() if (a in pair.known) == (b in pair.known)]
    length = sum(float(np.hypot(*arc.mean[:2])) for arc in inside if not is_uninformative(arc))
    total = sum((arc.covariance for arc in inside if not is_uninformative(arc)), np.zeros((3, 3)))
    return total / length if length > 0.0 else np.zeros((3, 3))


def _drift_at(pose: Float64, per_meter: Float64) -> Float64:
    """Covariance of a pose in its area, shape (3, 3), by its distance from the origin."""
    return float(np.hypot(*pose[:2])) * per_meter


def _is_contradictory(pair: ComponentPair, joined: HybridMap, options: LoopClosureParameters) -> bool:
    """Whether the arcs of a join contradict one another, by the chi-square of the cycles that they close."""
    arcs = len(_joining_pairs(pair, joined))
    before = sum(total_arc_chi2(joined.subgraph(areas)) for areas in (pair.known, pair.other))
    freedom = _POSE_DOF * (arcs - 1)
    gate = chi_square_quantile(options.contradiction_probability, freedom) if freedom else 0.0
    return freedom > 0 and total_arc_chi2(joined) - before > gate


def _joining_pairs(pair: ComponentPair, joined: HybridMap) -> list[AreaPair]:
    """The areas that arcs join, as (of the first component, of the second)."""
    return [(a, b) for a, b, _ in joined.all_arcs() if a in pair.known and b in pair.other]


def _refine(pair: ComponentPair, joined: HybridMap, configuration: Configuration) -> HybridMap:
    """The map with the keyframes of the areas that were joined registered with one another."""
    closed = sorted({area for ends in _joining_pairs(pair, joined) for area in ends})
    found = ClosureRefinement(configuration).refine(joined, pair.scans, closed)
    for area, keyframes in found.keyframes.items():
        joined.changed_areas[area] = dict(keyframes)
    closures = {(a, b): arc.closure for a, b, arc in joined.all_arcs()}
    for (a, b), belief in found.arcs.items():
        joined.set_arc(a, b, _with_floor(belief, configuration.tlca), closure=closures[a, b])
    joined.commit()
    return joined


def _with_floor(belief: PoseGaussian, options: LoopClosureParameters) -> PoseGaussian:
    return apply_sigma_floor(belief, options.arc_sigma_floor, np.radians(options.arc_angle_floor))
