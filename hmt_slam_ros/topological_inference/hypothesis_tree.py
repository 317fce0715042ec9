"""The tree of topological paths: what is remembered of each live one, their PMF, and which of them are kept."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, AreaPair, HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.topological_inference.global_localization import PoseHint


class Reduction(NamedTuple):
    """The hypotheses that stay.

    :ivar indices: shape (n,), int64, ascending indices, each once.
    :ivar weights: shape (n,), their new weights, with the sum of all the old ones.
    """

    indices: NDArray[np.int64]
    weights: NDArray[np.float64]


def reduce_hypotheses(weights: NDArray[np.float64], most: int, generator: np.random.Generator) -> Reduction:
    """Keep at most ``most`` hypotheses.

    Those heavier than a threshold c keep their weight; of the others a stratified draw keeps some at weight c. No
    hypothesis appears twice, the expected weight of each is what it was, and no other such scheme has a smaller
    squared error.

    :param weights: shape (m,), not negative, of distinct hypotheses; those with weight 0 are dropped.
    :param most: N, at least 1.
    :param generator: gives one number where a draw is needed.
    """
    alive = np.flatnonzero(weights > 0.0)
    if alive.size <= most:
        return Reduction(alive, weights[alive])
    c = threshold(weights[alive], most)
    heavy = weights[alive] >= c
    light = alive[~heavy]
    draws = most - int(heavy.sum())
    drawn = light[_draw_stratified(weights[light], draws, float(generator.random()))]
    kept = np.sort(np.concatenate((alive[heavy], drawn)))
    return Reduction(kept, np.where(weights[kept] >= c, weights[kept], weights[light].sum() / max(1, draws)))


def threshold(weights: NDArray[np.float64], most: int) -> float:
    """The c with sum of min(w / c, 1) = N, for more than N positive weights, shape (m,)."""
    falling = np.sort(weights)[::-1]
    rest = np.cumsum(falling[::-1])[::-1]
    # With the k heaviest kept, c = rest / (N - k); k is right where the next weight is below that c.
    for k in range(most):
        c = rest[k] / (most - k)
        if falling[k] < c:
            return float(c)
    return float(falling[most - 1])


def _draw_stratified(weights: NDArray[np.float64], count: int, offset: float) -> NDArray[np.int64]:
    """``count`` different indices, each drawn in proportion to its weight, none of which exceeds the stride."""
    edges = np.cumsum(weights) / weights.sum() * count
    edges[-1] = count
    return np.searchsorted(edges, np.arange(count) + offset, side="right").astype(np.int64)


Covariance = NDArray[np.float64]

# Log-probability per keyframe that wheels and scans both lose the robot: once in 50 km.
_LOG_KIDNAPPING_PRIOR = math.log(1e-5)
# Of the nats by which a scan contradicts, so many are no news: who stands there does so at the next keyframe too.
_CUSUM_DRIFT = 1.0
# Keyframe events for which a doubt is kept.
_CUSUM_WINDOW = 30
# What contradicted less than so much of the most is another matter, of before the robot was displaced.
_ONSET_SHARE = 0.2


@dataclass(frozen=True, eq=False)
class PoseInArea:
    """Where in the map a robot that may be anywhere seems to be.

    :ivar area: a known area.
    :ivar keyframe: of what it saw.
    :ivar pose: shape (3,), ``area_T_base`` of that.
    """

    area: int
    keyframe: int
    pose: Float64


@dataclass(frozen=True, eq=False)
class FalseAlarm:
    """That a robot that takes itself for lost was not displaced: furniture that was moved contradicts, too.

    :ivar tracked_pose: where it is then.
    :ivar probability: of that, by the scans for which it takes itself for lost.
    """

    tracked_pose: PoseInArea
    probability: float


@dataclass(frozen=True, eq=False)
class Tracking:
    """That the place of the robot in the map is known.

    :ivar relocalized_area: the known area in which it was recognized, until it goes over into another one; else None.
    :ivar kind: tells it from ``Lost`` in a document.
    """

    relocalized_area: int | None = None
    kind: Literal["tracking"] = "tracking"


@dataclass(frozen=True, eq=False)
class Lost:
    """That the robot may be anywhere, until it is recognized.

    :ivar since: the keyframe at which the robot arrived it is not known where.
    :ivar false_alarm: where it was then if it was not displaced, where nothing is mapped and nobody carried it; else
        None.
    :ivar pose_hint: where one of the keyframes since then is, as somebody says; else None.
    :ivar candidate: where it was recognized at the last look, if it was.
    :ivar tracked_pose: where it was at ``since`` if it was not displaced, as another hypothesis says; else None.
    :ivar counted_evidence: nats by which what it saw since then speaks for a place elsewhere, as far as that is in the
        hypothesis's weight; None where another one has it there since.
    :ivar kind: tells it from ``Tracking`` in a document.
    """

    since: int
    false_alarm: FalseAlarm | None = None
    pose_hint: PoseHint | None = None
    candidate: PoseInArea | None = None
    tracked_pose: PoseInArea | None = None
    counted_evidence: float | None = 0.0
    kind: Literal["lost"] = "lost"


@dataclass(frozen=True, eq=False)
class HypothesisState:
    """What TSBI remembers of a leaf beside its map; children inherit it.

    :ivar covariances: {keyframe: covariance (3, 3) of ``area_T_base``, right tangent} of the unsettled keyframes: those
        stored in the robot's area since it was entered, and those that came over with it.
    :ivar matched_keyframes: {known area: unsettled keyframes that were compared with it}. A keyframe speaks for or
        against a known area once.
    :ivar local_area_poses: {area: ``current_T_area``} of the areas in the local map besides the robot's own.
    :ivar unmatched_keyframes: the unsettled keyframes that no re-check has looked at.
    :ivar pending_candidates: known areas that the newest of them fitted beside, and in which the robot may be soon.
    :ivar unlinked_overlap: the area of the local map, joined to the robot's own by no arc, in whose place the robot
        seems to be, and for how many keyframe events in a row; or None.
    :ivar kidnapping_evidence: {keyframe event: nats by which its scan contradicted what the robot should have seen}, of
        the latest events since the robot may have been displaced.
    :ivar unstored_poses: {event of these: where the robot was}, where the map stays as it is and does not hold them.
    :ivar localization: whether the place of the robot in the map is known.
    """

    covariances: Mapping[int, Covariance] = field(default_factory=dict)
    matched_keyframes: Mapping[int, frozenset[int]] = field(default_factory=dict)
    local_area_poses: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)
    unmatched_keyframes: tuple[int, ...] = ()
    pending_candidates: tuple[int, ...] = ()
    unlinked_overlap: tuple[int, int] | None = None
    kidnapping_evidence: Mapping[int, float] = field(default_factory=dict)
    unstored_poses: Mapping[int, PoseInArea] = field(default_factory=dict)
    localization: Tracking | Lost = field(default_factory=Tracking)

    @property
    def is_lost(self) -> bool:
        """Whether the robot may be anywhere."""
        return isinstance(self.localization, Lost)

    def after_scan(
        self, event: int, log_kidnapping_ratio: float, unstored_pose: PoseInArea | None = None
    ) -> HypothesisState:
        """After the scan of a keyframe event.

        :param unstored_pose: where the robot was, if the map does not hold that.
        :param log_kidnapping_ratio: log p(scan | the robot was displaced before it) / p(scan | the robot is there),
            nats, by the map of what is around.
        """
        told = log_kidnapping_ratio - _CUSUM_DRIFT
        doubts = {k: nats for k, nats in self.kidnapping_evidence.items() if k > event - _CUSUM_WINDOW}
        if doubts or told > 0.0:
            doubts[event] = told
        if sum(doubts.values()) <= 0.0:
            doubts = {}
        if not doubts and not self.kidnapping_evidence:
            return self
        spots = self.unstored_poses if unstored_pose is None else {**self.unstored_poses, event: unstored_pose}
        return replace(
            self, kidnapping_evidence=doubts, unstored_poses={k: at for k, at in spots.items() if k in doubts}
        )

    @property
    def kidnapping_test(self) -> tuple[float, int]:
        """Log-odds that the robot was displaced of late, and the first keyframe event after that.

        The events since then speak for that together (the test of Page 1954).
        """
        if not self.kidnapping_evidence:
            return -math.inf, 0
        most = max(self.kidnapping_evidence.values())
        first = min(event for event, nats in self.kidnapping_evidence.items() if nats >= _ONSET_SHARE * most)
        return _LOG_KIDNAPPING_PRIOR + sum(
            nats for event, nats in self.kidnapping_evidence.items() if event >= first
        ), first

    def after_keyframe(self, keyframe: int, covariance: Covariance) -> HypothesisState:
        """After a keyframe entered the robot's area."""
        return replace(
            self,
            covariances={**self.covariances, keyframe: covariance},
            unmatched_keyframes=(*self.unmatched_keyframes, keyframe),
        )

    def after_matching(
        self, areas: Sequence[int], keyframes: Sequence[int], pending: tuple[int, ...] = (), *, all_areas: bool = True
    ) -> HypothesisState:
        """After keyframes were compared with known areas.

        :param pending: others, beside which they fitted.
        :param all_areas: whether they were compared with all that come into question.
        """
        added = {area: self.matched_keyframes.get(area, frozenset()) | set(keyframes) for area in areas}
        unchecked = () if all_areas else self.unmatched_keyframes
        return replace(
            self,
            matched_keyframes={**self.matched_keyframes, **added},
            unmatched_keyframes=unchecked,
            pending_candidates=pending,
        )

    def after_overlap(self, area: int | None) -> HypothesisState:
        """After a keyframe event at which the robot seemed to be in ``area`` of the local map, or in none such."""
        times = (
            self.unlinked_overlap[1] if self.unlinked_overlap is not None and self.unlinked_overlap[0] == area else 0
        )
        return replace(self, unlinked_overlap=None if area is None else (area, times + 1))

    def after_area_change(self, covariances: Mapping[int, Covariance]) -> HypothesisState:
        """After the robot entered another area together with the keyframes of ``covariances``."""
        kept = {area: keyframes & covariances.keys() for area, keyframes in self.matched_keyframes.items()}
        compared = {area: keyframes for area, keyframes in kept.items() if keyframes}
        return HypothesisState(
            covariances,
            compared,
            kidnapping_evidence=self.kidnapping_evidence,
            unstored_poses=self.unstored_poses,
            localization=self.localization if isinstance(self.localization, Lost) else Tracking(),
        )


def relative_covariance(
    whole: Covariance, reference: Covariance, reference_T_base: NDArray[np.float64], floor: Covariance
) -> Covariance:
    """Covariance of ``reference_T_base`` where the drift up to the reference is part of that of ``area_T_base``.

    :param whole: of ``area_T_base``, shape (3, 3), right tangent.
    :param reference: of ``area_T_reference``.
    :param floor: the least that is returned.
    """
    ad = se2.adjoint(se2.inverse(reference_T_base))
    values, vectors = np.linalg.eigh(whole - ad @ reference @ ad.T)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T + floor, dtype=np.float64)


class ReducedDistribution(NamedTuple):
    """The distribution over topological paths after a reduction, Eq. (14).

    :ivar indices: shape (n,), int64, ascending: the hypotheses that stay.
    :ivar probabilities: shape (n,); they sum to 1 less ``unexamined``.
    :ivar unexamined: probability of what was not looked at or was dropped for its smallness.
    """

    indices: NDArray[np.int64]
    probabilities: NDArray[np.float64]
    unexamined: float


def normalize_and_reduce(
    log_weights: NDArray[np.float64],
    log_skipped: float,
    unexamined: float,
    most: int,
    least: float,
    generator: np.random.Generator,
) -> ReducedDistribution:
    """Normalize, drop what is tiny, reduce to N.

    :param log_weights: shape (m,), nats, of all hypotheses.
    :param log_skipped: log of the weight, on the same scale, of what was not looked at now.
    :param unexamined: probability of what was not looked at earlier; it keeps its share, as no evidence is computed
        for it.
    :param most: N.
    :param least: probability below which a hypothesis is dropped.
    """
    scale = np.logaddexp(np.logaddexp.reduce(log_weights), log_skipped)
    probabilities = (1.0 - unexamined) * np.exp(log_weights - scale)
    probabilities[(probabilities < least) & (probabilities < probabilities.max())] = 0.0
    reduction = reduce_hypotheses(probabilities, most, generator)
    # What the sum lacks is the skipped, the dropped and what was unexamined before.
    total = float(reduction.weights.sum())
    return ReducedDistribution(reduction.indices, reduction.weights, max(0.0, 1.0 - total))


# Fine alignment brings together what lies so far apart.
_DISTANCE, _ANGLE = 0.5, math.radians(5.0)
_ALIGNED = np.diag([0.5 * _DISTANCE, 0.5 * _DISTANCE, 0.5 * _ANGLE]) ** 2
# Variance of a position, m^2, above which a hypothesis says nothing of it.
_MAX_VARIANCE = 1.0
_EQUIVALENCE_GATE = chi_square_gate(0.95)


@dataclass(frozen=True, eq=False)
class LocalizedHypothesis:
    """Where a hypothesis has the robot.

    :ivar hybrid_map: its map.
    :ivar area: the robot's area.
    :ivar pose: ``area_T_base``, shape (3,).
    :ivar nearby_areas: the areas that the robot is in or beside.
    """

    hybrid_map: HybridMap
    area: int
    pose: NDArray[np.float64]
    nearby_areas: Collection[int]

    @cached_property
    def poses_in_areas(self) -> Mapping[int, NDArray[np.float64]]:
        """{area: ``area_T_base``} of the areas relative to which the hypothesis is certain of the robot's place."""
        found = shortest_path_beliefs(self.hybrid_map, self.area, cost_limit=_MAX_VARIANCE)
        return {area: se2.between(belief.mean, self.pose) for area, belief in found.items()}

    @cached_property
    def closures(self) -> Mapping[AreaPair, ArcValue]:
        """The arcs that closed loops which the definite map leaves open."""
        return self.hybrid_map.pending_closures

    @cached_property
    def removed_arcs(self) -> frozenset[AreaPair]:
        """The definite arcs that the hypothesis lacks."""
        return frozenset(pair for pair, arc in self.hybrid_map.changed_arcs.items() if arc is None)

    def is_equivalent(self, other: LocalizedHypothesis) -> bool:
        """Whether both have the robot at the same place of all areas around that both have, and close the same loops.

        That it is in known ground is a claim of its own, even where the arcs alone would have it there.
        """
        if bool(self.closures) != bool(other.closures) or self.removed_arcs != other.removed_arcs:
            return False
        both = {
            area
            for area in {*self.nearby_areas, *other.nearby_areas}
            if self._has_areas(area) and other._has_areas(area)
        }
        return (
            bool(both)
            and all(self._agrees_on_pose(other, area) for area in both)
            and all(other._implies_closure(pair, arc) for pair, arc in self.closures.items())
            and all(self._implies_closure(pair, arc) for pair, arc in other.closures.items())
        )

    def _has_areas(self, *areas: int) -> bool:
        return all(map(self.hybrid_map.has_area, areas))

    def _implies_closure(self, pair: AreaPair, arc: ArcValue) -> bool:
        """Whether an arc of another hypothesis is no news: this one has the two areas there, and is certain of it or
        closed that loop itself.

        Areas that only the other has are not asked for.
        """
        if not self._has_areas(*pair):
            return True
        own = self.closures.get(pair)
        known = self._certain_pose(pair, arc) if own is None else own.pose
        return known is not None and _admits(arc.pose, known.mean)

    def _certain_pose(self, pair: AreaPair, arc: ArcValue) -> PoseGaussian | None:
        """Where the hypothesis has the second of two areas seen from the first, if it is not much less certain of that
        than an arc is.
        """
        limit = max(_MAX_VARIANCE, 4.0 * float(np.trace(arc.pose.covariance[:2, :2])))
        return shortest_path_beliefs(self.hybrid_map, pair[0], limit, targets=pair[1:]).get(pair[1])

    def _agrees_on_pose(self, other: LocalizedHypothesis, area: int) -> bool:
        here, there = self.poses_in_areas.get(area), other.poses_in_areas.get(area)
        return here is not None and there is not None and _is_close(here, there)


def _is_close(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    apart = se2.between(one, other)
    return math.hypot(apart[0], apart[1]) <= _DISTANCE and abs(float(apart[2])) <= _ANGLE


def _admits(belief: PoseGaussian, pose: NDArray[np.float64]) -> bool:
    """Whether a belief, after fine alignment, may come to be at a pose."""
    return belief.mahalanobis2(PoseGaussian(pose, _ALIGNED)) <= _EQUIVALENCE_GATE


def merge_equivalent(hypotheses: Sequence[LocalizedHypothesis], log_weights: Sequence[float]) -> dict[int, float]:
    """{number of a claim: log of the weight of all that say the same}, the heaviest of each first."""
    found: dict[int, float] = {}
    for number in sorted(range(len(hypotheses)), key=lambda n: (-log_weights[n], n)):
        same = next((kept for kept in found if hypotheses[kept].is_equivalent(hypotheses[number])), number)
        found[same] = float(np.logaddexp(found.get(same, -math.inf), log_weights[number]))
    return found
