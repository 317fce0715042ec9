"""Early estimates of scans that wait: there at once, near the truth, and without effect on the rest."""

import pickle
from collections import deque
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_metric_slam import Dialogue, agree, drive

from hmt_slam_ros.composition import metric_slam
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.map_changes import LocalArea
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    EndOfLog,
    Hypotheses,
    Hypothesis,
    Keyframe,
    LocalEstimate,
    PoseReset,
)
from hmt_slam_ros.messages.routing import SUBSCRIPTIONS
from hmt_slam_ros.metric_slam.look_ahead import EarlyEstimateRecord, LookAhead
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.process_table import PROCESSES

BUNDLED = Path(__file__).resolve().parent.parent / "data" / "malaga_one_loop"


def slam_without_copies(configuration):
    """A metric SLAM process that assumes no answer."""
    slam = metric_slam(configuration)
    slam.most_assumed = 0
    return slam


class Waiting(Dialogue):
    """A metric SLAM process whose first event gets no answer by itself, and its early estimates."""

    def __init__(self, configuration=None):
        super().__init__(answer=lambda keyframe: agree(keyframe) if keyframe.sequence else [])
        self.slam = slam_without_copies(configuration or Configuration())
        self.early = []

    def send(self, *messages):
        super().send(*messages)
        self.early += self.slam.look_ahead()
        return self


def late_answer(batch_size=None):
    """A dialogue of eleven scans of which the first one's event was answered last."""
    dialogue = Dialogue(answer=lambda keyframe: [])
    dialogue.slam = slam_without_copies(Configuration())
    for odometry, scan, _ in drive(11):
        dialogue.send(odometry, scan)
    dialogue.slam.batch_size = batch_size
    return dialogue.send(*agree(dialogue.messages_of(Keyframe)[0]))


def test_between_batches_of_scans_that_wait_a_new_one_has_an_estimate():
    batches, plain = late_answer(2), late_answer()
    assert (batches.slam.processed_scans, batches.slam.is_interrupted) == (3, True)
    for dialogue in (batches, plain):
        dialogue.send(*next(drive(1, start=11))[:2])
    assert [estimate.scan_index for estimate in batches.slam.look_ahead()] == [11]
    assert batches.slam.processed_scans == 3
    while batches.slam.is_interrupted:
        batches.answers += batches.slam.process_queue()
    for dialogue in (batches, plain):
        dialogue.slam.batch_size, dialogue.answer = None, agree
        dialogue.send(*agree(dialogue.messages_of(Keyframe)[-1]))
    assert plain.slam.processed_scans == 12
    assert pickle.dumps(batches.answers) == pickle.dumps(plain.answers)


def test_an_answer_that_comes_while_its_event_is_not_reached_is_that_of_a_killed_process():
    batches, plain = late_answer(2), late_answer()
    second = plain.messages_of(Keyframe)[1]
    for dialogue in (batches, plain):
        dialogue.send(*agree(second))
    while batches.slam.is_interrupted:
        batches.answers += batches.slam.process_queue()
    assert pickle.dumps(batches.answers) == pickle.dumps(plain.answers)


@pytest.mark.parametrize("last", [PoseReset(), EndOfLog()])
def test_all_that_wait_are_processed_before_anything_but_a_measurement(last):
    batches, plain = late_answer(2), late_answer()
    for dialogue in (batches, plain):
        dialogue.send(last)
    assert not batches.slam.is_interrupted
    assert pickle.dumps(batches.slam.state) == pickle.dumps(plain.slam.state)
    assert pickle.dumps(batches.answers) == pickle.dumps(plain.answers)


@pytest.mark.parametrize("kind", ["grid", "lines"])
def test_scans_that_wait_have_estimates_at_once_and_the_same_afterwards_as_without(kind):
    configuration = load_configuration(settings=[f"local_map.kind={kind}"])
    ahead, plain = Waiting(configuration), Dialogue(answer=lambda keyframe: [])
    plain.slam = metric_slam(configuration)
    for number, (odometry, scan, pose) in enumerate(drive(25)):
        ahead.send(odometry, scan)
        plain.send(odometry, scan)
        if number:
            (estimate,) = ahead.early[number - 1 :]
            assert (estimate.stamp, estimate.scan_index, estimate.event) == (scan.stamp, number, 0)
            assert np.hypot(*se2.between(pose, estimate.pose.mean)[:2]) < 0.05
            np.testing.assert_array_equal(estimate.odometry, odometry.pose)
    assert (ahead.slam.queued_scans, ahead.slam.processed_scans) == (24, 1)
    assert pickle.dumps(ahead.slam.state) == pickle.dumps(plain.slam.state)
    plain.answer = agree
    for dialogue in (ahead, plain):
        dialogue.send(*agree(dialogue.messages_of(Keyframe)[0]))
    assert pickle.dumps(ahead.slam.state) == pickle.dumps(plain.slam.state)
    assert pickle.dumps(ahead.answers) == pickle.dumps(plain.answers)
    assert len(ahead.messages_of(LocalEstimate)) == 25
    # None for scans that have had one, though the last ones wait for the next answer.
    assert len(ahead.early) == 24


def test_of_many_that_wait_the_newest_alone_has_one():
    dialogue = Waiting()
    steps = list(drive(31))
    for odometry, scan, _ in steps[:30]:
        Dialogue.send(dialogue, odometry, scan)
    assert [estimate.scan_index for estimate in dialogue.slam.look_ahead()] == [29]
    dialogue.send(*steps[30][:2])
    assert [estimate.scan_index for estimate in dialogue.early] == [30]
    assert np.hypot(*se2.between(steps[30][2], dialogue.early[0].pose.mean)[:2]) < 0.05


def test_when_metric_slam_gets_further_tracking_goes_on_from_there():
    steps = list(drive(41))
    dialogue = Dialogue(answer=lambda keyframe: [])
    dialogue.send(*steps[0][:2])
    slam, ahead = dialogue.slam, LookAhead(Configuration(), dialogue.slam)
    for number, (odometry, scan, _) in enumerate(steps[1:40], 1):
        ahead.add_odometry(odometry)
        dialogue.send(odometry, scan)
        assert ahead.follow(slam, slam.processed_scans)
        assert [estimate.scan_index for estimate in ahead.estimate([scan], number, 0)] == [number]
    dialogue.send(*agree(dialogue.messages_of(Keyframe)[0]))
    assert 1 < slam.processed_scans < 39
    assert ahead.follow(slam, slam.processed_scans)
    odometry, scan, pose = steps[40]
    ahead.add_odometry(odometry)
    (estimate,) = ahead.estimate([scan], 40, 1)
    assert np.hypot(*se2.between(pose, estimate.pose.mean)[:2]) < 0.05
    assert np.sqrt(estimate.pose.covariance[2, 2]) < np.radians(1.0)


def test_where_the_motion_since_metric_slams_last_scan_is_not_known_tracking_has_to_begin_again():
    dialogue = Dialogue()
    steps = list(drive(30))
    for odometry, scan, _ in steps[:3]:
        dialogue.send(odometry, scan)
    ahead = LookAhead(Configuration(), dialogue.slam)
    for odometry, scan, _ in steps[3:]:
        dialogue.send(odometry, scan)
    assert not ahead.follow(dialogue.slam, dialogue.slam.processed_scans)


def test_a_scan_whose_odometry_is_not_known_waits():
    dialogue = Waiting()
    (odometry, scan, _), (later, second, _) = drive(2)
    dialogue.send(odometry, scan, second)
    assert dialogue.early == []
    dialogue.send(later)
    assert [estimate.scan_index for estimate in dialogue.early] == [1]


def test_scans_that_wait_for_later_odometry_have_estimates_at_once():
    ahead, plain, frozen = Waiting(), Dialogue(), range(20, 35)
    ahead.answer = agree
    for number, (odometry, scan, pose) in enumerate(drive(50)):
        reading = replace(odometry, pose=np.array([1.9, 0.0, 0.0])) if number in frozen else odometry
        ahead.send(reading, scan)
        plain.send(reading, scan)
        if number in frozen:
            assert ahead.slam.queued_scans == number - frozen[0] + 1
            estimate = ahead.early[-1]
            assert (estimate.stamp, estimate.scan_index) == (scan.stamp, number)
            assert np.hypot(*se2.between(pose, estimate.pose.mean)[:2]) < 0.1
    assert len(ahead.early) == len(frozen)
    assert len(ahead.messages_of(LocalEstimate)) == 50
    assert pickle.dumps(ahead.slam.state) == pickle.dumps(plain.slam.state)
    assert pickle.dumps(ahead.answers) == pickle.dumps(plain.answers)


def test_it_goes_on_in_the_area_of_the_hypotheses_until_the_decision():
    dialogue = Waiting()
    steps = list(drive(4))
    for odometry, scan, _ in steps[:3]:
        dialogue.send(odometry, scan)
    moved = Hypothesis(0, 0, 1.0, 0, local_areas=(LocalArea(0, np.zeros(3)),))
    dialogue.send(Hypotheses(0, (moved,)))
    dialogue.send(*steps[3][:2])
    assert [estimate.scan_index for estimate in dialogue.early] == [1, 2, 3]
    dialogue.send(ClosureDecision(0))
    assert len(dialogue.messages_of(LocalEstimate)) == 4


def test_there_is_none_after_a_reset_until_the_robot_is_tracked_again():
    dialogue = Waiting()
    for odometry, scan, _ in drive(5):
        dialogue.send(odometry, scan)
    count = len(dialogue.early)
    dialogue.send(PoseReset())
    for odometry, scan, _ in drive(3, start=5):
        dialogue.send(odometry, scan)
    assert len(dialogue.early) == count
    dialogue.answer = lambda keyframe: [] if keyframe.sequence == 1 else agree(keyframe)
    dialogue.send(*agree(dialogue.messages_of(Keyframe)[0]))
    assert [(estimate.scan_index, estimate.event) for estimate in dialogue.early[count:]] == [(3, 1)]


def test_the_record_tells_how_far_they_were_off():
    dialogue, record = Waiting(), EarlyEstimateRecord()
    for odometry, scan, _ in drive(8):
        dialogue.send(odometry, scan)
    for estimate in dialogue.early:
        record.add(estimate)
    dialogue.send(*agree(dialogue.messages_of(Keyframe)[0]))
    first, second, *others = dialogue.messages_of(LocalEstimate)[1:]
    off = replace(second.pose, mean=second.pose.mean + np.array([0.3, 0.4, 0.0]))
    for estimate in (replace(first, area=7), replace(second, pose=off), *others):
        record.compare(estimate)
    assert str(record) == "7, 1 of them then in another area, the others off by 0.50 m"
    record.clear()


class DelayedRun:
    """The five processes, in which measurements come before answers to earlier ones, and processes are made again."""

    def __init__(self, configuration, seed):
        self.configuration, self.random = configuration, np.random.default_rng(seed)
        self.processes = {row.name: row.make(configuration, None) for row in PROCESSES}
        self.pending, self.sent, self.early = deque(), [], 0
        self.slams = [self.processes["slam"]]
        self.batches, self.batch_sizes = 0, np.random.default_rng(seed)

    def run(self, measurements, lock_step=False):
        """Feed measurements, each as soon as chance has it; without a chance, once nothing is pending."""
        inputs = deque([*measurements, EndOfLog()])
        while inputs or self.pending:
            # The end of the log comes when all is answered, as the nodes hold it back.
            may_come = inputs and (not self.pending or (not lock_step and len(inputs) > 1))
            if may_come and (not self.pending or self.random.random() < 0.6):
                self._deliver(inputs.popleft())
            else:
                self._deliver(self.pending.popleft())
            if inputs and not lock_step:
                self._disturb()
            if not lock_step:
                self._process_batch(may_wait=bool(inputs))
        return self

    def _deliver(self, message):
        self.sent.append(message)
        for name, process in self.processes.items():
            if isinstance(message, SUBSCRIPTIONS[name]):
                self.pending.extend(process.handle(message))

    def _disturb(self):
        if self.random.random() < 0.08:
            self.early += len(self.processes["slam"].look_ahead())
        if self.random.random() < 0.01:
            # The others have a state between two events only.
            row = PROCESSES[self.random.integers(1 if self.pending else len(PROCESSES))]
            self.processes[row.name] = row.make(self.configuration, deepcopy(self.processes[row.name].state))
            self.slams += [self.processes["slam"]] if row.name == "slam" else []

    def _process_batch(self, may_wait):
        """Process the next scans of those that are ready, or let them wait."""
        slam = self.processes["slam"]
        slam.batch_size = self.batch_sizes.choice([None, 1, 2])
        if slam.has_more and not (may_wait and self.batch_sizes.random() < 0.3):
            self.pending.extend(slam.process_batch())
            self.batches += 1

    def total(self, name):
        """A count of all metric SLAM processes together."""
        return sum(getattr(slam.record, name) for slam in self.slams)

    def chain(self):
        """The messages of keyframe events, and the estimates, as bytes."""
        kinds = (Keyframe, Hypotheses, ClosureDecision, LocalEstimate)
        return {kind.__name__: [pickle.dumps(m) for m in self.sent if isinstance(m, kind)] for kind in kinds}


@pytest.fixture(scope="module")
def measurements():
    """Those of a log in which a loop is closed."""
    return [record.measurement for record in open_log(BUNDLED).records()]


@pytest.fixture(scope="module")
def in_lock_step(measurements):
    return DelayedRun(Configuration(), 0).run(measurements, lock_step=True).chain()


@pytest.mark.parametrize("seed", [0, 4])
def test_however_late_answers_come_and_whatever_is_made_again_decisions_are_the_same(measurements, in_lock_step, seed):
    delayed = DelayedRun(Configuration(), seed).run(measurements)
    assert delayed.early > 50
    assert delayed.batches > 10
    assert delayed.total("confirmed") > 10
    assert sum(sum(slam.record.refuted.values()) for slam in delayed.slams) > 1
    assert 0 < delayed.total("repeated") < delayed.total("scans")
    found = delayed.chain()
    assert len(in_lock_step["Keyframe"]) > 50
    for kind, messages in in_lock_step.items():
        assert found[kind] == messages, kind
