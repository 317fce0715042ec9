"""The frame of a team: the maps of robots that are joined, in the map of one of them."""

from __future__ import annotations

from collections.abc import Iterable

import networkx
import numpy as np

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.map_changes import Pose
from hmt_slam_ros.messages.team import TeamPlacement, Verdict


def team_poses(robot: str, placements: Iterable[TeamPlacement]) -> dict[str, Pose]:
    """{robot: ``team_T_map``, shape (3,)} of the robots that are joined with one, directly or by others.

    The frame of the team is the map of the first of them by name. Where both robots of a pair have an answer, that of
    the one by whose name the pair begins counts, so that all robots get the same frame.

    :param robot: alone, it is a team of its own.
    :param placements: the last answer of each robot for each pair.
    """
    graph = networkx.Graph()
    graph.add_node(robot)
    answers = {(each.first, each.second): each for each in sorted(placements, key=lambda p: p.robot != p.second)}
    for (first, second), answer in answers.items():
        if answer.verdict is Verdict.JOINED:
            graph.add_edge(first, second, risk=1.0 - answer.probability, answer=answer)
    group = networkx.node_connected_component(graph, robot)
    root = min(group)
    poses = {root: np.zeros(3)}
    paths = networkx.single_source_dijkstra_path(graph, root, weight="risk")
    for name, path in sorted(paths.items(), key=lambda entry: len(entry[1])):
        if name != root:
            answer = graph.edges[path[-2], name]["answer"]
            step = answer.pose if answer.first == path[-2] else se2.inverse(answer.pose)
            poses[name] = se2.compose(poses[path[-2]], step)
    return poses
