"""The PMF over placements, from hand-made distributions of windows."""

import math

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import uninformative_belief
from hmt_slam_ros.messages.team import NO_REPETITION, Repetition
from hmt_slam_ros.registration.area_to_area import MatchMode
from hmt_slam_ros.registration.consistency import Agreement
from hmt_slam_ros.team.placement import (
    PlacementGeometry,
    PlacementPrior,
    WindowCandidate,
    placement_distribution,
    window_candidates,
)
from hmt_slam_ros.team.placement_evidence import WindowEvidence, placement_evidence, similar_probability
from hmt_slam_ros.team.windows import Window
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate
from hmt_slam_ros.topological_inference.pose_distribution import UNMAPPED_PRIOR, PoseDistribution

TIGHT = np.diag([0.02, 0.02, 0.005]) ** 2
AREAS, WINDOWS = 4, 3
SPACING = 10.0  # m between the areas of a component, along x
TURNED = np.array([5.0, 20.0, 1.2])  # first_T_second


def two_rows(drift=TIGHT):
    """Areas 0 to 3 in a row, and 10 to 12 in another, with a window in each of these."""
    hybrid_map, step = HybridMap(), np.array([SPACING, 0.0, 0.0])
    for area in (*range(AREAS), *range(10, 10 + WINDOWS)):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    for area in range(AREAS - 1):
        hybrid_map.set_arc(area, area + 1, PoseGaussian(step, TIGHT), closure=False)
    for area in range(10, 9 + WINDOWS):
        hybrid_map.set_arc(area, area + 1, PoseGaussian(step, drift), closure=False)
    hybrid_map.set_arc(0, 10, uninformative_belief(np.zeros(3)), closure=False)
    hybrid_map.commit()
    windows = [Window(10 + w, np.array([0.5, 0.1, 0.3]), {10 + w: np.zeros(3)}) for w in range(WINDOWS)]
    return PlacementGeometry(hybrid_map, windows), windows


def match(windows, window, log_ratio, area=0, placement=TURNED, shift=(0.0, 0.0, 0.0)):
    """The candidate of a window under a placement, seen from an area of the first component."""
    second_T_reference = se2.compose([SPACING * window, 0.0, 0.0], windows[window].reference)
    in_area = se2.between([SPACING * area, 0.0, 0.0], se2.compose(placement, second_T_reference))
    return WindowCandidate(window, area, PoseGaussian(in_area + shift, TIGHT), log_ratio)


FITS = WindowEvidence(5.0, True)
UNIQUE = Repetition(-50.0, 1.0), NO_REPETITION


def no_contradictions(*_):
    return None


def distribution(geometry, candidates, compare=no_contradictions, repetitions=UNIQUE):
    prior = PlacementPrior.of_pair(AREAS, WINDOWS, repetitions)
    return placement_distribution(geometry, candidates, (0, 10), prior, compare)


def odds(found):
    """Log-odds of each placement to the prior weight of all that is not one of them."""
    prior = 0.5 / PlacementPrior.of_pair(AREAS, WINDOWS).places
    rest = math.log(found.apart / (1.0 - prior * len(found.placements)))
    return [math.log(each.probability / prior) - rest for each in found.placements]


def test_components_without_a_candidate_are_apart():
    geometry, _ = two_rows()
    found = distribution(geometry, [[], [], []])
    assert found.best is None and found.apart == 1.0


def test_a_candidate_that_fits_no_better_than_unmapped_ground_is_no_placement():
    geometry, windows = two_rows()
    other = np.array([-40.0, 3.0, -2.0])
    candidates = [[match(windows, 0, 4.0), match(windows, 0, -0.1, placement=other)], [match(windows, 1, -2.0)], []]
    found = distribution(geometry, candidates)
    assert len(found.placements) == 1
    assert list(found.best.matches) == [0]
    # Of the placement that there is, it is evidence.
    assert found.best.evidence.agreement < 0.0


def test_windows_on_other_ground_leave_the_probability_of_a_placement():
    geometry, windows = two_rows()
    candidates = [[match(windows, 0, 4.0)], [match(windows, 1, 4.0)], []]
    alone = distribution(geometry, candidates[:2]).best.probability
    assert distribution(geometry, candidates).best.probability == pytest.approx(alone)


def test_windows_that_agree_are_one_placement():
    geometry, windows = two_rows()
    found = distribution(
        geometry,
        [[match(windows, 0, 4.0, 1)], [match(windows, 1, 5.0, 2)], [match(windows, 2, 0.5, 0)]],
    )
    assert len(found.placements) == 1
    assert found.best.evidence.best == pytest.approx(5.0)
    # The first window counts as far as similar surroundings end, and the arcs leave a share of the third elsewhere.
    assert 1.4 < found.best.evidence.agreement < 2.1
    assert list(found.best.matches) == [1, 0, 2]
    np.testing.assert_allclose(found.best.pose, TURNED, atol=1e-9)
    assert odds(found) == pytest.approx([sum(found.best.evidence)])
    assert sum(each.probability for each in found.placements) + found.apart == pytest.approx(1.0)


def test_a_candidate_beyond_a_meter_is_another_placement():
    geometry, windows = two_rows()
    near = [[match(windows, 0, 4.0)], [match(windows, 1, 3.0, shift=(0.5, 0.0, 0.0))], []]
    far = [[match(windows, 0, 4.0)], [match(windows, 1, 3.0, shift=(1.5, 0.0, 0.0))], []]
    assert len(distribution(geometry, near).placements) == 1
    assert len(distribution(geometry, far).placements) == 2


def test_drift_does_not_split_a_placement():
    geometry, windows = two_rows(drift=np.diag([0.8, 0.8, 0.02]) ** 2)
    found = distribution(geometry, [[match(windows, 0, 4.0)], [match(windows, 1, 3.0, shift=(1.5, 0.0, 0.0))], []])
    assert len(found.placements) == 1 and len(found.best.matches) == 2


def test_of_two_equal_placements_neither_is_sure():
    geometry, windows = two_rows()
    other = np.array([-40.0, 3.0, -2.0])
    both = [[match(windows, w, 5.0), match(windows, w, 5.0, placement=other)] for w in range(WINDOWS)]
    found = distribution(geometry, both)
    assert [each.probability for each in found.placements] == pytest.approx([found.best.probability] * 2)
    # What the false one of them agrees is no evidence.
    assert odds(found) == pytest.approx([5.0, 5.0])


def test_a_placement_stands_out_by_what_it_agrees_more_than_false_ones():
    geometry, windows = two_rows()
    other = np.array([-40.0, 3.0, -2.0])
    found = distribution(
        geometry,
        [
            [match(windows, 0, 5.0), match(windows, 0, 4.0, placement=other)],
            [match(windows, 1, 5.0)],
            [],
        ],
    )
    agreement = placement_evidence({0: FITS, 1: FITS}, similar_probability([{0: FITS}])).agreement
    assert odds(found) == pytest.approx([5.0 + agreement, 4.0], abs=0.01)


def test_contradictions_count_in_full():
    geometry, windows = two_rows()

    def contradict(window, _area, _belief, is_matched):
        assert is_matched == (window < 2)
        return -7.0 if window == 2 else 0.0

    found = distribution(geometry, [[match(windows, 0, 5.0)], [match(windows, 1, 5.0)], []], contradict)
    without = distribution(geometry, [[match(windows, 0, 5.0)], [match(windows, 1, 5.0)], []])
    assert odds(found) == pytest.approx([odds(without)[0] - 7.0], abs=0.3)


def test_a_building_that_repeats_itself_bounds_the_probability_of_a_placement():
    geometry, windows = two_rows()
    sure = [[match(windows, w, 50.0)] for w in range(WINDOWS)]
    bounds = {
        r: distribution(geometry, sure, repetitions=(Repetition(r, 1.0), NO_REPETITION)).best.probability
        for r in (-1.0, 0.0, 5.0)
    }
    assert bounds[-1.0] > bounds[0.0] == pytest.approx(1.0 / 1.003, abs=1e-4)
    odds_of_twins = 0.003 * math.exp(5.0)
    assert bounds[5.0] == pytest.approx(1.0 / (1.0 + odds_of_twins / (1.0 + odds_of_twins)), abs=1e-3)


def test_common_ground_is_evidence_of_repetition_once():
    geometry, windows = two_rows()
    whole = [[match(windows, w, 50.0)] for w in range(WINDOWS)]

    def sure(candidates, first, second):
        repetitions = Repetition(first, 1.0), Repetition(second, 1.0)
        return distribution(geometry, candidates, repetitions=repetitions).best.probability

    assert sure(whole, 4.0, 3.0) == sure(whole, 4.0, 0.0)
    # A window beyond the ground of the first is evidence of its own.
    part = [*whole[:2], []]
    assert sure(part, 4.0, 3.0) == pytest.approx(sure(part, 5.0, 0.0))


def test_a_twin_that_ends_in_the_map_does_not_explain_common_ground_that_goes_on():
    geometry, windows = two_rows()

    def sure(count, persistence):
        candidates = [[match(windows, w, 50.0)] if w < count else [] for w in range(WINDOWS)]
        repetitions = Repetition(20.0, persistence), Repetition(0.0, 1.0)
        return distribution(geometry, candidates, repetitions=repetitions).best.probability

    assert sure(3, 1.0) == pytest.approx(0.5, abs=1e-3)
    assert sure(3, 0.5) == pytest.approx(1.0 / (1.0 + 0.5**2), abs=1e-3)
    assert sure(1, 0.5) == pytest.approx(0.5, abs=1e-3)


def test_a_twin_that_neither_map_has_may_be_as_large_as_the_building():
    geometry, windows = two_rows()
    sure = [[match(windows, w, 50.0)] for w in range(WINDOWS)]
    repetitions = Repetition(20.0, 1e-9), Repetition(0.0, 1.0)
    bounded = distribution(geometry, sure, repetitions=repetitions).best.probability
    assert 1.0 - bounded == pytest.approx(0.003 * 0.5, rel=0.01)


def test_before_much_is_mapped_common_ground_is_improbable():
    geometry, windows = two_rows()
    found = distribution(geometry, [[match(windows, 0, 2.5)], [], []])
    assert found.best.probability < 0.45


def test_windows_are_compared_where_the_placement_has_them():
    geometry, windows = two_rows()
    compared = {}

    def note(window, area, belief, _is_matched):
        compared[window] = se2.compose([SPACING * area, 0.0, 0.0], belief.mean)
        return 0.0

    distribution(geometry, [[match(windows, 0, 5.0, 1)], [], []], note)
    for window, pose in compared.items():
        expected = match(windows, window, 0.0).belief.mean
        np.testing.assert_allclose(pose, expected, atol=1e-9)
    assert compared.keys() == {0, 1, 2}


def test_the_order_of_candidates_does_not_matter():
    geometry, windows = two_rows()
    other = np.array([-40.0, 3.0, -2.0])
    own = [[match(windows, w, 5.0 - w), match(windows, w, 2.0 + w, placement=other)] for w in range(WINDOWS)]
    found, turned = distribution(geometry, own), distribution(geometry, [each[::-1] for each in own])
    assert [each.probability for each in found.placements] == [each.probability for each in turned.placements]


def test_the_factor_of_a_window_does_not_depend_on_its_flat_prior():
    likelihoods, areas = np.array([30.0, 2.0, 0.1]), 5
    belief = PoseGaussian(np.zeros(3), TIGHT)
    candidates = tuple(PoseCandidate(a, MatchMode(belief, belief, 0.0), Agreement(0, 0, 0)) for a in range(3))
    weights = (1.0 - UNMAPPED_PRIOR) / areas * likelihoods
    known = PoseDistribution(candidates, weights / (weights.sum() + UNMAPPED_PRIOR))
    found = window_candidates(3, known, areas)
    np.testing.assert_allclose([each.log_ratio for each in found], np.log(likelihoods))
    assert {each.window for each in found} == {3}
