"""Kidnapping: a hypothesis is spawned, or lost, as far as the scans contradict the tracked pose."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from relocalizing import ARC, OPTIONS, GivenSearch, candidate, distribution, make_parent
from ring_for_tsbi import RING, Run, ring_drive
from test_topological_inference_branching import OTHER, PATH, ROOM, rooms_apart
from worlds import box, scan_in

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative
from hmt_slam_ros.messages.map_changes import InitialPose
from hmt_slam_ros.messages.messages import AreaEvents, Keyframe, PrunedKeyframe
from hmt_slam_ros.registration.area_to_area import MatchMode
from hmt_slam_ros.registration.consistency import Agreement
from hmt_slam_ros.topological_inference import kidnapping, relocalization
from hmt_slam_ros.topological_inference.global_scan_matching import PoseCandidate
from hmt_slam_ros.topological_inference.hypothesis_tree import FalseAlarm, HypothesisState, Lost, PoseInArea, Tracking
from hmt_slam_ros.topological_inference.kidnapping import decide_without_mapping, spawn_kidnapped_hypothesis
from hmt_slam_ros.topological_inference.kidnapping_prior import KidnappingPriors
from hmt_slam_ros.topological_inference.map_search import MapSearch
from hmt_slam_ros.topological_inference.pose_distribution import UNMAPPED_PRIOR, PoseDistribution
from hmt_slam_ros.topological_inference.pose_verification import KIDNAPPED_UNMAPPED_PRIOR
from hmt_slam_ros.topological_inference.tsbi import Tsbi

FAR, HERE = (30.0, 20.0), (0.0, 0.0)
PRIORS = KidnappingPriors.from_configuration(Configuration())
PRIOR = PRIORS.log_odds("ordinary", {})


ANGLE = np.array([[0, 0, 6, 0], [6, 0, 6, 3], [6, 3, 4, 3], [4, 3, 4, 5], [4, 5, 0, 5], [0, 5, 0, 0]], dtype=np.float64)
BEFORE = np.concatenate((ANGLE, box(1.0, 3.0, 2.0, 3.5)))
MOVED = np.concatenate((ANGLE, box(2.6, 0.5, 3.4, 1.1)))
NOWHERE = np.concatenate((box(-1.0, 1.0, 4.2, 6.5), box(2.6, 4.0, 3.6, 5.0)))
HALL = np.concatenate((box(-3.0, 0.5, 9.0, 4.5), box(4.0, 3.0, 5.0, 4.0)))


def spawn(rooms, evidence, first=FAR, hall=2):
    """The children after CUSUM increments in the last room, {keyframe of it: nats}; rooms but the first are far.

    The robot was kidnapped there from a hall, in which it stored ``hall`` keyframes.
    """
    parent, branching, newest = rooms_apart(rooms, [first, *[FAR] * (len(rooms) - 2)], 0.1)
    for k, keyframe in enumerate(newest[:hall]):
        branching.entry._replica.scans[keyframe] = scan_in(
            HALL, PATH[k], noise=0.01, seed=keyframe, field_of_view=2 * np.pi, beams=361
        )
    state = replace(parent.state, kidnapping_evidence={newest[n]: nats for n, nats in evidence.items()})
    return spawn_kidnapped_hypothesis(branching, replace(parent, state=state))


def search_through(branching, parent):
    """The children of a lost hypothesis at the event at which its search ends."""
    while True:
        branching.begin_event()
        branches = relocalization.update_relocalization(branching, parent)
        if branches.pose_distribution is not None:
            return branches
        parent = replace(parent, state=branches.children[0].state)


def since(child):
    """The keyframe since which the robot is lost; None where it is not."""
    return child.state.localization.since if child.state.is_lost else None


def test_the_keyframes_since_then_begin_an_area_with_an_uninformative_arc():
    stays, lost = spawn((ROOM, OTHER, ROOM), {2: 8.0}).children
    assert (stays.area, stays.log_weight, stays.moved_keyframes) == (2, 0.0, ())
    assert lost.area == 3
    assert lost.state.localization.since == 14
    (arc,) = lost.arcs
    assert (arc.source, arc.target) == (2, 3)
    assert is_uninformative(arc.pose)
    poses = {r.keyframe: r.pose for r in lost.moved_keyframes}
    assert sorted(poses) == [14, 15, 16, 17]  # what was stored before the displacement stays
    for keyframe, pose in poses.items():
        np.testing.assert_allclose(pose, se2.between(PATH[2], PATH[keyframe - 12]), atol=1e-9)
    assert not stays.state.kidnapping_evidence
    assert not lost.state.kidnapping_evidence


def test_a_match_elsewhere_is_evidence_for_it_and_the_first_candidate():
    _, lost = spawn((ROOM, OTHER, ROOM), {2: 8.0}).children
    assert lost.log_weight > PRIOR + 8.0 + 1.0
    assert lost.state.localization.counted_evidence == pytest.approx(lost.log_weight - PRIOR - 8.0)
    assert lost.state.localization.candidate.area == 0
    np.testing.assert_allclose(lost.state.localization.candidate.pose, se2.between(PATH[0], PATH[5]), atol=0.05)


def test_two_searches_with_the_same_result_relocalize_it():
    parent, branching, newest = rooms_apart((ROOM, OTHER, ROOM), [FAR, FAR], 0.1)
    lost = Lost(newest[0], tracked_pose=PoseInArea(2, newest[0], np.zeros(3)), counted_evidence=None)
    state = replace(parent.state, localization=lost)
    (still,) = search_through(branching, replace(parent, state=state)).children
    assert still.state.localization.candidate.area == 0
    branches = search_through(branching, replace(parent, state=still.state))
    _, found = branches.children
    assert relocalization.accept_relocalization(branches).children == [found]
    assert isinstance(found.state.localization, Tracking)
    assert found.state.localization.relocalized_area == 0
    assert (found.arcs[0].source, found.arcs[0].target) == (2, 0)


@pytest.mark.parametrize(("mapping", "area"), [(True, 1), (False, 0)])
def test_without_mapping_it_moves_to_the_area_of_its_relocalization(mapping, area):
    """Of what it mapped while it was lost one place alone is joined to the map."""
    run, poses = Run(RING), ring_drive(8)
    for pose in poses[:-1]:
        run.keyframe(pose)
    run.keyframe(poses[-1], cut=3)
    found = replace(run.tsbi.state.hypothesis_states[0], localization=Tracking(0))
    run.tsbi._state = replace(run.tsbi._state, hypothesis_states={0: found})
    (hypothesis,) = run.keyframe(poses[-1], mapping=mapping).hypotheses
    assert hypothesis.area == area
    assert run.tsbi.state.hypothesis_states[0].localization.relocalized_area is None


def test_it_is_searched_in_the_map_from_before_the_kidnapping(monkeypatch):
    searches, begin = [], MapSearch.begin

    def record_search(map_search, hybrid_map, poses, before, *others):
        searches.append((before, sorted(poses)))
        return begin(map_search, hybrid_map, poses, before, *others)

    monkeypatch.setattr(MapSearch, "begin", record_search)
    spawn((ROOM, OTHER, ROOM), {2: 8.0})
    assert searches == [(14, [14, 15, 16, 17])]


@pytest.mark.parametrize(("is_kidnapped", "probability"), [(False, 0.8), (True, 0.5)])
def test_unmapped_ground_is_as_probable_as_the_map_for_a_kidnapped_robot_alone(is_kidnapped, probability, monkeypatch):
    """Scans that fit a place as well as unmapped ground leave the prior as it is."""
    parent, branching, newest = rooms_apart((ROOM, OTHER), [FAR], 0.1)
    vague = PoseGaussian(np.zeros(3), np.eye(3))
    candidate = PoseCandidate(0, MatchMode(vague, vague, 0.0), Agreement(0, 0, 0))
    found = PoseDistribution((candidate,), np.array([1.0 - UNMAPPED_PRIOR]))
    monkeypatch.setattr(MapSearch, "localize", lambda *_: found)
    tracked_pose = PoseInArea(1, newest[0], np.zeros(3)) if is_kidnapped else None
    state = replace(parent.state, localization=Lost(newest[0], tracked_pose=tracked_pose, counted_evidence=None))
    branches = relocalization.update_relocalization(branching, replace(parent, state=state))
    assert branches.pose_distribution.probabilities.tolist() == pytest.approx([probability])


def test_on_unmapped_ground_only_the_cusum_statistic_counts():
    _, lost = spawn((OTHER, OTHER, ROOM), {2: 8.0}).children
    assert lost.log_weight == pytest.approx(PRIOR + 8.0 + math.log(KIDNAPPED_UNMAPPED_PRIOR), abs=0.5)
    assert lost.state.localization.candidate is None


def test_a_match_at_the_tracked_pose_is_evidence_against_it():
    _, lost = spawn((ROOM, OTHER, ROOM), {2: 8.0}, HERE, hall=0).children
    assert lost.log_weight < PRIOR + 8.0 - 2.0


@pytest.mark.parametrize(
    "evidence",
    [{}, {2: 1.0}, {4: 12.0}],
    ids=["sure", "hardly doubtful", "just now, and two keyframes are too few"],
)
def test_an_improbable_kidnapping_spawns_no_hypothesis(evidence):
    assert spawn((ROOM, OTHER, ROOM), evidence) is None


def test_an_area_is_not_left_without_keyframes():
    _, lost = spawn((ROOM, OTHER, ROOM), {0: 8.0}).children
    assert [r.keyframe for r in lost.moved_keyframes] == [13, 14, 15, 16, 17]


@pytest.mark.parametrize(("nats", "lost"), [(11.0, None), (12.0, 18)])
def test_without_mapping_it_is_lost_from_the_next_keyframe_on_if_that_is_more_probable(nats, lost):
    parent, branching, _ = rooms_apart((ROOM,), [], 0.1)
    pose_in_area = PoseInArea(0, 17, PATH[3])
    suspected = replace(
        parent, state=replace(parent.state, kidnapping_evidence={17: nats}, unstored_poses={17: pose_in_area})
    )
    branching.keep_scans(17, scan_in(OTHER, PATH[3], field_of_view=2 * np.pi, beams=361), {17})
    child = decide_without_mapping(branching, suspected, 17)
    assert since(child) == lost
    assert bool(child.state.kidnapping_evidence) == (lost is None)
    if lost is not None:
        assert child.state.localization.false_alarm.tracked_pose is pose_in_area
        assert child.state.localization.false_alarm.probability == pytest.approx(1.0 / (1.0 + math.exp(PRIOR + nats)))


@pytest.mark.parametrize(
    ("world", "off", "lost"),
    [(MOVED, 0.0, None), (MOVED, 2.0, 16), (OTHER, 0.0, 16), (NOWHERE, 0.0, 16)],
    ids=["furniture was moved", "farther on in the same room", "in another room", "on unmapped ground"],
)
def test_without_mapping_it_is_lost_if_another_place_is_more_probable(world, off, lost):
    parent, branching, _ = rooms_apart((OTHER, BEFORE), [FAR], 0.1)
    state = parent.state
    for event, pose in enumerate(PATH[:4], start=12):
        scan = scan_in(world, pose, noise=0.01, seed=event, field_of_view=2 * np.pi, beams=361)
        claimed = se2.between(PATH[0], pose) + np.array([off, 0.0, 0.0])
        state = state.after_scan(event, -3.0, -3.0, PRIORS, PoseInArea(1, event, claimed))
        branching.keep_scans(event, scan, state.unstored_poses)
    child = decide_without_mapping(branching, replace(parent, state=state), 15)
    assert since(child) == lost
    assert not child.state.kidnapping_evidence
    assert not child.state.unstored_poses


@pytest.mark.parametrize(("lost", "stays"), [(11, True), (9, False)], ids=["false alarm", "was moved"])
def test_the_false_alarm_is_at_the_odometry_pose_when_the_robot_is_lost(lost, stays):
    parent, branching, _ = rooms_apart((ROOM, OTHER), [FAR], 0.1)
    alarm = FalseAlarm(PoseInArea(1, 10, PATH[2]), 0.4, "ordinary")
    state = replace(parent.state, localization=Lost(lost, alarm))
    scan = scan_in(ROOM, PATH[3], field_of_view=2 * np.pi, beams=361)
    keyframe = Keyframe(11, scan, 1.0, (), motion_unknown=True, mapping=False)
    (child,) = relocalization.begin_relocalization(branching, replace(parent, state=state), keyframe, PATH[3]).children
    assert since(child) == 11
    if not stays:
        assert child.state.localization.false_alarm is None
        return
    assert (
        child.state.localization.false_alarm.tracked_pose.area,
        child.state.localization.false_alarm.tracked_pose.keyframe,
        child.state.localization.false_alarm.probability,
    ) == (1, 11, 0.4)
    np.testing.assert_array_equal(child.state.localization.false_alarm.tracked_pose.pose, PATH[3])


@pytest.mark.parametrize(("at", "found"), [(0.0, True), (3.0, False)], ids=["there", "elsewhere"])
def test_a_false_alarm_raises_the_probability_of_the_tracked_pose_only(at, found):
    parent, branching, newest = rooms_apart((ROOM, OTHER, ROOM), [FAR, FAR], 0.1)
    branches = {}
    for probability in (0.0, 0.4):
        stay = FalseAlarm(PoseInArea(0, newest[0], np.array([at, 0.0, 0.0])), probability, "ordinary")
        state = replace(parent.state, localization=Lost(newest[0], stay))
        distribution = search_through(branching, replace(parent, state=state)).pose_distribution
        branches[probability] = max(
            p for p, fit in zip(distribution.probabilities, distribution.candidates, strict=True) if fit.area == 0
        )
    assert (branches[0.4] > branches[0.0]) == found


@pytest.mark.parametrize("joined", [True, False])
def test_a_new_area_is_drawn_at_the_initial_pose_in_the_frame_of_the_area_before(joined):
    """Where no arcs lead to the area of the initial pose, its frame is taken for that of the area before."""
    parent, branching, newest = rooms_apart((ROOM, OTHER), [FAR] if joined else [], 0.1)
    pose = np.array([1.0, -0.5, 0.7])
    keyframe = Keyframe(
        newest[-1],
        branching.entry._replica.scans[newest[-1]],
        1.0,
        (),
        motion_unknown=True,
        initial_pose=InitialPose(0, PoseGaussian(pose, 0.1 * np.eye(3))),
    )
    (child,) = relocalization.begin_relocalization(branching, parent, keyframe, PATH[3]).children
    (arc,) = child.arcs
    assert (arc.source, arc.target) == (1, 2)
    assert is_uninformative(arc.pose)
    frame = np.array([*FAR, 0.0]) if joined else np.zeros(3)
    np.testing.assert_allclose(arc.pose.mean, se2.compose(frame, pose), atol=1e-9)


@pytest.mark.parametrize(("since", "reset"), [(0, False), (6, False), (7, True)])
def test_tracking_is_reset_only_where_the_robot_is_lost_from_the_next_event_on(since, reset):
    run, poses = Run(RING), ring_drive(7)
    for pose in poses[:-1]:
        run.keyframe(pose)
    lost = replace(run.tsbi.state.hypothesis_states[0], unmatched_keyframes=(), localization=Lost(since))
    run.tsbi._state = replace(run.tsbi._state, hypothesis_states={0: lost})
    (hypothesis,) = run.keyframe(poses[-1]).hypotheses
    assert (hypothesis.lost, hypothesis.tracking_reset) == (True, reset)


def test_an_initial_pose_replaces_the_false_alarm():
    parent, branching, newest = rooms_apart((ROOM, OTHER, ROOM), [FAR, FAR], 0.1)
    alarm = FalseAlarm(PoseInArea(1, newest[0], np.zeros(3)), 0.4, "ordinary")
    state = replace(parent.state, localization=Lost(newest[0], alarm))
    initial_pose = InitialPose(0, PoseGaussian(se2.between(PATH[0], PATH[5]), np.diag([0.3, 0.3, 0.2]) ** 2))
    pose = parent.hybrid_map.keyframes(2)[newest[-1]]
    keyframe = Keyframe(
        newest[-1], branching.entry._replica.scans[newest[-1]], 1.0, (), initial_pose=initial_pose, mapping=False
    )
    branches = relocalization.begin_relocalization(branching, replace(parent, state=state), keyframe, pose)
    lost = [child.state.localization for child in branches.children if child.state.is_lost]
    assert [one.false_alarm for one in lost] == [None]


def test_a_false_alarm_keeps_a_similar_place_from_being_accepted():
    distribution = PoseDistribution((None, None), np.array([0.0, 0.9]))
    stayed = distribution.with_false_alarm(np.array([True, False]), 0.5, 4)
    # Of the kidnapped half, unmapped ground of 0.2 weighs 0.1; the other half weighs as new ground.
    np.testing.assert_allclose(stayed.probabilities, [0.0, 0.9 / (0.9 + 0.1 + 0.1 / 0.2)], atol=1e-12)
    assert distribution.with_false_alarm(np.array([True, False]), 0.0, 4).probabilities == pytest.approx(
        distribution.probabilities
    )
    known = PoseDistribution((None, None), np.array([0.6, 0.3]))
    assert known.with_false_alarm(np.array([True, False]), 0.5, 4).probabilities[0] > 0.8


def test_scans_that_the_map_does_not_hold_are_remembered_as_long_as_they_are_uncertain():
    run, poses = Run(RING), ring_drive(8)
    for pose in poses[:6]:
        run.keyframe(pose)
    run.evidence[0], run.stored = -3.0, False
    for pose in poses[6:]:
        run.keyframe(pose, mapping=False)
    state = run.tsbi.state
    assert [*state.hypothesis_states[0].unstored_poses] == [*state.branching.unstored_scans] == [6, 7]
    assert [*Tsbi(Configuration(), state=state).state.branching.unstored_scans] == [6, 7]
    np.testing.assert_array_equal(state.hypothesis_states[0].unstored_poses[7].pose, run.poses[0])
    run.evidence[0] = 9.0
    run.keyframe(poses[7], mapping=False)
    assert not run.tsbi.state.hypothesis_states[0].unstored_poses
    assert not run.tsbi.state.branching.unstored_scans


def after_scans(scans, first=5):
    """The state after scans whose ends and walls contradict alike, by the sum of both, nats."""
    state = HypothesisState()
    for event, nats in enumerate(scans, start=first):
        state = state.after_scan(event, -0.5 * nats, -0.5 * nats, PRIORS)
    return state


def test_scans_that_contradict_add_up_and_are_remembered_in_the_next_area():
    state = after_scans((-0.3, 8.0, 5.0, 1.2))
    odds, since, _ = found = state.kidnapping_test(PRIORS)
    assert since == 6
    # Changed surroundings explain a part of it.
    assert PRIOR + 7.0 + 4.0 + 0.2 - 2.0 < odds < PRIOR + 7.0 + 4.0 + 0.2
    assert state.after_area_change({}).kidnapping_test(PRIORS) == found
    assert state.after_area_change({}).surroundings == state.surroundings


@pytest.mark.parametrize(("ends", "walls"), [(-9.0, 0.2), (0.2, -9.0)], ids=["in free space", "walls passed"])
def test_contradictions_of_one_kind_make_no_kidnapping_probable(ends, walls):
    state = HypothesisState()
    for event in range(3):
        state = state.after_scan(event, ends, walls, PRIORS)
    assert PRIOR < state.kidnapping_test(PRIORS)[0] < math.log(0.01)
    both = after_scans((8.8,) * 3)
    assert both.kidnapping_test(PRIORS)[0] > math.log(100.0)


def test_small_contradictions_at_every_keyframe_are_clutter():
    state = after_scans((0.9,) * 20)
    assert not state.kidnapping_evidence
    assert state.kidnapping_test(PRIORS) is None


def test_an_inconsistency_passes_with_scans_that_fit():
    assert after_scans((4.0,)).kidnapping_evidence
    assert not after_scans((4.0, -0.3, -0.3, -0.3)).kidnapping_evidence


def test_small_contradictions_before_the_onset_do_not_count():
    assert after_scans((2.0, 9.0, 6.0)).kidnapping_test(PRIORS)[1] == 6


def test_a_fifth_of_the_largest_evidence_can_be_the_onset_and_less_cannot():
    evidence = {4: 1.999, 5: 2.0, 6: 10.0}
    assert HypothesisState(kidnapping_evidence=evidence).kidnapping_test(PRIORS) == (
        pytest.approx(PRIOR + 12.0),
        5,
        "ordinary",
    )


def test_keyframes_of_a_kidnapped_robot_are_not_pruned_at_the_same_event():
    run = Run(RING)
    poses = ring_drive(16)
    for pose in poses[:12]:
        run.keyframe(pose)
    run.evidence[0] = -6.0
    for pose in poses[12:14]:
        assert len(run.keyframe(pose).hypotheses) == 1
    run._answer = lambda sequence, _events: run.tsbi.handle(AreaEvents(sequence, (), (PrunedKeyframe(sequence, 0),)))
    (answer,) = run.keyframe(poses[14])
    assert [hypothesis.lost for hypothesis in answer.hypotheses] == [False, True]
    assert not answer.pruned_keyframes


@pytest.mark.parametrize(
    ("log_odds", "confirmed", "lost"), [(-0.1, False, False), (2.0, False, True), (2.0, True, False)]
)
def test_without_mapping_a_probable_kidnapping_that_no_match_refutes_loses_the_robot(
    monkeypatch, log_odds, confirmed, lost
):
    pose = PoseInArea(5, 30, np.array([1.0, 1.0, 0.3]))
    priors = KidnappingPriors(OPTIONS.kidnapping_prior, 0.01, 0.25)
    evidence = {29: 1.0, 30: log_odds - priors.log_odds("ordinary", {}) - 1.0}
    parent = make_parent(Tracking())
    state = replace(parent.state, kidnapping_evidence=evidence, unstored_poses={30: pose})
    monkeypatch.setattr(kidnapping, "_confirms_tracked_pose", lambda _branching, _parent, _since: confirmed)
    branching = SimpleNamespace(options=OPTIONS, kidnapping_priors=priors)
    child = kidnapping.decide_without_mapping(branching, replace(parent, state=state), 30)
    assert child.state.is_lost is lost
    if log_odds > 0.0:
        assert child.state.kidnapping_evidence == child.state.unstored_poses == {}
    else:
        assert child.state is state
    if lost:
        first = child.state.localization
        assert first.since == 31
        assert first.false_alarm.tracked_pose is pose
        # The oldest event is below a fifth of the evidence.
        assert first.false_alarm.probability == pytest.approx(1.0 / (1.0 + math.exp(log_odds - 1.0)))


def test_scans_that_no_map_holds_are_matched_seen_from_the_first_since_then():
    parent = make_parent(Tracking(), area=0)
    poses = {
        28: PoseInArea(0, 28, np.array([0.5, 0.5, 0.1])),
        29: PoseInArea(1, 29, np.array([0.2, -0.4, 0.3])),
        30: PoseInArea(2, 30, np.array([0.2, -0.4, 0.3])),
        31: PoseInArea(0, 31, np.array([2.5, 1.5, 0.9])),
    }
    parent = replace(parent, state=replace(parent.state, unstored_poses=poses))
    first = se2.compose(ARC, poses[29].pose)
    branching = GivenSearch(options=OPTIONS, found=distribution((candidate(0, first, 0.7), 0.5)))
    assert kidnapping._confirms_tracked_pose(branching, parent, 29)
    requested, before, _ = branching.requested
    assert (list(requested), before) == ([29, 31], 29)
    np.testing.assert_allclose(requested[31], se2.between(first, poses[31].pose))
    branching.found = distribution((candidate(0, first, 0.5), 0.5))
    assert not kidnapping._confirms_tracked_pose(branching, parent, 29)
    assert not kidnapping._confirms_tracked_pose(branching, parent, 99)


@pytest.mark.parametrize(("event", "expected"), [(22, [22, 23, 24, 25]), (20, [21, 22, 23, 24, 25]), (26, [])])
def test_an_area_keeps_a_keyframe_when_others_begin_a_new_one(event, expected):
    assert kidnapping._keyframes_since(make_parent(Tracking()), event) == expected
    kept = kidnapping._keyframes_since(make_parent(Tracking()), 21)
    assert kept == [21, 22, 23, 24, 25]
