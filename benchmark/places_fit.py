"""What the observation model of places is fitted to: landmarks of a map beside what scans of another drive show."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from benchmark.institute_maps import InstituteMap, scenario_of
from benchmark.report import table
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.beam_labels import rays_of
from hmt_slam_ros.landmarks.corners import corners_of
from hmt_slam_ros.landmarks.line_extraction import extract_lines
from hmt_slam_ros.landmarks.openings import openings_of
from hmt_slam_ros.places.observation import reach_of
from hmt_slam_ros.places.observation_graph import OPENINGS, TRACKS, Landmarks, chosen, observation_graph, of_walls
from hmt_slam_ros.places.place_graph import PlaceGraph, state_of
from hmt_slam_ros.sensors import Scan

_EVERY = 5  # scans
_CHANGED = 0.25  # of the doors, that were closed before the further drive, and others opened
_BESIDE, _ASKEW = 0.6, 0.5  # m and rad, from the middle of an edge and its direction, of a scan that counts
_APART = 0.6  # m, of a landmark that was seen from one of the map that it is
_MARGIN = 0.3  # m, inside of the reach, for landmarks that have to be seen

POLICY = (
    f"Fit of the observation model: every {_EVERY}th scan of a further drive through the same building, in which "
    f"{100.0 * _CHANGED:.0f} % of the open doors were closed and others opened, at its true pose, where it was taken "
    f"along an edge of the chart. A landmark of the map is seen where one of its track is within {_APART:g} m; so far "
    "off are both, beyond what map and measurement say, on average of the squares. Detection: share of those in sight, "
    f"by {_MARGIN:g} m and more within reach, in proportion to their p_lmap. What is seen and is none of them is "
    "there, or is not, in proportion to its confidence. Usual: all that is seen."
)


class Match(NamedTuple):
    """A landmark of the map that has to be seen.

    :ivar corner: whether it is a corner; else an opening.
    :ivar probability: its p_lmap.
    :ivar seen: whether it is.
    :ivar off: along the hallway beyond what map and measurement say, squared, m^2.
    :ivar form: likewise heading, rad^2, or width, m^2.
    """

    corner: bool
    probability: float
    seen: bool
    off: float
    form: float


class Sight(NamedTuple):
    """What a scan shows.

    :ivar matches: landmarks of the map.
    :ivar confidences: of all that is seen.
    :ivar extra: of what is seen and is not in the map.
    """

    matches: list[Match]
    confidences: list[float]
    extra: list[float]


def fit(maps: Sequence[InstituteMap], configuration: Configuration) -> str:
    """The parameters that a further drive through each building tells."""
    sights = [sight for institute in maps for sight in sights_of(institute, configuration)]
    matches = [match for sight in sights for match in sight.matches]
    seen = [match for match in matches if match.seen]
    confidences = np.array([value for sight in sights for value in sight.confidences])
    extra = np.array([value for sight in sights for value in sight.extra])
    ground = len(sights) * 2.0 * configuration.places.reach * TRACKS
    corners = [match for match in seen if match.corner]
    openings = [match for match in seen if not match.corner]
    found = {
        "detection": sum(match.seen for match in matches) / sum(match.probability for match in matches),
        "position_deviation": _root([match.off for match in seen]),
        "heading_deviation": math.degrees(_root([match.form for match in corners])),
        "width_deviation": _root([match.form for match in openings]),
        "false_density": float((1.0 - extra).sum()) / ground,
        "new_density": float(extra.sum()) / ground,
        "usual_density": len(confidences) / ground,
        "true_share": float(confidences.mean()),
    }
    now = configuration.places
    rows = [[name, f"{value:.3g}", f"{getattr(now, name):g}"] for name, value in found.items()]
    return table(["parameter", "fitted", "now"], rows) + f"\n\n{len(sights)} scans, {len(matches)} landmarks. {POLICY}"


def _root(squares: Sequence[float]) -> float:
    return math.sqrt(max(0.0, float(np.mean(squares))))


def sights_of(institute: InstituteMap, configuration: Configuration) -> Iterator[Sight]:
    """What scans of a further drive along the hallways show."""
    graph, nodes = institute.chart.graph(configuration.places), institute.nodes
    scenario = scenario_of(institute.scenario.settings.seed, visit=2, changed=_CHANGED)
    numbers = range(0, len(scenario.scan_stamps), _EVERY)
    poses = scenario.true_poses(scenario.scan_stamps[::_EVERY])
    for number, pose in zip(numbers, poses, strict=True):
        for edge in institute.chart.edges:
            axis = np.array((*nodes[edge.start, :2], nodes[edge.start, 2] - 0.5 * math.pi * edge.leaving))
            ahead, beside, askew = se2.between(axis, pose).tolist()
            if 0.0 <= ahead < edge.distance[0] and abs(beside) <= _BESIDE and abs(askew) <= _ASKEW:
                state = state_of(edge.start, edge.leaving)
                yield _sight(scenario.scan(number), -askew, ahead, state, graph, configuration)
                break


def _sight(scan: Scan, axis: float, away: float, state: int, graph: PlaceGraph, configuration: Configuration) -> Sight:
    features, places = configuration.features, configuration.places
    lines = extract_lines(scan, features)
    openings = openings_of(lines, rays_of(scan, features), features)
    seen = of_walls(observation_graph(corners_of(lines, features), openings, axis, places))
    known = chosen(graph.expected.landmarks, slice(*graph.expected.starts[state : state + 2].tolist()))
    known = known._replace(along=known.along - away)
    left, matches = set(range(len(seen.tracks))), []
    for i in range(len(known.tracks)):
        near = [j for j in sorted(left) if _alike(known, i, seen, j)]
        own = min(near, key=lambda j: abs(seen.along[j] - known.along[i]), default=None)
        left.discard(own if own is not None else -1)
        low, high = reach_of(int(known.tracks[i]), float(known.forms[i]), places.reach)
        if low + _MARGIN <= known.along[i] <= high - _MARGIN:
            matches.append(_match(known, i, seen, own))
    extra = [float(seen.probabilities[j]) for j in sorted(left)]
    return Sight(matches, seen.probabilities.tolist(), extra)


def _alike(known: Landmarks, i: int, seen: Landmarks, j: int) -> bool:
    return bool(known.tracks[i] == seen.tracks[j]) and abs(float(seen.along[j] - known.along[i])) <= _APART


def _match(known: Landmarks, i: int, seen: Landmarks, j: int | None) -> Match:
    corner, probability = bool(known.tracks[i] < OPENINGS), float(known.probabilities[i])
    if j is None:
        return Match(corner, probability, False, 0.0, 0.0)
    turn = float(seen.forms[j] - known.forms[i])
    off = np.array((seen.along[j] - known.along[i], float(se2.wrap(turn)) if corner else turn))
    beyond: Float64 = off**2 - known.variances[i] - seen.variances[j]
    return Match(corner, probability, True, float(beyond[0]), float(beyond[1]))
