"""Faults of real sensors: what each does to the records of a stretch, where, and that everything else stays."""

from itertools import pairwise

import numpy as np
import pytest

from benchmark.real_faults import obstructions, odometry_faults, scan_faults
from benchmark.real_faults.faulty_run import plant
from benchmark.real_faults.kinds import BY_NAME, KINDS
from benchmark.real_faults.stream import ListedLog, odometry_path, seconds_of
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Odometry, Scan

WORLD = "sim:office,seed=1,size=0.7"
FULL_TURN = "sim:office,seed=1,size=0.7,field_of_view=360,beams=720"


@pytest.fixture(scope="module")
def drive():
    """A drive of 150 s."""
    return list(open_log(WORLD, duration=150.0).records())


@pytest.fixture(scope="module")
def all_around():
    """A drive of 30 s with a laser that sees all around."""
    return list(open_log(FULL_TURN, duration=30.0).records())


def random(seed=0):
    return np.random.Generator(np.random.Philox(key=[seed, 0]))


def scans(records):
    return [record.measurement for record in records if isinstance(record.measurement, Scan)]


def poses(records):
    return odometry_path(records).poses


def odometry_stamps(records):
    return np.array([record.measurement.stamp for record in records if isinstance(record.measurement, Odometry)])


def inside(seconds, place):
    return (seconds > place.begin) & (seconds < place.begin + place.seconds)


def returns(scan):
    """Ranges (n,), m, inf without a return."""
    return np.where(scan.valid, scan.ranges, np.inf)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_every_fault_keeps_the_order_and_depends_on_its_seed_alone(kind, drive, all_around):
    log = ListedLog("log", all_around if kind.sources == ("full-turn",) else drive)
    faulty, again = plant(kind.name, log, 3), plant(kind.name, log, 3)
    assert faulty.places == again.places
    for record, same in zip(faulty.records, again.records, strict=True):
        assert (record.source_stamp, record.measurement.stamp) == (same.source_stamp, same.measurement.stamp)
        if isinstance(record.measurement, Scan):
            np.testing.assert_array_equal(record.measurement.ranges, same.measurement.ranges)
        else:
            np.testing.assert_array_equal(record.measurement.pose, same.measurement.pose)
    assert (np.diff(seconds_of(faulty.records)) >= 0.0).all()
    assert (np.diff(odometry_stamps(faulty.records)) > 0).all()
    assert (np.diff([scan.stamp for scan in scans(faulty.records)]) > 0).all()
    assert len(faulty.records) != len(log.listed) or any(
        record is not own for record, own in zip(faulty.records, log.listed, strict=True)
    )


def test_no_fault_and_an_unknown_one(drive):
    log = ListedLog("log", drive)
    assert plant("none", log, 0).records == drive
    with pytest.raises(HmtSlamError, match="'rust' is no kind of fault: choose one of frozen-in-turns"):
        plant("rust", log, 0)


@pytest.mark.parametrize("fault", [odometry_faults.freeze_in_turns, odometry_faults.freeze_on_straights])
def test_frozen_readings_repeat_while_the_robot_turns_or_drives_straight(drive, fault):
    faulty, path = fault(drive, random()), odometry_path(drive)
    assert len(faulty.places) == 3
    frozen = np.zeros(path.seconds.size, dtype=bool)
    for place in faulty.places:
        assert 0.5 <= place.seconds <= 3.0
        rows = inside(path.seconds, place)
        start = path.poses_at(np.array([place.begin]))[0]
        np.testing.assert_allclose(poses(faulty.records)[rows][:, :2], np.tile(start[:2], (rows.sum(), 1)))
        (end,) = path.poses_at(np.array([place.begin + 0.5]))
        turned, driven = abs(se2.wrap(end[2] - start[2])), np.hypot(*(end - start)[:2])
        assert turned > np.radians(5.0) if fault is odometry_faults.freeze_in_turns else driven > 0.05
        frozen |= rows
    np.testing.assert_array_equal(poses(faulty.records)[~frozen], path.poses[~frozen])
    np.testing.assert_array_equal(odometry_stamps(faulty.records), odometry_stamps(drive))


def test_the_odometry_jumps_three_times_and_goes_on_from_there(drive):
    faulty, path = odometry_faults.jump(drive, random()), odometry_path(drive)
    steps, true_steps = (se2.between(own[:-1], own[1:]) for own in (poses(faulty.records), path.poses))
    jumps = se2.between(true_steps, steps)
    distances = np.hypot(jumps[:, 0], jumps[:, 1])
    at = np.flatnonzero(distances > 1e-6)
    np.testing.assert_allclose(path.seconds[at], [place.begin for place in faulty.places])
    np.testing.assert_allclose(distances[at], [place.amount for place in faulty.places])
    assert len(at) == 3
    assert (distances[at] >= 0.3).all()
    assert (distances[at] <= 3.0).all()
    assert (np.abs(jumps[at, 2]) <= np.radians(90.0)).all()


def test_the_odometry_begins_at_zero_again_twice(drive):
    faulty, path = odometry_faults.reset_to_zero(drive, random()), odometry_path(drive)
    rows = np.searchsorted(path.seconds, [place.begin for place in faulty.places])
    assert len(rows) == 2
    np.testing.assert_allclose(poses(faulty.records)[rows], 0.0, atol=1e-12)
    assert np.hypot(*path.poses[rows, :2].T).min() > 1.0
    own = poses(faulty.records)
    steps, true_steps = se2.between(own[:-1], own[1:]), se2.between(path.poses[:-1], path.poses[1:])
    others = np.setdiff1d(np.arange(len(steps)), rows - 1)
    np.testing.assert_allclose(steps[others], true_steps[others], atol=1e-9)


def test_turns_are_scaled_and_ways_are_not(drive):
    factors = []
    for seed in range(8):
        faulty = odometry_faults.scale_turns(drive, random(seed))
        steps, true_steps = (se2.between(own[:-1], own[1:]) for own in (poses(faulty.records), poses(drive)))
        np.testing.assert_allclose(steps[:, :2], true_steps[:, :2], atol=1e-9)
        turning = np.abs(true_steps[:, 2]) > 1e-4
        ratios = steps[turning, 2] / true_steps[turning, 2]
        np.testing.assert_allclose(ratios, 1.0 + faulty.places[0].amount, atol=1e-6)
        factors.append(ratios[0])
    errors = np.abs(np.array(factors) - 1.0)
    assert ((errors >= 0.05) & (errors <= 0.15)).all()
    assert min(factors) < 1.0 < max(factors)


def test_the_clock_of_the_odometry_is_off_by_the_same_time_throughout(drive):
    offsets = []
    for seed in range(8):
        faulty = odometry_faults.offset_clock(drive, random(seed))
        shifts = (odometry_stamps(faulty.records) - odometry_stamps(drive)) * 1e-9
        np.testing.assert_allclose(shifts, faulty.places[0].amount, atol=1e-9)
        offsets.append(shifts[0])
        assert [scan.stamp for scan in scans(faulty.records)] == [scan.stamp for scan in scans(drive)]
    assert ((np.abs(offsets) >= 0.05) & (np.abs(offsets) <= 0.3)).all()
    assert min(offsets) < 0.0 < max(offsets)


def test_readings_come_late_and_in_batches(drive):
    faulty = odometry_faults.deliver_in_batches(drive, random())
    np.testing.assert_array_equal(poses(faulty.records), poses(drive))
    late = (odometry_stamps(faulty.records) - odometry_stamps(drive)) * 1e-9
    seconds, arrivals = odometry_path(drive).seconds, odometry_path(faulty.records).seconds
    touched = np.zeros(seconds.size, dtype=bool)
    for place in faulty.places:
        during = (seconds >= place.begin) & (seconds < place.begin + place.seconds)
        assert 0.3 <= place.amount <= 1.0
        assert late[during].max() > 0.5 * place.amount
        pauses = np.diff(arrivals[during])
        assert pauses.max() > 0.7 * place.amount
        assert np.median(pauses) == pytest.approx(1e-3)
        touched |= (seconds >= place.begin) & (seconds < place.begin + place.seconds + place.amount)
    assert (late >= 0.0).all()
    np.testing.assert_array_equal(late[~touched], 0.0)


def test_a_gap_in_motion_has_no_scans_and_all_odometry(drive):
    lengths = []
    for seed in range(20):
        faulty = scan_faults.drop_scans_in_motion(drive, random(seed))
        (place,) = faulty.places
        first = drive[0].measurement.stamp
        scan_seconds = [np.array([1e-9 * (s.stamp - first) for s in scans(own)]) for own in (faulty.records, drive)]
        assert not inside(scan_seconds[0], place).any()
        gone = int(inside(scan_seconds[1], place).sum())
        assert gone >= 4
        assert len(scan_seconds[0]) == len(scan_seconds[1]) - gone
        np.testing.assert_array_equal(poses(faulty.records), poses(drive))
        assert place.amount > 0.1 * place.seconds
        lengths.append(place.seconds)
    assert min(lengths) < 5.0
    assert 20.0 < max(lengths) <= 0.4 * 150.0


def test_a_gap_at_rest_moves_all_later_stamps_and_nothing_else(drive):
    readings = set()
    for seed in range(8):
        faulty = scan_faults.pause(drive, random(seed))
        (place,) = faulty.places
        shifts = np.array([a.stamp - b.stamp for a, b in zip(scans(faulty.records), scans(drive), strict=True)]) * 1e-9
        assert set(np.round(shifts, 6)) == {0.0, round(place.seconds, 6)}
        # Scans are found again by their source stamps.
        assert [r.source_stamp for r in faulty.records if isinstance(r.measurement, Scan)] == [
            r.source_stamp for r in drive if isinstance(r.measurement, Scan)
        ]
        path = odometry_path(faulty.records)
        rows = inside(path.seconds, place)
        assert len(np.unique(path.poses[rows], axis=0)) <= 1
        readings.add(bool(rows.any()))
        assert len(poses(faulty.records)) == len(poses(drive)) + rows.sum()
    assert readings == {True, False}


def test_one_scan_a_second_is_left(drive):
    faulty = scan_faults.scan_slowly(drive, random())
    stamps = np.array([scan.stamp for scan in scans(faulty.records)]) * 1e-9
    assert len(stamps) == pytest.approx(150, abs=2)
    np.testing.assert_allclose(np.diff(stamps), 1.0)
    np.testing.assert_array_equal(poses(faulty.records), poses(drive))


def test_one_beam_a_degree_is_left_where_it_was(drive):
    for seed in range(4):
        thin, fine = scans(scan_faults.thin_to_one_degree(drive, random(seed)).records)[7], scans(drive)[7]
        assert np.degrees(thin.angle_increment) == pytest.approx(1.0)
        assert thin.ranges.size in {180, 181}
        points = {tuple(np.round(point, 4)) for point in fine.points}
        assert {tuple(np.round(point, 4)) for point in thin.points} <= points


def test_180_and_181_beams_come_in_turn(drive):
    counts = [scan.ranges.size for scan in scans(scan_faults.vary_beam_count(drive, random()).records)]
    assert set(counts[::2] + counts[1::2]) == {180, 181}
    assert len(set(counts[::2])) == len(set(counts[1::2])) == 1
    longer = next(s for s in scans(scan_faults.vary_beam_count(drive, random()).records) if s.ranges.size == 181)
    assert np.isinf(longer.ranges[-1])


def test_a_short_reach_leaves_near_returns_alone(drive):
    for short, far in zip(scans(scan_faults.shorten_reach(drive, random()).records), scans(drive), strict=True):
        assert short.range_max == 4.0
        np.testing.assert_array_equal(returns(short), np.where(returns(far) < 4.0, returns(far), np.inf))
    assert any((returns(far) > 5.0).any() for far in scans(drive))


def test_a_narrow_view_leaves_240_degrees(all_around):
    narrow, full = scans(scan_faults.narrow_view(all_around, random()).records)[3], scans(all_around)[3]
    angles = np.degrees(narrow.angle_min + narrow.angle_increment * np.arange(narrow.ranges.size))
    assert angles.min() == pytest.approx(-120.0, abs=0.51)
    assert angles.max() == pytest.approx(120.0, abs=0.51)
    assert {tuple(np.round(p, 4)) for p in narrow.points} < {tuple(np.round(p, 4)) for p in full.points}


def test_every_tenth_scan_is_empty(drive):
    empty = [not scan.valid.any() for scan in scans(scan_faults.empty_some_scans(drive, random()).records)]
    at = np.flatnonzero(empty)
    assert (np.diff(at) == 10).all()
    assert len(at) == pytest.approx(len(empty) / 10, abs=1)
    assert all(scan.valid.any() for scan in scans(drive))


def changed_scans(faulty, drive):
    """Seconds and both scans of every scan that differs."""
    first, pairs = drive[0].measurement.stamp, zip(scans(faulty.records), scans(drive), strict=True)
    return [(1e-9 * (own.stamp - first), own, true) for own, true in pairs if own is not true]


def test_carts_on_both_sides_leave_a_median_range_below_a_meter(drive):
    faulty = obstructions.narrow_doorways(drive, random())
    found = changed_scans(faulty, drive)
    assert len(faulty.places) == 4
    for place in faulty.places:
        near = [(own, true) for at, own, true in found if place.begin <= at < place.begin + place.seconds]
        medians = [np.median(returns(own)) for own, _ in near]
        assert sum(np.array(medians) < 1.0) >= 3
        assert np.median([np.median(returns(true)) for _, true in near]) > 1.0
        # What the carts do not hide is seen as before.
        for own, true in near:
            shorter = returns(own) < returns(true) - 0.05
            np.testing.assert_array_equal(
                returns(own)[~shorter & (returns(true) > 3.0)], returns(true)[~shorter & (returns(true) > 3.0)]
            )
    assert all(any(place.begin <= at <= place.begin + place.seconds for place in faulty.places) for at, _, _ in found)


def test_carts_stand_still_while_the_robot_passes(drive):
    """The nearest sides of both carts are walls at the same places of the odometry's frame in all scans."""
    faulty = obstructions.narrow_doorways(drive, random())
    place = faulty.places[0]
    path = odometry_path(drive)
    frame = path.poses_at(np.array([place.begin + 0.5 * place.seconds]))[0]
    sides = []
    for at, own, true in changed_scans(faulty, drive):
        if place.begin <= at < place.begin + place.seconds:
            hidden = (returns(own) < returns(true) - 0.1)[own.valid]
            world = se2.transform(path.poses_at(np.array([at]))[0], own.points[hidden])
            sides.append(se2.transform(se2.inverse(frame), world))
    offsets = np.concatenate(sides)
    np.testing.assert_allclose(np.median(np.abs(offsets[:, 1])), 0.5 * place.amount, atol=0.02)
    assert np.abs(offsets[:, 0]).max() < 0.9 + 0.05


def test_people_of_a_crowd_hide_walls_and_move(drive):
    faulty = obstructions.crowd(drive, random())
    found = changed_scans(faulty, drive)
    hidden = [returns(own) < returns(true) - 0.1 for _, own, true in found]
    shares = np.array([mask.mean() for mask in hidden])
    assert len(faulty.places) == 3
    assert 0.05 < shares.mean() < 0.7
    # None is nearer than allowed, and from one scan to the next other beams are hidden.
    assert min(returns(own)[mask].min() for (_, own, _), mask in zip(found, hidden, strict=True) if mask.any()) > 0.25
    assert np.mean([(a != b).mean() for a, b in pairwise(hidden)]) > 0.02
    assert all(any(place.begin <= at <= place.begin + place.seconds for place in faulty.places) for at, _, _ in found)


def test_faults_need_a_place(drive):
    standing = [record for record in drive if record.measurement.stamp < drive[0].measurement.stamp + 5_000_000_000]
    for fault in (odometry_faults.freeze_in_turns, odometry_faults.jump, scan_faults.pause, obstructions.crowd):
        with pytest.raises(HmtSlamError, match="no place for this fault"):
            fault(standing, random())
    with pytest.raises(HmtSlamError, match="without odometry"):
        odometry_faults.jump([record for record in drive if isinstance(record.measurement, Scan)], random())


def test_kinds_have_names_descriptions_and_draws_of_their_own():
    assert len(BY_NAME) == len(KINDS) == 17
    assert all(kind.description.endswith(".") for kind in KINDS)
    draws = {kind.random(log, seed).random() for kind in KINDS for log in ("aces", "intel") for seed in range(3)}
    assert len(draws) == 17 * 2 * 3
