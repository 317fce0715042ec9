"""The metric SLAM process, answered by hand in the place of the topological processes."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import Arc, AreaMerge, LocalArea, MovedKeyframe
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    EndOfLog,
    EndOfRun,
    Hypotheses,
    Hypothesis,
    Keyframe,
    LocalEstimate,
    Notice,
    ScanPoses,
)
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.sensors import Odometry

WALLS = np.concatenate((box(-3.02, -4.03, 12.03, 4.01), box(4.01, 1.52, 5.03, 2.52), box(7.02, -2.51, 7.52, -1.49)))
STEP = np.array([0.1, 0.0, 0.0])
SECOND = 10**9


def drive(count, start=0):
    """(odometry, scan, true pose) of a straight drive, ten scans a second."""
    for k in range(start, start + count):
        pose = np.array([0.1 * k, 0.0, 0.0])
        stamp = SECOND + k * SECOND // 10
        yield Odometry(stamp, pose), scan_in(WALLS, pose, stamp=stamp, field_of_view=2 * np.pi), pose


def agree(keyframe):
    """The answer that changes nothing."""
    hypotheses = tuple(
        Hypothesis(estimate.hypothesis, estimate.hypothesis, 1.0 / len(keyframe.estimates), estimate.area)
        for estimate in keyframe.estimates
    )
    return [Hypotheses(keyframe.sequence, hypotheses), ClosureDecision(keyframe.sequence)]


class Dialogue:
    """A metric SLAM process, and all its answers."""

    def __init__(self, configuration=None, answer=agree):
        self.slam = MetricSlam(configuration or Configuration())
        self.answer = answer
        self.answers = []

    def send(self, *messages):
        pending = list(messages)
        while pending:
            for message in self.slam.handle(pending.pop(0)):
                self.answers.append(message)
                if isinstance(message, Keyframe):
                    pending += self.answer(message)
        return self

    def messages_of(self, kind):
        return [message for message in self.answers if isinstance(message, kind)]


def test_every_scan_gets_a_pose_near_the_truth():
    dialogue = Dialogue()
    truths = []
    for odometry, scan, pose in drive(60):
        dialogue.send(odometry, scan)
        truths.append(pose)
    estimates = dialogue.messages_of(LocalEstimate)
    assert [estimate.scan_index for estimate in estimates] == list(range(60))
    errors = np.array([se2.between(t, e.pose.mean) for t, e in zip(truths, estimates, strict=True)])
    assert np.hypot(*errors[:, :2].T).max() < 0.05


def test_a_keyframe_comes_with_every_half_meter():
    dialogue = Dialogue()
    for odometry, scan, _ in drive(61):
        dialogue.send(odometry, scan)
    keyframes = dialogue.messages_of(Keyframe)
    assert [keyframe.sequence for keyframe in keyframes] == list(range(len(keyframes)))
    assert len(keyframes) in range(11, 14)
    assert all(keyframe.estimates[0].stored for keyframe in keyframes)


def test_ground_that_is_mapped_already_stores_no_keyframe():
    dialogue = Dialogue()
    forward = list(drive(41))
    for odometry, scan, _ in forward:
        dialogue.send(odometry, scan)
    stored = sum(keyframe.estimates[0].stored for keyframe in dialogue.messages_of(Keyframe))
    for k, (odometry, scan, _) in enumerate(reversed(forward)):
        stamp = 10 * SECOND + k * SECOND // 10
        dialogue.send(replace(odometry, stamp=stamp), replace(scan, stamp=stamp))
    keyframes = dialogue.messages_of(Keyframe)
    assert len(keyframes) > stored + 5
    assert sum(keyframe.estimates[0].stored for keyframe in keyframes) == stored


def test_scans_wait_while_a_keyframe_event_is_open_and_none_is_lost():
    dialogue = Dialogue(answer=lambda keyframe: [])
    for odometry, scan, _ in drive(20):
        dialogue.send(odometry, scan)
    assert len(dialogue.messages_of(LocalEstimate)) == 1
    assert dialogue.slam.queued_scans == 19
    dialogue.answer = agree
    dialogue.send(*agree(dialogue.messages_of(Keyframe)[0]))
    assert len(dialogue.messages_of(LocalEstimate)) == 20


def test_a_scan_waits_for_its_odometry():
    dialogue = Dialogue()
    (odometry, scan, _), (later, _, _) = drive(2)
    dialogue.send(scan)
    assert not dialogue.answers
    dialogue.send(odometry, later)
    assert len(dialogue.messages_of(LocalEstimate)) == 1


def test_without_odometry_scans_are_matched_after_a_while_and_it_is_reported_once():
    configuration = Configuration()
    configuration = replace(configuration, filter=replace(configuration.filter, max_scans_waiting_for_odometry=5))
    dialogue = Dialogue(configuration)
    for _, scan, _ in drive(30):
        dialogue.send(scan)
    dialogue.send(EndOfLog())
    assert len(dialogue.messages_of(LocalEstimate)) == 30
    (notice,) = dialogue.messages_of(Notice)
    assert "odometry" in notice.text
    assert np.abs(dialogue.messages_of(LocalEstimate)[-1].pose.mean - (2.9, 0, 0)).max() < 0.1


def test_stamps_that_jump_back_lose_no_scan_and_are_reported_once():
    dialogue = Dialogue()
    for k, (odometry, scan, _) in enumerate(drive(30)):
        stamp = scan.stamp - (SECOND // 2 if k in (10, 20) else 0)
        dialogue.send(replace(odometry, stamp=stamp), replace(scan, stamp=stamp))
    dialogue.send(EndOfLog())
    assert len(dialogue.messages_of(LocalEstimate)) == 30
    (notice,) = dialogue.messages_of(Notice)
    assert "not after its predecessor" in notice.text
    assert np.abs(dialogue.messages_of(LocalEstimate)[-1].pose.mean - (2.9, 0, 0)).max() < 0.1


@pytest.mark.parametrize("spoil", [np.nan, np.inf, 0.0, -1.0])
def test_faulty_ranges_and_differing_beam_counts_lose_no_scan(spoil):
    dialogue = Dialogue()
    for k, (odometry, scan, _) in enumerate(drive(30)):
        ranges = scan.ranges.copy()
        ranges[k % 7 :: 7] = spoil
        dialogue.send(odometry, replace(scan, ranges=ranges[: len(ranges) - k % 3]))
    dialogue.send(EndOfLog())
    assert dialogue.messages_of(EndOfRun)[0].processed == 30
    assert np.abs(dialogue.messages_of(LocalEstimate)[-1].pose.mean - (2.9, 0, 0)).max() < 0.05


def test_a_scan_without_any_return_is_placed_by_odometry():
    dialogue = Dialogue()
    for k, (odometry, scan, _) in enumerate(drive(30)):
        blind = replace(scan, ranges=np.full_like(scan.ranges, np.nan)) if k % 2 else scan
        dialogue.send(odometry, blind)
    assert len(dialogue.messages_of(LocalEstimate)) == 30
    assert len(dialogue.messages_of(Notice)) == 1
    assert np.abs(dialogue.messages_of(LocalEstimate)[-1].pose.mean - (2.9, 0, 0)).max() < 0.05


def test_the_trails_hold_every_scan_once_and_lead_to_its_pose():
    dialogue = Dialogue()
    truths = []
    for odometry, scan, pose in drive(60):
        dialogue.send(odometry, scan)
        truths.append(pose)
    dialogue.send(EndOfLog())
    poses = {0: np.zeros(3)}
    for keyframe in dialogue.messages_of(Keyframe):
        poses[keyframe.sequence] = keyframe.estimates[0].pose.mean
        poses |= {r.keyframe: r.pose for r in keyframe.estimates[0].revised_keyframes}
    rows = [
        (message.first_scan + k, se2.compose(poses[int(anchor)], pose))
        for message in dialogue.messages_of(ScanPoses)
        for k, (anchor, pose) in enumerate(zip(message.keyframes, message.poses, strict=True))
    ]
    assert [scan for scan, _ in rows] == list(range(60))
    errors = np.array([se2.between(t, p) for t, (_, p) in zip(truths, rows, strict=True)])
    assert np.hypot(*errors[:, :2].T).max() < 0.05
    (finished,) = dialogue.messages_of(EndOfRun)
    assert (finished.received, finished.processed, finished.dropped) == (60, 60, 0)


def split_at(event):
    """TSBI's answer that makes the keyframes 6 and later, at event ``event``, a new area 1, in one hypothesis."""

    def answer(keyframe):
        if keyframe.sequence != event:
            return agree(keyframe)
        (estimate,) = keyframe.estimates
        reference = PoseGaussian(np.array([3.0, 0.0, 0.0]), np.diag([1e-4, 1e-4, 1e-5]))
        moved = tuple(MovedKeyframe(k, 0, 1, np.array([0.5 * (k - 6), 0.0, 0.0])) for k in range(6, event + 1))
        change = Hypothesis(
            1,
            estimate.hypothesis,
            1.0,
            1,
            reference.inverse(),
            moved,
            (Arc(0, 1, reference),),
            (LocalArea(1, np.zeros(3)), LocalArea(0, np.array([-3.0, 0.0, 0.0]))),
        )
        return [Hypotheses(keyframe.sequence, (change,)), ClosureDecision(keyframe.sequence, 1)]

    return answer


def test_after_a_change_of_area_poses_are_in_the_new_frame_and_tracking_goes_on():
    dialogue = Dialogue(answer=split_at(10))
    truths = []
    for odometry, scan, pose in drive(80):
        dialogue.send(odometry, scan)
        truths.append(pose)
    estimates = dialogue.messages_of(LocalEstimate)
    assert {estimate.area for estimate in estimates} == {0, 1}
    for truth, estimate in zip(truths, estimates, strict=True):
        origin = np.array([3.0 if estimate.area == 1 else 0.0, 0.0, 0.0])
        assert np.abs(se2.between(truth, se2.compose(origin, estimate.pose.mean))[:2]).max() < 0.06
    last = dialogue.messages_of(Keyframe)[-1].estimates[0]
    assert last.hypothesis == 1
    assert last.area == 1


def test_a_robot_whose_area_becomes_part_of_another_goes_on_there():
    back = PoseGaussian(np.array([3.0, 0.0, 0.0]), np.diag([1e-4, 1e-4, 1e-5]))
    split = split_at(10)

    def answer(keyframe):
        if keyframe.sequence == 0 or keyframe.estimates[0].hypothesis == 0 or keyframe.sequence != 13:
            return split(keyframe)
        hypothesis = Hypothesis(
            1, 1, 1.0, 0, back, local_areas=(LocalArea(0, np.zeros(3)),), area_merge=AreaMerge(1, 0, back)
        )
        return [Hypotheses(13, (hypothesis,)), ClosureDecision(13, 1)]

    dialogue = Dialogue(answer=answer)
    truths = []
    for odometry, scan, pose in drive(80):
        dialogue.send(odometry, scan)
        truths.append(pose)
    estimates = dialogue.messages_of(LocalEstimate)
    assert [area for area, _ in groupby(estimates, lambda estimate: estimate.area)] == [0, 1, 0]
    for truth, estimate in zip(truths, estimates, strict=True):
        origin = np.array([3.0 if estimate.area == 1 else 0.0, 0.0, 0.0])
        assert np.abs(se2.between(truth, se2.compose(origin, estimate.pose.mean))[:2]).max() < 0.06
    hybrid_map = dialogue.slam._replica.maps[1]
    assert hybrid_map.area_ids() == [0]
    assert sorted(hybrid_map.keyframes(0)) == [keyframe.sequence for keyframe in dialogue.messages_of(Keyframe)]
    assert set(dialogue.slam.best_hypothesis.filter.keyframe_areas) == {0}
    # The drift goes on from what it was, with what is not known of how the two lie to each other.
    before, after = (dialogue.messages_of(Keyframe)[k].estimates[0].pose.covariance for k in (13, 14))
    assert np.trace(after[:2, :2]) > np.trace(before[:2, :2]) + 1e-4


def test_the_drift_grows_from_the_origin_of_the_area():
    dialogue = Dialogue(answer=split_at(10))
    for odometry, scan, _ in drive(80):
        dialogue.send(odometry, scan)
    deviations = [np.sqrt(np.trace(k.estimates[0].pose.covariance[:2, :2])) for k in dialogue.messages_of(Keyframe)]
    assert (np.diff(deviations[:11]) > 0).all()
    assert deviations[11] < deviations[10]


def test_two_hypotheses_are_tracked_side_by_side():
    def fork(keyframe):
        if keyframe.sequence != 3:
            return agree(keyframe)
        children = (Hypothesis(1, 0, 0.5, 0), Hypothesis(2, 0, 0.5, 0))
        return [Hypotheses(3, children), ClosureDecision(3)]

    dialogue = Dialogue(answer=fork)
    for odometry, scan, _ in drive(40):
        dialogue.send(odometry, scan)
    keyframes = dialogue.messages_of(Keyframe)
    assert [estimate.hypothesis for estimate in keyframes[-1].estimates] == [1, 2]
    assert sorted({poses.hypothesis for poses in dialogue.messages_of(ScanPoses)}) == [0, 1, 2]
    dialogue.send(ClosureDecision(keyframes[-1].sequence, 2))
    for odometry, scan, _ in drive(10, start=40):
        dialogue.send(odometry, scan)
    assert [estimate.hypothesis for estimate in dialogue.messages_of(Keyframe)[-1].estimates] == [2]


def test_a_robot_that_takes_itself_for_lost_goes_on_by_odometry():
    """It may be lost by mistake, so its filter is initialized where odometry has it."""

    def lost_at_the_third(keyframe):
        lost = keyframe.sequence == 2
        answer, decision = agree(keyframe)
        hypotheses = tuple(replace(child, lost=lost, tracking_reset=lost) for child in answer.hypotheses)
        return [replace(answer, hypotheses=hypotheses), decision]

    dialogue = Dialogue(answer=lost_at_the_third)
    truths = []
    for odometry, scan, pose in drive(40):
        dialogue.send(odometry, scan)
        truths.append(pose)
    assert [keyframe.motion_unknown for keyframe in dialogue.messages_of(Keyframe)[:5]] == [
        False,
        False,
        False,
        True,
        False,
    ]
    off = np.array(
        [se2.between(t, e.pose.mean) for t, e in zip(truths, dialogue.messages_of(LocalEstimate), strict=True)]
    )
    assert np.hypot(*off[:, :2].T).max() < 0.05
