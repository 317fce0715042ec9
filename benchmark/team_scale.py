"""Cost of the process team in maps of up to a thousand areas: steps, comparisons, load of robots that drive, memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar

from benchmark import team_load
from benchmark.lattice import Lattice, LatticeScans
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.registration.consistency import NO_CLUTTER
from hmt_slam_ros.team.components import Component, combine
from hmt_slam_ros.team.placement_search import PlacementSearch

LATTICES = (Lattice(5, 5), Lattice(10, 10), Lattice(25, 10), Lattice(40, 25))

COMPARISON = 2.0
"""Largest CPU time of a comparison, s."""

_STEPS = 400
"""Most steps of a search: those of a thousand areas would take hours here, where everything fits everywhere."""

POLICY = (
    "Both robots have the same lattice of corridors with equal crossings (see scale), so that every window fits "
    "everywhere: no building takes more work. *Update* is what new keyframes cost, *comparison* the distribution over "
    f"placements after up to {_STEPS} steps of the search. CPU time of one process."
)

_Result = TypeVar("_Result")


class TeamCost(NamedTuple):
    """CPU times, s.

    :ivar areas: of each robot.
    :ivar windows: of the second robot.
    :ivar update: of the search with new maps, which are combined.
    :ivar step: of the search, on average.
    :ivar comparison: of the two maps.
    """

    areas: int
    windows: int
    update: float
    step: float
    comparison: float


def measure_team_scale(settings: Settings) -> Report:
    """Measure lattices of growing size."""
    configuration = settings.configuration
    costs = [measure_cost(lattice, configuration) for lattice in LATTICES]
    loads = [team_load.measure_load(lattice, configuration) for lattice in team_load.LATTICES]
    memory = team_load.weigh_ground(configuration)
    report = Report("team_scale", "Cost of the process team in large maps")
    report.requirements = [*requirements(costs), *team_load.requirements(loads, memory)]
    report.body = [cost_table(costs), POLICY, team_load.load_table(loads, memory), team_load.POLICY]
    return report


def measure_cost(lattice: Lattice, configuration: Configuration, steps: int = _STEPS) -> TeamCost:
    """The cost where two robots have the same lattice.

    :param steps: most steps of the search.
    """
    known, search = _component(lattice), PlacementSearch(configuration)
    update, _ = _measure_time(lambda: search.update(combine(known, _component(lattice))))
    spent, done = _measure_time(lambda: next((n for n in range(steps) if search.step() is None), steps))
    comparison, _ = _measure_time(search.distribution)
    return TeamCost(lattice.areas, len(search.windows), update, spent / max(1, done), comparison)


def _component(lattice: Lattice) -> Component:
    hybrid_map, scans = lattice.hybrid_map(), LatticeScans()
    keyframes = [keyframe for area in hybrid_map.area_ids() for keyframe in hybrid_map.keyframes(area)]
    return Component.of_map(hybrid_map, {keyframe: scans[keyframe] for keyframe in keyframes}, NO_CLUTTER)


def _measure_time(function: Callable[[], _Result]) -> tuple[float, _Result]:
    """CPU time of a call, s, and what it returns."""
    begin = time.process_time()
    result = function()
    return time.process_time() - begin, result


def requirements(costs: Sequence[TeamCost]) -> list[Requirement]:
    """Requirements on the largest map."""
    return [Requirement(f"comparison in {each.areas} areas", each.comparison, COMPARISON, "s") for each in costs[-1:]]


def cost_table(costs: Sequence[TeamCost]) -> str:
    """A table with a line for each lattice."""
    rows = [
        [
            f"{each.areas}",
            f"{each.windows}",
            f"{each.update:.2f} s",
            f"{1e3 * each.step:.0f} ms",
            f"{each.comparison:.2f} s",
        ]
        for each in costs
    ]
    return table(["areas of each robot", "windows", "update", "step, mean", "comparison"], rows)
