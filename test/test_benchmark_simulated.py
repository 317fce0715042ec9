"""What is true of a simulated run: placements, loops, and that watching a run changes nothing of it."""

import csv

import numpy as np
import pytest

from benchmark.simulated.loops import Loops
from benchmark.simulated.records import Records, code_hash, read_record, write_comparisons
from benchmark.simulated.truth import Truth, nees
from benchmark.simulated.worlds import FAMILIES, LONG, SETTINGS, World, seeds
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.messages import Keyframe
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation import open_simulated

WORLD = World("ring", 5)
TIGHT = 1e-4 * np.eye(3)


def keyframes_of(log, spacing=10):
    """Keyframe events of every so many scans of a drive, without hypotheses."""
    scans = [r.measurement for r in log.records() if isinstance(r.measurement, Scan)][::spacing]
    path = log.true_poses(np.array([scan.stamp for scan in scans]))
    traveled = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T))))
    return [Keyframe(k, scan, float(way), ()) for k, (scan, way) in enumerate(zip(scans, traveled, strict=True))]


@pytest.fixture(scope="module")
def drive():
    """Twice around a ring: the truth, and the keyframe events."""
    log = open_simulated("sim:ring,seed=5")
    keyframes = keyframes_of(log)
    truth = Truth(log)
    for keyframe in keyframes:
        truth.add_keyframe(keyframe)
    return truth, keyframes


def test_training_and_validation_have_no_seed_in_common():
    assert not set(seeds(100, training=True)) & set(seeds(1000, training=False))
    assert seeds(2, training=False) == (1000, 1001)
    with pytest.raises(HmtSlamError, match="100 training seeds"):
        seeds(101, training=True)


def test_fresh_seeds_begin_at_the_first_that_is_given():
    assert seeds(3, 2000, training=False) == (2000, 2001, 2002)
    assert seeds(2, 98, training=True) == (98, 99)
    with pytest.raises(HmtSlamError, match="there are 100 training seeds: 101 are too many"):
        seeds(3, 98, training=True)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_has_a_world_of_a_length_that_is_feasible(family):
    assert 500 < open_simulated(World(family, 0).log).scan_count < 6000
    assert SETTINGS.keys() == set(FAMILIES)


def second_lap(truth, keyframes):
    """An event of the second lap and one of the first in the same place."""
    late = next(k.sequence for k in keyframes if k.path_length > 70.0)
    early = [k.sequence for k in keyframes if k.path_length < 40.0]
    distances = [np.hypot(*(truth.poses[k] - truth.poses[late])[:2]) for k in early]
    return early[int(np.argmin(distances))], late


def placement_with_error(truth, known, requirement, error, covariance=TIGHT):
    """The placement that joins the frames of two keyframes, moved by an error."""
    pose = se2.compose(se2.between(truth.poses[known], truth.poses[requirement]), np.array(error))
    return truth.assess({known: np.zeros(3)}, {requirement: pose}, covariance, pose)


def test_the_long_world_is_2_km_of_nested_loops_and_no_family():
    log = open_simulated(World(LONG, 1000).log)
    assert 1900 < np.hypot(*np.diff(log.scenario.poses[:, :2], axis=0).T).sum() < 2100
    assert LONG not in FAMILIES


def test_a_placement_is_true_where_the_places_meet(drive):
    truth, keyframes = drive
    known, requirement = second_lap(truth, keyframes)
    exact = placement_with_error(truth, known, requirement, (0.0, 0.0, 0.0))
    assert exact.true
    assert exact.pair == (known, requirement)
    assert exact.translation == pytest.approx(0.0, abs=1e-9)
    assert placement_with_error(truth, known, requirement, (0.45, 0.0, 0.1)).true
    assert not placement_with_error(truth, known, requirement, (0.0, 0.0, 0.2)).true
    # Up to 2 m where its covariance admits the error.
    assert not placement_with_error(truth, known, requirement, (1.5, 0.0, 0.0)).true
    assert placement_with_error(truth, known, requirement, (1.5, 0.0, 0.0), np.diag([1.0, 0.01, 0.01])).true
    assert not placement_with_error(truth, known, requirement, (2.5, 0.0, 0.0), np.diag([4.0, 0.01, 0.01])).true


def test_a_placement_that_joins_what_is_apart_is_false_however_right_its_pose(drive):
    truth, keyframes = drive
    far = next(k.sequence for k in keyframes if k.path_length > 20.0)
    placement = placement_with_error(truth, 0, far, (0.0, 0.0, 0.0))
    assert placement.translation == pytest.approx(0.0, abs=1e-9)
    assert not placement.same_place
    assert not placement.true


def test_a_loop_is_found_where_the_second_lap_begins_and_closed_where_the_map_joins_it(drive):
    truth, keyframes = drive
    loops, separate, joined = Loops(truth), HybridMap(), HybridMap()
    for keyframe in keyframes:
        area = 0 if keyframe.path_length < 28.0 else 1
        for hybrid_map in (separate, joined):
            hybrid_map.set_keyframe(keyframe.sequence, 2 * area, truth.poses[keyframe.sequence])
        loops.add_event(keyframe.sequence, keyframe.path_length, separate, 2 * area)
        if keyframe.path_length > 60.0 and joined.arc(0, 2) is None:
            loops.update_definite(keyframe.sequence, separate, 2)
            assert loops.found[-1].closed_at is None
            joined.set_arc(0, 2, PoseGaussian(np.zeros(3), TIGHT), closure=True)
            loops.update_definite(keyframe.sequence, joined, 2)
    loops.finish()
    (loop,) = loops.found
    assert loop.begin == pytest.approx(54.0, abs=2.0)
    assert loop.length == pytest.approx(54.0, abs=2.0)
    assert loop.can_be_closed
    assert loop.in_time
    assert loop.closed_at == pytest.approx(60.5, abs=1.0)


def test_nees_of_draws_from_a_belief_is_that_of_three_degrees_of_freedom():
    covariance = np.array([[0.04, 0.01, 0.002], [0.01, 0.02, 0.0], [0.002, 0.0, 0.001]])
    belief = PoseGaussian(np.array([3.0, -2.0, 2.5]), covariance)
    draws = np.random.default_rng(1).multivariate_normal(np.zeros(3), covariance, 2000)
    found = [nees(belief, se2.compose(belief.mean, se2.exp(xi))) for xi in draws]
    assert np.mean(found) == pytest.approx(3.0, abs=0.15)
    assert np.mean(np.array(found) > 7.815) == pytest.approx(0.05, abs=0.015)


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """A real watched run, in a process of its own."""
    folder = tmp_path_factory.mktemp("records")
    return folder, Records(folder, 1).make([WORLD], [])[0]


def test_watching_changes_nothing_of_a_run(record):
    _, watched = record
    result = run_log(open_simulated(WORLD.log), load_configuration(None, [], WORLD.seed))
    recording = result.recorder.finish(result.log_progress.stamps)
    arcs = list(recording.hybrid_map.all_arcs())
    assert [tuple(arc["areas"]) for arc in watched["arcs"]] == [(a, b) for a, b, _ in arcs]
    sigmas = [np.sqrt(np.trace(arc.pose.covariance[:2, :2])) for *_, arc in arcs]
    np.testing.assert_allclose([arc["sigma"] for arc in watched["arcs"]], sigmas, rtol=1e-6)
    assert watched["keyframes"] == len(result.recorder.keyframes)


def test_a_record_holds_what_the_four_measurements_need(record):
    _, watched = record
    assert watched["code"] == code_hash()
    assert sum(loop["can_be_closed"] for loop in watched["loops"]) == 1
    assert len(watched["poses"]) > 50
    assert all(pose["map"]["nees"] >= 0.0 for pose in watched["poses"])
    for event in watched["events"]:
        total = sum(answer["probability"] for answer in event["answers"]) + event["unexamined"]
        assert total == pytest.approx(1.0, abs=1e-5)
        assert sum(answer["probability"] for answer in event["arcs_alone"]) == pytest.approx(1.0, abs=1e-2)
    assert len(watched["rows"][0]) == len(watched["columns"])


def test_a_record_is_made_once_and_again_for_other_parameters(record):
    folder, watched = record
    path = folder / "ring-5.json.gz"
    before = path.stat().st_mtime_ns
    assert Records(folder, 1).make([WORLD], []) == [watched]
    assert path.stat().st_mtime_ns == before
    with pytest.raises(HmtSlamError, match=r"ring-5 failed.*no\.such"):
        Records(folder, 1).make([WORLD], ["no.such=1"])
    assert read_record(path) == watched


def test_comparisons_become_a_table(record, tmp_path):
    folder, watched = record
    assert write_comparisons(folder, tmp_path / "table.csv") == len(watched["rows"])
    with (tmp_path / "table.csv").open() as source:
        rows = list(csv.DictReader(source))
    assert [row["family"] for row in rows] == ["ring"] * len(watched["rows"])
    assert [int(row["event"]) for row in rows] == [row[0] for row in watched["rows"]]
    with pytest.raises(HmtSlamError, match="no records"):
        write_comparisons(tmp_path, tmp_path / "other.csv")
