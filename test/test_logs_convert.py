"""A log converted to a rosbag2 and read back is the same log."""

import os
from pathlib import Path

import numpy as np
import pytest

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.records import InMemoryLog, LogEntry, TimeWindow
from hmt_slam_ros.logs.writer import write_bag
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry, Scan

DATASETS = Path(os.environ.get("HMT_SLAM_DATASETS", Path(__file__).parents[1] / "../shared/datasets"))
MALAGA = Path(__file__).parents[1] / "data" / "malaga_one_loop"


def assert_same_log(one, other):
    """Source stamps, running stamps, ranges and headings bit for bit; angles as float32 has them."""
    assert (one.scan_count, one.duration) == (other.scan_count, other.duration)
    poses = []
    for a, b in zip(one.records(), other.records(), strict=True):
        first, second = a.measurement, b.measurement
        assert (a.source_stamp, first.stamp, type(first)) == (b.source_stamp, second.stamp, type(second))
        if isinstance(first, Scan):
            assert first.ranges.tobytes() == second.ranges.tobytes()
            assert np.float32(first.angle_min) == second.angle_min
            assert np.float32(first.angle_increment) == second.angle_increment
            assert (np.float32(first.range_min), np.float32(first.range_max)) == (second.range_min, second.range_max)
            assert np.float32(first.time_increment) == second.time_increment
            poses.append((first.laser_pose, second.laser_pose))
        else:
            poses.append((first.pose, second.pose))
    written, read = np.array(poses).transpose(1, 0, 2)
    np.testing.assert_allclose(read, written, rtol=0.0, atol=1e-14)


def difficult_log():
    """Stamps that jump back, odd ranges, differing beam counts, two laser poses, paired and free odometry."""
    rng = np.random.default_rng(3)
    mounts = [np.array([0.2, 0.0, 0.0]), np.array([-0.3, 0.1, np.pi - 1e-9])]
    entries = []
    for k in range(300):
        source = 10**18 + 10**8 * (k - 40 * (k % 50 == 49))
        pose = np.array([*rng.uniform(-100, 100, 2), rng.uniform(-np.pi, np.pi)])
        if k % 3:
            entries.append(LogEntry(source, Odometry, (pose,), precedes_its_scan=k % 3 == 1))
        if k % 3 != 2:
            ranges = rng.choice([0.0, np.nan, np.inf, 1.5, 7.25, 30.0], 5 + k % 7).astype(np.float32)
            entries.append(LogEntry(source, Scan, (ranges, -1.5707963, 0.0174532, 0.05, 29.9, mounts[k % 2], 1e-4)))
    return InMemoryLog("difficult", entries, TimeWindow())


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_whatever_a_log_holds_survives(tmp_path, storage):
    log = difficult_log()
    write_bag(log, tmp_path / "bag", storage=storage)
    assert_same_log(log, open_log(tmp_path / "bag"))


def test_headings_at_the_seam_are_kept(tmp_path):
    headings = [-np.pi, np.nextafter(np.pi, 0.0), 0.0, 1e-12, -np.pi / 2]
    entries = [LogEntry(k, Odometry, (np.array([0.0, 0.0, theta]),)) for k, theta in enumerate(headings)]
    entries.append(LogEntry(9, Scan, (np.ones(3, np.float32), 0.0, 0.5, 0.0, 5.0)))
    write_bag(InMemoryLog("seam", entries, TimeWindow()), tmp_path / "bag")
    odometry = [r.measurement.pose for r in open_log(tmp_path / "bag").records() if isinstance(r.measurement, Odometry)]
    turned = np.array([pose[2] for pose in odometry]) - headings
    np.testing.assert_allclose(np.remainder(turned + 1.0, 2 * np.pi) - 1.0, 0.0, atol=1e-15)


def test_a_bag_converted_again_is_the_same(tmp_path):
    write_bag(open_log(MALAGA), tmp_path / "again", storage="sqlite3")
    assert_same_log(open_log(MALAGA), open_log(tmp_path / "again"))


def test_a_part_of_a_log_can_be_converted(tmp_path):
    write_bag(open_log(MALAGA, start=10.0, duration=5.0), tmp_path / "part")
    assert_same_log(open_log(MALAGA, start=10.0, duration=5.0), open_log(tmp_path / "part"))


def test_the_bundled_log_is_what_its_readme_says():
    log = open_log(MALAGA)
    records = list(log.records())
    scans = [record.measurement for record in records if isinstance(record.measurement, Scan)]
    odometry = np.array([record.measurement.pose for record in records if isinstance(record.measurement, Odometry)])
    assert (log.name, log.scan_count, len(scans), len(odometry)) == ("malaga_one_loop", 225, 225, 225)
    assert log.duration == pytest.approx(59.07, abs=0.01)
    assert {scan.ranges.size for scan in scans} == {361}
    assert {scan.range_max for scan in scans} == {80.0}
    assert all(scan.laser_pose == pytest.approx([0.78, 0.0, 0.0], abs=1e-6) for scan in scans)
    assert np.rad2deg(scans[0].angle_min) == pytest.approx(-90.0, abs=1e-5)
    assert np.rad2deg(scans[0].angle_increment) == pytest.approx(0.5, abs=1e-6)
    assert np.hypot(*np.diff(odometry[:, :2], axis=0).T).sum() == pytest.approx(76.35, abs=0.01)
    assert np.mean([scan.valid.mean() for scan in scans]) == pytest.approx(0.885, abs=1e-3)


@pytest.mark.parametrize("storage", ["rar", ""])
def test_an_unknown_storage_is_refused(tmp_path, storage):
    with pytest.raises(HmtSlamError, match="choose one of mcap, sqlite3"):
        write_bag(open_log(MALAGA), tmp_path / "bag", storage=storage)


def test_an_existing_destination_is_left_alone(tmp_path):
    (tmp_path / "bag").mkdir()
    with pytest.raises(HmtSlamError, match="exists already"):
        write_bag(open_log(MALAGA), tmp_path / "bag")
    assert list((tmp_path / "bag").iterdir()) == []


def test_a_log_that_breaks_off_leaves_nothing_behind(tmp_path):
    class Breaking:
        name, scan_count, duration = "breaking", 9, 1.0

        def __init__(self):
            self.reads = 0

        def records(self):
            self.reads += 1
            yield from list(difficult_log().records())[:50]
            if self.reads > 1:
                raise HmtSlamError("breaking is damaged here: copy it anew.")

    with pytest.raises(HmtSlamError, match="damaged here"):
        write_bag(Breaking(), tmp_path / "bag")
    assert list(tmp_path.iterdir()) == []


def test_a_destination_that_cannot_be_made_is_one_sentence(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(HmtSlamError, match="cannot be written"):
        write_bag(open_log(MALAGA), tmp_path / "file" / "bag")


def dataset(name):
    path = DATASETS / name
    if not path.is_file():
        pytest.skip(f"{name} is not in the folder that HMT_SLAM_DATASETS names")
    return path


def test_intel_is_read_in_file_order_and_survives_conversion(tmp_path):
    log = open_log(dataset("intel.clf.xz"))
    records = list(log.records())
    sources = np.array([record.source_stamp for record in records])
    scans = [record for record in records if isinstance(record.measurement, Scan)]
    odometry = np.array([record.measurement.pose for record in records if isinstance(record.measurement, Odometry)])
    assert (log.scan_count, len(records)) == (13631, 13631 + 13631 + 26915)
    assert (np.diff(sources) < 0).sum() == 889
    assert (np.diff([record.source_stamp for record in scans]) < 0).sum() == 631
    assert np.hypot(*np.diff(odometry[:, :2], axis=0).T).sum() == pytest.approx(508.0, abs=2.0)
    write_bag(log, tmp_path / "intel")
    assert_same_log(log, open_log(tmp_path / "intel"))


@pytest.mark.parametrize(
    ("name", "scans", "beams", "nothing", "furthest_wall"),
    [
        ("aces.clf.xz", 7374, 180, 50.0, 49.5),
        ("intel.clf.xz", 13631, 180, 81.83, 27.0),
        ("edmonton.kf.clf.xz", 340, 180, 51.1, 50.7),
        ("freiburg-101.kf.clf.xz", 292, 360, 81.83, 74.0),
    ],
)
def test_in_every_log_the_sensors_maximum_is_no_return(name, scans, beams, nothing, furthest_wall):
    log = open_log(dataset(name))
    measured = [record.measurement for record in log.records() if isinstance(record.measurement, Scan)]
    assert len(measured) == scans
    assert {scan.ranges.size for scan in measured} == {beams}
    (limit,) = {scan.range_max for scan in measured}
    assert furthest_wall - 0.5 < limit <= np.float32(nothing)
    assert {tuple(scan.laser_pose) for scan in measured} == {(0.0, 0.0, 0.0)}
