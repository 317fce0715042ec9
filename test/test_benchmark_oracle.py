"""The exact enumeration of topologies, and the distance of TSBI's distribution from it."""

import pytest

from benchmark import oracle
from benchmark.oracle import (
    Enumeration,
    Regime,
    compare_drive,
    drive_stops,
    mean_distances,
    oracle_requirements,
    run_tsbi,
    total_variation,
)
from benchmark.report import VALIDATION, document_marks
from benchmark.runs import PARAMETERS
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.topological_inference import tsbi

WORLD, SEED, NOISE = "four crossings", 1, 2.0
VAGUE = Regime("vague", (WORLD,), (NOISE,), ("tsbi.temper=0.03",))


@pytest.fixture(scope="module")
def drive():
    return drive_stops(f"sim:{oracle.WORLDS[WORLD]},seed={SEED}", SEED, NOISE)


def test_a_distribution_is_at_no_distance_from_itself_and_at_one_from_what_excludes_it():
    assert total_variation({(0, 1): 0.3, (0, 0): 0.7}, {(0, 0): 0.7, (0, 1): 0.3}) == pytest.approx(0.0)
    assert total_variation({(0, 1): 1.0}, {(0, 0): 1.0}) == 1.0
    assert total_variation({(0, 1): 1.0}, {(0, 1): 0.8}) == pytest.approx(0.2)


def test_a_drive_has_eight_visits_and_every_keyframe_leaves_once(drive):
    assert len(drive) == 48
    assert [k for k, stop in enumerate(drive) if stop.cut] == [11, 17, 23, 29, 35, 41, 47]
    assert not drive[0].step.any()


def test_the_enumeration_gives_every_way_its_share(drive):
    settings = ["tsbi.recheck_keyframes=1000", "tsbi.temper=0.03"]
    enumeration = Enumeration(load_configuration(PARAMETERS, settings), NOISE)
    for stop in drive[:36]:
        pmf = enumeration.keyframe(*stop)
        assert sum(pmf.values()) == pytest.approx(1.0)
    assert enumeration.has_candidates
    assert enumeration.topology_count >= len(pmf) > 1
    for path in pmf:
        assert len(path) == 6
        assert path[0] == 0
        # A visit is named by itself or by the earlier one in which its area was entered first.
        assert all(area == visit or path[area] == area < visit for visit, area in enumerate(path))


def test_with_enough_hypotheses_tsbi_says_what_the_enumeration_says(monkeypatch):
    """Where hypotheses that are equivalent stay apart, as they do in the enumeration."""
    monkeypatch.setattr(tsbi, "merge_equivalent", lambda _, log_weights: dict(enumerate(log_weights)))
    monkeypatch.setattr(oracle, "HYPOTHESES", (1, 2, 32))
    distances = compare_drive(VAGUE, WORLD, SEED, NOISE, ()).distances
    assert len(distances[1]) >= 4
    assert max(distances[32]) < 0.01
    assert 0.0 < sum(distances[2]) < sum(distances[1])


def test_making_one_of_hypotheses_that_are_equivalent_moves_little_probability(monkeypatch):
    monkeypatch.setattr(oracle, "HYPOTHESES", (32,))
    assert 0.0 < max(compare_drive(VAGUE, WORLD, SEED, NOISE, ()).distances[32]) < 0.05


def test_what_is_dropped_is_lacking(drive):
    settings = ["tsbi.recheck_keyframes=1000", "tsbi.temper=0.03", "tsbi.drop_probability=0.1"]
    found = run_tsbi(drive, load_configuration(PARAMETERS, settings), NOISE)
    assert min(sum(pmf.values()) for pmf in found) < 1.0 - 1e-6


def test_the_distance_has_to_be_small_and_to_fall(monkeypatch):
    monkeypatch.setattr(oracle, "HYPOTHESES", (1, 2))
    drives = [
        oracle.ComparedDrive("", "", {1: [0.4, 0.2], 2: [0.0]}, 3, 0.0),
        oracle.ComparedDrive("", "", {1: [0.0], 2: []}, 1, 0.0),
    ]
    assert mean_distances(drives) == {1: pytest.approx(0.2), 2: 0.0}
    met = [requirement.is_met for requirement in oracle_requirements("", {1: 0.2, 16: 0.06, 32: 0.07}, 16)]
    assert met == [False, False]
    assert all(requirement.is_met for requirement in oracle_requirements("", {1: 0.2, 16: 0.01, 32: 0.0}, 16))


def test_the_document_has_a_place_for_the_tables():
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in document_marks("oracle"))
