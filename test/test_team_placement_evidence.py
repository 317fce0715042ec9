"""What the windows of a placement tell, after the best of them."""

import math

import pytest

from hmt_slam_ros.team.placement_evidence import WindowEvidence, placement_evidence, similar_probability


def evidence(log_ratios, similar=0.2):
    """Of windows in known ground.

    :param log_ratios: {window: nats}.
    """
    return placement_evidence({w: WindowEvidence(each, True) for w, each in log_ratios.items()}, similar)


def test_the_best_window_counts_in_full():
    assert evidence({3: 4.0}) == (4.0, 0.0)
    assert evidence({1: 2.0, 2: 4.0}).best == 4.0


def test_a_window_beside_the_best_counts_up_to_where_similar_surroundings_end():
    assert evidence({0: 9.0, 1: 1.0}).agreement == pytest.approx(-math.log(0.2 + 0.8 * math.exp(-1.0)))
    assert evidence({0: 9.0, 1: 8.9}).agreement == pytest.approx(-math.log(0.2), abs=0.01)


def test_a_distant_window_is_evidence_of_its_own():
    near, far, farther = (evidence({0: 9.0, gap: 3.0}).agreement for gap in (1, 2, 6))
    assert near < far < farther
    assert farther == pytest.approx(3.0, abs=0.01)


def test_windows_on_both_sides_of_the_best_count_alike():
    assert evidence({0: 1.0, 1: 9.0, 2: 2.0, 3: -1.0}).agreement == pytest.approx(
        evidence({3: 1.0, 2: 9.0, 1: 2.0, 0: -1.0}).agreement
    )


def test_contradictions_count_in_full():
    assert evidence({0: 9.0, 1: -6.0}).agreement == pytest.approx(-6.0, abs=0.3)
    assert evidence({0: 9.0, 9: -6.0}).agreement == pytest.approx(-6.0, abs=0.001)


def test_behind_a_contradiction_the_surroundings_are_not_similar_any_more():
    assert evidence({0: 9.0, 1: -6.0, 2: 3.0}).agreement == pytest.approx(-6.0 + 3.0, abs=0.3)


def test_windows_that_tell_nothing_change_nothing():
    with_them, without = evidence({0: 9.0, 1: 0.0, 2: 0.0, 3: 2.5}), evidence({0: 9.0, 3: 2.5})
    assert with_them.agreement == pytest.approx(without.agreement)


def test_where_surroundings_stay_similar_nothing_but_contradictions_counts():
    assert evidence({0: 9.0, 1: 4.0, 2: 4.0}, similar=1.0).agreement == 0.0


def test_false_placements_show_how_long_surroundings_stay_similar():
    fits, differs, elsewhere = (WindowEvidence(*each) for each in ((4.0, True), (-1.0, True), (0.0, False)))
    prior = similar_probability([])
    assert 0.1 < prior < 0.3
    assert similar_probability([{0: fits, 1: fits, 2: fits}] * 5) > 0.8
    assert similar_probability([{0: fits, 1: differs, 2: differs}] * 5) < 0.05
    # Ground that the other robot does not know is no evidence, nor is a placement that fits nowhere.
    assert similar_probability([{0: fits, 1: elsewhere}, {0: differs, 1: differs}, {}]) == prior
