"""TSBI: branching at cuts, weights, recognition of known ground."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from worlds import box, scan_in

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.messages import (
    Accepted,
    AreaEvent,
    AreaEvents,
    AreaPose,
    Hypotheses,
    Keyframe,
    Leaf,
    LeafEstimate,
)
from hmt_slam_ros.processes.replica import Replica
from hmt_slam_ros.processes.tsbi import Tsbi
from hmt_slam_ros.processes.tsbi_branching import Branching, Parent
from hmt_slam_ros.topology.hypothesis_tree import LeafNotes

# A ring of corridors, 2 m wide, with niches and pillars that differ from side to side.
RING = np.concatenate((
    box(0.0, 0.0, 18.0, 12.0), box(2.0, 2.0, 16.0, 10.0), box(5.0, 0.0, 6.0, 0.4), box(11.0, 1.7, 11.6, 2.0),
    box(17.6, 4.0, 18.0, 5.5), box(16.0, 7.0, 16.3, 7.5), box(8.0, 11.5, 10.0, 12.0), box(4.0, 10.0, 4.4, 10.5),
    box(0.0, 6.0, 0.5, 6.6), box(1.6, 3.0, 2.0, 4.4),
))  # fmt: skip
STEP_SIGMA = np.array([0.02, 0.02, math.radians(0.25)])
STEP = np.diag(STEP_SIGMA**2)


def ring_drive(length):
    """``length`` poses half a metre apart, counter-clockwise along the middle of the corridors from (3, 1)."""
    corners = np.array([[17.0, 1.0], [17.0, 11.0], [1.0, 11.0], [1.0, 1.0]])
    poses, here, corner = [], np.array([3.0, 1.0]), 0
    while len(poses) < length:
        leg = corners[corner % 4] - here
        distance = math.hypot(*leg)
        if distance < 0.5:
            corner += 1
            continue
        poses.append([*here, math.atan2(leg[1], leg[0])])
        here = here + 0.5 * leg / distance
    return np.array(poses)


class Run:
    """A stand-in for metric SLAM, AAM and TLCA around a TSBI: dead reckoning with drift, cuts at given keyframes."""

    def __init__(self, walls, drift=(0.0, 0.0, 0.0), configuration=None, **laser):
        self.walls, self.laser = walls, laser
        self.drift = np.array(drift)
        self.tsbi = Tsbi(configuration or Configuration())
        self.replica = Replica()
        self.poses = {0: np.zeros(3)}
        self.covariances = {0: np.diag([1e-8, 1e-8, 1e-8])}
        self.true_pose = None
        self.answers = []
        self.evidence = {}
        self.stored = True

    def keyframe(self, true_pose, cut=0, moved=None, only=None):
        """One keyframe event; ``cut`` is how many of the newest keyframes leave the area, in every hypothesis."""
        sequence = len(self.answers)
        if self.true_pose is not None:
            step = se2.compose(se2.between(self.true_pose, true_pose), self.drift)
            for h in self.poses:
                self.poses[h] = se2.compose(self.poses[h], step)
                ad = se2.adjoint(se2.inverse(step))
                self.covariances[h] = ad @ self.covariances[h] @ ad.T + STEP
        self.true_pose = true_pose
        scan = scan_in(self.walls, true_pose, stamp=sequence, noise=0.01, seed=sequence, **self.laser)
        leaves = tuple(
            LeafEstimate(
                h, self.replica.areas[h], PoseGaussian(self.poses[h], self.covariances[h]), self.stored,
                self.evidence.get(h, 0.0), 12.0,
            )
            for h in sorted(self.poses)
        )  # fmt: skip
        message = Keyframe(sequence, scan, 0.5 * sequence, leaves)
        assert self.tsbi.handle(message) == []
        self.replica.add(message)
        return self._answer(sequence, self._events(sequence, cut, moved))

    def _events(self, sequence, cut, moved):
        if moved is not None:
            return tuple(AreaEvent(h, "moved", (), moved, 0.5) for h in sorted(self.poses))
        newest = tuple(range(sequence - cut + 1, sequence + 1))
        return tuple(AreaEvent(h, "cut", newest, self.replica.areas[h], 0.2) for h in sorted(self.poses) if cut)

    def _answer(self, sequence, events):
        (answer,) = self.tsbi.handle(AreaEvents(sequence, events))
        assert isinstance(answer, Hypotheses)
        assert answer.sequence == sequence
        assert sum(leaf.probability for leaf in answer.leaves) + answer.unexamined == pytest.approx(1.0)
        assert [leaf.hypothesis for leaf in answer.leaves] == sorted({leaf.hypothesis for leaf in answer.leaves})
        self.replica.apply(answer)
        rebased = {
            leaf.hypothesis: self.poses[leaf.parent]
            if leaf.rebase is None
            else se2.compose(leaf.rebase.mean, self.poses[leaf.parent])
            for leaf in answer.leaves
        }
        self.covariances = {
            leaf.hypothesis: self.covariances[leaf.parent] if leaf.rebase is None else len(leaf.relabelled) * STEP
            for leaf in answer.leaves
        }
        self.poses = rebased
        self.answers.append(answer)
        return answer

    def accept(self, hypothesis, **more):
        message = Accepted(len(self.answers) - 1, hypothesis, **more)
        assert self.tsbi.handle(message) == []
        self.replica.accept(message)
        self.poses = {hypothesis: self.poses[hypothesis]}
        self.covariances = {hypothesis: self.covariances[hypothesis]}


def around_the_ring(configuration=None, cuts_every=14, keyframes=112, drift=(0.002, -0.001, 0.0012)):
    """Once around and a few metres further; the best hypothesis is accepted between cuts until the ring closes."""
    run = Run(RING, drift, configuration, field_of_view=2 * np.pi, beams=241)
    poses = ring_drive(keyframes)
    for k, pose in enumerate(poses):
        answer = run.keyframe(pose, cut=cuts_every // 2 if k and k % cuts_every == 0 else 0)
        if k < 0.85 * keyframes and len(answer.leaves) > 1:
            run.accept(run.replica.best)
    return run, poses


def best_leaf(answer):
    return max(answer.leaves, key=lambda leaf: leaf.probability)


@pytest.fixture(scope="module")
def ring():
    return around_the_ring()


def closures(run, hypothesis):
    return [(a, b, value) for a, b, value in run.replica.maps[hypothesis].all_arcs() if value.closure]


def test_without_an_event_the_hypothesis_stays():
    run = Run(RING)
    answer = run.keyframe(np.array([3.0, 1.0, 0.0]))
    assert answer.leaves == (answer.leaves[0],)
    leaf = answer.leaves[0]
    assert (leaf.hypothesis, leaf.parent, leaf.probability, leaf.area, leaf.local) == (0, 0, 1.0, 0, ())


def test_a_cut_in_unknown_ground_makes_a_new_area():
    run = Run(RING)
    poses = ring_drive(8)
    for pose in poses[:-1]:
        run.keyframe(pose)
    (leaf,) = run.keyframe(poses[-1], cut=3).leaves
    assert (leaf.hypothesis, leaf.area, leaf.probability) == (0, 1, 1.0)
    assert [r.keyframe for r in leaf.relabelled] == [5, 6, 7]
    assert np.allclose(leaf.relabelled[0].pose, 0.0)
    assert np.allclose(leaf.relabelled[2].pose, se2.between(poses[5], poses[7]))
    (arc,) = leaf.arcs
    assert (arc.source, arc.target, arc.closure) == (0, 1, False)
    assert np.allclose(arc.pose.mean, se2.between(poses[0], poses[5]))
    assert np.allclose(leaf.rebase.mean, se2.between(poses[5], poses[0]))


def test_the_new_arc_has_the_uncertainty_of_the_reference_keyframe_and_the_floor():
    run = Run(RING)
    for pose in ring_drive(7):
        run.keyframe(pose)
    at_reference = run.covariances[0].copy()
    for pose in ring_drive(9)[7:8]:
        run.keyframe(pose)
    (leaf,) = run.keyframe(ring_drive(9)[8], cut=3).leaves
    floor = np.diag([0.01, 0.01, math.radians(0.2)]) ** 2
    assert np.allclose(leaf.arcs[0].pose.covariance, at_reference + floor)


def test_the_local_map_holds_the_area_and_those_that_are_surely_near():
    run = Run(RING)
    for pose in ring_drive(7):
        run.keyframe(pose)
    (leaf,) = run.keyframe(ring_drive(8)[7], cut=3).leaves
    assert [local.area for local in leaf.local] == [1, 0]
    assert np.allclose(leaf.local[0].pose, 0.0)
    assert np.allclose(leaf.local[1].pose, leaf.rebase.mean)


def test_a_move_goes_to_the_known_area_and_no_keyframe_changes():
    run = Run(RING)
    poses = ring_drive(8)
    for pose in poses[:-1]:
        run.keyframe(pose)
    run.keyframe(poses[-1], cut=3)
    before = run.poses[0]
    (leaf,) = run.keyframe(poses[-1], moved=0).leaves
    assert (leaf.hypothesis, leaf.area, leaf.relabelled, leaf.arcs) == (0, 0, (), ())
    assert [local.area for local in leaf.local] == [0, 1]
    assert np.allclose(se2.compose(leaf.rebase.mean, before), se2.between(poses[0], poses[-1]))


def test_turning_back_into_tracked_ground_is_no_new_area():
    """The robot goes back along the corridor: the local map tracks it there, so there is nothing to choose."""
    run = Run(RING)
    poses = ring_drive(16)
    for k, pose in enumerate(poses):
        run.keyframe(pose, cut=6 if k == 12 else 0)
    for pose in poses[2:6][::-1]:
        turned = np.array([pose[0], pose[1], math.pi])
        run.keyframe(turned)
    (leaf,) = run.keyframe(np.array([*poses[1][:2], math.pi]), cut=5).leaves
    assert (leaf.area, leaf.probability, leaf.arcs) == (0, 1.0, ())
    assert {r.area for r in leaf.relabelled} == {0}


def test_ground_tracked_by_way_of_another_area_is_joined_by_a_measured_arc():
    """The robot is back in area 0, which the local map holds, but only area 1 has an arc to it."""
    settings = Configuration()
    settings = replace(settings, tsbi=replace(settings.tsbi, local_sigma=0.3))
    run = Run(RING, configuration=settings, field_of_view=2 * np.pi, beams=241)
    poses = ring_drive(20)
    for k, pose in enumerate(poses):
        run.keyframe(pose, cut=4 if k in (8, 14) else 0)
    assert run.replica.maps[0].arc(2, 0) is None
    run.stored = False
    answers = [run.keyframe(np.array([*poses[k][:2], math.pi])) for k in (14, 8, 2, 2, 2)]
    (arc,) = [arc for answer in answers for leaf in answer.leaves for arc in leaf.arcs]
    assert (arc.source, arc.target, arc.closure) == (2, 0, True)
    reference = min(run.replica.maps[0].keyframes(2))
    assert np.allclose(arc.pose.mean, se2.between(poses[reference], poses[0]), atol=0.03)
    assert np.sqrt(arc.pose.covariance[1, 1]) < 0.2
    assert answers[-1].leaves[0].probability == 1.0


def test_the_ring_closes(ring):
    run, _ = ring
    best = run.replica.best
    assert run.replica.probabilities[best] > 0.95
    assert closures(run, best)


def test_the_drift_before_the_closure_was_too_large_for_the_local_map(ring):
    _, poses = ring
    drifted = np.zeros(3)
    for a, b in pairwise(poses[:97]):
        drifted = se2.compose(drifted, se2.compose(se2.between(a, b), (0.002, -0.001, 0.0012)))
    assert np.hypot(*(drifted - se2.between(poses[0], poses[96]))[:2]) > 0.4


def test_the_arc_that_closes_the_ring_is_precise(ring):
    """From frame to frame: the first keyframes of both areas, whose true poses are known."""
    run, poses = ring
    hybrid_map = run.replica.maps[run.replica.best]
    a, b, value = closures(run, run.replica.best)[0]
    keyframe_a, pose_a = next(iter(hybrid_map.keyframes(a).items()))
    keyframe_b, pose_b = next(iter(hybrid_map.keyframes(b).items()))
    truth = se2.between(
        se2.compose(poses[keyframe_a], se2.inverse(pose_a)), se2.compose(poses[keyframe_b], se2.inverse(pose_b))
    )
    away = se2.log(se2.between(value.pose.mean, truth))
    assert np.hypot(*away[:2]) < 0.25
    assert away @ np.linalg.solve(value.pose.covariance, away) < 16.3


def test_two_runs_say_the_same_to_the_bit(ring):
    run, _ = ring
    again, _ = around_the_ring()
    for a, b in zip(run.answers, again.answers, strict=True):
        assert [(x.hypothesis, x.probability, x.area) for x in a.leaves] == [
            (x.hypothesis, x.probability, x.area) for x in b.leaves
        ]


def test_a_hypothesis_that_branched_has_children_with_new_ids(ring):
    run, _ = ring
    seen = set()
    for answer in run.answers:
        parents = [leaf.parent for leaf in answer.leaves]
        for leaf in answer.leaves:
            if leaf.hypothesis != leaf.parent:
                assert leaf.hypothesis not in seen
            elif leaf.hypothesis == leaf.parent:
                assert parents.count(leaf.parent) == 1
        seen |= {leaf.hypothesis for leaf in answer.leaves}


PATH = np.array([[1.2 + 0.5 * k, 2.2, 0.1 * math.sin(k)] for k in range(6)])
ROOM = np.concatenate((box(0.0, 0.0, 5.0, 5.0), box(1.0, 3.0, 2.0, 3.5)))
OTHER = np.concatenate((box(-0.8, 1.2, 7.5, 3.4), box(3.0, 1.2, 3.4, 1.5)))


def rooms_apart(rooms, offsets, sigma, configuration=None):
    """The children of a hypothesis whose robot maps the last of several rooms, which may be one of the others.

    :param rooms: walls of areas 0, 1, ...; the robot is in the last. All were driven through on the same path.
    :param offsets: where the arcs place the frames of the known areas in that of the last one, (2,) each.
    :param sigma: deviation of the arcs, m.
    """
    replica = Replica()
    hybrid_map, here = replica.maps[0], len(rooms) - 1
    for area, walls in enumerate(rooms):
        for k, pose in enumerate(PATH):
            keyframe = 6 * area + k
            replica.scans[keyframe] = scan_in(
                walls, pose, noise=0.01, seed=keyframe, field_of_view=2 * np.pi, beams=361
            )
            hybrid_map.place(keyframe, area, se2.between(PATH[0], pose))
    for area, offset in enumerate(offsets):
        spread = np.diag([sigma, sigma, math.radians(5.0)]) ** 2
        hybrid_map.set_arc(here, area, PoseGaussian(np.array([*offset, 0.0]), spread), closure=False)
    newest = range(6 * here, 6 * here + 6)
    notes = LeafNotes({k: 1e-3 * np.eye(3) for k in newest}, unchecked=tuple(newest))
    parent = Parent(0, here, hybrid_map, notes, 0.0)
    return parent, Branching(configuration or Configuration(), replica), list(newest)


def weights_by_area(branches):
    weights = {}
    for child in branches.children:
        weights[child.area] = weights.get(child.area, 0.0) + math.exp(child.log_weight)
    total = sum(weights.values())
    return {area: weight / total for area, weight in weights.items()}


def test_one_of_two_rooms_that_look_alike_to_the_prior_is_recognised():
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


def test_a_recognised_area_is_entered_at_the_pose_of_the_match():
    parent, branching, newest = rooms_apart((ROOM, ROOM), ((0.6, -0.4),), 1.0)
    child = max(branching.cut(parent, newest[1:]).children, key=lambda child: child.log_weight)
    assert child.area == 0
    truth = se2.between(PATH[0], PATH[1])
    entered = {r.keyframe: r.pose for r in child.relabelled}
    assert np.allclose(entered[newest[1]], truth, atol=0.03)
    assert np.allclose(child.rebase.mean, 0.0, atol=0.04)
    (arc,) = child.arcs
    assert (arc.source, arc.target) == (1, 0)
    assert np.allclose(arc.pose.mean, 0.0, atol=0.04)
    assert not arc.closure  # an arc joined the two before
    assert np.sqrt(arc.pose.covariance[0, 0]) < 0.2


def test_candidates_beyond_the_number_that_is_examined_keep_their_prior_mass():
    settings = Configuration()
    settings = replace(settings, tsbi=replace(settings.tsbi, max_candidates=1))
    parent, branching, newest = rooms_apart((ROOM, ROOM, ROOM), ((0.6, 0.4), (-0.5, 0.3)), 1.0, settings)
    branches = branching.cut(parent, newest[1:])
    assert len({child.area for child in branches.children}) == 2  # new, and one of the two
    assert 0.05 < math.exp(branches.log_skipped) < 0.6


def test_a_re_check_joins_areas_by_an_arc_and_moves_nothing():
    parent, branching, _ = rooms_apart((ROOM, ROOM, ROOM), ((0.6, 0.4), (-0.5, 0.3)), 1.0)
    # Area 0 is the robot's neighbour; let it be known only by way of area 1.
    hybrid_map = parent.hybrid_map
    arc_1_0 = hybrid_map.arc(2, 1).inverse().compose(hybrid_map.arc(2, 0))
    del hybrid_map.arcs[0, 2]
    hybrid_map.set_arc(1, 0, arc_1_0, closure=False)
    children = branching.recheck(parent).children
    stay, *joined = children
    assert (stay.area, stay.arcs, stay.reload) == (2, (), False)
    assert stay.notes.unchecked == ()
    assert joined
    for child in joined:
        assert (child.area, child.relabelled, child.rebase) == (2, (), None)
        (arc,) = child.arcs
        assert (arc.source, arc.target, arc.closure) == (2, 0, True)


def test_a_keyframe_speaks_for_or_against_an_area_once():
    parent, branching, newest = rooms_apart((ROOM, ROOM), ((0.6, -0.4),), 1.0)
    stay = replace(parent, notes=parent.notes.checked([0], newest))
    branches = branching.cut(stay, newest[1:])
    assert [child.area for child in branches.children] == [parent.area + 1]


def test_the_evidence_of_the_scans_shifts_the_weights():
    run, _ = ring_with_two_leaves()
    first, second = sorted(run.poses)
    before = dict(run.replica.probabilities)
    run.evidence = {first: 0.0, second: 1.5}
    answer = run.keyframe(run.true_pose)
    after = {leaf.hypothesis: leaf.probability for leaf in answer.leaves}
    assert after[second] / after[first] == pytest.approx(math.exp(1.5) * before[second] / before[first])


def ring_with_two_leaves():
    """Two live hypotheses: the children of a cut, as TSBI would have made them."""
    run = Run(RING)
    run.keyframe(np.array([3.0, 1.0, 0.0]))
    split = Hypotheses(0, (Leaf(1, 0, 0.6, 0), Leaf(2, 0, 0.4, 0)))
    for replica in (run.replica, run.tsbi._replica):
        replica.apply(split)
    run.tsbi._notes = dict.fromkeys((1, 2), run.tsbi._notes[0])
    run.poses = {1: np.zeros(3), 2: np.zeros(3)}
    run.covariances = {1: STEP, 2: STEP}
    return run, split


def test_acceptance_leaves_one_hypothesis():
    run, _ = ring_with_two_leaves()
    run.accept(2)
    (leaf,) = run.keyframe(run.true_pose).leaves
    assert (leaf.hypothesis, leaf.parent, leaf.probability) == (2, 2, 1.0)


def test_the_local_map_takes_the_poses_of_the_global_map_where_they_agree():
    run = Run(RING)
    poses = ring_drive(8)
    for pose in poses[:-1]:
        run.keyframe(pose)
    run.keyframe(poses[-1], cut=3)
    nudge = np.array([0.004, -0.003, 0.001])
    placed = se2.compose(se2.between(poses[0], poses[5]), nudge)
    certain = 1e-6 * np.eye(3)
    run.accept(
        0, global_poses=(AreaPose(0, PoseGaussian(np.zeros(3), certain)), AreaPose(1, PoseGaussian(placed, certain)))
    )
    (leaf,) = run.keyframe(poses[-1], moved=0).leaves
    assert np.allclose(leaf.local[1].pose, placed)


def test_events_of_another_keyframe_are_refused():
    run = Run(RING)
    run.keyframe(np.array([3.0, 1.0, 0.0]))
    with pytest.raises(HmtSlamError, match="a message was lost"):
        run.tsbi.handle(AreaEvents(5, ()))
