"""Loop closures that only the belief over places proposes, in two laps of institutes, and its proposals elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np

from benchmark.institute_maps import LASER, PEOPLE
from benchmark.report import Columns, Report, Requirement, table, table_of
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings, chosen_seeds
from benchmark.simulated.truth import NEAR, TURN
from benchmark.simulated.watch import Watch
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.places.area_views import AreaViewCache
from hmt_slam_ros.places.landmark_evidence import PlaceEvidence
from hmt_slam_ros.places.loop_proposals import AreaLoop, LoopProposer
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.topological_inference.branching import Branching

SEEDS = 3
"""Buildings, each with one loop."""

LIMIT = 0.5
"""Largest deviation of the position of areas that are compared by the arcs, m."""

ELSEWHERE = ("office", "nested", "hall", "twins")
"""Other worlds."""

ELSEWHERE_SEEDS = 2
"""Buildings of each of them."""

_LAPS = 2

POLICY = (
    f"A robot with a laser that sees all around drives {_LAPS} laps of an institute on its scripted route, including "
    f"rooms, with {PEOPLE} people. At the end of the first lap it returns to its first hallway, and stays in known "
    f"ground: one loop in each building. By the arcs, only areas whose position is certain to {LIMIT:g} m "
    f"(`tsbi.prior_limit={LIMIT:g}`) are compared, and none is across such a loop. So all closures are proposed by "
    "landmarks, as the column without them shows. A proposal is the relative pose of two areas; it is right if that is "
    f"true to {NEAR:g} m and {TURN:g} degrees. One is requested at every cut at which an area is less certain than "
    "that; before there is a loop, all proposals are false. A loop is closed at the first right closure that is "
    "accepted; closures are scored as in `loops`. In the paper, the loops were made by a kidnapped robot: 3 of 3 were "
    "detected, and nowhere else did two peaks move in the same way three times. Elsewhere a laser sees half a circle, "
    "and the number of laps is the default of the world."
)


ProposalListener = Callable[[HybridMap, AreaLoop | None, float], None]


class Proposal(NamedTuple):
    """The proposal of landmarks at a cut.

    :ivar at: path length, m.
    :ivar error: of the proposed pose, m and degrees; None where nothing was proposed.
    :ivar seconds: CPU time.
    """

    at: float
    error: tuple[float, float] | None
    seconds: float = 0.0

    @property
    def is_right(self) -> bool:
        """Whether the proposed relative pose is true."""
        return self.error is not None and self.error[0] <= NEAR and self.error[1] <= TURN


class AcceptedClosure(NamedTuple):
    """A closure that was accepted.

    :ivar at: path length, m.
    :ivar is_right: whether the two areas meet there.
    """

    at: float
    is_right: bool


class LoopDrive(NamedTuple):
    """The proposals and closures of a drive.

    :ivar traveled: m.
    :ivar begins: path lengths at which the robot returns to known ground, m.
    :ivar proposals: at every cut with a request for one.
    :ivar accepted: the closures.
    """

    traveled: float
    begins: list[float]
    proposals: list[Proposal]
    accepted: list[AcceptedClosure]

    @property
    def made_proposals(self) -> list[Proposal]:
        """The proposals with a relative pose."""
        return [proposal for proposal in self.proposals if proposal.error is not None]

    @property
    def closing_distances(self) -> list[float]:
        """Path from the begin of each closed loop to the first right closure, m."""
        closing_distances = (
            min(
                (proposal.at - begin for proposal in self.accepted if proposal.is_right and proposal.at >= begin),
                default=None,
            )
            for begin in self.begins
        )
        return [way for way in closing_distances if way is not None]


class _ReportingProposer(LoopProposer):
    """Proposes loops, and passes them to a listener."""

    def __init__(self, configuration: Configuration, views: AreaViewCache, listener: ProposalListener) -> None:
        super().__init__(configuration, views)
        self._listener = listener

    def propose(self, hybrid_map: HybridMap) -> AreaLoop | None:
        """Propose a loop, and pass it to the listener."""
        begin = time.process_time()
        found = super().propose(hybrid_map)
        self._listener(hybrid_map, found, time.process_time() - begin)
        return found


class _ProposalWatch(Watch):
    """Watches proposals, too."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.proposals: list[Proposal] = []

    def branching(self, configuration: Configuration, replica: Replica) -> Branching:
        """As of ``Watch``, with a proposer that has a listener."""
        branching = super().branching(configuration, replica)
        evidence = branching.landmarks
        if isinstance(evidence, PlaceEvidence) and evidence.loops is not None:
            evidence.loops = _ReportingProposer(configuration, evidence.views, self._add_proposal)
        return branching

    def _add_proposal(self, hybrid_map: HybridMap, loop: AreaLoop | None, seconds: float) -> None:
        error = None
        if loop is not None:
            frames = (self.truth.frame(hybrid_map, area) for area in (loop.area, loop.other_area))
            difference = se2.between(loop.pose.mean, se2.between(*frames))
            error = float(np.hypot(difference[0], difference[1])), float(np.degrees(abs(difference[2])))
        self.proposals.append(Proposal(max(self.traveled.values()), error, seconds))


def measure_threeloops(settings: Settings) -> Report:
    """Drive laps with and without landmarks that propose loops."""
    seeds = chosen_seeds(settings, SEEDS)
    worlds = [(world, seed) for world in ELSEWHERE for seed in chosen_seeds(settings, ELSEWHERE_SEEDS)]
    with_proposals, without_proposals = (
        partial(drive_laps, changes=(*settings.changes, f"places.loops={on}")) for on in ("true", "false")
    )
    with ProcessPoolExecutor(settings.records.jobs) as pool:
        elsewhere = pool.map(
            with_proposals, *zip(*((seed, f"{world},seed={seed}") for world, seed in worlds), strict=True)
        )
        with_them, without = (list(pool.map(run, seeds)) for run in (with_proposals, without_proposals))
        others = list(elsewhere)
    report = Report("threeloops", "Loops that only the belief over places proposes", seeds=seeds)
    report.requirements = [*requirements(with_them, without), *elsewhere_requirements(others)]
    rows = [_drive_row(f"{seed}", *pair) for seed, *pair in zip(seeds, with_them, without, strict=True)]
    head = ["building", "traveled [m]", "loops", "cuts before", "proposals", "cuts behind", "proposals in all"]
    head += ["false", "closures accepted", "false", "loops closed", "after [m]", "closed without proposals"]
    report.body.append(table(head, rows))
    names = [f"{world} {seed}" for world, seed in worlds]

    report.body += [table_of(_ELSEWHERE_COLUMNS, zip(names, others, strict=True)), POLICY]
    return report


def requirements(with_proposals: Sequence[LoopDrive], without: Sequence[LoopDrive]) -> list[Requirement]:
    """Requirements on drives with proposals, and on those without."""
    return [
        Requirement("loops closed, share", _closed_share(with_proposals), 1.0, least=1.0),
        *_false_requirements(with_proposals),
        Requirement("loops closed without proposals, share", _closed_share(without), 0),
    ]


def _false_requirements(drives: Sequence[LoopDrive], prefix: str = "") -> list[Requirement]:
    proposals = sum(not proposal.is_right for drive in drives for proposal in drive.made_proposals)
    closures = sum(not closure.is_right for drive in drives for closure in drive.accepted)
    return [
        Requirement(f"{prefix}proposals that are false", proposals, 0),
        Requirement(f"{prefix}closures accepted falsely", closures, 0),
    ]


def elsewhere_requirements(drives: Sequence[LoopDrive]) -> list[Requirement]:
    """Requirements on drives through other worlds."""
    return _false_requirements(drives, "elsewhere: ")


def drive_laps(seed: int, building: str = "", *, changes: tuple[str, ...]) -> LoopDrive:
    """Drive laps of one building, by default an institute."""
    configuration = load_configuration(PARAMETERS, [f"tsbi.prior_limit={LIMIT:g}", *changes], seed)
    log = open_simulated(f"sim:{building or f'institute,seed={seed},laps={_LAPS},people={PEOPLE},{LASER}'}")
    watch = _ProposalWatch(log, configuration)
    watch.run()
    begins = [loop.begin for loop in watch.loops.found if loop.can_be_closed]
    accepted = [AcceptedClosure(watch.traveled[closure["event"]], closure["right"]) for closure in watch.accepted]
    return LoopDrive(max(watch.traveled.values()), begins, watch.proposals, accepted)


def _closed_share(drives: Sequence[LoopDrive]) -> float:
    """Share of the loops that are closed."""
    return sum(len(own.closing_distances) for own in drives) / max(1, sum(len(own.begins) for own in drives))


def _count_false(closings: Sequence[Proposal] | Sequence[AcceptedClosure]) -> str:
    return str(sum(not closing.is_right for closing in closings))


_ELSEWHERE_COLUMNS: Columns[tuple[str, LoopDrive]] = [
    ("elsewhere", lambda row: row[0]),
    ("traveled [m]", lambda row: f"{row[1].traveled:.0f}"),
    ("cuts", lambda row: str(len(row[1].proposals))),
    ("s a cut, most", lambda row: f"{max((proposal.seconds for proposal in row[1].proposals), default=0.0):.2f}"),
    ("proposals", lambda row: str(len(row[1].made_proposals))),
    ("false", lambda row: _count_false(row[1].made_proposals)),
    ("closures accepted", lambda row: str(len(row[1].accepted))),
    ("false", lambda row: _count_false(row[1].accepted)),
]


def _drive_row(building: str, drive: LoopDrive, without: LoopDrive) -> list[str]:
    before = [p for p in drive.proposals if p.at < min(drive.begins, default=drive.traveled)]
    proposed = sum(proposal.error is not None for proposal in before)
    counts = [len(drive.begins), len(before), proposed, len(drive.proposals) - len(before), len(drive.made_proposals)]
    closed = [_count_false(drive.made_proposals), str(len(drive.accepted)), _count_false(drive.accepted)]
    distances = [f"{distance:.0f}" for distance in drive.closing_distances]
    loops = [str(len(distances)), ", ".join(distances) or "-", str(len(without.closing_distances))]
    return [building, f"{drive.traveled:.0f}", *map(str, counts), *closed, *loops]
