"""Existence of landmarks."""

import pytest

from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.hybrid_map.landmark import Existence

FEATURES = FeatureParameters(landmark_detected=0.9, landmark_by_chance=0.1, landmark_lasting=0.99)


def visit(existence, times, confidence=0.9):
    for _ in range(times):
        existence = existence.update_on_detection(confidence, FEATURES)
    return existence


def miss(existence, times):
    for _ in range(times):
        existence = existence.update_on_miss(FEATURES)
    return existence


def test_one_visit_is_bayes_rule():
    """By hand: r- = 0.99 * 0.5 = 0.495; seen 0.9 * 0.495 / (0.9 * 0.495 + 0.1 * 0.505)."""
    half = Existence(0.8, presence=0.5)
    assert half.update_on_detection(0.8, FEATURES).presence == pytest.approx(0.4455 / (0.4455 + 0.0505))
    assert half.update_on_miss(FEATURES).presence == pytest.approx(0.0495 / (0.0495 + 0.4545))
    assert half.probability == pytest.approx(0.4)


def test_that_it_is_a_landmark_is_the_mean_of_what_the_scans_say_that_show_it():
    """Eq. (4): one that is hardly believed in is no more believed in for being seen again and again."""
    existence = (
        Existence(0.1).update_on_detection(0.4, FEATURES).update_on_miss(FEATURES).update_on_detection(0.1, FEATURES)
    )
    assert existence.confidence == pytest.approx(0.2)
    assert visit(Existence(0.1), 100, confidence=0.1).probability < 0.1


def test_what_was_seen_a_hundred_times_is_gone_after_a_few_misses():
    existence = visit(Existence(0.9), 100)
    assert existence.probability > 0.89
    assert miss(existence, 4).probability < 0.05


def test_what_is_missed_once_in_ten_visits_stays():
    existence = Existence(0.9)
    for _ in range(20):
        existence = miss(visit(existence, 9), 1)
        assert existence.probability > 0.75
    assert visit(existence, 2).probability > 0.89


def test_visits_are_counted():
    existence = miss(visit(Existence(0.9), 3), 2)
    assert (existence.detections, existence.misses) == (4, 2)


def test_one_look_suffices_for_what_is_gone_when_the_robot_comes_back():
    existence = visit(Existence(1.0), 100, confidence=1.0)
    assert miss(existence, 1).probability > 0.5
    back = existence.mark_absence().mark_absence()
    assert back.probability == existence.probability
    assert miss(back, 1).probability < 0.5
    assert visit(back, 1, confidence=1.0).probability > 0.95
