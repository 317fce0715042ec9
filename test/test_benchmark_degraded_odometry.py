"""Degraded odometry: what is degraded, by how much, and that everything else stays."""

from dataclasses import dataclass

import numpy as np
import pytest

from benchmark.degraded_odometry import KINDS, degrade_log
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.sensors import Odometry, Scan


@dataclass
class ListedLog:
    """A log of given odometry poses (n, 3), one every ``period`` s, each followed by a scan of the same stamp."""

    poses: np.ndarray
    period: float = 0.1
    name: str = "listed"

    @property
    def scan_count(self):
        return len(self.poses)

    @property
    def duration(self):
        return self.period * (len(self.poses) - 1)

    def records(self):
        for k, pose in enumerate(self.poses):
            stamp = round(k * self.period * 1e9)
            yield LogRecord(stamp, Odometry(stamp, pose))
            yield LogRecord(stamp, Scan(stamp, np.ones(3, dtype=np.float32), 0.0, 0.1, 0.0, 10.0))


def straight(distance, readings):
    poses = np.zeros((readings + 1, 3))
    poses[:, 0] = np.linspace(0.0, distance, readings + 1)
    return ListedLog(poses)


def turning(turns):
    """2 s straight on, then 90 degrees within 3 s, again and again."""
    rates = np.tile(np.repeat([0.0, np.pi / 2 / 30], [20, 30]), turns)
    headings = np.concatenate(([0.0], np.cumsum(rates)))
    return ListedLog(np.stack((0.0 * headings, 0.0 * headings, se2.wrap(headings)), axis=1))


def readings(log):
    return [record.measurement for record in log.records() if isinstance(record.measurement, Odometry)]


def increments(log):
    poses = np.array([reading.pose for reading in readings(log)])
    return se2.between(poses[:-1], poses[1:])


@pytest.mark.parametrize("kind", KINDS)
def test_scans_and_stamps_stay_and_one_seed_gives_one_log(kind):
    log = turning(20)
    worse, again, other = degrade_log(log, kind, 3), degrade_log(log, kind, 3), degrade_log(log, kind, 4)
    assert (worse.scan_count, worse.duration) == (log.scan_count, log.duration)
    scans = [record.measurement.stamp for record in worse.records() if isinstance(record.measurement, Scan)]
    assert scans == [record.measurement.stamp for record in log.records() if isinstance(record.measurement, Scan)]
    stamps = [reading.stamp for reading in readings(worse)]
    assert set(stamps) <= {reading.stamp for reading in readings(log)}
    assert stamps == [reading.stamp for reading in readings(again)]
    for reading, other_reading in zip(readings(worse), readings(again), strict=True):
        np.testing.assert_array_equal(reading.pose, other_reading.pose)
    if kind not in {"none", "missing"}:
        assert any(
            (reading.pose != other_reading.pose).any()
            for reading, other_reading in zip(readings(worse), readings(other), strict=True)
        )


@pytest.mark.parametrize(("kind", "factor"), [("noise-2x", np.sqrt(3.0)), ("noise-4x", np.sqrt(15.0))])
@pytest.mark.parametrize("per_meter", [4, 40])
def test_the_noise_over_a_meter_is_the_models_whatever_the_rate_of_the_readings(kind, factor, per_meter):
    distance = 2000
    errors = increments(degrade_log(straight(distance, distance * per_meter), kind, 0)) - [1.0 / per_meter, 0.0, 0.0]
    # The lateral errors of the readings within one meter are of the frame of each, not turned by those before.
    deviations = errors.reshape(distance, per_meter, 3).sum(axis=1).std(axis=0)
    np.testing.assert_allclose(deviations, factor * np.array([0.1, 0.1, np.radians(2.0)]), rtol=0.05)


def test_a_robot_that_stands_gets_no_noise():
    np.testing.assert_array_equal(increments(degrade_log(straight(0.0, 50), "noise-4x", 0)), 0.0)


def test_one_turn_in_five_slips_by_twenty_degrees_either_way_within_a_second():
    log = turning(400)
    errors = np.degrees(se2.wrap(increments(degrade_log(log, "slip", 0))[:, 2] - increments(log)[:, 2]))
    turns = errors.reshape(400, 50)
    slips = turns.sum(axis=1)
    slipped = np.abs(slips) > 1e-6
    np.testing.assert_allclose(np.abs(slips[slipped]), 20.0)
    assert 0.15 < slipped.mean() < 0.25
    assert 0.3 < (slips[slipped] > 0).mean() < 0.7
    assert (np.count_nonzero(np.abs(turns) > 1e-6, axis=1)[slipped] == 10).all()
    np.testing.assert_allclose(turns[:, :20], 0.0, atol=1e-9)


def test_readings_miss_at_random_or_all_of_them():
    log = straight(100.0, 4000)
    assert len(readings(degrade_log(log, "missing", 0))) == pytest.approx(0.95 * 4001, abs=50)
    assert readings(degrade_log(log, "none", 0)) == []


def test_another_kind_is_refused():
    with pytest.raises(ValueError, match="'noise-3x' is no kind"):
        degrade_log(straight(1.0, 2), "noise-3x", 0)
