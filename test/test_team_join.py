"""Maps of one simulated building that are joined, and others that are not."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from laps import CONFIGURATION, map_lap
from worlds import box, drive, scan_at

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import consistent_map
from hmt_slam_ros.hybrid_map.shortest_path import map_pieces
from hmt_slam_ros.messages.team import Verdict
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.team.components import Component, combine, renumber
from hmt_slam_ros.team.join import decide, join_at, meet
from hmt_slam_ros.team.placement import Placement, PlacementDistribution, WindowCandidate
from hmt_slam_ros.team.placement_evidence import PlacementEvidence
from hmt_slam_ros.team.team_map import merge_components
from hmt_slam_ros.team.windows import Window

OFFICE, OTHER, RING = "sim:office,size=0.7,seed=51", "sim:office,size=0.7,seed=50", "sim:ring,seed=50"
TIGHT = np.diag([0.02, 0.02, 0.005]) ** 2


@cache
def meeting(first, second):
    return meet(map_lap(*first), map_lap(*second), CONFIGURATION)


def keyframe_poses(component):
    poses = consistent_map(component.hybrid_map).poses
    return {
        k: se2.compose(belief.mean, pose)
        for area, belief in poses.items()
        for k, pose in component.hybrid_map.keyframes(area).items()
    }


def test_halves_of_a_drive_are_joined_as_in_the_simulation():
    found = meeting((OFFICE, 0), (OFFICE, 1))
    assert found.verdict is Verdict.JOINED
    assert found.distribution.best.probability >= 0.99 and len(found.distribution.best.matches) > 3
    joined = found.refine(CONFIGURATION)
    assert len(map_pieces(joined.hybrid_map)) == 1
    poses, log = keyframe_poses(joined), open_log(OFFICE)
    numbers = sorted(poses)
    truth = dict(zip(numbers, log.true_poses(np.array([joined.scans[k].stamp for k in numbers])), strict=True))
    first = found.pair.first_keyframe
    known = np.array([truth[k][:2] for k in numbers if k < first])
    for k in numbers[first:]:
        nearest = numbers[int(np.hypot(*(known - truth[k][:2]).T).argmin())]
        error = se2.between(se2.between(truth[nearest], truth[k]), se2.between(poses[nearest], poses[k]))
        assert math.hypot(error[0], error[1]) < 0.2 and abs(error[2]) < math.radians(3.0)


def test_the_halves_are_joined_alike_in_the_other_order():
    one, other = meeting((OFFICE, 0), (OFFICE, 1)), meeting((OFFICE, 1), (OFFICE, 0))
    assert other.verdict is Verdict.JOINED
    difference = se2.compose(one.distribution.best.pose, other.distribution.best.pose)
    assert math.hypot(difference[0], difference[1]) < 0.2 and abs(difference[2]) < math.radians(3.0)


def test_the_same_maps_give_the_same_distribution_whatever_their_numbers():
    one, second = meeting((OFFICE, 0), (OFFICE, 1)), map_lap(OFFICE, 1)
    shifted = Component(renumber(second.hybrid_map, 5, 1000), {k + 1000: scan for k, scan in second.scans.items()})
    for again in (second, shifted):
        other = meet(map_lap(OFFICE, 0), again, CONFIGURATION)
        for before, now in zip(one.distribution.placements, other.distribution.placements, strict=True):
            assert before.probability == now.probability
            np.testing.assert_array_equal(before.pose, now.pose)


def test_maps_of_two_buildings_stay_apart():
    found = meeting((OFFICE, 0), (OTHER, 0))
    assert found.verdict is Verdict.APART and found.joined is None
    assert found.distribution.apart > 0.9


def test_of_a_ring_with_equal_sides_four_placements_keep_their_probabilities():
    found = meeting((RING, 0), (RING, 1))
    assert min(found.pair.repetitions).log_ratio > 2.5
    probabilities = [each.probability for each in found.distribution.placements]
    assert min(probabilities[:4]) > 0.5 * probabilities[0]
    assert max(probabilities[4:], default=0.0) < 0.01 * probabilities[0]
    assert sum(probabilities) < 0.5


@pytest.mark.long
def test_a_third_map_joins_the_piece_that_it_fits():
    parts = {"a": map_lap(OFFICE, 0), "other": map_lap(OTHER, 0), "b": map_lap(OFFICE, 1)}
    team = merge_components(parts, CONFIGURATION)
    assert [piece.name for piece in team.pieces] == ["a + b", "other"]
    assert [met.meeting.verdict for met in team.meetings] == [Verdict.APART, Verdict.JOINED, Verdict.APART]
    whole = team.whole()
    assert [len(piece) for piece in map_pieces(whole.component.hybrid_map)] == [
        len(parts["a"].hybrid_map.area_ids()) + len(parts["b"].hybrid_map.area_ids()),
        len(parts["other"].hybrid_map.area_ids()),
    ]
    for name, shift in whole.shifts.items():
        for keyframe, scan in parts[name].scans.items():
            assert whole.component.scans[keyframe + shift.keyframes] is scan


def room(x, seed, cupboard=5.0):
    """Keyframes of a walk through a room of 8 m by 6 m with a cupboard, which stands at ``x``, and their scans."""
    walls = np.concatenate((box(0.0, 0.0, 8.0, 6.0), box(cupboard, 4.5, cupboard + 2.0, 5.5)))
    walls[:, ::2] += x
    rng = np.random.default_rng(seed)
    poses = [np.array([x + 1.0 + 0.5 * n, 1.5 + 0.3 * (n % 3), 0.4 * n]) for n in range(12)]
    return poses, [scan_at(walls, pose, 0.01, rng, 360) for pose in poses]


def rooms(places, seed, cupboards=()):
    """The map of rooms, one area in each, equal but for where their cupboards stand."""
    hybrid_map, scans = HybridMap(), {}
    for area, x in enumerate(places):
        for pose, scan in zip(*room(x, seed + area, *cupboards[area : area + 1]), strict=True):
            hybrid_map.set_keyframe(len(scans), area, pose - [x, 0.0, 0.0])
            scans[len(scans)] = scan
        if area:
            step = np.array([x - places[area - 1], 0.0, 0.0])
            hybrid_map.set_arc(area - 1, area, PoseGaussian(step, TIGHT), closure=False)
    hybrid_map.commit()
    return Component(hybrid_map, scans)


def test_in_which_of_two_equal_rooms_a_map_lies_stays_open():
    found = meet(rooms((0.0, 30.0), 0), rooms((0.0,), 5), CONFIGURATION)
    assert found.joined is None
    one, other = found.distribution.placements[:2]
    assert min(one.probability, other.probability) > 0.1
    assert abs(one.pose[0] - other.pose[0]) == pytest.approx(30.0, abs=0.1)


def test_the_pose_of_a_placement_is_between_the_frames_of_the_maps():
    """The components are pieces of maps, with another first area."""
    first, second = rooms((0.0, 30.0), 0), rooms((0.0,), 5)
    one, other = np.array([3.0, 1.0, 0.5]), np.array([-2.0, 4.0, -1.0])
    plain = meet(first, second, CONFIGURATION).distribution.placements
    found = meet(replace(first, pose=one), replace(second, pose=other), CONFIGURATION).distribution.placements
    for before, now in zip(plain, found, strict=True):
        assert now.probability == before.probability
        expected = se2.compose(se2.compose(one, before.pose), se2.inverse(other))
        assert now.pose.tolist() == expected.tolist()


def hall(y, seed):
    """The map of a straight way through a hall of 10 m by 7 m, ``y`` m from its wall."""
    walls = np.concatenate((box(0.0, 0.0, 10.0, 7.0), box(3.0, 0.0, 4.5, 0.6), box(7.0, 6.0, 7.8, 7.0)))
    hybrid_map, rng = HybridMap(), np.random.default_rng(seed)
    poses = dict(enumerate(drive((1.0, y), (9.0, y))))
    for keyframe, pose in poses.items():
        hybrid_map.set_keyframe(keyframe, 0, se2.between(poses[0], pose))
    hybrid_map.commit()
    return Component(hybrid_map, {k: scan_at(walls, pose, 0.01, rng, 360) for k, pose in poses.items()})


@pytest.mark.parametrize("y", [1.5, 5.0])
def test_a_robot_on_the_other_side_of_a_hall_is_found(y):
    found = meet(hall(1.5, 0), hall(y, 1), CONFIGURATION).distribution.best
    np.testing.assert_allclose(found.pose, [0.0, y - 1.5, 0.0], atol=0.05)
    assert all(window.is_in_place for window in found.windows.values())


def matched_at(shift):
    """Two rows of areas, and a sure placement by matches of two windows, the second of which is shifted, m."""
    pair = combine(rooms((0.0, 30.0), 0), rooms((0.0, 30.0), 5))
    windows = [Window(area, np.zeros(3), pair.hybrid_map.keyframes(area)) for area in pair.other]
    beliefs = [PoseGaussian(np.array([x, 0.0, 0.0]), TIGHT) for x in (0.0, shift)]
    matches = {n: WindowCandidate(n, area, beliefs[n], 5.0) for n, area in enumerate(pair.known)}
    return pair, windows, Placement(np.zeros(3), matches, {}, PlacementEvidence(5.0, 5.0), 0.999)


@pytest.mark.parametrize(("shift", "verdict"), [(0.02, Verdict.JOINED), (0.5, Verdict.CONTRADICTORY)])
def test_arcs_that_contradict_one_another_join_nothing(shift, verdict):
    pair, windows, placement = matched_at(shift)
    found, joined = decide(pair, windows, PlacementDistribution((placement,), 0.001), CONFIGURATION)
    assert found is verdict and (joined is not None) == (verdict is Verdict.JOINED)


@pytest.mark.parametrize(("distance", "verdict"), [(0.0, Verdict.CONTRADICTORY), (12.0, Verdict.JOINED)])
def test_windows_are_off_by_what_areas_bend_inside(distance, verdict):
    """Two windows differ by 0.4 m: five deviations of the arcs, and two far from the origins of the areas."""
    pair, windows, placement = matched_at(0.4)
    arc = PoseGaussian(np.array([3.0, 0.0, 0.0]), np.diag([0.05, 0.05, 0.005]) ** 2)
    for areas in (pair.known, pair.other):
        pair.hybrid_map.set_arc(*areas, arc, closure=False)
    there = np.array([distance, 0.0, 0.0])
    windows = [Window(window.area, there, window.poses) for window in windows]
    matches = {
        n: match._replace(belief=PoseGaussian(match.belief.mean + there, TIGHT))
        for n, match in placement.matches.items()
    }
    distribution = PlacementDistribution((replace(placement, matches=matches),), 0.001)
    assert decide(pair, windows, distribution, CONFIGURATION)[0] is verdict


@pytest.mark.parametrize(
    ("probability", "windows_that_agree", "verdict"),
    [(0.98, 2, Verdict.OPEN), (0.999, 1, Verdict.OPEN), (0.3, 2, Verdict.APART)],
)
def test_only_a_sure_placement_of_two_windows_joins(probability, windows_that_agree, verdict):
    pair, windows, placement = matched_at(0.0)
    matches = dict(list(placement.matches.items())[:windows_that_agree])
    placement = replace(placement, matches=matches, probability=probability)
    found, joined = decide(pair, windows, PlacementDistribution((placement,), 1.0 - probability), CONFIGURATION)
    assert found is verdict and joined is None


def test_a_join_replaces_the_uninformative_arc_by_closures():
    pair, windows, placement = matched_at(0.0)
    joined = join_at(pair, windows, placement, CONFIGURATION.tlca)
    between = [(a, b, arc) for a, b, arc in joined.all_arcs() if a in pair.known and b in pair.other]
    assert [(a, b) for a, b, _ in between] == list(zip(pair.known, pair.other, strict=True))
    assert all(arc.closure for _, _, arc in between)
