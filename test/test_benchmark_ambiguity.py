"""The analysis of what becomes of hypotheses in identical places: on made-up stories, and the truth of small worlds."""

from types import SimpleNamespace

import numpy as np
import pytest

from benchmark.ambiguity import (
    NEW,
    RIGHT,
    WRONG,
    Reentry,
    ReentryVerdict,
    decision_table,
    judge_reentry,
    requirements,
    trace_hypotheses,
)
from benchmark.simulated.loops import Loop, find_rivalries, looks_alike, odometry_probabilities
from benchmark.simulated.truth import Truth
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.simulation import open_simulated


def hypothesis(hypothesis, parent, probability, right=0, wrong=0):
    reported = {"hypothesis": hypothesis, "parent": parent, "probability": probability}
    return reported | {"samples": 10.0 * probability, "right": right, "wrong": wrong}


def entry(event, *hypotheses):
    return {
        "event": event,
        "stamp": 10**9 * event,
        "traveled": 0.5 * event,
        "unexamined": 0.0,
        "hypotheses": list(hypotheses),
    }


PMF = [
    entry(0, hypothesis(0, 0, 1.0)),
    entry(1, hypothesis(1, 0, 0.1), hypothesis(2, 0, 0.5, right=1), hypothesis(3, 0, 0.4, wrong=1)),
    entry(2, hypothesis(2, 2, 0.7), hypothesis(3, 3, 0.3)),
    # A right closure does not mend what went wrong before.
    entry(3, hypothesis(2, 2, 0.97), hypothesis(3, 3, 0.03, right=1)),
    entry(4, hypothesis(2, 2, 1.0)),
]


def test_hypotheses_are_classified_by_the_loops_that_they_and_their_parents_closed():
    moments = trace_hypotheses(PMF, 0)
    assert [moment.probabilities[RIGHT] for moment in moments] == [0.0, 0.5, 0.7, 0.97, 1.0]
    assert [moment.probabilities[WRONG] for moment in moments] == [0.0, 0.4, 0.3, 0.03, 0.0]
    assert [moment.probabilities[NEW] for moment in moments] == [1.0, 0.1, 0.0, 0.0, 0.0]
    assert [moment.has_question for moment in moments] == [False, True, True, True, True]
    assert moments[1].samples == 5.0


def test_the_question_is_open_once_known_places_have_a_fifth():
    shares = [[], [0.19], [0.1, 0.1]]
    known = [[hypothesis(1 + n, 0, share, 1) for n, share in enumerate(own)] for own in shares]
    pmf = [entry(k, hypothesis(0, 0, 1.0 - sum(own)), *known[k]) for k, own in enumerate(shares)]
    assert [moment.has_question for moment in trace_hypotheses(pmf, 0)] == [False, False, True]


def test_what_closed_before_the_story_begins_does_not_count():
    assert not any(moment.has_question for moment in trace_hypotheses(PMF, 2)[:1])


def test_both_are_alive_until_the_evidence_and_the_true_one_is_sure_soon_after():
    verdict = judge_reentry(trace_hypotheses(PMF, 0), evidence=3)
    assert (verdict.lowest, verdict.highest, verdict.at_question, verdict.at_evidence) == (0.3, 0.7, 0.5, 0.7)
    assert verdict.both_alive
    assert verdict.waited == 0.0
    assert verdict.is_decided_correctly


def test_a_hypothesis_that_is_ruled_out_before_the_evidence_is_not_alive():
    verdict = judge_reentry(trace_hypotheses(PMF, 0), evidence=4)
    assert not verdict.both_alive
    assert verdict.lowest == 0.03


def test_the_wrong_place_is_never_sure():
    swapped = [entry(e["event"], *(hypothesis(**swap(one)) for one in e["hypotheses"])) for e in PMF]
    verdict = judge_reentry(trace_hypotheses(swapped, 0), evidence=3)
    assert verdict.both_alive
    assert verdict.waited is None
    assert not verdict.is_decided_correctly


def swap(one):
    return {
        "hypothesis": one["hypothesis"],
        "parent": one["parent"],
        "probability": one["probability"],
        "right": one["wrong"],
        "wrong": one["right"],
    }


def test_a_question_after_the_evidence_shows_nothing_alive_but_can_be_decided():
    verdict = judge_reentry(trace_hypotheses(PMF, 0), evidence=0)
    assert verdict.has_question
    assert not verdict.both_alive
    assert verdict.waited == pytest.approx(1.0)


def test_without_a_question_nothing_is_decided():
    verdict = judge_reentry(trace_hypotheses([entry(k, hypothesis(0, 0, 1.0)) for k in range(3)], 0), evidence=1)
    assert not verdict.has_question
    assert not verdict.is_decided_correctly


def reentry(by, verdict):
    return Reentry({}, {"by_odometry": by}, [], verdict)


def test_requirements_hold_only_where_all_undecided_are_alive_and_all_are_decided_correctly():
    good = ReentryVerdict(True, 0.3, 0.7, 0.5, 0.7, 0.5, 1.0)
    late = ReentryVerdict(True, None, None, None, None, 0.0, 1.0)
    decided_unasked = reentry(1.0, ReentryVerdict(False, None, None, None, None, None, 0.0))
    assert all(requirement.is_met for requirement in requirements("twins", [reentry(0.4, good), decided_unasked]))
    assert [a.is_met for a in requirements("twins", [reentry(0.4, good), reentry(0.9, late)])] == [True, False, True]
    assert [requirement.is_met for requirement in requirements("ring", [reentry(1.0, late)])] == [False, True]


@pytest.fixture(scope="module")
def twins():
    return open_simulated("sim:twins,seed=0,size=0.7")


def in_room(log, name, x, y, turn=-0.5 * np.pi):
    """A pose by its place in front of a room: ``x`` m to the side of the door, ``y`` m before it."""
    place = log.scenario.building.twin_frames[name]
    return se2.compose(place, np.array([-y, x, turn + 0.5 * np.pi]))


def test_twin_rooms_look_alike_from_within_and_not_from_the_passage(twins):
    for x, y, turn, alike in ((0.0, 3.0, -0.5, True), (0.0, -2.0, -0.5, True), (0.0, -5.5, -0.5, False)):
        pose, image = (in_room(twins, name, x, y, turn * np.pi) for name in ("first", "second"))
        assert looks_alike(twins, pose, image) == alike


def test_nothing_to_be_seen_is_not_alike(twins):
    pose, image = (in_room(twins, name, 0.0, 12.0, 0.5 * np.pi) for name in ("first", "second"))
    assert not looks_alike(twins, pose, image)


def keyframe_truth(log, count):
    """The truth about keyframes at equal times."""
    truth = Truth(log)
    stamps = log.scenario.scan_stamps[np.linspace(0, log.scan_count - 1, count).astype(int)]
    for k, (stamp, pose) in enumerate(zip(stamps, log.true_poses(stamps), strict=True)):
        truth.stamps[k], truth.poses[k] = int(stamp), pose
    return truth


def test_odometry_rules_out_what_is_many_deviations_off_and_not_what_is_none_off(twins):
    truth = keyframe_truth(twins, 60)
    here = truth.poses[30]
    near, far = se2.compose(here, np.array([0.05, 0.0, 0.0])), se2.compose(here, np.array([0.0, 0.0, np.pi]))
    weights = odometry_probabilities(twins, truth, 20, 30, [here, near, far])
    assert weights.sum() == pytest.approx(1.0)
    assert weights[1] == pytest.approx(weights[0], rel=0.5)
    assert weights[2] < 1e-3


def test_in_the_ring_odometry_decides_and_views_never_do():
    log = open_simulated("sim:ring,seed=0")
    truth = keyframe_truth(log, 201)
    traveled = {k: 0.55 * k for k in truth.poses}
    loop = Loop(100, 55.0, 60.0, 55.0, {100: (0,), 101: (1,)})
    (found,) = find_rivalries(log, truth, [loop], traveled)
    assert (found.event, found.since, found.evidence) == (100, 0, None)
    assert found.by_odometry > 0.99


def test_a_world_without_identical_places_has_no_rivalry():
    log = SimpleNamespace(scenario=SimpleNamespace(building=SimpleNamespace(twin_frames={})))
    assert find_rivalries(log, None, [Loop(1, 0.0, 0.0, 1.0, {1: (0,)})], {}) == []


def test_the_table_has_the_path_until_the_true_place_is_sure():
    slow = [entry(0, hypothesis(0, 0, 1.0)), entry(1, hypothesis(2, 0, 0.5, right=1), hypothesis(3, 0, 0.5, wrong=1))]
    slow += [
        entry(k, hypothesis(2, 2, min(1.0, 0.5 + 0.04 * k)), hypothesis(3, 3, max(0.0, 0.5 - 0.04 * k)))
        for k in range(2, 60)
    ]
    moments = trace_hypotheses(slow, 0)
    rivalry = {"event": 0, "evidence": 1, "by_odometry": 0.6}
    found = [Reentry({"family": "twins"}, rivalry, moments, judge_reentry(moments, 1))]
    # Over 0.95 from event 12 on, which is 5.5 m after the evidence.
    assert "| twins, not decided by it | 1 | 0 | 0 | 1 | 1 |" in decision_table(found)
    assert "| twins, decided by odometry | 0 | 0 | 0 | 0 | 0 |" in decision_table(found)
