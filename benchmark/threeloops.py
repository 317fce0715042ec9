"""Loop closures that only the belief over places proposes, in institutes that are gone round twice.

And what it proposes in other worlds, where a laser sees half a circle.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np

from benchmark.institute_maps import LASER, PEOPLE
from benchmark.report import Report, Requirement, table
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
"""Areas are looked at whose position is this certain by the arcs, m."""

ELSEWHERE = ("office", "nested", "hall", "twins")
"""Other worlds, with as many buildings each; and how many."""

ELSEWHERE_SEEDS = 2

_LAPS = 2

POLICY = (
    f"A robot with a laser that sees all around goes round an institute {_LAPS} times by its scripted route, rooms "
    f"included, with {PEOPLE} people about. At the end of the first lap it comes back to its first hallway, and from "
    "there on it is in known ground: one loop a building. By the arcs only areas are looked at whose position is "
    f"certain to {LIMIT:g} m (`tsbi.prior_limit={LIMIT:g}`), which none is on the other side of such a loop: what "
    "closes has been proposed by landmarks, as the column without them shows. A proposal says how two areas lie to "
    f"each other; it is right where that is true to {NEAR:g} m and {TURN:g} degrees. It is asked for one at every "
    "cut at which an area is less certain than that, so at some before there is a loop, where all proposals are false. "
    "A loop is closed at the first right closure that is accepted; these are judged as in `loops`. In the paper a "
    "robot that was carried made the loops: 3 of 3 were detected, and nowhere else did two peaks move in the same way "
    "three times. Elsewhere a laser sees half a circle, and the robot goes round as often as is usual there."
)


ProposalListener = Callable[[HybridMap, AreaLoop | None, float], None]


class Proposal(NamedTuple):
    """What landmarks said at a cut at which they were asked.

    :ivar at: path length, m.
    :ivar error: of the proposed pose, m and degrees; None where nothing was proposed.
    :ivar seconds: CPU time.
    """

    at: float
    error: tuple[float, float] | None
    seconds: float = 0.0

    @property
    def is_right(self) -> bool:
        """Whether that is how the two areas lie."""
        return self.error is not None and self.error[0] <= NEAR and self.error[1] <= TURN


class AcceptedClosure(NamedTuple):
    """A closure that was accepted.

    :ivar at: path length, m.
    :ivar is_right: whether the two areas meet there.
    """

    at: float
    is_right: bool


class Drive(NamedTuple):
    """What came of a drive.

    :ivar traveled: m.
    :ivar begins: path lengths at which the robot came back to known ground, m.
    :ivar proposals: at every cut at which landmarks were asked.
    :ivar accepted: the closures.
    """

    traveled: float
    begins: list[float]
    proposals: list[Proposal]
    accepted: list[AcceptedClosure]

    @property
    def made_proposals(self) -> list[Proposal]:
        """The cuts at which something was proposed."""
        return [proposal for proposal in self.proposals if proposal.error is not None]

    @property
    def closing_distances(self) -> list[float]:
        """From each loop that was closed the path from its begin to the first right closure, m."""
        closing_distances = (
            min(
                (proposal.at - begin for proposal in self.accepted if proposal.is_right and proposal.at >= begin),
                default=None,
            )
            for begin in self.begins
        )
        return [way for way in closing_distances if way is not None]


class _ReportingProposer(LoopProposer):
    """Proposes loops, and tells which."""

    def __init__(self, configuration: Configuration, views: AreaViewCache, listener: ProposalListener) -> None:
        super().__init__(configuration, views)
        self._listener = listener

    def propose(self, hybrid_map: HybridMap) -> AreaLoop | None:
        """As always."""
        begin = time.process_time()
        found = super().propose(hybrid_map)
        self._listener(hybrid_map, found, time.process_time() - begin)
        return found


class _ProposalWatch(Watch):
    """Judges proposals, too."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.proposals: list[Proposal] = []

    def branching(self, configuration: Configuration, replica: Replica) -> Branching:
        """As always, but for who proposes loops."""
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
    """Go round with landmarks that propose loops, and without."""
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
    rows = [_elsewhere_row(f"{world} {seed}", run) for (world, seed), run in zip(worlds, others, strict=True)]
    head = ["elsewhere", "traveled [m]", "cuts", "s a cut, most", "proposals", "false", "closures accepted", "false"]
    report.body += [table(head, rows), POLICY]
    return report


def requirements(with_them: Sequence[Drive], without: Sequence[Drive]) -> list[Requirement]:
    """What is asked of drives with proposals, and of those without."""
    false_proposals = sum(not one.is_right for own in with_them for one in own.made_proposals)
    false_closures = sum(not one.is_right for own in with_them for one in own.accepted)
    return [
        Requirement("loops closed, share", _closed_share(with_them), 1.0, least=1.0),
        Requirement("proposals that are false", false_proposals, 0),
        Requirement("closures accepted falsely", false_closures, 0),
        Requirement("loops closed without proposals, share", _closed_share(without), 0),
    ]


def elsewhere_requirements(drives: Sequence[Drive]) -> list[Requirement]:
    """What is asked of drives through other worlds."""
    false_proposals = sum(not one.is_right for own in drives for one in own.made_proposals)
    false_closures = sum(not one.is_right for own in drives for one in own.accepted)
    return [
        Requirement("elsewhere: proposals that are false", false_proposals, 0),
        Requirement("elsewhere: closures accepted falsely", false_closures, 0),
    ]


def drive_laps(seed: int, building: str = "", *, changes: tuple[str, ...]) -> Drive:
    """Go round in one building, an institute if no other is named."""
    configuration = load_configuration(PARAMETERS, [f"tsbi.prior_limit={LIMIT:g}", *changes], seed)
    log = open_simulated(f"sim:{building or f'institute,seed={seed},laps={_LAPS},people={PEOPLE},{LASER}'}")
    watch = _ProposalWatch(log, configuration)
    watch.run()
    begins = [loop.begin for loop in watch.loops.found if loop.can_be_closed]
    accepted = [AcceptedClosure(watch.traveled[closure["event"]], closure["right"]) for closure in watch.accepted]
    return Drive(max(watch.traveled.values()), begins, watch.proposals, accepted)


def _closed_share(drives: Sequence[Drive]) -> float:
    """Share of the loops."""
    return sum(len(own.closing_distances) for own in drives) / max(1, sum(len(own.begins) for own in drives))


def _elsewhere_row(building: str, own: Drive) -> list[str]:
    return [
        building,
        f"{own.traveled:.0f}",
        str(len(own.proposals)),
        f"{max((one.seconds for one in own.proposals), default=0.0):.2f}",
        str(len(own.made_proposals)),
        str(sum(not one.is_right for one in own.made_proposals)),
        str(len(own.accepted)),
        str(sum(not one.is_right for one in own.accepted)),
    ]


def _drive_row(building: str, own: Drive, without: Drive) -> list[str]:
    before = [one for one in own.proposals if one.at < min(own.begins, default=own.traveled)]
    return [
        building,
        f"{own.traveled:.0f}",
        str(len(own.begins)),
        str(len(before)),
        str(sum(one.error is not None for one in before)),
        str(len(own.proposals) - len(before)),
        str(len(own.made_proposals)),
        str(sum(not one.is_right for one in own.made_proposals)),
        str(len(own.accepted)),
        str(sum(not one.is_right for one in own.accepted)),
        str(len(own.closing_distances)),
        ", ".join(f"{way:.0f}" for way in own.closing_distances) or "-",
        str(len(without.closing_distances)),
    ]
