"""What landmarks say of where a lost robot is: the log score of looks at a map, with and without them as a prior."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.landmark_scans import keyframes_of
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_families, chosen_seeds
from hmt_slam_ros.agreement import Clutter
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.offline.runtime import Run
from hmt_slam_ros.processes.place_prior import PlacePrior
from hmt_slam_ros.processes.replica import Replica
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.topology.closure_search import ClosureSearch
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.located import Located
from hmt_slam_ros.topology.whereabouts import UNMAPPED, Whereabouts

Array = NDArray[np.float64]

SEEDS = 2
"""Buildings of every kind."""

WORLDS = ("office", "busy", "institute", "nested")

LOOKS, KEYFRAMES = 15, 6
"""Looks from inside of each map, and as many from outside; and keyframes that the robot saw until then."""

SURE = 0.8
"""Probability from which on a look takes a place for the right one, as TSBI's second one in a row does."""

EXPONENTS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
ALIKE = tuple(np.arange(-2.0, 10.5, 0.5).tolist())
"""What is tried for ``places.prior_temper`` and ``places.prior_alike``."""

# The map is of this share of the first of two rounds; who is inside is so near to one of its keyframes, m, who is
# outside as far from all.
_MAPPED, _INSIDE, _OUTSIDE = 0.6, 1.0, 4.0
_RIGHT, _RIGHT_ANGLE = 1.0, math.radians(20.0)
_DRIFT = np.array([0.01, 0.01, math.radians(0.2)])  # from keyframe to keyframe, m, m, rad
_DRAWS = 2011
# Scans within which the robot has seen as many keyframes, or stands still.
_MOST = 400

POLICY = (
    f"A building is mapped for {_MAPPED:g} of a round. A robot that wakes up looks where it is in that map once it saw "
    f"{KEYFRAMES} keyframes: inside, of the second round, within {_INSIDE:g} m of keyframes of the map, and outside, "
    f"farther than {_OUTSIDE:g} m from all of them. Log score is minus the logarithm of the probability of where it "
    f"is, a right place being off by {_RIGHT:g} m and {math.degrees(_RIGHT_ANGLE):.0f} degrees at most, or of the map "
    f"not reaching there; looks from outside weigh {UNMAPPED:g} in all, as in the prior. Found is where a place has a "
    f"probability of {SURE:g}. The best constant in the stead of landmarks says what a smaller prior for the map would "
    "do alone. A look from inside among whose places the right one is not has no score, as no prior helps it."
)


class Look(NamedTuple):
    """A look.

    :ivar inside: whether the robot is where the map reaches.
    :ivar where: by surfaces alone.
    :ivar right: shape (n,), which of the places are right.
    :ivar ratios: shape (n,), what landmarks say of them, nats; zeros where they say nothing.
    :ivar told: whether they say anything.
    :ivar seconds: CPU time of surfaces and of landmarks.
    """

    inside: bool
    where: Whereabouts
    right: NDArray[np.bool_]
    ratios: Array
    told: bool
    seconds: tuple[float, float]


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
        for name, temper, alike in _priors(own, places.prior_temper, places.prior_alike):
            scored = scored_with(own, temper, alike)
            inside = sum(look.inside for look in own)
            shares = [f"{100.0 * share:.0f} %" for share in scored[1:]]
            rows.append([world, str(inside), str(len(own) - inside), name, f"{scored.score:.3f}", *shares])
    without, asked = (scored_with(every, *of) for of in ((0.0, 0.0), (places.prior_temper, places.prior_alike)))
    report.requirements += [
        Requirement("log score with landmarks / without", asked.score / without.score, 1.0),
        Requirement("found from inside with landmarks / without", asked.found / without.found, math.inf, least=0.95),
        Requirement("found from outside, with landmarks", asked.outside, without.outside),
    ]
    spent = 1e3 * np.mean([look.seconds for look in every], axis=0)
    report.body += [
        table(head, rows),
        f"Best of all that was tried on these looks: {_told(fitted(every, EXPONENTS))}. A look takes "
        f"{spent[0]:.0f} ms by surfaces, and {spent[1]:.0f} ms more by landmarks, the map's being gathered anew in "
        "each building.",
        POLICY,
    ]
    return report


def _priors(looks: Sequence[Look], temper: float, alike: float) -> list[tuple[str, float, float]]:
    """Names, exponents and bounds of what is compared."""
    constant = fitted(looks, (0.0,))[1]
    return [("none", 0.0, 0.0), (f"a constant, {-constant:g}", 0.0, constant), ("landmarks", temper, alike)]


def _told(fit: tuple[float, float]) -> str:
    return f"an exponent of {fit[0]:g}, and {fit[1]:g} nats of what looks alike"


def looks_of(world: str, seed: int, configuration: Configuration) -> Iterator[Look]:
    """Looks at the map of a part of a building."""
    log = open_simulated(f"sim:{world},seed={seed},laps=2")
    stamps, poses = log.scenario.scan_stamps, log.scenario.true_poses(log.scenario.scan_stamps)
    last = int(0.5 * _MAPPED * len(stamps))
    run = Run(replace(configuration, seed=seed))
    for record in log.records():
        if record.measurement.stamp > stamps[last]:
            break
        run.read(record)
    replica = Replica.of(run.state.tsbi.replica)
    newest = run.recorder.keyframes[max(run.recorder.keyframes)]
    clutter = next(leaf.clutter for leaf in newest.leaves if leaf.hypothesis == replica.best)
    hybrid_map, scans = replica.maps[replica.best], dict(replica.scans)
    true = {k: log.true_poses(np.array([scan.stamp]))[0] for k, scan in scans.items()}
    search, prior = ClosureSearch(configuration, scans), PlacePrior(configuration, scans)
    draw, before = np.random.default_rng([_DRAWS, seed]), max(scans) + 1
    for inside, numbers in _starts(poses, np.array(list(true.values())), last, configuration, draw):
        seen = dict(enumerate(numbers, start=before))
        scans.update({k: log.scenario.scan(n) for k, n in seen.items()})
        drift = np.cumsum(_DRIFT * draw.standard_normal((len(numbers), 3)), axis=0)
        placed = se2.compose(se2.between(poses[numbers[0]], poses[numbers]), drift)
        asked = dict(zip(seen, placed, strict=True))
        yield _looked(search, prior, hybrid_map, asked, before, clutter, true, inside, poses[numbers[-1]])
        search.found()


def _starts(
    poses: Array, known: Array, last: int, configuration: Configuration, draw: np.random.Generator
) -> Iterator[tuple[bool, list[int]]]:
    """Whether a robot is in the map, and the scans that it sees, one after the other.

    :param poses: shape (n, 3), of all scans.
    :param known: shape (k, 3), of the keyframes of the map.
    :param last: number of the last scan of the map.
    """
    away = np.array([np.hypot(*(known[:, :2] - pose[:2]).T).min() for pose in poses])
    for inside in (True, False):
        wanted = LOOKS
        first = len(poses) // 2 if inside else last
        for start in draw.permutation(np.arange(first, len(poses))).tolist():
            numbers = [start + k for k in keyframes_of(poses[start:][:_MOST], configuration)[:KEYFRAMES]]
            apart = away[numbers]
            if len(numbers) == KEYFRAMES and ((apart <= _INSIDE) if inside else (apart >= _OUTSIDE)).all():
                yield inside, numbers
                wanted -= 1
            if not wanted:
                break


def _looked(
    search: ClosureSearch,
    prior: PlacePrior,
    hybrid_map: HybridMap,
    asked: dict[int, Array],
    before: int,
    clutter: Clutter,
    true: dict[int, Array],
    inside: bool,
    at: Array,
) -> Look:
    """A look.

    :param clutter: what contradicts the map usually, as metric SLAM has learnt.
    :param true: {keyframe of the map: ``world_T_base``}.
    :param at: ``world_T_base`` of the newest keyframe.
    """
    begin = time.process_time()
    where = search.everywhere(hybrid_map, asked, before, clutter)
    middle = time.process_time()
    ratios = prior.log_ratios(hybrid_map, asked, before, where.found)
    spent = middle - begin, time.process_time() - middle
    newest = asked[max(asked)]
    right = np.array([_is_right(hybrid_map, one, newest, true, at) for one in where.found], dtype=np.bool_)
    told = ratios is not None
    return Look(inside, where, right, np.zeros(len(right)) if ratios is None else ratios, told, spent)


def _is_right(hybrid_map: HybridMap, located: Located, newest: Array, true: dict[int, Array], at: Array) -> bool:
    """Whether a place is where the robot is, by the keyframe of the area that is nearest to it."""
    pose, placed = se2.compose(located.mode.pose.mean, newest), hybrid_map.keyframes(located.area)
    nearest = min(placed, key=lambda k: math.dist(placed[k][:2], pose[:2]))
    off = se2.between(at, se2.compose(true[nearest], se2.between(placed[nearest], pose)))
    return bool(math.hypot(off[0], off[1]) <= _RIGHT and abs(off[2]) <= _RIGHT_ANGLE)


def scored_with(looks: Sequence[Look], temper: float, alike: float) -> Scored:
    """What comes of looks where landmarks count with an exponent, and against what looks alike."""
    scores: dict[bool, list[float]] = {True: [], False: []}
    found, wrong, outside = [], [], []
    for look in looks:
        weights = temper * look.ratios - alike if look.told or not temper else np.zeros(len(look.ratios))
        probabilities = look.where.weighed(weights).probabilities
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


def fitted(looks: Sequence[Look], exponents: Sequence[float]) -> tuple[float, float]:
    """The exponent and the bound of the least log score."""
    tried = [(exponent, alike) for exponent in exponents for alike in ALIKE]
    return min(tried, key=lambda of: scored_with(looks, *of).score)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan
