"""The topology of a saved map as GraphML, which programs and libraries for graphs read."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.local_map.area_kind import AreaKinds
from hmt_slam_ros.local_map.local_mapping import LocalMapping
from hmt_slam_ros.offline.saved_map import read_saved_map
from hmt_slam_ros.topology.surroundings import stacked

TOPOLOGY = "topology.graphml"

_POSE = ("x", "y", "theta")
_COVARIANCE = ("xx", "xy", "xt", "yy", "yt", "tt")


def export_topology(directory: Path) -> Path:
    """Write the areas and arcs of the most probable hypothesis into an output folder as ``topology.graphml``.

    A node is an area with ``map_T_area``, the number of its ``keyframes``, whether the ``robot`` was in it at the end,
    and the probability that it is a ``hallway`` and no room, which is missing where too little is known around it; an
    edge from a to b an arc with ``a_T_b`` and whether it is a loop ``closure``. Poses are x, y in m and theta in rad,
    xx to tt the upper triangle of their covariance in the right tangent frame.

    :param directory: output folder of a run.
    :returns: the file.
    :raises HmtSlamError: where the folder holds no complete map.
    """
    saved = read_saved_map(directory / "hmt_map")
    best = saved.replica.best
    hybrid_map = saved.replica.maps[best]
    kinds = AreaKinds(LocalMapping(saved.configuration))
    # Takes a fifth of a second and a dozen megabytes, for this command alone.
    import networkx as nx  # noqa: PLC0415

    graph = nx.DiGraph()
    for area in hybrid_map.area_ids():
        here = area == saved.replica.areas[best]
        numbers = _numbers(saved.area_poses[area])
        keyframes = hybrid_map.keyframes(area)
        kind = kinds.of([saved.replica.scans[k] for k in keyframes], stacked(keyframes))
        known = {} if kind is None else {"hallway": kind.probability}
        graph.add_node(area, **numbers, keyframes=len(keyframes), robot=here, **known)
    for a, b, arc in hybrid_map.all_arcs():
        graph.add_edge(a, b, **_numbers(arc.pose), closure=arc.closure)
    nx.write_graphml_xml(graph, directory / TOPOLOGY)
    return directory / TOPOLOGY


def _numbers(belief: PoseGaussian) -> dict[str, float]:
    upper = belief.covariance[np.triu_indices(3)]
    return dict(zip(_POSE + _COVARIANCE, [*belief.mean.tolist(), *upper.tolist()], strict=True))
