"""The robot's own ground in a map that also has ground of other robots."""

from __future__ import annotations

import networkx
import numpy as np

from hmt_slam_ros.hybrid_map.hybrid_map import (
    NO_KEYFRAME,
    ArcValue,
    HybridMap,
    KeyframePoses,
    area_pair,
    has_foreign_keyframes,
)
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative, shortest_path_beliefs


def own_ground(hybrid_map: HybridMap) -> HybridMap:
    """The areas with keyframes of the robot's own, with these keyframes alone.

    Where foreign ground alone leads from one to another, the arc between them is its most certain path.
    """
    keyframes = {area: _own_keyframes(hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()}
    own = HybridMap(changed_areas={area: poses for area, poses in keyframes.items() if poses})  # type: ignore[misc]
    own.changed_arcs |= {
        (a, b): arc for a, b, arc in hybrid_map.all_arcs() if a in own.changed_areas and b in own.changed_areas
    }
    _bridge(own, hybrid_map)
    own.commit()
    return own


def _own_keyframes(keyframes: KeyframePoses) -> KeyframePoses:
    """The very mapping where all keyframes are the robot's own."""
    if not has_foreign_keyframes(keyframes):
        return keyframes
    return {keyframe: pose for keyframe, pose in keyframes.items() if keyframe > NO_KEYFRAME}


def _bridge(own: HybridMap, hybrid_map: HybridMap) -> None:
    """Join the pieces of a map by the most certain paths of another map, from the first piece on."""
    graph = networkx.Graph()
    graph.add_nodes_from(own.changed_areas)
    graph.add_edges_from(ends for ends, arc in own.changed_arcs.items() if arc and not is_uninformative(arc.pose))
    first, *others = sorted(networkx.connected_components(graph), key=min) or [set()]
    for piece in others:
        area = min(piece)
        paths = shortest_path_beliefs(hybrid_map, area, targets=sorted(first))
        reached = {other: belief for other, belief in paths.items() if other in first}
        if reached:
            nearest = min(reached, key=lambda other: (float(np.trace(reached[other].covariance)), other))
            pose = reached[nearest]
            own.changed_arcs[area_pair(area, nearest)] = ArcValue(pose if area < nearest else pose.inverse(), False)
            first |= piece
