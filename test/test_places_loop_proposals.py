"""Loops that the landmarks of a map propose, whatever its arcs say."""

import math

import numpy as np
import pytest
from small_floor import AREAS, BUILDING, CONFIGURATION, keyframes, seen_at
from worlds import scan_at

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.places.area_views import AreaViewCache
from hmt_slam_ros.places.chart import build_chart
from hmt_slam_ros.places.loop_detector import traversed_paths
from hmt_slam_ros.places.loop_proposals import AreaLoopDetector, LoopProposer
from hmt_slam_ros.simulation.building import FloorPlan
from hmt_slam_ros.submap.local_mapping import LocalMapping

# The areas of another visit, the first of which is a step long: where both truly begin, and where the arcs have them.
THIRD, ARCS = np.array([4.0, 0.1, 0.7]), np.array([30.0, 40.0, -1.0])
VAGUE = np.diag([20.0, 20.0, 1.0]) ** 2


def other_hallway():
    """Walls of a hallway as long, with doors elsewhere and on other sides."""
    plan = FloorPlan()
    plan.cut_rectangle(0.0, -1.0, 22.0, 1.0)
    for x, side in ((4.0, -1.0), (8.2, 1.0), (12.9, 1.0), (18.1, -1.0)):
        plan.cut_rectangle(x - 0.6, min(side, 1.3 * side), x + 0.6, max(side, 1.3 * side))
        plan.cut_rectangle(x - 2.0, min(1.2 * side, 5.0 * side), x + 2.0, max(1.2 * side, 5.0 * side))
    found = plan.walls()
    return np.concatenate([se2.transform(BUILDING, found[:, k : k + 2]) for k in (0, 2)], axis=1)


def driven_twice(again, walls=None):
    """The map, and its scans, of a small floor and of what was driven along after that, as two more areas.

    :param again: shape (n, 3), poses on the floor.
    :param walls: if that was elsewhere.
    """
    hybrid_map, scans, rng = HybridMap(), {}, np.random.default_rng(2)
    for k, pose in enumerate(keyframes()):
        area = int(pose[0] > 8.0)
        hybrid_map.set_keyframe(k, area, se2.between(AREAS[area], pose))
        scans[k] = seen_at(pose, rng)
    for k, pose in enumerate(again, len(scans)):
        hybrid_map.set_keyframe(k, 2 + int(k > len(keyframes())), se2.between(THIRD, pose))
        at = se2.compose(BUILDING, pose)
        scans[k] = seen_at(pose, rng) if walls is None else scan_at(walls, at, 0.01, rng, 720)
    arc = PoseGaussian(se2.between(AREAS[0], AREAS[1]), np.diag([0.03, 0.03, 0.003]) ** 2)
    hybrid_map.set_arc(0, 1, arc, closure=False)
    hybrid_map.set_arc(1, 2, PoseGaussian(ARCS, VAGUE), closure=False)
    hybrid_map.set_arc(2, 3, PoseGaussian(np.zeros(3), 1e-4 * np.eye(3)), closure=False)
    return hybrid_map, scans


def hallway_poses(turned):
    """Poses along the hallway, from its one end to the other."""
    ahead = np.array([(x, -0.1, 0.0) for x in np.arange(1.0, 21.2, 0.5)])
    return ahead if not turned else np.stack((ahead[::-1, 0], ahead[:, 1], np.full(len(ahead), math.pi)), axis=1)


def map_loops(scans):
    return AreaLoopDetector(CONFIGURATION, AreaViewCache(LocalMapping(CONFIGURATION), scans))


@pytest.fixture(scope="module", params=[False, True])
def two_drives(request):
    return driven_twice(hallway_poses(request.param))


def test_a_hallway_that_the_map_holds_twice_is_a_loop_as_it_truly_lies(two_drives):
    hybrid_map, scans = two_drives
    loop = map_loops(scans).newest_loop(hybrid_map)
    assert loop is not None
    assert (loop.area, loop.first_area, loop.other_area in (0, 1)) == (3, 3, True)
    off = se2.log(se2.between(loop.pose.mean, se2.between(THIRD, AREAS[loop.other_area])))
    assert math.hypot(off[0], off[1]) < 0.2
    assert abs(off[2]) < math.radians(2.0)
    assert off @ np.linalg.solve(loop.pose.covariance, off) < 16.3  # chi-square, 99.9 %


def test_another_hallway_is_none():
    hybrid_map, scans = driven_twice(hallway_poses(turned=False), other_hallway())
    assert map_loops(scans).newest_loop(hybrid_map) is None


def test_a_robot_that_was_in_all_areas_of_late_has_no_map_of_before():
    hybrid_map, scans = driven_twice(hallway_poses(turned=False))
    newest = max(scans)
    hybrid_map.set_keyframe(newest, 0, hybrid_map.keyframes(0)[0])
    hybrid_map.set_keyframe(newest, 2, hybrid_map.keyframes(2)[min(hybrid_map.keyframes(2))])
    assert map_loops(scans).newest_loop(hybrid_map) is None


def test_the_way_leads_from_node_to_node_as_the_robot_went(two_drives):
    hybrid_map, scans = two_drives
    part = hybrid_map.subgraph([3])
    chart = build_chart(
        part, AreaViewCache(LocalMapping(CONFIGURATION), scans).views_of_map(part), CONFIGURATION.features
    )
    (way,) = traversed_paths(part, chart)
    assert len(way) == 4
    places = np.array([chart.nodes[k].pose for k in (way[0].start, *(edge.end for edge in way))])
    there = se2.compose(THIRD, places)[:, 0]
    first = np.arange(5) if there[0] < there[-1] else np.arange(5)[::-1]
    np.testing.assert_allclose(there[first], (1.0, 5.0, 10.0, 16.0, 21.0), atol=0.2)
    newest = hybrid_map.keyframes(3)[max(hybrid_map.keyframes(3))]
    assert there[-1] == pytest.approx(se2.compose(THIRD, newest)[0], abs=1.0)


def test_a_proposal_is_used_and_reported_once_and_stays_no_arc(two_drives):
    hybrid_map, scans = two_drives
    proposals = LoopProposer(CONFIGURATION, AreaViewCache(LocalMapping(CONFIGURATION), scans))
    supposed = proposals.with_proposed_arc(hybrid_map, 3)
    (notice,) = proposals.notices()
    (other,) = set(supposed.neighbors(3)) - {2}
    assert f"from area 3 to area 3 are those up to area {other}" in notice.text
    assert hybrid_map.neighbors(3) == [2]
    proposals.with_proposed_arc(hybrid_map, 3)
    assert not proposals.notices()


def test_where_an_arc_joins_the_two_nothing_is_proposed(two_drives):
    hybrid_map, scans = two_drives
    closed = hybrid_map.branch()
    for known in (0, 1):
        closed.set_arc(3, known, PoseGaussian(se2.between(THIRD, AREAS[known]), 0.01 * np.eye(3)), closure=True)
    proposals = LoopProposer(CONFIGURATION, AreaViewCache(LocalMapping(CONFIGURATION), scans))
    assert proposals.with_proposed_arc(closed, 3) is closed
    assert not proposals.notices()
