"""Evidence of contradictions against a beta-binomial model, and the samples of walls, one after the other."""

import pytest
from scipy.special import betaln

from hmt_slam_ros.registration.consistency import (
    MAP_IN_MAP,
    MAPS_OUTLIER_RATE,
    NO_SAMPLES,
    SCAN_IN_SUBMAP,
    WALLS_OF_SUBMAP,
    Agreement,
    ClutterEstimate,
    ConsistencyTest,
    MapAgreement,
    OutlierRate,
    add_wall_hit,
    add_wall_passed,
)


@pytest.mark.parametrize("model", [ConsistencyTest(0.05, 300.0, 8.0), ConsistencyTest(0.2, 40.0, 3.0)])
@pytest.mark.parametrize("usual", [0.002, 0.07])
@pytest.mark.parametrize(("on", "free"), [(70, 3), (10, 25), (0, 4), (33, 0)])
def test_the_ratio_is_that_of_two_beta_binomials_of_independent_samples(model, usual, on, free):
    """Both have the same concentration of inliers; contradictions have that times their rate."""

    def log_probability(rate):
        a, b = rate * model.concentration, model.concentration
        return betaln(a + free / model.correlated_samples, b + on / model.correlated_samples) - betaln(a, b)

    expected = log_probability(usual) - log_probability(usual + model.extra_rate)
    assert model.log_likelihood_ratio(Agreement(200, on, free), usual) == pytest.approx(expected, abs=1e-9)


def test_rates_are_those_of_all_independent_samples_and_a_prior():
    rate = OutlierRate(30.0, 2.0).update(Agreement(300, 120, 30), 15.0).update(Agreement(300, 45, 60), 15.0)
    assert rate == pytest.approx((30.0 + 11.0, 2.0 + 6.0))
    assert rate.rate == pytest.approx(8.0 / 49.0)
    assert pytest.approx(0.75 / 100.75) == MAPS_OUTLIER_RATE


def test_a_scan_is_evidence_by_its_ends_and_for_a_kidnapping_also_by_the_walls():
    clutter = ClutterEstimate(OutlierRate(80.0, 3.0), OutlierRate(60.0, 1.0))
    found = MapAgreement(Agreement(300, 200, 40), Agreement(70, 50, 20))
    ends = SCAN_IN_SUBMAP.log_likelihood_ratio(found.ends, 3.0 / 83.0)
    walls = WALLS_OF_SUBMAP.log_likelihood_ratio(found.walls, 1.0 / 61.0)
    assert min(abs(ends), abs(walls)) > 0.1
    evidence = clutter.evaluate(found)
    assert evidence.log_evidence == pytest.approx(ends)
    assert evidence.log_kidnapping_ratio == pytest.approx(-ends - walls)
    later = clutter.update(found)
    assert later.beam_outliers == pytest.approx((80.0 + 200 / 20.0, 3.0 + 40 / 20.0))
    assert later.wall_outliers == pytest.approx((60.0 + 50 / 5.0, 1.0 + 20 / 5.0))
    assert later.clutter == pytest.approx((5.0 / 95.0, 5.0 / 75.0))
    assert MAP_IN_MAP.log_likelihood_ratio(Agreement(0, 0, 0), 0.01) == 0.0


def test_a_hit_counts_where_it_is_a_spacing_away_from_the_last_sample():
    samples = add_wall_hit(NO_SAMPLES, 2.0, -1.0, 0.5)
    assert samples == (1, 2.0, -1.0)
    assert add_wall_hit(samples, 2.29, -0.61, 0.5) == samples
    assert add_wall_hit(samples, 2.5, -1.0, 0.5) == (2, 2.5, -1.0)
    assert add_wall_hit(samples, 1.7, -1.41, 0.5) == (2, 1.7, -1.41)


@pytest.mark.parametrize(
    ("away", "total", "moves"), [(0.49, 3, False), (0.5, 4, True), (1.5, 4, True), (1.51, 3, True)]
)
def test_a_passed_wall_counts_between_a_spacing_and_a_gap_from_the_last_sample(away, total, moves):
    samples = NO_SAMPLES._replace(total=3, x=2.0, y=-1.0)
    x, y = 2.0, -1.0 + away
    found = add_wall_passed(samples, x, y, 0.5, 1.5)
    assert found == ((total, x, y) if moves else samples)
    assert add_wall_passed(NO_SAMPLES, x, y, 0.5, 1.5) == (0, x, y)
