"""Scans of several topics pass in the order of their stamps, and none waits for a silent laser."""

import numpy as np
import pytest

from hmt_slam_ros.sensors import Scan

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from hmt_slam_ros.ros.scan_merge import ScanMerge

MS = 1_000_000


def scan(milliseconds):
    return Scan(milliseconds * MS, np.ones(3, dtype=np.float32), -1.0, 1.0, 0.05, 30.0)


def stamps_passed(merge, *arrivals):
    """Stamps in ms of the scans that pass at each arrival (topic, ms); None for one that came too late."""
    due = [merge.push(topic, scan(stamp)) for topic, stamp in arrivals]
    return [None if scans is None else [one.stamp / MS for one in scans] for scans in due]


def test_the_scans_of_one_topic_pass_as_they_come():
    assert stamps_passed(ScanMerge(["scan"]), ("scan", 100), ("scan", 50), ("scan", 200)) == [[100], [50], [200]]


def test_scans_pass_in_the_order_of_their_stamps():
    merge = ScanMerge(["front", "rear"])
    # Nobody knows yet whether the other laser scans.
    assert stamps_passed(merge, ("front", 100)) == [[100]]
    assert stamps_passed(merge, ("rear", 150), ("rear", 250), ("front", 200), ("front", 300)) == [
        [],
        [],
        [150, 200],
        [250],
    ]
    assert merge.waiting_count == 1


def test_of_two_scans_at_one_time_the_second_is_stamped_later():
    merge = ScanMerge(["front", "rear"], newest_stamp=0)
    assert stamps_passed(merge, ("front", 100), ("rear", 100), ("front", 200)) == [[100], [100.001], []]
    assert stamps_passed(merge, ("rear", 200), ("rear", 300), ("front", 300)) == [[200, 200.001], [], [300, 300.001]]


def test_a_silent_laser_is_not_waited_for_and_too_late_scans_are_left_out():
    merge = ScanMerge(["front", "rear"])
    stamps_passed(merge, ("front", 0), ("rear", 50))
    assert stamps_passed(merge, *(("front", stamp) for stamp in range(100, 800, 100))) == [
        [50],
        [],
        [],
        [],
        [],
        [100, 200, 300, 400, 500, 600],
        [700],
    ]
    assert stamps_passed(merge, ("rear", 650), ("rear", 750), ("front", 800)) == [None, [], [750]]


def test_when_time_goes_back_what_waits_passes_first():
    merge = ScanMerge(["front", "rear"])
    stamps_passed(merge, ("front", 10_000), ("rear", 10_050), ("front", 10_100))
    assert merge.waiting_count == 1
    assert stamps_passed(merge, ("front", 100), ("rear", 150), ("front", 200)) == [[10_100, 100], [], [150]]
