"""Two areas that a closure joined and in which nothing separates are one: in every process, in the map and after it."""

import numpy as np
import pytest
from misled import run

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.hmt_map import MapWriter, read_saved_map

# Corridors around four blocks: crossings are entered from several sides and at first taken for new ground.
LOG, SECONDS = "sim:grid,seed=4,count=2", 220.0


@pytest.fixture(scope="module")
def drive():
    """What was recorded, and the replicas of slam, aam, tsbi and tlca; documents went through JSON."""
    return run(open_log(LOG, duration=SECONDS), Configuration())


@pytest.fixture(scope="module")
def merged_areas(drive):
    """{keyframe event: the robot's area before and after it} of those at which an area became part of another."""
    recording, _ = drive
    rows = {row.keyframe: row for row in recording.probabilities}
    fewer = [k for k in rows if k and rows[k].areas < rows[k - 1].areas and rows[k].parent == rows[k - 1].hypothesis]
    assert fewer != []
    return {k: (rows[k - 1].area, rows[k].area) for k in fewer}


def test_the_robots_own_area_may_be_the_one_that_is_no_more(drive, merged_areas):
    left = [before for before, after in merged_areas.values() if before != after]
    assert left != []
    areas = drive[0].hybrid_map.area_ids()
    assert not set(left) & set(areas)
    assert drive[0].last_estimate.area in areas


def test_every_process_has_the_same_map_from_messages_alone(drive):
    recording, replicas = drive
    whole = recording.hybrid_map
    for replica in replicas:
        assert list(replica.maps) == [recording.replica.best_hypothesis]
        found = replica.maps[recording.replica.best_hypothesis]
        assert replica.robot_areas == recording.replica.robot_areas
        assert found.area_ids() == whole.area_ids()
        for area in found.area_ids():
            here, there = found.keyframes(area), whole.keyframes(area)
            assert list(here) == list(there)
            np.testing.assert_array_equal(list(here.values()), list(there.values()))
        for (a, b, arc), (c, d, other) in zip(found.all_arcs(), whole.all_arcs(), strict=True):
            assert (a, b, arc.closure) == (c, d, other.closure)
            np.testing.assert_array_equal(arc.pose.mean, other.pose.mean)
            np.testing.assert_array_equal(arc.pose.covariance, other.pose.covariance)


def test_the_published_pose_does_not_jump_when_areas_become_one(drive, merged_areas):
    recording, _ = drive
    stamps = {row.keyframe: row.stamp for row in recording.probabilities}
    for k in merged_areas:
        row = int(np.searchsorted(recording.stamps, stamps[k]))
        step = se2.between(*recording.online_trajectory[row : row + 2])
        driven = se2.between(*recording.odometry[row : row + 2])
        assert np.hypot(*(step - driven)[:2]) < 0.1
        assert np.degrees(abs(step[2] - driven[2])) < 2.0


class Until:
    """The log as far as to a scan."""

    def __init__(self, stamp):
        self.stamp = stamp

    def records(self):
        """Those that are no later."""
        return (record for record in open_log(LOG).records() if record.measurement.stamp <= self.stamp)


def test_a_log_may_end_when_the_robots_area_becomes_part_of_another(drive, merged_areas):
    stamps = {row.keyframe: row.stamp for row in drive[0].probabilities}
    k, after = next((k, after) for k, (before, after) in merged_areas.items() if before != after)
    recording, _ = run(Until(stamps[k]), Configuration())
    assert recording.probabilities[-1].keyframe == k
    assert recording.last_estimate.area == recording.replica.robot_areas[recording.replica.best_hypothesis] == after
    assert after in recording.hybrid_map.area_ids()
    in_map = recording.area_poses[after].compose(recording.last_estimate.pose)
    np.testing.assert_allclose(in_map.mean, recording.trajectory[-1], atol=0.05)


def test_the_trajectory_is_right(drive):
    recording, _ = drive
    truth = open_log(LOG).true_poses(recording.stamps)
    at = se2.compose(truth[0], se2.compose(se2.inverse(recording.trajectory[0]), recording.trajectory))
    assert np.hypot(*(at - truth)[:, :2].T).mean() < 0.15


def test_loops_stay_closed(drive):
    """As many arcs close loops as there are arcs beyond those that join all areas."""
    hybrid_map = drive[0].hybrid_map
    arcs = [arc for _, _, arc in hybrid_map.all_arcs()]
    assert sum(arc.closure for arc in arcs) == len(arcs) - len(hybrid_map.area_ids()) + 1


def test_the_saved_map_has_the_areas_that_are_left(drive, tmp_path):
    recording, _ = drive
    writer = MapWriter(tmp_path / "hmt_map")
    writer.write_map(recording.replica, recording.area_poses, recording.last_estimate)
    writer.finish(Configuration())
    saved = read_saved_map(tmp_path / "hmt_map")
    best = saved.replica.maps[saved.replica.best_hypothesis]
    assert best.area_ids() == recording.hybrid_map.area_ids() == sorted(saved.area_poses)
    assert saved.replica.robot_areas == recording.replica.robot_areas
