"""Visits of marks as evidence for the topology (docs/decisions/0080-marks.md).

Two visits of one mark measure the relative pose of two keyframes. How well a hypothesis predicts it weighs the
hypothesis, and areas to which it leads are candidates of a comparison. A mark is wrong with a prior probability, which
bounds what it can do.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate, fuse
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.same_place import areas_of
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.registration.area_to_area import MatchMode
from hmt_slam_ros.sensors import MarkObservation
from hmt_slam_ros.topological_inference.candidate_gating import Query, Transition

_VISIT_GAP = 30
"""Keyframe events without an observation after which a visit has ended."""

_MAX_VISITS = 16
"""Visits of a mark; of more the second oldest is forgotten."""

_MAX_MARKS = 1000
"""Marks that are remembered; further ones are not."""

_MEDIAN_DISTANCE2 = 2.366
"""Median of the squared Mahalanobis distance of a right pair of visits, chi-square with 3 degrees of freedom."""

_MAX_HEADING_DEVIATION = 1.0
"""Deviation of a heading from which arcs do not tell whether a mark agrees with them, rad."""

PLACEMENT_COVARIANCE = np.diag([0.1**2, 0.1**2, math.radians(2.0) ** 2])
"""Covariance of a keyframe's pose in its area, and of the motion from an observation to its keyframe."""

_FUSION_PROBABILITY = 0.9
"""Share of right marks that agree so well with a match that both are fused."""


@dataclass(frozen=True, eq=False)
class MarkVisit:
    """Observations of a mark, with few keyframe events between them.

    :ivar first_event: event of the first of them.
    :ivar last_event: event of the last one.
    :ivar keyframe: the keyframe to which the first is relative.
    :ivar pose: belief over ``mark_T_base`` of this keyframe.
    """

    first_event: int
    last_event: int
    keyframe: int
    pose: PoseGaussian


class Anchor(NamedTuple):
    """The keyframe to which observations of an event are relative.

    :ivar keyframe: its number.
    :ivar pose: shape (3,), ``base_T_keyframe``, its pose seen from the robot.
    """

    keyframe: int
    pose: Float64


@dataclass(frozen=True, eq=False)
class MarkMemory:
    """The visits of all marks.

    :ivar visits: {name of a mark: its visits}, the oldest first.
    """

    visits: Mapping[str, tuple[MarkVisit, ...]] = field(default_factory=dict)

    def after_event(
        self, event: int, observations: Sequence[MarkObservation], anchor: Anchor | None, since: int = 0
    ) -> MarkMemory:
        """The memory after a keyframe event.

        :param anchor: of its observations; without one no visit begins.
        :param since: event since which the robot is lost; visits before have ended.
        """
        if not observations:
            return self
        visits = dict(self.visits)
        for observation in observations:
            known = visits.get(observation.name, ())
            if known and known[-1].last_event >= since and event - known[-1].last_event < _VISIT_GAP:
                visits[observation.name] = (*known[:-1], replace(known[-1], last_event=event))
            elif anchor is not None and (known or len(visits) < _MAX_MARKS):
                pose = observation.pose.compose(PoseGaussian.from_pose(anchor.pose))
                kept = known if len(known) < _MAX_VISITS else (known[0], *known[2:])
                visits[observation.name] = (*kept, MarkVisit(event, event, anchor.keyframe, pose))
        return MarkMemory(visits)

    def beginning_visits(self, event: int) -> list[tuple[MarkVisit, tuple[MarkVisit, ...]]]:
        """The visits that begin at an event, each with those before."""
        return [(known[-1], known[:-1]) for known in self.visits.values() if known[-1].first_event == event]

    def repeated_visits(self, keyframes: Collection[int]) -> Iterator[tuple[MarkVisit, tuple[MarkVisit, ...]]]:
        """The newest visits, where they are at one of some keyframes, each with those before, if there are any."""
        for known in self.visits.values():
            if known[-1].keyframe in keyframes and len(known) > 1:
                yield known[-1], known[:-1]

    def without_keyframes(self, pruned: Mapping[int, Anchor | None]) -> MarkMemory:
        """The memory with visits at other keyframes instead of pruned ones, or without them.

        :param pruned: {keyframe: the one in its place, seen from it}.
        """
        if not self.visits or not pruned:
            return self
        moved = {name: tuple(_moved_visits(known, pruned)) for name, known in self.visits.items()}
        return MarkMemory({name: known for name, known in moved.items() if known})

    def restricted_to(self, keyframes: Collection[int]) -> MarkMemory:
        """The memory without visits at other keyframes."""
        lost = {v.keyframe for known in self.visits.values() for v in known} - set(keyframes)
        return self.without_keyframes(dict.fromkeys(lost))


def _moved_visits(visits: Iterable[MarkVisit], pruned: Mapping[int, Anchor | None]) -> Iterator[MarkVisit]:
    for visit in visits:
        anchor = pruned.get(visit.keyframe, visit)
        if isinstance(anchor, Anchor):
            yield replace(visit, keyframe=anchor.keyframe, pose=visit.pose.compose(PoseGaussian.from_pose(anchor.pose)))
        elif anchor is visit:
            yield visit


def nearest_anchor(hybrid_map: HybridMap, area: int, pose: Float64, excluded: Collection[int] = ()) -> Anchor | None:
    """The keyframe of an area that is the nearest to a pose; None without one.

    :param pose: ``area_T_base``, shape (3,).
    :param excluded: keyframes that are not meant.
    """
    poses = {k: other for k, other in hybrid_map.keyframes(area).items() if k not in excluded}
    if not poses:
        return None
    keyframe = min(poses, key=lambda k: (math.hypot(*(poses[k] - pose)[:2]), k))
    return Anchor(keyframe, se2.between(pose, poses[keyframe]))


class AreaMark(NamedTuple):
    """A mark that puts keyframes into a known area.

    :ivar prior: belief over ``area_T_reference`` by the arcs.
    :ivar belief: the same by the mark.
    :ivar mark_gain: likelihood ratio of "it is right, and they are there" to "it tells nothing", less 1.
    """

    prior: PoseGaussian
    belief: PoseGaussian
    mark_gain: float

    @property
    def joint_belief(self) -> PoseGaussian:
        """The belief by arcs and mark; by the mark alone where the arcs hardly know the heading."""
        return self.belief if _is_unknown(self.prior) else fuse([self.belief, self.prior])


class MarkEntry(NamedTuple):
    """Whether keyframes lie in an area's place, by arcs and a mark.

    :ivar belief: over ``area_T_reference`` by the mark.
    :ivar mark_gain: as of :class:`AreaMark`.
    :ivar probability: that they lie in the place, by arcs and mark.
    """

    belief: PoseGaussian
    mark_gain: float
    probability: float

    def shares(self, modes: Sequence[MatchMode]) -> list[float]:
        """The share of each mode of a match in the place, 1 together where one agrees with the mark well."""
        agreements = [agreement2(self.belief.mahalanobis2(mode.pose)) for mode in modes]
        masses = np.exp([mode.log_mass - max(other.log_mass for other in modes) for mode in modes]) * agreements
        total = float(np.sum(masses))
        return [float(mass) / total * max(agreements) if total > 0.0 else 0.0 for mass in masses]


def fuse_with_mark(mode: MatchMode, belief: PoseGaussian) -> MatchMode:
    """A mode with the information of a mark, where both agree.

    :param belief: over the same pose by the mark.
    """
    if belief.mahalanobis2(mode.pose) > chi_square_gate(_FUSION_PROBABILITY):
        return mode
    return mode._replace(pose=fuse([mode.pose, belief]), measured=fuse([mode.measured, belief]))


def total_gain(marks: Mapping[int, MarkEntry]) -> float:
    """The likelihood of all that marks may tell, relative to that they tell nothing: 1 without marks.

    :param marks: {area: entry}.
    """
    return 1.0 + sum(mark.mark_gain for mark in marks.values())


def mix_transition(transition: Transition, marks: Mapping[int, MarkEntry], new_floor: float) -> Transition:
    """The transition model as a mixture of "no mark is right" and "a mark puts the keyframes into an area".

    :param transition: by the arcs.
    :param marks: {area: entry}.
    :param new_floor: smallest probability of new ground.
    """
    if not marks:
        return transition
    total = total_gain(marks)
    inside = {area: min(mark.probability, 1.0 - new_floor) for area, mark in marks.items()}
    known = {area: probability / total for area, probability in transition.known.items()}
    for area, mark in marks.items():
        known[area] = known.get(area, 0.0) + mark.mark_gain * inside[area] / total
    outside = sum(mark.mark_gain * (1.0 - inside[area]) for area, mark in marks.items())
    return Transition(known, (transition.new + outside) / total)


class MarkEvidence:
    """The evidence of visits under a hypothesis."""

    def __init__(self, configuration: Configuration) -> None:
        self._wrong_share = configuration.marks.wrong_share
        self._arc_scale2 = configuration.tsbi.prior_scale**2
        self._cost_limit = configuration.tsbi.prior_limit**2
        self._gate = chi_square_gate(configuration.tsbi.gate_probability)

    def log_likelihood(
        self, hybrid_map: HybridMap, area: int, pose: PoseGaussian, visit: MarkVisit, before: Sequence[MarkVisit]
    ) -> float:
        """Log-likelihood of a visit that begins, relative to one that the map predicts: 0 at most, nats.

        :param pose: belief over ``area_T_base`` of its keyframe, in the robot's area.
        :param before: earlier visits of the mark.
        """
        query = Query(pose, {visit.keyframe: np.zeros(3)})
        pairs = self._pairs(self._locate(hybrid_map, area, before), query, visit, before)
        if not pairs:
            return 0.0
        agreement = sum(self._agreement(pair.prior, pair.belief) for pair in pairs) / len(pairs)
        return math.log(self._wrong_share + (1.0 - self._wrong_share) * agreement)

    def find_areas(
        self, hybrid_map: HybridMap, area: int, query: Query, memory: MarkMemory, excluded: Collection[int]
    ) -> dict[int, AreaMark]:
        """{known area: mark that puts the query there}, as far as the arcs admit it.

        :param area: the area that the query is in.
        :param excluded: areas that are no candidates.
        """
        found: dict[int, AreaMark] = {}
        repeated = list(memory.repeated_visits(query.poses))
        located = self._locate(hybrid_map, area, [one for _, before in repeated for one in before])
        for visit, before in repeated:
            pairs = self._pairs(located, query, visit, before)
            best, shares = dict[int, tuple[float, _VisitPair]](), defaultdict[int, float](float)
            for pair in pairs:
                share = (1.0 - self._wrong_share) * self._agreement(pair.prior, pair.belief) / len(pairs)
                if share > 0.0 and pair.area not in excluded:
                    shares[pair.area] += share
                    best[pair.area] = max(best.get(pair.area, (0.0, pair)), (share, pair), key=lambda one: one[0])
            rest = 1.0 - sum(shares.values())
            for known, share in shares.items():
                pair, other = best[known][1], found.get(known)
                mark_gain = (1.0 + (0.0 if other is None else other.mark_gain)) * (1.0 + share / rest) - 1.0
                found[known] = (
                    AreaMark(pair.prior, pair.belief, mark_gain)
                    if other is None
                    else other._replace(mark_gain=mark_gain)
                )
        return found

    def _locate(self, hybrid_map: HybridMap, area: int, visits: Sequence[MarkVisit]) -> dict[int, _LocatedKeyframe]:
        """{keyframe of a visit: where it is}, of those that an area admits by ``tsbi.prior_limit``."""
        areas = areas_of(hybrid_map, {one.keyframe for one in visits})
        if not areas:
            return {}
        paths = shortest_path_beliefs(hybrid_map, area, self._cost_limit, targets=set(areas.values()))
        return {
            keyframe: _LocatedKeyframe(known, paths[known], hybrid_map.keyframes(known)[keyframe])
            for keyframe, known in areas.items()
            if known in paths
        }

    def _pairs(
        self, located: Mapping[int, _LocatedKeyframe], query: Query, visit: MarkVisit, before: Sequence[MarkVisit]
    ) -> list[_VisitPair]:
        """The relative poses of a visit of the query, and those before that are in the map."""
        reference = PoseGaussian(se2.inverse(query.poses[visit.keyframe]), PLACEMENT_COVARIANCE)
        mark_T_reference = visit.pose.compose(reference)
        pairs = []
        for one in before:
            if (place := located.get(one.keyframe)) is not None:
                arcs = place.path.inverse().compose(query.belief)
                keyframe = PoseGaussian(place.pose, PLACEMENT_COVARIANCE)
                belief = keyframe.compose(one.pose.inverse()).compose(mark_T_reference)
                prior = PoseGaussian(arcs.mean, self._arc_scale2 * arcs.covariance)
                pairs.append(_VisitPair(place.area, prior, belief))
        return pairs

    def _agreement(self, prior: PoseGaussian, belief: PoseGaussian) -> float:
        """How well the arcs predict what a mark says, 0 beyond the gate, 1 for half of the right ones."""
        if _is_unknown(prior):
            return 1.0
        distance2 = prior.mahalanobis2(belief)
        return agreement2(distance2) if distance2 <= self._gate else 0.0


class _LocatedKeyframe(NamedTuple):
    """A keyframe in a map.

    :ivar area: that it is in.
    :ivar path: belief over the pose of this area in the robot's.
    :ivar pose: ``area_T_base``, shape (3,).
    """

    area: int
    path: PoseGaussian
    pose: Float64


class _VisitPair(NamedTuple):
    """Two visits of a mark.

    :ivar area: of the earlier one.
    :ivar prior: belief over ``area_T_reference`` of the query by the arcs.
    :ivar belief: the same by the mark.
    """

    area: int
    prior: PoseGaussian
    belief: PoseGaussian


def _is_unknown(prior: PoseGaussian) -> bool:
    """Whether arcs do not tell the heading."""
    return bool(prior.covariance[2, 2] > _MAX_HEADING_DEVIATION**2)


def agreement2(distance2: float) -> float:
    """How well two visits agree by their squared Mahalanobis distance: 1 for half of the right ones."""
    return math.exp(-0.5 * max(0.0, distance2 - _MEDIAN_DISTANCE2))
