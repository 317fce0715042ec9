"""The tree of topological paths: the state of each live hypothesis, PMF and reduction."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.messages import MotionCondition
from hmt_slam_ros.topological_inference.area_comparison import OngoingComparison
from hmt_slam_ros.topological_inference.global_localization import GlobalSearch
from hmt_slam_ros.topological_inference.kidnapping_evidence import (
    CUSUM_DRIFT,
    EVIDENCE_WINDOW,
    cusum_since,
    log_displacement_ratio,
)
from hmt_slam_ros.topological_inference.kidnapping_prior import KidnappingCounts, KidnappingPriors, add_counts
from hmt_slam_ros.topological_inference.search_prior import PoseHint
from hmt_slam_ros.topological_inference.surroundings_change import Surroundings

Covariance = Float64

_ONSET_SHARE = 0.2
"""Smallest share of the largest evidence with which the kidnapping can begin."""


class Reduction(NamedTuple):
    """The hypotheses that stay.

    :ivar indices: shape (n,), int64, ascending indices, each once.
    :ivar weights: shape (n,), their new weights, with the sum of all the old ones.
    """

    indices: Int64
    weights: Float64


def reduce_hypotheses(weights: Float64, most: int, generator: np.random.Generator) -> Reduction:
    """At most ``most`` hypotheses, by the resampling of Fearnhead and Clifford (2003).

    Those heavier than a threshold c keep their weight; of the others a stratified draw keeps some at weight c. No
    hypothesis appears twice, and expected weights stay the same. No such scheme has a smaller squared error.

    :param weights: shape (m,), not negative, of distinct hypotheses; those with weight 0 are dropped.
    :param most: N, at least 1.
    :param generator: of the number that a draw needs.
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


def threshold(weights: Float64, most: int) -> float:
    """The c with sum of min(w / c, 1) = N, for more than N positive weights, shape (m,)."""
    descending = np.sort(weights)[::-1]
    rest = np.cumsum(descending[::-1])[::-1]
    # With the k heaviest kept, c = rest / (N - k); k is right where the next weight is below that c.
    for k in range(most):
        c = rest[k] / (most - k)
        if descending[k] < c:
            return float(c)
    return float(descending[most - 1])


def _draw_stratified(weights: Float64, count: int, offset: float) -> Int64:
    """``count`` different indices, each drawn in proportion to its weight, none of which exceeds the stride."""
    edges = np.cumsum(weights) / weights.sum() * count
    edges[-1] = count
    return np.searchsorted(edges, np.arange(count) + offset, side="right").astype(np.int64)


@dataclass(frozen=True, eq=False)
class PoseInArea:
    """The pose of a keyframe in an area.

    :ivar area: a known area.
    :ivar keyframe: its number.
    :ivar pose: shape (3,), ``area_T_base`` of the keyframe.
    """

    area: int
    keyframe: int
    pose: Float64


@dataclass(frozen=True, eq=False)
class FalseAlarm:
    """The alternative that a lost robot was not kidnapped, but that furniture was moved.

    :ivar tracked_pose: the robot's pose then.
    :ivar probability: of that, by the scans that made it lost.
    :ivar motion_condition: of the motion in which it would have been kidnapped.
    """

    tracked_pose: PoseInArea
    probability: float
    motion_condition: MotionCondition


@dataclass(frozen=True, eq=False)
class Tracking:
    """The pose of the robot in the map is known.

    :ivar relocalized_area: the known area in which it was relocalized, until it changes its area; else None.
    :ivar kind: distinguishes it from ``Lost`` in a document.
    """

    relocalized_area: int | None = None
    kind: Literal["tracking"] = "tracking"


@dataclass(frozen=True, eq=False)
class Lost:
    """The robot may be anywhere in the map of before, until it is relocalized.

    :ivar since: the first keyframe after the robot was lost.
    :ivar false_alarm: the alternative to a kidnapping, in localization; else None.
    :ivar pose_hint: for one of the keyframes since then; else None.
    :ivar candidate: the pose that the last search found, if it did.
    :ivar plausible_areas: the areas in which the robot may be by that search, and those around; the next one is made
        there. None for the whole map.
    :ivar tracked_pose: the pose at ``since`` without a kidnapping, in mapping; else None.
    :ivar search: of the map, while it goes on; else None.
    :ivar searched: the newest keyframe of the last search, -1 before the first.
    :ivar unknown: the newest keyframe of those that are on unmapped ground for certain, -1 for none.
    :ivar counted_evidence: log Bayes factor for a pose elsewhere that is in the hypothesis's weight, nats; None behind
        a wide arc, and after a relocalized hypothesis was split off.
    :ivar kind: distinguishes it from ``Tracking`` in a document.
    """

    since: int
    false_alarm: FalseAlarm | None = None
    pose_hint: PoseHint | None = None
    candidate: PoseInArea | None = None
    plausible_areas: frozenset[int] = frozenset()
    tracked_pose: PoseInArea | None = None
    search: GlobalSearch | None = None
    searched: int = -1
    unknown: int = -1
    counted_evidence: float | None = 0.0
    kind: Literal["lost"] = "lost"


class KidnappingTest(NamedTuple):
    """The result of a test for a kidnapping.

    :ivar log_odds: of a kidnapping.
    :ivar since: the first keyframe event since which scans contradict.
    :ivar condition: of the motion in which it would have been.
    """

    log_odds: float
    since: int
    condition: MotionCondition


@dataclass(frozen=True, eq=False)
class HypothesisState:
    """What TSBI remembers of a hypothesis beside its map; children inherit it.

    :ivar covariances: {keyframe: covariance (3, 3) of ``area_T_base``, right tangent} of the keyframes stored in the
        robot's area since it was entered, and those that moved there with it.
    :ivar matched_keyframes: {known area: those of them that were compared with it}. A keyframe counts for or against a
        known area once.
    :ivar local_area_poses: {area: ``current_T_area``} of the areas in the submap besides the robot's own.
    :ivar unmatched_keyframes: those of them that no re-check has compared.
    :ivar pending_candidates: known areas beside which the newest of them fitted, and which the robot may enter soon.
    :ivar comparison: of some of them with known areas, while it goes on; else None.
    :ivar unlinked_overlap: the area of the submap in whose place the robot is, if no arc joins it to the robot's own,
        and for how many keyframe events in a row; or None.
    :ivar kidnapping_evidence: {keyframe event: CUSUM increment, nats} of the latest events since the robot may have
        been kidnapped.
    :ivar onset_conditions: {event of these: condition of the motion to it} where that is not ordinary.
    :ivar kidnapping_counts: counts of keyframe events and kidnappings, this map's.
    :ivar surroundings: what explains the contradictions if the robot was not kidnapped.
    :ivar unstored_poses: {event of these: the robot's pose} of scans that the map does not hold.
    :ivar localization: tracking, or lost.
    :ivar statement_evidence: log-likelihood of statements that is in the hypothesis's weight, nats; None where TLCA
        weighed it, as much as it is for the map.
    :ivar compared_statement: the newest statement whose areas were compared.
    """

    covariances: Mapping[int, Covariance] = field(default_factory=dict)
    matched_keyframes: Mapping[int, frozenset[int]] = field(default_factory=dict)
    local_area_poses: Mapping[int, Float64] = field(default_factory=dict)
    unmatched_keyframes: tuple[int, ...] = ()
    pending_candidates: tuple[int, ...] = ()
    comparison: OngoingComparison | None = None
    unlinked_overlap: tuple[int, int] | None = None
    kidnapping_evidence: Mapping[int, float] = field(default_factory=dict)
    onset_conditions: Mapping[int, MotionCondition] = field(default_factory=dict)
    kidnapping_counts: KidnappingCounts = field(default_factory=dict)
    surroundings: Surroundings = field(default_factory=Surroundings)
    unstored_poses: Mapping[int, PoseInArea] = field(default_factory=dict)
    localization: Tracking | Lost = field(default_factory=Tracking)
    statement_evidence: float | None = 0.0
    compared_statement: int = 0

    @property
    def is_lost(self) -> bool:
        """Whether the hypothesis is lost."""
        return isinstance(self.localization, Lost)

    def after_motion(self, event: int, condition: MotionCondition, priors: KidnappingPriors) -> HypothesisState:
        """The state after the motion to a keyframe event, before its scan.

        Faults that are usual in this map are not remembered: an onset that scans show later loses little against them.
        """
        counts = add_counts(self.kidnapping_counts, condition, events=1)
        more = priors.log_odds(condition, counts) - priors.log_odds("ordinary", counts)
        is_telling = more > CUSUM_DRIFT - math.log(priors.aliasing)
        conditions = {**self.onset_conditions, event: condition} if is_telling else self.onset_conditions
        return replace(self, kidnapping_counts=counts, onset_conditions=conditions)

    def after_scan(
        self,
        event: int,
        log_ends: float,
        log_walls: float,
        priors: KidnappingPriors,
        unstored_pose: PoseInArea | None = None,
    ) -> HypothesisState:
        """The state after the scan of a keyframe event.

        :param log_ends: log-likelihood ratio of the ends of its beams in the submap, "not kidnapped" to "kidnapped",
            nats.
        :param log_walls: that of the walls of the submap that they hit or pass.
        :param unstored_pose: the robot's pose, if the map does not hold the scan.
        """
        surroundings = self.surroundings.update(log_ends, log_walls)
        increment = -surroundings.log_likelihood - CUSUM_DRIFT
        evidence = {k: nats for k, nats in self.kidnapping_evidence.items() if k > event - EVIDENCE_WINDOW}
        if evidence or increment > 0.0 or event in self.onset_conditions:
            evidence[event] = increment
        evidence = self._relevant_evidence(evidence, priors)
        if not evidence and not self.kidnapping_evidence:
            return replace(self, surroundings=surroundings, onset_conditions={})
        poses = self.unstored_poses if unstored_pose is None else {**self.unstored_poses, event: unstored_pose}
        return replace(
            self,
            kidnapping_evidence=evidence,
            onset_conditions={k: condition for k, condition in self.onset_conditions.items() if k in evidence},
            surroundings=surroundings,
            unstored_poses={k: pose for k, pose in poses.items() if k in evidence},
        )

    def _relevant_evidence(self, evidence: dict[int, float], priors: KidnappingPriors) -> dict[int, float]:
        """The evidence since the first event since which a kidnapping became more probable than an ordinary one.

        That is the oldest event, or one after a motion that was not ordinary.
        """
        ordinary = priors.log_odds("ordinary", self.kidnapping_counts)
        for first in sorted({*list(evidence)[:1], *self.onset_conditions.keys() & evidence.keys()}):
            if self._prior_log_odds(first, priors) - ordinary + self._statistic(evidence, first, priors) > 0.0:
                return {event: nats for event, nats in evidence.items() if event >= first}
        return {}

    def _statistic(self, evidence: Mapping[int, float], first: int, priors: KidnappingPriors) -> float:
        """The evidence of scans for a kidnapping before an event, nats."""
        if first in self.onset_conditions:
            return log_displacement_ratio(evidence, first, priors.aliasing)
        return cusum_since(evidence, first)

    def _prior_log_odds(self, event: int, priors: KidnappingPriors) -> float:
        return priors.log_odds(self.onset_condition(event), self.kidnapping_counts)

    def kidnapping_test(self, priors: KidnappingPriors) -> KidnappingTest | None:
        """The test for a recent kidnapping (CUSUM, Page 1954); None where the scans do not contradict on the whole.

        The kidnapping was before the first event since which scans contradict, or before an earlier one after a motion
        that was not ordinary, whichever is more probable: between the two the robot may be in a similar place
        (docs/decisions/0068-after-a-gap.md).
        """
        evidence = self.kidnapping_evidence
        least = _ONSET_SHARE * max(evidence.values(), default=0.0)
        onset = min((event for event, nats in evidence.items() if nats >= least > 0.0), default=None)
        if onset is None:
            return None
        tests = [
            KidnappingTest(self._prior_log_odds(first, priors) + statistic, onset, self.onset_condition(first))
            for first in sorted({onset, *self._faults_until(onset)})
            if (statistic := self._statistic(evidence, first, priors)) > self._least_statistic(first)
        ]
        return max(tests, key=lambda test: test.log_odds, default=None)

    def _least_statistic(self, first: int) -> float:
        """The evidence that scans since an event have to exceed, nats: after a fault more than clutter has."""
        return CUSUM_DRIFT if first in self.onset_conditions else 0.0

    def _faults_until(self, event: int) -> list[int]:
        """The events of the evidence after motions that were not ordinary, up to an event."""
        return [first for first in self.onset_conditions if first in self.kidnapping_evidence and first <= event]

    def onset_condition(self, event: int) -> MotionCondition:
        """The condition of the motion to a keyframe event of the evidence."""
        return self.onset_conditions.get(event, "ordinary")

    def after_kidnapping(self, condition: MotionCondition) -> HypothesisState:
        """The state of a hypothesis in which the robot was kidnapped in a motion."""
        counts = add_counts(self.kidnapping_counts, condition, kidnappings=1)
        return replace(self, kidnapping_counts=counts)

    def without_kidnapping_evidence(self) -> HypothesisState:
        """The state without the evidence of a kidnapping, once that was weighed."""
        return replace(self, kidnapping_evidence={}, onset_conditions={})

    def after_keyframe(self, keyframe: int, covariance: Covariance) -> HypothesisState:
        """The state after a keyframe was stored in the robot's area."""
        return replace(
            self,
            covariances={**self.covariances, keyframe: covariance},
            unmatched_keyframes=(*self.unmatched_keyframes, keyframe),
        )

    def after_matching(
        self, areas: Sequence[int], keyframes: Sequence[int], pending: tuple[int, ...] = (), *, all_areas: bool = True
    ) -> HypothesisState:
        """The state after keyframes were compared with known areas. Keyframes that came since are without a match.

        :param pending: other areas, beside which they fitted.
        :param all_areas: whether they were compared with all candidates.
        """
        newer = tuple(k for k in self.unmatched_keyframes if k > max(keyframes, default=math.inf))
        added = {area: self.matched_keyframes.get(area, frozenset()) | set(keyframes) for area in areas}
        return replace(
            self,
            matched_keyframes={**self.matched_keyframes, **added},
            unmatched_keyframes=newer if all_areas else self.unmatched_keyframes,
            pending_candidates=pending,
            comparison=None,
        )

    def after_overlap(self, area: int | None) -> HypothesisState:
        """The state after an event with the robot in the place of ``area`` without an arc to it, or of none such."""
        before, count = self.unlinked_overlap or (None, 0)
        return replace(self, unlinked_overlap=None if area is None else (area, count + 1 if area == before else 1))

    def after_area_change(self, covariances: Mapping[int, Covariance]) -> HypothesisState:
        """The state after the robot entered another area together with the keyframes of ``covariances``."""
        matched = {area: keyframes & covariances.keys() for area, keyframes in self.matched_keyframes.items()}
        return HypothesisState(
            covariances,
            {area: keyframes for area, keyframes in matched.items() if keyframes},
            kidnapping_evidence=self.kidnapping_evidence,
            onset_conditions=self.onset_conditions,
            kidnapping_counts=self.kidnapping_counts,
            surroundings=self.surroundings,
            unstored_poses=self.unstored_poses,
            localization=self.localization if isinstance(self.localization, Lost) else Tracking(),
            statement_evidence=self.statement_evidence,
            compared_statement=self.compared_statement,
        )


def relative_covariance(
    whole: Covariance, reference: Covariance, reference_T_base: Float64, floor: Covariance
) -> Covariance:
    """Covariance of ``reference_T_base``, shape (3, 3), if that of ``area_T_base`` includes that of the reference.

    :param whole: of ``area_T_base``, shape (3, 3), right tangent.
    :param reference: of ``area_T_reference``.
    :param floor: is added.
    """
    ad = se2.adjoint(se2.inverse(reference_T_base))
    values, vectors = np.linalg.eigh(whole - ad @ reference @ ad.T)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T + floor, dtype=np.float64)


class ReducedDistribution(NamedTuple):
    """The distribution over topological paths after a reduction, Eq. (14).

    :ivar indices: shape (n,), int64, ascending: the hypotheses that stay.
    :ivar probabilities: shape (n,); they sum to 1 less ``unexamined``.
    :ivar unexamined: probability of what was not examined, or dropped as too improbable.
    """

    indices: Int64
    probabilities: Float64
    unexamined: float


def normalize_and_reduce(
    log_weights: Float64, log_skipped: float, unexamined: float, most: int, least: float, generator: np.random.Generator
) -> ReducedDistribution:
    """The distribution of hypotheses, without the improbable ones, reduced to N.

    :param log_weights: shape (m,), nats, of all hypotheses.
    :param log_skipped: log of the weight, on the same scale, of what was not examined now.
    :param unexamined: probability of what was not examined earlier; it keeps its share, as it has no evidence.
    :param most: N.
    :param least: probability below which a hypothesis is dropped.
    """
    scale = np.logaddexp(np.logaddexp.reduce(log_weights), log_skipped)
    probabilities = (1.0 - unexamined) * np.exp(log_weights - scale)
    probabilities[(probabilities < least) & (probabilities < probabilities.max())] = 0.0
    reduction = reduce_hypotheses(probabilities, most, generator)
    rest = max(0.0, 1.0 - float(reduction.weights.sum()))
    return ReducedDistribution(reduction.indices, reduction.weights, rest)
