"""A belief over places: how soon a lost robot knows where it is, in corridors that are drawn from the model itself."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from benchmark.belief_corridors import ROUGH, drawn_building, random_corridors
from benchmark.belief_world import drawn_observation, drawn_of_present
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_families, chosen_seeds
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.places.observation import observation_model
from hmt_slam_ros.places.observation_graph import chosen
from hmt_slam_ros.places.place_graph import PlaceGraph, node_of, place_graph, turned
from hmt_slam_ros.places.position_belief import Travel, flat_belief

SEEDS = 100
"""Worlds of every family."""


class Family(NamedTuple):
    """What corridors are like.

    :ivar density: of the corners of a kind, 1/m.
    :ivar stands: whether what is there, and where exactly, is drawn once for a world, else anew at every look.
    :ivar looks: whether landmarks are looked at; else there is only the way from opening to opening.
    """

    density: float
    stands: bool
    looks: bool = True


FAMILIES = {
    "model": Family(0.05, stands=False),
    "standing": Family(0.05, stands=True),
    "bare": Family(0.01, stands=True),
    "distances": Family(0.05, stands=True, looks=False),
}

_ROWS, _COLUMNS = 1, 2
_ARRIVALS = 12  # of a run
_AFTER = 3  # nodes without an error after which a recovery counts
_BETWEEN = 2.0  # m, from one look to the next on the way
_NOISE = (0.02, 0.02)  # deviations of odometry: of the distance by the distance, and of the turn, rad
_ALONG = 0.1  # deviation of the place at which an opening is noticed, m
_RECOVERED, _WRONG, _CALIBRATED = 0.95, 0.005, 0.03

POLICY = (
    "**These worlds are the model's own: random corridors with landmarks that are extracted, missed and invented as "
    "places/observation.py has it, with the densities of the parameters. No laser was simulated, and nothing here "
    f"says that real scans are like that.** A hallway that {_COLUMNS} others cross, with doors; of an edge the map "
    "knows the length to 3 % and of a landmark the place to 5 cm; the landmarks' p_lmap is 0.6 to 1. In *standing*, "
    "*bare* and *distances*, what is there and where exactly is drawn once for a world, as in a building; in *model* "
    "anew at every look, as the belief takes it to be. In *bare* there are a fifth of the corners, in *distances* no "
    "landmark is looked at. A robot begins somewhere with a flat belief and goes straight on, at the end of a hallway "
    f"it turns (paper, section 4.2). It looks at every opening that it notices, and every {_BETWEEN:g} m in between; "
    "some openings it passes without notice, and it takes none for one where there is none. States and metres: to the "
    f"first estimate that is confident and right, from which the estimates at the next {_AFTER} nodes are right too, "
    "as in the paper's table 3 (10 runs: all recovered, after 2.11 states and 13.7 m on average). A run is "
    f"{_ARRIVALS} openings long. Estimates: after every look, or arrival where nothing is "
    "looked at. The paper's share of confident wrong ones, 0.5 %, is of robots that were not lost at first. Expected "
    "calibration error: of the most probable state, over ten bins of equal width."
)


class Estimate(NamedTuple):
    """A belief and what is true.

    :ivar arrivals: openings noticed so far.
    :ivar metres: travelled so far.
    :ivar probability: of the most likely state.
    :ivar confident: whether the belief is.
    :ivar right: whether that state is the true one.
    """

    arrivals: int
    metres: float
    probability: float
    confident: bool
    right: bool


class World(NamedTuple):
    """A map and what it is a map of.

    :ivar family: of the world.
    :ivar graph: the map.
    :ivar truth: the graph of the building; the map itself where nothing was drawn once.
    :ivar existence: shape (nodes,), of the openings of the building.
    """

    family: Family
    graph: PlaceGraph
    truth: PlaceGraph
    existence: Float64


def measure_belief(settings: Settings) -> Report:
    """Let robots that are lost find their place."""
    chosen = chosen_families(settings, tuple(FAMILIES))
    seeds = chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    runs = {name: [run_of(FAMILIES[name], seed, configuration) for seed in seeds] for name in chosen}
    report = Report("belief", "A belief over places", seeds=seeds)
    for name in chosen:
        if FAMILIES[name].looks:
            report.requirements += _requirements(name, runs[name])
    report.body += [_recovery_table(runs), _estimate_table(runs), POLICY]
    return report


def run_of(family: Family, seed: int, configuration: Configuration) -> list[Estimate]:
    """The estimates of one run."""
    random = np.random.default_rng(seed)
    drive = Drive(random, world_of(random, family, configuration), configuration)
    return [estimate for _ in range(_ARRIVALS) for estimate in drive.to_next_opening()]


def world_of(random: np.random.Generator, family: Family, configuration: Configuration) -> World:
    """A random world of a family."""
    known = random_corridors(random, _ROWS, _COLUMNS, family.density)
    there = drawn_building(random, known) if family.stands else known
    graph, truth = (place_graph(each.nodes, each.edges, configuration.places) for each in (known, there))
    return World(family, graph, truth, np.array([node.existence for node in there.nodes]))


class Drive:
    """A robot that begins somewhere and goes straight on, and turns where it cannot."""

    def __init__(self, random: np.random.Generator, world: World, configuration: Configuration) -> None:
        self._random, self._world, self._places = random, world, configuration.places
        self._model = observation_model(configuration.places, configuration.features)
        self._belief = flat_belief(world.graph, configuration.places)
        self._state = int(random.choice(np.flatnonzero(world.truth.following >= 0)))
        self._since, self._beside, self._metres, self._arrivals = 0.0, random.normal(0.0, _ALONG), 0.0, 0

    def to_next_opening(self) -> Iterator[Estimate]:
        """The estimates from the opening where the robot is to that at which it notices the next one."""
        if not self._arrivals:
            self._look()
            yield self._estimate()
        elif self._world.truth.following[self._state] < 0:
            self._state, self._belief = turned(self._state, 2), self._belief.turned(2)
        at, noticed = self._state, False
        while not noticed:
            yield from self._along_edge(at)
            at = int(self._world.truth.following[at])
            end = self._world.truth.following[at] < 0
            noticed = end or self._random.random() < self._world.existence[node_of(at)] * self._places.noticed
        self._arrive(at)
        yield self._estimate()

    def _along_edge(self, state: int) -> Iterator[Estimate]:
        length = float(self._world.truth.lengths[state])
        if not self._world.family.stands:
            length = max(0.5 * length, self._random.normal(length, ROUGH * length))
        looks = math.ceil(length / _BETWEEN) - 1
        for _ in range(looks):
            self._go(_BETWEEN)
            if self._world.family.looks:
                self._belief = self._belief.gone_on(_BETWEEN)
                self._look()
                yield self._estimate()
        self._go(length - looks * _BETWEEN)

    def _go(self, distance: float) -> None:
        self._since, self._metres = self._since + distance, self._metres + distance

    def _arrive(self, state: int) -> None:
        beside = self._random.normal(0.0, _ALONG)
        noise = _NOISE[0] * self._since
        distance = self._random.normal(self._since - self._beside + beside, noise)
        variances = noise**2 + 2.0 * _ALONG**2, _NOISE[1] ** 2
        travel = Travel(max(0.0, distance), self._random.normal(0.0, _NOISE[1]), variances)
        self._belief = self._belief.arrived(travel)
        self._state, self._since, self._beside, self._arrivals = state, 0.0, beside, self._arrivals + 1
        self._look()

    def _look(self) -> None:
        if not self._world.family.looks:
            return
        expected = self._world.truth.expected
        around = chosen(expected.landmarks, slice(*expected.starts[self._state : self._state + 2].tolist()))
        variance = _ALONG**2 + (_NOISE[0] * self._since) ** 2
        if self._world.family.stands:
            there = np.ones(len(around.tracks), np.bool_)
            seen = drawn_of_present(self._random, around, there, self._since + self._beside, self._model)
        else:
            seen = drawn_observation(self._random, around, self._since, variance, self._model)
        self._belief = self._belief.observed(seen, self._model, self._since, variance)

    def _estimate(self) -> Estimate:
        belief = self._belief
        right = belief.most_likely == self._state
        return Estimate(self._arrivals, self._metres, float(belief.probabilities.max()), belief.confident, right)


def recovery(estimates: Sequence[Estimate]) -> Estimate | None:
    """The first confident and right estimate with none wrong at the next nodes; None as long as there is none."""
    first: Estimate | None = None
    for k, estimate in enumerate(estimates):
        if not estimate.right:
            first = None
        elif first is None and estimate.confident:
            first = estimate
        last = k + 1 == len(estimates) or estimates[k + 1].arrivals > estimate.arrivals
        if first is not None and last and estimate.arrivals - first.arrivals >= _AFTER:
            return first
    return None


def _requirements(name: str, runs: Sequence[Sequence[Estimate]]) -> list[Requirement]:
    estimates = [estimate for run in runs for estimate in run]
    wrong = float(np.mean([estimate.confident and not estimate.right for estimate in estimates]))
    recovered = float(np.mean([recovery(run) is not None for run in runs]))
    return [
        Requirement(f"{name}: recovered", recovered, 1.0, least=_RECOVERED),
        Requirement(f"{name}: estimates that are confident and wrong", wrong, _WRONG),
        Requirement(f"{name}: expected calibration error", calibration_error(estimates), _CALIBRATED),
    ]


def calibration_error(estimates: Sequence[Estimate]) -> float:
    """Of the most likely state, over ten bins."""
    peaks = np.array([estimate.probability for estimate in estimates])
    right = np.array([estimate.right for estimate in estimates])
    bins = np.minimum(9, (10.0 * peaks).astype(int))
    return float(np.abs(np.bincount(bins, peaks - right)).sum()) / len(peaks)


def _recovery_table(runs: dict[str, list[list[Estimate]]]) -> str:
    head = ["family", "runs", "recovered", "states, mean", "min", "max", "metres, mean", "min", "max"]
    rows = []
    for name, own in runs.items():
        found = [estimate for run in own if (estimate := recovery(run)) is not None]
        row = [name, str(len(own)), f"{100.0 * len(found) / len(own):.1f} %"]
        for values, digits in (([e.arrivals for e in found], 0), ([e.metres for e in found], 1)):
            extremes = (f"{value:.{digits}f}" for value in (min(values), max(values))) if found else ("-", "-")
            row += [f"{np.mean(values):.2f}" if found else "-", *extremes]
        rows.append(row)
    return table(head, rows)


def _estimate_table(runs: dict[str, list[list[Estimate]]]) -> str:
    head = ["family", "estimates", "right", "confident", "confident and wrong", "calibration error"]
    rows = []
    for name, own in runs.items():
        estimates = [estimate for run in own for estimate in run]
        sure = [estimate for estimate in estimates if estimate.confident]
        wrong = sum(not estimate.right for estimate in sure)
        shares = (sum(e.right for e in estimates), len(sure), wrong)
        row = [f"{100.0 * share / len(estimates):.2f} %" for share in shares]
        rows.append([name, str(len(estimates)), *row, f"{calibration_error(estimates):.3f}"])
    return table(head, rows)
