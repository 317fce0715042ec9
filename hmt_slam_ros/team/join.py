"""Joins: arcs between two components where a placement is sure enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hmt_slam_ros.configuration.topology import LoopClosureParameters
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_quantile
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap, apply_sigma_floor, fuse_traversals
from hmt_slam_ros.hybrid_map.pose_graph import total_arc_chi2
from hmt_slam_ros.loop_closure.closure_refinement import ClosureRefinement
from hmt_slam_ros.messages.team import Verdict
from hmt_slam_ros.team.components import Component, ComponentPair, combine
from hmt_slam_ros.team.placement import Placement, PlacementDistribution
from hmt_slam_ros.team.placement_search import PlacementSearch
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
    :ivar joined: the two as one component, None unless they were joined.
    """

    pair: ComponentPair
    windows: tuple[Window, ...]
    distribution: PlacementDistribution
    verdict: Verdict
    joined: Component | None = None


def meet(first: Component, second: Component, configuration: Configuration) -> Meeting:
    """Find how the second component lies in the first, and join them where that is sure."""
    pair, search = combine(first, second), PlacementSearch(configuration)
    search.update(pair)
    while search.step():
        pass
    return judge(search, configuration)


def judge(search: PlacementSearch, configuration: Configuration) -> Meeting:
    """What a search tells about its two components, as far as it came."""
    pair, windows, distribution = search.pair, search.windows, search.distribution()
    verdict, joined = decide(pair, windows, distribution, configuration)
    return Meeting(pair, windows, distribution, verdict, joined)


def decide(
    pair: ComponentPair, windows: Sequence[Window], distribution: PlacementDistribution, configuration: Configuration
) -> tuple[Verdict, Component | None]:
    """What becomes of two components, and both as one where they are joined."""
    best, options = distribution.best, configuration.tlca
    if best is None or distribution.apart >= 0.5:
        return Verdict.APART, None
    if best.probability < options.accept_probability or len(best.matches) < MIN_WINDOWS:
        return Verdict.OPEN, None
    joined = join_at(pair, windows, best, options)
    if _is_contradictory(pair, joined, options):
        return Verdict.CONTRADICTORY, None
    return Verdict.JOINED, pair.as_one(_refine(pair, joined, configuration))


def join_at(
    pair: ComponentPair, windows: Sequence[Window], placement: Placement, options: LoopClosureParameters
) -> HybridMap:
    """The hybrid map with an arc for every window that agrees on a placement, fused where they join the same areas."""
    joined = pair.hybrid_map.subgraph(pair.hybrid_map.area_ids())
    joined.remove_arc(*pair.joint)
    joined.commit()
    for number, match in placement.matches.items():
        window = windows[number]
        to_area = PoseGaussian.from_pose(se2.inverse(window.reference))
        belief = _with_floor(match.belief.compose(to_area), options)
        known = joined.arc(match.area, window.area)
        arc = belief if known is None else fuse_traversals(known, belief, shared=0.0)
        joined.set_arc(match.area, window.area, arc, closure=True)
    joined.commit()
    return joined


def _is_contradictory(pair: ComponentPair, joined: HybridMap, options: LoopClosureParameters) -> bool:
    """Whether the arcs of a join contradict one another, by the chi-square of the cycles that they close."""
    arcs = sum(a in pair.known and b in pair.other for a, b, _ in joined.all_arcs())
    before = sum(total_arc_chi2(joined.subgraph(areas)) for areas in (pair.known, pair.other))
    freedom = _POSE_DOF * (arcs - 1)
    gate = chi_square_quantile(options.contradiction_probability, freedom) if freedom else 0.0
    return freedom > 0 and total_arc_chi2(joined) - before > gate


def _refine(pair: ComponentPair, joined: HybridMap, configuration: Configuration) -> HybridMap:
    """The map with the keyframes of the areas that were joined registered with one another."""
    closed = sorted({area for a, b, _ in joined.all_arcs() if a in pair.known and b in pair.other for area in (a, b)})
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
