"""Hallways that are closed between drives: whether a pilot notices, goes another way, and comes back to them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from typing import NamedTuple

import networkx
import numpy as np

from benchmark.institute_maps import InstituteMap, charted
from benchmark.institute_missions import Steered, axis_of, known_of
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_seeds
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.exploration.rooms import Destination, destinations
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.offline.runtime import run_log
from hmt_slam_ros.places.edge_existence import WatchedWays
from hmt_slam_ros.places.place_graph import state_of, turned
from hmt_slam_ros.places.policy import turn_towards
from hmt_slam_ros.simulation import SimulatedLog, open_simulated

WORLDS = {"office": 0.7, "institute": 0.8}
"""A ring of corridors, and hallways with two passages between them, and how large they are."""

SEEDS, PEOPLE = 5, 2
"""Buildings of each, and who walks about at every visit."""

TIME = 150.0
"""Of a drive at most, s."""

DRIVES = ("open", "closed", "still closed", "open again")
"""One after the other in each building."""

# A way that is closed is so long at least, m; the wall across it is so far from where the robot comes at most, m, and
# so far to both sides of its middle, m.
_LEAST, _SEEN, _HALF = 3.0, 4.0, 1.5

POLICY = (
    f"Every building, a small one, is mapped by a scripted drive; then robots go by their belief, as on the "
    f"missions in an institute, with {PEOPLE} people about, who also pass what is closed. Drawn by chance are a way of "
    f"the chart, {_LEAST:g} m long or more, round which another way leads, and a door; the shortest way from one of "
    "its ends to the door leads over it. Four drives are from there to that door, the robot knowing its place and "
    "looking where it plans to go: with all open; with a wall across that way, in its middle or "
    f"{_SEEN:g} m before the robot; with the wall still there; and with the wall gone. What the pilot knows of ways is "
    f"carried on from drive to drive. It arrives where within {TIME:g} s it goes over to the metric filter before that "
    "door. The way is noticed where its existence is below the minimum at the end of the second drive, and comes back "
    "where it is not at the end of the fourth. Wrong is every other way of the chart that is called closed at any scan "
    "of a drive."
)


class Closing(NamedTuple):
    """A way that will be closed.

    :ivar way: the state in which it is left, from a node.
    :ivar goal: a place behind a door to which it leads.
    :ivar wall: shape (1, 4), that closes it, in the world, m.
    :ivar lengths: of the shortest way to the door, and of that without it, m.
    """

    way: int
    goal: Destination
    wall: Float64
    lengths: tuple[float, float]


class Drive(NamedTuple):
    """A drive to a door.

    :ivar arrived: whether the robot says so, before that door.
    :ivar metres: driven.
    :ivar seconds: of the simulation.
    :ivar closed: whether the way is closed at the end, as the robot knows it.
    :ivar wrong: how many others were called closed on the way.
    """

    arrived: bool
    metres: float
    seconds: float
    closed: bool
    wrong: int


class Building(NamedTuple):
    """What came of a building.

    :ivar lengths: as of `Closing`.
    :ivar ways: of its chart.
    :ivar drives: as of `DRIVES`.
    """

    lengths: tuple[float, float]
    ways: int
    drives: tuple[Drive, ...]


def measure_ways(settings: Settings) -> Report:
    """Close ways and open them again."""
    seeds = chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    cases = list(product(settings.logs_or(tuple(WORLDS)), seeds))
    with ProcessPoolExecutor(settings.records.jobs) as pool:
        found = list(pool.map(partial(driven, configuration=configuration), *zip(*cases, strict=True)))
    report = Report("ways", "Ways that are closed and opened again", seeds=seeds)
    report.requirements = requirements(found)
    report.body += [_table(cases, found), POLICY]
    return report


def driven(world: str, seed: int, configuration: Configuration) -> Building:
    """The four drives in a building."""
    institute = _mapped(world, seed, configuration)
    closing = closing_of(institute, configuration, np.random.default_rng(seed))
    ways = WatchedWays(institute.chart.graph(configuration.places), configuration.features)
    visit = _log(world, seed, visit=1)
    drives = []
    for name in DRIVES:
        wall = closing.wall if name in DRIVES[1:3] else closing.wall[:0]
        drives.append(_drive(institute._replace(scenario=visit.scenario), closing, wall, ways, configuration))
    return Building(closing.lengths, len(institute.chart.edges) // 2, tuple(drives))


def _log(world: str, seed: int, visit: int) -> SimulatedLog:
    own = f"changed=0,laps=1,size={WORLDS[world]:g},rate=3,field_of_view=360,beams=360,moved=0"
    return open_simulated(f"sim:{world},seed={seed},visit={visit},people={PEOPLE},{own}")


def _mapped(world: str, seed: int, configuration: Configuration) -> InstituteMap:
    log = _log(world, seed, visit=0)
    result = run_log(log, configuration, lasting=True)
    recording = result.recorder.finish(result.log.stamps, result.log.first_scans, result.log.earlier)
    return charted(log.scenario, recording.hybrid_map, recording.replica.scans, log.true_poses, configuration)


def closing_of(institute: InstituteMap, configuration: Configuration, random: np.random.Generator) -> Closing:
    """One of all that can be.

    :raises HmtSlamError: where there is none.
    """
    found = list(_closings(institute, destinations(known_of(institute, configuration))))
    if not found:
        raise HmtSlamError("no way of the chart can be closed round which another one leads to a door: choose a seed")
    return found[int(random.integers(len(found)))]


def _closings(institute: InstituteMap, places: dict[int, Destination]) -> Iterator[Closing]:
    ways = networkx.Graph()
    for edge in institute.chart.edges:
        ways.add_edge(edge.start, edge.end, length=edge.distance[0])
    for edge in institute.chart.edges:
        others = networkx.restricted_view(ways, [], [(edge.start, edge.end)])
        if edge.distance[0] < _LEAST or not networkx.has_path(others, edge.start, edge.end):
            continue
        far, round_it = (_lengths(graph, edge.start) for graph in (ways, others))
        for node, goal in places.items():
            if node != edge.start and far[node] < round_it[node]:
                wall = _across(institute, edge.start, edge.end)
                yield Closing(state_of(edge.start, edge.leaving), goal, wall, (far[node], round_it[node]))


def _lengths(ways: networkx.Graph, start: int) -> dict[int, float]:
    return dict(networkx.single_source_dijkstra_path_length(ways, start, weight="length"))


def _across(institute: InstituteMap, start: int, end: int) -> Float64:
    """A wall across a way, shape (1, 4)."""
    begin, along = institute.nodes[start, :2], institute.nodes[end, :2] - institute.nodes[start, :2]
    length = float(np.hypot(*along))
    middle = begin + min(0.5 * length, _SEEN) / length * along
    aside = _HALF / length * np.array((-along[1], along[0]))
    return np.concatenate((middle - aside, middle + aside))[None]


def _drive(
    institute: InstituteMap, closing: Closing, wall: Float64, ways: WatchedWays, configuration: Configuration
) -> Drive:
    """Drive to the door; ``wall`` is what is across the way."""
    graph = known_of(institute, configuration).graph
    quarters = turn_towards(graph, closing.way, closing.goal.node, ways.closed)
    assert quarters is not None
    state = turned(closing.way, quarters)
    steered = Steered(institute, institute.scenario, configuration, axis_of(institute, state), state)
    robot, pilot = steered.robot, steered.pilot
    robot.close(wall)
    pilot.ways, begin = ways, robot.stamp
    own = {closing.way, turned(int(graph.following[closing.way]), 2)}
    wrong: set[int] = set()
    pilot.go(closing.goal)
    while pilot.started is None and robot.stamp < begin + TIME * NANOSECONDS:
        steered.step()
        wrong |= ways.closed - own
    arrived = pilot.started is not None and pilot.started.node == closing.goal.node
    seconds = (robot.stamp - begin) / NANOSECONDS
    return Drive(arrived, robot.travelled, seconds, closing.way in ways.closed, len(wrong) // 2)


def requirements(found: Sequence[Building]) -> list[Requirement]:
    """What is asked for."""
    by_name = dict(zip(DRIVES, zip(*(one.drives for one in found), strict=True), strict=True))
    ways = sum(one.ways * len(DRIVES) for one in found)
    asked = {
        "closed ways that are noticed": [one.closed for one in by_name["closed"]],
        "missions that arrive by another way": [one.arrived for one in by_name["closed"]],
        "missions that arrive, the way being known to be closed": [one.arrived for one in by_name["still closed"]],
        "ways that come back": [not one.closed for one in by_name["open again"]],
    }
    wrong = sum(drive.wrong for one in found for drive in one.drives)
    return [
        *(Requirement(name, float(np.mean(held)), 1.0, least=0.9) for name, held in asked.items()),
        Requirement("open ways that are called closed, of all on all drives", wrong / ways, 0.01),
    ]


def _table(cases: Sequence[tuple[str, int]], found: Sequence[Building]) -> str:
    head = ["building", "shortest [m]", "round it [m]", *(f"{name} [m]" for name in DRIVES), "noticed", "back", "wrong"]
    rows = []
    for (world, seed), one in zip(cases, found, strict=True):
        metres = [f"{drive.metres:.0f}" if drive.arrived else "-" for drive in one.drives]
        wrong = sum(drive.wrong for drive in one.drives)
        told = ["yes" if held else "no" for held in (one.drives[1].closed, not one.drives[3].closed)]
        rows.append([f"{world} {seed}", *(f"{length:.0f}" for length in one.lengths), *metres, *told, str(wrong)])
    return table(head, rows)
