"""A robot that starts somewhere in a map, or is kidnapped, maps around itself, until it is recognized where it is."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from benchmark.awakening import FAR, SURE, map_log, try_start
from benchmark.kidnapping import SOON, drive_kidnapped
from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative, uninformative_belief
from hmt_slam_ros.messages.map_changes import InitialPose
from hmt_slam_ros.messages.messages import PoseReset
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.saved_map.folder import FolderReader, FolderWriter
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.simulation.scenario import START
from hmt_slam_ros.topological_inference import event_work
from hmt_slam_ros.topological_inference.map_search import MapSearch
from hmt_slam_ros.topological_inference.tsbi import TsbiState

WORLD = "sim:office,seed=3,size=0.7"
CARRIED = f"{WORLD},carried=0.6,to=0.75,turned=120"
OFF = np.array([5.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def maps():
    return map_log(WORLD, Configuration())


@pytest.fixture(scope="module")
def office(maps):
    return maps["whole"]


@pytest.fixture(scope="module")
def begin(office):
    """The record of a keyframe's scan."""
    known = {scan.stamp for scan in Replica.from_state(office.state.processes["tsbi"].replica).scans.values()}
    return [scan for scan in office.scans if office.records[scan].measurement.stamp in known][60]


def start_in_map(office, records, scans):
    """A run that started in a map and read so many scans."""
    run = LockStepRun(Configuration(), state=office.state)
    run.lock_step.feed(PoseReset())
    for record in records:
        run.process_record(record)
        scans -= isinstance(record.measurement, Scan)
        if not scans:
            break
    return run


def test_it_begins_a_new_area_to_which_an_arc_leads_that_has_no_information(office, begin):
    before = Replica.from_state(office.state.processes["tsbi"].replica)
    run = start_in_map(office, office.records[begin:], 10)
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
def test_it_is_recognized_where_it_is(maps, kind, share):
    log = maps[kind]
    found = try_start(log, log.starts[int(share * len(log.starts))])
    assert found.right
    assert not found.wrong
    assert found.right_at_first
    assert found.probability >= SURE
    assert found.found <= FAR


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_without_landmarks_as_prior_it_is_recognized_too(maps, share):
    log = maps["first half"]
    requested = replace(log, configuration=with_changes(Configuration(), {"places.prior": False}))
    found = try_start(requested, log.starts[int(share * len(log.starts))])
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


def test_it_is_not_believed_to_be_where_one_look_alone_finds_it(office, begin, monkeypatch):
    """Every other look finds it 5 m off."""
    looks, found = [], MapSearch.localize

    def off_at_times(search, *requested):
        looks.append(found(search, *requested))
        if len(looks) % 2:
            return looks[-1]
        moved = [
            fit._replace(mode=fit.mode._replace(pose=PoseGaussian(fit.mode.pose.mean + OFF, np.eye(3))))
            for fit in looks[-1].candidates
        ]
        return looks[-1]._replace(candidates=tuple(moved))

    monkeypatch.setattr(MapSearch, "localize", off_at_times)
    run = start_in_map(office, office.records[begin:], 150)
    (hypothesis,) = run.recorder.hypotheses[max(run.recorder.hypotheses)].hypotheses
    assert sum(look.best is not None and look.best[1] > 0.9 for look in looks) >= 3
    assert hypothesis.lost


@pytest.mark.parametrize("seed", [4, 5, 6, 7])
def test_in_a_building_that_it_does_not_know_it_stays_lost(office, seed):
    run = start_in_map(office, open_log(f"sim:grid,seed={seed},size=0.7").records(), 150)
    assert all(hypothesis.lost for hypothesis in run.recorder.hypotheses[max(run.recorder.hypotheses)].hypotheses)


def test_a_robot_that_stands_still_is_localized_at_its_initial_pose(office, begin):
    """In the place of a keyframe; the initial pose is 0.4 m and 6 degrees off."""
    replica = Replica.from_state(office.state.processes["tsbi"].replica)
    hybrid_map = replica.maps[replica.best_hypothesis]
    scan = office.records[begin].measurement
    (at,) = [
        (area, pose)
        for area in hybrid_map.area_ids()
        for keyframe, pose in hybrid_map.keyframes(area).items()
        if replica.scans[keyframe].stamp == scan.stamp
    ]
    messages = PoseGaussian(se2.compose(at[1], np.array([0.3, -0.25, 0.1])), np.diag([0.5, 0.5, 0.26]) ** 2)
    run = LockStepRun(Configuration(), state=office.state)
    run.lock_step.feed(PoseReset(InitialPose(at[0], messages)))
    for k in range(3):
        stamp = scan.stamp + k * 200_000_000
        run.lock_step.feed(Odometry(stamp, np.zeros(3)))
        run.lock_step.feed(replace(scan, stamp=stamp))
    run.lock_step.feed(Odometry(stamp + 200_000_000, np.zeros(3)))
    hypotheses = run.recorder.hypotheses[max(run.recorder.hypotheses)].hypotheses
    assert sum(hypothesis.probability for hypothesis in hypotheses if not hypothesis.lost) > 0.9


def test_scans_are_counted_on_and_odometry_restarts(office, begin):
    run = start_in_map(office, office.records[begin:], 25)
    assert run.state.processes["slam"].processed_scans == office.state.processes["slam"].processed_scans + 25
    assert run.state.processes["slam"].dropped_scans == 0


def test_one_that_is_kidnapped_while_it_maps_notices_and_is_recognized():
    found = drive_kidnapped(CARRIED)
    assert found.noticed <= SOON
    assert found.again <= FAR
    assert not found.confident
    assert max(found.errors) < 0.1


@pytest.mark.parametrize("seed", [1, 3])
def test_one_that_is_kidnapped_in_a_gap_of_scans_notices_and_is_recognized(seed):
    found = drive_kidnapped(f"sim:office,seed={seed},size=0.7,laps=2,carried=0.6,to=0.75,turned=120", gap=4.0)
    assert found.noticed <= SOON
    assert found.again <= FAR
    assert not found.confident
    assert max(found.errors) < 0.1


def test_one_that_is_kidnapped_while_it_stores_nothing_notices_and_is_recognized(office):
    run = LockStepRun(Configuration(mode="localization"), state=office.state)
    run.lock_step.feed(PoseReset())
    log = open_log(CARRIED)
    jump = START + int(0.6e9 * log.scenario.drive.duration)
    received = []
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
            received.append((since, lost))
    assert not any(lost for since, lost in received if -1.0 < since < 0.0)
    assert any(lost for since, lost in received if 0.0 < since < SOON)  # at 0.6 m/s at most
    assert not received[-1][1]
    assert run.state.processes["slam"].dropped_scans == 0


def test_an_arc_that_has_no_information_is_distinguished_from_the_least_certain_one_between_areas():
    assert is_uninformative(uninformative_belief(np.array([3.0, 4.0, 1.0])))
    assert not is_uninformative(PoseGaussian(np.zeros(3), np.diag([100.0, 100.0, 1.0]) ** 2))


def test_a_search_that_is_saved_amid_goes_on_as_it_would_have(office, monkeypatch, tmp_path):
    """In a building that it does not know, with one small region at each event, so that it takes several."""
    monkeypatch.setattr(event_work, "_MAX_WORK", 1)
    records = iter(open_log("sim:grid,seed=4,size=0.7").records())
    configuration = replace(Configuration(), tsbi=replace(Configuration().tsbi, local_reach=1.0))
    run = LockStepRun(configuration, state=office.state)
    run.lock_step.feed(PoseReset())
    for record in records:
        run.process_record(record)
        (state,) = run.state.processes["tsbi"].hypothesis_states.values()
        if state.is_lost and state.localization.search is not None:
            break
    assert state.localization.search.unexamined
    writer = FolderWriter(tmp_path)
    writer.write("tsbi", run.state.processes["tsbi"])
    writer.finish("state", 1)
    saved = FolderReader(tmp_path, "state", 1).read("tsbi", TsbiState)
    before = replace(run.state, processes={**run.state.processes, "tsbi": saved})
    other = LockStepRun(configuration, state=before)
    for record in itertools.islice(records, 80):
        run.process_record(record)
        other.process_record(record)
    one, two = (each.recorder.hypotheses[max(each.recorder.hypotheses)].hypotheses for each in (run, other))
    assert [(h.id, h.probability, h.area, h.lost) for h in one] == [(h.id, h.probability, h.area, h.lost) for h in two]
    (own,), (again,) = (each.state.processes["tsbi"].hypothesis_states.values() for each in (run, other))
    assert own.localization.searched == again.localization.searched == max(state.localization.search.poses)
