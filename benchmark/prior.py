"""What landmarks say of where a lost robot is: the log score of looks at a map, with and without them as a prior."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmark.looks import INSIDE, KEYFRAMES, LOOKS, OUTSIDE, RIGHT, RIGHT_ANGLE, Look, Looks, map_of, simulated_drive
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_families, chosen_seeds
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.places.relocalization_prior import counted
from hmt_slam_ros.topological_inference.global_localization import UNMAPPED

SEEDS = 2
"""Buildings of every kind."""

WORLDS = ("office", "busy", "institute", "nested")

SURE = 0.8
"""Probability from which on a look takes a place for the right one, as TSBI's second one in a row does."""

EXPONENTS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0)
"""What is tried for ``places.prior_temper``."""

CONSTANTS: tuple[float, ...] = tuple(np.arange(-2.0, 10.5, 0.5).tolist())
"""What is tried in the stead of landmarks, nats."""

Weights = Callable[[Look], Float64]

# The map is of this share of the first of two rounds.
_MAPPED = 0.6

POLICY = (
    f"A building is mapped for {_MAPPED:g} of a round. A robot that wakes up looks where it is in that map once it saw "
    f"{KEYFRAMES} keyframes: inside, of the second round, within {INSIDE:g} m of keyframes of the map, and outside, "
    f"farther than {OUTSIDE:g} m from all of them. Log score is minus the logarithm of the probability of where it "
    f"is, a right place being off by {RIGHT:g} m and {math.degrees(RIGHT_ANGLE):.0f} degrees at most, or of the map "
    f"not reaching there; looks from outside weigh {UNMAPPED:g} in all, as in the prior. Found is where a place has a "
    f"probability of {SURE:g}. The best constant in the stead of landmarks says what a smaller prior for the map would "
    "do alone. A look from inside among whose places the right one is not has no score, as no prior helps it."
)


class Scored(NamedTuple):
    """What came of looks.

    :ivar score: log score, nats.
    :ivar found: share of the looks from inside that found the right place.
    :ivar wrong: that found a wrong one, from inside; likewise ``outside``, that found any.
    """

    score: float
    found: float
    wrong: float
    outside: float


def measure_prior(settings: Settings) -> Report:
    """Map buildings in part, and look where a robot is in them."""
    chosen, seeds = chosen_families(settings, WORLDS), chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    looks = {world: [look for seed in seeds for look in looks_of(world, seed, configuration)] for world in chosen}
    places = configuration.places
    report = Report("prior", "Landmarks as the prior of where a lost robot is", seeds=seeds)
    head = ["world", "looks from inside", "outside", "prior", "log score", "found", "wrong", "found from outside"]
    rows, every = [], [look for own in looks.values() for look in own]
    for world, own in {**looks, "**all**": every}.items():
        for name, weights in _priors(own, places.prior_temper):
            scored = scored_with(own, weights)
            inside = sum(look.inside for look in own)
            shares = [f"{100.0 * share:.0f} %" for share in scored[1:]]
            rows.append([world, str(inside), str(len(own) - inside), name, f"{scored.score:.3f}", *shares])
    without, asked = scored_with(every), scored_with(every, by_landmarks(places.prior_temper))
    report.requirements += [
        Requirement("log score with landmarks / without", asked.score / without.score, 1.0),
        Requirement("found from inside with landmarks / without", asked.found / without.found, math.inf, least=0.95),
        Requirement("found from outside, with landmarks", asked.outside, without.outside),
    ]
    spent = 1e3 * np.mean([look.seconds for look in every], axis=0)
    report.body += [
        table(head, rows),
        f"Best of all that was tried on these looks: an exponent of {fitted(every):g}. A look takes "
        f"{spent[0]:.0f} ms by surfaces, and {spent[1]:.0f} ms more by landmarks, the map's being gathered anew in "
        "each building.",
        POLICY,
    ]
    return report


def _priors(looks: Sequence[Look], temper: float) -> list[tuple[str, Weights]]:
    """What is compared, and its name."""
    constant = best_constant(looks)
    by_constant = by_a_constant(constant)
    return [("none", by_nothing), (f"a constant, {-constant:g}", by_constant), ("landmarks", by_landmarks(temper))]


def by_nothing(look: Look) -> Float64:
    """Places count by their surfaces alone."""
    return np.zeros(len(look.right))


def by_a_constant(constant: float) -> Weights:
    """The map counts so much less, nats, than it does."""
    return lambda look: np.full(len(look.right), -constant)


def by_landmarks(temper: float) -> Weights:
    """Landmarks count with an exponent."""
    return lambda look: counted(look.ratios, temper)


def looks_of(world: str, seed: int, configuration: Configuration, most: int = LOOKS) -> Iterator[Look]:
    """Looks at the map of a part of a building, from inside and from outside."""
    drive = simulated_drive(f"sim:{world},seed={seed},laps=2")
    seeded = replace(configuration, seed=seed)
    part = map_of(drive, int(0.5 * _MAPPED * len(drive.poses)), seeded)
    return Looks(drive, part, seeded).taken(len(drive.poses) // 2, most)


def scored_with(looks: Sequence[Look], weights: Weights = by_nothing) -> Scored:
    """What comes of looks whose places count so much more, nats."""
    scores: dict[bool, list[float]] = {True: [], False: []}
    found, wrong, outside = [], [], []
    for look in looks:
        probabilities = look.where.weighed(weights(look)).probabilities
        right = float(probabilities[look.right].sum()) if look.inside else 1.0 - float(probabilities.sum())
        if not look.inside or look.right.any():
            scores[look.inside].append(-math.log(max(right, 1e-12)))
        sure = probabilities >= SURE
        if look.inside:
            found.append(bool((sure & look.right).any()))
            wrong.append(bool((sure & ~look.right).any()))
        else:
            outside.append(bool(sure.any()))
    score = (1.0 - UNMAPPED) * _mean(scores[True]) + UNMAPPED * _mean(scores[False])
    return Scored(score, _mean(found), _mean(wrong), _mean(outside))


def fitted(looks: Sequence[Look]) -> float:
    """The exponent of the least log score."""
    return min(EXPONENTS, key=lambda exponent: scored_with(looks, by_landmarks(exponent)).score)


def best_constant(looks: Sequence[Look]) -> float:
    """What the map counts less, nats, for the least log score without landmarks."""
    return min(CONSTANTS, key=lambda constant: scored_with(looks, by_a_constant(constant)).score)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan
