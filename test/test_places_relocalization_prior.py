"""Evidence of landmarks for the place of a robot that starts lost in a map."""

import math

import numpy as np
import pytest

from benchmark.heading import keyframes_of
from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.landmarks.area_landmarks import GrowingArea
from hmt_slam_ros.places.area_views import AreaViewCache
from hmt_slam_ros.places.relocalization_prior import RelocalizationPrior
from hmt_slam_ros.registration.area_to_area import MatchMode
from hmt_slam_ros.registration.consistency import Agreement
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.submap.local_mapping import LocalMapping
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate
from hmt_slam_ros.topological_inference.pose_distribution import UNMAPPED_PRIOR, PoseDistribution

CONFIGURATION = with_changes(Configuration(), {"places.prior_temper": 0.5})


def place_prior(scans):
    return RelocalizationPrior(CONFIGURATION, AreaViewCache(LocalMapping(CONFIGURATION), scans))


def make_candidate(pose, area=0):
    belief = PoseGaussian(np.asarray(pose, dtype=float), np.eye(3) * 1e-4)
    return PoseCandidate(area, MatchMode(belief, belief, 0.0), Agreement(0, 0, 0))


@pytest.fixture(scope="module")
def drive():
    """A map of the first round through a building; and of the second one some keyframes beside a door."""
    scenario = open_simulated("sim:office,seed=3,size=0.7,laps=2").scenario
    poses = scenario.true_poses(scenario.scan_stamps)
    numbers = keyframes_of(poses, Configuration())
    first = [n for n in numbers if n < len(poses) // 2]
    second = [n for n in numbers if n > len(poses) // 2][10:20]
    scans, hybrid_map = {}, HybridMap()
    for k, n in enumerate(first):
        scans[k] = scenario.scan(n)
        hybrid_map.set_keyframe(k, 0, se2.between(poses[first[0]], poses[n]))
    before = len(first)
    for k, n in enumerate(second, start=before):
        scans[k] = scenario.scan(n)
    seen = {before + i: se2.between(poses[second[0]], poses[n]) for i, n in enumerate(second)}
    return hybrid_map, scans, seen, before, se2.between(poses[first[0]], poses[second[0]])


def test_landmarks_speak_for_the_right_place_and_against_others(drive):
    hybrid_map, scans, seen, before, true = drive
    along = [se2.compose(true, np.array([shift, 0.0, 0.0])) for shift in (-2.0, 2.0, 5.0)]
    turned = se2.compose(true, np.array([0.0, 0.0, math.pi]))
    right, *others = place_prior(scans).log_ratios(
        hybrid_map, seen, before, [make_candidate(pose) for pose in (true, *along, turned)]
    )
    assert right > 1.0
    assert max(others) < right - 5.0
    # A place a few centimeters off is the same one.
    (near,) = place_prior(scans).log_ratios(
        hybrid_map, seen, before, [make_candidate(se2.compose(true, np.array([0.05, 0.05, 0.01])))]
    )
    assert abs(near - right) < 3.0


class AllLandmarks(RelocalizationPrior):
    """Leaves out no landmark of the map before it selects those within reach."""

    def _landmarks_at(self, hybrid_map, before, placements, frame):
        for area, pose in placements:
            known = self._known_around(hybrid_map, area, before)
            yield list(known.landmarks), se2.compose(se2.inverse(pose), known.poses)


def test_a_landmark_counts_within_reach_along_the_axis_however_far_across_it_is(drive):
    hybrid_map, scans, seen, before, true = drive
    found = [make_candidate(se2.compose(true, np.array([shift, 0.0, 0.0]))) for shift in (0.0, 2.0)]
    for reach in (0.5, 1.5):
        changed = with_changes(CONFIGURATION, {"places.reach": reach})
        views = AreaViewCache(LocalMapping(changed), scans)
        near, everything = (
            kind(changed, views).log_ratios(hybrid_map, seen, before, found)
            for kind in (RelocalizationPrior, AllLandmarks)
        )
        np.testing.assert_allclose(near, everything, atol=1e-9)


def test_landmarks_that_should_be_visible_and_are_not_speak_against_a_place(drive):
    """Ground without landmarks, far from the map, has none to miss."""
    hybrid_map, scans, seen, before, true = drive
    shifts = ([100.0, 100.0, 0.0], [0.0, 2.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0])
    found = [make_candidate(se2.compose(true, np.array(shift))) for shift in shifts]
    bare, *others = place_prior(scans).log_ratios(hybrid_map, seen, before, found)
    assert max(others) < bare - 1.0


def test_what_speaks_against_places_weighs_them_with_an_exponent(drive):
    hybrid_map, scans, seen, before, true = drive
    prior = place_prior(scans)
    found = (make_candidate(true), make_candidate(se2.compose(true, np.array([2.0, 0.0, 0.0]))), make_candidate(true))
    where = PoseDistribution(found, np.array([0.4, 0.4, 5e-4]))
    ratios = prior.log_ratios(hybrid_map, seen, before, found)
    expected = np.array([0.4, 0.4, 5e-4]) * np.exp([0.0, 0.5 * ratios[1], 0.0])
    # That landmarks agree in a place says no more than its surfaces.
    assert ratios[0] > 0.0 > ratios[1]
    weighed = prior.reweight(where, hybrid_map, seen, before)
    np.testing.assert_allclose(weighed.probabilities, expected / (expected.sum() + 1.0 - 0.8005), rtol=1e-9)
    assert weighed.candidates is found


def test_a_look_finds_the_landmarks_gathered_at_the_events_before(drive, monkeypatch):
    hybrid_map, scans, seen, before, true = drive
    prior, found = place_prior(scans), (make_candidate(se2.compose(true, np.array([2.0, 0.0, 0.0]))),)
    where, sighting = PoseDistribution(found, np.array([0.8])), GrowingArea.observe_keyframe
    looked_at = []
    monkeypatch.setattr(
        GrowingArea, "observe_keyframe", lambda *requested: looked_at.append(requested) or sighting(*requested)
    )
    steps = CONFIGURATION.tsbi.recheck_keyframes - 1
    for _ in range(steps):
        known = len(looked_at)
        # Two hypotheses, whose maps are the same up to there.
        prior.prefetch([(hybrid_map, before), (hybrid_map.branch(), before)])
        assert len(looked_at) - known <= math.ceil(before / steps)
    assert len(looked_at) == before
    assert prior.reweight(where, hybrid_map, seen, before).probabilities[0] < 0.8
    assert len(looked_at) == before + len(seen)


def test_where_keyframes_of_the_map_moved_it_is_evaluated_again(drive):
    hybrid_map, scans, seen, before, true = drive
    prior = place_prior(scans)
    place = [make_candidate(true)]
    (requested,) = prior.log_ratios(hybrid_map, seen, before, place)
    moved, shift = hybrid_map.branch(), np.array([3.0, -2.0, 0.0])
    for k, pose in hybrid_map.keyframes(0).items():
        moved.set_keyframe(k, 0, se2.compose(shift, pose))
    (off,) = prior.log_ratios(moved, seen, before, place)
    (there,) = prior.log_ratios(moved, seen, before, [make_candidate(se2.compose(shift, true))])
    assert there == pytest.approx(requested, abs=1.0)
    assert off < requested - 3.0


def test_new_ground_looks_like_the_places_of_the_map(drive):
    hybrid_map, scans, seen, before, _ = drive
    only = HybridMap()
    for k in (0, 1):
        only.set_keyframe(k, 0, hybrid_map.keyframes(0)[k])
    newest = seen[max(seen)]
    same = [make_candidate(se2.compose(pose, se2.inverse(newest))) for pose in only.keyframes(0).values()]
    ratios = place_prior(scans).log_ratios(only, seen, before, same)
    # All that is known of it are these two, of which it is one or the other with a probability of 0.9.
    assert np.exp(ratios).mean() < 1.0 / 0.9


def test_a_map_of_places_that_all_fit_speaks_for_none_of_them(drive):
    hybrid_map, scans, seen, before, true = drive
    newest = se2.compose(true, seen[max(seen)])
    keyframes = hybrid_map.keyframes(0)
    near = sorted(keyframes, key=lambda k: np.abs(se2.between(newest, keyframes[k])).sum())[:2]
    only = HybridMap()
    for k in near:
        only.set_keyframe(k, 0, keyframes[k])
    same = [make_candidate(se2.compose(keyframes[k], se2.inverse(seen[max(seen)]))) for k in near]
    ratios = place_prior(scans).log_ratios(only, seen, before, same)
    # With the mean ratio m of the places against unknown ground, that against unmapped ground is m / (0.1 + 0.9 m).
    assert 1.0 < np.exp(ratios).mean() < 1.0 / 0.9


def test_without_a_landmark_or_a_place_nothing_changes(drive):
    hybrid_map, scans, seen, before, _ = drive
    prior = place_prior(scans)
    assert prior.log_ratios(hybrid_map, seen, before, []) is None
    nowhere = PoseDistribution((), np.zeros(0))
    assert prior.reweight(nowhere, hybrid_map, seen, before).probabilities.size == 0


def test_weights_follow_bayes_and_stay_finite():
    where = PoseDistribution(
        (make_candidate(np.zeros(3)), make_candidate(np.ones(3))), np.array([0.3, 1.0 - UNMAPPED_PRIOR - 0.3])
    )
    np.testing.assert_allclose(where.reweight([0.0, 0.0]).probabilities, where.probabilities)
    weighed = where.reweight([math.log(4.0), 0.0]).probabilities
    np.testing.assert_allclose(weighed, np.array([1.2, 0.5]) / 1.9)
    np.testing.assert_allclose(where.reweight([5000.0, 0.0]).probabilities, [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(where.reweight([-5000.0, -5000.0]).probabilities, [0.0, 0.0], atol=1e-12)
