"""Localization over places in an institute: missions and relocations, as in tables 2 and 3 of Tomatis et al. (2003)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np

from benchmark.belief import Estimate, recovery
from benchmark.institute_drives import Guided
from benchmark.institute_maps import PEOPLE, InstituteMap, mapped, scenario_of
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_seeds
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.places.chart import DOOR
from hmt_slam_ros.places.observation_graph import QUARTERS
from hmt_slam_ros.places.place_graph import state_of
from hmt_slam_ros.places.position_belief import certain_belief
from hmt_slam_ros.places.switching import MetricStart, metric_start
from hmt_slam_ros.simulation.scenario import Scenario

SEEDS = 5
"""Buildings."""

_MISSIONS, _RELOCATIONS = 5, 2  # in each
_CHANGED = {"as mapped": 0.0, "doors changed": 0.25}
_FAR = 60.0  # m, of a relocation at most
_NEAR = 1.0  # m, from a state of the building to the node that is it
_INTO = 1.0  # m, behind the door
_LEAST = 20.0  # m, of a mission, where there is a door so far away
_SUCCESS, _UNCONFIDENT, _FALSE, _CONFIDENT_FALSE, _TRANSITIONS = 1.0, 0.12, 0.014, 0.005, 0.12  # paper, table 2
_METRES, _STATES = 13.7, 2.11  # paper, table 3
_NEES = 3.6
_WAY = 0.5 * math.pi

POLICY = (
    f"In a map that SLAM made of another drive robots are driven by true poses, with {PEOPLE} people about, a laser "
    "that sees all around and noisy wheels, while the belief runs along. An estimate is one scan's, in a hallway while "
    "the robot does not turn; it is right where the place that it says, its most likely node and the way since then, "
    "is within 1 m of the robot, and its direction is the robot's. Missions: from one open door to another one, "
    f"{_LEAST:g} m away or more, from a known state; a success is a confident belief in the goal's node before its "
    "door. A transition is a node that the robot notices; it is false where the estimate after that is wrong. "
    "Relocations: from a random place in a hallway and a flat belief the robot goes straight on, and turns at the end "
    "of the hallway, to the right, the left, or back, where another one begins; it has recovered at the first "
    "confident and right estimate behind which there is no wrong one up to the third further node. Doors changed: "
    f"{100 * _CHANGED['doors changed']:.0f} % of the open doors were closed and others opened after the map was made; "
    "what is required is of the doors as mapped, as in the paper. Metric start: the pose with which the metric filter "
    "begins at the goal's door, against the true one; NEES has 3 degrees of freedom."
)


class Mission(NamedTuple):
    """A drive from one door to another one.

    :ivar success: whether the belief was confident and right at the goal.
    :ivar metres: driven.
    :ivar seconds: of the simulation.
    :ivar estimates: on the way.
    :ivar errors: of the metric start at the door, m, rad and NEES; None where there was none.
    """

    success: bool
    metres: float
    seconds: float
    estimates: list[Estimate]
    errors: tuple[float, float, float] | None


def measure_institute(settings: Settings) -> Report:
    """Drive missions and relocate lost robots."""
    seeds = chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    with ProcessPoolExecutor(settings.records.jobs) as pool:
        buildings = list(pool.map(partial(_of_building, configuration=configuration), seeds))
    missions = {name: [one for building in buildings for one in building[name][0]] for name in _CHANGED}
    lost = {name: [one for building in buildings for one in building[name][1]] for name in _CHANGED}
    report = Report("institute", "Missions and relocations in an institute", seeds=seeds)
    known = next(iter(_CHANGED))
    report.requirements = [*_mission_requirements(missions[known]), *_relocation_requirements(lost[known])]
    report.body += [_mission_table(missions), _relocation_table(lost), POLICY]
    return report


def _of_building(seed: int, configuration: Configuration) -> dict[str, tuple[list[Mission], list[list[Estimate]]]]:
    """Missions and relocations in one building, with the doors as mapped and changed."""
    institute = mapped(seed, configuration)
    scenarios = {name: scenario_of(seed, visit=1, changed=changed) for name, changed in _CHANGED.items()}
    return {
        name: (missions_of(institute, own, configuration), relocations_of(institute, own, configuration))
        for name, own in scenarios.items()
    }


def missions_of(institute: InstituteMap, scenario: Scenario, configuration: Configuration) -> list[Mission]:
    """From door to door."""
    random = np.random.default_rng([scenario.settings.seed, 1])
    doors = open_doors(institute, scenario)
    stops = [int(random.choice(doors))]
    for _ in range(_MISSIONS):
        stops.append(_next_stop(random, institute, doors, stops[-1]))
    return [_mission(institute, scenario, configuration, stops[k : k + 2]) for k in range(_MISSIONS)]


def _next_stop(random: np.random.Generator, institute: InstituteMap, doors: Sequence[int], stop: int) -> int:
    """One of the doors that are far away, or the farthest."""
    ways = {door: Guided.length(institute, stop, door) for door in doors if door != stop}
    far = [door for door, length in ways.items() if length >= _LEAST]
    return int(random.choice(far or [max(ways, key=lambda door: ways[door])]))


def open_doors(institute: InstituteMap, scenario: Scenario) -> list[int]:
    """The nodes of the chart that are doors and open at a visit."""
    states = scenario.building.states
    places = states.poses[~states.crossings, :2]
    return [
        k
        for k, node in enumerate(institute.chart.nodes)
        if node.kind == DOOR and np.hypot(*(places - institute.nodes[k, :2]).T).min() <= _NEAR
    ]


def _mission(
    institute: InstituteMap, scenario: Scenario, configuration: Configuration, stops: Sequence[int]
) -> Mission:
    start, goal = stops
    graph = institute.chart.graph(configuration.places)
    direction = next(
        edge.leaving
        for edge in institute.chart.edges
        if [edge.start, edge.end] == Guided.way(institute, start, goal)[:2]
    )
    node = institute.nodes[start]
    pose = np.array((*node[:2], float(se2.wrap(node[2] - _WAY * direction))))
    known = certain_belief(graph, configuration.places, state_of(start, direction))
    guided = Guided(institute, scenario, pose, configuration, known)
    begin = guided.robot.stamp
    for place in guided.corners(Guided.way(institute, start, goal)):
        for _ in guided.drive_to(place):
            pass
    metres, seconds = guided.robot.travelled, 1e-9 * (guided.robot.stamp - begin)
    found = _entered(guided, institute, goal)
    success = found is not None and found[0].node == goal
    errors = None if found is None else _errors(institute, *found)
    return Mission(success, metres, seconds, guided.estimates, errors)


def _entered(guided: Guided, institute: InstituteMap, goal: int) -> tuple[MetricStart, Float64] | None:
    """Drive through the goal's door; with what the metric filter starts before it, and the robot's true pose then."""
    opening = institute.chart.nodes[goal].openings[0]
    door = se2.compose(institute.frames[opening.area], opening.landmark.pose.mean)
    found = None
    for _ in guided.drive_to(se2.transform(door, np.array([[_INTO, 0.0]]))[0]):
        start = metric_start(guided.estimator, institute.chart)
        if found is None and start is not None:
            found = start, guided.robot.pose.copy()
    return found


def _errors(institute: InstituteMap, start: MetricStart, pose: Float64) -> tuple[float, float, float]:
    true = se2.between(institute.frames[start.area], pose)
    off = se2.log(se2.between(start.pose.mean, true))
    nees = float(off @ np.linalg.solve(start.pose.covariance, off))
    return math.hypot(off[0], off[1]), abs(float(off[2])), nees


def relocations_of(institute: InstituteMap, scenario: Scenario, configuration: Configuration) -> list[list[Estimate]]:
    """The estimates of robots that are lost at first."""
    random = np.random.default_rng([scenario.settings.seed, 2])
    return [_relocation(institute, scenario, configuration, random) for _ in range(_RELOCATIONS)]


def _relocation(
    institute: InstituteMap, scenario: Scenario, configuration: Configuration, random: np.random.Generator
) -> list[Estimate]:
    edges = {(edge.start, edge.leaving): edge for edge in institute.chart.edges}
    lengths = np.array([edge.distance[0] for edge in edges.values()])
    edge = list(edges.values())[int(random.choice(len(lengths), p=lengths / lengths.sum()))]
    node = institute.nodes[edge.start]
    axis = np.array((*node[:2], float(se2.wrap(node[2] - _WAY * edge.leaving))))
    start = se2.compose(axis, np.array((random.uniform(0.2, 0.8) * edge.distance[0], 0.0, 0.0)))
    guided = Guided(institute, scenario, start, configuration)
    end, direction = edge.end, edge.leaving
    while guided.robot.travelled < _FAR and recovery(guided.estimates) is None:
        while (end, direction) in edges:
            end = edges[end, direction].end
        for _ in guided.drive_to(institute.nodes[end, :2]):
            if guided.robot.travelled >= _FAR or recovery(guided.estimates) is not None:
                break
        turns = ((direction + quarters) % QUARTERS for quarters in (1, 3, 2))
        direction = next(turned for turned in turns if (end, turned) in edges)
    return guided.estimates


def _mission_requirements(missions: Sequence[Mission]) -> list[Requirement]:
    estimates = [estimate for mission in missions for estimate in mission.estimates]
    false = [not one.right for one in estimates]
    confident = [one.confident and not one.right for one in estimates]
    nees = [mission.errors[2] for mission in missions if mission.errors is not None]
    return [
        Requirement("missions that succeed", _mean([one.success for one in missions]), 1.0, least=_SUCCESS),
        Requirement("false state transitions", _mean(_transitions(missions)), _TRANSITIONS),
        Requirement("unconfident estimates", _mean([not one.confident for one in estimates]), _UNCONFIDENT),
        Requirement("false estimates", _mean(false), _FALSE),
        Requirement("confident false estimates", _mean(confident), _CONFIDENT_FALSE),
        Requirement("NEES of the metric start, mean", _mean(nees), _NEES),
    ]


def _transitions(missions: Sequence[Mission]) -> list[bool]:
    """Of all nodes that were noticed, whether the estimate after that is wrong."""
    return [
        not after.right
        for mission in missions
        for before, after in zip(mission.estimates[:-1], mission.estimates[1:], strict=True)
        if after.arrivals > before.arrivals
    ]


def _relocation_requirements(runs: Sequence[Sequence[Estimate]]) -> list[Requirement]:
    found = [estimate for run in runs if (estimate := recovery(run)) is not None]
    return [
        Requirement("relocations that recover", len(found) / len(runs), 1.0, least=1.0),
        Requirement("distance for recovering, mean", _mean([one.metres for one in found]), _METRES, "m"),
        Requirement("states for recovering, mean", _mean([one.arrivals for one in found]), _STATES),
    ]


def _mission_table(missions: dict[str, list[Mission]]) -> str:
    rows = [
        ["Number of missions"], ["Success"], ["Total travelled distance [m]"], ["Mean travel distance [m]"],
        ["Mean travel speed [m/s]"], ["Total state transitions"], ["False state transitions"], ["Total estimates"],
        ["Unconfident states"], ["False estimates"], ["Confident false estimates"], ["Metric start: mean error [cm]"],
        ["Metric start: mean error [deg]"], ["Metric start: NEES, mean"],
    ]  # fmt: skip
    paper = ["25", "25 / 100 %", "899", "36", "0.31", "181", "21 / 12 %", "27870", "3413 / 12 %", "404 / 1.4 %"]
    columns = [_mission_column(own) for own in missions.values()]
    for row, *cells in zip(rows, [*paper, "149 / 0.5 %", "-", "-", "-"], *columns, strict=True):
        row.extend(cells)
    return table(["missions", "paper", *missions], rows)


def _mission_column(missions: Sequence[Mission]) -> list[str]:
    estimates = [estimate for mission in missions for estimate in mission.estimates]
    metres, seconds = sum(one.metres for one in missions), sum(one.seconds for one in missions)
    errors = np.array([one.errors for one in missions if one.errors is not None]).reshape(-1, 3)
    transitions = _transitions(missions)
    return [
        str(len(missions)), _share([one.success for one in missions]), f"{metres:.0f}",
        f"{metres / len(missions):.0f}", f"{metres / seconds:.2f}", str(len(transitions)), _share(transitions),
        str(len(estimates)), _share([not one.confident for one in estimates]),
        _share([not one.right for one in estimates]), _share([one.confident and not one.right for one in estimates]),
        f"{100.0 * _mean(errors[:, 0]):.1f}", f"{math.degrees(_mean(errors[:, 1])):.2f}", f"{_mean(errors[:, 2]):.2f}",
    ]  # fmt: skip


def _relocation_table(lost: dict[str, list[list[Estimate]]]) -> str:
    rows = [
        ["Number of experiments", "10"], ["Recovered", "10"], ["Total travelled distance [m]", "250"],
        ["Mean distance for recovering [m]", "13.7"], ["Min / max distance for recovering [m]", "1.21 / 20.31"],
        ["Mean number of states for recovering", "2.11"], ["Min / max states for recovering", "1 / 4"],
    ]  # fmt: skip
    for runs in lost.values():
        found = [estimate for run in runs if (estimate := recovery(run)) is not None]
        metres, states = [one.metres for one in found], [one.arrivals for one in found]
        travelled = sum(run[-1].metres for run in runs if run)
        cells = [
            str(len(runs)), str(len(found)), f"{travelled:.0f}", f"{_mean(metres):.1f}",
            f"{min(metres, default=math.nan):.2f} / {max(metres, default=math.nan):.2f}", f"{_mean(states):.2f}",
            f"{min(states, default=0)} / {max(states, default=0)}",
        ]  # fmt: skip
        for row, cell in zip(rows, cells, strict=True):
            row.append(cell)
    return table(["relocations", "paper", *lost], rows)


def _mean(values: Sequence[float] | Float64) -> float:
    return float(np.mean(values)) if len(values) else math.nan


def _share(values: Sequence[bool]) -> str:
    return f"{sum(values)} / {100.0 * _mean(values):.1f} %" if values else "-"
