"""TSBI's PMF against an exact enumeration of all topologies, on small worlds."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.scripted import STEP, Robot, Script, UnboundedWork
from benchmark.settings import Settings
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.hybrid_map.surroundings import areas_around
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, Replica
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.topological_inference.area_comparison import ComparisonKind, OngoingComparison
from hmt_slam_ros.topological_inference.branches import Child, Parent
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.candidate_gating import AreaCandidate, Query
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState
from hmt_slam_ros.topological_inference.map_search import MapSearch
from hmt_slam_ros.topological_inference.marks import AreaMark
from hmt_slam_ros.topological_inference.tsbi import Tsbi

WORLDS = {
    "ring": "ring,size=0.7",
    "ring, short sight": "ring,size=0.7,range=3,beams=61",
    "four crossings": "grid,size=0.7,count=1",
    "four crossings, short sight": "grid,size=0.7,count=1,range=3,beams=61",
    "nine crossings": "grid,size=0.7,count=2",
    "nine crossings, short sight": "grid,size=0.7,count=2,range=3,beams=61",
    "office": "office,size=0.7",
}
"""{name: simulated world}."""

HYPOTHESES = (1, 2, 4, 8, 16, 32)
"""Values of tsbi.max_hypotheses."""

SEEDS, VISITS = 2, 8

LIMIT = 0.05
"""Largest mean distance with the number of hypotheses of the parameter file."""

_KEYFRAMES = 6  # of a visit
_EQUAL = 1e-6  # distances that differ by less are the same

POLICY = (
    f"Drives of {VISITS} area visits, each of {_KEYFRAMES} keyframes at equal distances along the whole route; between "
    "keyframes dead reckoning errs by 2 cm and half a degree, times the noise. No hypothesis is accepted, and "
    "candidates in known ground are searched at cuts only (tsbi.recheck_keyframes is out of reach). The enumeration "
    "compares the keyframes with every known area that the arcs do not exclude, searches modes in all but 1e-9 of the "
    "prior, and keeps all of them down to a probability of 1e-9. It shares with TSBI the transition model, the "
    "likelihoods, and the changes of the map. The figure is the total variation distance of the distributions over the "
    "areas of all visits, after every cut from the first one on at which a known area was possible. Unexamined and "
    "dropped hypotheses of TSBI count as wrong. With uninformative scans (tsbi.temper 0.03), many topologies stay "
    "alive and the reduction has to choose. With odometry that errs by 8 cm and 2 degrees in 1 to 3 m there are no "
    "requirements: similar corridors fit so well that the enumeration keeps poses five deviations off. The gate on the "
    "prior (tsbi.gate_probability) excludes these on purpose, and topologies of 1e-9 become probable again."
)

Visits = tuple[int, ...]
"""The area of every visit, named by its first visit."""

NEGLIGIBLE = 1e-9
"""Probability below which a topology is dropped."""

_EVERYWHERE = 1.0 - 1e-9  # share of the prior in which poses are searched for
_DPI = 110


class Regime(NamedTuple):
    """The conditions of a comparison.

    :ivar name: for the tables.
    :ivar worlds: names of ``WORLDS``.
    :ivar noises: factors on the deviations of the odometry.
    :ivar changes: parameters that differ from the file.
    :ivar required: whether the distance has to be small.
    """

    name: str
    worlds: tuple[str, ...]
    noises: tuple[float, ...]
    changes: tuple[str, ...] = ()
    required: bool = True


REGIMES = (
    Regime("as it is", tuple(WORLDS), (1.0, 2.0, 3.0)),
    Regime("uninformative scans", ("ring", "four crossings", "nine crossings"), (2.0, 4.0), ("tsbi.temper=0.03",)),
    Regime("odometry beyond use", tuple(WORLDS), (4.0,), required=False),
)


class KeyframeStop(NamedTuple):
    """A keyframe event of a drive.

    :ivar step: the motion since the last one as the odometry has it, shape (3,).
    :ivar scan: the keyframe's.
    :ivar cut: how many of the newest keyframes leave the area.
    """

    step: Float64
    scan: Scan
    cut: int


class ComparedDrive(NamedTuple):
    """The scores of one drive.

    :ivar regime: name of the regime.
    :ivar world: name of the world.
    :ivar distances: {number of hypotheses: total variation distance after every cut that counts}.
    :ivar topologies: largest number of topologies of the enumeration.
    :ivar dropped: upper bound of the probability that it dropped.
    """

    regime: str
    world: str
    distances: dict[int, list[float]]
    topologies: int
    dropped: float


def measure_oracle(settings: Settings) -> Report:
    """Enumerate and compare."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("oracle", "TSBI against exact enumeration", seeds=seeds)
    usual = settings.configuration.tsbi.max_hypotheses
    rows, pictured = [], {}
    for regime in REGIMES:
        drives = [
            compare_drive(regime, world, seed, noise, settings.changes)
            for world in regime.worlds
            for noise in regime.noises
            for seed in seeds
        ]
        means = pictured[regime.name] = mean_distances(drives)
        if regime.required:
            report.requirements += oracle_requirements(regime.name, means, usual)
        rows += [_table_row(regime.name, world, [d for d in drives if d.world == world]) for world in regime.worlds]
        rows.append(_table_row(regime.name, "all", drives))
        report.data[regime.name] = [drive._asdict() for drive in drives]
    head = ["scans and odometry", "world", "drives", "cuts", "topologies at most", *(f"N = {n}" for n in HYPOTHESES)]
    report.body += [table(head, rows), POLICY]
    report.pictures["oracle.png"] = "Mean distance to the exact distribution against the number of hypotheses."
    plot_oracle(settings.out / "oracle.png", pictured, LIMIT)
    return report


def drive_stops(world: str, seed: int, noise: float) -> list[KeyframeStop]:
    """A drive along the whole route of a simulated world.

    :param noise: factor on the deviations of the odometry.
    """
    log = open_simulated(world)
    poses = log.true_poses(log.scenario.stamps[:: log.scenario.settings.readings])
    driven = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))))
    at = np.searchsorted(driven, np.linspace(0.0, driven[-1], VISITS * _KEYFRAMES + 1)[:-1])
    random = np.random.default_rng(seed)
    errors = se2.exp(noise * random.multivariate_normal(np.zeros(3), STEP, size=len(at)))
    steps = [np.zeros(3), *(se2.between(poses[a], poses[b]) for a, b in pairwise(at))]
    return [
        KeyframeStop(
            se2.compose(step, error) if k else step,
            log.scenario.scan(int(at[k])),
            _KEYFRAMES if k >= _KEYFRAMES and k % _KEYFRAMES == _KEYFRAMES - 1 else 0,
        )
        for k, (step, error) in enumerate(zip(steps, errors, strict=True))
    ]


def compare_drive(regime: Regime, world: str, seed: int, noise: float, changes: Sequence[str]) -> ComparedDrive:
    """Enumerate a drive, and run TSBI on it with every number of hypotheses.

    :param changes: parameters that differ from the file, beside those of the regime.
    """
    changes = (*regime.changes, *changes)
    drive = drive_stops(f"sim:{WORLDS[world]},seed={seed}", seed, noise)
    enumeration = Enumeration(_configuration(changes), noise)
    exact, counts, most_topologies = [], [], 1
    for stop in drive:
        pmf = enumeration.keyframe(*stop)
        if stop.cut:
            exact.append(pmf)
            counts.append(enumeration.has_candidates)
            most_topologies = max(most_topologies, enumeration.topology_count)
    distances = {}
    for hypotheses in HYPOTHESES:
        pmfs = run_tsbi(drive, _configuration((*changes, f"tsbi.max_hypotheses={hypotheses}")), noise)
        distances[hypotheses] = [
            total_variation(p, q) for p, q, is_counted in zip(exact, pmfs, counts, strict=True) if is_counted
        ]
    return ComparedDrive(regime.name, world, distances, most_topologies, enumeration.dropped)


def _configuration(changes: Sequence[str]) -> Configuration:
    return load_configuration(PARAMETERS, ["tsbi.recheck_keyframes=1000", *changes])


def run_tsbi(drive: Sequence[KeyframeStop], configuration: Configuration, noise: float) -> list[dict[Visits, float]]:
    """TSBI's PMF after every cut, without unexamined and dropped probability."""
    script = Script(Tsbi(configuration, _UnboundedBranching), noise=noise)
    paths: dict[int, tuple[Visits, dict[int, int]]] = {FIRST_HYPOTHESIS: ((0,), {0: 0})}
    pmfs = []
    for stop in drive:
        hypotheses = script.keyframe(*stop).hypotheses
        before, paths = paths, {}
        pmf: dict[Visits, float] = defaultdict(float)
        for hypothesis in hypotheses:
            path, named = before[hypothesis.parent]
            if stop.cut:
                named = {hypothesis.area: len(path), **named}
                path = (*path, named[hypothesis.area])
            paths[hypothesis.id] = path, named
            pmf[path] += hypothesis.probability
        if stop.cut:
            pmfs.append(dict(pmf))
    return pmfs


def total_variation(exact: Mapping[Visits, float], found: Mapping[Visits, float]) -> float:
    """Total variation distance; what ``found`` lacks to 1 counts as another path."""
    lacking = max(0.0, 1.0 - sum(found.values()))
    return 0.5 * (lacking + sum(abs(exact.get(path, 0.0) - found.get(path, 0.0)) for path in {**exact, **found}))


def mean_distances(drives: Sequence[ComparedDrive]) -> dict[int, float]:
    """{number of hypotheses: mean distance over all cuts that count}, NaN if there are none."""
    pooled = {n: [distance for drive in drives for distance in drive.distances[n]] for n in HYPOTHESES}
    return {n: float(np.mean(own)) if own else float("nan") for n, own in pooled.items()}


def oracle_requirements(regime: str, means: Mapping[int, float], usual: int) -> list[Requirement]:
    """Requirements on the distance, and on its decrease with the number of hypotheses.

    :param usual: number of hypotheses of the parameter file.
    """
    rises = max(b - a for a, b in pairwise(means.values()))
    return [
        Requirement(f"{regime}: mean total variation distance with {usual} hypotheses", means[usual], LIMIT),
        Requirement(f"{regime}: largest rise of the mean where the hypotheses are doubled", rises, _EQUAL),
    ]


def _table_row(regime: str, world: str, drives: Sequence[ComparedDrive]) -> list[str]:
    cuts = sum(len(drive.distances[HYPOTHESES[0]]) for drive in drives)
    most = max(drive.topologies for drive in drives)
    means = [f"{mean:.4f}" for mean in mean_distances(drives).values()]
    return [regime, world, str(len(drives)), str(cuts), str(most), *means]


class _UnboundedSearch(ClosureSearch):
    """A closure search that compares at one event, however much work that is: no area abstraction repeats a cut."""

    def __init__(self, configuration: Configuration, scans: Mapping[int, Scan]) -> None:
        super().__init__(configuration, scans)
        self.work = UnboundedWork()


class _UnboundedBranching(Branching):
    """A branching with that search."""

    def __init__(self, configuration: Configuration, replica: Replica) -> None:
        super().__init__(configuration, replica)
        self.search = _UnboundedSearch(configuration, replica.scans)
        self.map_search = MapSearch(configuration, replica.scans, self.search.work)


class _EverywhereSearch(_UnboundedSearch):
    """A closure search in all areas, with the same likelihoods."""

    def __init__(self, configuration: Configuration, scans: Mapping[int, Scan]) -> None:
        super().__init__(configuration, scans)
        self._settings = replace(self._settings, gate=chi_square_gate(_EVERYWHERE), margin=25.0, max_modes=1000)
        self._options = replace(self._options, max_modes=1000)

    def begin_comparison(
        self,
        hybrid_map: HybridMap,
        area: int,
        query: Query,
        compare_drive: Mapping[int, Collection[int]],
        excluded: Collection[int],
        most: int,
        kind: ComparisonKind = "recheck",
        only: Collection[int] = (),
        marks: Mapping[int, AreaMark] | None = None,
    ) -> OngoingComparison:
        """Compare as ``ClosureSearch`` does, with all areas."""
        del most, only, marks
        unmatched = {
            known: {k: pose for k, pose in query.poses.items() if k not in compare_drive.get(known, ())}
            for known in hybrid_map.area_ids()
            if known not in excluded
        }
        beliefs = shortest_path_beliefs(hybrid_map, area)
        candidates = {
            known: AreaCandidate(self.gating.prior(beliefs[known], query), own, 1.0)
            for known, own in unmatched.items()
            if 2 * len(own) >= len(query.poses)
        }
        elsewhere = self.gating.classify_areas(hybrid_map, area, query, excluded)[2]
        return OngoingComparison(query, frozenset(excluded), kind, candidates, {}, tuple(elsewhere))


@dataclass(frozen=True, eq=False)
class _Topology:
    """A topology of the enumeration, with its map.

    :ivar path: its areas by visits.
    :ivar named: {area: its first visit}.
    :ivar log_weight: log of its probability.
    """

    path: Visits
    named: dict[int, int]
    hybrid_map: HybridMap
    state: HypothesisState
    robot: Robot
    log_weight: float

    @property
    def parent(self) -> Parent:
        """The parent hypothesis of the next event."""
        return Parent(FIRST_HYPOTHESIS, self.robot.area, self.hybrid_map, self.state, self.log_weight)


class Enumeration:
    """All topologies of a drive.

    :ivar dropped: upper bound of the probability of the dropped topologies.
    :ivar has_candidates: whether any known area was possible so far, by the arcs.
    """

    def __init__(self, configuration: Configuration, noise: float = 1.0) -> None:
        """:param noise: factor on the deviations of the odometry."""
        self._noise = noise
        self._replica = Replica()
        self._branching = Branching(configuration, self._replica)
        self._branching.search = _EverywhereSearch(configuration, self._replica.scans)
        self._topologies = [_Topology((0,), {0: 0}, HybridMap(), HypothesisState(), Robot(), 0.0)]
        self._sequence = -1
        self.dropped = 0.0
        self.has_candidates = False

    @property
    def topology_count(self) -> int:
        """Current number of topologies."""
        return len(self._topologies)

    def keyframe(self, step: Float64, scan: Scan, cut: int = 0) -> dict[Visits, float]:
        """Process a keyframe event as :meth:`benchmark.scripted.Script.keyframe`; return {path: probability}."""
        self._sequence += 1
        self._replica.scans[self._sequence] = scan
        self._branching.begin_event()
        points = self._branching.search.surface_points(scan)
        topologies = [self._reweight(self._add_keyframe(topology, step), points) for topology in self._topologies]
        if cut:
            newest = range(self._sequence + 1 - cut, self._sequence + 1)
            topologies = [child for topology in topologies for child in self._children(topology, newest)]
        self._topologies = self._normalize(topologies)
        pmf: dict[Visits, float] = defaultdict(float)
        for topology in self._topologies:
            pmf[topology.path] += math.exp(topology.log_weight)
        return dict(pmf)

    def _add_keyframe(self, topology: _Topology, step: Float64) -> _Topology:
        """The topology with the newest keyframe in the robot's area."""
        robot = topology.robot.move(step, self._noise)
        topology.hybrid_map.set_keyframe(self._sequence, robot.area, robot.pose.mean)
        return replace(
            topology, robot=robot, state=topology.state.after_keyframe(self._sequence, robot.pose.covariance)
        )

    def _reweight(self, topology: _Topology, points: Float64) -> _Topology:
        """The topology, reweighted by the newest scan in known ground."""
        pose = topology.robot.pose.mean
        found = self._branching.reweight_by_known_ground(topology.parent, pose, points, self._sequence)
        return replace(topology, log_weight=found.log_weight)

    def _children(self, topology: _Topology, newest: Sequence[int]) -> Iterator[_Topology]:
        branches = self._branching.cut(topology.parent, newest)
        self.has_candidates |= any(child.state.matched_keyframes for child in branches.children)
        for child in branches.children:
            yield self._continue(topology, child)

    def _continue(self, topology: _Topology, child: Child) -> _Topology:
        hybrid_map = topology.hybrid_map.branch()
        self._replica.apply_changes(hybrid_map, child.moved_keyframes, child.arcs)
        around = areas_around(hybrid_map, child.area, self._branching.search.submap_radius)
        local = {area: belief.mean for area, belief in around.items() if area != child.area}
        named = {child.area: len(topology.path), **topology.named}
        robot = topology.robot.enter(child.area, child.frame_change, len(child.moved_keyframes), self._noise)
        path = (*topology.path, named[child.area])
        return _Topology(path, named, hybrid_map, replace(child.state, local_area_poses=local), robot, child.log_weight)

    def _normalize(self, topologies: Sequence[_Topology]) -> list[_Topology]:
        total = float(np.logaddexp.reduce([topology.log_weight for topology in topologies]))
        kept = [topology for topology in topologies if topology.log_weight - total > math.log(NEGLIGIBLE)]
        self.dropped += NEGLIGIBLE * (len(topologies) - len(kept))
        return [replace(topology, log_weight=topology.log_weight - total) for topology in kept]


def plot_oracle(path: Path, distances: Mapping[str, Mapping[int, float]], bound: float) -> None:
    """Draw the total variation distance against the number of hypotheses.

    :param distances: {regime: {number of hypotheses: mean distance}}.
    """
    figure = Figure(figsize=(6.0, 4.5), layout="constrained")
    axes = figure.subplots()
    for name, own in distances.items():
        axes.plot(list(own), list(own.values()), "o-", label=name)
    axes.axhline(bound, color="black", linewidth=0.8)
    axes.set_xscale("log", base=2)
    axes.set(xlabel="hypotheses", ylabel="mean total variation distance")
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)
