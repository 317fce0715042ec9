"""The verdict on topology: a missed loop, a wrong closure and a failed run are no right topology."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import box, scan_in

from benchmark.logs import BUNDLED, open_logs
from benchmark.odometry import TopologyVerdict, closure_errors, judge_run
from benchmark.runs import Case, Runner
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import Relations, StampedPoses, evaluate_relations, read_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.replica import Replica

# Keyframes of a robot that comes back to where it began: area 0 holds the first two, area 1 the last two.
TRUTH = {0: [0.0, 0.0, 0.0], 1: [5.0, 0.0, 0.3], 2: [5.2, 1.0, -2.0], 3: [0.3, 0.1, 3.0]}
WALLS = box(-3, -3, 8, 3)


def replica_of(arc, *, closure=True):
    """The map with the arc ``0_T_1``; the areas' frames are those of their first keyframes."""
    truth = {keyframe: np.array(pose) for keyframe, pose in TRUTH.items()}
    hybrid_map = HybridMap()
    for keyframe, area, first in ((0, 0, 0), (1, 0, 0), (2, 1, 2), (3, 1, 2)):
        hybrid_map.set_keyframe(keyframe, area, se2.between(truth[first], truth[keyframe]))
    hybrid_map.set_arc(0, 1, PoseGaussian(arc, 1e-4 * np.eye(3)), closure=closure)
    scans = {keyframe: scan_in(WALLS, pose, stamp=10 * keyframe, beams=11) for keyframe, pose in truth.items()}
    return Replica(scans, {0: hybrid_map}, {0: 1.0}, {0: 1})


def errors_of(replica, world=(0.0, 0.0, 0.0)):
    return closure_errors(replica, {10 * k: se2.compose(world, np.array(pose)) for k, pose in TRUTH.items()})


TRUE_ARC = se2.between(np.array(TRUTH[0]), np.array(TRUTH[2]))


@pytest.mark.parametrize("world", [(0.0, 0.0, 0.0), (-40.0, 7.0, 2.0)])
def test_a_true_arc_has_no_error_in_any_frame(world):
    (error,) = errors_of(replica_of(TRUE_ARC), world)
    assert error.areas == (0, 1)
    assert error.translation == pytest.approx(0.0, abs=1e-9)
    assert error.rotation == pytest.approx(0.0, abs=1e-9)


def test_the_error_of_an_arc_is_reported_where_its_areas_meet():
    """Turned about the place where keyframes 0 and 3 meet, the arc is wrong by that turn alone."""
    meeting = np.array([0.3, 0.1, 0.0])
    turned = se2.compose(se2.compose(meeting, [0.0, 0.0, 0.2]), se2.between(meeting, np.array(TRUTH[2])))
    (error,) = errors_of(replica_of(turned))
    assert error.translation == pytest.approx(0.0, abs=1e-9)
    assert error.rotation == pytest.approx(np.degrees(0.2))


def test_arcs_that_closed_no_loop_are_not_scored():
    assert errors_of(replica_of(TRUE_ARC + 3.0, closure=False)) == []


def scores(error):
    """One relation over 100 s, wrong by some meters."""
    stamps = np.array([0, 100_000_000_000])
    trajectory = StampedPoses(stamps, np.array([[0.0, 0.0, 0.0], [10.0 + error, 0.0, 0.0]]))
    return evaluate_relations(trajectory, Relations(stamps[:1], stamps[1:], np.array([[10.0, 0.0, 0.0]])))


def errors_of_shift(x, turn=0.0):
    return tuple(errors_of(replica_of(se2.compose(np.array([x, 0.0, turn]), TRUE_ARC))))


def test_a_map_of_the_right_topology_is_distinguished_from_wrong_ones():
    assert TopologyVerdict(scores(0.3), errors_of_shift(0.1)).is_right
    assert TopologyVerdict(scores(0.3)).is_right
    assert not TopologyVerdict(scores(1.1), errors_of_shift(0.1)).is_right
    assert not TopologyVerdict(scores(0.3), errors_of_shift(0.6)).is_right
    assert not TopologyVerdict(scores(0.3), errors_of_shift(0.0, np.radians(11.0))).is_right
    assert not TopologyVerdict(scores(0.3), (*errors_of_shift(0.0), *errors_of_shift(3.0))).is_right
    assert not TopologyVerdict(scores(float("nan")), errors_of_shift(0.0)).is_right
    assert not TopologyVerdict(None).is_right


@pytest.mark.long
def test_runs_with_degraded_odometry_are_scored_and_a_failed_one_is_wrong(tmp_path):
    """Real runs of the beginning of the bundled log; the path of the first is taken for the truth."""
    with open_logs([BUNDLED]) as (bundled,):
        relations = tmp_path / "relations"
        log = replace(bundled, relations_file=relations)
        runner = Runner(tmp_path / "runs", jobs=1)
        cases = [Case(log, 0, kind, duration=5.0) for kind in ("", "none", "no such kind")]
        reference, degraded, failed = runner.attempts(cases)
        assert not degraded.fault, degraded.fault
        assert "no such kind" in failed.fault
        path = read_tum(reference.folder / "trajectory.tum")
        last = se2.between(path.poses[0], path.poses[-1])
        relations.write_text(f"{path.stamps[0] / 1e9} {path.stamps[-1] / 1e9} {last[0]} {last[1]} 0 0 0 {last[2]}\n")
        assert judge_run(reference, reference).scores.overall.translation.max == pytest.approx(0.0, abs=1e-6)
        assert judge_run(degraded, reference).scores.overall.translation.max > 1e-4
        assert judge_run(failed, reference) == TopologyVerdict(None)
        with pytest.raises(HmtSlamError, match="no such kind"):
            runner.runs([failed.case])
