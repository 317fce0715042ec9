"""Metric SLAM where odometry is wrong, silent or missing."""

import re
from dataclasses import replace

import numpy as np
import pytest
from test_metric_slam import WALLS, Dialogue
from test_submap_scan_matcher import with_niches
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.messages import EndOfLog, Keyframe, LocalEstimate, Notice
from hmt_slam_ros.sensors import Odometry

SECOND = 10**9


def turning_drive(rate, seconds=24.0):
    """(stamp, true pose, scan) at ``rate`` Hz: 6 s ahead and then a quarter turn within 3 s, again and again."""
    step, poses = 1.0 / rate, [np.zeros(3)]
    for k in range(1, int(seconds * rate)):
        ahead = (k * step) % 9.0 < 6.0
        twist = np.array([0.4, 0.0, 0.0]) if ahead else np.array([0.1, 0.0, np.radians(30.0)])
        poses.append(se2.compose(poses[-1], se2.exp(step * twist)))
    for k, pose in enumerate(poses):
        stamp = SECOND + round(k * step * SECOND)
        yield stamp, pose, scan_in(WALLS, pose, stamp=stamp, noise=0.01, seed=k)


def errors(dialogue, truths):
    """Largest distance, m, and angle, degrees, of any estimate from the truth."""
    poses = np.array([estimate.pose.mean for estimate in dialogue.messages_of(LocalEstimate)])
    difference = se2.between(np.array(truths), poses)
    return np.hypot(*difference[:, :2].T).max(), np.degrees(np.abs(difference[:, 2])).max()


@pytest.mark.parametrize("rate", [1.0, 5.0])
@pytest.mark.parametrize("slip", [-40.0, 40.0])
def test_a_slip_in_a_turn_does_not_lose_the_robot_and_is_reported_once(rate, slip):
    dialogue, truths = Dialogue(), []
    odometry, before = np.zeros(3), np.zeros(3)
    for stamp, pose, scan in turning_drive(rate):
        slipped = np.radians(slip) * np.array([0.0, 0.0, 1.0 / rate]) * (7.0 < stamp / SECOND - 1.0 <= 8.0)
        odometry = se2.compose(odometry, se2.compose(se2.between(before, pose), slipped))
        before = pose
        dialogue.send(Odometry(stamp, odometry), scan)
        truths.append(pose)
    dialogue.send(EndOfLog())
    distance, angle = errors(dialogue, truths)
    assert distance < 0.08
    assert angle < 1.5
    (notice,) = (notice for notice in dialogue.messages_of(Notice) if "the scans are believed" in notice.text)
    by_odometry, by_scans = map(float, re.findall(r"turned by (-?\d+) degrees", notice.text))
    assert by_odometry - by_scans == pytest.approx(slip, abs=6.0)
    begin, end = map(float, re.search(r"from ([\d.]+) s to ([\d.]+) s", notice.text).groups())
    assert 8.0 <= begin < end <= 9.5


def test_in_a_bare_corridor_odometry_that_repeats_and_catches_up_is_taken_as_steady_motion():
    corridor = box(-100.0, -1.2, 100.0, 1.2)
    dialogue, truths = Dialogue(), []
    for k in range(60):
        pose, stamp = np.array([0.16 * k, 0.0, 0.0]), SECOND + k * SECOND // 5
        shown = truths[30] if 30 < k <= 35 else pose
        dialogue.send(Odometry(stamp, shown), scan_in(corridor, pose, stamp=stamp, noise=0.01, seed=k))
        truths.append(pose)
    dialogue.send(EndOfLog())
    assert errors(dialogue, truths)[0] < 0.1
    (notice,) = (notice for notice in dialogue.messages_of(Notice) if "fell behind the robot" in notice.text)
    assert "for 1.00 s at 7.2" in notice.text


@pytest.mark.parametrize("rate", [1.0, 2.0, 5.0, 10.0])
def test_without_odometry_the_robot_is_tracked_from_its_first_scan_on(rate):
    dialogue, truths = Dialogue(), []
    for _, pose, scan in turning_drive(rate):
        dialogue.send(scan)
        truths.append(pose)
    dialogue.send(EndOfLog())
    assert len(dialogue.messages_of(LocalEstimate)) == len(truths)
    distance, angle = errors(dialogue, truths)
    assert distance < 0.08
    assert angle < 1.5
    (notice,) = dialogue.messages_of(Notice)
    assert "wait for odometry" in notice.text


def test_without_odometry_no_scan_waits_once_patience_is_lost():
    dialogue = Dialogue()
    for k, (_, _, scan) in enumerate(turning_drive(5.0)):
        dialogue.send(scan)
        waited = dialogue.slam.queued_scans
        assert waited == (k + 1 if k < 15 else 0)


def test_odometry_that_falls_silent_and_comes_back_is_used_again():
    dialogue, truths = Dialogue(), []
    for k, (stamp, pose, scan) in enumerate(turning_drive(5.0)):
        messages = [scan] if 30 <= k < 70 else [Odometry(stamp, pose), scan]
        dialogue.send(*messages)
        truths.append(pose)
    dialogue.send(EndOfLog())
    distance, angle = errors(dialogue, truths)
    assert distance < 0.08
    assert angle < 1.5
    assert len(dialogue.messages_of(LocalEstimate)) == len(truths)


def test_readings_that_are_missing_here_and_there_are_bridged():
    random = np.random.default_rng(0)
    dialogue, truths = Dialogue(), []
    for stamp, pose, scan in turning_drive(5.0):
        dialogue.send(*([scan] if random.random() < 0.3 else [Odometry(stamp, pose), scan]))
        truths.append(pose)
    dialogue.send(EndOfLog())
    distance, angle = errors(dialogue, truths)
    assert distance < 0.08
    assert angle < 1.5
    assert not dialogue.messages_of(Notice)


def test_noise_beyond_the_model_is_learnt_and_reported_once():
    random = np.random.default_rng(0)
    dialogue, truths = Dialogue(), []
    odometry, before = np.zeros(3), np.zeros(3)
    for stamp, pose, scan in turning_drive(5.0, seconds=60.0):
        error = np.array([0.08, 0.08, np.radians(4.0)]) * random.standard_normal(3)
        odometry = se2.compose(odometry, se2.compose(se2.between(before, pose), error))
        before = pose
        dialogue.send(Odometry(stamp, odometry), scan)
        truths.append(pose)
    dialogue.send(EndOfLog())
    distance, angle = errors(dialogue, truths)
    assert distance < 0.1
    assert angle < 2.0
    assert len([notice for notice in dialogue.messages_of(Notice) if "noise model" in notice.text]) == 1


@pytest.mark.parametrize("seed", range(3))
def test_without_odometry_a_robot_that_sets_off_along_a_corridor_is_followed(seed):
    walls, dialogue, truths = with_niches(seed), Dialogue(), []
    speeds = np.concatenate((np.zeros(15), np.arange(0.0, 0.6, 0.15), np.full(60, 0.6)))
    for k, x in enumerate(0.2 * np.cumsum(speeds)):
        truths.append(np.array([x, 0.0, 0.0]))
        dialogue.send(scan_in(walls, truths[-1], stamp=SECOND + k * SECOND // 5, noise=0.01, seed=k))
    dialogue.send(EndOfLog())
    distance, angle = errors(dialogue, truths)
    assert distance < 0.3
    assert angle < 1.5


def keyframe_conditions(dialogue):
    """{stamp of a keyframe, s: condition of the motion to it}."""
    return {k.scan.stamp / SECOND: k.motion_condition for k in dialogue.messages_of(Keyframe)}


def drive_with(change, count=80):
    """The conditions over a straight drive of which ``change(k, stamp, odometry, scan)`` gives the messages."""
    dialogue = Dialogue()
    for k in range(count):
        pose, stamp = np.array([0.1 * k, 0.0, 0.0]), SECOND + k * SECOND // 10
        scan = scan_in(WALLS, pose, stamp=stamp, noise=0.01, seed=k)
        dialogue.send(*change(k, stamp, pose, scan))
    dialogue.send(EndOfLog())
    return keyframe_conditions(dialogue)


def test_an_ordinary_motion_is_one_that_scans_and_odometry_show():
    found = drive_with(lambda _k, stamp, pose, scan: [Odometry(stamp, pose), scan])
    assert len(found) > 12
    assert set(found.values()) == {"ordinary"}


@pytest.mark.parametrize(("missing", "condition"), [(8, "ordinary"), (15, "after_gap")])
def test_the_first_keyframe_after_scans_were_missing_for_a_while_says_so(missing, condition):
    absent = range(40, 40 + missing)
    found = drive_with(lambda k, stamp, pose, scan: [Odometry(stamp, pose), *([] if k in absent else [scan])])
    first = min(stamp for stamp in found if stamp >= 5.0 + 0.1 * missing)
    assert found.pop(first) == condition
    assert set(found.values()) == {"ordinary"}


def test_a_clock_that_goes_back_is_a_gap():
    def go_back(k, stamp, pose, scan):
        stamp -= 2 * SECOND * (k >= 40)
        return [Odometry(stamp, pose), replace(scan, stamp=stamp)]

    found = list(drive_with(go_back).values())
    assert found.count("after_gap") == 1
    assert set(found) == {"ordinary", "after_gap"}


def test_a_motion_that_scans_contradict_is_uncertain():
    def slip(k, stamp, pose, scan):
        return [Odometry(stamp, pose + np.array([0.0, 0.0, 0.7 * (k >= 40)])), scan]

    found = drive_with(slip)
    uncertain = [stamp for stamp, condition in found.items() if condition == "uncertain"]
    assert uncertain
    assert all(4.9 < stamp < 6.0 for stamp in uncertain)
    assert found[max(found)] == "ordinary"


def test_a_motion_that_neither_scans_nor_odometry_show_is_uncertain():
    def blind(k, stamp, pose, scan):
        if 40 <= k < 60:
            return [replace(scan, ranges=np.full_like(scan.ranges, np.inf))]
        return [Odometry(stamp, pose), scan]

    found = drive_with(blind)
    assert "uncertain" in {condition for stamp, condition in found.items() if 5.0 <= stamp < 7.5}
    assert found[max(found)] == "ordinary"
