"""Weights of hypotheses: runs with other weights, and weights that are replayed on a run."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from benchmark.runs import PARAMETERS
from benchmark.simulated.watch import observe_world
from benchmark.simulated.weighed import FilterNotes, NotingFilters, Weighing, run_weighed
from benchmark.simulated.worlds import World
from benchmark.weighing import IN_USE, WEIGHINGS, contrasts, outcome_table, reliability_of_evidence, replay
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.submap.local_mapping import LocalMapping
from hmt_slam_ros.submap.particle_filter import ParticleFilter

WORLD = World("ring", 5)


@pytest.fixture(scope="module")
def record():
    return run_weighed(WORLD.log, WORLD.seed, WEIGHINGS[IN_USE], None)


def entry(probability, right, before=(0.0, 0.0, 0.0), newest=(0.0, 0.0, 0.0), matched_share=0.5):
    return {
        "probability": probability,
        "right": right,
        "before": before,
        "newest": newest,
        "matched_share": matched_share,
    }


def test_the_weights_of_the_package_give_its_probabilities(record):
    expected = observe_world(WORLD)
    assert [event["answers"] for event in record["events"]] == [event["answers"] for event in expected["events"]]
    assert record["events"]
    assert [closure["right"] for closure in record["accepted"]] == [c["right"] for c in expected["accepted"]]


def test_other_weights_give_other_probabilities(record):
    other = run_weighed(WORLD.log, WORLD.seed, WEIGHINGS["filter"], None)
    assert other["events"] != record["events"]


def test_the_evidence_of_the_filter_is_the_mean_over_the_particles_of_all_modes(monkeypatch):
    notes = FilterNotes()
    configuration = load_configuration(PARAMETERS, ["filter.particles=2"])
    own = NotingFilters(LocalMapping(configuration), notes).new(7, 0).branch(8)
    own.log_weights = np.log([1.0, 3.0])
    evidences = np.log([2.0, 4.0])

    def propose(_, number, __):
        return SimpleNamespace(
            rows=np.array([number]), proposals=SimpleNamespace(evidences=evidences[number : number + 1])
        )

    monkeypatch.setattr(ParticleFilter, "_propose", propose)
    notes.evidences[8] = -np.inf
    for mode in (0, 1):
        own._propose(mode, np.empty((0, 4)))
    assert notes.evidences == {8: pytest.approx(math.log((1.0 * 2.0 + 3.0 * 4.0) / 4.0))}


STEP = {
    "event": 3,
    "hypotheses": [
        entry(0.8, False, before=(1.0, 5.0, 0.0), newest=(0.5, 1.0, 0.0), matched_share=0.6),
        entry(0.2, True, before=(2.0, 1.0, 1.0), newest=(0.0, 2.0, -1.0), matched_share=0.9),
    ],
}
RECORD = {"steps": [STEP, {"event": 4, "hypotheses": [entry(1.0, True), entry(0.0, True)]}]}


def odds(forecast):
    return forecast.right / sum(forecast.wrong)


def test_replayed_with_the_weights_of_the_package_only_the_newest_scan_counts():
    (forecast,) = replay(RECORD, WEIGHINGS[IN_USE])
    assert odds(forecast) == pytest.approx(0.25 * math.exp(-1.0 - 0.5))


def test_replayed_with_other_weights_all_evidence_since_the_acceptance_is_exchanged():
    (forecast,) = replay(RECORD, Weighing(0.0, 1.0, 1.0))
    without = 0.25 * math.exp(-(2.0 + 1.0) + 1.0)
    assert odds(forecast) == pytest.approx(without * math.exp((1.0 + 2.0 + 0.0) - (5.0 + 1.0)))


def test_a_contrast_is_the_true_hypothesis_less_the_false_one():
    (contrast,) = contrasts(RECORD)
    assert contrast.matched_share == pytest.approx(0.3)
    assert contrast.newest == (-0.5, 1.0, -1.0)
    assert contrast.total == (0.5, -3.0, 0.0)


def test_evidence_is_counted_by_its_amount_and_by_whether_it_is_for_the_truth():
    assert reliability_of_evidence([2.0, -2.5, 2.5, 0.01, 20.0]) == [(2.5, 3, pytest.approx(2 / 3)), (20.0, 1, 1.0)]


def test_weighings_are_compared_on_the_same_worlds(record):
    lines = outcome_table({IN_USE: [record, record], "filter": [record, record]}).splitlines()
    assert lines[3].count("+0.000 to +0.000") == 4
