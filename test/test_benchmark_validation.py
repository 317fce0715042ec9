"""The analyses of simulated runs, on made-up records of which the right figures are known."""

import math

import numpy as np
import pytest

from benchmark.__main__ import main
from benchmark.calibration import (
    KINDS,
    Forecast,
    coverage,
    forecast_of_arcs,
    forecast_of_base_rate,
    forecast_of_hypotheses,
    interval,
    make_forecast,
    mean_nees,
    new_rate,
    reliability,
    reliability_of_all,
    reliability_of_top,
)
from benchmark.loops import acceptances, closing_distances, find_faults, missed_share
from benchmark.report import VALIDATION, Requirement, document_marks
from benchmark.simulated.closures import NEW, NOT_EXAMINED


def answer(area, probability, right):
    return {"area": area, "probability": probability, "right": right}


def test_true_answers_count_as_one_and_what_is_not_examined_is_false():
    found = make_forecast([(3, 0.5, True), (4, 0.2, True), (3, 0.1, False), (5, 0.05, False), (5, 0.05, False)])
    assert found.right == pytest.approx(0.7)
    np.testing.assert_allclose(sorted(found.wrong), [0.1, 0.1, 0.1])
    assert found.brier == pytest.approx(0.3**2 + 3 * 0.1**2)
    assert found.surprise == pytest.approx(-math.log(0.7))
    assert found.top == (pytest.approx(0.7), True)


def test_a_forecast_without_the_true_answer_is_as_bad_as_can_be_but_finite():
    found = make_forecast([(NEW, 1.0, False)])
    assert found.brier == 2.0
    assert found.surprise == pytest.approx(-math.log(1e-6))
    assert found.top == (1.0, False)


EVENT = {
    "answers": [answer(2, 0.9, True), answer(NEW, 0.1, False)],
    # Two hypotheses of 0.8 and 0.15, of which the first examined two areas, and one of 0.05 that did not.
    "arcs_alone": [
        answer(NEW, 0.4, False),
        answer(2, 0.3, True),
        answer(3, 0.1, False),
        answer(NEW, 0.15, False),
        answer(NOT_EXAMINED, 0.05, True),
    ],
}


def test_the_other_forecasters_see_no_scan():
    assert forecast_of_hypotheses(EVENT).right == pytest.approx(0.9)
    assert forecast_of_arcs(EVENT).right == pytest.approx(0.35)
    base = forecast_of_base_rate(EVENT, 0.6)
    assert base.right == pytest.approx(0.8 * 0.2 + 0.05)
    assert sum(base.wrong) == pytest.approx(1.0 - base.right)
    # New ground: 60 % of what examined areas, and all of what had none to examine.
    assert max(base.wrong) == pytest.approx(0.8 * 0.6 + 0.15)
    assert new_rate([EVENT]) == 0.0


def calibrated_forecasts(count, draw):
    """Questions of two answers whose probabilities are right."""
    for p in draw.uniform(0.5, 1.0, count):
        yield Forecast(p, (1.0 - p,)) if draw.random() < p else Forecast(1.0 - p, (p,))


def test_right_probabilities_have_no_calibration_error_and_too_certain_ones_have():
    draw = np.random.default_rng(2)
    right = list(calibrated_forecasts(20_000, draw))
    assert reliability_of_top(right).error < 0.01
    assert reliability_of_all(right).error < 0.01
    certain = [Forecast(float(each.right > 0.5), (float(each.right <= 0.5),)) for each in right]
    # Right in three of four cases on average.
    assert reliability_of_top(certain).error == pytest.approx(0.25, abs=0.01)
    low, high = interval([right[k : k + 10] for k in range(0, 200, 10)], lambda some: reliability_of_top(some).error)
    assert low < reliability_of_top(right[:200]).error < high


def test_a_reliability_diagram_has_every_answer_in_one_bin():
    found = reliability([(0.0, False), (0.05, False), (0.95, True), (1.0, True), (0.55, False)])
    assert found.counts.tolist() == [2, 0, 0, 0, 0, 1, 0, 0, 0, 2]
    assert found.error == pytest.approx((2 * 0.025 + 0.55 + 2 * 0.025) / 5)
    assert math.isnan(reliability([]).error)


def loop(closed_at, *, can_be_closed=True, end=50.0):
    in_time = closed_at is not None and closed_at <= end + 10.0
    return {"begin": 40.0, "end": end, "closed_at": closed_at, "can_be_closed": can_be_closed, "in_time": in_time}


def record(loops=(), accepted=(), pending=(), arcs=(), poses=()):
    return {
        "world": "sim:nested,seed=1000",
        "loops": list(loops),
        "accepted": [{"right": right, "probability": 0.99} for right in accepted],
        "pending": [{"right": right} for right in pending],
        "arcs": [{"nees": nees, "closure": False} for nees in arcs],
        "area_poses": [],
        "poses": [{"map": {"nees": nees}, "local": {"nees": nees}} for nees in poses],
    }


def test_a_loop_that_is_closed_late_or_never_is_missed():
    records = [record([loop(44.0), loop(None, can_be_closed=False)]), record([loop(70.0), loop(None)])]
    assert missed_share(records) == pytest.approx(2 / 3)
    assert closing_distances(records) == [4.0]
    assert math.isnan(missed_share([record()]))


def test_a_topology_is_exact_without_false_closures_and_with_every_loop_closed():
    assert find_faults(record([loop(70.0), loop(None, can_be_closed=False)], [True], [True])) == []
    assert find_faults(record([loop(None)])) == ["loops not closed: 1"]
    assert find_faults(record([], [True, False])) == ["closures accepted falsely: 1"]
    assert find_faults(record([], [], [False])) == ["false closures pending: 1"]


def test_every_accepted_closure_counts_by_its_probability():
    assert acceptances([record(accepted=[True, False]), record()]) == [(0.99, True), (0.99, False)]


def test_every_run_counts_the_same_for_the_mean_nees():
    records = [record(arcs=[2.0, 4.0]), record(arcs=[9.0]), record()]
    assert mean_nees(records, KINDS["arcs"]) == pytest.approx(6.0)
    assert coverage(records, KINDS["arcs"]) == pytest.approx(2 / 3)
    assert math.isnan(mean_nees(records, KINDS["arcs that closed a loop"]))
    assert math.isnan(coverage(records, KINDS["poses of areas"]))


def test_a_figure_may_be_too_small():
    assert Requirement("NEES", 3.0, 4.5, least=2.0).row[2:] == ["2 to 4.5", "pass"]
    assert not Requirement("NEES", 1.9, 4.5, least=2.0).is_met
    assert not Requirement("NEES", math.nan, 4.5, least=2.0).is_met
    assert Requirement("runs", 8, math.inf, least=300).row[2:] == ["at least 300", "FAIL"]
    assert Requirement("error", 0.1, 1.0, "m").row[2:] == ["1 m", "pass"]


@pytest.mark.parametrize("kind", ["calibration", "loops", "topology", "consistency"])
def test_the_document_has_a_place_for_every_measurement(kind):
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in document_marks(kind))


def test_all_is_measured_on_a_world_of_the_training_seeds(tmp_path, capsys):
    """Seed 0 of one family: far too few runs for the requirements, which is reported."""
    out, runs = tmp_path / "report", tmp_path / "runs"
    options = ["--logs", "ring", "--seeds", "1", "--training", "--jobs", "1", "--out", str(out), "--runs", str(runs)]
    assert main(["calibration", "loops", "consistency", *options]) == 1
    assert [path.name for path in runs.iterdir()] == ["ring-0.json.gz"]
    text = (out / "calibration.md").read_text()
    assert "| runs | 1 | at least 300 | FAIL |" in text
    assert "| ring | 1 |" in text
    assert "most probable answer: expected calibration error above 0.9" in text
    assert (out / "reliability.png").stat().st_size > 10_000
    assert (out / "nees.png").stat().st_size > 10_000
    loops = (out / "loops.md").read_text()
    assert "| ring | 1 |" in loops
    assert "| accepted closures | " in loops
    assert "NEES of arcs that closed a loop, mean over runs" in (out / "consistency.md").read_text()
    assert main(["calibration", "--logs", "aces", "--seeds", "1", "--out", str(tmp_path / "other")]) == 2
    assert "no family 'aces'" in capsys.readouterr().err
