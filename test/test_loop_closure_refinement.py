"""Joint refinement of the areas that a closure joined."""

import numpy as np
import pytest
import worlds

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import Edges
from hmt_slam_ros.loop_closure.closure_refinement import ClosureRefinement
from hmt_slam_ros.loop_closure.joint_refinement import ScanPairs, relative_beliefs
from hmt_slam_ros.registration.scan_to_scan import extract_surfaces

ROOMS = worlds.two_rooms()
# The first room twice, and between the visits the second one, which lies beside the closure.
VISITS = {
    0: worlds.drive((1.0, 2.0), (4.5, 3.0), (4.0, 5.0)),
    1: worlds.drive((6.5, 3.0), (9.0, 3.0), (9.0, 4.5)),
    2: worlds.drive((4.5, 2.0), (2.0, 2.5), (2.0, 4.0)),
}
ERROR = np.array([0.12, -0.08, 0.03])
CLOSURE = np.diag([0.2**2, 0.2**2, 0.05**2])
TRAVELLED = np.diag([0.03**2, 0.03**2, 0.01**2])


def make_areas(bend=0.0, seed=0, closure=CLOSURE):
    """Areas in frames at their first keyframes; the closing arc is off by ERROR, area 2 is bent, rad a keyframe."""
    hybrid_map, scans, truth, k = HybridMap(), {}, {}, 0
    for area, poses in VISITS.items():
        for i, pose in enumerate(poses):
            turned = se2.compose([0.0, 0.0, bend * i * (area == 2)], se2.between(poses[0], pose))
            hybrid_map.set_keyframe(k, area, turned)
            scans[k], truth[k] = worlds.scan_in(ROOMS, pose, noise=0.01, seed=100 * seed + k), pose
            k += 1
    first = {area: poses[0] for area, poses in VISITS.items()}
    hybrid_map.set_arc(0, 1, PoseGaussian(se2.between(first[0], first[1]), TRAVELLED), closure=False)
    off = se2.compose(se2.between(first[0], first[2]), se2.exp(ERROR))
    hybrid_map.set_arc(0, 2, PoseGaussian(off, closure), closure=True)
    return hybrid_map, scans, truth


def refine(hybrid_map, scans, closed=(0, 2), **changes):
    return ClosureRefinement(with_changes(Configuration(), changes)).refine(hybrid_map, scans, set(closed))


@pytest.mark.parametrize("bend", [0.0, 0.004])
def test_the_closing_arc_and_the_keyframes_of_both_areas_come_to_where_their_scans_agree(bend):
    hybrid_map, scans, truth = make_areas(bend)
    found = refine(hybrid_map, scans)
    assert found.keyframes.keys() == {0, 2}
    arc = found.arcs[0, 2].mean
    for k, pose in found.keyframes[2].items():
        error = se2.between(truth[k], se2.compose(VISITS[0][0], se2.compose(arc, pose)))
        assert np.hypot(*error[:2]) < 0.03
        assert np.degrees(abs(error[2])) < 0.5


def test_the_frame_of_an_area_stays_where_its_keyframes_move_least():
    hybrid_map, scans, _ = make_areas(bend=0.004)
    found = refine(hybrid_map, scans)
    for area, keyframes in found.keyframes.items():
        before, after = np.array(list(hybrid_map.keyframes(area).values())), np.array(list(keyframes.values()))
        np.testing.assert_allclose((after - before)[:, :2].mean(axis=0), 0.0, atol=1e-9)
        np.testing.assert_allclose(se2.best_fit(before, after), 0.0, atol=1e-9)


def test_an_area_beside_the_closure_moves_as_a_whole_if_at_all():
    hybrid_map, scans, _ = make_areas()
    found = refine(hybrid_map, scans)
    assert 1 not in found.keyframes
    moved = se2.between(hybrid_map.arc(0, 1).mean, found.arcs[0, 1].mean)
    assert np.hypot(*moved[:2]) < 0.03


def test_an_area_beside_the_closure_turns_as_its_only_keyframe_that_sees_walls_does():
    hybrid_map, nothing = HybridMap(), np.array([[500.0, 0.0, 500.0, 1.0]])
    home, k, scans = VISITS[0][-1], 0, {}
    visits = {0: VISITS[0], 1: [home, se2.compose(home, [0.0, 0.0, 0.5])], 2: VISITS[2]}
    for area, poses in visits.items():
        for pose in poses:
            hybrid_map.set_keyframe(k, area, se2.between(poses[0], pose))
            scans[k] = worlds.scan_in(nothing if pose is home and area == 1 else ROOMS, pose, noise=0.01, seed=k)
            k += 1
    beside, joined = (se2.between(visits[0][0], visits[area][0]) for area in (1, 2))
    hybrid_map.set_arc(0, 1, PoseGaussian(se2.compose(beside, [0.1, -0.05, 0.08]), CLOSURE), closure=False)
    hybrid_map.set_arc(0, 2, PoseGaussian(joined, CLOSURE), closure=True)
    error = se2.between(beside, refine(hybrid_map, scans).arcs[0, 1].mean)
    assert np.hypot(*error[:2]) < 0.03
    assert np.degrees(abs(error[2])) < 0.5


def test_the_closing_arc_is_far_more_certain_and_not_too_much_so_and_one_to_an_area_beside_as_before():
    squared = []
    for seed in range(8):
        hybrid_map, scans, truth = make_areas(seed=seed)
        found = refine(hybrid_map, scans)
        np.testing.assert_allclose(found.arcs[0, 1].covariance, TRAVELLED, atol=1e-12)
        arc, frames = found.arcs[0, 2], {}
        for area, first in ((0, 0), (2, min(found.keyframes[2]))):
            frames[area] = se2.compose(truth[first], se2.inverse(found.keyframes[area][first]))
        error = se2.log(se2.between(arc.mean, se2.between(frames[0], frames[2])))
        squared.append(error @ np.linalg.solve(arc.covariance, error))
        assert np.sqrt(np.trace(arc.covariance[:2, :2])) < 0.1
    # Rooms are clearer than buildings with drift, for which the covariance is made.
    assert np.mean(squared) < 3.0


@pytest.mark.parametrize(("before", "is_kept"), [(0.3, False), (0.5, True), (2.0, True)])
def test_a_position_that_was_known_no_better_than_the_refinement_captures_stays_as_uncertain(before, is_kept):
    """It may have ended at another structure that looks alike."""
    hybrid_map, scans, _ = make_areas(closure=np.diag([before**2, 0.2**2, 0.05**2]))
    deviations = np.sqrt(np.diag(refine(hybrid_map, scans).arcs[0, 2].covariance))
    assert deviations[0] == pytest.approx(before, rel=0.05) if is_kept else deviations[0] < 0.1
    assert deviations[1] < 0.1


def test_along_a_bare_corridor_the_closing_arc_stays_uncertain():
    hybrid_map, scans, walls = HybridMap(), {}, np.array([[-200.0, -1.0, 200.0, -1.0], [-200.0, 1.0, 200.0, 1.0]])
    for area, start in ((0, 0.0), (1, 1.3)):
        for i in range(6):
            k = 6 * area + i
            hybrid_map.set_keyframe(k, area, np.array([0.5 * i, 0.0, 0.0]))
            scans[k] = worlds.scan_in(walls, np.array([start + 0.5 * i, 0.0, 0.0]), noise=0.01, seed=k)
    hybrid_map.set_arc(0, 1, PoseGaussian(np.array([1.3, 0.0, 0.0]), CLOSURE), closure=True)
    deviations = np.sqrt(np.diag(refine(hybrid_map, scans, (0, 1)).arcs[0, 1].covariance))
    assert deviations[0] == pytest.approx(0.2, rel=0.1)
    assert deviations[1] < 0.03


def test_a_direction_that_a_pair_informs_of_next_to_nothing_keeps_the_uncertainty_of_the_motion():
    """Along a corridor, noise of the normals leaves a pair of scans with hardly any information, which is dropped."""
    walls, poses = np.array([[-200.0, -1.0, 200.0, -1.0], [-200.0, 1.0, 200.0, 1.0]]), np.zeros((2, 3))
    poses[1, 0] = 0.5
    options, motion = Configuration().refinement, np.diag([5.0, 5.0, 1.0]) ** 2
    scans = [worlds.scan_in(walls, pose, noise=0.01, seed=k, beams=181) for k, pose in enumerate(poses)]
    rows = np.array([[0, 1]])
    (belief,) = relative_beliefs(
        extract_surfaces(scans, 30.0, options.max_points),
        poses,
        ScanPairs(rows, np.full(1, options.min_share)),
        Edges(*rows.T, poses[1:], motion[None]),
        options,
        rows,
    )
    deviations = np.sqrt(np.diag(belief.covariance))
    assert deviations[0] == pytest.approx(5.0, rel=0.02)
    assert deviations[1] < 0.1


def test_where_scans_show_nothing_a_closing_arc_between_two_origins_is_as_certain_as_before():
    """The keyframes at the origins carry it, although others stand there turned about."""
    hybrid_map, nothing = HybridMap(), np.array([[500.0, 0.0, 500.0, 1.0]])
    for k in range(4):
        hybrid_map.set_keyframe(k, k // 2, np.array([0.0, 0.0, 3.0 * (k % 2)]))
    hybrid_map.set_arc(0, 1, PoseGaussian(np.array([1.3, 0.2, 0.1]), CLOSURE), closure=True)
    found = refine(hybrid_map, {k: worlds.scan_in(nothing, np.zeros(3)) for k in range(4)}, (0, 1)).arcs[0, 1]
    np.testing.assert_allclose(found.mean, [1.3, 0.2, 0.1], atol=1e-9)
    np.testing.assert_allclose(found.covariance, CLOSURE, atol=1e-6)


def test_closures_far_from_each_other_are_refined_each_for_itself():
    hybrid_map, scans, _ = make_areas()
    far, first = HybridMap(), len(scans)
    for area in hybrid_map.area_ids():
        for k, pose in hybrid_map.keyframes(area).items():
            far.set_keyframe(k, area, pose)
            far.set_keyframe(first + k, 10 + area, pose)
            scans[first + k] = scans[k]
    for a, b, arc in hybrid_map.all_arcs():
        far.set_arc(a, b, arc.pose, closure=arc.closure)
        far.set_arc(10 + a, 10 + b, arc.pose, closure=arc.closure)
    # The way from one to the other leads through areas that lie beside neither.
    far.set_keyframe(2 * first, 5, np.zeros(3))
    far.set_keyframe(2 * first + 1, 6, np.zeros(3))
    for a, b in ((1, 5), (5, 6), (6, 11)):
        far.set_arc(a, b, PoseGaussian(np.array([30.0, 0.0, 0.0]), TRAVELLED), closure=False)
    alone, both = refine(hybrid_map, scans), refine(far, scans, (0, 2, 10, 12))
    assert both.keyframes.keys() == {0, 2, 10, 12}
    for pair in ((0, 2), (10, 12)):
        np.testing.assert_allclose(both.arcs[pair].mean, alone.arcs[0, 2].mean, atol=1e-6)
        np.testing.assert_allclose(both.arcs[pair].covariance, alone.arcs[0, 2].covariance, atol=1e-9)


def test_without_iterations_nothing_changes():
    hybrid_map, scans, _ = make_areas()
    found = refine(hybrid_map, scans, **{"refinement.iterations": 0})
    assert found.keyframes == found.arcs == {}
