"""The running clock and the exact conversion between seconds and nanoseconds."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.logs.records import InMemoryLog, LogEntry, TimeWindow
from hmt_slam_ros.logs.stamps import running_stamps, seconds_from_stamp, stamp_from_seconds
from hmt_slam_ros.sensors import Odometry, Scan


@pytest.mark.parametrize(
    ("text", "stamp"),
    [
        ("976052857.337284", 976_052_857_337_284_000),
        ("0", 0),
        ("12.", 12_000_000_000),
        ("1.4e3", 1_400_000_000_000),
        ("-0.5", -500_000_000),
        ("1.0000000009", 1_000_000_000),
    ],
)
def test_seconds_become_exact_nanoseconds(text, stamp):
    assert stamp_from_seconds(text) == stamp


@pytest.mark.parametrize("text", ["", "nohost", "nan", "inf", "1.2.3", "1,5", "1e12", "1e999999"])
def test_text_that_is_no_time_is_refused(text):
    with pytest.raises(ValueError, match="no time in seconds"):
        stamp_from_seconds(text)


@given(st.integers(min_value=-(2**62), max_value=2**62))
def test_any_stamp_survives_the_way_through_text(stamp):
    assert stamp_from_seconds(seconds_from_stamp(stamp)) == stamp


def test_stamps_that_advance_are_kept():
    assert running_stamps([0, 10_000, 20_000], [False, True, True], [False] * 3).tolist() == [0, 10_000, 20_000]


def test_where_the_source_jumps_back_each_kind_advances_by_a_microsecond():
    sources = [100_000, 100_000, 50_000, 60_000, 70_000, 103_500]
    is_scan = [False, True, True, False, True, False]
    #          odometry, scan (equal allowed), scan +1, odometry (last stamp), scan +1, source again
    expected = [100_000, 100_000, 101_000, 101_000, 102_000, 103_500]
    assert running_stamps(sources, is_scan, [False] * 6).tolist() == expected


def test_odometry_that_belongs_to_a_scan_has_exactly_its_stamp():
    sources = [5_000, 5_000, 5_000, 5_000, 4_000, 4_000]
    is_scan = [False, True] * 3
    stamps = running_stamps(sources, is_scan, [True, False] * 3).tolist()
    assert stamps == [5_000, 5_000, 6_000, 6_000, 7_000, 7_000]


@given(st.lists(st.tuples(st.integers(0, 20_000), st.sampled_from(["odometry", "scan", "pair"])), max_size=30))
def test_the_clock_never_runs_back_and_advances_within_each_kind(readings):
    sources, is_scan, paired = [], [], []
    for source, kind in readings:
        sources += [source] * (2 if kind == "pair" else 1)
        is_scan += {"odometry": [False], "scan": [True], "pair": [False, True]}[kind]
        paired += {"odometry": [False], "scan": [False], "pair": [True, False]}[kind]
    stamps = running_stamps(sources, is_scan, paired).tolist()
    assert all(a <= b for a, b in pairwise(stamps))
    assert all(stamp >= source for stamp, source in zip(stamps, sources, strict=True))
    for wanted in (True, False):
        of_kind = [stamp for stamp, scan in zip(stamps, is_scan, strict=True) if scan is wanted]
        assert all(a < b for a, b in pairwise(of_kind))
    assert all(stamps[k] == stamps[k + 1] for k, pair in enumerate(paired) if pair)


def _entries(seconds):
    for second in seconds:
        yield LogEntry(second * 10**9, Odometry, (np.zeros(3),), precedes_its_scan=True)
        yield LogEntry(second * 10**9, Scan, (np.ones(2, dtype=np.float32), 0.0, 0.1, 0.0, 5.0))


def test_a_part_of_a_log_has_the_stamps_of_the_whole():
    entries = list(_entries([10, 11, 9, 13, 14]))
    whole = [record.measurement.stamp for record in InMemoryLog("log", entries, TimeWindow()).records()]
    part = InMemoryLog("log", entries, TimeWindow(start=1.0, duration=2.0))
    assert [record.measurement.stamp for record in part.records()] == whole[2:8]
    assert (part.scan_count, part.duration) == (3, 2.0)
    assert whole[4:6] == [11 * 10**9 + 1000] * 2


def test_a_part_without_scans_is_refused():
    with pytest.raises(HmtSlamError, match="chosen by start and duration"):
        InMemoryLog("log", list(_entries([10, 20])), TimeWindow(start=2.0, duration=3.0))


@pytest.mark.parametrize("window", [{"start": -1.0}, {"start": float("nan")}, {"duration": 0.0}])
def test_an_impossible_part_is_refused(window):
    with pytest.raises(HmtSlamError, match=r"start is|duration is"):
        TimeWindow(**window)
