"""Modes of a pose by themselves: their particles, their leader, resampling, and moments over them."""

import numpy as np
import pytest

from hmt_slam_ros.registration.match_covariance import MatchError
from hmt_slam_ros.sensors.relative_motion import NO_MOTION
from hmt_slam_ros.submap.local_filter import TrackedMode
from hmt_slam_ros.submap.pose_modes import (
    MotionMixture,
    PoseModes,
    allocate_particles,
    draw_systematically,
    share_out,
)

LEAST = 1e-3
SURE = np.log([0.4, 0.1, 0.2, 0.1, 0.15, 0.05])


def modes_of(*members):
    """Modes whose numbers are the members; each is known by its counted evidence, 10 times its number."""
    tracked = (TrackedMode(NO_MOTION, np.zeros((3, 3)), 10.0 * number) for number in range(max(members) + 1))
    return PoseModes(tuple(tracked), np.array(members))


def evidences_of(modes):
    return [mode.counted_evidence for mode in modes.tracked]


def along_x(*positions):
    """Poses on the x axis, shape (n, 3)."""
    return np.array([[x, 0.0, 0.0] for x in positions])


def test_particles_are_shared_out_by_mass_and_each_mode_has_one():
    np.testing.assert_array_equal(allocate_particles(np.array([1.0]), 12), [12])
    np.testing.assert_array_equal(allocate_particles(np.array([0.5, 0.25, 0.25]), 12), [6, 3, 3])
    np.testing.assert_array_equal(allocate_particles(np.array([0.97, 0.01, 0.01, 0.01]), 12), [9, 1, 1, 1])
    np.testing.assert_array_equal(allocate_particles(np.array([0.98, 0.01, 0.01]), 3), [1, 1, 1])


def test_systematic_draws_are_as_many_as_weights_have_it_up_to_one():
    weights = np.random.default_rng(1).dirichlet(np.ones(7))
    for offset in (0.0, 0.3, 0.999):
        counts = np.bincount(draw_systematically(weights, 20, offset), minlength=7)
        assert counts.sum() == 20
        assert (np.abs(counts - 20 * weights) < 1.0).all()


@pytest.mark.parametrize("head", [2, 5, 9])
def test_the_best_mode_of_a_match_keeps_the_head_and_all_others_keep_their_order(head):
    rows = np.array([2, 4, 5, 7, 9])
    parts = share_out(rows, head, np.log([0.1, 0.6, 0.3]))
    assert [len(part) for part in parts] == [1, 3, 1]
    np.testing.assert_array_equal(parts[0], [head])
    np.testing.assert_array_equal(np.concatenate(parts[1:]), rows[rows != head])


def test_a_mode_is_matched_from_the_leader_or_from_its_heaviest_particle():
    modes = modes_of(0, 1, 0, 1, 1)
    log_weights = np.log([0.1, 0.1, 0.3, 0.2, 0.3])
    assert modes.heads(0, log_weights) == [0, 4]
    assert modes.heads(3, log_weights) == [2, 3]
    np.testing.assert_allclose(modes.shares(log_weights - 700.0), [0.4, 0.6])


@pytest.mark.parametrize(
    ("leader", "positions", "members", "evidences"),
    [
        # Apart, the modes are in the order of the leader's and then of their shares.
        (4, (0.0, 5.0, 9.0), [1, 1, 2, 2, 0, 0], [20.0, 0.0, 10.0]),
        # The lightest mode has the leader and remains.
        (4, (0.0, 5.0, 5.001), [1, 1, 0, 0, 0, 0], [20.0, 0.0]),
        # Of two others the heavier one remains.
        (4, (0.0, 0.001, 5.0), [1, 1, 1, 1, 0, 0], [20.0, 0.0]),
        (0, (0.0, 0.001, 0.002), [0, 0, 0, 0, 0, 0], [0.0]),
    ],
)
def test_modes_in_one_basin_become_that_of_the_leader_or_the_heavier_one(leader, positions, members, evidences):
    poses = along_x(*np.repeat(positions, 2))
    # The place of a particle that is no head does not matter.
    poses[[1, 3, 5]] += 100.0
    joined = modes_of(0, 0, 1, 1, 2, 2).join_coinciding(poses, leader, SURE)
    np.testing.assert_array_equal(joined.members, members)
    assert evidences_of(joined) == evidences


def test_a_mode_whose_keyframes_lie_elsewhere_ends_and_its_particles_go_on_from_the_leader():
    modes = modes_of(0, 0, 1, 1, 2, 2)
    keyframe_poses = np.zeros((6, 2, 3))
    keyframe_poses[:, 1] = along_x(1.0, 1.0, 3.0, 3.0, 1.001, 1.0)
    remaining, sources = modes.end_diverged(keyframe_poses, 5, SURE)
    np.testing.assert_array_equal(sources, [0, 1, 5, 5, 4, 5])
    np.testing.assert_array_equal(remaining.members, [0, 0, 1, 1, 1, 1])
    assert evidences_of(remaining) == [0.0, 20.0]
    alike, sources = modes.end_diverged(np.zeros((6, 2, 3)), 5, SURE)
    np.testing.assert_array_equal(sources, np.arange(6))
    np.testing.assert_array_equal(alike.members, modes.members)


@pytest.mark.parametrize(
    ("log_weights", "elected"),
    [
        ((0.0, 0.0, 0.0, 0.0), 1),
        ((2.9, 0.0, 0.0, 0.0), 1),
        ((3.1, 0.0, 0.0, 0.0), 0),
        # Another mode leads by its sum, and there its heaviest particle.
        ((0.0, 0.0, 2.9, 2.8), 1),
        ((0.0, 0.0, 3.1, 3.2), 3),
        # Another mode is heavier, but not clearly: the lead stays in the mode.
        ((3.2, 0.0, 3.3, 0.0), 0),
    ],
)
def test_another_particle_leads_only_where_it_or_its_mode_is_clearly_more_likely(log_weights, elected):
    assert modes_of(0, 0, 1, 1).elect_leader(1, np.array(log_weights)) == elected


def test_a_mode_is_refuted_below_the_least_share_but_never_the_only_one():
    log_weights = np.log([0.5, 0.4991, 0.0005, 0.0004])
    assert modes_of(0, 0, 1, 1).has_refuted(log_weights, LEAST)
    assert not modes_of(0, 0, 0, 1).has_refuted(log_weights, 3e-4)
    assert not modes_of(0, 0, 0, 0).has_refuted(log_weights, 2.0)


def test_resampling_puts_the_leader_first_and_draws_each_mode_by_its_own_weights():
    modes = modes_of(0, 0, 1, 1, 1, 1)
    log_weights = np.log([0.2, 0.2, 0.3, 0.0999, 0.0001, 0.2])
    ancestors, drawn_weights, drawn = modes.resample(4, log_weights, LEAST, 0.5)
    # The leader takes the place of the first draw.
    np.testing.assert_array_equal(ancestors, [4, 2, 3, 5, 0, 1])
    np.testing.assert_array_equal(drawn.members, [0, 0, 0, 0, 1, 1])
    assert evidences_of(drawn) == [10.0, 0.0]
    assert drawn_weights.max() == 0.0
    np.testing.assert_allclose(drawn.shares(drawn_weights), [0.6, 0.4])
    again, *_ = modes.resample(5, log_weights, LEAST, 0.5)
    np.testing.assert_array_equal(again, [5, 2, 2, 3, 0, 1])


def test_resampling_ends_refuted_modes_but_keeps_that_of_the_leader():
    modes = modes_of(0, 0, 1, 1, 2, 2)
    log_weights = np.log([0.0001, 0.0001, 0.0002, 0.0002, 0.5, 0.4994])
    ancestors, drawn_weights, drawn = modes.resample(0, log_weights, LEAST, 0.5)
    np.testing.assert_array_equal(ancestors, [0, 4, 4, 4, 5, 5])
    assert evidences_of(drawn) == [0.0, 20.0]
    # One particle is more than the share of the leader's mode, so its weight is less.
    np.testing.assert_allclose(drawn.shares(drawn_weights), np.array([0.0002, 0.9994]) / 0.9996)


def test_resampling_of_one_mode_gives_equal_weights():
    ancestors, drawn_weights, drawn = modes_of(0, 0, 0, 0).resample(1, np.log([0.5, 0.1, 0.1, 0.3]), LEAST, 0.5)
    np.testing.assert_array_equal(ancestors, [1, 0, 2, 3])
    np.testing.assert_array_equal(drawn_weights, 0.0)
    np.testing.assert_array_equal(drawn.members, 0)


def test_moments_about_a_mode_are_those_of_a_mixture():
    poses, shares = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), np.array([0.75, 0.25])
    mixture = MotionMixture(poses[0], poses, shares)
    np.testing.assert_allclose(mixture.spread(), np.diag([1.0, 0.0, 0.0]), atol=1e-12)
    own = [np.diag([0.1, 0.2, 0.3]), np.diag([0.5, 0.6, 0.7])]
    expected = np.diag([0.75 * 0.1 + 0.25 * 0.5 + 1.0, 0.3, 0.4])
    np.testing.assert_allclose(mixture.mix_covariances(own), expected, atol=1e-12)
    # A mode that faces to the left is uncertain across the other one.
    turned = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2]])
    mixed = MotionMixture(turned[0], turned, shares).mix_covariances([np.zeros((3, 3)), np.diag([4.0, 0.0, 0.0])])
    assert mixed[1, 1] == pytest.approx(1.0)
    assert mixed[2, 2] == pytest.approx(0.25 * (np.pi / 2) ** 2)


def test_errors_of_modes_have_what_the_modes_differ_by_and_the_mean_gain():
    mixture = MotionMixture(np.zeros(3), along_x(0.0, 2.0), np.array([0.75, 0.25]))
    own = [MatchError(scale * np.eye(3), 0.5 * scale * np.eye(3), scale * np.eye(3)) for scale in (0.1, 0.5)]
    mixed = mixture.mix_errors(own)
    np.testing.assert_allclose(mixed.pose_covariance, np.diag([1.2, 0.2, 0.2]), atol=1e-12)
    np.testing.assert_allclose(mixed.drift_covariance, np.diag([1.1, 0.1, 0.1]), atol=1e-12)
    np.testing.assert_allclose(mixed.gain, 0.2 * np.eye(3), atol=1e-12)


def test_information_is_less_by_a_further_error_also_where_there_is_none():
    information = np.diag([100.0, 4.0, 0.0])
    motions = np.array([[0.0, np.sqrt(1.5), 0.0], [0.0, 0.0, 3.0]])
    mixture = MotionMixture(np.zeros(3), motions, np.array([0.5, 0.5]))
    np.testing.assert_allclose(mixture.spread(), np.diag([0.0, 0.75, 4.5]), atol=1e-12)
    np.testing.assert_allclose(mixture.blur_information(information), np.diag([100.0, 1.0, 0.0]), atol=1e-9)
