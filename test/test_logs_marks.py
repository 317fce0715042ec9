"""Marks in simulated drives and in bags: the same observations, and those that are none left out."""

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from hmt_slam_ros.cli.main import main
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs import mark_messages
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.writer import write_bag
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import MarkObservation, Scan

WORLD = "sim:ring,seed=1,beams=31"
MARKED = f"{WORLD},marks=6"


def marks_in(log):
    return [record for record in log.records() if isinstance(record.measurement, MarkObservation)]


@pytest.fixture(scope="module")
def drive():
    """A simulated drive of two laps, with the records of its marks."""
    log = open_log(MARKED)
    return log, marks_in(log)


def test_each_mark_is_seen_in_both_laps_from_near_and_where_it_is(drive):
    log, records = drive
    names = {record.measurement.name for record in records}
    assert names == {f"mark_{k}" for k in range(6)}
    for name in names:
        own = [record for record in records if record.measurement.name == name]
        poses = [log.true_poses(np.array([record.measurement.stamp]))[0] for record in own]
        marks = np.array(
            [
                se2.compose(pose, se2.inverse(record.measurement.pose.mean))
                for record, pose in zip(own, poses, strict=True)
            ]
        )
        assert np.hypot(*(marks - np.median(marks, axis=0))[:, :2].T).max() < 0.25  # 1 degree at 1.5 m, 3 cm
        assert max(np.hypot(*(pose - marks[0])[:2]) for pose in poses) < 1.7
        assert own[-1].measurement.stamp - own[0].measurement.stamp > 0.4 * log.duration * 1e9


def test_without_marks_a_drive_is_the_same_but_for_them(drive):
    plain = open_log(WORLD, duration=3.0).records()
    marked = (r for r in open_log(MARKED, duration=3.0).records() if not isinstance(r.measurement, MarkObservation))
    for one, other in zip(plain, marked, strict=True):
        assert (one.source_stamp, type(one.measurement)) == (other.source_stamp, type(other.measurement))
        if isinstance(one.measurement, Scan):
            np.testing.assert_array_equal(one.measurement.ranges, other.measurement.ranges)


def test_a_name_is_misread_in_a_whole_pass(drive):
    _, right = drive
    wrong = marks_in(open_log(f"{MARKED},wrong_marks=0.5"))
    seen = {(record.measurement.stamp, record.measurement.name) for record in right}
    misread = [
        record.measurement.name for record in wrong if (record.measurement.stamp, record.measurement.name) not in seen
    ]
    assert 0 < len(misread) < len(wrong)
    changes = sum(a != b for a, b in pairwise(misread))
    assert changes <= 12


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_has_the_same_observations_where_their_topic_is_named(tmp_path, storage):
    log = open_log(MARKED, duration=6.0)
    write_bag(log, tmp_path / "bag", storage=storage)
    assert not marks_in(open_log(tmp_path / "bag"))
    read = open_log(tmp_path / "bag", marks_topic="/marks")
    wanted = marks_in(log)
    assert len(wanted) > 3
    for one, other in zip(wanted, marks_in(read), strict=True):
        assert (one.source_stamp, one.measurement.name, one.measurement.stamp) == (
            other.source_stamp,
            other.measurement.name,
            other.measurement.stamp,
        )
        np.testing.assert_allclose(other.measurement.pose.mean, one.measurement.pose.mean, atol=1e-12)
        np.testing.assert_allclose(other.measurement.pose.covariance, one.measurement.pose.covariance, atol=1e-15)
    assert main(["convert", str(tmp_path / "bag"), str(tmp_path / "copy"), "--marks", "/marks"]) == 0
    assert len(marks_in(open_log(tmp_path / "copy", marks_topic="/marks"))) == len(wanted)
    part = [
        record.measurement.stamp for record in open_log(tmp_path / "bag", marks_topic="/marks", start=1.0).records()
    ]
    assert min(part) >= part[0]


def test_a_bag_without_the_topic_is_one_sentence(tmp_path):
    write_bag(open_log(MARKED, duration=2.0), tmp_path / "bag")
    with pytest.raises(HmtSlamError, match=r"bag has no topic /tags of type .*: set marks.topic to /marks\."):
        open_log(tmp_path / "bag", marks_topic="/tags")
    assert main(["map", str(tmp_path / "bag"), "--out", str(tmp_path / "out"), "--set", "marks.topic=/scan"]) == 2


def test_a_log_without_marks_has_no_topic_of_them(tmp_path):
    write_bag(open_log(WORLD, duration=2.0), tmp_path / "bag")
    with pytest.raises(HmtSlamError, match=r"set marks\.topic to nothing"):
        open_log(tmp_path / "bag", marks_topic="/marks")


def test_an_observation_that_is_none_is_left_out(tmp_path):
    log = open_log(MARKED, duration=6.0)
    records = list(log.records())
    first = next(k for k, record in enumerate(records) if isinstance(record.measurement, MarkObservation))
    belief = records[first].measurement.pose
    broken = replace(records[first].measurement, pose=PoseGaussian(belief.mean, -belief.covariance))
    records[first] = LogRecord(records[first].source_stamp, broken)
    write_bag(SimpleNamespace(name="broken", records=lambda: iter(records)), tmp_path / "bag")
    read = open_log(tmp_path / "bag", marks_topic="/marks")
    assert read.left_out.count == 1
    assert "covariance of a mark" in read.left_out.reason
    assert len(marks_in(read)) == len(marks_in(log)) - 1


def test_the_covariance_of_a_message_is_along_the_axes_of_the_mark():
    belief = PoseGaussian(np.array([1.0, 2.0, np.pi / 2]), np.diag([0.04, 0.01, 0.001]))
    covariance = mark_messages.message_covariance(belief).reshape(6, 6)
    np.testing.assert_allclose(np.diag(covariance), [0.01, 0.04, 0.0, 0.0, 0.0, 0.001], atol=1e-15)


def test_a_map_of_a_bag_with_marks_is_that_of_the_drive_and_goes_on(tmp_path):
    """Whole, in two processes, and in two parts: the same trajectory, byte for byte."""
    arguments = ["--set", "filter.particles=3", "--set", "tsbi.recheck_keyframes=3"]

    def trajectory(name, *words):
        assert main(["map", MARKED, "--out", str(tmp_path / name), *arguments, *words]) == 0
        return (tmp_path / name / "trajectory.tum").read_bytes()

    whole = trajectory("whole", "--jobs", "1", "--duration", "12")
    assert trajectory("ahead", "--jobs", "2", "--duration", "12") == whole
    trajectory("part", "--jobs", "1", "--duration", "8")
    state = tmp_path / "part" / "hmt_map" / "tsbi.json"
    assert '"mark_' in state.read_text()
    assert trajectory("rest", "--jobs", "1", "--duration", "12", "--from", str(tmp_path / "part")) == whole
