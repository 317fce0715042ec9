"""Registration of scans with each other: equations, joint solution, placement of the scans between keyframes."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import drive, scan_in, two_rooms

from hmt_slam_ros.configuration.topology import RefinementParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import Edges
from hmt_slam_ros.loop_closure.joint_refinement import (
    add_distant_pairs,
    certain_areas,
    linked_areas,
    nearest_keyframes,
    refine_jointly,
    scan_pairs,
)
from hmt_slam_ros.registration.scan_to_scan import (
    extract_surfaces,
    normal_equations,
    weighting_from_options,
)
from hmt_slam_ros.results.final_map import register_scans

OPTIONS = RefinementParameters()
CORRIDOR = np.array([[-200.0, -1.0, 200.0, -1.0], [-200.0, 1.0, 200.0, 1.0]])
# Through the door and back, every half meter.
TRUTH = np.concatenate((drive((2.0, 2.0), (5.0, 3.0), (9.0, 3.0)), drive((9.0, 3.2), (5.0, 3.2), (2.0, 2.5))))


def scans_at(poses: np.ndarray, walls: np.ndarray, noise: float = 0.01, **laser: object) -> list:
    return [scan_in(walls, pose, noise=noise, seed=k, **laser) for k, pose in enumerate(poses)]


def surfaces(scans: list):
    return extract_surfaces(scans, 30.0, OPTIONS.max_points)


def equations(
    walls: np.ndarray, truth: np.ndarray, relative: np.ndarray, noise: float = 0.0, gate: float = 0.3, every: int = 1
):
    seen = surfaces(scans_at(truth, walls, noise))
    one, other = np.array([0]), np.array([1])
    information, gradient, share = normal_equations(
        seen, one, seen, other, relative[None], gate, weighting_from_options(OPTIONS), every
    )
    return information[0], gradient[0], share[0]


def odometry(poses: np.ndarray, sigma: float, angle: float, seed: int) -> Edges:
    """Noisy increments between successive poses."""
    count = len(poses) - 1
    deviations = np.array([sigma, sigma, angle])
    noise = deviations * np.random.default_rng(seed).standard_normal((count, 3))
    increments = se2.compose(se2.between(poses[:-1], poses[1:]), se2.exp(noise))
    covariance = np.broadcast_to(np.diag(deviations**2), (count, 3, 3))
    return Edges(np.arange(count), np.arange(1, count + 1), increments, covariance.copy())


def errors(found: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Largest error of place, m, and of heading, deg, in the frame of the first pose."""
    off = se2.between(se2.between(truth[0], truth), se2.between(found[0], found))
    return np.hypot(off[:, 0], off[:, 1]).max(), np.degrees(np.abs(off[:, 2])).max()


def test_normals_stand_upright_on_the_walls_and_point_to_the_laser() -> None:
    pose = np.array([3.0, 2.0, 0.3])
    seen = surfaces([scan_in(two_rooms(), pose)])
    points, normals = se2.transform(pose, seen.points), se2.transform([0.0, 0.0, pose[2]], seen.normals)
    assert seen.is_flat.mean() > 0.8
    assert np.all(np.sum((points - pose[:2]) * normals, axis=1)[seen.is_flat] < 0.0)
    south = seen.is_flat & (points[:, 1] < 1e-3) & (np.abs(points[:, 0] - 3.0) < 2.0)
    assert south.sum() > 10
    np.testing.assert_allclose(normals[south], np.tile([0.0, 1.0], (south.sum(), 1)), atol=1e-3)


def test_at_the_true_pose_nothing_pulls() -> None:
    truth = np.array([[2.0, 2.0, 0.2], [2.4, 2.3, 0.5]])
    information, gradient, share = equations(two_rooms(), truth, se2.between(truth[1], truth[0]))
    assert share > 0.8
    assert np.abs(np.linalg.solve(information, gradient)).max() < 2e-3


@pytest.mark.parametrize("off", [(0.05, 0.0, 0.0), (0.0, -0.05, 0.0), (0.0, 0.0, 0.02), (0.04, 0.03, -0.02)])
def test_one_step_leads_to_the_true_pose(off: tuple[float, float, float]) -> None:
    truth = np.array([[2.0, 2.0, 0.2], [2.4, 2.3, 0.5]])
    start = se2.compose(se2.between(truth[1], truth[0]), se2.exp(off))
    information, gradient, _ = equations(two_rooms(), truth, start)
    step = -np.linalg.solve(information, gradient)
    np.testing.assert_allclose(step, -np.array(off), atol=0.2 * np.abs(off).max())


def test_half_of_the_points_tell_as_much_as_all() -> None:
    truth = np.array([[2.0, 2.0, 0.2], [2.4, 2.3, 0.5]])
    start = se2.compose(se2.between(truth[1], truth[0]), se2.exp((0.03, 0.02, 0.01)))
    all_of_them, half = (equations(two_rooms(), truth, start, every=every) for every in (1, 2))
    steps = [-np.linalg.solve(information, gradient) for information, gradient, _ in (all_of_them, half)]
    np.testing.assert_allclose(steps[1], steps[0], atol=0.003)
    assert not np.array_equal(all_of_them[0], half[0])
    np.testing.assert_allclose(half[0], all_of_them[0], atol=0.05 * np.abs(all_of_them[0]).max())
    assert half[2] == pytest.approx(all_of_them[2], abs=0.03)


def test_a_bare_corridor_has_no_information_of_the_direction_along_it() -> None:
    truth = np.array([[0.0, 0.1, 0.0], [0.5, -0.1, 0.05]])
    information, _, share = equations(CORRIDOR, truth, se2.between(truth[1], truth[0]), noise=0.01)
    assert share > 0.5
    along = np.linalg.eigvalsh(information)[0]
    assert along < 1e-2 * np.sort(np.diag(information))[1]


def test_noise_does_not_shorten_a_bare_corridor() -> None:
    """A pair informs hardly along the corridor; hundreds with a common error would still move keyframes."""
    ahead, pulls, informations = np.array([3.0, 0.1, 0.0]), [], []
    for seed in range(150):
        scans = [
            scan_in(CORRIDOR, pose, noise=0.02, seed=2 * seed + k, beams=361)
            for k, pose in enumerate((np.array([0.0, 0.1, 0.0]), ahead))
        ]
        near = [replace(s, ranges=np.where(s.ranges < 10.0, s.ranges, s.range_max)) for s in scans]
        seen, back = surfaces(near), np.array([[-3.0, 0.0, 0.0]])
        information, gradient, _ = normal_equations(
            seen, np.array([0]), seen, np.array([1]), back, 0.4, weighting_from_options(OPTIONS), 1
        )
        pulls.append(-gradient[0, 0])
        informations.append(information[0, 0, 0])
    # By normals of total least squares they would move by 0.025 m, with an information of 33.
    assert abs(np.sum(pulls) / np.sum(informations)) < 0.015
    assert np.mean(informations) < 15.0


def test_the_two_sides_of_a_thin_wall_are_not_the_same_wall() -> None:
    walls = np.array([[-5.0, 0.0, 5.0, 0.0]])
    truth = np.array([[0.0, -2.0, np.pi / 2], [0.0, 2.0, -np.pi / 2]])
    _, _, share = equations(walls, truth, se2.between(truth[1], truth[0]))
    assert share == 0.0


def test_scans_of_other_resolution_and_mounting_register_with_each_other() -> None:
    truth = np.array([[2.0, 2.0, 0.2], [2.4, 2.3, 0.5]])
    one = scan_in(two_rooms(), truth[0], beams=721, laser_pose=(0.2, 0.0, 0.1))
    other = scan_in(two_rooms(), truth[1], beams=181, laser_pose=(-0.1, 0.05, -0.4))
    seen = surfaces([one, other])
    start = se2.compose(se2.between(truth[1], truth[0]), se2.exp([0.03, -0.03, 0.01]))
    pair = np.array([0]), seen, np.array([1])
    information, gradient, share = normal_equations(seen, *pair, start[None], 0.3, weighting_from_options(OPTIONS), 1)
    assert share[0] > 0.2
    np.testing.assert_allclose(-np.linalg.solve(information[0], gradient[0]), [-0.03, 0.03, -0.01], atol=0.008)


def test_joint_refinement_takes_the_drift_of_odometry_away() -> None:
    motion = odometry(TRUTH, 0.02, 0.01, seed=3)
    drifted = [TRUTH[0]]
    for increment in motion.poses:
        drifted.append(se2.compose(drifted[-1], increment))
    start = np.array(drifted)
    everything = np.zeros(len(TRUTH), dtype=np.int64)
    around = nearest_keyframes(start, everything, start, everything, {0: frozenset({0})}, OPTIONS.reach, 16)
    pairs = scan_pairs(around, OPTIONS.min_share)
    refined = refine_jointly(surfaces(scans_at(TRUTH, two_rooms())), start, pairs, motion, OPTIONS)
    before, after = errors(start, TRUTH), errors(refined, TRUTH)
    # 0.1 degrees of noise in the first scan alone are 15 mm at the far end.
    assert before[0] > 0.15
    assert after[0] < 0.03
    assert after[1] < 0.3
    np.testing.assert_array_equal(refined[0], start[0])


def test_a_scan_is_placed_among_keyframes_that_stay() -> None:
    between = np.array([[2.3, 2.15, 0.3], [7.2, 3.05, 0.1], [4.0, 3.05, np.pi]])
    off = np.array([[0.05, 0.03, 0.02], [-0.06, 0.02, -0.02], [0.0, -0.06, 0.03]])
    start = se2.compose(between, se2.exp(off))
    rows = np.zeros(len(TRUTH), dtype=np.int64)
    around = nearest_keyframes(TRUTH, rows, start, np.zeros(3, np.int64), {0: frozenset({0})}, OPTIONS.reach, 4)
    placed = register_scans(
        surfaces(scans_at(TRUTH, two_rooms())),
        TRUTH,
        surfaces(scans_at(between, two_rooms())),
        start,
        around,
        OPTIONS,
    )
    error = np.abs(se2.between(between, placed))
    assert error[:, :2].max() < 0.012
    assert np.degrees(error[:, 2]).max() < 0.3


def test_a_scan_that_shows_nothing_stays_where_it_is() -> None:
    start = np.array([[2.0, 2.0, 0.2]])
    blind = scan_in(np.array([[500.0, 0.0, 500.0, 1.0]]), start[0])
    keyframes = surfaces(scans_at(TRUTH, two_rooms()))
    around = [np.array([0, 1], dtype=np.int64)]
    np.testing.assert_allclose(
        register_scans(keyframes, TRUTH, surfaces([blind]), start, around, OPTIONS), start, atol=1e-12
    )


def test_keyframes_in_areas_that_no_arcs_link_are_not_paired() -> None:
    hybrid_map = HybridMap()
    for area in range(5):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    for area in range(4):
        hybrid_map.set_arc(area, area + 1, PoseGaussian(np.zeros(3), np.eye(3)), closure=False)
    linked = linked_areas(hybrid_map)
    assert linked[0] == {0, 1, 2}
    assert linked[2] == {0, 1, 2, 3, 4}
    poses, areas = np.zeros((5, 3)), np.arange(5)
    pairs = scan_pairs(nearest_keyframes(poses, areas, poses, areas, linked, 4.0, 10), 0.1)
    assert pairs.rows.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3], [2, 4], [3, 4]]


def test_the_nearest_in_place_and_heading_come_first() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 3.0], [1.0, 0.0, 0.1], [9.0, 0.0, 0.0]])
    areas = np.zeros(4, dtype=np.int64)
    found = nearest_keyframes(poses, areas, poses[:1], areas[:1], {0: frozenset({0})}, 4.0, 2)
    assert found[0].tolist() == [0, 2]


def test_areas_are_certain_of_each_other_where_a_short_way_joins_them() -> None:
    hybrid_map = HybridMap()
    for area in range(4):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    for area, deviation in enumerate((0.1, 0.1, 1.0)):
        arc = PoseGaussian(np.zeros(3), np.diag([deviation**2, 1e-6, 1e-6]))
        hybrid_map.set_arc(area, area + 1, arc, closure=False)
    assert certain_areas(hybrid_map, 0.2) == {0: {0, 1, 2}, 1: {0, 1, 2}, 2: {0, 1, 2}, 3: {3}}


# A hall with pillars; twice along it, the second time along the other side from 10 m on.
HALL = np.array(
    [[-3.0, -1.0, 43.0, -1.0], [43.0, -1.0, 43.0, 8.0], [43.0, 8.0, -3.0, 8.0], [-3.0, 8.0, -3.0, -1.0]]
    + [[x, 3.5 + side, x + 0.6, 3.5 - side] for x in range(0, 42, 6) for side in (-0.4, 0.4)]
)
ONCE = np.column_stack((np.arange(0.0, 30.0), np.zeros(30), np.zeros(30)))
AGAIN = np.column_stack((ONCE[:, 0], np.where(ONCE[:, 0] < 10.0, 0.0, 7.0), np.zeros(30)))
WAYS = np.concatenate((ONCE, AGAIN))


def ways_paired(areas: np.ndarray, certain: dict[int, set[int]], start: np.ndarray = WAYS):
    """The pairs near each other, and those with the other way too."""
    seen = surfaces(scans_at(WAYS, HALL))
    everything = {area: set(areas.tolist()) for area in areas.tolist()}
    near = scan_pairs(nearest_keyframes(start, areas, start, areas, everything, OPTIONS.reach, 9), OPTIONS.min_share)
    return seen, near, add_distant_pairs(near, seen, start, areas, certain, OPTIONS)


def test_where_ways_keep_apart_keyframes_are_paired_with_those_of_the_other_that_see_most_of_the_same() -> None:
    areas = np.zeros(60, dtype=np.int64)
    _, near, pairs = ways_paired(areas, {0: {0}})
    far = pairs.rows[len(near.rows) :]
    np.testing.assert_array_equal(pairs.rows[: len(near.rows)], near.rows)
    assert np.all(far[:, 1] - far[:, 0] > 20)
    assert np.all(pairs.min_share[len(near.rows) :] < OPTIONS.min_share)
    met = near.rows[near.rows[:, 1] - near.rows[:, 0] > 20]
    apart = set(range(60)) - set(met.ravel().tolist())
    assert set(range(15, 30)) | set(range(45, 60)) <= apart <= set(far.ravel().tolist())
    assert all(row in apart or other in apart for row, other in far.tolist())


def test_ways_through_areas_that_are_not_certain_of_each_other_are_not_paired() -> None:
    areas = np.repeat([0, 1], 30)
    _, near, pairs = ways_paired(areas, {0: {0}, 1: {1}})
    np.testing.assert_array_equal(pairs.rows, near.rows)


@pytest.mark.parametrize("seed", range(4))
def test_a_way_that_keeps_apart_is_held_by_the_walls_that_both_ways_see(seed: int) -> None:
    motion = odometry(WAYS, 0.02, 0.004, seed)
    drifted = [WAYS[0]]
    for increment in motion.poses:
        drifted.append(se2.compose(drifted[-1], increment))
    start = np.array(drifted)
    seen, near, pairs = ways_paired(np.zeros(60, dtype=np.int64), {0: {0}}, start)
    alone, joint = (refine_jointly(seen, start, those, motion, OPTIONS) for those in (near, pairs))
    # Seen: 0.041 to 0.106 m alone, 0.019 to 0.047 m jointly.
    assert errors(joint, WAYS)[0] < 0.7 * errors(alone, WAYS)[0]


def test_of_many_keyframes_the_nearest_are_found_also_where_headings_lie_on_both_sides_of_half_a_turn() -> None:
    random = np.random.default_rng(3)
    poses = np.column_stack((random.uniform(-6.0, 6.0, (80, 2)), random.uniform(-np.pi, np.pi, 80)))
    # Equals come in their order.
    poses[40:50] = poses[30:40]
    areas, linked = np.arange(80) % 3, {0: {0, 1}, 1: {0, 1, 2}, 2: {1, 2}}
    found = nearest_keyframes(poses, areas, poses[:30], areas[:30], linked, 4.0, 9)
    for pose, area, rows in zip(poses, areas, found, strict=False):
        distance, turn = np.hypot(*(poses[:, :2] - pose[:2]).T), np.abs(se2.wrap(poses[:, 2] - pose[2]))
        near = [k for k in range(80) if distance[k] <= 4.0 and areas[k] in linked[area]]
        assert rows.tolist() == sorted(near, key=lambda k: distance[k] + turn[k])[:9]
    assert min(map(len, found)) < 9 == max(map(len, found))
