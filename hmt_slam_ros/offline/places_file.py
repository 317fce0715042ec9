"""The chart of a saved map as JSON: places along hallways, the ways between them, and the landmarks on these."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.places.chart import NAMES, Chart, ChartNode
from hmt_slam_ros.places.observation_graph import TRACK_NAMES, Landmarks
from hmt_slam_ros.places.place_graph import DIRECTION_NAMES, Edge

PLACES = "places.json"


def write_places(directory: Path, area_poses: Mapping[int, PoseGaussian], chart: Chart) -> Path:
    """Write ``places.json``, with all numbers in m and rad.

    ``places``, in order, are doors, crossings and ends of hallways, each with its ``name``, the ``area`` in whose frame
    it is known, ``area_T_place`` and ``map_T_place`` (x, y, theta), heading north, the ``existence``, and the
    ``openings`` that lead off there with their ``direction`` and ``width``. ``ways`` lead from one place to the next,
    by their numbers, in both directions: ``distance`` and ``deviation``, and the ``landmarks`` on the way in the order
    in which they are met, each so far ``along`` it, on its ``track``, with a ``form`` (a corner's heading against the
    way, an opening's width) and its ``existence``.

    :param area_poses: {area: the belief over ``map_T_area``}.
    """
    document = {
        "places": [_place(chart.name(k), area_poses[node.area], node) for k, node in enumerate(chart.nodes)],
        "ways": [_way(edge) for edge in chart.edges],
    }
    (directory / PLACES).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return directory / PLACES


def _place(name: str, frame: PoseGaussian, node: ChartNode) -> dict[str, object]:
    openings = [
        {"direction": DIRECTION_NAMES[one.direction], "width": one.landmark.width, "hallway": one.hallway}
        for one in node.openings
    ]
    return {
        "name": name,
        "kind": NAMES[node.kind],
        "area": node.area,
        "area_T_place": node.pose.tolist(),
        "map_T_place": se2.compose(frame.mean, node.pose).tolist(),
        "existence": node.existence,
        "openings": openings,
    }


def _way(edge: Edge) -> dict[str, object]:
    return {
        "start": edge.start,
        "end": edge.end,
        "direction": DIRECTION_NAMES[edge.leaving],
        "distance": edge.distance[0],
        "deviation": float(np.sqrt(edge.distance[1])),
        "landmarks": _landmarks(edge.landmarks),
    }


def _landmarks(landmarks: Landmarks) -> list[dict[str, object]]:
    """In the order in which they are met."""
    return [
        {
            "along": float(landmarks.along[k]),
            "track": TRACK_NAMES[landmarks.tracks[k]],
            "form": float(landmarks.forms[k]),
            "existence": float(landmarks.probabilities[k]),
        }
        for k in np.argsort(landmarks.along, kind="stable").tolist()
    ]
