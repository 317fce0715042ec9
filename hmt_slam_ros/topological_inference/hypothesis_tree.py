"""The tree of topological paths: what is remembered of each live one, their PMF, and which of them are kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.topological_inference.global_localization import Told


class Reduction(NamedTuple):
    """The hypotheses that stay.

    :ivar kept: shape (n,), int64, ascending indices, each once.
    :ivar weights: shape (n,), their new weights, with the sum of all the old ones.
    """

    kept: NDArray[np.int64]
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
    drawn = light[_stratified(weights[light], draws, float(generator.random()))]
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


def _stratified(weights: NDArray[np.float64], count: int, offset: float) -> NDArray[np.int64]:
    """``count`` different indices, each drawn in proportion to its weight, none of which exceeds the stride."""
    edges = np.cumsum(weights) / weights.sum() * count
    edges[-1] = count
    return np.searchsorted(edges, np.arange(count) + offset, side="right").astype(np.int64)


Covariance = NDArray[np.float64]

# Log-probability per keyframe that wheels and scans both lose the robot: once in 50 km.
_DISPLACED = math.log(1e-5)
# Of the nats by which a scan contradicts, so many are no news: who stands there does so at the next keyframe too.
_LASTING = 1.0
# Keyframe events for which a doubt is kept.
_KEPT = 30
# What contradicted less than so much of the most is another matter, of before the robot was displaced.
_MATTER = 0.2


@dataclass(frozen=True, eq=False)
class Spot:
    """Where in the map a robot that may be anywhere seems to be.

    :ivar area: a known area.
    :ivar keyframe: of what it saw.
    :ivar pose: shape (3,), ``area_T_base`` of that.
    """

    area: int
    keyframe: int
    pose: Float64


@dataclass(frozen=True, eq=False)
class Stay:
    """That a robot that takes itself for lost was not displaced: furniture that was moved contradicts, too.

    :ivar spot: where it is then.
    :ivar probability: of that, by the scans for which it takes itself for lost.
    """

    spot: Spot
    probability: float


@dataclass(frozen=True, eq=False)
class LeafNotes:
    """What TSBI remembers of a leaf beside its map; children inherit it.

    :ivar covariances: {keyframe: covariance (3, 3) of ``area_T_base``, right tangent} of the unsettled keyframes: those
        stored in the robot's area since it was entered, and those that came over with it.
    :ivar compared: {known area: unsettled keyframes that were compared with it}. A keyframe speaks for or against a
        known area once.
    :ivar local: {area: ``current_T_area``} of the areas in the local map besides the robot's own.
    :ivar unchecked: the unsettled keyframes that no re-check has looked at.
    :ivar beside: known areas that the newest of them fitted beside, and in which the robot may be soon.
    :ivar astray: the area of the local map, joined to the robot's own by no arc, in whose place the robot seems to be,
        and for how many keyframe events in a row; or None.
    :ivar doubts: {keyframe event: nats by which its scan contradicted what the robot should have seen}, of the latest
        events since the robot may have been displaced.
    :ivar spots: {event of these: where the robot was}, where the map stays as it is and does not hold them.
    :ivar lost: the keyframe at which the robot arrived it is not known where, until that is recognized; else None.
    :ivar stay: where it was then if it was not displaced, where nothing is mapped and nobody carried it; else None.
    :ivar told: where one of the keyframes since then is, as somebody says; else None.
    :ivar sighted: where it was recognized at the last look, if it was.
    :ivar found: the known area in which it was recognized, until it goes over into another one; else None.
    :ivar claim: where it was at ``lost`` if it was not displaced, as another hypothesis says; else None.
    :ivar credit: nats by which what it saw since then speaks for a place elsewhere, as far as that is in the
        hypothesis's weight; None where another one has it there since.
    """

    covariances: Mapping[int, Covariance] = field(default_factory=dict)
    compared: Mapping[int, frozenset[int]] = field(default_factory=dict)
    local: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)
    unchecked: tuple[int, ...] = ()
    beside: tuple[int, ...] = ()
    astray: tuple[int, int] | None = None
    doubts: Mapping[int, float] = field(default_factory=dict)
    spots: Mapping[int, Spot] = field(default_factory=dict)
    lost: int | None = None
    stay: Stay | None = None
    told: Told | None = None
    sighted: Spot | None = None
    found: int | None = None
    claim: Spot | None = None
    credit: float | None = 0.0

    def heard(self, event: int, doubt: float, spot: Spot | None = None) -> LeafNotes:
        """After the scan of a keyframe event.

        :param spot: where the robot was, if the map does not hold that.
        :param doubt: log p(scan | the robot was displaced before it) / p(scan | the robot is there), nats, by the map
            of what is around.
        """
        told = doubt - _LASTING
        doubts = {k: nats for k, nats in self.doubts.items() if k > event - _KEPT}
        if doubts or told > 0.0:
            doubts[event] = told
        if sum(doubts.values()) <= 0.0:
            doubts = {}
        if not doubts and not self.doubts:
            return self
        spots = self.spots if spot is None else {**self.spots, event: spot}
        return replace(self, doubts=doubts, spots={k: at for k, at in spots.items() if k in doubts})

    @property
    def displaced(self) -> tuple[float, int]:
        """Log-odds that the robot was displaced of late, and the first keyframe event after that.

        The events since then speak for that together (the test of Page 1954).
        """
        if not self.doubts:
            return -math.inf, 0
        most = max(self.doubts.values())
        first = min(event for event, nats in self.doubts.items() if nats >= _MATTER * most)
        return _DISPLACED + sum(nats for event, nats in self.doubts.items() if event >= first), first

    def stored(self, keyframe: int, covariance: Covariance) -> LeafNotes:
        """After a keyframe entered the robot's area."""
        return replace(
            self, covariances={**self.covariances, keyframe: covariance}, unchecked=(*self.unchecked, keyframe)
        )

    def checked(
        self, areas: Sequence[int], keyframes: Sequence[int], beside: tuple[int, ...] = (), *, all_areas: bool = True
    ) -> LeafNotes:
        """After keyframes were compared with known areas.

        :param beside: others, beside which they fitted.
        :param all_areas: whether they were compared with all that come into question.
        """
        added = {area: self.compared.get(area, frozenset()) | set(keyframes) for area in areas}
        unchecked = () if all_areas else self.unchecked
        return replace(self, compared={**self.compared, **added}, unchecked=unchecked, beside=beside)

    def seen_in(self, area: int | None) -> LeafNotes:
        """After a keyframe event at which the robot seemed to be in ``area`` of the local map, or in none such."""
        times = self.astray[1] if self.astray is not None and self.astray[0] == area else 0
        return replace(self, astray=None if area is None else (area, times + 1))

    def entered(self, covariances: Mapping[int, Covariance]) -> LeafNotes:
        """After the robot entered another area together with the keyframes of ``covariances``."""
        kept = {area: keyframes & covariances.keys() for area, keyframes in self.compared.items()}
        compared = {area: keyframes for area, keyframes in kept.items() if keyframes}
        return LeafNotes(
            covariances,
            compared,
            doubts=self.doubts,
            spots=self.spots,
            lost=self.lost,
            stay=self.stay,
            told=self.told,
            sighted=self.sighted,
            claim=self.claim,
            credit=self.credit,
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


class Settled(NamedTuple):
    """The distribution over topological paths after a reduction, Eq. (14).

    :ivar kept: shape (n,), int64, ascending: the hypotheses that stay.
    :ivar probabilities: shape (n,); they sum to 1 less ``unexamined``.
    :ivar unexamined: probability of what was not looked at or was dropped for its smallness.
    """

    kept: NDArray[np.int64]
    probabilities: NDArray[np.float64]
    unexamined: float


def settle(
    log_weights: NDArray[np.float64],
    log_skipped: float,
    unexamined: float,
    most: int,
    least: float,
    generator: np.random.Generator,
) -> Settled:
    """Normalise, drop what is tiny, reduce to N.

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
    return Settled(reduction.kept, reduction.weights, max(0.0, 1.0 - total))
