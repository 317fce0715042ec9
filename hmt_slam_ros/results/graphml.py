"""Areas and arcs as GraphML, for libraries of graphs."""

from __future__ import annotations

import io
from collections.abc import Mapping

import numpy as np

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.topology import Topology

_POSE = ("x", "y", "theta")
_COVARIANCE = ("xx", "xy", "xt", "yy", "yt", "tt")
"""Names of the components of a pose, and of the upper triangle of its covariance."""


def topology_graphml(topology: Topology) -> str:
    """The areas and arcs of a message as GraphML.

    Areas have :func:`area_attributes`, arcs have :func:`arc_attributes` and their ``probability``.
    """
    areas = {
        known.area: area_attributes(known.pose, len(known.keyframes), known.area == topology.area)
        for known in topology.areas
    }
    arcs = {
        (arc.source, arc.target): {**arc_attributes(arc.pose, arc.closure), "probability": arc.probability}
        for arc in topology.arcs
    }
    return graphml(areas, arcs).decode()


def graphml(areas: Mapping[int, Mapping[str, object]], arcs: Mapping[tuple[int, int], Mapping[str, object]]) -> bytes:
    """A directed graph as GraphML.

    :param areas: {area: attributes}.
    :param arcs: {(source, target): attributes}.
    """
    import networkx as nx  # noqa: PLC0415  it takes 0.2 s and 12 MB, for those who want GraphML alone

    graph = nx.DiGraph()
    graph.add_nodes_from(areas.items())
    graph.add_edges_from((*ends, attributes) for ends, attributes in arcs.items())
    document = io.BytesIO()
    nx.write_graphml_xml(graph, document)
    return document.getvalue()


def area_attributes(pose: PoseGaussian, keyframe_count: int, has_robot: bool) -> dict[str, object]:
    """Attributes of an area: the belief over ``map_T_area``, its number of keyframes, whether the robot is in it."""
    return {**pose_values(pose), "keyframes": keyframe_count, "robot": has_robot}


def arc_attributes(pose: PoseGaussian, closure: bool) -> dict[str, object]:
    """Attributes of an arc: the belief over ``source_T_target``, whether it closed a loop."""
    return {**pose_values(pose), "closure": closure}


def pose_values(belief: PoseGaussian) -> dict[str, float]:
    """{name: component} of the mean, m and rad, and of the upper triangle of the covariance, right tangent frame."""
    upper = belief.covariance[np.triu_indices(3)]
    return dict(zip(_POSE + _COVARIANCE, [*belief.mean.tolist(), *upper.tolist()], strict=True))
