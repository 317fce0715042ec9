"""The Area Abstraction Mechanism in a world of rooms, answered by a TSBI played by hand."""

import numpy as np
import pytest
import worlds

from hmt_slam_ros.area_abstraction import aam as aam_module
from hmt_slam_ros.area_abstraction.aam import Aam
from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import Arc, AreaMerge, MovedKeyframe
from hmt_slam_ros.messages.messages import (
    AreaEvents,
    ClosureDecision,
    Hypotheses,
    Hypothesis,
    HypothesisEstimate,
    Keyframe,
    LocalEstimate,
)
from hmt_slam_ros.registration.consistency import Clutter

WORLD = worlds.two_rooms()
THERE = worlds.drive((1.0, 2.0), (4.0, 3.0), (8.0, 3.0), (10.5, 3.5), (10.5, 5.0), (7.5, 5.0), (7.5, 2.0))
OPTIONS = {"aam.ncut_threshold": 0.8, "aam.overlap_radius": 0.15, "aam.confirmations": 1}


def aam(**changes):
    return Aam(with_changes(Configuration(), OPTIONS | {f"aam.{name}": value for name, value in changes.items()}))


def exact(pose):
    return PoseGaussian(np.asarray(pose, dtype=np.float64), np.eye(3) * 1e-6)


def estimate(hypothesis, area, pose, stored=True):
    return HypothesisEstimate(hypothesis, area, exact(pose), stored, 0.0, 0.0, Clutter(), 12.0)


def keyframe(k, world_pose, *estimates):
    return Keyframe(k, worlds.scan_at(WORLD, world_pose), 0.5 * k, estimates)


def stay(k, *hypotheses, area=0):
    return Hypotheses(k, tuple(Hypothesis(h, h, 1.0 / len(hypotheses), area) for h in hypotheses))


def drive_until_cut(process, poses=THERE, origin=None):
    """Play keyframes with one hypothesis in area 0 until a cut; returns it with the index of its keyframe."""
    origin = poses[0] if origin is None else origin
    for k, pose in enumerate(poses):
        (answer,) = process.handle(keyframe(k, pose, estimate(0, 0, se2.between(origin, pose))))
        assert isinstance(answer, AreaEvents)
        assert answer.sequence == k
        if answer.events:
            return answer.events[0], k
        process.handle(stay(k, 0))
    pytest.fail("no cut on the whole way")


def area_change(area, event, k, hypothesis=0, parent=0, probability=1.0, new_T_old=None):
    """TSBI's answer that the keyframes of a cut belong to ``area``."""
    new_T_old = np.zeros(3) if new_T_old is None else new_T_old
    poses = {i: se2.compose(new_T_old, se2.between(THERE[0], THERE[i])) for i in event.keyframes}
    return Hypothesis(
        hypothesis,
        parent,
        probability,
        area,
        exact(new_T_old),
        tuple(MovedKeyframe(i, event.area, area, pose) for i, pose in poses.items()),
        (Arc(event.area, area, exact(se2.inverse(new_T_old))),),
    )


def test_the_second_room_is_cut_off_from_the_first():
    event, k = drive_until_cut(aam())
    assert (event.hypothesis, event.kind, event.area) == (0, "cut", 0)
    assert event.keyframes[-1] == k
    assert event.keyframes == tuple(range(event.keyframes[0], k + 1))
    # All the keyframes that leave lie beyond the door or in it, all that stay before it.
    assert 5.0 < THERE[event.keyframes[0], 0] < 7.0
    assert 0.0 < event.score <= 0.8


def test_a_robot_that_goes_about_in_one_room_stays_in_its_area():
    process = aam()
    for k, pose in enumerate(worlds.drive((1.0, 1.0), (5.0, 1.0), (5.0, 4.0), (2.0, 4.0), (2.0, 2.0))):
        assert process.handle(keyframe(k, pose, estimate(0, 0, pose)))[0].events == ()
        process.handle(stay(k, 0))


def test_a_cut_has_to_be_found_at_several_keyframes_in_a_row():
    _, first = drive_until_cut(aam(confirmations=1))
    _, third = drive_until_cut(aam(confirmations=3))
    assert third == first + 2


def test_a_smaller_threshold_waits_longer_or_never_cuts():
    _, early = drive_until_cut(aam(ncut_threshold=0.9))
    _, late = drive_until_cut(aam(ncut_threshold=0.72))
    assert late > early


def test_both_sides_of_a_cut_hold_the_smallest_number_of_keyframes():
    event, k = drive_until_cut(aam(min_cluster=10))
    assert len(event.keyframes) >= 10
    assert k + 1 - len(event.keyframes) >= 10


def test_the_frame_of_the_area_does_not_matter():
    here, k_here = drive_until_cut(aam())
    there, k_there = drive_until_cut(aam(), origin=np.array([-40.0, 70.0, 2.0]))
    assert (here.keyframes, k_here) == (there.keyframes, k_there)
    assert here.score == pytest.approx(there.score, abs=1e-9)


def test_every_keyframe_has_one_answer():
    process = aam()
    assert len(process.handle(keyframe(0, THERE[0], estimate(0, 0, np.zeros(3))))) == 1
    assert process.handle(stay(0, 0)) == []
    assert process.handle(ClosureDecision(0)) == []
    assert process.handle(LocalEstimate(0, 0, 0, exact(np.zeros(3)), np.zeros(3), 0)) == []
    assert process.handle(worlds.scan_at(WORLD, THERE[0])) == []


def test_the_keyframes_that_left_begin_the_new_area():
    process = aam()
    event, k = drive_until_cut(process)
    process.handle(Hypotheses(k, (area_change(1, event, k),)))
    (answer,) = process.handle(keyframe(k + 1, THERE[k + 1], estimate(0, 1, se2.between(THERE[0], THERE[k + 1]))))
    assert answer.events == ()


@pytest.fixture
def pair_counts(monkeypatch):
    """The numbers of scan pairs that were compared, call by call."""
    counts = []

    def count_calls(original):
        def counting(one, pose, others, other_poses, radius):
            counts.append(len(others))
            return original(one, pose, others, other_poses, radius)

        return counting

    for name in ("overlaps", "sensed_overlaps"):
        monkeypatch.setattr(aam_module, name, count_calls(getattr(aam_module, name)))
    return counts


def test_a_new_keyframe_is_compared_with_each_of_its_area_once(pair_counts):
    process = aam(ncut_threshold=0.0)
    for k, pose in enumerate(THERE[:12]):
        pair_counts.clear()
        process.handle(keyframe(k, pose, estimate(0, 0, pose)))
        # Once with all for the graph and once with the eight nearest for the question whether the robot moved.
        assert sum(pair_counts) == k + min(k, 8)
        process.handle(stay(k, 0))


def test_nothing_is_measured_again_when_hypotheses_branch_into_a_new_area(pair_counts):
    process = aam()
    event, k = drive_until_cut(process)
    pair_counts.clear()
    process.handle(Hypotheses(k, (area_change(1, event, k, 1, 0, 0.6), area_change(2, event, k, 2, 0, 0.4))))
    assert sum(pair_counts) == 0


def answered_in_first_room(process):
    """Rooms 0 and 1 known, the robot in room 1; returns the next keyframe's number."""
    event, k = drive_until_cut(process)
    process.handle(Hypotheses(k, (area_change(1, event, k),)))
    process.handle(ClosureDecision(k, 0))
    for later in range(k + 1, len(THERE)):
        area_pose = se2.between(THERE[0], THERE[later])
        assert process.handle(keyframe(later, THERE[later], estimate(0, 1, area_pose)))[0].events == ()
        process.handle(stay(later, 0, area=1))
    return len(THERE)


def drive_back(process):
    """Drive back into the first room over known ground until something happens; (keyframe, world pose, event)."""
    back = worlds.drive((7.5, 2.0), (7.5, 3.0), (5.0, 3.0), (1.0, 2.0))
    for k, pose in enumerate(back, start=answered_in_first_room(process)):
        own_estimate = estimate(0, 1, se2.between(THERE[0], pose), stored=False)
        (answer,) = process.handle(keyframe(k, pose, own_estimate))
        if answer.events:
            return k, pose, answer.events[0]
        process.handle(stay(k, 0, area=1))
    pytest.fail("nothing happened on the whole way")


def test_a_robot_that_returns_over_an_arc_has_moved_into_the_known_area():
    _, pose, event = drive_back(aam(confirmations=2))
    assert (event.kind, event.area, event.keyframes) == ("moved", 0, ())
    assert 3.0 < pose[0] < 6.5
    assert 0.3 < event.score <= 1.0


def moves_about(process, poses):
    """Areas of move events while the robot drives back and forth on known ground, at first in area 1."""
    area, moves = 1, []
    for k, pose in enumerate(poses, start=answered_in_first_room(process)):
        own_estimate = estimate(0, area, se2.between(THERE[0], pose), stored=False)
        (answer,) = process.handle(keyframe(k, pose, own_estimate))
        moves += [event.area for event in answer.events]
        area = moves[-1] if moves else 1
        process.handle(stay(k, 0, area=area))
    return moves


def test_the_margin_keeps_a_robot_that_dithers_in_the_door_from_flapping():
    dither = np.array([[6.1, 3.0, np.pi], [6.3, 3.0, np.pi]] * 6)
    assert len(moves_about(aam(confirmations=1), dither)) <= 1
    assert len(moves_about(aam(confirmations=1, move_margin=0.0), dither)) > 4


def test_a_short_look_into_the_other_area_is_no_move():
    poses = np.array([[7.5, 3.0, np.pi], [5.0, 3.0, np.pi]] * 4)
    assert moves_about(aam(confirmations=2), poses) == []
    assert len(moves_about(aam(confirmations=1), poses)) == 8 - 1


def test_new_keyframes_stay_at_a_move_and_become_old_ground():
    process = aam(confirmations=1, min_cluster=3)
    k, _, event = drive_back(process)
    process.handle(stay(k, 0, area=event.area))
    # In room 0 again: its keyframes are old ground and cannot leave it, however small the smallest cluster is.
    for step, pose in enumerate(worlds.drive((4.0, 4.0), (4.0, 2.0)), start=k + 1):
        (answer,) = process.handle(keyframe(step, pose, estimate(0, 0, se2.between(THERE[0], pose))))
        cut = [event for event in answer.events if event.kind == "cut"]
        assert all(min(event.keyframes) > k for event in cut)
        process.handle(stay(step, 0, area=0))


def test_a_closure_puts_the_keyframes_beside_the_known_ones_and_compares_only_across(pair_counts):
    process = aam()
    event, k = drive_until_cut(process)
    # Played: the second room is taken for a known area, which here is area 0 itself under another name.
    process.handle(Hypotheses(k, (area_change(7, event, k, 1, 0, 0.5), area_change(8, event, k, 2, 0, 0.5))))
    pair_counts.clear()
    back = {i: se2.between(THERE[0], THERE[i]) for i in event.keyframes}
    relabelled = tuple(MovedKeyframe(i, 7, 0, pose) for i, pose in back.items())
    process.handle(Hypotheses(k + 1, (Hypothesis(1, 1, 1.0, 0, exact(np.zeros(3)), relabelled),)))
    known = k + 1 - len(event.keyframes)
    assert sum(pair_counts) == known * len(event.keyframes)


def test_a_hypothesis_that_does_not_store_the_keyframe_is_not_cut():
    process = aam()
    for k, pose in enumerate(THERE):
        stored = k < 12
        (answer,) = process.handle(keyframe(k, pose, estimate(0, 0, se2.between(THERE[0], pose), stored)))
        assert answer.events == ()
        process.handle(stay(k, 0))


def test_hypotheses_are_scored_each_by_its_own_map():
    process = aam()
    event, k = drive_until_cut(process)
    process.handle(Hypotheses(k, (area_change(1, event, k, 1, 0, 0.6), Hypothesis(2, 0, 0.4, 0))))
    pose = se2.between(THERE[0], THERE[k + 1])
    (answer,) = process.handle(keyframe(k + 1, THERE[k + 1], estimate(1, 1, pose), estimate(2, 0, pose)))
    assert [(event.hypothesis, event.kind) for event in answer.events] == [(2, "cut")]


def test_acceptance_drops_the_other_hypotheses():
    process = aam()
    event, k = drive_until_cut(process)
    process.handle(Hypotheses(k, (area_change(1, event, k, 1, 0, 0.9), Hypothesis(2, 0, 0.1, 0))))
    process.handle(ClosureDecision(k, 1))
    pose = se2.between(THERE[0], THERE[k + 1])
    (answer,) = process.handle(keyframe(k + 1, THERE[k + 1], estimate(1, 1, pose), estimate(2, 0, pose)))
    assert answer.events == ()


def close_loop(process, around, error=(0.0, 0.0, 0.0), sigma=1e-4):
    """Rooms 0 and 1 known; area 2, begun at the first of the poses ``around``, is joined to area 0 by a closure.

    Returns the answer to the next keyframe, and that keyframe's number.
    """
    first = answered_in_first_room(process)
    moved = MovedKeyframe(first, 1, 2, np.zeros(3))
    one_T_two = se2.between(THERE[0], around[0])
    begun = Hypothesis(0, 0, 1.0, 2, exact(se2.inverse(one_T_two)), (moved,), (Arc(1, 2, exact(one_T_two)),))
    process.handle(keyframe(first, around[0], estimate(0, 1, one_T_two)))
    process.handle(Hypotheses(first, (begun,)))
    process.handle(ClosureDecision(first, 0, begun.arcs))
    for k, pose in enumerate(around[1:-1], start=first + 1):
        (answer,) = process.handle(keyframe(k, pose, estimate(0, 2, se2.between(around[0], pose))))
        assert answer.events == ()
        process.handle(stay(k, 0, area=2))
    last = first + len(around) - 1
    seen = se2.compose(se2.inverse(one_T_two), np.array(error))
    arc = Arc(2, 0, PoseGaussian(seen, np.diag([sigma, 1e-4, 1e-4]) ** 2), closure=True)
    process.handle(keyframe(last, around[-1], estimate(0, 2, se2.between(around[0], around[-1]))))
    process.handle(Hypotheses(last, (Hypothesis(0, 0, 1.0, 2, None, (), (arc,)),)))
    process.handle(ClosureDecision(last, 0, (arc,)))
    pose = se2.between(around[0], around[-1])
    (answer,) = process.handle(keyframe(last + 1, around[-1], estimate(0, 2, pose, stored=False)))
    return answer, last + 1


AGAIN = worlds.drive((2.0, 2.0), (4.5, 2.0), (4.5, 4.0))


def test_a_room_that_was_taken_for_a_new_one_is_the_same_area_when_the_loop_is_closed():
    process = aam()
    answer, k = close_loop(process, AGAIN)
    (event,) = answer.events
    assert (event.hypothesis, event.kind, event.area, event.into) == (0, "merged", 2, 0)
    assert 0.8 < event.score <= 2.0
    process.handle(
        Hypotheses(k, (Hypothesis(0, 0, 1.0, 0, area_merge=AreaMerge(2, 0, exact(se2.between(THERE[0], AGAIN[0])))),))
    )
    process.handle(ClosureDecision(k, 0))
    # Its keyframes are the robot's own, and one graph holds them and the known ones.
    watch = process.state.partitions[0]
    assert watch.area == 0
    assert watch.new_keyframes >= {*range(k - len(AGAIN) + 1, k)}
    assert watch.graphs.keys() == {0, 1}
    joined = {joint.graph for joint in watch.joined_graphs.values()}
    assert process.state.graphs.keys() == joined.union(watch.graphs.values())
    assert set(process.state.graphs[watch.graphs[0]].keyframes) == set(process._replica.maps[0].keyframes(0))
    (answer,) = process.handle(keyframe(k + 1, AGAIN[-1], estimate(0, 0, se2.between(THERE[0], AGAIN[-1]), False)))
    assert answer.events == ()


def test_areas_stay_two_while_the_arc_between_them_is_less_certain_than_a_match():
    """As along a corridor: one rigid map would fix an error that a later scan can correct."""
    for sigma, events in ((0.07, ["merged"]), (0.09, [])):
        answer, _ = close_loop(aam(), AGAIN, sigma=sigma)
        assert [event.kind for event in answer.events] == events


def test_another_room_stays_an_area_of_its_own_when_the_loop_is_closed():
    """Through the door much of the first room is seen, but an area of both would be cut again."""
    beyond = worlds.drive((10.0, 2.0), (8.0, 4.5), (10.0, 5.0))
    answer, _ = close_loop(aam(), beyond)
    assert [event.kind for event in answer.events if event.kind == "merged"] == []


def test_a_merge_is_evaluated_again_on_leaving_and_with_one_hypothesis_only():
    process = aam()
    _, k = close_loop(process, AGAIN)
    in_two, in_zero = se2.between(AGAIN[0], AGAIN[-1]), se2.between(THERE[0], AGAIN[-1])
    # TSBI finds that they contradict each other.
    process.handle(stay(k, 0, area=2))
    assert process.handle(keyframe(k + 1, AGAIN[-1], estimate(0, 2, in_two, stored=False)))[0].events == ()
    gone_over = Hypothesis(1, 0, 0.6, 0, exact(se2.between(THERE[0], AGAIN[0])))
    process.handle(Hypotheses(k + 1, (gone_over, Hypothesis(2, 0, 0.4, 2))))
    both = estimate(1, 0, in_zero, stored=False), estimate(2, 2, in_two, stored=False)
    assert process.handle(keyframe(k + 2, AGAIN[-1], *both))[0].events == ()
    process.handle(Hypotheses(k + 2, (Hypothesis(1, 1, 1.0, 0),)))
    (event,) = process.handle(keyframe(k + 3, AGAIN[-1], both[0]))[0].events
    assert (event.kind, event.area, event.into) == ("merged", 2, 0)


def test_two_areas_are_measured_again_only_where_the_arc_between_them_moved(pair_counts):
    process = aam()
    answer, k = close_loop(process, AGAIN)
    pose, before = se2.between(AGAIN[0], AGAIN[-1]), answer.events[0].score
    for later, error in enumerate((0.0, 0.001, 0.1), start=k):
        two_T_zero = se2.compose(se2.between(AGAIN[0], THERE[0]), (error, 0.0, 0.0))
        process.handle(stay(later, 0, area=2))
        process.handle(ClosureDecision(later, 0, (Arc(2, 0, exact(two_T_zero), closure=True),)))
        pair_counts.clear()
        (answer,) = process.handle(keyframe(later + 1, AGAIN[-1], estimate(0, 2, pose, stored=False)))
        moved = error == 0.1
        assert (answer.events[0].score != before) == bool(pair_counts) == moved


@pytest.mark.parametrize(("deviation", "is_cut"), [(19.0, False), (21.0, True)])
def test_a_keyframe_whose_heading_is_unknown_leaves_its_area_at_once_and_alone(deviation, is_cut):
    process = aam(confirmations=3)
    for k in range(4):
        process.handle(keyframe(k, THERE[k], estimate(0, 0, se2.between(THERE[0], THERE[k]))))
        process.handle(stay(k, 0))
    pose = PoseGaussian(se2.between(THERE[0], THERE[4]), np.diag([0.1, 0.1, np.radians(deviation)]) ** 2)
    uncertain = HypothesisEstimate(0, 0, pose, True, 0.0, 0.0, Clutter(), 12.0)
    (answer,) = process.handle(keyframe(4, THERE[4], uncertain))
    assert [(event.kind, event.keyframes, event.area) for event in answer.events] == [("cut", (4,), 0)] * is_cut
