"""The branches of a hypothesis: which known areas are candidates, how they are weighed and entered."""

import math
from dataclasses import replace

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.topological_inference import event_work
from hmt_slam_ros.topological_inference.branches import Parent
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState, Lost

PATH = np.array([[1.2 + 0.5 * k, 2.2, 0.1 * math.sin(k)] for k in range(6)])
ROOM = np.concatenate((box(0.0, 0.0, 5.0, 5.0), box(1.0, 3.0, 2.0, 3.5)))
OTHER = np.concatenate((box(-0.8, 1.2, 7.5, 3.4), box(3.0, 1.2, 3.4, 1.5)))


def rooms_apart(rooms, offsets, sigma, configuration=None, last=PATH):
    """The children of a hypothesis whose robot maps the last of several rooms, which may be one of the others.

    :param rooms: walls of areas 0, 1, ...; the robot is in the last. All were driven through on the same path.
    :param offsets: where the arcs place the frames of the known areas in that of the last one, (2,) each.
    :param sigma: deviation of the arcs, m.
    :param last: the path through the last room, where it is another.
    """
    replica = Replica()
    hybrid_map, here = replica.maps[0], len(rooms) - 1
    for area, walls in enumerate(rooms):
        for k, pose in enumerate(last if area == here else PATH):
            keyframe = 6 * area + k
            replica.scans[keyframe] = scan_in(
                walls, pose, noise=0.01, seed=keyframe, field_of_view=2 * np.pi, beams=361
            )
            hybrid_map.set_keyframe(keyframe, area, se2.between(PATH[0], pose))
    for area, offset in enumerate(offsets):
        spread = np.diag([sigma, sigma, math.radians(5.0)]) ** 2
        hybrid_map.set_arc(here, area, PoseGaussian(np.array([*offset, 0.0]), spread), closure=False)
    newest = range(6 * here, 6 * here + 6)
    state = HypothesisState({k: 1e-3 * np.eye(3) for k in newest}, unmatched_keyframes=tuple(newest))
    parent = Parent(0, here, hybrid_map, state, 0.0)
    return parent, Branching(configuration or Configuration(), replica), list(newest)


def known_through_another(hybrid_map):
    """Let area 0 be known only by way of area 1, where it is a neighbor of the robot's area 2."""
    arc_1_0 = hybrid_map.arc(2, 1).inverse().compose(hybrid_map.arc(2, 0))
    del hybrid_map.changed_arcs[0, 2]
    hybrid_map.set_arc(1, 0, arc_1_0, closure=False)


def weights_by_area(branches):
    weights = {}
    for child in branches.children:
        weights[child.area] = weights.get(child.area, 0.0) + math.exp(child.log_weight)
    total = sum(weights.values())
    return {area: weight / total for area, weight in weights.items()}


def test_one_of_two_rooms_that_look_alike_to_the_prior_is_recognized():
    parent, branching, newest = rooms_apart((OTHER, ROOM, ROOM), ((0.6, 0.4), (-0.5, 0.3)), 1.0)
    weights = weights_by_area(branching.cut(parent, newest[1:]))
    assert weights[1] > 0.9
    assert weights.get(0, 0.0) < weights[parent.area + 1]


def test_two_identical_rooms_and_a_loose_prior_stay_both():
    parent, branching, newest = rooms_apart((ROOM, ROOM, ROOM), ((0.6, 0.4), (-0.5, 0.3)), 1.0)
    weights = weights_by_area(branching.cut(parent, newest[1:]))
    assert weights[0] > 0.25
    assert weights[1] > 0.25


def test_an_unknown_room_is_new_though_the_arcs_point_into_known_ones():
    parent, branching, newest = rooms_apart((ROOM, ROOM, OTHER), ((0.6, 0.4), (-0.5, 0.3)), 1.0)
    weights = weights_by_area(branching.cut(parent, newest[1:]))
    assert weights[parent.area + 1] > 0.8


def test_an_area_beyond_the_gate_is_no_candidate():
    parent, branching, newest = rooms_apart((ROOM, ROOM), ((9.0, 9.0),), 0.5)
    branches = branching.cut(parent, newest[1:])
    assert [child.area for child in branches.children] == [parent.area + 1]
    assert branches.children[0].log_weight == 0.0


def test_a_recognized_area_is_entered_at_the_pose_of_the_match():
    parent, branching, newest = rooms_apart((ROOM, ROOM), ((0.6, -0.4),), 1.0)
    child = max(branching.cut(parent, newest[1:]).children, key=lambda child: child.log_weight)
    assert child.area == 0
    truth = se2.between(PATH[0], PATH[1])
    entered = {r.keyframe: r.pose for r in child.moved_keyframes}
    assert np.allclose(entered[newest[1]], truth, atol=0.03)
    assert np.allclose(child.frame_change.mean, 0.0, atol=0.04)
    (arc,) = child.arcs
    assert (arc.source, arc.target) == (1, 0)
    assert np.allclose(arc.pose.mean, 0.0, atol=0.04)
    assert not arc.closure  # an arc joined the two before
    assert np.sqrt(arc.pose.covariance[0, 0]) < 0.2


def test_the_frame_change_has_the_uncertainty_of_the_newest_keyframe():
    parent, branching, newest = rooms_apart((ROOM, ROOM), ((0.4, 0.3),), 0.7)
    grown = {k: (1.0 + k - newest[0]) * np.diag([1e-3, 2e-3, 1e-4]) for k in newest}
    parent = replace(parent, state=replace(parent.state, covariances=grown))
    exact = PoseGaussian(parent.hybrid_map.keyframes(parent.area)[newest[-1]], np.zeros((3, 3)))
    children = branching.cut(parent, newest[1:]).children
    assert {child.area for child in children} == {0, 2}
    for child in children:
        composed = child.frame_change.compose(exact)
        np.testing.assert_allclose(composed.covariance, child.state.covariances[newest[-1]], atol=1e-12)
        (moved,) = [r.pose for r in child.moved_keyframes if r.keyframe == newest[-1]]
        np.testing.assert_allclose(composed.mean, moved, atol=1e-9)


def test_candidates_beyond_the_number_that_is_examined_keep_their_prior_mass():
    settings = Configuration()
    settings = replace(settings, tsbi=replace(settings.tsbi, max_candidates=1))
    parent, branching, newest = rooms_apart((ROOM, ROOM, ROOM), ((0.6, 0.4), (-0.5, 0.3)), 1.0, settings)
    branches = branching.cut(parent, newest[1:])
    assert len({child.area for child in branches.children}) == 2  # new, and one of the two
    assert 0.05 < math.exp(branches.log_skipped_weight) < 0.6


def test_a_re_check_joins_areas_by_an_arc_and_moves_nothing():
    parent, branching, _ = rooms_apart((ROOM, ROOM, ROOM), ((0.6, 0.4), (-0.5, 0.3)), 1.0)
    known_through_another(parent.hybrid_map)
    parent.hybrid_map.set_arc(2, 1, PoseGaussian(parent.hybrid_map.arc(2, 1).mean, 1e-3 * np.eye(3)), closure=False)
    children = branching.recheck(parent).children
    stay, *joined = children
    assert (stay.area, stay.arcs, stay.reload_local_map) == (2, (), False)
    assert stay.state.unmatched_keyframes == ()
    assert joined
    for child in joined:
        assert (child.area, child.moved_keyframes, child.frame_change) == (2, (), None)
        (arc,) = child.arcs
        assert (arc.source, arc.target, arc.closure) == (2, 0, True)


def test_a_keyframe_speaks_for_or_against_an_area_once():
    parent, branching, newest = rooms_apart((ROOM, ROOM), ((0.6, -0.4),), 1.0)
    stay = replace(parent, state=parent.state.after_matching([0], newest))
    branches = branching.cut(stay, newest[1:])
    assert [child.area for child in branches.children] == [parent.area + 1]


def approaching(xs):
    """A robot with keyframes at ``xs`` in a hall with a known area, of which the last keyframe is at x = 3.7."""
    walls = np.concatenate((box(0.0, 0.0, 12.0, 5.0), box(1.0, 3.0, 2.0, 3.5), box(7.0, 0.5, 7.6, 0.9)))
    path = np.array([[x, 2.2, np.pi] for x in xs])
    parent, branching, newest = rooms_apart((walls, OTHER, walls), ((0.3, -0.2), (0.0, 40.0)), 0.5, last=path)
    known_through_another(parent.hybrid_map)
    return parent, branching, newest


def test_keyframes_beside_the_place_of_an_area_make_it_a_pending_candidate():
    parent, branching, newest = approaching((8.7, 8.2, 7.7, 7.2, 6.7, 6.2))
    branches = branching.cut(parent, newest)
    assert [child.area for child in branches.children] == [parent.area + 1]
    assert 0 not in branches.children[0].state.matched_keyframes


@pytest.mark.parametrize(("sigma", "is_compared"), [(1.0, True), (0.05, False)])
def test_a_recheck_compares_a_neighbor_only_where_the_arc_is_wide(sigma, is_compared):
    parent, branching, _ = rooms_apart((ROOM, ROOM), ((0.6, -0.4),), sigma)
    parent = replace(parent, state=replace(parent.state, local_area_poses={}))
    stay, *joined = branching.recheck(parent).children
    assert [[arc.target for arc in child.arcs] for child in joined] == [[0]] * is_compared
    for child in joined:
        assert child.log_weight > stay.log_weight
        np.testing.assert_allclose(child.arcs[0].pose.mean, np.zeros(3), atol=0.03)


def test_keyframes_of_a_wide_pose_are_tracked_in_no_area_and_compared_with_those_around():
    parent, branching, newest = rooms_apart((ROOM, ROOM), ((0.6, -0.4),), 1.0)
    poses = {0: np.array([0.6, -0.4, 0.0])}
    certain = replace(parent, state=replace(parent.state, local_area_poses=poses))
    (tracked,) = branching.cut(certain, newest).children
    assert tracked.area == 0
    wide = {k: np.diag([0.6, 0.6, 0.2]) ** 2 for k in newest}
    uncertain = replace(certain, state=replace(certain.state, covariances=wide))
    assert {child.area for child in branching.cut(uncertain, newest).children} == {0, parent.area + 1}


def behind_a_wide_arc(covariance):
    """The child on new ground of a robot in area 1, whose pose in that area is as uncertain; area 0 is far."""
    parent, branching, newest = rooms_apart((OTHER, ROOM), ((40.0, 0.0),), 0.1)
    parent = replace(parent, state=replace(parent.state, covariances=dict.fromkeys(newest, np.diag(covariance) ** 2)))
    (child,) = branching.cut(parent, newest[2:]).children
    return parent, child


def test_behind_a_wide_arc_the_robot_is_searched_in_the_map_of_before():
    parent, child = behind_a_wide_arc((0.1, 0.1, 0.7))
    assert child.area == 2
    lost = child.state.localization
    assert (lost.since, lost.tracked_pose.area, lost.tracked_pose.keyframe) == (8, 1, 8)
    np.testing.assert_array_equal(lost.tracked_pose.pose, parent.hybrid_map.keyframes(1)[8])
    assert lost.counted_evidence is None
    (arc,) = child.arcs
    assert 0.7 < np.sqrt(arc.pose.covariance[2, 2]) < 0.72  # not uninformative
    for known_heading in ((0.1, 0.1, 0.1), (0.9, 0.9, 0.3)):
        _, compared = behind_a_wide_arc(known_heading)
        assert not compared.state.is_lost


@pytest.mark.parametrize("is_lost", [False, True])
def test_where_a_lost_robot_is_searched_its_keyframes_are_not_compared(is_lost):
    parent, branching, newest = rooms_apart((ROOM, ROOM), ((0.6, -0.4),), 1.0)
    if is_lost:
        parent = replace(parent, state=replace(parent.state, localization=Lost(newest[0])))
    found = branching.cut(parent, newest[1:]).children
    assert {child.area for child in found} == ({2} if is_lost else {0, 2})


def test_a_recheck_of_pending_candidates_compares_the_newest_keyframes():
    parent, branching, _ = approaching((6.2, 5.6, 5.0, 4.4, 3.8, 3.2))
    parent = replace(parent, state=replace(parent.state, unmatched_keyframes=(), pending_candidates=(0,)))
    stay, joined = branching.recheck(parent, (0,)).children
    assert [arc.target for arc in joined.arcs] == [0]
    assert joined.log_weight > stay.log_weight
    parent, branching, newest = approaching((8.7, 8.2, 7.7, 7.2, 6.7, 6.2))
    parent = replace(
        parent, state=replace(parent.state, unmatched_keyframes=tuple(newest[-3:]), pending_candidates=(0,))
    )
    (stay,) = branching.recheck(parent, (0,)).children
    assert stay.log_weight == parent.log_weight
    assert (stay.state.unmatched_keyframes, stay.state.pending_candidates) == (tuple(newest[-3:]), (0,))


def test_keyframes_most_of_which_are_in_its_place_are_recognized():
    parent, branching, newest = approaching((6.2, 5.6, 5.0, 4.4, 3.8, 3.2))
    branches = branching.cut(parent, newest)
    assert max(branches.children, key=lambda child: child.log_weight).area == 0


PILLARS = np.concatenate(
    (box(-80.0, 1.2, 80.0, 3.4), *(box(x, 3.0, x + 0.3, 3.4) for x in np.arange(-39.0, 45.0, 1.2)))
)
"""A hall of equal pillars, 1.2 m apart."""


@pytest.mark.parametrize("prior", [False, True])
def test_configured_landmarks_have_to_be_given(prior):
    configuration = with_changes(Configuration(), {"places.prior": prior})
    assert Branching(configuration, Replica(), lambda *_: None).landmarks is None
    if prior:
        with pytest.raises(HmtSlamError, match=r"places\.prior and places\.loops need landmarks"):
            Branching(configuration, Replica())
    else:
        assert Branching(configuration, Replica()).landmarks is None


def test_a_scan_that_fits_in_several_ways_is_measured_by_the_heaviest():
    parent, branching, newest = rooms_apart((PILLARS, PILLARS), ((0.3, 0.1),), 0.8)
    truth = se2.between(PATH[0], PATH[5])
    prior = PoseGaussian(truth, np.diag([0.8, 0.8, math.radians(5.0)]) ** 2)
    scan = branching.entry._replica.scans[newest[-1]]
    measured = branching.search.measure_pose(parent.hybrid_map, 0, parent.area, scan, prior)
    np.testing.assert_allclose(measured.mean, truth, atol=0.1)


def test_the_only_way_to_fit_has_all_the_probability_of_the_place_whatever_its_mass():
    """The exponent of the surface likelihood changes the mass, but not the evidence."""
    weights = []
    for temper in (0.1, 0.3):
        settings = Configuration()
        settings = replace(settings, tsbi=replace(settings.tsbi, temper=temper))
        parent, branching, newest = rooms_apart((ROOM, ROOM), ((0.2, -0.1),), 0.5, settings)
        (weight,) = [child.log_weight for child in branching.cut(parent, newest[1:]).children if child.area == 0]
        weights.append(weight)
    assert weights[0] == pytest.approx(weights[1], abs=0.2)


def test_further_ways_to_fit_into_an_area_count_as_not_examined():
    weights, skipped = {}, {}
    for most in (1, 6):
        settings = Configuration()
        settings = replace(settings, tsbi=replace(settings.tsbi, max_modes=most, temper=0.03))
        parent, branching, newest = rooms_apart((PILLARS, PILLARS), ((0.3, 0.1),), 0.8, settings)
        branches = branching.cut(parent, newest[1:])
        weights[most] = [math.exp(child.log_weight) for child in branches.children if child.area == 0]
        skipped[most] = math.exp(branches.log_skipped_weight)
    assert (len(weights[1]), len(weights[6])) == (1, 4)
    assert weights[1][0] == max(weights[6])
    assert 0.0 < skipped[1] <= sum(weights[6]) - max(weights[6]) + 1e-9
    assert skipped[6] == 0.0


def test_an_improbable_hypothesis_examines_few_areas_and_counts_the_others(monkeypatch):
    monkeypatch.setattr(event_work, "_MAX_COMPARISON_WORK", 10**12)
    offsets = [(0.5 * k - 1.2, 0.3 * (k % 3) - 0.3) for k in range(6)]
    parent, branching, newest = rooms_apart((ROOM,) * 7, offsets, 1.0)
    examined = {}
    for share in (1.0, 1e-3):
        branches = branching.cut(replace(parent, probability=share), newest[1:])
        examined[share] = {area for child in branches.children for area in child.state.matched_keyframes}
        assert (branches.log_skipped_weight > -math.inf) == (share < 1.0)
    assert (len(examined[1.0]), len(examined[1e-3])) == (6, 4)


def cut_in_promised_place(rooms, sigma=0.1, cut=2, **state):
    """The children of a robot that arcs put in the place of area 0."""
    parent, branching, newest = rooms_apart(rooms, ((0.2, 0.1),), sigma)
    parent = replace(parent, state=replace(parent.state, **state))
    return branching.cut(parent, newest[cut:]).children


def test_where_nothing_fits_in_a_promised_place_the_arcs_may_be_wrong():
    new, suspected = cut_in_promised_place((OTHER, ROOM))
    assert math.exp(new.log_weight) == pytest.approx(0.05)  # new ground beside the place
    assert math.exp(suspected.log_weight) == pytest.approx(0.01)
    (arc,) = suspected.arcs
    assert is_uninformative(arc.pose)
    assert suspected.state.localization.since == 8
    assert not new.state.is_lost


@pytest.mark.parametrize(
    ("rooms", "settings"),
    [
        ((ROOM, ROOM), {}),
        ((OTHER, ROOM), {"sigma": 6.0}),
        ((OTHER, ROOM), {"localization": Lost(6)}),
        ((OTHER, ROOM), {"cut": 0}),
    ],
    ids=["it fits", "nothing is promised", "lost already", "an area would be left empty"],
)
def test_else_the_arcs_are_not_suspected(rooms, settings):
    children = cut_in_promised_place(rooms, **settings)
    assert not any(is_uninformative(arc.pose) for child in children for arc in child.arcs)


def test_a_recheck_suspects_the_arcs_of_a_promised_place_too():
    parent, branching, newest = rooms_apart((OTHER, OTHER, ROOM), ((0.2, 0.1), (2.0, 0.0)), 0.1)
    known_through_another(parent.hybrid_map)
    parent = replace(parent, state=replace(parent.state, unmatched_keyframes=tuple(newest[1:])))
    arcs = [arc for child in branching.recheck(parent).children for arc in child.arcs]
    assert [is_uninformative(arc.pose) for arc in arcs] == [True]


def test_the_next_keyframes_that_do_not_fit_in_the_same_promised_place_are_no_further_evidence():
    parent, branching, newest = rooms_apart((OTHER, OTHER, ROOM), ((0.2, 0.1), (2.0, 0.0)), 0.1)
    known_through_another(parent.hybrid_map)
    parent = replace(parent, state=replace(parent.state, unmatched_keyframes=tuple(newest[1:3])))
    stay, *suspected = branching.recheck(parent).children
    assert math.exp(stay.log_weight) == pytest.approx(0.05)
    assert [is_uninformative(arc.pose) for child in suspected for arc in child.arcs] == [True]
    again = replace(parent, state=replace(stay.state, unmatched_keyframes=tuple(newest[3:])))
    (only,) = branching.recheck(again).children
    assert math.exp(only.log_weight) == pytest.approx(1.0)
    assert list(only.arcs) == []
