"""The prior of a kidnapping: by what the motion to a keyframe event rests on, learnt in this map."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from ring_for_tsbi import RING, Run, ring_drive
from test_topological_inference_branching import OTHER, PATH, ROOM, rooms_apart

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.messages import HypothesisEstimate
from hmt_slam_ros.registration.consistency import Agreement, Clutter
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch, known_ground_log_ratio
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState, PoseInArea
from hmt_slam_ros.topological_inference.kidnapping import decide_without_mapping, spawn_kidnapped_hypothesis
from hmt_slam_ros.topological_inference.kidnapping_evidence import CUSUM_DRIFT, log_displacement_ratio
from hmt_slam_ros.topological_inference.kidnapping_prior import EventCounts, KidnappingPriors, add_counts
from hmt_slam_ros.topological_inference.tsbi import Tsbi

PRIORS = KidnappingPriors.from_configuration(Configuration())
FAULTS = ["after_gap", "uncertain"]


def probability(condition, counts):
    """The prior probability of a kidnapping."""
    return 1.0 / (1.0 + math.exp(-PRIORS.log_odds(condition, counts)))


def after_events(scans, conditions=None, state=None, first=5):
    """The state after events: the sum of what ends and walls contradict, nats, and {index: condition}."""
    state = state or HypothesisState()
    for n, nats in enumerate(scans):
        state = state.after_motion(first + n, (conditions or {}).get(n, "ordinary"), PRIORS)
        state = state.after_scan(first + n, -0.5 * nats, -0.5 * nats, PRIORS)
    return state


def test_the_prior_of_an_ordinary_event_is_the_parameter_and_that_of_a_fault_its_share_of_the_faults():
    prior, fault = Configuration().tsbi.kidnapping_prior, Configuration().motion.fault_probability
    assert probability("ordinary", {}) == pytest.approx(prior, rel=1e-9)
    for condition in FAULTS:
        assert probability(condition, {}) == pytest.approx(prior / (prior + fault), rel=1e-9)


def test_the_prior_is_the_posterior_mean_of_the_counts_of_its_condition():
    counts = {"ordinary": EventCounts(1000, 1), "after_gap": EventCounts(40, 3)}
    rate = 37.5 / (0.5 / PRIORS.fault + 1040)
    mean = PRIORS.kidnapping / (PRIORS.kidnapping + rate)
    assert probability("ordinary", counts) == pytest.approx(1.5 / (0.5 / PRIORS.kidnapping + 1000), rel=1e-9)
    assert probability("after_gap", counts) == pytest.approx((0.5 + 3) / (0.5 / mean + 40), rel=1e-9)


def test_faults_that_were_kidnappings_do_not_make_such_a_fault_usual():
    counts = {"ordinary": EventCounts(1000, 0), "after_gap": EventCounts(6, 6)}
    expected = (0.5 + 6) / (0.5 / probability("after_gap", {}) + 6)
    assert probability("after_gap", counts) == pytest.approx(expected, rel=1e-9)


def test_a_fault_that_is_usual_says_little():
    """Stamps of scans that are sent in bursts have a gap every few seconds."""
    rare, usual = ({"ordinary": EventCounts(1000, 0), "after_gap": EventCounts(n, 0)} for n in (1, 300))
    assert probability("after_gap", rare) == pytest.approx(probability("after_gap", {}), rel=0.01)
    assert PRIORS.kidnapping < probability("after_gap", usual) < 5.0 * PRIORS.kidnapping


def test_events_are_counted_by_their_condition():
    state = after_events((-3.0,) * 4, {1: "after_gap", 3: "uncertain"})
    assert state.kidnapping_counts == {"ordinary": (2, 0), "after_gap": (1, 0), "uncertain": (1, 0)}
    assert state.after_area_change({}).kidnapping_counts == state.kidnapping_counts
    assert add_counts(state.kidnapping_counts, "uncertain", kidnappings=2)["uncertain"] == (1, 2)


@pytest.mark.parametrize("condition", FAULTS)
def test_after_a_fault_the_same_scans_make_a_kidnapping_more_probable(condition):
    scans = (-3.0, 6.0, 4.0)
    ordinary, event, _ = after_events(scans).kidnapping_test(PRIORS)
    faulty, onset, condition_then = after_events(scans, {1: condition}).kidnapping_test(PRIORS)
    assert (event, onset, condition_then) == (6, 6, condition)
    # Evidence of ordinary motions has a drift of 1 nat at each event.
    assert 3.5 + 2.0 * CUSUM_DRIFT + math.log(1.0 - PRIORS.aliasing) < faulty - ordinary
    assert faulty - ordinary < math.log(1.0 / PRIORS.fault) + 2.0 * CUSUM_DRIFT


def test_scans_that_agree_after_the_fault_are_none_of_those_since_the_onset():
    """The robot may have been put into a similar place, which ended there."""
    state = after_events((0.5, 4.0, 4.0), {0: "after_gap"})
    test = state.kidnapping_test(PRIORS)
    assert (test.since, test.condition) == (6, "after_gap")
    assert state.after_area_change({}).kidnapping_test(PRIORS) == state.kidnapping_test(PRIORS)


def test_a_fault_alone_is_no_evidence():
    state = after_events((0.5,), {0: "after_gap"})
    assert state.onset_conditions == {5: "after_gap"}
    assert state.kidnapping_test(PRIORS) is None


def test_a_fault_before_scans_that_fit_is_remembered_since_another_place_may_be_similar():
    state = after_events((0.5, *(-4.0,) * 5), {0: "after_gap"})
    assert state.onset_conditions == {5: "after_gap"}
    assert state.kidnapping_test(PRIORS) is None
    odds, onset, condition = after_events((6.0, 6.0), state=state, first=11).kidnapping_test(PRIORS)
    alone = HypothesisState(surroundings=state.surroundings, kidnapping_counts=state.kidnapping_counts)
    others, _, _ = after_events((6.0, 6.0), state=alone, first=11).kidnapping_test(PRIORS)
    assert (onset, condition) == (11, "after_gap")
    assert odds > others + 1.0


def test_the_longer_scans_fit_the_less_a_fault_counts():
    states = [after_events((*(-4.0,) * n, 6.0, 6.0), {0: "after_gap"}) for n in (2, 6, 10)]
    odds = [state.kidnapping_test(PRIORS).log_odds for state in states]
    assert odds[0] > odds[1] > odds[2]
    assert not after_events((-4.0,) * 28, {0: "after_gap"}).onset_conditions


def test_a_usual_fault_is_not_remembered():
    usual = HypothesisState(kidnapping_counts={"ordinary": EventCounts(1000, 0), "after_gap": EventCounts(300, 0)})
    assert not after_events((0.5,), {0: "after_gap"}, state=usual).onset_conditions


def test_a_fault_is_remembered_as_long_as_evidence():
    state = after_events((0.9,) * 40, {0: "after_gap"})
    assert not state.kidnapping_evidence
    assert not state.onset_conditions


def test_a_fault_while_evidence_adds_up_does_not_replace_a_better_onset():
    assert after_events((12.0, 1.1, 1.1), {2: "after_gap"}).kidnapping_test(PRIORS)[1:] == (5, "ordinary")


def test_the_evidence_since_a_fault_is_that_of_all_places_where_the_robot_may_be():
    """By an enumeration of the events at which a similar place ends."""
    evidence, similar, end = {3: 99.0, 5: -0.4, 6: 1.2, 7: -2.0, 8: 3.0}, 0.25, 0.1
    ratios = [math.exp(nats + CUSUM_DRIFT) for event, nats in evidence.items() if event >= 5]
    expected = (1.0 - similar) * math.prod(ratios)
    for n in range(1, len(ratios)):
        expected += similar * (1.0 - end) ** (n - 1) * end * math.prod(ratios[n:])
    expected += similar * (1.0 - end) ** (len(ratios) - 1)
    assert log_displacement_ratio(evidence, 5, similar) == pytest.approx(math.log(expected), rel=1e-12)


def spawn(condition, counts=None, nats=0.5):
    """The children after CUSUM increments of so many nats in each keyframe of the last room."""
    parent, branching, newest = rooms_apart((ROOM, OTHER, ROOM), [(30.0, 20.0)] * 2, 0.1)
    conditions = {} if condition == "ordinary" else {newest[1]: condition}
    state = replace(
        parent.state,
        kidnapping_evidence=dict.fromkeys(newest[1:], nats / len(newest[1:])),
        onset_conditions=conditions,
        kidnapping_counts=counts or {},
    )
    return spawn_kidnapped_hypothesis(branching, replace(parent, state=state))


@pytest.mark.parametrize("condition", FAULTS)
def test_a_fault_spawns_a_kidnapped_hypothesis_on_less_evidence(condition):
    assert spawn("ordinary") is None
    stays, kidnapped = spawn(condition).children
    assert stays.state.kidnapping_counts == {}
    assert kidnapped.state.kidnapping_counts == {condition: (0, 1)}
    for child in (stays, kidnapped):
        assert not child.state.onset_conditions
    assert spawn(condition, nats=-5.0 * CUSUM_DRIFT) is None


def test_repeated_kidnappings_raise_the_prior():
    counts = {}
    first = spawn("after_gap").children[1].log_weight
    for _ in range(3):
        before = probability("after_gap", counts)
        counts = add_counts(counts, "after_gap", events=1, kidnappings=1)
        assert probability("after_gap", counts) > before
        assert probability("ordinary", counts) == probability("ordinary", {})
    assert spawn("after_gap", counts).children[1].log_weight > first + 1.0


@pytest.mark.parametrize(("condition", "lost"), [("ordinary", False), ("after_gap", True), ("uncertain", True)])
def test_without_mapping_the_robot_is_lost_on_less_evidence_after_a_fault(condition, lost, monkeypatch):
    parent, branching, _ = rooms_apart((ROOM,), [], 0.1)
    monkeypatch.setattr("hmt_slam_ros.topological_inference.kidnapping._confirms_tracked_pose", lambda *_: False)
    state = replace(
        parent.state,
        kidnapping_evidence={17: 8.0},
        onset_conditions={} if condition == "ordinary" else {17: condition},
        unstored_poses={17: PoseInArea(0, 17, PATH[3])},
    )
    child = decide_without_mapping(branching, replace(parent, state=state), 17)
    assert child.state.is_lost is lost
    if lost:
        assert child.state.localization.false_alarm.motion_condition == condition


def test_the_counts_are_part_of_the_state_and_a_resumed_inference_decides_alike():
    poses = ring_drive(14)
    run = Run(RING)
    for n, pose in enumerate(poses[:12]):
        run.keyframe(pose, motion_condition="after_gap" if n == 3 else "ordinary")
    (state,) = run.tsbi.state.hypothesis_states.values()
    assert state.kidnapping_counts == {"ordinary": (11, 0), "after_gap": (1, 0)}
    run.evidence[0] = -1.0
    run.keyframe(poses[12], motion_condition="after_gap")
    resumed = Tsbi(Configuration(), state=run.tsbi.state)
    (before,), (after,) = (own.state.hypothesis_states.values() for own in (run.tsbi, resumed))
    assert before.onset_conditions == after.onset_conditions == {3: "after_gap", 12: "after_gap"}
    assert before.kidnapping_test(PRIORS) == after.kidnapping_test(PRIORS)
    assert after.kidnapping_counts["after_gap"] == (2, 0)
    assert list(before.kidnapping_evidence) == list(range(3, 13))


def test_after_a_fault_scans_count_by_the_ground_from_before_it(monkeypatch):
    """Ends as that ground has them, and walls that agree by its share of the scan; contradictions count in full."""
    run, before = Run(RING), []
    for n, pose in enumerate(ring_drive(14)[:13]):
        run.keyframe(pose, motion_condition="after_gap" if n == 12 else "ordinary")
    agreement = Agreement(100, 40, 9)
    monkeypatch.setattr(ClosureSearch, "known_ground_agreement", lambda *given: before.append(given[-1]) or agreement)
    (state,), keyframe = (
        run.tsbi.state.hypothesis_states.values(),
        SimpleNamespace(sequence=13, scan=run.replica.scans[12]),
    )
    estimate = HypothesisEstimate(0, 0, PoseGaussian.from_pose(np.zeros(3)), True, 0.7, -1.9, Clutter(0.1, 0.0), 12.0)
    ends, walls = run.tsbi._log_ratios(estimate, state, keyframe)
    assert before == [10]
    assert ends == known_ground_log_ratio(agreement, 0.1)
    assert walls == pytest.approx(0.4 * 1.2)
    _, contradicting = run.tsbi._log_ratios(replace(estimate, log_kidnapping_ratio=1.1), state, keyframe)
    assert contradicting == pytest.approx(-1.8)
    ordinary = replace(state, onset_conditions={})
    assert run.tsbi._log_ratios(estimate, ordinary, keyframe) == pytest.approx((0.7, 1.2))
    assert before == [10, 10]
