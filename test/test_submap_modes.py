"""Modes of a match: each has particles by its mass, and goes by its own map until the weights decide."""

from dataclasses import replace

import numpy as np
import pytest
from worlds import box, scan_in

import hmt_slam_ros.submap.particle_filter as module
from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.registration.scan_to_map import Prior
from hmt_slam_ros.saved_map.folder import FolderReader, FolderWriter
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import RelativeMotion, is_wide
from hmt_slam_ros.submap.local_filter import ParticleFilterState, PlacedKeyframe
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.particle_filter import ParticleFilter
from hmt_slam_ros.submap.scan_matcher import ScanMatch, ScanMatcher

SURE = np.diag([0.02, 0.02, 0.01]) ** 2
OVER_GAP = np.diag([0.4, 0.05, 0.05]) ** 2
ROOM = np.concatenate((box(-6.02, -4.03, 6.03, 7.01), box(3.51, 1.02, 4.53, 2.52), box(-4.02, 3.03, -3.52, 7.01)))
END = 7.0
RANGE = 4.0


def corridor_with_equal_niches():
    """A corridor along x with a niche every meter on both sides, closed at its right end."""
    walls = [[END, -1.2, END, 1.2]]
    for y, behind in ((-1.2, -1.5), (1.2, 1.5)):
        for x in np.arange(-12.0, END):
            near, far = x + 0.5, x + 1.0
            walls += [[x, y, near, y], [near, y, near, behind], [near, behind, far, behind], [far, behind, far, y]]
    return np.array(walls)


CORRIDOR = corridor_with_equal_niches()


@pytest.fixture(scope="module")
def mapping():
    """Maps of what is near, so that the end of the corridor shows near it alone."""
    return LocalMapping(with_changes(Configuration(), {"local_map.max_range": RANGE}))


def prepare(mapping, x, seed=0):
    """The scan at x in the corridor."""
    pose = np.array([x, 0.0, 0.0])
    scan = scan_in(CORRIDOR, pose, noise=0.01, seed=seed, field_of_view=2 * np.pi, beams=361)
    return PreparedScan(mapping, scan)


def prediction_of(x, covariance):
    motion = RelativeMotion(np.array([x, 0.0, 0.0]), covariance)
    return Prediction(motion, motion, fused=motion)


def filter_in_corridor(mapping):
    """A filter at the origin of a map of the corridor."""
    area_filter = ParticleFilter(mapping, 0, 0)
    for keyframe, x in enumerate(np.arange(-4.0, 6.1, 0.5)):
        area_filter.poses[:] = (x, 0.0, 0.0)
        area_filter.add_keyframe(keyframe, prepare(mapping, x).scan)
    area_filter.initialize(PoseGaussian.from_pose(np.zeros(3)))
    return area_filter


def filter_after_gap(mapping, truth, covariance=OVER_GAP):
    """A filter that last saw x = 0, whose odometry has 0.5 m since then."""
    area_filter = filter_in_corridor(mapping)
    area_filter.track(prepare(mapping, truth), prediction_of(0.5, covariance))
    return area_filter


def shares_of(area_filter):
    """The share of each mode in the weights."""
    weights = np.exp(area_filter.log_weights)
    return np.bincount(area_filter.state.members, weights / weights.sum())


def drive(area_filter, x, end, first_step=1):
    """Drive on from x with sure odometry; the results of the filter steps, by x."""
    steps = {}
    for k in range(1, round((end - x) / 0.25) + 1):
        prepared = prepare(area_filter.mapping, x + 0.25 * k, k)
        area_filter.track(prepared, prediction_of(0.25, SURE))
        if k % 2 == 0:
            steps[x + 0.25 * k] = area_filter.update(prepared, first_step + k)
            area_filter.add_keyframe(100 + first_step + k, prepared.scan)
    return steps


@pytest.mark.parametrize("truth", [0.0, 1.0])
def test_two_equal_modes_live_until_a_scan_tells_then_the_true_one_has_all_weight(mapping, truth):
    area_filter = filter_after_gap(mapping, truth)
    heads = sorted(area_filter.poses[:, 0])
    assert (heads[0], heads[-1]) == pytest.approx((0.0, 1.0), abs=0.05)
    np.testing.assert_allclose(shares_of(area_filter), 0.5, atol=0.1)
    # A mode that is a meter too far ahead expects the end of the corridor from here on.
    steps = drive(area_filter, truth, END - RANGE - 1.0)
    assert all(step.mode_count == 2 for step in steps.values())
    assert shares_of(area_filter).min() > 0.2
    drive(area_filter, END - RANGE - 1.0, 5.0, first_step=50)
    shares = shares_of(area_filter)
    assert shares[area_filter.state.members[area_filter.leader]] > 0.95
    np.testing.assert_allclose(area_filter.pose, [5.0, 0.0, 0.0], atol=0.05)
    np.testing.assert_allclose(area_filter.leading_keyframe_poses()[-1], [5.0, 0.0, 0.0], atol=0.05)


def test_covariances_have_what_two_modes_differ_by_once(mapping):
    area_filter = filter_after_gap(mapping, 0.0)
    assert np.sqrt(area_filter.tracking_covariance[0, 0]) == pytest.approx(0.5 * np.sqrt(2.0), rel=0.1)
    steps = drive(area_filter, 0.0, 1.0)
    along = [np.sqrt(step.match_error.drift_covariance[0, 0]) for step in steps.values()]
    assert along[0] == pytest.approx(0.5 * np.sqrt(2.0), rel=0.1)
    assert along[1] < 0.05
    informations = [step.information[0, 0] for step in steps.values()]
    assert informations[0] < 3.0
    assert informations[1] > 100.0


def test_a_match_under_a_wide_prior_has_a_bounded_number_of_modes(mapping):
    area_filter = filter_after_gap(mapping, 0.0, np.diag([1.5, 0.05, 0.05]) ** 2)
    members = area_filter.state.members
    np.testing.assert_array_equal(np.unique(members), np.arange(module.MOST_MODES))
    assert len(area_filter.state.modes) == module.MOST_MODES
    area_filter.track(prepare(mapping, 0.0), prediction_of(0.0, np.diag([1.5, 0.05, 0.05]) ** 2))
    assert len(area_filter.state.modes) == module.MOST_MODES


def test_one_mode_is_matched_once_a_scan_and_has_the_same_bits_as_if_there_were_never_more(mapping, monkeypatch):
    calls, match = [], ScanMatcher.match
    monkeypatch.setattr(ScanMatcher, "match", lambda *arguments: calls.append(1) or match(*arguments))
    first, second = filter_in_corridor(mapping), filter_in_corridor(mapping)
    steps = drive(first, 0.0, 3.0)
    assert len(calls) == 12
    assert {step.mode_count for step in steps.values()} == {1}
    monkeypatch.setattr(module, "MOST_MODES", 1)
    drive(second, 0.0, 3.0)
    for name in ("poses", "log_weights", "keyframe_poses", "tracking_covariance"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def test_a_filter_with_two_modes_goes_on_from_its_saved_state_bit_for_bit(mapping, tmp_path):
    area_filter = filter_after_gap(mapping, 0.0)
    drive(area_filter, 0.0, 0.75)
    writer = FolderWriter(tmp_path)
    writer.write("filter", area_filter.state)
    writer.finish("state of a filter", 1)
    saved = FolderReader(tmp_path, "state of a filter", 1).read("filter", ParticleFilterState)
    tables = np.stack([mapping.pool.share(table) for table in saved.tables])
    again = ParticleFilter.from_state(mapping, replace(saved, tables=tables))
    for own in (area_filter, again):
        steps = drive(own, 0.75, 4.0, first_step=50)
        assert {step.mode_count for step in steps.values()} >= {2}
    for name in ("poses", "log_weights", "keyframe_poses", "tracking_covariance"):
        np.testing.assert_array_equal(getattr(area_filter, name), getattr(again, name))


@pytest.mark.parametrize("stored", [False, True])
def test_modes_with_maps_of_their_own_end_with_these_and_others_live_on(mapping, stored):
    area_filter = filter_after_gap(mapping, 0.0)
    prepared = prepare(mapping, 0.0)
    area_filter.update(prepared, 1)
    content = [
        PlacedKeyframe(k, 0, prepare(mapping, pose[0]).scan, pose)
        for k, pose in enumerate(area_filter.leading_keyframe_poses())
    ]
    if stored:
        area_filter.add_keyframe(100, prepared.scan)
        content.append(PlacedKeyframe(100, 0, prepared.scan, area_filter.pose))
    before = area_filter.pose.copy()
    area_filter.reload(content, 0)
    np.testing.assert_allclose(area_filter.pose, before, atol=1e-9)
    spread = np.ptp(area_filter.poses[:, 0])
    assert len(area_filter.state.modes) == (1 if stored else 2)
    assert spread < 0.2 if stored else spread > 0.8
    area_filter.release()


def test_a_keyframe_leaves_the_masses_of_its_own_scan_as_they_are_far_from_the_odometry_too(monkeypatch):
    mapping = LocalMapping(Configuration())
    area_filter = ParticleFilter(mapping, 0, 0)
    area_filter.add_keyframe(0, scan_in(ROOM, np.zeros(3), field_of_view=2 * np.pi))
    odometry = RelativeMotion(np.array([4.3, 0.6, np.radians(-94.0)]), np.diag([0.5, 0.5, 0.5]) ** 2)
    vague = RelativeMotion(np.zeros(3), np.diag([2.0, 2.0, 4.0]) ** 2)
    match = ScanMatcher.match

    def with_unmatched_mode(*arguments):
        (slip,) = match(*arguments)
        assert slip.contradicts_odometry
        unmatched = slip._replace(
            pose=odometry.increment, hessian=np.zeros((3, 3)), predicted_motion=odometry, log_evidence=0.0
        )
        return [slip, unmatched._replace(contradicts_odometry=False)]

    monkeypatch.setattr(ScanMatcher, "match", with_unmatched_mode)
    truth = np.array([0.3, 0.1, np.radians(30.0)])
    prepared = PreparedScan(mapping, scan_in(ROOM, truth, noise=0.01))
    area_filter.track(prepared, Prediction(odometry, vague, fused=odometry))
    np.testing.assert_allclose(shares_of(area_filter), 0.5, atol=1e-9)
    step = area_filter.update(prepared, 1)
    np.testing.assert_allclose(shares_of(area_filter), 0.5, atol=0.1)
    error = se2.between(truth, area_filter.pose)
    assert np.hypot(*error[:2]) < 0.05
    assert abs(np.degrees(error[2])) < 1.0
    assert is_wide(step.match_error.drift_covariance, mapping.configuration.filter)


@pytest.mark.parametrize(
    ("log_mass", "at_prediction", "leads"),
    [(-4.0, 0.0, "odometry"), (-1.8, 0.0, "odometry"), (-1.4, 0.0, "slip"), (-4.0, -3.5, "slip"), (2.0, 0.0, "alone")],
)
def test_odometry_leads_on_new_ground_unless_a_slip_is_clearly_more_probable(mapping, log_mass, at_prediction, leads):
    """Odometry has the robot where the map ends, or contradicts the scan; a slip has it where the scan fits."""
    area_filter, points = filter_in_corridor(mapping), prepare(mapping, 0.0).surfels
    prior = Prior(np.array([40.0, 0.0, 0.0]), np.linalg.inv(OVER_GAP))
    motion = RelativeMotion(prior.mean, OVER_GAP)
    predicted = ScanMatch(prior.mean, np.zeros((3, 3)), prior, motion, at_prediction, at_prediction)
    slip = ScanMatch(np.zeros(3), np.eye(3), prior, motion, 0.0, log_mass, contradicts_odometry=True)
    modes = ScanMatcher(mapping)._select_modes(points, slip, [predicted, slip], area_filter._leading_view())
    assert len(modes) == (1 if leads == "alone" else 2)
    assert modes[0].contradicts_odometry == (leads != "odometry")
