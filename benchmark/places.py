"""Charts of maps of a simulated institute against its true states: what is found, missed, confused."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmark.institute_maps import PEOPLE, InstituteMap, mapped
from benchmark.places_fit import fit
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from benchmark.simulated.measured import chosen_seeds
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.landmarks.landmarks import OPENING
from hmt_slam_ros.places.chart import CROSSING, END

SEEDS = 5
"""Buildings, each of which is mapped twice."""

_NEAR = 1.0  # m, from a state's place to the node that is it
_ALIKE = 0.4  # m, between the places of one corner in two maps
_BELIEVED = 0.5
_DETECTED, _CONFUSED, _CONSTANT = 0.98, 0.092, 0.77  # paper, table 1

POLICY = (
    f"The default route through an institute of 13 states, with {PEOPLE} people and a laser that sees all around, "
    "mapped twice by the package's own SLAM, with other noise and other people. A state is detected where a node is "
    f"within {_NEAR:g} m of it. A node is confused that is a crossing where there is a door or the other way, or where "
    "there is no state at all; ends of hallways are not counted. The robot drove into the rooms and hallways, so that "
    "these are told apart by what is behind an opening; in the paper they were told apart before that. Off: the "
    "distance of a node from its state's true place. Length: of an edge, against the distance of the two states. "
    "Corners: those believed in "
    f"({_BELIEVED:g} or more) in either map of a building; constant are those with one of their kind within {_ALIKE:g} "
    "m in the other map."
)


class Judged(NamedTuple):
    """A chart against the truth.

    :ivar states: how many there are.
    :ivar detected: how many of these are nodes.
    :ivar confused: how many nodes are confused.
    :ivar off: distances of nodes from their states, m.
    :ivar lengths: errors of the lengths of edges between states, in deviations.
    :ivar corners: shape (n, 3), place and kind.
    """

    states: int
    detected: int
    confused: int
    off: list[float]
    lengths: list[float]
    corners: Float64


def measure_places(settings: Settings) -> Report:
    """Map institutes twice and compare their charts with their states, and with each other."""
    seeds = chosen_seeds(settings, SEEDS)
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    maps = [[mapped(seed, configuration, visit) for visit in (0, 1)] for seed in seeds]
    pairs = [[judged(institute) for institute in own] for own in maps]
    every = [one for pair in pairs for one in pair]
    states = sum(one.states for one in every)
    constant = [share for pair in pairs for share in (_constant(*pair), _constant(*pair[::-1]))]
    report = Report("places", "Places of an institute", seeds=seeds)
    report.requirements = [
        Requirement("states detected", sum(one.detected for one in every) / states, 1.0, least=_DETECTED),
        Requirement("nodes confused, of the states", sum(one.confused for one in every) / states, _CONFUSED),
        Requirement("corners that are constant", float(np.mean(constant)), 1.0, least=_CONSTANT),
    ]
    report.body += [_table(seeds, pairs), POLICY]
    if settings.training:
        report.body.append(fit([own[0] for own in maps], configuration))
    return report


def judged(institute: InstituteMap) -> Judged:
    """A chart beside the truth."""
    states, nodes = institute.scenario.building.states, institute.chart.nodes
    away = np.hypot(*(institute.nodes[:, None, :2] - states.poses[None, :, :2]).transpose(2, 0, 1))
    inner = np.array([node.kind != END for node in nodes])
    crossing = np.array([node.kind == CROSSING for node in nodes])
    own = away.argmin(axis=1)
    near = inner & (away.min(axis=1) <= _NEAR)
    right = near & (states.crossings[own] == crossing)
    lengths = []
    for edge in institute.chart.edges[::2]:
        if near[edge.start] and near[edge.end]:
            true = float(np.hypot(*(states.poses[own[edge.start], :2] - states.poses[own[edge.end], :2])))
            lengths.append((edge.distance[0] - true) / edge.distance[1] ** 0.5)
    found = len(set(own[near].tolist()))
    off = away[near].min(axis=1).tolist()
    return Judged(len(states.poses), found, int((inner & ~right).sum()), off, lengths, _corners(institute))


def _corners(institute: InstituteMap) -> Float64:
    """The true places and the kinds of the corners that are believed in, each once."""
    found: list[tuple[float, float, float]] = []
    for area, view in institute.views.items():
        for landmark in filter(_counts, view.landmarks):
            x, y = se2.compose(institute.frames[area], landmark.pose.mean)[:2].tolist()
            if not _near(np.array((x, y, landmark.kind)), np.array(found).reshape(-1, 3)):
                found.append((x, y, landmark.kind))
    return np.array(found).reshape(-1, 3)


def _counts(landmark: Landmark) -> bool:
    return landmark.kind != OPENING and landmark.existence.probability >= _BELIEVED


def _near(corner: Float64, others: Float64) -> bool:
    """Whether one of some corners (n, 3) is this one."""
    return bool(np.any((np.hypot(*(others[:, :2] - corner[:2]).T) <= _ALIKE) & (others[:, 2] == corner[2])))


def _constant(one: Judged, other: Judged) -> float:
    """Share of the corners of one map that another one has, too."""
    return float(np.mean([_near(corner, other.corners) for corner in one.corners]))


def _table(seeds: Sequence[int], pairs: Sequence[Sequence[Judged]]) -> str:
    head = ["building", "states", "detected", "confused", "off, mean [cm]", "length, RMS [deviations]", "corners"]
    rows = [
        [str(seed), *_cells(pair), f"{100.0 * _constant(*pair):.0f} %"] for seed, pair in zip(seeds, pairs, strict=True)
    ]
    every = [one for pair in pairs for one in pair]
    rows.append(["all", *_cells(every), ""])
    return table([*head, "constant"], rows)


def _cells(judged_maps: Sequence[Judged]) -> list[str]:
    off = [value for one in judged_maps for value in one.off]
    lengths = np.array([value for one in judged_maps for value in one.lengths])
    return [
        *(str(sum(values)) for values in zip(*(one[:3] for one in judged_maps), strict=True)),
        f"{100.0 * np.mean(off):.1f}",
        f"{np.sqrt(np.mean(lengths**2)):.2f}",
        f"{np.mean([len(one.corners) for one in judged_maps]):.0f}",
    ]
