"""A map that a further log extends: poses of all logs in one frame, whatever the clocks of the logs say."""

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from preloaded import hmt_slam

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.evaluation import read_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.final_map import deskewed_scans, final_map
from hmt_slam_ros.results.log_reading import LogProgress, LogReader, is_newest_log
from hmt_slam_ros.sensors import Scan

WORLD = "sim:office,seed=3,size=0.7"
BUNDLED = Path(__file__).parents[1] / "data" / "malaga_one_loop"
FIRST, BEGIN, SECOND = 130.0, 130.1, 120.0
NEAR, TURN = 0.15, np.radians(2.0)


class Restamped:
    """A log with other stamps of its own."""

    def __init__(self, log, by):
        self.log, self.by = log, by
        self.name, self.scan_count, self.duration = log.name, log.scan_count, log.duration

    def records(self):
        for record in self.log.records():
            measurement = dataclasses.replace(record.measurement, stamp=record.measurement.stamp + self.by)
            yield dataclasses.replace(record, source_stamp=record.source_stamp + self.by, measurement=measurement)


def scans_of(log):
    return [record for record in log.records() if isinstance(record.measurement, Scan)]


@pytest.fixture(scope="module")
def first():
    """The state after the first part of a drive."""
    run = LockStepRun(Configuration())
    for record in open_log(WORLD, duration=FIRST).records():
        run.process_record(record)
    return run.state


@pytest.fixture(scope="module")
def second_log():
    return open_log(WORLD, start=BEGIN, duration=SECOND)


def extend_map(state, log):
    """The final map of a map and a further log, and how the logs were read."""
    result = run_log(log, Configuration(), state=state)
    recording = result.recorder.finish(result.log_progress.stamps, result.log_progress.first_scans)
    scans = partial(deskewed_scans, log, Configuration())
    return final_map(recording, scans, Configuration()).recording, result.log_progress


@pytest.fixture(scope="module")
def both(first, second_log):
    return extend_map(first, second_log)


def test_the_poses_of_both_logs_are_in_one_frame(both, first):
    recording, log = both
    assert log.first_scans == (0, first.log.stamps.size)
    truth = np.array([record.true_pose for record in scans_of(open_log(WORLD, duration=BEGIN + SECOND))])
    assert len(truth) == len(recording.trajectory)
    away = se2.between(se2.between(truth[0], truth), se2.between(recording.trajectory[0], recording.trajectory))
    assert np.hypot(away[:, 0], away[:, 1]).max() < NEAR
    assert np.abs(away[:, 2]).max() < TURN


def test_the_robot_was_lost_at_first_and_then_joined(first, second_log):
    run, lost = LockStepRun(Configuration(), state=first), []
    for record in run.unread_records(second_log):
        run.process_record(record)
        events = max(run.recorder.hypotheses, default=-1)
        if events >= first.processes["slam"].keyframe_events:
            lost.append(all(hypothesis.lost for hypothesis in run.recorder.hypotheses[events].hypotheses))
    assert lost[0]
    assert not lost[-1]
    joined = lost.index(False)
    assert not any(lost[joined:])


@pytest.mark.parametrize("by", [-3600, -60])
def test_stamps_before_and_among_those_of_the_map_make_no_difference(both, first, second_log, by):
    log = Restamped(second_log, by * 1_000_000_000)
    recording, read = extend_map(first, log)
    np.testing.assert_array_equal(recording.trajectory, both[0].trajectory)
    own = [record.source_stamp for record in scans_of(log)]
    np.testing.assert_array_equal(read.source_stamps[read.first_scans[-1] :], own)


def test_a_run_can_stop_in_the_second_log_as_well(both, first, second_log):
    run = LockStepRun(Configuration(), state=first)
    for number, record in enumerate(run.unread_records(second_log)):
        run.process_record(record)
        if number == 1500:
            break
    recording, log = extend_map(run.state, second_log)
    np.testing.assert_array_equal(recording.trajectory, both[0].trajectory)
    assert log.first_scans == both[1].first_scans


def test_a_log_that_the_map_does_not_know_is_an_island_in_it(first):
    """Neither bends the other."""
    recording, log = extend_map(first, open_log(BUNDLED, duration=20.0))
    alone, _ = extend_map(None, open_log(WORLD, duration=FIRST))
    apart = se2.between(alone.trajectory, recording.trajectory[: log.first_scans[1]])
    assert np.hypot(apart[:, 0], apart[:, 1]).max() < NEAR
    assert np.isfinite(recording.trajectory).all()


def test_a_log_is_known_by_the_stamp_and_the_ranges_of_its_first_scan(first):
    assert is_newest_log(first.log, open_log(WORLD))
    assert not is_newest_log(first.log, Restamped(open_log(WORLD), 1))
    assert not is_newest_log(first.log, open_log("sim:office,seed=4,size=0.7"))
    assert is_newest_log(LogProgress(), open_log(BUNDLED))


def test_the_clock_of_a_map_goes_on_in_a_log_that_is_older(first, second_log):
    reading = LogReader(first.log)
    log = Restamped(second_log, -(10**12))
    reading.begin_log(log)
    record = next(iter(reading.unread_records(log)))
    assert record.measurement.stamp > first.log.stamps[-1]
    assert record.source_stamp < first.log.source_stamps[0]


def test_the_command_says_whether_the_log_is_a_further_one_and_writes_the_poses_of_all(tmp_path):
    def map_part(log, name, seconds, *options):
        """What the command reports."""
        return hmt_slam("map", log, "--out", tmp_path / name, "--duration", seconds, *options, check=True).stderr

    map_part(BUNDLED, "a", 6, "--start", 0.5)
    reported = map_part(BUNDLED, "b", 9, "--from", tmp_path / "a")
    assert "malaga_one_loop is the log that the map was made of, of which " in reported
    assert "it is a further one" not in reported
    assert not (tmp_path / "b" / "earlier").exists()
    reported = map_part(WORLD, "c", 5, "--from", tmp_path / "b")
    assert "it is a further one" in reported
    scans = [len(scans_of(log)) for log in (open_log(BUNDLED, start=0.5, duration=9.0), open_log(WORLD, duration=5.0))]
    for name in ("trajectory", "trajectory_online", "stages/keyframes"):
        assert read_tum(tmp_path / "c" / f"{name}.tum").stamps.size == scans[1]
    np.testing.assert_array_equal(
        read_tum(tmp_path / "c" / "earlier" / "1.tum").stamps, read_tum(tmp_path / "b" / "trajectory.tum").stamps
    )
