"""The topology of a saved map as GraphML, which programs and libraries for graphs read, its landmarks and places."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hmt_slam_ros.features.landmark_map import Landmark
from hmt_slam_ros.features.landmarks import KINDS
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.local_map.area_kind import AreaKinds
from hmt_slam_ros.local_map.local_mapping import LocalMapping
from hmt_slam_ros.offline.places_file import write_places
from hmt_slam_ros.offline.saved_map import read_saved_map
from hmt_slam_ros.places.area_views import AreaViews
from hmt_slam_ros.places.chart import chart_of
from hmt_slam_ros.topology.portals import Portal, portals_of
from hmt_slam_ros.topology.surroundings import stacked

TOPOLOGY, LANDMARKS = "topology.graphml", "landmarks.json"

_POSE = ("x", "y", "theta")
_COVARIANCE = ("xx", "xy", "xt", "yy", "yt", "tt")


def export_topology(directory: Path) -> tuple[Path, Path, Path]:
    """Write ``topology.graphml``, ``landmarks.json`` and ``places.json`` of the most probable hypothesis.

    In the graph a node is an area with ``map_T_area``, the number of its ``keyframes``, whether the ``robot`` was in it
    at the end, and the probability that it is a ``hallway`` and no room, which is missing where too little is known
    around it; an edge from a to b an arc with ``a_T_b`` and whether it is a loop ``closure``. Poses are x, y in m and
    theta in rad, xx to tt the upper triangle of their covariance in the right tangent frame. ``portals`` is the number
    of openings that the path passed between the two; the most probable one stands with it, as portal_x to portal_tt,
    ``a_T_portal`` with the heading from a to b, ``portal_width``, m, and the probability of its ``portal_existence``.

    :param directory: output folder of a run.
    :returns: the three files.
    :raises HmtSlamError: where the folder holds no complete map.
    """
    saved = read_saved_map(directory / "hmt_map")
    best = saved.replica.best
    hybrid_map = saved.replica.maps[best]
    mapping = LocalMapping(saved.configuration)
    kinds, views = AreaKinds(mapping), AreaViews(mapping, saved.replica.scans).of_map(hybrid_map)
    landmarks = {area: view.landmarks for area, view in views.items()}
    # Takes a fifth of a second and a dozen megabytes, for this command alone.
    import networkx as nx  # noqa: PLC0415

    graph = nx.DiGraph()
    for area in hybrid_map.area_ids():
        here = area == saved.replica.areas[best]
        numbers = _numbers(saved.area_poses[area])
        keyframes = hybrid_map.keyframes(area)
        kind = kinds.of([saved.replica.scans[k] for k in keyframes], stacked(keyframes))
        hallway = {} if kind is None else {"hallway": kind.probability}
        graph.add_node(area, **numbers, keyframes=len(keyframes), robot=here, **hallway)
    portals = portals_of(hybrid_map, landmarks, saved.configuration.features)
    for a, b, arc in hybrid_map.all_arcs():
        graph.add_edge(a, b, **_numbers(arc.pose), closure=arc.closure, **_annotation(portals, (a, b)))
    nx.write_graphml_xml(graph, directory / TOPOLOGY)
    document = {
        "areas": {str(area): [_landmark(one) for one in own] for area, own in landmarks.items()},
        "portals": [_portal(portal) for portal in portals],
    }
    (directory / LANDMARKS).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    chart = chart_of(hybrid_map, views, saved.configuration.features)
    return directory / TOPOLOGY, directory / LANDMARKS, write_places(directory, saved.area_poses, chart)


def _annotation(portals: Sequence[Portal], areas: tuple[int, int]) -> dict[str, float]:
    """What an arc says of its portals."""
    own = [portal for portal in portals if portal.areas == areas]
    if not own:
        return {"portals": 0}
    best = max(own, key=lambda portal: portal.existence)
    pose = {f"portal_{name}": value for name, value in _numbers(best.pose_in_a).items()}
    return {"portals": len(own), **pose, "portal_width": best.width, "portal_existence": best.existence}


def _landmark(landmark: Landmark) -> dict[str, object]:
    existence = landmark.existence
    opening = {"width": landmark.width, "width_deviation": landmark.width_deviation} if landmark.width else {}
    return {
        "kind": KINDS[landmark.kind],
        **_numbers(landmark.pose),
        **opening,
        "existence": existence.probability,
        "seen": existence.seen,
        "missed": existence.missed,
    }


def _portal(portal: Portal) -> dict[str, object]:
    return {
        "areas": list(portal.areas),
        "in_first": _numbers(portal.pose_in_a),
        "in_second": _numbers(portal.pose_in_b),
        "width": portal.width,
        "width_deviation": portal.width_deviation,
        "existence": portal.existence,
        "passages": portal.passages,
    }


def _numbers(belief: PoseGaussian) -> dict[str, float]:
    upper = belief.covariance[np.triu_indices(3)]
    return dict(zip(_POSE + _COVARIANCE, [*belief.mean.tolist(), *upper.tolist()], strict=True))
