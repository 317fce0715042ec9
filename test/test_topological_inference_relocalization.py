"""A robot that starts anywhere in a map, or is kidnapped, maps around itself until it is relocalized."""

from dataclasses import replace

import numpy as np
import pytest

from benchmark.awakening import FAR, awakened, mapped
from benchmark.kidnapping import SOON, kidnapped
from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative, uninformative_belief
from hmt_slam_ros.messages.map_changes import InitialPose
from hmt_slam_ros.messages.messages import PoseReset
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.offline.runtime import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.simulation.scenario import START
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch

WORLD = "sim:office,seed=3,size=0.7"
CARRIED = f"{WORLD},carried=0.6,to=0.75,turned=120"
OFF = np.array([5.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def maps():
    return mapped(WORLD, Configuration())


@pytest.fixture(scope="module")
def office(maps):
    return maps["whole"]


@pytest.fixture(scope="module")
def begin(office):
    """The record of a keyframe's scan."""
    known = {scan.stamp for scan in Replica.from_state(office.state.processes["tsbi"].replica).scans.values()}
    return [scan for scan in office.scans if office.records[scan].measurement.stamp in known][60]


def run_in_map(office, records, scans):
    """A run that started in a map and read so many scans."""
    run = LockStepRun(Configuration(), state=office.state)
    run.lock_step.feed(PoseReset())
    for record in records:
        run.process_record(record)
        scans -= isinstance(record.measurement, Scan)
        if not scans:
            break
    return run


def test_it_begins_a_new_area_with_an_uninformative_arc(office, begin):
    before = Replica.from_state(office.state.processes["tsbi"].replica)
    run = run_in_map(office, office.records[begin:], 10)
    replica = Replica.from_state(run.state.processes["tsbi"].replica)
    (hypothesis,) = run.recorder.hypotheses[max(run.recorder.hypotheses)].hypotheses
    assert hypothesis.lost
    assert hypothesis.area not in before.maps[before.best_hypothesis].area_ids()
    hybrid_map = replica.maps[hypothesis.id]
    (beside,) = hybrid_map.neighbors(hypothesis.area)
    assert is_uninformative(hybrid_map.arc(beside, hypothesis.area))
    for area in before.maps[before.best_hypothesis].area_ids():
        assert hybrid_map.keyframes(area).keys() == before.maps[before.best_hypothesis].keyframes(area).keys()


@pytest.mark.parametrize(("kind", "share"), [("whole", 0.15), ("whole", 0.7), ("first half", 0.5)])
def test_it_is_relocalized_at_its_pose(maps, kind, share):
    log = maps[kind]
    found = awakened(log, log.starts[int(share * len(log.starts))])
    assert found.right
    assert not found.wrong
    assert found.found <= FAR


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_without_landmarks_as_prior_it_is_recognized_too(maps, share):
    log = maps["first half"]
    arguments = replace(log, configuration=with_changes(Configuration(), {"places.prior": False}))
    found = awakened(arguments, log.starts[int(share * len(log.starts))])
    assert found.right
    assert not found.wrong
    assert found.found <= FAR


def test_in_the_map_of_the_first_half_it_starts_in_the_second_near_keyframes_of_the_first(maps):
    log, whole = maps["first half"], maps["whole"]
    scans = Replica.from_state(log.state.processes["tsbi"].replica).scans.values()
    stamps = {log.records[scan].measurement.stamp: n for n, scan in enumerate(log.scans)}
    known = np.array([log.truth[stamps[scan.stamp], :2] for scan in scans])
    assert max(stamps[scan.stamp] for scan in scans) < min(log.starts)
    assert all(np.hypot(*(known - log.truth[start, :2]).T).min() < 2.1 for start in log.starts)
    assert np.hypot(*(log.truth - whole.truth)[:, :2].T).max() < 0.5


def test_a_single_search_does_not_relocalize_it(office, begin, monkeypatch):
    """Every other search is 5 m off."""
    searches, found = [], ClosureSearch.localize_globally

    def off_at_times(search, *arguments):
        searches.append(found(search, *arguments))
        if len(searches) % 2:
            return searches[-1]
        moved = [
            fit._replace(mode=fit.mode._replace(pose=PoseGaussian(fit.mode.pose.mean + OFF, np.eye(3))))
            for fit in searches[-1].candidates
        ]
        return searches[-1]._replace(candidates=tuple(moved))

    monkeypatch.setattr(ClosureSearch, "localize_globally", off_at_times)
    run = run_in_map(office, office.records[begin:], 150)
    (hypothesis,) = run.recorder.hypotheses[max(run.recorder.hypotheses)].hypotheses
    assert sum(search_result.best is not None and search_result.best[1] > 0.9 for search_result in searches) >= 3
    assert hypothesis.lost


@pytest.mark.parametrize("seed", [4, 5, 6, 7])
def test_in_a_building_that_it_does_not_know_it_stays_lost(office, seed):
    run = run_in_map(office, open_log(f"sim:grid,seed={seed},size=0.7").records(), 150)
    assert all(hypothesis.lost for hypothesis in run.recorder.hypotheses[max(run.recorder.hypotheses)].hypotheses)


def test_a_standing_robot_is_relocalized_at_an_initial_pose(office, begin):
    """At a keyframe; the initial pose is 0.4 m and 6 degrees off."""
    replica = Replica.from_state(office.state.processes["tsbi"].replica)
    hybrid_map = replica.maps[replica.best_hypothesis]
    scan = office.records[begin].measurement
    (at,) = [
        (area, pose)
        for area in hybrid_map.area_ids()
        for keyframe, pose in hybrid_map.keyframes(area).items()
        if replica.scans[keyframe].stamp == scan.stamp
    ]
    hint = PoseGaussian(se2.compose(at[1], np.array([0.3, -0.25, 0.1])), np.diag([0.5, 0.5, 0.26]) ** 2)
    run = LockStepRun(Configuration(), state=office.state)
    run.lock_step.feed(PoseReset(InitialPose(at[0], hint)))
    for k in range(3):
        stamp = scan.stamp + k * 200_000_000
        run.lock_step.feed(Odometry(stamp, np.zeros(3)))
        run.lock_step.feed(replace(scan, stamp=stamp))
    run.lock_step.feed(Odometry(stamp + 200_000_000, np.zeros(3)))
    hypotheses = run.recorder.hypotheses[max(run.recorder.hypotheses)].hypotheses
    assert sum(hypothesis.probability for hypothesis in hypotheses if not hypothesis.lost) > 0.9


def test_scans_are_counted_on_and_odometry_restarts(office, begin):
    run = run_in_map(office, office.records[begin:], 25)
    assert run.state.processes["slam"].processed_scans == office.state.processes["slam"].processed_scans + 25
    assert run.state.processes["slam"].dropped_scans == 0


def test_a_robot_kidnapped_during_mapping_is_relocalized():
    found = kidnapped(CARRIED)
    assert found.noticed <= SOON
    assert found.again <= FAR
    assert not found.confident
    assert max(found.errors) < 0.1


def test_a_robot_kidnapped_in_localization_is_relocalized(office):
    run = LockStepRun(Configuration(mode="localization"), state=office.state)
    run.lock_step.feed(PoseReset())
    log = open_log(CARRIED)
    jump = START + int(0.6e9 * log.scenario.drive.duration)
    history = []
    for record in log.records():
        since = 1e-9 * (record.measurement.stamp - jump)
        if since > 40.0:
            break
        if since > -30.0:
            run.process_record(record)
        if run.recorder.hypotheses:
            lost = all(
                hypothesis.lost for hypothesis in run.recorder.hypotheses[max(run.recorder.hypotheses)].hypotheses
            )
            history.append((since, lost))
    assert not any(lost for since, lost in history if -1.0 < since < 0.0)
    assert any(lost for since, lost in history if 0.0 < since < SOON)  # at 0.6 m/s at most
    assert not history[-1][1]
    assert run.state.processes["slam"].dropped_scans == 0


def test_an_uninformative_arc_differs_from_the_least_certain_one_between_areas():
    assert is_uninformative(uninformative_belief(np.array([3.0, 4.0, 1.0])))
    assert not is_uninformative(PoseGaussian(np.zeros(3), np.diag([100.0, 100.0, 1.0]) ** 2))
