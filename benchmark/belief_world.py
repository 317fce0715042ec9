"""Random corridors with landmarks, true buildings for them, and observations drawn from the model of the belief."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.places.observation import ObservationModel, visible_interval
from hmt_slam_ros.places.observation_graph import (
    OPENINGS,
    TRACKS,
    LandmarkSequence,
    empty_sequence,
    merge_sequences,
    select_landmarks,
)
from hmt_slam_ros.places.place_graph import EAST, NORTH, Edge, Node

SURENESS = 2.0
"""Sum of the parameters of the beta distribution of confidences p_l; smaller values are wider."""

WIDTHS = (0.6, 3.0)
"""Of openings, m, evenly distributed."""

ROUGH = 0.03
"""Deviation of a distance in the map by its length."""

_DOOR, _HALLWAY = (0.7, 1.2), (1.5, 2.5)  # widths, m
_DOORS, _LEAST = 3.0, 1.5  # mean distance between doors beyond the least, m
_BETWEEN, _END = (10.0, 20.0), (6.0, 15.0)  # of hallways from each other and beyond the last crossing, m
_APART = 0.6  # landmarks of a track, m, at least
_EXISTENCE = (0.6, 1.0)
_PLACED, _FORM = 0.05**2, 0.03**2  # variances of a landmark of the map: along, m^2, and of its form, rad^2 or m^2
_CORNER, _LEFT, _RIGHT = 4, OPENINGS + 1, OPENINGS + 3


def draw_observation(
    random: np.random.Generator, landmarks: LandmarkSequence, offset: float, variance: float, model: ObservationModel
) -> LandmarkSequence:
    """A random observation of the landmarks of a state.

    :param offset: of the robot beyond the state's node, m.
    :param variance: of that, m^2.
    """
    there = random.random(len(landmarks.tracks)) < landmarks.probabilities
    return draw_of_present(random, landmarks, there, offset + random.normal(0.0, math.sqrt(variance)), model)


def draw_of_present(
    random: np.random.Generator, landmarks: LandmarkSequence, there: Bool, offset: float, model: ObservationModel
) -> LandmarkSequence:
    """A random observation of the present landmarks from a known position."""
    extracted = there & (random.random(len(there)) < model.detection)
    extracted_landmarks = select_landmarks(landmarks, extracted)
    corner = extracted_landmarks.tracks < OPENINGS
    form_variances = extracted_landmarks.variances[:, 1] + np.where(
        corner, model.heading_variance, model.width_variance
    )
    along = (
        extracted_landmarks.positions
        - offset
        + random.normal(0.0, np.sqrt(extracted_landmarks.variances[:, 0] + model.position_variance))
    )
    forms = extracted_landmarks.forms + random.normal(0.0, np.sqrt(form_variances))
    found = _make_sequence(
        extracted_landmarks.tracks,
        along,
        np.where(corner, se2.wrap(forms), forms),
        _draw_confidences(random, len(along), model),
    )
    sight = (
        visible_interval(track, form, model.reach)
        for track, form in zip(extracted_landmarks.tracks, extracted_landmarks.forms, strict=True)
    )
    low, high = np.array(list(sight)).reshape(-1, 2).T
    within = select_landmarks(found, (low <= found.positions) & (found.positions <= high))
    return merge_sequences((within, draw_clutter(random, model.new_density, model.false_density, model)))


def draw_clutter(
    random: np.random.Generator, present_density: float, absent_density: float, model: ObservationModel
) -> LandmarkSequence:
    """Random landmarks outside of the map, by the densities of true and of false ones, 1/m."""
    lists = []
    for density, is_present in ((present_density, True), (absent_density, False)):
        count = int(random.poisson(density * 2.0 * model.reach * TRACKS))
        tracks = random.integers(0, TRACKS, count)
        along = random.uniform(-model.reach, model.reach, count)
        forms = np.where(tracks < OPENINGS, random.uniform(-np.pi, np.pi, count), random.uniform(*WIDTHS, count))
        lists.append(_make_sequence(tracks, along, forms, _draw_confidences(random, count, model, is_present)))
    return merge_sequences(lists)


def _draw_confidences(random: np.random.Generator, count: int, model: ObservationModel, there: bool = True) -> Float64:
    """Random confidences of true or false landmarks; those of all landmarks are beta(a, b) with the mean pi."""
    a, b = SURENESS * model.true_share, SURENESS * (1.0 - model.true_share)
    return random.beta(a + there, b + (not there), count)


def _make_sequence(tracks: Int64, along: Float64, forms: Float64, confidences: Float64) -> LandmarkSequence:
    """Landmarks whose positions and forms have only the errors of the model."""
    return merge_sequences((LandmarkSequence(tracks, along, forms, np.zeros((len(tracks), 2)), confidences),))


class Corridors(NamedTuple):
    """Nodes and the edges between them in one direction each."""

    nodes: list[Node]
    edges_one_way: list[Edge]

    @property
    def edges(self) -> list[Edge]:
        """In both directions."""
        return [edge for edge in self.edges_one_way for edge in (edge, edge.reverse)]


def random_corridors(random: np.random.Generator, rows: int, columns: int, density: float) -> Corridors:
    """Hallways from west to east that cross others from south to north, with doors and corners.

    :param density: of the corners of a kind, 1/m.
    """
    across, up = _crossings(random, columns), _crossings(random, rows)
    corridors = Corridors([_crossing(random) for _ in range(rows * columns)], [])
    for row in range(rows):
        _hallway(random, corridors, [row * columns + k for k in range(columns)], across, EAST, density)
    for column in range(columns):
        _hallway(random, corridors, [k * columns + column for k in range(rows)], up, NORTH, density)
    return corridors


def draw_building(random: np.random.Generator, corridors: Corridors) -> Corridors:
    """A random building of which the corridors are a map: the landmarks that exist, at exact places."""
    nodes = [
        Node(
            float(random.random() < node.existence), _draw_present(random, node.north), _draw_present(random, node.east)
        )
        for node in corridors.nodes
    ]
    edges_one_way = [
        edge._replace(
            distance=(random.normal(edge.distance[0], math.sqrt(edge.distance[1])), 0.0),
            turn=(random.normal(edge.turn[0], math.sqrt(edge.turn[1])), 0.0),
            landmarks=_draw_present(random, edge.landmarks),
        )
        for edge in corridors.edges_one_way
    ]
    return Corridors(nodes, edges_one_way)


def _draw_present(random: np.random.Generator, landmarks: LandmarkSequence) -> LandmarkSequence:
    there = random.random(len(landmarks.tracks)) < landmarks.probabilities
    kept = select_landmarks(landmarks, there)
    along, forms = (random.normal(mean, np.sqrt(kept.variances[:, k])) for k, mean in enumerate(kept[1:3]))
    certain = np.zeros_like(kept.variances)
    return merge_sequences((LandmarkSequence(kept.tracks, along, forms, certain, np.ones(len(along))),))


def _crossings(random: np.random.Generator, count: int) -> Float64:
    """Positions of crossings along a hallway, with its two ends as first and last, m."""
    steps = [*random.uniform(*_END, 1), *random.uniform(*_BETWEEN, count - 1), *random.uniform(*_END, 1)]
    return np.concatenate(([0.0], np.cumsum(steps)))


def _hallway(
    random: np.random.Generator,
    corridors: Corridors,
    crossings: Sequence[int],
    places: Float64,
    heading: int,
    density: float,
) -> None:
    """Add the doors and the two ends of a hallway, and its edges."""
    stops = list(zip(places[1:-1].tolist(), crossings, strict=True))
    for begin, end in zip(places[:-1].tolist(), places[1:].tolist(), strict=True):
        at = begin + _LEAST + random.exponential(_DOORS)
        while at < end - _LEAST:
            stops.append((at, _add_node(corridors, _side(random, heading, _opening(random, _DOOR, (_LEFT, _RIGHT))))))
            at += _LEAST + random.exponential(_DOORS)
    stops += [(at, _add_node(corridors, _side(random, heading, empty_sequence()))) for at in places[[0, -1]].tolist()]
    stops.sort()
    for (at, start), (then, end) in pairwise(stops):
        length = then - at
        distance = (length, (ROUGH * length) ** 2)
        landmarks = _corners(random, length, density)
        corridors.edges_one_way.append(Edge(start, heading, end, heading, distance, (0.0, 0.01**2), landmarks))


def _add_node(corridors: Corridors, node: Node) -> int:
    corridors.nodes.append(node)
    return len(corridors.nodes) - 1


def _side(random: np.random.Generator, heading: int, landmarks: LandmarkSequence) -> Node:
    existence = float(random.uniform(*_EXISTENCE))
    none = empty_sequence()
    return Node(existence, landmarks, none) if heading == NORTH else Node(existence, none, landmarks)


def _crossing(random: np.random.Generator) -> Node:
    both = [
        merge_sequences((_opening(random, _HALLWAY, (_LEFT,)), _opening(random, _HALLWAY, (_RIGHT,)))) for _ in range(2)
    ]
    return Node(float(random.uniform(*_EXISTENCE)), *both)


def _opening(random: np.random.Generator, widths: tuple[float, float], tracks: Sequence[int]) -> LandmarkSequence:
    return _landmarks(random, random.choice(tracks, 1).tolist(), [0.0], [float(random.uniform(*widths))])


def _corners(random: np.random.Generator, length: float, density: float) -> LandmarkSequence:
    """Random corners along a stretch of hallway, with headings along one of the four diagonals."""
    tracks, along, forms = [], [], []
    for track in range(_CORNER):
        at = 0.5 * _APART + random.exponential(1.0 / density)
        while at < length - 0.5 * _APART:
            tracks.append(track)
            along.append(at)
            forms.append(0.5 * math.pi * random.integers(4) - 0.75 * math.pi)
            at += _APART + random.exponential(1.0 / density)
    return _landmarks(random, tracks, along, forms)


def _landmarks(
    random: np.random.Generator, tracks: Sequence[int], along: Sequence[float], forms: Sequence[float]
) -> LandmarkSequence:
    count = len(tracks)
    variances = np.tile((_PLACED, _FORM), (count, 1))
    existence = random.uniform(*_EXISTENCE, count)
    own = np.array(tracks, dtype=np.int64), np.array(along, dtype=np.float64), np.array(forms, dtype=np.float64)
    return merge_sequences((LandmarkSequence(*own, variances, existence),))
