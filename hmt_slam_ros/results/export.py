"""Parts of a saved map for other programs: grid for nav2, topology as GraphML, chart of places as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.grids.occupancy_map import occupancy_image, write_map
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.hybrid_map.surroundings import stack_poses
from hmt_slam_ros.landmarks.area_classes import AreaClassifier
from hmt_slam_ros.landmarks.landmarks import KIND_NAMES
from hmt_slam_ros.landmarks.portals import Portal, find_portals
from hmt_slam_ros.own_files import write_file
from hmt_slam_ros.places.area_views import AreaViewCache
from hmt_slam_ros.places.chart import NODE_KIND_NAMES, Chart, ChartNode, build_chart
from hmt_slam_ros.places.observation_graph import TRACK_NAMES, LandmarkSequence
from hmt_slam_ros.places.place_graph import DIRECTION_NAMES, Edge
from hmt_slam_ros.results.graphml import arc_attributes, area_attributes, graphml, pose_values
from hmt_slam_ros.results.hmt_map import read_saved_map
from hmt_slam_ros.results.log_reading import map_folder
from hmt_slam_ros.submap.local_mapping import LocalMapping
from hmt_slam_ros.untrusted_input import shorten

_FINEST, _COARSEST = 0.005, 10.0
"""Limits of the resolution of a grid, m."""

PLACES, TOPOLOGY, LANDMARKS = "places.json", "topology.graphml", "landmarks.json"
"""Files of the chart of places, of the topology and of the landmarks."""


def export_grid(
    directory: Path, folder: Path, resolution: float | None = None, area: int | None = None
) -> tuple[Path, Path]:
    """Write map.pgm and map.yaml, drawn from the keyframes of the most probable hypothesis.

    :param directory: output folder, the hmt_map in it, or a map that nodes saved.
    :param folder: folder for the files, made where it is missing.
    :param resolution: side of a cell, m; that of the local maps where None.
    :param area: the one area to draw, in its own frame; None for the whole map in the map frame.
    :returns: the two files.
    :raises HmtSlamError: where there is no complete map, no such area, or the resolution is out of range.
    """
    if resolution is not None and not _FINEST <= resolution <= _COARSEST:
        raise HmtSlamError(f"--resolution {resolution:g} is none for a grid: give {_FINEST:g} to {_COARSEST:g} m")
    saved = read_saved_map(map_folder(directory))
    hybrid_map = saved.replica.maps[saved.replica.best_hypothesis]
    areas = [known for known in hybrid_map.area_ids() if known in saved.area_poses]
    if area is not None and area not in areas:
        raise HmtSlamError(f"--area {area} is not in the map: its areas are {', '.join(map(str, areas))}")
    frames = {area: np.zeros(3)} if area is not None else {known: saved.area_poses[known].mean for known in areas}
    poses = {
        keyframe: se2.compose(frame, pose)
        for known, frame in frames.items()
        for keyframe, pose in hybrid_map.keyframes(known).items()
    }
    scans = [saved.replica.scans[keyframe] for keyframe in poses]
    settings = saved.configuration.local_map
    try:
        folder.mkdir(parents=True, exist_ok=True)
        image = occupancy_image(scans, np.array(list(poses.values())), resolution or settings.cell, settings.max_range)
        write_map(folder, image)
    except OSError as fault:
        raise HmtSlamError(f"{folder} cannot be written ({fault.strerror}): choose another --grid") from fault
    return folder / "map.pgm", folder / "map.yaml"


def write_places(directory: Path, area_poses: Mapping[int, PoseGaussian], chart: Chart) -> Path:
    """Write ``places.json``, with all numbers in m and rad.

    ``places`` are doors, crossings and ends of hallways. Each has its ``name``, its ``area``, ``area_T_place`` and
    ``map_T_place`` (x, y, theta) with the heading north, its ``existence``, and its ``openings`` with ``direction`` and
    ``width``. ``ways`` connect neighboring places, by their numbers, in both directions. Each has ``distance``,
    ``deviation`` and the ``landmarks`` along it in order, with the distance ``along`` it, the ``track``, a ``form`` (a
    corner's heading relative to the way, an opening's width) and the ``existence``.

    :param area_poses: {area: the belief over ``map_T_area``}.
    """
    document = {
        "places": [_place_entry(chart.name(k), area_poses[node.area], node) for k, node in enumerate(chart.nodes)],
        "ways": [_edge_entry(edge) for edge in chart.edges],
    }
    write_file(directory / PLACES, (json.dumps(document, indent=1) + "\n").encode())
    return directory / PLACES


def _place_entry(name: str, frame: PoseGaussian, node: ChartNode) -> dict[str, object]:
    openings = [
        {"direction": DIRECTION_NAMES[side.direction], "width": side.landmark.width, "hallway": side.leads_to_hallway}
        for side in node.openings
    ]
    return {
        "name": name,
        "kind": NODE_KIND_NAMES[node.kind],
        "area": node.area,
        "area_T_place": node.pose.tolist(),
        "map_T_place": se2.compose(frame.mean, node.pose).tolist(),
        "existence": node.existence,
        "openings": openings,
    }


def _edge_entry(edge: Edge) -> dict[str, object]:
    return {
        "start": edge.start,
        "end": edge.end,
        "direction": DIRECTION_NAMES[edge.start_direction],
        "distance": edge.distance[0],
        "deviation": float(np.sqrt(edge.distance[1])),
        "landmarks": _edge_landmark_entries(edge.landmarks),
    }


def _edge_landmark_entries(landmarks: LandmarkSequence) -> list[dict[str, object]]:
    """The landmarks in their order along the edge."""
    return [
        {
            "along": float(landmarks.positions[k]),
            "track": TRACK_NAMES[landmarks.tracks[k]],
            "form": float(landmarks.forms[k]),
            "existence": float(landmarks.probabilities[k]),
        }
        for k in np.argsort(landmarks.positions, kind="stable").tolist()
    ]


def export_topology(directory: Path) -> tuple[Path, Path, Path]:
    """Write ``topology.graphml``, ``landmarks.json`` and ``places.json`` of the most probable hypothesis.

    A node of the graph is an area with ``map_T_area``, the number of its ``keyframes``, whether the ``robot`` was in it
    at the end, and the probability that it is a ``hallway``, where enough is known around it. An edge from a to b is an
    arc with ``a_T_b`` and whether it is a loop ``closure``. Poses are x, y in m and theta in rad; xx to tt are the
    upper triangle of the covariance in the right tangent frame. ``portals`` is the number of openings that the path
    passed between the two areas. The most probable one is given as portal_x to portal_tt, ``a_T_portal`` with the
    heading from a to b, ``portal_width``, m, and ``portal_existence``, its probability.

    :param directory: output folder of a run.
    :returns: the three files.
    :raises HmtSlamError: where the folder holds no complete map.
    """
    saved = read_saved_map(directory / "hmt_map")
    best = saved.replica.best_hypothesis
    hybrid_map = saved.replica.maps[best]
    mapping = LocalMapping(saved.configuration)
    kinds, views = AreaClassifier(mapping), AreaViewCache(mapping, saved.replica.scans).views_of_map(hybrid_map)
    landmarks = {area: view.landmarks for area, view in views.items()}
    areas: dict[int, dict[str, object]] = {}
    if missing := sorted(set(hybrid_map.area_ids()) - saved.area_poses.keys()):
        raise HmtSlamError(f"{directory} has no pose of the areas {shorten(missing)}: map the log again")
    for area in hybrid_map.area_ids():
        has_robot = area == saved.replica.robot_areas[best]
        keyframes = hybrid_map.keyframes(area)
        kind = kinds.classify([saved.replica.scans[k] for k in keyframes], stack_poses(keyframes))
        hallway = {} if kind is None else {"hallway": kind.probability}
        areas[area] = {**area_attributes(saved.area_poses[area], len(keyframes), has_robot), **hallway}
    portals = find_portals(hybrid_map, landmarks, saved.configuration.features)
    arcs = {
        (a, b): {**arc_attributes(arc.pose, arc.closure), **_portal_attributes(portals, (a, b))}
        for a, b, arc in hybrid_map.all_arcs()
    }
    write_file(directory / TOPOLOGY, graphml(areas, arcs))
    document = {
        "areas": {str(area): [_landmark_entry(landmark) for landmark in known] for area, known in landmarks.items()},
        "portals": [_portal_entry(portal) for portal in portals],
    }
    write_file(directory / LANDMARKS, (json.dumps(document, indent=1) + "\n").encode())
    chart = build_chart(hybrid_map, views, saved.configuration.features)
    return directory / TOPOLOGY, directory / LANDMARKS, write_places(directory, saved.area_poses, chart)


def _portal_attributes(portals: Sequence[Portal], areas: tuple[int, int]) -> dict[str, float]:
    """The attributes of an edge for the portals between two areas."""
    between = [portal for portal in portals if portal.areas == areas]
    if not between:
        return {"portals": 0}
    best = max(between, key=lambda portal: portal.existence)
    pose = {f"portal_{name}": value for name, value in pose_values(best.pose_in_a).items()}
    return {"portals": len(between), **pose, "portal_width": best.width, "portal_existence": best.existence}


def _landmark_entry(landmark: Landmark) -> dict[str, object]:
    existence = landmark.existence
    opening = {"width": landmark.width, "width_deviation": landmark.width_deviation} if landmark.width else {}
    return {
        "kind": KIND_NAMES[landmark.kind],
        **pose_values(landmark.pose),
        **opening,
        "existence": existence.probability,
        "seen": existence.detections,
        "missed": existence.misses,
    }


def _portal_entry(portal: Portal) -> dict[str, object]:
    return {
        "areas": list(portal.areas),
        "in_first": pose_values(portal.pose_in_a),
        "in_second": pose_values(portal.pose_in_b),
        "width": portal.width,
        "width_deviation": portal.width_deviation,
        "existence": portal.existence,
        "passages": portal.crossing_count,
    }
