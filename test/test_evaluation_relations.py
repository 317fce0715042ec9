"""Errors at relations, against values worked out by hand."""

import numpy as np
import pytest

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import (
    Relations,
    StampedPoses,
    evaluate_folder,
    evaluate_relations,
    format_table,
    read_relations,
    write_tum,
)
from hmt_slam_ros.geometry import se2

S = 10**9


def poses_at(*rows):
    """Rows (seconds, x, y, theta)."""
    table = np.array(rows, dtype=np.float64)
    return StampedPoses(np.round(table[:, 0] * S).astype(np.int64), table[:, 1:])


def relations_of(*rows):
    """Rows (start, end, x, y, theta)."""
    table = np.array(rows, dtype=np.float64)
    stamps = np.round(table[:, :2] * S).astype(np.int64)
    return Relations(stamps[:, 0], stamps[:, 1], table[:, 2:])


def test_errors_by_hand():
    """Facing +y at (1, 1), the pose at (1, 3) is 2 m ahead; the truth says 1.7 m ahead, 0.4 m left, turned by -10."""
    trajectory = poses_at((0, 1, 1, np.pi / 2), (1, 1, 3, np.pi / 2), (2, 1, 3, -np.pi / 2))
    relations = relations_of((0, 1, 1.7, 0.4, np.deg2rad(-10)), (1, 2, 0, 0, np.pi), (0, 2, 2, 0, np.deg2rad(-170)))
    errors = evaluate_relations(trajectory, relations).overall
    assert (errors.count, errors.matched, errors.missed, errors.extrapolated) == (3, 3, 0, 0)
    assert errors.translation.mean == pytest.approx(0.5 / 3)
    assert errors.translation.std == pytest.approx(np.sqrt((0.25 - 0.25 / 3) / 2))
    assert errors.translation.rms == pytest.approx(np.sqrt(0.25 / 3))
    assert errors.translation.max == pytest.approx(0.5)
    assert errors.rotation.mean == pytest.approx(20 / 3)
    assert errors.rotation.max == pytest.approx(10)


def test_a_true_trajectory_in_any_frame_has_no_error():
    rng = np.random.default_rng(0)
    poses = rng.uniform(-5, 5, (50, 3))
    stamps = np.arange(50) * S
    first, second = rng.integers(0, 50, (2, 200))
    truth = Relations(stamps[first], stamps[second], se2.between(poses[first], poses[second]))
    moved = StampedPoses(stamps, se2.compose([100.0, -7.0, 2.0], poses))
    errors = evaluate_relations(moved, truth).overall
    assert errors.translation.max == pytest.approx(0.0, abs=1e-12)
    assert errors.rotation.max == pytest.approx(0.0, abs=1e-10)


def test_the_order_of_the_trajectory_does_not_matter():
    rows = [(k, k * 0.5, np.sin(k), 0.1 * k) for k in range(100)]
    relations = relations_of(*((k, (k * 7) % 100, 0.3, 0.2, 0.1) for k in range(100)))
    straight = evaluate_relations(poses_at(*rows), relations)
    jumping = evaluate_relations(poses_at(*rows[50:], *rows[:50][::-1]), relations)
    assert jumping == straight


def test_of_poses_with_the_same_stamp_the_first_counts():
    relations = relations_of((0, 1, 1, 0, 0))
    errors = evaluate_relations(poses_at((0, 0, 0, 0), (1, 1, 0, 0), (1, 9, 9, 0)), relations)
    assert errors.overall.translation.max == 0.0


def test_a_pose_at_a_tenth_of_a_second_counts_and_one_later_is_missed():
    relations = relations_of((0, 1, 1, 0, 0), (0, 2, 1, 0, 0), (3, 0, 1, 0, 0))
    errors = evaluate_relations(poses_at((0, 0, 0, 0), (1.1, 1, 0, 0), (2.100000001, 1, 0, 0)), relations).overall
    assert (errors.matched, errors.missed, errors.extrapolated) == (1, 2, 0)
    assert errors.translation.max == 0.0


def test_with_odometry_a_pose_is_extrapolated_to_the_time_requested():
    """At 2 s the odometry has gone 1 m ahead since the pose at 1 s, which looks along +y in the trajectory."""
    trajectory = poses_at((0, 0, 0, 0), (1, 5, 0, np.pi / 2))
    odometry = poses_at((0, 7, 7, 0), (1, 8, 7, 0), (2, 9, 7, 0.25))
    relations = relations_of((0, 2, 5, 1, np.pi / 2 + 0.25))
    assert evaluate_relations(trajectory, relations).overall.missed == 1
    errors = evaluate_relations(trajectory, relations, odometry).overall
    assert (errors.matched, errors.missed, errors.extrapolated) == (1, 0, 1)
    assert errors.translation.max == pytest.approx(0.0, abs=1e-12)
    assert errors.rotation.max == pytest.approx(0.0, abs=1e-12)


def test_odometry_with_a_gap_bridges_nothing_across_it():
    trajectory, odometry = poses_at((0, 0, 0, 0)), poses_at((0, 0, 0, 0), (1, 1, 0, 0))
    errors = evaluate_relations(trajectory, relations_of((0, 2, 2, 0, 0), (0, 1, 1, 0, 0)), odometry).overall
    assert (errors.matched, errors.missed) == (1, 1)


def test_relations_over_more_than_a_minute_are_scored_apart_too():
    trajectory = poses_at((0, 0, 0, 0), (60, 1, 0, 0), (60.05, 1, 0, 0), (200, 4, 0, 0))
    relations = relations_of((0, 60, 0, 0, 0), (0, 60.05, 0, 0, 0), (200, 0, 0, 0, 0), (0, 300, 0, 0, 0))
    errors = evaluate_relations(trajectory, relations)
    assert (errors.overall.count, errors.overall.matched, errors.overall.missed) == (4, 3, 1)
    assert (errors.over_60_s.count, errors.over_60_s.matched, errors.over_60_s.missed) == (3, 2, 1)
    assert errors.overall.translation.mean == pytest.approx(2.0)
    assert errors.over_60_s.translation.mean == pytest.approx(2.5)


def test_nothing_matched_has_no_error_rather_than_none():
    errors = evaluate_relations(poses_at((0, 0, 0, 0)), relations_of((5, 6, 0, 0, 0)))
    assert errors.overall.missed == 1
    assert np.isnan(errors.overall.translation.mean)
    assert "0/1 (0.0 %)" in format_table(errors)


def test_a_folder_is_evaluated_with_the_odometry_of_its_log(tmp_path):
    log = tmp_path / "log.clf"
    lines = [f"FLASER 2 1.0 2.0 {k} 0 0 {k} 0 0 {k}.000000 host 0" for k in range(100)]
    log.write_text("\n".join(lines) + "\n")
    write_tum(tmp_path / "trajectory.tum", poses_at((0, 0, 0, 0), (99, 99.5, 0, 0)))
    (tmp_path / "truth").write_text("# t1 t2 x y z r p y\n0 99.0 99 0 0 0 0 0\n0.0 40 40 0 0 0 0 0.1 # turn\n")
    without = evaluate_folder(tmp_path, tmp_path / "truth")
    assert (without.overall.matched, without.overall.missed) == (1, 1)
    errors = evaluate_folder(tmp_path, tmp_path / "truth", log)
    assert (errors.overall.matched, errors.overall.extrapolated, errors.over_60_s.matched) == (2, 1, 1)
    assert errors.over_60_s.translation.mean == pytest.approx(0.5)
    assert errors.overall.rotation.max == pytest.approx(np.rad2deg(0.1))
    table = format_table(errors).splitlines()
    assert "2/2 (100.0 %)" in table[1]
    assert "0.500 +- 0.000" in table[2]
    assert "within 0.1 s" in table[3]


@pytest.mark.parametrize("text", ["", "1 2 3\n", "1 2 0 0 0 0 0 x\n"])
def test_what_is_no_relation_is_one_sentence(tmp_path, text):
    (tmp_path / "truth").write_text(text)
    with pytest.raises(HmtSlamError, match=r"holds no relation|line 1 of .* is not"):
        read_relations(tmp_path / "truth")
