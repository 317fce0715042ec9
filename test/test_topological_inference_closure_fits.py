"""Weights of fits by their equations, what is learned of similar places, and descriptors of scans."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.registration.area_to_area import MatchMode
from hmt_slam_ros.registration.consistency import MAP_IN_MAP, MAPS_OUTLIER_RATE, SCAN_IN_STORED_MAP, Agreement
from hmt_slam_ros.topological_inference.area_comparison import ExaminedArea
from hmt_slam_ros.topological_inference.branches import Parent
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.candidate_gating import EntryPrior
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch, first_new_keyframe, known_ground_log_ratio
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState
from hmt_slam_ros.topological_inference.place_recognition import (
    PerceptualAliasing,
    ScanDescriptors,
    _distances,
    describe_scan,
    descriptor_log_ratio,
)

SIGMA = np.array([0.4, 0.2, 0.1])


@pytest.mark.parametrize("expected_probability", [0.5, 0.51])
@pytest.mark.parametrize("pending", [False, True])
def test_a_fit_weighs_its_share_of_the_place_its_evidence_and_its_offset(pending, expected_probability):
    search = ClosureSearch(Configuration(), {})
    search._aliasing.add_negatives([0.1, 0.7, 0.85, 0.9])
    hybrid_map = HybridMap()
    for area in (1, 4):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    if pending:
        hybrid_map.commit()
        hybrid_map.set_arc(1, 4, PoseGaussian(np.zeros(3), np.eye(3)), closure=True)
    prior = PoseGaussian(np.zeros(3), np.diag(SIGMA) ** 2)
    modes = [
        MatchMode(PoseGaussian(np.array(pose), 0.01 * np.eye(3)), PoseGaussian(np.array(pose), np.eye(3)), mass)
        for pose, mass in (((0.8, 0.0, 0.0), 2.0), ((0.0, -1.0, 0.0), 1.0), ((0.0, 0.2, 0.0), -1.0))
    ]
    agreements = [Agreement(50, round(40 + 5 * pose[0]), round(2 - pose[1])) for pose in (m.pose.mean for m in modes)]
    examined = ExaminedArea(4, prior, EntryPrior(expected_probability, 2.5), tuple(modes), tuple(agreements))
    fits = list(search._fits(hybrid_map, examined, 0.3))
    total = math.log(sum(math.exp(mode.log_mass) for mode in modes))
    is_expected = pending and expected_probability > 0.5
    for found, mode, agreement, squared in zip(fits, modes, agreements, (4.0, 25.0, 1.0), strict=True):
        evidence = MAP_IN_MAP.log_likelihood_ratio(agreement, MAPS_OUTLIER_RATE)
        share = agreement.matched_share
        evidence += search._aliasing.log_distinctiveness(share, already_expected=is_expected)
        offset = -0.5 * max(0.0, squared - 2.5)
        assert (found.area, found.mode) == (4, mode)
        assert found.log_weight == pytest.approx(math.log(0.3) + mode.log_mass - total + evidence + offset)
    assert list(search._fits(hybrid_map, examined._replace(modes=(), agreements=()), 0.3)) == []


def test_a_match_is_as_distinctive_as_as_good_ones_elsewhere_are_rare():
    aliasing = PerceptualAliasing(0.1)
    assert aliasing.log_distinctiveness(0.8, already_expected=False) == pytest.approx(math.log(10.0))
    aliasing.add_negatives([0.5, 0.75, 0.79, 0.9])
    for share, as_good in ((0.95, 0), (0.9, 1), (0.8, 2), (0.76, 3), (0.4, 4)):
        expected = math.log((2.0 + 4.0) / (2.0 * 0.1 + as_good))
        assert aliasing.log_distinctiveness(share, already_expected=False) == pytest.approx(expected)
        limited = aliasing.log_distinctiveness(share, already_expected=True)
        assert limited == pytest.approx(min(expected, math.log(2.5)))
    aliasing.add_negatives([0.1] * 70)
    assert list(aliasing.negative_shares) == [0.1] * 64


def test_known_ground_is_that_of_keyframes_older_than_thirty_events_in_steps_of_twenty():
    for keyframe, before in ((29, -20), (30, 0), (49, 0), (50, 20), (69, 20), (70, 40)):
        assert first_new_keyframe(keyframe) == before


def test_known_ground_is_what_keyframes_before_one_saw():
    search, requested = ClosureSearch(Configuration(), {}), []
    points, pose, agreement = np.zeros((3, 2)), np.array([1.0, 2.0, 0.3]), Agreement(100, 80, 20)
    grid = SimpleNamespace(compare=lambda *given: requested.append(given) or agreement)
    search._grid_cache = SimpleNamespace(grid_before=lambda _map, _poses, before: requested.append(before) or grid)
    assert search.known_ground_agreement(HybridMap(), {}, points, pose, 20) is agreement
    assert requested == [20, (points, pose)]


def test_what_contradicts_known_ground_counts_less_among_clutter():
    agreement = Agreement(100, 80, 20)
    found = [known_ground_log_ratio(agreement, clutter) for clutter in (0.0, 0.002, 0.1)]
    expected = [
        SCAN_IN_STORED_MAP.log_likelihood_ratio(agreement, rate) for rate in (MAPS_OUTLIER_RATE, MAPS_OUTLIER_RATE, 0.1)
    ]
    assert found == pytest.approx(expected)
    assert found[2] > found[0] + 1.0


@pytest.mark.parametrize(("agreement", "counts"), [(Agreement(100, 100, 0), True), (Agreement(100, 50, 50), False)])
def test_after_a_kidnapping_known_ground_is_what_was_known_before_and_counts_where_it_agrees(agreement, counts):
    branching, before = Branching(Configuration(), Replica()), []
    grid = SimpleNamespace(compare=lambda *_: agreement)
    branching.search._grid_cache = SimpleNamespace(grid_before=lambda _map, _poses, k: before.append(k) or grid)
    parent = Parent(0, 0, HybridMap(), HypothesisState(), -1.5)
    ratio = SCAN_IN_STORED_MAP.log_likelihood_ratio(agreement, MAPS_OUTLIER_RATE)
    points, pose = np.zeros((3, 2)), np.zeros(3)
    usual = branching.reweight_by_known_ground(parent, pose, points, 95).log_weight
    kidnapped = branching.reweight_by_known_ground(parent, pose, points, 95, 77).log_weight
    assert before == [60, 77]
    assert usual == pytest.approx(-1.5 + ratio)
    assert kidnapped == pytest.approx(-1.5 + (ratio if counts else 0.0))


@pytest.mark.parametrize("count", [1, 31, 32, 100])
def test_a_descriptor_has_the_logarithms_of_evenly_spaced_ranges_in_order(count):
    ranges = np.random.default_rng(count).uniform(0.05, 30.0, count)
    valid = np.random.default_rng(count + 1).random(count) < 0.8
    found = describe_scan(SimpleNamespace(valid=valid, ranges=ranges.astype(np.float32)))
    known = sorted(min(max(r, 0.3), 20.0) if v else 20.0 for r, v in zip(ranges, valid, strict=True))
    expected = [math.log(known[math.floor((q + 0.5) / 32.0 * count)]) for q in range(32)]
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_distances_are_means_to_the_nearest_descriptor_of_each_area():
    rng = np.random.default_rng(2)
    query, known = rng.normal(size=(3, 5)), rng.normal(size=(6, 5))
    expected = [
        np.mean([min(np.abs(q - k).mean() for k in known[a:b]) for q in query]) for a, b in ((0, 1), (1, 4), (4, 6))
    ]
    np.testing.assert_allclose(_distances(query, known, np.array([0, 1, 4, 6])), expected)


def test_areas_have_probabilities_by_the_ratio_of_their_similarity():
    rng = np.random.default_rng(3)
    descriptors = ScanDescriptors({})
    descriptors._rows, table = {k: k for k in range(8)}, rng.normal(size=(8, 32))
    descriptors._table = table
    areas = {3: (0, 1), 5: (2, 3), 9: (4, 5, 6)}
    similarity = descriptors.similarity([7], list(areas.values()))
    assert np.median(similarity) == 0.0
    weights = np.exp(-0.3 + 1.44 * similarity)
    np.testing.assert_allclose(np.exp(descriptor_log_ratio(similarity)), weights)
    found = descriptors.area_probabilities([7], areas)
    assert found == pytest.approx(dict(zip(areas, weights / weights.sum(), strict=True)))
    # Descriptors nearer than a thousandth are the same.
    table[0], table[2] = table[7] + 1e-5, table[7] + 5e-4
    near = descriptors.similarity([7], list(areas.values()))
    assert near[0] == near[1] == 0.0
    assert near[2] < 0.0
