"""Localization over places in an institute: missions and relocations, as in tables 2 and 3 of Tomatis et al. (2003)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import pairwise
from typing import Any

from benchmark.institute_drives import (
    AT_PLACE,
    FAR,
    LEAST,
    TIME,
    Estimate,
    Mission,
    missions_of,
    recovery,
    relocations_of,
)
from benchmark.institute_maps import PEOPLE, map_institute, scenario_of
from benchmark.report import Report, Requirement, mean, table
from benchmark.settings import Settings, chosen_seeds
from hmt_slam_ros.configuration import Configuration

SEEDS = 5
"""Buildings."""

_CHANGED = {"as mapped": 0.0, "doors changed": 0.25}
_SUCCESS, _UNCONFIDENT, _FALSE, _CONFIDENT_FALSE, _TRANSITIONS = 1.0, 0.12, 0.014, 0.005, 0.12  # paper, table 2
_DISTANCE, _STATES = 13.7, 2.11  # paper, table 3
_NEES = 2.1, 4.2  # 0.7 to 1.4 for each of 3 degrees of freedom

POLICY = (
    f"The belief over places drives robots in a map that SLAM made of another drive, with {PEOPLE} people, a laser "
    "that sees all around and noisy wheels; true poses are used for scores only. In hallways the robot keeps to the "
    "middle between the walls, and turns by the policy of the most likely state. Before its goal's door it switches to "
    "the metric filter if it is confident, starts that with the door's moments, and drives by it to a place in the "
    "room, and back out for the next mission. An estimate is that of one scan in a hallway while the robot does not "
    "turn. It is right if its place, which is the most likely node and the distance since then, is within 1 m of the "
    "robot, with the robot's direction. Missions: five in each building, each from the room of the last one to another "
    f"room with an open door, {LEAST:g} m away or more; the first begins before a door, in a known state. A success is "
    f"a switch at the door of the goal. A place is reached if the robot reports that within {TIME:g} s, and is within "
    f"{AT_PLACE:g} m of it. After a mission that reaches no place, the robot is put before the door of its goal. "
    "Distances and times include the drives in rooms. A transition is a node that the robot notices; it is false if "
    "the estimate after it is wrong. A contact is a step that would bring the robot's disc into a surface or a person. "
    f"Relocations: up to {FAR:g} m from a random place in a hallway with a flat belief. The robot drives straight on, "
    "and turns at the end of the hallway to where the expected information is largest, or back. It has recovered at "
    "the first confident and right estimate without a wrong one up to the third further node. Doors changed: "
    f"{100 * _CHANGED['doors changed']:.0f} % of the open doors were closed, and others opened, after the map was "
    "made; requirements are on the doors as mapped, as in the paper. Metric start: the initial pose of the metric "
    "filter, compared with the true one; NEES has 3 degrees of freedom."
)


def measure_institute(settings: Settings) -> Report:
    """Drive missions, and relocate lost robots."""
    seeds = chosen_seeds(settings, SEEDS)
    configuration = settings.configuration
    with ProcessPoolExecutor(settings.records.jobs) as pool:
        buildings = list(pool.map(partial(_measure_building, configuration=configuration), seeds))
    missions = {name: [mission for building in buildings for mission in building[name][0]] for name in _CHANGED}
    relocations = {name: [drive for building in buildings for drive in building[name][1]] for name in _CHANGED}
    report = Report("institute", "Missions and relocations in an institute", seeds=seeds)
    as_mapped = next(iter(_CHANGED))
    report.requirements = mission_requirements(missions[as_mapped]) + _relocation_requirements(relocations[as_mapped])
    report.body += [
        _paper_table("missions", _MISSION_ROWS, missions),
        _paper_table("relocations", _RELOCATION_ROWS, relocations),
        POLICY,
    ]
    return report


def _measure_building(seed: int, configuration: Configuration) -> dict[str, tuple[list[Mission], list[list[Estimate]]]]:
    """Missions and relocations in one building, with the doors as mapped and changed."""
    institute = map_institute(seed, configuration)
    scenarios = {name: scenario_of(seed, visit=1, changed=changed) for name, changed in _CHANGED.items()}
    return {
        name: (missions_of(institute, scenario, configuration), relocations_of(institute, scenario, configuration))
        for name, scenario in scenarios.items()
    }


def mission_requirements(missions: Sequence[Mission]) -> list[Requirement]:
    """Requirements on missions, from table 2 of the paper."""
    estimates = _all_estimates(missions)
    nees = [mission.errors[2] for mission in missions if mission.errors is not None]
    success, reached = (mean([getattr(mission, name) for mission in missions]) for name in ("success", "reached"))
    return [
        Requirement("missions that succeed", success, 1.0, least=_SUCCESS),
        Requirement("missions that reach their place", reached, 1.0, least=_SUCCESS),
        Requirement("false state transitions", mean(false_transitions(missions)), _TRANSITIONS),
        Requirement("unconfident estimates", mean([not estimate.confident for estimate in estimates]), _UNCONFIDENT),
        Requirement("false estimates", mean([not estimate.right for estimate in estimates]), _FALSE),
        Requirement(
            "confident false estimates", mean([_is_trap(estimate) for estimate in estimates]), _CONFIDENT_FALSE
        ),
        Requirement("NEES of the metric start, mean", mean(nees), _NEES[1], least=_NEES[0]),
    ]


def _all_estimates(missions: Sequence[Mission]) -> list[Estimate]:
    return [estimate for mission in missions for estimate in mission.estimates]


def _is_trap(estimate: Estimate) -> bool:
    """Whether an estimate is confident and false."""
    return estimate.confident and not estimate.right


def false_transitions(missions: Sequence[Mission]) -> list[bool]:
    """Whether the estimate after each noticed node is false."""
    return [
        not after.right
        for mission in missions
        for before, after in pairwise(mission.estimates)
        if after.arrivals > before.arrivals
    ]


def _relocation_requirements(runs: Sequence[Sequence[Estimate]]) -> list[Requirement]:
    found = _recoveries(runs)
    return [
        Requirement("relocations that recover", len(found) / len(runs), 1.0, least=1.0),
        Requirement("distance for recovering, mean", mean([estimate.distance for estimate in found]), _DISTANCE, "m"),
        Requirement("states for recovering, mean", mean([estimate.arrivals for estimate in found]), _STATES),
    ]


def _recoveries(runs: Sequence[Sequence[Estimate]]) -> list[Estimate]:
    return [estimate for run in runs if (estimate := recovery(run)) is not None]


def _paper_table(
    name: str, rows: Sequence[tuple[str, str, Callable[[list[Any]], str]]], columns: Mapping[str, list[Any]]
) -> str:
    """A table with the figures of the paper, and a column for each state of the doors.

    :param rows: name, figure of the paper, and the function that gives the cell of a column.
    :param columns: {state of the doors: missions or relocations}.
    """
    cells = [[heading, paper, *(cell(column) for column in columns.values())] for heading, paper, cell in rows]
    return table([name, "paper", *columns], cells)


def _format_count(flags: Sequence[bool]) -> str:
    return f"{sum(flags)} / {100.0 * mean(flags):.1f} %" if flags else "-"


def _mean_start_error(missions: Sequence[Mission], k: int) -> float:
    """Mean error of the metric start: m, rad and NEES for k = 0, 1 and 2."""
    return mean([mission.errors[k] for mission in missions if mission.errors is not None])


def _total_distance(missions: Sequence[Mission]) -> float:
    return sum(mission.distance for mission in missions)


_MISSION_ROWS: list[tuple[str, str, Callable[[list[Mission]], str]]] = [
    ("Number of missions", "25", lambda missions: str(len(missions))),
    ("Success", "25 / 100 %", lambda missions: _format_count([mission.success for mission in missions])),
    ("Place in the room reached", "-", lambda missions: _format_count([mission.reached for mission in missions])),
    ("Contacts", "-", lambda missions: str(sum(mission.contacts for mission in missions))),
    ("Total traveled distance [m]", "899", lambda missions: f"{_total_distance(missions):.0f}"),
    ("Mean travel distance [m]", "36", lambda missions: f"{_total_distance(missions) / len(missions):.0f}"),
    (
        "Mean travel speed [m/s]",
        "0.31",
        lambda missions: f"{_total_distance(missions) / sum(m.seconds for m in missions):.2f}",
    ),
    ("Total state transitions", "181", lambda missions: str(len(false_transitions(missions)))),
    ("False state transitions", "21 / 12 %", lambda missions: _format_count(false_transitions(missions))),
    ("Total estimates", "27870", lambda missions: str(len(_all_estimates(missions)))),
    (
        "Unconfident states",
        "3413 / 12 %",
        lambda missions: _format_count([not e.confident for e in _all_estimates(missions)]),
    ),
    ("False estimates", "404 / 1.4 %", lambda missions: _format_count([not e.right for e in _all_estimates(missions)])),
    (
        "Confident false estimates",
        "149 / 0.5 %",
        lambda missions: _format_count([_is_trap(e) for e in _all_estimates(missions)]),
    ),
    ("Metric start: mean error [cm]", "-", lambda missions: f"{100.0 * _mean_start_error(missions, 0):.1f}"),
    ("Metric start: mean error [deg]", "-", lambda missions: f"{math.degrees(_mean_start_error(missions, 1)):.2f}"),
    ("Metric start: NEES, mean", "-", lambda missions: f"{_mean_start_error(missions, 2):.2f}"),
]
"""Lines of the table of missions, with the paper's table 2."""


def _distances(runs: Sequence[Sequence[Estimate]]) -> list[float]:
    return [estimate.distance for estimate in _recoveries(runs)]


def _states(runs: Sequence[Sequence[Estimate]]) -> list[int]:
    return [estimate.arrivals for estimate in _recoveries(runs)]


def _format_range(values: Sequence[float], digits: int) -> str:
    least, most = min(values, default=math.nan), max(values, default=math.nan)
    return f"{least:.{digits}f} / {most:.{digits}f}"


_RELOCATION_ROWS: list[tuple[str, str, Callable[[list[list[Estimate]]], str]]] = [
    ("Number of experiments", "10", lambda runs: str(len(runs))),
    ("Recovered", "10", lambda runs: str(len(_recoveries(runs)))),
    ("Total traveled distance [m]", "250", lambda runs: f"{sum(run[-1].distance for run in runs if run):.0f}"),
    ("Mean distance for recovering [m]", "13.7", lambda runs: f"{mean(_distances(runs)):.1f}"),
    ("Min / max distance for recovering [m]", "1.21 / 20.31", lambda runs: _format_range(_distances(runs), 2)),
    ("Mean number of states for recovering", "2.11", lambda runs: f"{mean(_states(runs)):.2f}"),
    ("Min / max states for recovering", "1 / 4", lambda runs: _format_range(_states(runs), 0)),
]
"""Lines of the table of relocations, with the paper's table 3."""
