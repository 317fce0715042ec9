"""A robot that drives round and round over the same ground: what it knows does not grow with time."""

import numpy as np
import pytest

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.messages import Hypotheses
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.recorder import Recorder
from hmt_slam_ros.sensors import Scan

LAPS = 6


class Observer:
    """Two recorders, of which one keeps all messages; what was forgotten, and when."""

    def __init__(self, *recorders):
        self.recorders, self.forgotten = recorders, []

    def handle(self, message):
        if isinstance(message, Hypotheses):
            self.forgotten += message.pruned_keyframes
        return [answer for recorder in self.recorders for answer in recorder.handle(message)]


class Rounds:
    """A run of several laps.

    :ivar keyframes: of the map after every lap.
    """

    def __init__(self):
        self.log = open_log(f"sim:office,size=0.7,rate=2.5,laps={LAPS}")
        self.run, self.folding = LockStepRun(Configuration()), Recorder(Configuration())
        self.observer = Observer(self.run.recorder, self.folding)
        self.run.lock_step.processes["recorder"] = self.observer
        self.keyframes, self.kept = [], 0
        for record in self.log.records():
            self.run.process_record(record)
            self.folding.compact()
            self.kept = max(self.kept, len(self.folding.keyframes))
            if isinstance(record.measurement, Scan) and self.run.scans_read * LAPS >= self.log.scan_count * (
                len(self.keyframes) + 1
            ):
                self.keyframes.append(len(self.area_of_keyframe))
        self.result = self.run.finish()
        self.log_state = self.result.log_progress
        self.recording = self.run.recorder.finish(self.log_state.stamps)

    @property
    def area_of_keyframe(self):
        """{keyframe: its area} of the map, of which there is one."""
        replica = self.run.state.processes["slam"].replica
        return {k for area in replica.common.area_keyframes().values() for k in area} | {
            k for own in replica.changes.values() for area in own.area_keyframes().values() for k in area
        }


@pytest.fixture(scope="module")
def rounds():
    return Rounds()


def test_the_map_of_later_laps_is_no_larger(rounds):
    assert len(rounds.keyframes) == LAPS
    assert rounds.keyframes[-1] <= 1.03 * rounds.keyframes[2], rounds.keyframes


def test_pruned_keyframes_were_stored_and_are_gone_in_every_process(rounds):
    state, gone = rounds.run.state, {one.keyframe for one in rounds.observer.forgotten}
    assert len(gone) >= 4 * (LAPS - 2)
    for replica in (
        state.processes["slam"].replica,
        state.processes["aam"].replica,
        state.processes["tsbi"].replica,
        state.processes["tlca"].replica,
        state.recorder.replica,
    ):
        assert not gone & replica.scans.keys()
        assert replica.scans.keys() == state.processes["slam"].replica.scans.keys()
    assert not gone & rounds.area_of_keyframe
    for live in state.processes["slam"].live_hypotheses.values():
        assert not gone & {
            *live.particle_filter.keyframes,
            *live.keyframe_covariances.to_dict(),
            *live.step_covariances.to_dict(),
            live.event.anchor,
        }
    assert not gone & {keyframe for graph in state.processes["aam"].graphs.values() for keyframe in graph.keyframes}


def test_every_scan_keeps_its_pose_relative_to_a_keyframe_that_is_there(rounds):
    scans = rounds.recording.relative_trajectory
    assert set(scans.keyframes.tolist()) <= rounds.area_of_keyframe
    known = scans.keyframes >= 0
    assert known.all()
    assert np.hypot(*scans.poses[:, :2].T).max() < 3.0
    truth = rounds.log.true_poses(rounds.log_state.stamps)
    steps = [se2.between(poses[:-10], poses[10:]) for poses in (truth, rounds.recording.trajectory)]
    away = np.hypot(*(steps[1] - steps[0])[:, :2].T)
    assert np.median(away) < 0.03
    assert away.max() < 0.3


def test_a_record_has_the_same_keyframes_as_the_messages(rounds):
    assert rounds.kept < 100 < len(rounds.run.recorder.keyframes)
    folded = rounds.folding.finish(rounds.log_state.stamps)
    for name in ("trajectory", "online_trajectory", "odometry"):
        np.testing.assert_array_equal(getattr(folded, name), getattr(rounds.recording, name))
    assert folded.probabilities == rounds.recording.probabilities
    assert folded.area_poses.keys() == rounds.recording.area_poses.keys()
