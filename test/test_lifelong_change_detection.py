"""Mode lifelong: what stays is stored, what is gone is left out, and who walks through does neither."""

import dataclasses

import numpy as np
import pytest
from worlds import box, scan_in

from benchmark.one_drive import JoinedVisits
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.lifelong.change_detection import RecentScan, append_recent_scan, combine_stale_beams, detect_changes
from hmt_slam_ros.messages.documents import KeyframeHeader, encode
from hmt_slam_ros.messages.map_changes import StaleBeams
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.results.hmt_map import MapWriter, read_run_state
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.polar_scan import FREE, SURFACE, UNKNOWN, classify_points, occlusion_starts, to_polar_scan
from hmt_slam_ros.sensors.scan import BeamRevision
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.submap.local_filter import PlacedKeyframe

ROOM = box(-5.0, -3.0, 5.0, 3.0)
CUPBOARD = box(2.0, 0.5, 2.6, 1.7)
SECOND = 1_000_000_000
WAY = np.array([[-2.0, 0.0, 0.0], [-1.5, 0.0, 0.0], [-1.0, 0.0, 0.0], [-0.5, 0.0, 0.0]])
NOW = np.array([0.0, 0.0, 0.0])


def room(*things):
    return np.concatenate((ROOM, *things))


def scans_in(*worlds, apart=SECOND):
    """A scan from each pose of the path, in the world at that time."""
    pairs = enumerate(zip(worlds, WAY, strict=False))
    return tuple(RecentScan(scan_in(walls, pose, stamp=n * apart, beams=361), pose) for n, (walls, pose) in pairs)


def keyframes(walls):
    return [PlacedKeyframe(n, 0, scan_in(walls, pose, beams=361), pose) for n, pose in enumerate(WAY)]


def changes(before, now, recent=None):
    """The changes between a scan now and a map of before."""
    scan = RecentScan(scan_in(now, NOW, stamp=10 * SECOND, beams=361), NOW)
    return detect_changes(
        scan, scans_in(now, now, now) if recent is None else recent, keyframes(before), Configuration().filter
    )


def ends(keyframe, beams):
    """Where beams end of a keyframe's scan, map frame."""
    points = keyframe.scan.points + keyframe.pose[:2]
    return points[beams[keyframe.scan.valid]]


def test_a_polar_scan_separates_surface_free_space_and_occluded_space():
    view = to_polar_scan(scan_in(room(CUPBOARD), NOW, beams=361))
    places = np.array([[2.0, 1.0], [1.0, 0.5], [4.0, 2.0], [5.0, -2.0], [-1.0, 0.0], [4.8, -1.0], [2.0, 0.45]])
    assert classify_points(view, places).tolist() == [SURFACE, FREE, UNKNOWN, SURFACE, UNKNOWN, UNKNOWN, SURFACE]
    starts = occlusion_starts(view, np.array([[1.0, 0.5], [2.0, 0.45]]))
    assert (np.abs(starts - np.hypot(1.0, 0.5) - 1.0) < 1e-9).sum() > 5
    assert (starts[starts > 0.0] < view.ranges[starts > 0.0]).all()
    assert not occlusion_starts(view, np.array([[4.0, 2.0]])).any()


@pytest.mark.parametrize("increment", [1, -1])
def test_a_view_of_a_laser_that_hangs_upside_down_or_moves_in_the_sweep_is_the_same(increment):
    poses = np.stack((np.linspace(0.0, 0.1, 361), np.zeros(361), np.zeros(361)), axis=1)
    swept = scan_in(room(CUPBOARD), poses, beams=361, field_of_view=increment * np.pi)
    moving = dataclasses.replace(swept, motion=np.array([0.1, 0.0, 0.0]))
    places = np.array([[2.0, 1.0], [1.0, 0.5], [4.0, 2.0]])
    assert classify_points(to_polar_scan(moving), places).tolist() == [SURFACE, FREE, UNKNOWN]


def test_an_unchanged_room_has_no_changes():
    found = changes(room(CUPBOARD), room(CUPBOARD))
    assert (found.has_new_surface, found.has_changed_surface) == (False, False)
    assert not any(late.seen_through.any() or late.starts.any() for late in found.stale_beams.values())


def test_furniture_that_came_is_stored_and_beams_that_pass_it_are_out_of_date():
    found = changes(room(), room(CUPBOARD))
    assert found.has_changed_surface
    for keyframe in keyframes(room()):
        late = found.stale_beams[keyframe.keyframe]
        passed = ends(keyframe, late.starts > 0.0)
        assert len(passed) > 5
        assert (passed[:, 0] > 2.3).all()
        assert not late.seen_through.any()


def test_of_furniture_that_is_gone_every_beam_is_out_of_date():
    found = changes(room(CUPBOARD), room())
    for keyframe in keyframes(room(CUPBOARD)):
        gone = found.stale_beams[keyframe.keyframe].seen_through
        on = np.zeros(361, dtype=bool)
        on[keyframe.scan.valid] = np.abs(keyframe.scan.points + keyframe.pose[:2] - [2.3, 1.1]).max(axis=1) < 0.61
        assert on.sum() > 10
        assert (on == gone).mean() > 0.98


def test_people_who_walk_by_are_no_change():
    """A person as wide as the cupboard, elsewhere in every scan."""
    at = [box(x, -1.0, x + 0.4, -0.6) for x in (1.0, 1.6, 2.2)]
    found = changes(room(), room(box(2.8, -1.0, 3.2, -0.6)), scans_in(*(room(person) for person in at)))
    assert (found.has_new_surface, found.has_changed_surface) == (False, False)
    assert not any(late.seen_through.any() or late.starts.any() for late in found.stale_beams.values())


def test_a_wrong_pose_makes_no_beams_stale():
    found = changes(room(), room() * [0.6, 0.4, 0.6, 0.4])
    assert not found.has_changed_surface
    assert not found.stale_beams


def test_recent_scans_are_few_and_a_second_apart():
    recent = ()
    for recent_scan in scans_in(*[room()] * 4, apart=SECOND // 2):
        recent = append_recent_scan(recent, recent_scan)
    assert [recent_scan.scan.stamp for recent_scan in recent] == [0, SECOND]
    for n in range(5):
        recent = append_recent_scan(recent, RecentScan(scan_in(room(), NOW, stamp=(2 + n) * SECOND), NOW))
    assert len(recent) == 3


def test_hypotheses_have_to_agree_on_stale_beams():
    one, other = changes(room(CUPBOARD), room()), changes(room(), room())
    assert combine_stale_beams([(one, 0.97), (other, 0.03)])
    assert combine_stale_beams([(one, 0.6), (other, 0.4)]) == ()
    assert combine_stale_beams([]) == ()


def test_beams_are_left_out_of_a_scan_once_for_all_who_hold_it():
    scan = scan_in(room(), NOW, beams=361)
    less = scan.revise(BeamRevision((3, 4), (180,), (1.5,)))
    assert less is scan.revise(BeamRevision((3, 4), (180,), (1.5,)))
    assert np.flatnonzero(scan.valid & ~less.valid).tolist() == [3, 4]
    assert len(less.points) == len(scan.points) - 2


@pytest.mark.parametrize("motion", [0.0, 0.1])
def test_an_occluded_beam_keeps_its_end_and_loses_the_free_space_before_it(motion):
    poses = np.stack((np.linspace(0.0, motion, 361), np.zeros(361), np.zeros(361)), axis=1)
    scan = dataclasses.replace(scan_in(room(), poses, beams=361), motion=np.array([motion, 0.0, 0.0]))
    thing = np.array([[2.0, 0.0], [2.0, 0.1]])
    starts = occlusion_starts(to_polar_scan(scan), thing)
    cut = np.flatnonzero(starts)
    less = scan.revise(BeamRevision((), tuple(cut.tolist()), tuple(starts[cut].tolist())))
    assert (less.points == scan.points).all()
    places = np.array([[5.0, 0.0], [2.0, 0.05], [4.0, 0.1], [1.0, -1.0]])
    assert classify_points(to_polar_scan(scan), places).tolist() == [SURFACE, FREE, FREE, FREE]
    assert classify_points(to_polar_scan(less), places).tolist() == [SURFACE, UNKNOWN, FREE, FREE]
    away = less.origins[np.isin(np.flatnonzero(less.valid), cut)]
    assert (away[:, 0] > 2.9).all()
    assert (away[:, 0] < 3.1).all()
    assert len(away) >= 4


WORLD = "sim:office,seed=1000,size=0.7,rate=2.5,laps=1,visit={}"
LIFELONG = dataclasses.replace(Configuration(), mode="lifelong")
MIDDLE, END = 70, 110


def read(run, records):
    """The keyframes of a run meanwhile, and its state then."""
    for record in records:
        run.process_record(record)
    return [run.recorder.keyframes[k] for k in sorted(run.recorder.keyframes)], run.state


@pytest.fixture(scope="module")
def visits(tmp_path_factory):
    """The state after a visit; of a second one the keyframes, what was read of it, in two parts, and the states."""
    log = JoinedVisits([open_simulated(WORLD.format(number)) for number in (1, 2)])
    records, first = list(log.records()), log.scan_count // 2
    scans = np.cumsum([isinstance(record.measurement, Scan) for record in records])
    ends = [int(np.searchsorted(scans, count, side="right")) for count in (first, first + MIDDLE, first + END)]
    _, before = read(LockStepRun(Configuration()), records[: ends[0]])
    run = LockStepRun(LIFELONG, state=before)
    _, middle = read(run, records[ends[0] : ends[1]])
    folder = tmp_path_factory.mktemp("middle") / "hmt_map"
    writer = MapWriter(folder)
    writer.write_state(middle)
    writer.finish(LIFELONG)
    rest = records[ends[1] : ends[2]]
    messages, after = read(run, rest)
    return before, folder, rest, messages, after


def test_every_process_leaves_the_same_beams_out_and_little_is_stored(visits):
    before, _, _, messages, after = visits
    stored = [any(estimate.stored for estimate in message.estimates) for message in messages]
    assert 0 < sum(stored) < 0.4 * len(stored)
    assert all(message.mapping for message in messages)
    scans = after.processes["slam"].replica.scans
    for replica in (
        after.processes["aam"].replica,
        after.processes["tsbi"].replica,
        after.processes["tlca"].replica,
        after.recorder.replica,
    ):
        assert replica.scans.keys() == scans.keys()
        assert all(scan is scans[keyframe] for keyframe, scan in replica.scans.items())
    stale = [one for message in messages for one in message.stale_beams]
    assert all(isinstance(one, StaleBeams) for one in stale)
    old = [one for one in stale if one.keyframe in before.processes["slam"].replica.scans and one.keyframe in scans]
    assert len(old) > 10
    for one in old:
        assert not scans[one.keyframe].valid[list(one.removed)].any()
    cut = [one for one in old if one.occluded]
    assert cut
    for one in cut:
        starts = scans[one.keyframe].starts[list(one.occluded)]
        assert (starts >= np.float32(one.starts)).all()


def test_a_run_that_continues_from_its_state_has_the_same_messages(visits):
    _, folder, rest, messages, _ = visits
    middle, _ = read_run_state(folder)
    assert any(live.event.recent_scans for live in middle.processes["slam"].live_hypotheses.values())
    again, _ = read(LockStepRun(LIFELONG, state=middle), rest)
    same = messages[-len(again) :]
    assert [encode(KeyframeHeader.from_keyframe(one)) for one in again] == [
        encode(KeyframeHeader.from_keyframe(one)) for one in same
    ]
    assert any(one.stale_beams for one in again)
