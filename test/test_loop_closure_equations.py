"""Equations of the acceptance of paths: alignment, fused arcs, odds of closures, and edges of a refinement."""

import math
from dataclasses import replace

import numpy as np
import pytest
from plain_map import plain_view
from worlds import box, scan_in

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, write_to_array
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, HybridMap, apply_sigma_floor, fuse_traversals
from hmt_slam_ros.hybrid_map.shortest_path import uninformative_belief
from hmt_slam_ros.loop_closure import closure_refinement
from hmt_slam_ros.loop_closure.acceptance import Acceptance, AreaAlignment, PendingArc, pending_arc
from hmt_slam_ros.loop_closure.closure_history import Closure, MapSnapshot
from hmt_slam_ros.loop_closure.closure_refinement import ClosureRefinement
from hmt_slam_ros.loop_closure.tlca import Tlca, TopologicalPath
from hmt_slam_ros.messages.map_changes import Arc, MovedKeyframe
from hmt_slam_ros.messages.messages import Hypothesis
from hmt_slam_ros.registration.scan_to_map import linearize
from hmt_slam_ros.sensors.relative_motion import path_covariance
from hmt_slam_ros.sensors.scan import extract_surfels, transform_surfels

SPREAD = np.array([[0.04, 0.01, 0.002], [0.01, 0.03, -0.001], [0.002, -0.001, 0.001]])
ROOM = np.concatenate((box(-4.02, -3.03, 5.03, 4.01), box(1.01, 1.02, 2.03, 2.52)))


def belief(pose, spread=SPREAD):
    return PoseGaussian(np.array(pose), np.array(spread))


def pending(source, target, pose, near, **changes):
    arc = PendingArc(30, near, source, target, belief(pose), False, None, (), frozenset({30}))
    return replace(arc, **changes)


def test_an_alignment_balances_the_points_and_the_closure():
    """The closure's information counts once, and that of the points by the exponent of their likelihood."""
    configuration = Configuration()
    alignment = AreaAlignment(configuration)
    view, truth = plain_view(ROOM, (-4.02, -3.03, 5.03, 4.01)), np.array([0.5, -0.4, 0.7])
    scan = scan_in(ROOM, truth, beams=181)
    off = np.array([0.06, -0.05, 0.02])
    points = transform_surfels(se2.compose(off, truth), extract_surfels(scan.points, scan.origins))
    closure, matched = belief([1.5, -0.7, 0.9], 0.02 * SPREAD), belief([1.5, -0.7, 0.9], 0.5 * SPREAD)
    found = alignment._refine_offset(points, closure, matched, view, np.zeros((3, 3)))
    # The closure in the frame of the area in which the points lie.
    information = np.linalg.inv(closure.inverse().covariance)
    sums, gradient, _ = linearize(points, *found, view, alignment._alignment)
    hessian = np.empty((3, 3))
    write_to_array(sums, hessian)
    temper = configuration.matching.temper
    total = temper * np.array(gradient) + information @ found
    assert np.abs(np.linalg.solve(temper * hessian + information, total)).max() < 1e-3
    assert 0.2 < np.linalg.norm(found) / np.linalg.norm(off) < 0.98
    tight = belief([1.5, -0.7, 0.9], 1e-4 * SPREAD)
    np.testing.assert_array_equal(alignment._refine_offset(points, closure, tight, view, np.zeros((3, 3))), np.zeros(3))


@pytest.mark.parametrize("shared", [(), (31,), (30, 31, 32)])
@pytest.mark.parametrize("turned", [False, True])
def test_an_arc_is_fused_with_the_old_one_by_the_keyframes_that_both_have(turned, shared):
    acceptance = Acceptance(Configuration())
    new = pending(2, 5, [3.0, 1.0, 0.4], 2, observing_keyframes=frozenset({30, 31, 32}), closure=True)
    old = belief([3.1, 0.9, 0.42], 2.0 * SPREAD)
    arc = Arc(5, 2, old.inverse(), False) if turned else Arc(2, 5, old, False)
    found = acceptance._fuse_arc(new, arc, frozenset({*shared, 7, 8}))
    expected = fuse_traversals(old, new.pose, len(shared) / 3.0)
    options = Configuration().tlca
    expected = apply_sigma_floor(expected, options.arc_sigma_floor, math.radians(options.arc_angle_floor))
    assert (found.source, found.target, found.closure) == (2, 5, False)
    np.testing.assert_allclose(found.pose.mean, expected.mean, atol=1e-9)
    np.testing.assert_allclose(found.pose.covariance, expected.covariance, atol=1e-9)


@pytest.mark.parametrize("old", [None, Arc(2, 5, uninformative_belief(np.zeros(3)), False)])
def test_an_arc_without_an_old_one_that_informs_is_the_new_one(old):
    new = pending(2, 5, [3.0, 1.0, 0.4], 2, closure=True)
    found = Acceptance(Configuration())._fuse_arc(new, old, frozenset())
    assert found.closure
    np.testing.assert_array_equal(found.pose.mean, new.pose.mean)
    np.testing.assert_array_equal(found.pose.covariance, SPREAD)


def test_a_pending_arc_leads_to_the_area_of_the_robot_and_knows_what_it_replaced():
    hybrid_map = HybridMap()
    hybrid_map.set_arc(5, 2, belief([1.0, 2.0, 0.3]), closure=True)
    arc = Arc(5, 2, belief([3.0, 1.0, 0.4]), False)
    moved = tuple(MovedKeyframe(k, 2, area, np.zeros(3)) for k, area in ((9, 5), (4, 5), (7, 6)))
    found = pending_arc(arc, Hypothesis(0, 0, 1.0, 5, None, moved, (arc,)), 30, 2, hybrid_map)
    assert (found.event, found.near, found.source, found.target, found.pair) == (30, 2, 2, 5, (2, 5))
    assert (found.closure, found.joined_keyframes, found.observing_keyframes) == (False, (4, 9), {4, 9})
    np.testing.assert_allclose(found.pose.mean, se2.inverse([3.0, 1.0, 0.4]))
    assert (found.replaced_arc.source, found.replaced_arc.target, found.replaced_arc.closure) == (2, 5, True)
    np.testing.assert_allclose(found.replaced_arc.pose.mean, se2.inverse([1.0, 2.0, 0.3]))
    alone = pending_arc(arc, Hypothesis(0, 0, 1.0, 2, None, (), (arc,)), 30, 5, HybridMap())
    assert (alone.source, alone.target, alone.replaced_arc) == (5, 2, None)
    assert (alone.joined_keyframes, alone.observing_keyframes) == ((), {30})


@pytest.mark.parametrize("near", [2, 5])
def test_a_pending_arc_becomes_a_closure_from_the_area_of_the_robot(near):
    arc, snapshot = pending(2, 5, [3.0, 1.0, 0.4], near), MapSnapshot({}, {})
    found = arc.to_closure(1.5, snapshot)
    assert (found.closure_id, found.near, found.far, found.log_odds) == ((30, (2, 5)), near, 7 - near, 1.5)
    expected = arc.pose if near == 2 else arc.pose.inverse()
    np.testing.assert_allclose(found.pose.mean, expected.mean)
    np.testing.assert_allclose(found.pose.covariance, expected.covariance)
    assert found.snapshot is snapshot


@pytest.mark.parametrize(
    ("probability", "false"), [(0.3, 0.5), (0.5, 0.5), (0.8, 0.2), (0.93, 0.07), (0.95, 0.05), (0.999, 0.05)]
)
def test_an_accepted_closure_has_the_odds_of_its_path_within_limits(probability, false):
    tlca = Tlca(with_changes(Configuration(), {"tlca.accept_probability": 0.95}))
    new = pending(2, 5, [3.0, 1.0, 0.4], 2, closure=True)
    path = TopologicalPath(pending_arcs=(new, pending(2, 3, [1.0, 0.0, 0.0], 2)))
    (found,) = tlca._accepted_closures(path, probability, MapSnapshot({}, {}))
    assert found.pair == (2, 5)
    assert found.log_odds == pytest.approx(math.log((1.0 - false) / false), abs=1e-9)
    assert tlca._new_closures == {(30, (2, 5))}


def test_arcs_that_were_observed_again_leave_the_snapshots_of_earlier_closures():
    value = ArcValue(belief([1.0, 0.0, 0.0]), closure=False)
    old = MapSnapshot({}, {(0, 1): value, (1, 2): value, (2, 5): value})
    new = MapSnapshot({}, {(7, 8): value})
    closures = (
        Closure((10, (0, 4)), 4, 0, belief([1.0, 2.0, 3.0]), 2.0, old),
        Closure((12, (1, 6)), 6, 1, belief([1.0, 2.0, 3.0]), 3.0, None),
    )
    again = pending(1, 2, [1.0, 0.0, 0.0], 1, replaced_arc=Arc(1, 2, belief([1.0, 0.0, 0.0]), False))
    known = pending(6, 1, [1.0, 0.0, 0.0], 6, closure=True)
    first = pending(2, 5, [1.0, 0.0, 0.0], 2)
    path = TopologicalPath(pending_arcs=(again, known, first), closures=closures)
    tlca = Tlca(Configuration())
    found = tlca._accepted_closures(path, 0.9, new)
    assert [closure.closure_id for closure in found] == [(10, (0, 4)), (12, (1, 6))]
    assert found[0].snapshot.arcs.keys() == {(0, 1), (2, 5)}
    assert found[1].snapshot is new
    assert [closure.log_odds for closure in found] == [2.0, 3.0]
    assert tlca._new_closures == frozenset()


def areas_of_keyframes():
    """Areas 0, 1 and 2, each with keyframes; 1 is closed with 0 by an arc, 2 lies beside 1; 7 is apart."""
    hybrid_map, rng = HybridMap(), np.random.default_rng(3)
    for area, keyframes in {0: (4, 1, 8), 1: (10, 12, 16), 2: (20, 21), 7: (70,)}.items():
        for keyframe in keyframes:
            hybrid_map.set_keyframe(keyframe, area, rng.uniform([-2.0, -1.0, -1.0], [2.0, 1.5, 1.0]))
    hybrid_map.set_arc(0, 1, belief([4.0, 1.0, 0.5]), closure=True)
    hybrid_map.set_arc(1, 2, belief([3.0, -1.0, -0.4]), closure=False)
    return hybrid_map


def test_the_edges_of_a_refinement_are_motion_rigid_areas_and_arcs_between_their_first_keyframes():
    hybrid_map, configuration = areas_of_keyframes(), Configuration()
    edges = list(ClosureRefinement(configuration)._edges(hybrid_map, [0, 1, 2], [0, 1], 10.0))
    assert [(a, b) for a, b, _ in edges] == [(1, 4), (4, 8), (10, 12), (12, 16), (20, 21), (4, 10), (10, 20)]
    for a, b, edge in edges[:5]:
        area = next(area for area in (0, 1, 2) if a in hybrid_map.keyframes(area))
        step = se2.between(hybrid_map.keyframes(area)[a], hybrid_map.keyframes(area)[b])
        np.testing.assert_allclose(edge.mean, step)
        if area == 2:
            expected = np.diag([1e-6, 1e-6, 1e-6])
        elif b - a > 3:
            gate = configuration.refinement.first_gate
            expected = np.diag([gate, gate, math.radians(10.0)]) ** 2
        else:
            expected = path_covariance(np.hypot(*step[:2]), abs(step[2]), configuration.motion)
        np.testing.assert_allclose(edge.covariance, expected)
    for (a, b, edge), (source, target), inflation in zip(edges[5:], ((0, 1), (1, 2)), (10.0, 1.0), strict=True):
        arc = hybrid_map.arc(source, target)
        first, second = hybrid_map.keyframes(source)[a], hybrid_map.keyframes(target)[b]
        np.testing.assert_allclose(edge.mean, se2.compose(se2.compose(se2.inverse(first), arc.mean), second))
        ad = se2.adjoint(se2.inverse(second))
        np.testing.assert_allclose(edge.covariance, inflation * ad @ arc.covariance @ ad.T)
    assert [(a, b) for a, b, _ in ClosureRefinement(configuration)._edges(hybrid_map, [0, 1], [0])][-1] == (4, 10)
    stacked = closure_refinement.stack_edges(edges, sorted({k for a, b, _ in edges for k in (a, b)}))
    assert stacked.sources.tolist() == [0, 1, 3, 4, 6, 1, 3]
    assert stacked.targets.tolist() == [1, 2, 4, 5, 7, 3, 6]
    np.testing.assert_array_equal(stacked.poses[6], edges[6][2].mean)
    np.testing.assert_array_equal(stacked.covariances[6], edges[6][2].covariance)


def test_closed_areas_are_refined_in_groups_with_those_one_arc_away():
    hybrid_map = areas_of_keyframes()
    hybrid_map.set_keyframe(30, 3, np.zeros(3))
    hybrid_map.set_arc(2, 3, belief([1.0, 0.0, 0.0]), closure=False)
    groups = closure_refinement._connected_groups
    assert groups(hybrid_map, {0}) == [[0, 1]]
    assert groups(hybrid_map, {1}) == [[0, 1, 2]]
    assert groups(hybrid_map, {0, 3}) == [[0, 1], [2, 3]]
    assert groups(hybrid_map, {0, 2, 7}) == [[0, 1, 2, 3], [7]]


def test_refined_keyframes_are_in_frames_that_move_as_little_as_they_can():
    hybrid_map, rng = areas_of_keyframes(), np.random.default_rng(5)
    at = {area: rng.uniform(-3.0, 3.0, 3) for area in (0, 1, 2)}
    poses = {
        k: se2.compose(se2.compose(at[area], pose), rng.normal(0.0, 0.05, 3))
        for area in at
        for k, pose in hybrid_map.keyframes(area).items()
    }
    found = closure_refinement._split_by_area(hybrid_map, poses, [0, 1, 2], [1, 0])
    frames = {
        area: se2.best_fit(list(hybrid_map.keyframes(area).values()), [poses[k] for k in hybrid_map.keyframes(area)])
        for area in at
    }
    assert list(found.keyframes) == [0, 1]
    for area, keyframes in found.keyframes.items():
        assert keyframes.keys() == hybrid_map.keyframes(area).keys()
        for k, pose in keyframes.items():
            np.testing.assert_allclose(se2.compose(frames[area], pose), poses[k], atol=1e-9)
    assert found.arcs.keys() == {(0, 1), (1, 2)}
    for (a, b), arc in found.arcs.items():
        np.testing.assert_allclose(arc.mean, se2.between(frames[a], frames[b]))
        np.testing.assert_array_equal(arc.covariance, SPREAD)
    part = closure_refinement._split_by_area(hybrid_map, poses, [1, 2], [2])
    assert (part.keyframes.keys(), part.arcs.keys()) == ({2}, {(1, 2)})
