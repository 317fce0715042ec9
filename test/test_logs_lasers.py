"""A robot with two lasers, in simulation and in bags: each scan is one of its own, with its laser's place and times."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from test_logs_bag import bag_of, usual
from two_lasers import TOPICS, bag_with_two_topics

from hmt_slam_ros.cli.main import main
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.scan import SweepCheck

WORLD = "sim:office,seed=3,beams=91,lasers=2,forward=0.25"


def scans_of(log):
    return [record.measurement for record in log.records() if isinstance(record.measurement, Scan)]


@pytest.mark.parametrize("readings", [1, 2])
def test_the_second_laser_faces_back_and_scans_between(readings):
    log = open_log(f"{WORLD},readings={readings}", duration=2.0)
    scans = scans_of(log)
    assert log.scan_count == len(scans) == 22 - readings + 1
    assert [scan.laser_pose.tolist() for scan in scans[:2]] == [[0.25, 0.0, 0.0], [-0.25, 0.0, np.pi]]
    assert scans[1].stamp - scans[0].stamp == {1: 1_000, 2: 100_000_000}[readings]
    assert all(one.stamp < other.stamp for one, other in pairwise(scans))
    alone = scans_of(open_log(WORLD.replace("lasers=2", f"lasers=1,readings={readings}"), duration=2.0))
    assert [scan.ranges.tobytes() for scan in scans[::2]] == [scan.ranges.tobytes() for scan in alone]


def test_a_bag_with_a_topic_for_each_laser_is_read_as_one_robot(tmp_path):
    log = open_log(WORLD, duration=4.0)
    read = open_log(bag_with_two_topics(log, tmp_path), scan_topics=TOPICS)
    assert read.scan_count == log.scan_count
    for scan, other in zip(scans_of(read), scans_of(log), strict=True):
        assert (scan.stamp, scan.ranges.tobytes()) == (other.stamp, other.ranges.tobytes())
        np.testing.assert_allclose(scan.laser_pose, other.laser_pose, atol=1e-12)


def test_topics_that_a_bag_lacks_are_named(tmp_path):
    bag = bag_of(tmp_path / "bag", usual(scan_topic="/front"))
    with pytest.raises(HmtSlamError, match="bag has no topic /rear: choose one of /front"):
        open_log(bag, scan_topics=TOPICS)
    with pytest.raises(HmtSlamError, match=r"sensors\.scan_topics does not name 1 to 8 topics"):
        load_configuration(settings=["sensors.scan_topics= , "])


@pytest.mark.long
def test_a_robot_with_two_lasers_maps_as_well_as_with_one(tmp_path, capsys):
    bag, out = bag_with_two_topics(open_log(WORLD, duration=60.0), tmp_path), tmp_path / "out"
    assert main(["map", str(bag), "--out", str(out), "--set", f"sensors.scan_topics={TOPICS}", "--jobs", "1"]) == 0
    assert " 601 of 601 scans, 0 dropped" in capsys.readouterr().out
    assert main(["evaluate", str(out), "--truth", f"{WORLD}"]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("all"))
    assert float(row.split(")")[1].split()[1]) < 0.02  # m, mean error of relations


def test_the_sweep_of_a_laser_is_compared_with_the_time_between_its_own_scans():
    check = SweepCheck()
    poses = [np.array([0.2, 0.0, 0.0]), np.array([-0.2, 0.0, np.pi])]
    scan = Scan(0, np.ones(91, dtype=np.float32), -1.0, 0.02, 0.05, 30.0, time_increment=0.08 / 90)
    for k in range(40):
        assert check.check(replace(scan, stamp=50_000_000 * k, laser_pose=poses[k % 2]))[1] is None
    faults = [check.check(replace(scan, stamp=50_000_000 * k, laser_pose=poses[0]))[1] for k in range(41, 60)]
    assert "longer than the 0.050 s from one scan to the next" in faults[-1]
