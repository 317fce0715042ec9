"""Observations of marks on their way to a keyframe: at the right pose, whenever they come."""

from dataclasses import replace

import numpy as np
import pytest
from test_metric_slam import SECOND, Dialogue, drive

from hmt_slam_ros.composition import metric_slam
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.messages import Keyframe, PoseReset
from hmt_slam_ros.metric_slam.marks import DELAY, MarkQueue
from hmt_slam_ros.sensors import MarkObservation
from hmt_slam_ros.sensors.mark import check_mark

MARK = np.array([1.0, 2.0, 0.7])
COVARIANCE = np.diag([0.03, 0.03, 0.02]) ** 2


def observe_mark(seconds, name="lift", mark=MARK):
    """The observation of a mark, m and rad, at a time of the drive, s."""
    pose = np.array([seconds, 0.0, 0.0])  # 1 m/s
    return MarkObservation(SECOND + round(seconds * 1e9), name, PoseGaussian(se2.between(mark, pose), COVARIANCE))


def dialogue_with(marks, scans=21):
    """A drive of some scans; {number of the scan before which it comes: observation} of the marks."""
    dialogue = Dialogue()
    for k, (odometry, scan, _) in enumerate(drive(scans)):
        dialogue.send(odometry, *marks.get(k, ()), scan)
    return dialogue


def marks_of(dialogue):
    """{name: its keyframe event, with the observation} of all keyframes."""
    return {one.name: (keyframe, one) for keyframe in dialogue.messages_of(Keyframe) for one in keyframe.marks}


@pytest.mark.parametrize("seconds", [0.2, 0.23, 0.29])
def test_an_observation_is_at_the_pose_of_the_next_keyframe(seconds):
    dialogue = dialogue_with({0: [observe_mark(0.0, "first")], 3: [observe_mark(seconds)]})
    keyframe, mark = marks_of(dialogue)["lift"]
    true = se2.between(MARK, np.array([(keyframe.scan.stamp - SECOND) / 1e9, 0.0, 0.0]))
    # Along the drive to a centimeter, and aside as well as the scans are tracked.
    assert (np.abs(se2.between(true, mark.pose.mean)) < (0.01, 0.03, 0.01)).all()
    assert mark.stamp == observe_mark(seconds).stamp
    delay = (keyframe.scan.stamp - mark.stamp) / 1e9
    assert 0.5 <= delay <= 1.2


def test_an_observation_that_comes_late_counts_like_one_in_time():
    first = [observe_mark(0.0, "first")]
    early, late = (marks_of(dialogue_with({0: first, k: [observe_mark(0.23)]}))["lift"] for k in (3, 7))
    assert early[0].sequence == late[0].sequence
    np.testing.assert_array_equal(early[1].pose.mean, late[1].pose.mean)
    np.testing.assert_array_equal(early[1].pose.covariance, late[1].pose.covariance)


def test_a_keyframe_has_the_newest_observation_of_each_mark_ordered_by_name():
    marks = {
        3: [observe_mark(0.2, "b"), observe_mark(0.21, "b"), observe_mark(0.22, "a")],
        4: [observe_mark(0.19, "b")],
    }
    keyframes = dialogue_with(marks, 12).messages_of(Keyframe)
    (found,) = [keyframe.marks for keyframe in keyframes if keyframe.marks]
    assert [(one.name, one.stamp - SECOND) for one in found] == [("a", 220_000_000), ("b", 210_000_000)]


def test_what_is_too_old_and_what_a_reset_forgets_is_in_no_keyframe():
    old = replace(observe_mark(0.2), stamp=SECOND // 4)
    assert not marks_of(dialogue_with({5: [old]}))
    dialogue = dialogue_with({3: [observe_mark(0.2)]}, 5)
    dialogue.send(PoseReset())
    for odometry, scan, _ in drive(15, start=5):
        dialogue.send(odometry, scan)
    assert not marks_of(dialogue)


def test_without_marks_nothing_is_kept():
    assert MarkQueue().after_scan(SECOND, np.zeros(3)).steps == ()


def test_marks_of_a_wrong_clock_take_no_more_room():
    queue = MarkQueue()
    for k in range(1000):
        queue = queue.add(observe_mark(1e6 + k))
    for k in range(300):
        queue = queue.after_scan(SECOND + k, np.zeros(3))
    assert len(queue.waiting) == 256
    assert len(queue.steps) == 64
    queue = MarkQueue()
    for k in range(100):
        queue = queue.add(observe_mark(0.0, f"mark {k}"))
    assert len(queue.after_scan(SECOND + DELAY, np.zeros(3)).take()[0]) == 32


def test_a_slam_that_works_ahead_or_goes_on_from_a_state_has_the_same_marks():
    plain = dialogue_with({0: [observe_mark(0.0, "first")], 3: [observe_mark(0.23)]})
    configuration = Configuration()
    ahead, waiting = Dialogue(answer=lambda keyframe: []), []
    ahead.slam = metric_slam(configuration)
    for k, (odometry, scan, _) in enumerate(drive(21)):
        marks = {0: [observe_mark(0.0, "first")], 3: [observe_mark(0.23)]}.get(k, ())
        ahead.send(odometry, *marks, scan)
        ahead.slam.look_ahead()
        for keyframe in [one for one in ahead.messages_of(Keyframe) if one.sequence not in waiting]:
            if k >= 2 * keyframe.sequence:
                waiting.append(keyframe.sequence)
                ahead.send(*plain.answer(keyframe))
        if k == 5:
            ahead.slam = metric_slam(configuration, ahead.slam.state)
    found, wanted = marks_of(ahead), marks_of(plain)
    assert found.keys() == wanted.keys() == {"first", "lift"}
    for name, (keyframe, mark) in wanted.items():
        assert found[name][0].sequence == keyframe.sequence
        np.testing.assert_array_equal(found[name][1].pose.mean, mark.pose.mean)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("frame_id", {"name": ""}),
        ("frame_id", {"name": "x" * 101}),
        ("frame_id", {"name": "a\nb"}),
        ("stamp", {"stamp": -1}),
        ("pose", {"pose": PoseGaussian(np.array([np.nan, 0.0, 0.0]), COVARIANCE)}),
        ("pose", {"pose": PoseGaussian(np.array([1e8, 0.0, 0.0]), COVARIANCE)}),
        ("covariance", {"pose": PoseGaussian(MARK, np.zeros((3, 3)))}),
        ("covariance", {"pose": PoseGaussian(MARK, np.full((3, 3), np.inf))}),
        ("covariance", {"pose": PoseGaussian(MARK, COVARIANCE + np.eye(3, k=1))}),
        ("covariance", {"pose": PoseGaussian(MARK, np.diag([0.01, 0.01, 0.3]))}),
    ],
)
def test_an_observation_that_is_none_is_refused_by_a_sentence(field, value):
    assert check_mark(observe_mark(0.0)).name == "lift"
    with pytest.raises(HmtSlamError, match=f"^{field}( of a mark)? = .* is not .*: correct the (detector|driver)"):
        check_mark(replace(observe_mark(0.0), **value))
