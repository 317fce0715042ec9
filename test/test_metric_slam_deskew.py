"""Metric SLAM with a laser whose sweep takes as long as the time from one scan to the next."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from test_metric_slam import SECOND, Dialogue
from worlds import box, scan_in

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.occupancy_map import OCCUPIED, occupancy_image
from hmt_slam_ros.messages.messages import EndOfLog, Keyframe, LocalEstimate, Notice
from hmt_slam_ros.sensors import Odometry

WALLS = np.concatenate(
    (
        box(-6.02, -5.03, 8.03, 5.01),
        box(2.01, 2.52, 3.03, 3.52),
        box(-3.02, -3.51, -1.52, -2.49),
        box(5.3, -4.0, 6.1, -2.2),
        [[-2.02, 5.01, -2.02, 3.2]],
    )
)
BEAMS, PERIOD, ODOMETRY_PERIOD = 361, 0.1, 0.02
SCANS = 160


def true_pose(seconds):
    """``world_T_base`` (n, 3) on a round of straight meters and quarter circles, each of one second."""
    corners = [np.zeros(3)]
    for second in range(SCANS // 10 + 1):
        corners.append(se2.compose(corners[-1], se2.exp(twist(second))))
    whole = np.floor(seconds).astype(int)
    part = np.asarray(seconds) - whole
    return se2.compose(np.array(corners)[whole], se2.exp(part[..., None] * np.array([twist(s) for s in whole.flat])))


def twist(second):
    """1 m/s, and in every other second 90 degrees a second."""
    return np.array([1.0, 0.0, np.pi / 2 if second % 2 else 0.0])


def readings():
    """Odometry with noise of two percent on every increment."""
    stamps = np.arange(0.0, SCANS * PERIOD + 1e-9, ODOMETRY_PERIOD)
    poses, random = true_pose(stamps), np.random.default_rng(0)
    pose = poses[0]
    for k, stamp in enumerate(stamps):
        step = se2.between(poses[max(0, k - 1)], poses[k])
        pose = se2.compose(pose, step * (1.0 + 0.02 * random.standard_normal(3)))
        yield Odometry(SECOND + round(stamp * SECOND), pose)


class Drive(NamedTuple):
    """What came out of a drive: errors of the scans' poses (n, 3), and black cells of the map."""

    errors: np.ndarray
    black: int

    @property
    def error(self):
        """Root mean square of the error of position, m."""
        return float(np.sqrt(np.mean(np.sum(self.errors[:, :2] ** 2, axis=1))))


def drive_sweeping(sweep, timed):
    """A drive with a laser whose sweep takes ``sweep`` seconds; ``timed`` scans have a time increment."""
    odometry, dialogue = list(readings()), Dialogue()
    for k in range(SCANS):
        begin = k * PERIOD
        poses = true_pose(begin + sweep * np.linspace(0.0, 1.0, BEAMS))
        stamp = SECOND + round(begin * SECOND)
        scan = scan_in(WALLS, poses, stamp, BEAMS, 1.5 * np.pi, noise=0.01, seed=k, sweep=sweep)
        dialogue.send(scan if timed else replace(scan, time_increment=0.0))
        while odometry and odometry[0].stamp < stamp + PERIOD * SECOND:
            dialogue.send(odometry.pop(0))
    dialogue.send(EndOfLog())
    assert not dialogue.messages_of(Notice)
    estimates = np.array([estimate.pose.mean for estimate in dialogue.messages_of(LocalEstimate)])
    stored = [(k.scan, k.estimates[0].pose.mean) for k in dialogue.messages_of(Keyframe) if k.estimates[0].stored]
    image = occupancy_image([scan for scan, _ in stored], np.array([pose for _, pose in stored]), 0.05, 30.0)
    errors = se2.between(true_pose(np.arange(SCANS) * PERIOD), estimates)
    return Drive(errors, int(np.sum(image.pixels == OCCUPIED)))


@pytest.fixture(scope="module")
def drives():
    return {
        "standing": drive_sweeping(0.0, timed=True),
        "skewed": drive_sweeping(0.1, timed=False),
        "deskewed": drive_sweeping(0.1, timed=True),
    }


def test_a_robot_that_turns_while_its_laser_sweeps_is_found_as_if_the_laser_took_no_time(drives):
    assert drives["deskewed"].error < 0.02
    assert drives["deskewed"].error < 1.25 * drives["standing"].error
    assert drives["skewed"].error > 4.0 * drives["standing"].error
    headings = {name: np.degrees(np.sqrt(np.mean(drive.errors[:, 2] ** 2))) for name, drive in drives.items()}
    assert headings["deskewed"] < 0.15
    assert headings["skewed"] > 1.0


def test_its_map_is_as_sharp_as_if_the_laser_took_no_time(drives):
    assert drives["deskewed"].black < 1.05 * drives["standing"].black
    assert drives["skewed"].black > 1.3 * drives["standing"].black


def sweeping_scan(index):
    """A scan of 0.09 s that begins ``index`` tenths of a second after the start."""
    return scan_in(WALLS, np.zeros(3), SECOND + index * SECOND // 10, sweep=0.09)


def test_a_scan_waits_until_odometry_covers_its_last_beam():
    dialogue = Dialogue().send(Odometry(SECOND, np.zeros(3)), sweeping_scan(0))
    dialogue.send(Odometry(SECOND + SECOND * 8 // 100, np.array([0.08, 0.0, 0.0])))
    assert not dialogue.answers
    dialogue.send(Odometry(SECOND + SECOND * 9 // 100, np.array([0.09, 0.0, 0.0])))
    (keyframe,) = dialogue.messages_of(Keyframe)
    np.testing.assert_allclose(keyframe.scan.motion, (0.09, 0.0, 0.0), atol=1e-9)


def test_at_the_end_of_a_log_the_last_sweep_goes_on_as_the_odometry_did():
    dialogue = Dialogue().send(Odometry(SECOND - SECOND // 10, np.array([-0.1, 0.0, 0.0])))
    dialogue.send(Odometry(SECOND, np.zeros(3)), sweeping_scan(0))
    assert not dialogue.answers
    dialogue.send(EndOfLog())
    np.testing.assert_allclose(dialogue.messages_of(Keyframe)[0].scan.motion, (0.09, 0.0, 0.0), atol=1e-9)


def test_an_impossible_time_increment_is_reported_once_and_no_scan_is_lost():
    dialogue = Dialogue()
    for k in range(10):
        stamp = SECOND + k * SECOND // 10
        dialogue.send(Odometry(stamp, np.zeros(3)), replace(sweeping_scan(k), time_increment=np.nan))
    assert len(dialogue.messages_of(LocalEstimate)) == 10
    (notice,) = dialogue.messages_of(Notice)
    assert "time_increment = nan s" in notice.text
    assert all(keyframe.scan.time_increment == 0.0 for keyframe in dialogue.messages_of(Keyframe))
