"""Visits of marks as evidence: what they weigh, what they propose, and how little a wrong one may do."""

import math
from dataclasses import replace

import numpy as np
import pytest
from ring_for_tsbi import RING, Run, ring_drive

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.flat import with_changes
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.registration.area_to_area import MatchMode
from hmt_slam_ros.registration.consistency import Agreement
from hmt_slam_ros.saved_map.validation import check_record
from hmt_slam_ros.sensors import MarkObservation
from hmt_slam_ros.topological_inference.branches import Parent
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.candidate_gating import Query, Transition
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState, Lost
from hmt_slam_ros.topological_inference.marked_places import NO_MARKS, MarkedPlaceFinder
from hmt_slam_ros.topological_inference.marks import (
    Anchor,
    AreaMark,
    MarkEntry,
    MarkEvidence,
    MarkMemory,
    MarkVisit,
    fuse_with_mark,
    mix_transition,
    nearest_anchor,
)
from hmt_slam_ros.topological_inference.pose_distribution import UNMAPPED_PRIOR
from hmt_slam_ros.topological_inference.search_prior import PoseHint

WRONG = Configuration().marks.wrong_share
SHARP = np.diag([0.03, 0.03, 0.02]) ** 2
MARK = np.array([4.0, 1.2, 0.4])  # in the world


def observation(pose, name="lift", mark=MARK):
    """The observation of a mark at a pose of the robot in the world."""
    return MarkObservation(0, name, PoseGaussian(se2.between(mark, pose), SHARP))


def visit(keyframe, pose, **more):
    """A visit at a keyframe."""
    return MarkVisit(keyframe, keyframe, keyframe, replace(observation(pose), **more).pose)


def line(deviation, areas=3, angle=0.02):
    """A map of areas 10 m apart along x with two keyframes each, 0 and 1 in area 0 and so on; arcs as uncertain."""
    hybrid_map = HybridMap()
    for area in range(areas):
        for k in range(2):
            hybrid_map.set_keyframe(2 * area + k, area, np.array([1.0 * k, 0.0, 0.0]))
    for area in range(areas - 1):
        arc = PoseGaussian(np.array([10.0, 0.0, 0.0]), np.diag([deviation, deviation, angle]) ** 2)
        hybrid_map.set_arc(area, area + 1, arc, closure=False)
    return hybrid_map


def line_pose(area, x=0.0, off=0.0):
    """The pose of a keyframe of the line in the world."""
    return np.array([10.0 * area + x, off, 0.0])


def query(keyframe=4, pose=(0.0, 0.0, 0.0)):
    """A query of one keyframe of the last area."""
    return Query(PoseGaussian(np.array(pose), np.diag([1e-4, 1e-4, 1e-6])), {keyframe: np.zeros(3)})


def test_observations_with_few_events_between_are_one_visit_of_the_first_of_them():
    memory, poses = MarkMemory(), ring_drive(80)
    for event in (3, 5, 32, 70):
        anchor = Anchor(event, np.zeros(3))
        memory = memory.after_event(event, [observation(poses[event])], anchor)
    (visits,) = memory.visits.values()
    assert [(one.first_event, one.last_event, one.keyframe) for one in visits] == [(3, 32, 3), (70, 70, 70)]
    np.testing.assert_allclose(visits[1].pose.mean, se2.between(MARK, poses[70]))
    assert [one[0].first_event for one in memory.beginning_visits(70)] == [70]
    assert memory.beginning_visits(32) == []
    assert [one[0].keyframe for one in memory.repeated_visits({70})] == [70]
    assert not list(memory.repeated_visits({3}))


def test_without_an_anchor_a_visit_goes_on_and_none_begins():
    memory = MarkMemory().after_event(0, [observation(line_pose(0))], None)
    assert memory.visits == {}
    memory = memory.after_event(1, [observation(line_pose(0))], Anchor(1, np.zeros(3)))
    memory = memory.after_event(25, [observation(line_pose(0))], None)
    assert memory.visits["lift"][0].last_event == 25
    assert memory.after_event(60, [observation(line_pose(0))], None).visits == memory.visits


def test_visits_and_marks_are_bounded():
    memory = MarkMemory()
    for event in range(0, 1000, 40):
        memory = memory.after_event(event, [observation(line_pose(0))], Anchor(event, np.zeros(3)))
    events = [one.first_event for one in memory.visits["lift"]]
    assert len(events) == 16
    assert (events[0], events[1], events[-1]) == (0, 400, 960)
    many = [observation(line_pose(0), f"mark {k}") for k in range(1010)]
    assert len(MarkMemory().after_event(0, many, Anchor(0, np.zeros(3))).visits) == 1000


def test_a_visit_goes_to_the_nearest_keyframe_where_its_own_is_pruned_or_is_forgotten():
    hybrid_map = line(0.1)
    memory = MarkMemory({"lift": (visit(1, line_pose(0, 1.0)),), "tag": (visit(5, line_pose(2, 1.0)),)})
    anchor = nearest_anchor(hybrid_map, 0, np.array([1.0, 0.0, 0.0]), {1})
    moved = memory.without_keyframes({1: anchor, 5: None})
    assert moved.visits.keys() == {"lift"}
    (one,) = moved.visits["lift"]
    assert one.keyframe == 0
    np.testing.assert_allclose(one.pose.mean, se2.between(MARK, line_pose(0)), atol=1e-12)
    assert memory.restricted_to({5}).visits.keys() == {"tag"}
    assert nearest_anchor(hybrid_map, 0, np.zeros(3), {0, 1}) is None


@pytest.mark.parametrize(
    ("off", "least", "most"), [(0.0, -1e-9, 0.0), (0.2, -0.1, 0.0), (6.0, math.log(WRONG), math.log(WRONG))]
)
def test_a_hypothesis_loses_what_a_visit_contradicts_and_never_more_than_its_reliability(off, least, most):
    evidence = MarkEvidence(Configuration())
    known, now = visit(0, line_pose(0)), visit(4, line_pose(2, off=off))
    pose = PoseGaussian(np.zeros(3), np.diag([1e-4, 1e-4, 1e-6]))
    found = evidence.log_likelihood(line(0.2), 2, pose, now, (known,))
    assert least - 1e-9 <= found <= most + 1e-9


def test_of_several_earlier_visits_each_may_be_the_right_one():
    evidence = MarkEvidence(Configuration())
    pose = PoseGaussian(np.zeros(3), np.diag([1e-4, 1e-4, 1e-6]))
    wrong = visit(2, line_pose(1, off=30.0))
    found = evidence.log_likelihood(line(0.2), 2, pose, visit(4, line_pose(2)), (visit(0, line_pose(0)), wrong))
    assert found == pytest.approx(math.log(WRONG + 0.5 * (1.0 - WRONG)), abs=0.01)


def test_visits_that_the_map_lacks_are_no_evidence():
    evidence = MarkEvidence(Configuration())
    pose = PoseGaussian(np.zeros(3), np.diag([1e-4, 1e-4, 1e-6]))
    assert evidence.log_likelihood(line(0.2), 2, pose, visit(4, line_pose(2)), (visit(99, line_pose(0)),)) == 0.0


def closing(wrong=False, count=1, deviation=3.0):
    """A memory in which the robot of area 2 sees marks of area 0 again, as if it had come back there."""
    there = line_pose(0, 0.5)
    before = [visit(0, line_pose(0, off=40.0 if wrong else 0.0)) for _ in range(count)]
    memory = MarkMemory({f"mark {k}": (one, visit(4, there)) for k, one in enumerate(before)})
    hybrid_map = line(deviation, angle=0.3)
    return MarkEvidence(Configuration()), hybrid_map, memory


def test_a_mark_puts_keyframes_into_the_area_where_it_was_seen():
    # The arcs are 20 m off, but so wide that they admit it.
    evidence, hybrid_map, memory = closing(deviation=12.0)
    found = evidence.find_areas(hybrid_map, 2, query(), memory, {2})
    assert found.keys() == {0}
    np.testing.assert_allclose(found[0].belief.mean, [0.5, 0.0, 0.0], atol=1e-9)
    assert 0.0 < found[0].mark_gain <= 1.0 / WRONG - 1.0 + 1e-9
    assert evidence.find_areas(hybrid_map, 2, query(), memory, {0, 2}) == {}
    assert evidence.find_areas(hybrid_map, 2, query(5), memory, {2}) == {}


def test_a_mark_beyond_the_gate_of_the_arcs_proposes_nothing():
    evidence, hybrid_map, memory = closing(deviation=0.3)
    assert evidence.find_areas(hybrid_map, 2, query(), memory, {2}) == {}
    evidence, hybrid_map, memory = closing(wrong=True, deviation=3.0)
    assert evidence.find_areas(hybrid_map, 2, query(), memory, {2}) == {}


def test_the_factors_of_several_marks_multiply():
    one, two = (
        evidence.find_areas(hybrid_map, 2, query(), memory, {2})[0]
        for evidence, hybrid_map, memory in (closing(count=1, deviation=12.0), closing(count=2, deviation=12.0))
    )
    assert two.mark_gain == pytest.approx((1.0 + one.mark_gain) ** 2 - 1.0)


def test_the_transition_model_is_a_mixture_that_sums_to_one():
    by_arcs = Transition({0: 0.2, 3: 0.1}, 0.7)
    assert mix_transition(by_arcs, {}, 0.05) is by_arcs
    belief = PoseGaussian(np.zeros(3), SHARP)
    mixed = mix_transition(by_arcs, {0: MarkEntry(belief, 19.0, 0.9), 5: MarkEntry(belief, 1.0, 1.0)}, 0.05)
    assert mixed.known[0] == pytest.approx((0.2 + 19.0 * 0.9) / 21.0)
    assert mixed.known[3] == pytest.approx(0.1 / 21.0)
    assert mixed.known[5] == pytest.approx(0.95 / 21.0)
    assert mixed.new == pytest.approx((0.7 + 19.0 * 0.1 + 0.05) / 21.0)
    assert sum(mixed.known.values()) + mixed.new == pytest.approx(1.0)


def modes(*poses):
    """Modes of a match of equal mass."""
    return [
        MatchMode(PoseGaussian(np.array(pose), 0.01 * np.eye(3)), PoseGaussian(np.array(pose), 0.02 * np.eye(3)), -3.0)
        for pose in poses
    ]


def test_the_modes_share_what_a_mark_adds_by_how_they_agree_with_it():
    entry = MarkEntry(PoseGaussian(np.zeros(3), SHARP), 19.0, 1.0)
    assert entry.shares(modes((0.0, 0.0, 0.0), (5.0, 0.0, 0.0))) == pytest.approx([1.0, 0.0], abs=1e-6)
    assert entry.shares(modes((0.0, 0.0, 0.0), (0.01, 0.0, 0.0))) == pytest.approx([0.5, 0.5])
    assert max(entry.shares(modes((5.0, 0.0, 0.0)))) < 1e-6
    assert entry.shares([]) == []


def test_a_mode_that_agrees_is_fused_with_the_mark_and_another_stays():
    (near, far), mark = modes((0.05, 0.0, 0.0), (3.0, 0.0, 0.0)), PoseGaussian(np.zeros(3), SHARP)
    fused = fuse_with_mark(near, mark)
    assert 0.0 < fused.measured.mean[0] < 0.01
    assert np.linalg.eigvalsh(near.measured.covariance - fused.measured.covariance).min() > 0.0
    assert fuse_with_mark(far, mark) is far


def test_where_the_arcs_hardly_know_the_heading_the_mark_counts_alone():
    mark = PoseGaussian(np.array([1.0, 2.0, 0.3]), SHARP)
    wide = AreaMark(PoseGaussian(np.zeros(3), 2.0 * np.eye(3)), mark, 1.0)
    assert wide.joint_belief is mark
    narrow = AreaMark(PoseGaussian(mark.mean, SHARP), mark, 1.0).joint_belief
    np.testing.assert_allclose(narrow.covariance, 0.5 * SHARP)


def run_with_marks(names, configuration=None, length=122, until=122):
    """Once around the ring and on; {keyframe: names of marks seen there}, each at one place of the world."""
    run, poses = Run(RING, configuration=configuration, field_of_view=2 * np.pi, beams=241), ring_drive(length)
    for k, pose in enumerate(poses[:until]):
        run.marks = tuple(observation(pose, name) for name in names.get(k, ()))
        run.keyframe(pose, cut=7 if k and k % 14 == 0 else 0)
        if len(run.answers[-1].hypotheses) > 1:
            break
    return run, k


def test_a_mark_leads_to_a_comparison_at_once():
    # The ring closes at keyframe 96; the re-check after a cut at 98 is due at 103.
    _, first = run_with_marks({})
    marked, earlier = run_with_marks({2: ["lift"], 98: ["lift"]})
    assert earlier <= first
    assert len(marked.answers[-1].hypotheses) > 1
    assert marked.tsbi.state.branching.marks.visits["lift"][1].keyframe == 98


def test_marks_survive_in_the_state():
    run, _ = run_with_marks({2: ["lift"]}, until=10)
    (one,) = run.tsbi.state.branching.marks.visits["lift"]
    assert (one.first_event, one.keyframe) == (2, 2)


@pytest.mark.parametrize(
    ("visits", "words"),
    [
        ((), "a mark that was visited"),
        ((visit(99, ring_drive(1)[0]),), "at keyframes with scans"),
        ((visit(2, ring_drive(1)[0]), visit(1, ring_drive(1)[0])), "in the order of events"),
        ((replace(visit(2, ring_drive(1)[0]), pose=PoseGaussian(MARK, np.zeros((3, 3)))),), "positive definite"),
    ],
)
def test_marks_that_cannot_be_are_in_no_saved_state(visits, words):
    run, _ = run_with_marks({2: ["lift"]}, until=10)
    state = run.tsbi.state
    check_record(state, "tsbi")
    tampered = replace(state, branching=replace(state.branching, marks=MarkMemory({"lift": visits})))
    with pytest.raises(HmtSlamError, match=words):
        check_record(tampered, "tsbi")


@pytest.mark.parametrize("wrong_share", [0.01, 0.3])
def test_the_share_of_wrong_marks_bounds_the_gain(wrong_share):
    _, hybrid_map, memory = closing(deviation=12.0)
    evidence = MarkEvidence(with_changes(Configuration(), {"marks.wrong_share": wrong_share}))
    assert evidence.find_areas(hybrid_map, 2, query(), memory, {2})[0].mark_gain <= 1.0 / wrong_share - 1.0 + 1e-9


LOST = {8: np.zeros(3), 9: np.array([0.5, 0.0, 0.0])}
"""Keyframes of a lost robot, of which the second visits a mark."""


def pose_candidate(area, pose):
    """A match of the lost robot's keyframes."""
    belief = PoseGaussian(np.array(pose), np.diag([0.02, 0.02, 0.01]) ** 2)
    return PoseCandidate(area, MatchMode(belief, belief, 0.0), Agreement(100, 90, 0))


def lost_memory(*earlier, pose):
    """Visits before, and one of a lost robot whose second keyframe is at a pose of the world."""
    return MarkMemory({"lift": (*earlier, visit(9, pose))})


def test_a_mark_puts_a_lost_robot_where_it_was_visited():
    hybrid_map = line(0.1)
    # The robot is at the beginning of area 1, in which the mark was visited 1 m farther on.
    memory = lost_memory(visit(3, line_pose(1, 1.0)), pose=line_pose(1, 0.5))
    places = MarkedPlaceFinder(Configuration()).find(hybrid_map, LOST, 8, memory)
    ((pose,),) = places.marks
    assert pose.area == 1
    np.testing.assert_allclose(pose.belief.mean, np.zeros(3), atol=1e-9)
    flat = 0.8 / 3
    found = [pose_candidate(1, (0.0, 0.0, 0.0)), pose_candidate(1, (0.8, 0.0, 0.0)), pose_candidate(2, (0.0, 0.0, 0.0))]
    factors = np.exp(places.log_factors(hybrid_map, found, flat))
    # In the frame of another area it is the same place.
    beside = pose_candidate(0, (10.0, 0.0, 0.0))
    np.testing.assert_allclose(factors, [WRONG + (1.0 - WRONG) / flat, WRONG, WRONG])
    np.testing.assert_allclose(np.exp(places.log_factors(hybrid_map, [beside], flat)), factors[:1], rtol=0.2)
    assert places.area_factors((0, 1), flat) == pytest.approx({0: WRONG, 1: factors[0]})
    assert math.exp(places.log_unmarked) == pytest.approx(WRONG)


def test_a_mark_that_was_not_visited_before_tells_a_lost_robot_nothing():
    finder, hybrid_map = MarkedPlaceFinder(Configuration()), line(0.1)
    own = visit(8, line_pose(1))
    for memory in (MarkMemory(), lost_memory(pose=line_pose(1)), lost_memory(own, pose=line_pose(1))):
        assert finder.find(hybrid_map, LOST, 8, memory) is NO_MARKS
    assert NO_MARKS.log_factors(hybrid_map, [pose_candidate(1, (0.0, 0.0, 0.0))], 0.3) == [0.0]
    assert NO_MARKS.log_unmarked == 0.0


@pytest.mark.parametrize(("earlier", "share"), [(1, 1.0), (4, 0.25)])
def test_a_mark_alone_is_as_sure_as_it_is_right_and_its_visits_share_that(earlier, share):
    """Among any number of areas whose scans agree equally well."""
    areas = 50
    hybrid_map = line(0.1, areas)
    visits = [visit(2 * area, line_pose(10)) for area in range(10, 10 + earlier)]
    memory = lost_memory(*visits, pose=line_pose(10, 0.5))
    poses = {200: np.zeros(3), 9: np.array([0.5, 0.0, 0.0])}
    places = MarkedPlaceFinder(Configuration()).find(hybrid_map, poses, 200, memory)
    candidates = [pose_candidate(area, (0.0, 0.0, 0.0)) for area in range(areas)]
    flat = 0.8 / areas
    weights = flat * np.exp(places.log_factors(hybrid_map, candidates, flat))
    probabilities = weights / (weights.sum() + 0.2 * math.exp(places.log_unmarked))
    assert probabilities[10] == pytest.approx((1.0 - WRONG) * share, abs=2e-3)
    assert probabilities[40] < WRONG * flat * 1.01


def test_a_mark_is_no_evidence_beside_an_initial_pose_of_a_searched_keyframe():
    branching = Branching(Configuration(), Replica())
    branching.marks = lost_memory(visit(3, line_pose(1, 1.0)), pose=line_pose(1, 0.5))
    parent = Parent(4, 2, line(0.1), HypothesisState(), 0.0)
    for keyframe, is_searched in ((9, True), (7, False)):
        hint = PoseHint(keyframe, 1, PoseGaussian(np.zeros(3), np.eye(3)))
        prior = branching.find_search_prior(parent, Lost(8, pose_hint=hint), LOST)
        assert (prior.hint is not None, len(prior.marks.marks)) == (is_searched, 0 if is_searched else 1)
        assert prior.without_marks().hint is prior.hint
        assert prior.without_marks().log_unmapped == math.log(UNMAPPED_PRIOR)


def test_the_visit_of_a_robot_that_is_lost_since_is_another_one():
    memory = MarkMemory().after_event(3, [observation(line_pose(0))], Anchor(3, np.zeros(3)))
    for since, count in ((0, 1), (3, 1), (4, 2)):
        again = memory.after_event(5, [observation(line_pose(1))], Anchor(5, np.zeros(3)), since)
        assert len(again.visits["lift"]) == count
