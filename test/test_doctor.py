"""A fault planted into a simulated drive is found, and nothing else is."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from hmt_slam_ros.cli.main import main
from hmt_slam_ros.doctor.examination import log_findings
from hmt_slam_ros.doctor.frames import FrameTransform, MessageStatistics, ScanHeader, read_scan_header
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.ros_types import LASER_SCAN, typestore
from hmt_slam_ros.logs.writer import _header, write_bag
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Scan

WORLD = "sim:office,seed=3,beams=181,readings=4"
TWO_LASERS = f"{WORLD},lasers=2,forward=0.2"


class Faulty:
    """A log with other records."""

    name = "faulty"

    def __init__(self, records):
        self._records = list(records)
        self.scan_count = sum(isinstance(record.measurement, Scan) for record in self._records)
        stamps = [record.measurement.stamp for record in self._records]
        self.duration = 1e-9 * (max(stamps) - min(stamps))

    def records(self):
        return iter(self._records)


@pytest.fixture(scope="module")
def drive():
    """The records of 70 s."""
    return list(open_log(WORLD, duration=70.0).records())


def change_records(drive, *, scan=lambda scan: scan, odometry=lambda odometry: odometry):
    return Faulty(
        replace(record, measurement=scan(record.measurement) if is_scan(record) else odometry(record.measurement))
        for record in drive
    )


def is_scan(record):
    return isinstance(record.measurement, Scan)


def subjects(log, messages=None):
    """What is not fine, {subject: severity}."""
    return {one.subject: one.severity for one in log_findings(log, messages) if one.severity != "fine"}


def text_of(log, subject):
    return next(one.text for one in log_findings(log) if one.subject == subject)


def turn_laser(scan, angle, forward=0.0):
    return replace(scan, laser_pose=scan.laser_pose - np.array([forward, 0.0, angle]))


def scale_odometry(drive, *, way=1.0, turn=1.0, between=(0.0, np.inf)):
    """Odometry whose increments are scaled, all of them or those of some seconds."""
    readings = [record.measurement for record in drive if not is_scan(record)]
    seconds = 1e-9 * np.array([reading.stamp - readings[0].stamp for reading in readings[1:]])
    poses = np.array([reading.pose for reading in readings])
    steps = se2.log(se2.between(poses[:-1], poses[1:]))
    steps[(between[0] <= seconds) & (seconds <= between[1])] *= np.array([way, way, turn])
    driven = [poses[0]]
    for step in steps:
        driven.append(se2.compose(driven[-1], se2.exp(step)))
    poses = iter(driven)
    return change_records(drive, odometry=lambda reading: replace(reading, pose=next(poses)))


def drop_records(drive, dropped):
    """Without the records of which a condition on seconds since the first and the record holds."""
    first = drive[0].measurement.stamp
    return Faulty(record for record in drive if not dropped(1e-9 * (record.measurement.stamp - first), record))


def test_in_a_sound_log_nothing_is_wrong(drive):
    assert subjects(Faulty(drive)) == {}


@pytest.mark.parametrize("seed", (1, 2))
def test_nor_in_another_world_with_people_and_a_laser_ahead(seed):
    log = open_log(f"sim:busy,seed={seed},forward=0.3,beams=181,rate=8", duration=60.0)
    assert subjects(log) == {}


@pytest.mark.parametrize("seed", (0, 1))
def test_where_the_laser_reaches_nothing_only_that_is_reported(seed):
    log = open_log(f"sim:hall,seed={seed},beams=181", duration=60.0)
    assert subjects(log) == {"few returns": "wrong"}


def test_a_laser_that_is_turned_is_found_with_the_angle(drive):
    log = change_records(drive, scan=lambda scan: turn_laser(scan, math.radians(12.0)))
    assert subjects(log) == {"laser yaw": "wrong"}
    assert "turned by 12" in text_of(log, "laser yaw") or "turned by 11" in text_of(log, "laser yaw")
    assert "to the left" in text_of(log, "laser yaw")


def test_a_laser_that_looks_backwards_is_found(drive):
    assert subjects(change_records(drive, scan=lambda scan: turn_laser(scan, math.pi))) == {"laser backwards": "wrong"}


def test_a_laser_that_is_somewhere_else_is_found_with_the_place(drive):
    log = change_records(drive, scan=lambda scan: turn_laser(scan, 0.0, -0.4))
    assert subjects(log) == {"laser place": "wrong"}
    forward = float(text_of(log, "laser place").split()[3])
    assert forward == pytest.approx(-0.4, abs=0.05)


def test_a_mirrored_laser_is_found(drive):
    log = change_records(drive, scan=lambda scan: replace(scan, ranges=np.ascontiguousarray(scan.ranges[::-1])))
    assert subjects(log) == {"mirrored": "wrong"}


@pytest.mark.parametrize(("scale", "severity"), ((1.15, "doubtful"), (0.8, "wrong")))
def test_odometry_with_a_wrong_scale_of_ways_is_found(drive, scale, severity):
    log = scale_odometry(drive, way=scale)
    assert subjects(log) == {"translation scale": severity}
    assert float(text_of(log, "translation scale").split()[3]) == pytest.approx(scale, abs=0.03)


def test_odometry_with_a_wrong_scale_of_turns_is_found(drive):
    log = scale_odometry(drive, turn=1.25)
    assert subjects(log) == {"rotation scale": "wrong"}
    assert float(text_of(log, "rotation scale").split()[3]) == pytest.approx(1.25, abs=0.03)


@pytest.mark.parametrize("offset", (0.2, -0.2))
def test_clocks_that_are_apart_are_found_with_the_time(drive, offset):
    def late(record):
        if not is_scan(record):
            return record
        stamp = record.measurement.stamp + round(offset * 1e9)
        return LogRecord(stamp, replace(record.measurement, stamp=stamp))

    records = sorted(map(late, drive), key=lambda record: record.measurement.stamp)
    log = Faulty(records)
    assert subjects(log) == {"clock offset": "wrong"}
    text = text_of(log, "clock offset")
    assert f" s {'late' if offset > 0.0 else 'early'} against" in text
    # The noise of simulated odometry is drawn from scan to scan, and so says when they were.
    assert float(text.split()[4]) == pytest.approx(0.2, abs=0.05)


def test_odometry_that_drops_out_is_found(drive):
    log = drop_records(drive, lambda seconds, record: not is_scan(record) and 20.0 < seconds < 24.0)
    assert subjects(log) == {"odometry gaps": "doubtful", "scans without odometry": "wrong"}


def test_odometry_that_stands_still_while_the_robot_drives_is_found(drive):
    log = scale_odometry(drive, way=0.0, turn=0.0, between=(20.0, 32.0))
    assert subjects(log) == {"odometry frozen": "wrong"}


def turn_start(drive):
    """The time at which the robot turns at 20 degrees/s for the first time, s after the first reading."""
    readings = [record.measurement for record in drive if not is_scan(record)]
    seconds = 1e-9 * np.array([reading.stamp - readings[0].stamp for reading in readings])
    heading = np.unwrap([reading.pose[2] for reading in readings])
    rates = np.abs(np.interp(seconds + 0.5, seconds, heading) - np.interp(seconds - 0.5, seconds, heading))
    return seconds[np.argmax((rates > math.radians(20.0)) & (seconds > 5.0))]


def repeat_readings(drive, begin, seconds):
    """Readings that repeat from a time on, and then go on at the true place."""
    readings = [record.measurement for record in drive if not is_scan(record)]
    first = readings[0].stamp
    stuck = next(reading.pose for reading in readings if 1e-9 * (reading.stamp - first) >= begin)
    return change_records(
        drive,
        odometry=lambda reading: (
            replace(reading, pose=stuck) if begin <= 1e-9 * (reading.stamp - first) < begin + seconds else reading
        ),
    )


def numbers_after(text, words):
    """The first number after some words of a text."""
    return float(text.partition(words)[2].split()[0])


@pytest.mark.parametrize("seconds", (1.0, 2.0))
def test_a_single_freeze_in_a_turn_is_named_with_time_duration_and_motion(drive, seconds):
    begin = turn_start(drive)
    log = repeat_readings(drive, begin, seconds)
    assert subjects(log) == {"odometry frozen": "doubtful"}
    text = text_of(log, "odometry frozen")
    assert "stands still once" in text
    assert numbers_after(text, "the longest time for") == pytest.approx(seconds, abs=0.3)
    assert numbers_after(text, "s, ") == pytest.approx(begin, abs=0.3)
    assert abs(numbers_after(text, "turned by")) > 15.0


def test_a_robot_that_stands_has_no_frozen_odometry(drive):
    """In the middle of the drive it stands for 10 s, in which readings and scans repeat."""
    middle = len(drive) // 2
    stamp = drive[middle].measurement.stamp
    last_scan = next(record for record in reversed(drive[:middle]) if is_scan(record))
    last_reading = next(record for record in reversed(drive[:middle]) if not is_scan(record))
    random, standing = np.random.default_rng(0), []
    for k in range(1, 200):
        now = stamp + k * 50_000_000
        standing.append(LogRecord(now, replace(last_reading.measurement, stamp=now)))
        if k % 4 == 0:
            noise = 0.015 * random.standard_normal(last_scan.measurement.ranges.size).astype(np.float32)
            scan = replace(last_scan.measurement, stamp=now, ranges=last_scan.measurement.ranges + noise)
            standing.append(LogRecord(now, scan))
    later = [
        LogRecord(r.source_stamp + 10**10, replace(r.measurement, stamp=r.measurement.stamp + 10**10))
        for r in drive[middle:]
    ]
    assert subjects(Faulty([*drive[:middle], *standing, *later])) == {}


@pytest.mark.parametrize(("step", "turn"), ((0.6, 0.0), (0.0, 40.0)))
def test_a_small_jump_of_the_odometry_is_named_with_time_and_size(drive, step, turn):
    readings = [record.measurement for record in drive if not is_scan(record)]
    begin, at = readings[0].stamp, readings[600]
    jump = np.array([step, 0.0, math.radians(turn)])
    log = change_records(
        drive,
        odometry=lambda reading: (
            replace(reading, pose=se2.compose(se2.compose(at.pose, jump), se2.between(at.pose, reading.pose)))
            if reading.stamp > at.stamp
            else reading
        ),
    )
    assert subjects(log) == {"odometry jumps": "wrong"}
    text = text_of(log, "odometry jumps")
    assert "jumps once" in text
    assert numbers_after(text, "farthest by") == pytest.approx(step, abs=0.1)
    assert numbers_after(text, " m and") == pytest.approx(turn, abs=3.0)
    assert numbers_after(text, "degrees, ") == pytest.approx(1e-9 * (at.stamp - begin), abs=0.2)


def test_readings_that_come_in_batches_are_named_with_the_pause(drive):
    """Of 10 s the readings are held for 0.8 s each."""
    first, held = drive[0].measurement.stamp, 800_000_000

    def arrival(record):
        since = record.measurement.stamp - first
        if is_scan(record) or not 30 * 10**9 <= since < 40 * 10**9:
            return record.measurement.stamp
        batch = -(-since // held) * held
        return first + batch - (batch - since) // 1000

    records = [replace(r, measurement=replace(r.measurement, stamp=arrival(r))) for r in drive]
    log = Faulty(sorted(records, key=lambda record: record.measurement.stamp))
    found = subjects(log)
    assert found["odometry batches"] == "wrong"
    assert not found.keys() & {"odometry frozen", "odometry jumps"}
    text = text_of(log, "odometry batches")
    assert numbers_after(text, "in batches") == pytest.approx(12, abs=1)
    assert numbers_after(text, "pause takes") == pytest.approx(0.8, abs=0.06)


def test_wheels_that_slip_are_found():
    log = open_log(WORLD + ",slips=100", duration=70.0)
    assert subjects(log) == {"slip": "doubtful"}


def test_odometry_that_was_reset_is_found(drive):
    first = drive[0].measurement.stamp
    log = change_records(
        drive,
        odometry=lambda reading: (
            replace(reading, pose=reading.pose + np.array([9.0, 0.0, 0.0]))
            if reading.stamp - first > 30 * 10**9
            else reading
        ),
    )
    assert subjects(log) == {"odometry jumps": "wrong"}


def test_odometry_that_is_no_number_and_scans_without_beams_do_not_disturb(drive):
    second = drive[0].measurement.stamp + 10**9
    log = change_records(
        drive,
        scan=lambda scan: replace(scan, ranges=scan.ranges[:0]) if scan.stamp < second else scan,
        odometry=lambda reading: replace(reading, pose=np.full(3, np.nan)) if reading.stamp == second else reading,
    )
    assert subjects(log) == {"odometry not finite": "wrong"}


def test_missing_scans_are_found(drive):
    log = drop_records(drive, lambda seconds, record: is_scan(record) and 20.0 < seconds < 23.0)
    assert subjects(log) == {"scan gaps": "doubtful"}


def test_scans_that_are_too_far_apart_are_found(drive):
    log = drop_records(drive, lambda seconds, record: is_scan(record) and seconds % 3.0 > 0.1)
    assert subjects(log) == {"sparse scans": "doubtful"}


def with_ranges(drive, change):
    random = np.random.default_rng(0)

    def spoil_ranges(scan):
        ranges = scan.ranges.copy()
        change(ranges, random)
        return replace(scan, ranges=ranges)

    return change_records(drive, scan=spoil_ranges)


@pytest.mark.parametrize(
    ("value", "share", "expected"),
    ((np.nan, 0.15, {"NaN ranges": "doubtful"}), (0.0, 0.4, {"ranges below range_min": "wrong"})),
)
def test_ranges_that_are_none_are_found(drive, value, share, expected):
    def spoil(ranges, random):
        ranges[random.random(ranges.size) < share] = value

    assert subjects(with_ranges(drive, spoil)) == expected


def test_a_laser_that_hardly_sees_anything_is_found(drive):
    def spoil(ranges, random):
        ranges[random.random(ranges.size) < 0.95] = np.inf

    assert subjects(with_ranges(drive, spoil)) == {"few returns": "wrong"}


def test_beams_that_see_the_robot_are_found(drive):
    def spoil(ranges, random):
        ranges[3:9] = 0.31 + 0.01 * random.standard_normal(6)

    log = with_ranges(drive, spoil)
    assert subjects(log) == {"beams on the robot": "doubtful"}
    assert "6 beams, from number 3 to 8" in text_of(log, "beams on the robot")


@pytest.mark.parametrize(
    ("change", "subject"),
    (
        ({"range_max": 0.01}, "range limits"),
        ({"angle_increment": 0.0}, "beam angles"),
        ({"angle_increment": math.radians(3.0)}, "beam angles"),
        ({"time_increment": 0.05}, "time_increment"),
    ),
)
def test_scans_that_cannot_be_are_found(drive, change, subject):
    found = subjects(change_records(drive[:200], scan=lambda scan: replace(scan, **change)))
    assert found[subject] == "wrong"


def test_stamps_that_jump_back_or_stay_are_found(drive):
    sources = [record.source_stamp for record in drive]
    scans = [k for k, record in enumerate(drive) if is_scan(record)]
    sources[scans[50]] -= 3 * 10**8
    sources[scans[80]] = sources[scans[79]]
    log = Faulty(LogRecord(source, record.measurement) for source, record in zip(sources, drive, strict=True))
    assert subjects(log) == {"scan stamps jump back": "doubtful", "scan stamps equal": "doubtful"}
    assert "once, by up to 0.100 s" in text_of(log, "scan stamps jump back")


def test_a_robot_that_stands_is_not_scored(drive):
    scan = next(record.measurement for record in drive if is_scan(record))
    log = change_records(
        drive[:400],
        scan=lambda other: replace(scan, stamp=other.stamp),
        odometry=lambda reading: replace(reading, pose=np.zeros(3)),
    )
    assert subjects(log) == {}
    assert "hardly moved" in text_of(log, "translation not judged")


def joint(parent, child, *, topic="/tf_static", roll=0.0, moved=0.0):
    pose = np.eye(4)
    pose[1:3, 1:3] = [[math.cos(roll), -math.sin(roll)], [math.sin(roll), math.cos(roll)]]
    return FrameTransform(parent, child, topic, pose, 1, moved)


LASER, WHEELS = joint("base_link", "laser"), joint("odom", "base_link", topic="/tf", moved=9.0)
HEAD = ScanHeader("laser", -1.0, 1.0, 0.02, 101)


@pytest.mark.parametrize(
    ("expected", "changes"),
    (
        ({}, {}),
        ({}, {"transforms": (joint("base_link", "laser", roll=math.pi), WHEELS)}),
        ({"tilted": "doubtful"}, {"transforms": (joint("base_link", "laser", roll=math.radians(5.0)), WHEELS)}),
        ({"two parents": "wrong"}, {"transforms": (LASER, WHEELS, joint("map", "base_link"))}),
        ({"static transform moves": "doubtful"}, {"transforms": (joint("base_link", "laser", moved=0.1), WHEELS)}),
        ({"map -> odom": "doubtful"}, {"transforms": (LASER, WHEELS, joint("map", "odom", topic="/tf"))}),
        ({"frames contradict": "wrong"}, {"odometry_frames": ("wheel_odom", "base_link")}),
        ({}, {"transforms": (LASER, WHEELS, joint("base_link", "foot")), "odometry_frames": ("odom", "foot")}),
        ({"odometry frames": "doubtful"}, {"odometry_frames": ("odom", "")}),
        ({"odometry frames": "doubtful"}, {"odometry_frames": ("map", "base_link")}),
        ({"scan frame": "wrong"}, {"scan_headers": {HEAD._replace(frame=""): 3}}),
        ({"angle_max": "doubtful"}, {"scan_headers": {HEAD: 3, HEAD._replace(angle_max=1.02): 2}}),
        ({}, {"scan_headers": {HEAD._replace(angle_max=1.002): 2}}),
    ),
)
def test_frames_and_stated_angles_that_do_not_fit_are_found(drive, expected, changes):
    sound = MessageStatistics({}, {}, {HEAD: 3}, ("odom", "base_link"), (LASER, WHEELS))
    assert subjects(Faulty(drive[:300]), replace(sound, **changes)) == expected


@pytest.mark.parametrize("frame", ("laser", "a", "base_laser_2"))
def test_what_a_scan_says_of_itself_is_read_without_its_ranges(frame):
    count = 7
    message = typestore().types[LASER_SCAN](
        header=_header(5, frame),
        angle_min=-1.5,
        angle_max=1.5,
        angle_increment=0.5,
        time_increment=0.0,
        scan_time=0.0,
        range_min=0.1,
        range_max=9.0,
        ranges=np.ones(count, np.float32),
        intensities=np.zeros(0, np.float32),
    )
    content = bytes(typestore().serialize_cdr(message, LASER_SCAN))
    assert read_scan_header(content) == ScanHeader(frame, -1.5, 1.5, 0.5, count)


def test_the_command_says_what_is_wrong_and_returns_it(drive, tmp_path, capsys):
    log = change_records(drive, scan=lambda scan: turn_laser(scan, math.radians(12.0)))
    write_bag(log, tmp_path / "bag")
    assert main(["doctor", str(tmp_path / "bag")]) == 1
    sent = capsys.readouterr().out.splitlines()
    assert sent[0].startswith("wrong    laser yaw: The laser is turned by 1")
    assert sent[-1].startswith("1 wrong, 0 doubtful, ")
    assert any("Odometry is odom -> base_link, scans are in laser." in line for line in sent)
    assert main(["doctor", "--json", str(tmp_path / "bag")]) == 1
    found = json.loads(capsys.readouterr().out)["findings"]
    assert [one["subject"] for one in found if one["severity"] == "wrong"] == ["laser yaw"]
    assert main(["doctor", "data/malaga_one_loop"]) == 0


@pytest.mark.parametrize("arguments", ((), ("--live", "sim:office"), ("nowhere",)))
def test_the_command_refuses_what_it_cannot_examine(arguments, capsys):
    assert main(["doctor", *arguments]) == 2
    assert capsys.readouterr().err.startswith("hmt_slam doctor: ")


@pytest.fixture(scope="module")
def two_lasers():
    """The records of 70 s of a robot with a front and a rear laser."""
    return list(open_log(TWO_LASERS, duration=70.0).records())


def move_rear_laser(drive, offset):
    """The stated mounting of the rear laser is off."""

    def state(scan):
        is_rear = abs(scan.laser_pose[2]) > 1.0
        return replace(scan, laser_pose=se2.compose(scan.laser_pose, np.array(offset))) if is_rear else scan

    return change_records(drive, scan=state)


def test_two_lasers_at_their_mountings_see_the_same_surfaces(two_lasers):
    assert subjects(Faulty(two_lasers)) == {}
    names = "The laser at (-0.20 m, 0.00 m, 180 degrees) and the laser at (0.20 m, 0.00 m, 0 degrees) see the same"
    assert text_of(Faulty(two_lasers), "two lasers") == f"{names} surfaces in the same places."
    rates = [one.text for one in log_findings(Faulty(two_lasers)) if one.subject == "contents"]
    assert [" scans at 5.0 Hz" in text for text in rates] == [True, True]


@pytest.mark.parametrize(
    ("offset", "severity", "sentence"),
    [
        ((0.0, 0.3, 0.0), "wrong", "0.30 m and 0.1 degrees apart"),
        ((0.0, 0.0, math.radians(4.0)), "doubtful", "0.04 m and 3.8 degrees apart"),
        ((0.0, 0.0, math.radians(12.0)), "wrong", "degrees apart: measure their mountings anew"),
    ],
)
def test_two_lasers_one_of_which_is_elsewhere_contradict_each_other(two_lasers, offset, severity, sentence):
    log = move_rear_laser(two_lasers, offset)
    assert subjects(log)["two lasers"] == severity
    assert sentence in text_of(log, "two lasers")
    assert re.search(r"the first one is at \(-0\.2\d m, -?0\.0\d m, -?1(80|79) degrees\)", text_of(log, "two lasers"))


def test_a_laser_that_sees_the_robot_is_named_among_two(two_lasers):
    def block(scan):
        return replace(scan, ranges=with_body(scan.ranges)) if abs(scan.laser_pose[2]) > 1.0 else scan

    def with_body(ranges):
        return np.where(np.arange(ranges.size) < 20, np.float32(0.3), ranges)

    text = text_of(change_records(two_lasers, scan=block), "beams on the robot")
    assert text.startswith("Of the laser at (-0.20 m, 0.00 m, 180 degrees): 20 beams, from number 0 to 19")
