"""Equations of the joint refinement: registrations as edges, the information that counts, and distant pairs."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import box, drive, scan_in, two_rooms

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import Edges, relative_covariances
from hmt_slam_ros.loop_closure import joint_refinement
from hmt_slam_ros.loop_closure.joint_refinement import (
    PairLimits,
    ScanPairs,
    add_distant_pairs,
    agree_better,
    nearest_keyframes,
    pair_limits,
    relative_beliefs,
    scan_pairs,
)
from hmt_slam_ros.registration.scan_to_scan import extract_surfaces, normal_equations, weighting_from_options

OPTIONS = replace(Configuration().refinement, certainty=0.4)
POSES = np.concatenate((drive((1.0, 2.0), (4.0, 3.0))[:3], drive((6.5, 3.0), (9.0, 3.5))[:2]))
PAIRS = ScanPairs(np.array([[0, 1], [0, 2], [1, 2], [3, 4], [0, 4]]), np.array([0.1, 0.1, 0.1, 0.1, 0.99]))
MOTION = Edges(
    np.arange(4),
    np.arange(1, 5),
    se2.between(POSES[:-1], POSES[1:]),
    np.tile(np.diag([0.1, 0.08, 0.03]) ** 2, (4, 1, 1)),
)


@pytest.fixture(scope="module")
def surfaces():
    scans = [scan_in(two_rooms(), pose, beams=121, noise=0.01, seed=k) for k, pose in enumerate(POSES)]
    return extract_surfaces(scans, 30.0, 60)


def known_part(information):
    """The information (3, 3) along directions with 0.4 % of the largest; a turn counts as it moves a point 3 m away."""
    lever = np.diag([1.0, 1.0, 3.0])
    values, vectors = np.linalg.eigh(np.linalg.inv(lever) @ information @ np.linalg.inv(lever))
    return (
        lever
        @ sum(v * np.outer(u, u) for v, u in zip(values, vectors.T, strict=True) if v > 0.004 * values[-1])
        @ lever
    )


def plain_registrations(surfaces, poses, gate, stride):
    """{pair: the step of Gauss-Newton where walls tell, and the information}, of those that overlap."""
    found = {}
    for (i, j), least in zip(PAIRS.rows, PAIRS.min_share, strict=True):
        relative = se2.between(poses[j], poses[i])
        rows = np.array([i]), np.array([j])
        information, gradient, share = normal_equations(
            surfaces, rows[0], surfaces, rows[1], relative[None], gate, weighting_from_options(OPTIONS), stride
        )
        if share[0] >= least:
            total = known_part(information[0]) + 1e-6 * np.eye(3)
            found[i, j] = se2.compose(relative, se2.exp(-np.linalg.inv(total) @ gradient[0])), total
    return found


@pytest.mark.parametrize("stride", [1, 2])
def test_pairs_that_overlap_become_edges_from_the_second_to_the_first(surfaces, stride):
    poses = se2.compose(POSES, se2.exp(np.random.default_rng(2).normal(0.0, 0.02, (5, 3))))
    edges = joint_refinement._register_pairs(surfaces, poses, PAIRS, 0.3, stride, OPTIONS)
    expected = plain_registrations(surfaces, poses, 0.3, stride)
    assert list(zip(edges.targets, edges.sources, strict=True)) == list(expected)
    assert (0, 4) not in expected
    assert len(expected) >= 3
    for pose, covariance, (step, information) in zip(edges.poses, edges.covariances, expected.values(), strict=True):
        np.testing.assert_allclose(pose, step, atol=1e-9)
        np.testing.assert_allclose(covariance @ information, np.eye(3), atol=1e-8)


def counted_pairs(surfaces, poses, limits):
    """The pairs whose registration counts."""
    edges = joint_refinement._register_pairs(surfaces, poses, PAIRS, 0.3, 1, OPTIONS, limits)
    return set(zip(edges.targets.tolist(), edges.sources.tolist(), strict=True))


def test_a_registration_counts_only_within_what_the_arcs_allow(surfaces):
    poses = POSES.copy()
    poses[2] = se2.compose(POSES[2], [0.2, 0.0, 0.0])
    relative = se2.between(poses[PAIRS.rows[:, 1]], poses[PAIRS.rows[:, 0]])
    information = np.zeros((5, 3, 3))
    assert {(0, 2), (1, 2)} <= counted_pairs(surfaces, poses, PairLimits(relative, information))
    # The scans move both pairs by 0.2 m, one may move by 0.33 m and the other by 0.16 m at most.
    information[1], information[2] = np.eye(3) / 0.1**2 * 1.5, np.eye(3) / 0.04**2
    kept = counted_pairs(surfaces, poses, PairLimits(relative, information))
    assert (0, 2) in kept
    assert (1, 2) not in kept


def test_a_registration_counts_only_where_the_scans_agree_better_than_before(surfaces):
    """One pair was right before, and would be registered from a pose too far away to come back to it."""
    poses = POSES.copy()
    poses[2] = se2.compose(POSES[2], [0.25, 0.1, 0.1])
    before, now = (se2.between(at[PAIRS.rows[:, 1]], at[PAIRS.rows[:, 0]]) for at in (POSES, poses))
    free = np.zeros((5, 3, 3))
    assert (1, 2) in counted_pairs(surfaces, poses, PairLimits(now, free))
    assert (1, 2) not in counted_pairs(surfaces, poses, PairLimits(before, free))


def test_scans_agree_better_the_nearer_their_walls_are_and_not_at_all_when_torn_apart(surfaces):
    pair = ScanPairs(PAIRS.rows[:1], PAIRS.min_share[:1])
    nearer_first = [POSES.copy() for _ in range(4)]
    for poses, offset in zip(nearer_first, (0.0, 0.03, 0.2, 30.0), strict=True):
        poses[1] = se2.compose(POSES[1], [offset, 0.0, 0.0])
    for i, before in enumerate(nearer_first):
        for j, after in enumerate(nearer_first[:3]):
            # A pair that did not overlap before does not count.
            assert agree_better(surfaces, before, after, pair, OPTIONS) == (j < i < 3)
        assert not agree_better(surfaces, before, nearer_first[3], pair, OPTIONS)


def test_scans_that_see_less_of_the_same_walls_may_agree_better():
    """In a bare corridor they are 2 m apart, and were taken for one place, to 3 cm."""
    corridor = np.array([[-30.0, -1.0, 30.0, -1.0], [-30.0, 1.0, 30.0, 1.0]])
    truth = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    scans = [scan_in(corridor, pose, beams=181, noise=0.005, seed=k) for k, pose in enumerate(truth)]
    before = np.array([[0.0, 0.0, 0.0], [0.0, 0.03, 0.0]])
    pair = ScanPairs(np.array([[0, 1]]), np.array([0.1]))
    assert agree_better(extract_surfaces(scans, 8.0, 181), before, truth, pair, OPTIONS)


def test_pairs_of_two_areas_are_limited_by_the_arcs_between_them():
    covariances = np.diag([0.01, 0.02, 0.003]), np.diag([0.04, 0.01, 0.001])
    hybrid_map, frames = HybridMap(), [np.zeros(3), np.array([4.0, 1.0, 0.3]), np.array([7.0, 1.0, -0.4])]
    areas, area_T_scan = np.array([0, 0, 1, 2, 2]), np.zeros((5, 3))
    for row, area in enumerate(areas.tolist()):
        area_T_scan[row] = se2.between(frames[area], POSES[row])
        hybrid_map.set_keyframe(row, area, area_T_scan[row])
    for a, covariance in enumerate(covariances):
        hybrid_map.set_arc(a, a + 1, PoseGaussian(se2.between(frames[a], frames[a + 1]), covariance), closure=False)
    limits = pair_limits(hybrid_map, POSES, PAIRS, areas, area_T_scan)
    np.testing.assert_allclose(limits.relative, se2.between(POSES[PAIRS.rows[:, 1]], POSES[PAIRS.rows[:, 0]]))
    for (i, j), information in zip(PAIRS.rows.tolist(), limits.information, strict=True):
        if areas[i] == areas[j]:
            assert not information.any()
            continue
        belief = PoseGaussian.from_pose(frames[areas[i]])
        for a in range(areas[i], areas[j]):
            belief = belief.compose(hybrid_map.arc(a, a + 1))
        # Of the second scan in the first one's area, then of the first scan in the second.
        belief = PoseGaussian.from_pose(se2.inverse(POSES[i])).compose(belief)
        pair = belief.compose(PoseGaussian.from_pose(area_T_scan[j])).inverse()
        np.testing.assert_allclose(np.linalg.inv(information), pair.covariance, rtol=1e-9, atol=1e-12)


def test_directions_with_next_to_no_information_are_dropped():
    """A turn counts as it moves a point three meters away; among positions alone, a direction needs more."""
    rng = np.random.default_rng(3)
    scale = np.diag([1.0, 1.0, 3.0])
    cases = ((1.0, 0.031, 0.3, 3), (1.0, 0.029, 0.3, 2), (1.0, 0.031, 300.0, 1), (1.0, 0.5, 0.003, 2))
    for across, along, turn, kept in cases:
        heading = rng.uniform(-np.pi, np.pi)
        turned = se2.transform(np.array([0.0, 0.0, heading]), np.eye(2))
        information = np.zeros((3, 3))
        information[:2, :2] = turned.T @ np.diag([across, along]) @ turned
        information[2, 2] = turn
        (found,), (inverse,) = joint_refinement._known_directions((scale @ information @ scale)[None])
        assert np.linalg.matrix_rank(found, tol=1e-6) == np.linalg.matrix_rank(inverse, tol=1e-6) == kept
        np.testing.assert_allclose(found @ inverse @ found, found, atol=1e-9)
        # What is kept is as it was.
        np.testing.assert_allclose(found, (scale @ information @ scale) @ (inverse @ found), atol=1e-9)


@pytest.mark.parametrize("noise", [0.01, 0.03])
def test_noise_of_bare_walls_is_no_information_along_them(noise):
    """Scans in a corridor whose ends are out of reach; the laser has one beam a degree."""
    rng, corridor = np.random.default_rng(0), box(-60.0, -1.0, 60.0, 1.0)
    poses = np.column_stack((np.linspace(-3.0, 3.0, 40), 0.2 * rng.normal(size=40), 0.1 * rng.normal(size=40)))
    scans = [scan_in(corridor, pose, noise=noise, seed=k) for k, pose in enumerate(poses)]
    own = extract_surfaces(scans, Configuration().local_map.max_range, OPTIONS.max_points)
    first, second = np.array([(i, j) for i in range(40) for j in range(i + 1, 40) if poses[j, 0] - poses[i, 0] < 3.0]).T
    relative = se2.between(poses[second], poses[first])
    information = normal_equations(own, first, own, second, relative, 0.4, weighting_from_options(OPTIONS), 1)[0]
    kept = [np.linalg.matrix_rank(each, tol=1e-9) for each in joint_refinement._known_directions(information)[0]]
    assert np.mean(np.array(kept) == 3) < 0.05
    assert np.mean(np.array(kept) == 2) > 0.9


def test_relative_poses_are_as_certain_as_motion_and_a_share_of_what_walls_tell(surfaces):
    between = np.array([[0, 2], [4, 1], [3, 4]])
    found = relative_beliefs(surfaces, POSES, PAIRS, MOTION, OPTIONS, between)
    expected = plain_registrations(surfaces, POSES, OPTIONS.last_gate, 1)
    information = 0.4 * np.array([total for _, total in expected.values()])
    edges = Edges(
        np.concatenate((MOTION.sources, [j for _, j in expected])),
        np.concatenate((MOTION.targets, [i for i, _ in expected])),
        np.concatenate((MOTION.poses, [pose for pose, _ in expected.values()])),
        np.concatenate((MOTION.covariances, np.linalg.inv(information))),
    )
    for belief, covariance, (i, j) in zip(found, relative_covariances(POSES, edges, between), between, strict=True):
        np.testing.assert_allclose(belief.mean, se2.between(POSES[i], POSES[j]), atol=1e-12)
        np.testing.assert_allclose(belief.covariance, covariance, rtol=1e-6, atol=1e-12)


def test_the_nearest_keyframes_are_those_within_reach_in_linked_areas():
    rng = np.random.default_rng(6)
    poses = np.column_stack((rng.uniform(-6.0, 6.0, (60, 2)), rng.uniform(-np.pi, np.pi, 60)))
    areas, linked = 4 + np.arange(60) % 3, {4: {4, 5}, 5: {4, 5, 6}, 6: {5, 6}}
    found = nearest_keyframes(poses, areas, poses[:20], areas[:20], linked, 4.0, 6)
    for pose, area, rows in zip(poses, areas, found, strict=False):
        distance, turn = np.hypot(*(poses[:, :2] - pose[:2]).T), np.abs(se2.wrap(poses[:, 2] - pose[2]))
        near = [k for k in range(60) if distance[k] <= 4.0 and areas[k] in linked[area]]
        assert rows.tolist() == sorted(near, key=lambda k: distance[k] + turn[k])[:6]
    assert min(map(len, found)) < 6 == max(map(len, found))


def test_pairs_are_each_once_and_in_order():
    found = scan_pairs([np.array([0, 3, 1]), np.array([2]), np.array([], np.int64), np.array([3, 0, 2])], 0.2)
    assert found.rows.tolist() == [[0, 1], [0, 3], [1, 2], [2, 3]]
    assert found.min_share.tolist() == [0.2] * 4
    assert scan_pairs([np.array([0])], 0.2).rows.shape == (0, 2)


def test_a_keyframe_far_from_other_passes_is_paired_with_the_five_of_these_that_share_most_walls(surfaces, monkeypatch):
    """Keyframes 0 to 29 along x, 30 to 59 beside them; keyframe 20 of the second pass is near one of the first."""
    count, options = 60, replace(OPTIONS, reach=2.0)
    along = np.arange(count) % 30
    poses = np.column_stack((0.7 * along, 3.0 * (np.arange(count) >= 30), np.zeros(count)))
    areas = np.where(np.arange(count) == 33, 1, 0)
    shares = np.random.default_rng(4).uniform(0.0, 0.3, (count, count))
    requested = []

    def given_shares(first, rows, second, others, relative, gate, _weighting, stride):
        assert (first, second, gate, stride) == (surfaces, surfaces, options.first_gate, 4)
        np.testing.assert_allclose(relative, se2.between(poses[others], poses[rows]))
        requested.append(int(rows[0]) if len(rows) else -1)
        return None, None, shares[rows, others]

    monkeypatch.setattr(joint_refinement, "normal_equations", given_shares)
    near = ScanPairs(np.array([[3, 4], [4, 5], [7, 40], [9, 29], [10, 31]]), np.full(5, 0.2))
    found = add_distant_pairs(near, surfaces, poses, areas, {0: {0}, 1: {1}}, options)
    expected = set()
    for i in set(range(count)) - {7, 40, 10, 31}:
        others = [
            k
            for k in range(count)
            if abs(k - i) > 20 and np.hypot(*(poses[k] - poses[i])[:2]) <= 10.0 and areas[k] == areas[i]
        ]
        most = sorted(others, key=lambda k: -shares[i, k])[:5]
        expected |= {(min(i, k), max(i, k)) for k in most if shares[i, k] >= 0.03}
    assert found.rows[:5].tolist() == near.rows.tolist()
    assert [tuple(row) for row in found.rows[5:].tolist()] == sorted(expected)
    assert found.min_share.tolist() == [0.2] * 5 + [0.03] * len(expected)
    assert len(expected) > 100
