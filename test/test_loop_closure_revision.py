"""An accepted closure that later contradicts others is withdrawn, with all that hangs on it; the map is not bent."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from misled import make_misled, run
from ring_for_tsbi import RING, Run, ring_drive

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue, HybridMap, area_pair
from hmt_slam_ros.loop_closure.closure_history import (
    AcceptedPath,
    Closure,
    MapSnapshot,
    PathStep,
    apply_area_merge,
    undo_refinements,
    withdraw_closure,
)
from hmt_slam_ros.loop_closure.closure_revision import ClosureConsistencyCheck
from hmt_slam_ros.messages.map_changes import Arc, ArcEnds, AreaMerge, MovedKeyframe
from hmt_slam_ros.messages.messages import Hypothesis
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.final_map import final_map
from hmt_slam_ros.sensors import Scan

BOUND = chi_square_gate(Configuration().tlca.contradiction_probability)
ODOMETRY, MATCH = np.diag([0.3, 0.3, 0.02]) ** 2, np.diag([0.05, 0.05, 0.01]) ** 2
NEXT = np.array([4.0, 0.0, 0.0])  # from the frame of an area to that of the next


def true_motion(a, b):
    """Truth: ``a_T_b`` of areas along a straight corridor."""
    return (b - a) * NEXT


def corridor(areas):
    """Areas 0, 1, ... along a corridor, each with keyframes 10 a and 10 a + 1, joined by odometry; its history."""
    hybrid_map, history = HybridMap(), ()
    for area in range(areas):
        hybrid_map.set_keyframe(10 * area, area, np.zeros(3))
        hybrid_map.set_keyframe(10 * area + 1, area, np.array([1.0, 0.0, 0.0]))
        if area:
            hybrid_map.set_arc(area - 1, area, PoseGaussian(NEXT, ODOMETRY), closure=False)
            history += (PathStep(10 * area, area - 1, area, ((area - 1, area),), frozenset({10 * area})),)
    return hybrid_map, history


def make_closure(hybrid_map, event, near, far, error=(0.0, 0.0, 0.0), log_odds=4.6):
    belief = PoseGaussian(se2.compose(true_motion(near, far), np.array(error)), MATCH)
    hybrid_map.set_arc(near, far, belief, closure=True)
    return Closure((event, (min(near, far), max(near, far))), near, far, belief, log_odds, MapSnapshot({}, {}))


def path_of(hybrid_map, history, closures, area):
    hybrid_map.commit()
    return AcceptedPath(hybrid_map, history, tuple(closures), area, np.zeros(3))


TRUE, FALSE = (0.0, 0.0, 0.0), (2.2, 0.0, 0.0)


def drive_with(*found, areas=8, area=7):
    """The corridor with closures (event, near, far, error)."""
    hybrid_map, history = corridor(areas)
    closures = []
    for event, near, far, error in found:
        closures.append(make_closure(hybrid_map, event, near, far, error))
        history += (PathStep(event, near, near, (closures[-1].pair,)),)
    return path_of(hybrid_map, history, closures, area)


def find_inconsistency(path, event):
    return ClosureConsistencyCheck(path, BOUND, 100).find_inconsistency(
        [c.closure_id for c in path.closures if c.closure_id[0] == event], 0.01
    )


def test_closures_that_agree_raise_no_inconsistency():
    path = drive_with((80, 7, 0, (0.05, 0.0, 0.0)), (81, 6, 1, (0.0, -0.05, 0.0)), (82, 7, 2, (0.0, 0.0, 0.0)))
    assert find_inconsistency(path, 82) is None


def test_a_closure_contradicts_others_if_its_excess_is_above_the_bound():
    path = drive_with((80, 6, 0, FALSE), (81, 7, 1, TRUE))
    new = [path.closures[1].closure_id]
    excess = ClosureConsistencyCheck(path, 0.0, 100).find_inconsistency(new, 0.01).excess_chi2
    below = ClosureConsistencyCheck(path, np.nextafter(excess, 0.0), 100).find_inconsistency(new, 0.01)
    assert below.excess_chi2 == excess
    assert ClosureConsistencyCheck(path, excess, 100).find_inconsistency(new, 0.01) is None


def test_a_false_closure_is_found_when_true_ones_contradict_it():
    """It fits the odometry alone."""
    path = drive_with((80, 6, 0, FALSE))
    assert find_inconsistency(path, 80) is None
    path = drive_with((80, 6, 0, FALSE), (81, 7, 1, TRUE))
    inconsistency = find_inconsistency(path, 81)
    assert inconsistency.closure.closure_id[0] == 81
    assert inconsistency.excess_chi2 > BOUND
    assert [c.closure_id[0] for c in inconsistency.explanations[0].false_closures] == [80]
    assert inconsistency.explanations[0].probability > 0.9


def test_where_two_closures_contradict_each_other_both_may_be_false():
    path = drive_with((80, 6, 0, FALSE), (81, 7, 1, (-2.2, 0.0, 0.0)))
    inconsistency = find_inconsistency(path, 81)
    assert sorted(c.closure_id[0] for e in inconsistency.explanations for c in e.false_closures) == [80, 81]
    assert [e.probability for e in inconsistency.explanations] == pytest.approx([0.5, 0.5], abs=0.01)


def test_the_odds_at_which_a_closure_was_accepted_speak_for_it():
    path = drive_with((80, 6, 0, FALSE), (81, 7, 1, (-2.2, 0.0, 0.0)))
    closures = (path.closures[0], replace(path.closures[1], log_odds=10.0))
    inconsistency = find_inconsistency(replace(path, closures=closures), 81)
    assert [[c.closure_id[0] for c in e.false_closures] for e in inconsistency.explanations] == [[80]]


def test_closures_that_were_accepted_because_of_a_false_one_go_with_it_and_true_ones_stay():
    shifted = (80, 6, 0, FALSE), (81, 6, 1, FALSE), (82, 7, 2, FALSE)
    path = drive_with((79, 3, 0, TRUE), *shifted, (90, 5, 3, TRUE), (91, 7, 4, TRUE))
    inconsistency = find_inconsistency(path, 91)
    best = inconsistency.explanations[0]
    assert [c.closure_id[0] for c in best.false_closures] == [80, 81, 82]
    assert best.probability > 0.99
    assert [c.closure_id[0] for c in best.path.closures] == [79, 90, 91]


def false_account():
    """From area 3 the robot falsely enters area 0: it stores keyframes 41, 42 there, goes on to area 1, stores 45, and
    leaves it for area 4, which is new."""
    hybrid_map, history = corridor(4)
    closure = make_closure(hybrid_map, 40, 3, 0)
    hybrid_map.set_keyframe(39, 0, np.array([0.2, 0.1, 0.0]))
    hybrid_map.set_keyframe(41, 0, np.array([0.5, 0.1, 0.0]))
    hybrid_map.set_keyframe(42, 0, np.array([1.0, 0.1, 0.0]))
    hybrid_map.set_keyframe(45, 1, np.array([0.5, 0.1, 0.0]))
    hybrid_map.set_keyframe(50, 4, np.zeros(3))
    hybrid_map.set_arc(1, 4, PoseGaussian(np.array([0.0, 3.0, 1.5]), ODOMETRY), closure=False)
    history += (
        PathStep(40, 3, 0, ((0, 3),), frozenset({39})),
        PathStep(43, 0, 1, ()),
        PathStep(50, 1, 4, ((1, 4),), frozenset({50})),
    )
    return path_of(hybrid_map, history, [closure], 4)


def in_frame_of(hybrid_map, *areas):
    """``first_T_last`` along arcs."""
    pose = np.zeros(3)
    for a, b in pairwise(areas):
        pose = se2.compose(pose, hybrid_map.arc(a, b).mean)
    return pose


def test_keyframes_stored_after_a_false_closure_become_a_separate_area():
    before = false_account()
    found = withdraw_closure(before, before.closures[0].closure_id, 9)
    hybrid_map = found.hybrid_map
    assert {a: sorted(hybrid_map.keyframes(a)) for a in hybrid_map.area_ids()} == {
        0: [0, 1],
        1: [10, 11],
        2: [20, 21],
        3: [30, 31],
        4: [50],
        9: [39, 41, 42, 45],
    }
    assert [(a, b, arc.closure) for a, b, arc in hybrid_map.all_arcs()] == [
        (0, 1, False),
        (1, 2, False),
        (2, 3, False),
        (3, 9, False),
        (4, 9, False),
    ]
    assert found.closures == ()
    # The robot's own path is as it was, seen from where it came.
    was = in_frame_of(before.hybrid_map, 3, 0, 1, 4)
    np.testing.assert_allclose(in_frame_of(hybrid_map, 3, 9, 4), was, atol=1e-12)
    at = se2.compose(in_frame_of(before.hybrid_map, 3, 0, 1), before.hybrid_map.keyframes(1)[45])
    np.testing.assert_allclose(se2.compose(hybrid_map.arc(3, 9).mean, hybrid_map.keyframes(9)[45]), at, atol=1e-12)
    assert (found.area, found.frame_change) == (4, None)
    np.testing.assert_array_equal(list(before.hybrid_map.keyframes(0)), [0, 1, 39, 41, 42])


def test_a_robot_that_is_in_an_area_falsely_is_then_in_the_new_one():
    before = false_account()
    hybrid_map = before.hybrid_map.branch()
    hybrid_map.remove_arc(1, 4)
    found = withdraw_closure(
        replace(before, hybrid_map=hybrid_map, history=before.history[:-1], area=1), before.closures[0].closure_id, 9
    )
    assert found.area == 9
    np.testing.assert_allclose(found.frame_change, NEXT, atol=1e-12)
    assert found.history[-1].area_after == 9


def test_a_link_that_the_robot_never_crossed_is_only_taken_out():
    before = drive_with((80, 6, 0, FALSE))
    found = withdraw_closure(before, before.closures[0].closure_id, 100)
    assert 100 not in found.hybrid_map.area_ids()
    assert found.hybrid_map.arc(0, 6) is None
    assert (found.area, found.frame_change) == (7, None)
    assert before.hybrid_map.arc(0, 6) is not None


def test_a_rollback_restores_moved_keyframes_and_moves_later_ones_along():
    hybrid_map, history = corridor(4)
    bent = np.array([0.3, 0.2, 0.05])
    closure = make_closure(hybrid_map, 40, 3, 0)
    former = {k: (3, hybrid_map.keyframes(3)[k].copy()) for k in (30, 31)}
    undo = MapSnapshot(former, {(2, 3): ArcValue(PoseGaussian(NEXT, ODOMETRY), closure=False)})
    for k in (30, 31):
        hybrid_map.set_keyframe(k, 3, se2.compose(bent, former[k][1]))
    hybrid_map.set_arc(2, 3, PoseGaussian(NEXT + 0.1, ODOMETRY), closure=False)
    stored, reached = np.array([1.5, 0.0, 0.0]), np.array([3.0, 0.0, 0.2])
    hybrid_map.set_keyframe(41, 3, se2.compose(bent, stored))
    hybrid_map.set_keyframe(45, 4, np.zeros(3))
    hybrid_map.set_arc(3, 4, PoseGaussian(se2.compose(bent, reached), ODOMETRY), closure=False)
    history += (PathStep(40, 3, 3, ((0, 3),)), PathStep(45, 3, 4, ((3, 4),), frozenset({45})))
    path = path_of(hybrid_map, history, [replace(closure, snapshot=undo)], 4)
    found = undo_refinements(path, closure.closure_id)
    placed = found.hybrid_map.keyframes(3)
    for k in (30, 31):
        np.testing.assert_array_equal(placed[k], former[k][1])
    np.testing.assert_allclose(placed[41], stored, atol=1e-12)
    np.testing.assert_allclose(found.hybrid_map.arc(3, 4).mean, reached, atol=1e-12)
    np.testing.assert_array_equal(found.hybrid_map.arc(2, 3).mean, NEXT)
    assert found.closures[0].snapshot is None
    at_home = undo_refinements(replace(path, area=3, pose=se2.compose(bent, stored)), closure.closure_id)
    np.testing.assert_allclose(at_home.pose, stored, atol=1e-12)
    np.testing.assert_allclose(at_home.frame_change, se2.inverse(bent), atol=1e-12)


def test_an_area_that_became_part_of_another_is_that_one_in_the_account():
    """Areas 3 and 6 are one; the false closure of areas 7 and 1 can be withdrawn as before, that of 3 and 6 cannot."""
    path = drive_with((80, 6, 3, TRUE), (81, 7, 1, FALSE), (82, 6, 0, TRUE))
    history, closures = apply_area_merge(path, AreaMerge(6, 3, path.hybrid_map.arc(3, 6)))
    assert [(c.closure_id[0], c.near, c.far) for c in closures] == [(81, 7, 1), (82, 3, 0)]
    np.testing.assert_allclose(closures[1].pose.mean, true_motion(3, 0), atol=1e-9)
    steps = [(step.event, step.area_before, step.area_after, step.new_arcs) for step in history]
    assert steps[4:] == [
        (50, 4, 5, ((4, 5),)),
        (60, 5, 3, ((3, 5),)),
        (70, 3, 7, ((3, 7),)),
        (80, 3, 3, ()),
        (81, 7, 7, ((1, 7),)),
        (82, 3, 3, ((0, 3),)),
    ]
    history, closures = apply_area_merge(path, AreaMerge(6, 3, path.hybrid_map.arc(3, 6)))
    hybrid_map = path.hybrid_map.branch()
    hybrid_map.merge(6, 3, hybrid_map.arc(3, 6))
    found = withdraw_closure(AcceptedPath(hybrid_map, history, closures, 7, np.zeros(3)), closures[0].closure_id, 100)
    assert found.hybrid_map.arc(1, 7) is None
    assert found.hybrid_map.arc(3, 7) is not None
    assert [c.closure_id[0] for c in found.closures] == [82]


def test_a_closure_beside_which_another_observation_of_its_arc_is_fused_is_not_withdrawn():
    """Both 5 and 6 were found beside 0, and are then found to be one."""
    path = drive_with((80, 6, 0, TRUE), (81, 5, 0, TRUE), (82, 6, 5, TRUE))
    _, closures = apply_area_merge(path, AreaMerge(6, 5, path.hybrid_map.arc(5, 6)))
    assert closures == ()


def test_a_rollback_after_a_merge():
    hybrid_map, history = corridor(4)
    bent = np.array([0.3, 0.2, 0.05])
    former = {k: (k // 10, hybrid_map.keyframes(k // 10)[k].copy()) for k in (20, 21, 30, 31)}
    for k, (area, pose) in former.items():
        hybrid_map.set_keyframe(k, area, se2.compose(bent, pose))
    arcs = {pair: hybrid_map.arc_value(*pair) for pair in ((1, 2), (2, 3))}
    closure = replace(make_closure(hybrid_map, 40, 2, 0), snapshot=MapSnapshot(former, arcs))
    path = path_of(hybrid_map, history, [closure], 2)
    history, closures = apply_area_merge(path, AreaMerge(3, 2, path.hybrid_map.arc(2, 3)))
    assert set(closures[0].snapshot.keyframes) == {20, 21}
    assert set(closures[0].snapshot.arcs) == {(1, 2)}
    hybrid_map.merge(3, 2, hybrid_map.arc(2, 3))
    found = undo_refinements(
        AcceptedPath(hybrid_map, history, closures, 2, np.zeros(3)), closure.closure_id
    ).hybrid_map.keyframes(2)
    for k in (20, 21):
        np.testing.assert_array_equal(found[k], former[k][1])
    was = hybrid_map.keyframes(2)
    for k in (30, 31):
        np.testing.assert_allclose(se2.between(found[21], found[k]), se2.between(was[21], was[k]), atol=1e-12)


def test_tsbi_goes_on_with_the_explanations_as_live_hypotheses():
    run = Run(RING)
    for k, pose in enumerate(ring_drive(8)):
        run.keyframe(pose, cut=3 if k == 7 else 0)
    link = PoseGaussian(np.array([2.5, 0.0, 0.0]), MATCH)
    back = PoseGaussian(np.array([2.5, 0.0, 0.0]), np.zeros((3, 3)))
    keyframes = run.replica.maps[0].keyframes(1)
    moved = tuple(MovedKeyframe(k, 1, 0, se2.compose(back.mean, pose)) for k, pose in keyframes.items())
    explanations = (
        Hypothesis(0, 0, 0.7, 0, back, moved, (), removed_arcs=(ArcEnds(0, 1),)),
        Hypothesis(0, 0, 0.3, 1, None, (), (Arc(0, 1, link, closure=True),)),
    )
    run.accept(0, revised_hypotheses=explanations)
    one, two = run.keyframe(ring_drive(9)[8]).hypotheses
    assert (one.parent, two.parent, one.id == two.id) == (0, 0, False)
    assert (one.probability, two.probability) == pytest.approx((0.7, 0.3))
    assert run.replica.maps[one.id].arc(0, 1) is None
    np.testing.assert_array_equal(run.replica.maps[two.id].arc(0, 1).mean, link.mean)
    # The keyframe that came since goes with the robot.
    assert sorted(r.keyframe for r in one.moved_keyframes) == [5, 6, 7, 8]
    assert sorted(run.replica.maps[one.id].keyframes(0)) == list(range(9))
    assert one.local_areas[0].area == 0
    assert [hypothesis.removed_arcs for hypothesis in run.keyframe(ring_drive(10)[9]).hypotheses] == [(), ()]


LOG = "sim:ring,seed=3,size=1.5"


@pytest.fixture(scope="module")
def drives():
    """Two laps of a ring of corridors, and the same with a loop falsely closed after a third of the first lap.

    By itself the false closure is within what is admitted of a cycle.
    """
    return run(open_log(LOG), Configuration()), run(open_log(LOG), Configuration(), make_misled(2, 0, 3.8))


def arcs(recording, merged=()):
    """The pairs of areas that arcs join; ``merged`` are parts of area 0, which they close the loop to."""
    pairs = {
        area_pair(*(0 if area in merged else area for area in (a, b))) for a, b, _ in recording.hybrid_map.all_arcs()
    }
    return pairs - {(0, 0)}


def test_a_closure_that_was_accepted_falsely_is_withdrawn_when_the_true_one_comes(drives):
    (without_it, _), (with_it, _) = drives
    accepted = {row.keyframe: row for row in with_it.probabilities if row.accepted}
    assert min(k for k, row in accepted.items() if row.closures) < 80  # definite, long before the true one
    (text,) = [notice.text for notice in with_it.notices if notice.process == "tlca"]
    assert "closure between areas 0 and 4 contradicts" in text
    assert "of all closures 2-0 is taken for false" in text
    # Whether area 4 is merged into area 0 depends on the last keyframe events.
    merged = {4} - (set(with_it.area_poses) & set(without_it.area_poses))
    assert arcs(with_it, merged) == arcs(without_it, merged)
    assert any(arc.closure for a, b, arc in with_it.hybrid_map.all_arcs() if a == 0)
    assert with_it.hybrid_map.arc(0, 2) is None
    assert with_it.replica.probabilities[with_it.replica.best_hypothesis] == 1.0


def test_afterwards_the_map_is_as_if_it_had_never_been_there(drives):
    (one, _), (two, _) = drives
    reference, *others = (area for area in one.area_poses if area in two.area_poses)
    assert others in ([1, 2, 3], [1, 2, 3, 4])
    np.testing.assert_array_equal(two.area_poses[reference].mean, one.area_poses[reference].mean)
    for area in others:
        assert two.area_poses[area].mahalanobis2(one.area_poses[area]) < BOUND
    scans = [r.measurement for r in open_log(LOG).records() if isinstance(r.measurement, Scan)]
    final = [final_map(drive, lambda: scans, Configuration()).recording.trajectory for drive in (one, two)]
    apart = np.hypot(*se2.between(*final)[:, :2].T)
    assert apart.mean() < 0.05
    assert apart.max() < 0.15


def test_every_process_has_the_same_map_from_messages_alone(drives):
    for recording, replicas in drives:
        for replica in replicas:
            assert list(replica.maps) == [recording.replica.best_hypothesis]
            found = replica.maps[recording.replica.best_hypothesis]
            assert found.area_ids() == recording.hybrid_map.area_ids()
            for area in found.area_ids():
                here, there = found.keyframes(area), recording.hybrid_map.keyframes(area)
                assert list(here) == list(there)
                np.testing.assert_array_equal(list(here.values()), list(there.values()))
            for (a, b, arc), (c, d, other) in zip(found.all_arcs(), recording.hybrid_map.all_arcs(), strict=True):
                assert (a, b, arc.closure) == (c, d, other.closure)
                np.testing.assert_array_equal(arc.pose.mean, other.pose.mean)


def test_a_true_closure_is_not_rejected(drives):
    recording, _ = drives[0]
    assert [notice for notice in recording.notices if notice.process == "tlca"] == []
    assert any(arc.closure for _, _, arc in recording.hybrid_map.all_arcs())
