"""TSBI once around a ring of corridors: the closure, its precision, and the ids of the hypotheses."""

from itertools import pairwise

import numpy as np
import pytest
from ring_for_tsbi import RING, Run, ring_drive

from hmt_slam_ros.geometry import se2

DRIFT = np.array([0.002, -0.001, 0.0012])  # m, m, rad per keyframe


def around_the_ring():
    """Once around and a few meters further; the best hypothesis is accepted between cuts until the ring closes."""
    run = Run(RING, DRIFT, field_of_view=2 * np.pi, beams=241)
    poses = ring_drive(112)
    for k, pose in enumerate(poses):
        answer = run.keyframe(pose, cut=7 if k and k % 14 == 0 else 0)
        if k <= 95 and len(answer.hypotheses) > 1:
            run.accept(run.replica.best_hypothesis)
    return run, poses


@pytest.fixture(scope="module")
def ring():
    return around_the_ring()


def closures(run, hypothesis):
    return [(a, b, value) for a, b, value in run.replica.maps[hypothesis].all_arcs() if value.closure]


def test_the_ring_closes(ring):
    run, _ = ring
    best = run.replica.best_hypothesis
    assert run.replica.probabilities[best] > 0.95
    assert closures(run, best)


def test_the_drift_before_the_closure_was_too_large_for_the_local_map(ring):
    _, poses = ring
    drifted = np.zeros(3)
    for a, b in pairwise(poses[:97]):
        drifted = se2.compose(drifted, se2.compose(se2.between(a, b), DRIFT))
    assert np.hypot(*(drifted - se2.between(poses[0], poses[96]))[:2]) > 0.4


def test_the_arc_that_closes_the_ring_is_precise(ring):
    """From frame to frame: the first keyframes of both areas, whose true poses are known."""
    run, poses = ring
    hybrid_map = run.replica.maps[run.replica.best_hypothesis]
    a, b, value = closures(run, run.replica.best_hypothesis)[0]
    keyframe_a, pose_a = next(iter(hybrid_map.keyframes(a).items()))
    keyframe_b, pose_b = next(iter(hybrid_map.keyframes(b).items()))
    truth = se2.between(
        se2.compose(poses[keyframe_a], se2.inverse(pose_a)), se2.compose(poses[keyframe_b], se2.inverse(pose_b))
    )
    away = se2.log(se2.between(value.pose.mean, truth))
    assert np.hypot(*away[:2]) < 0.25
    assert away @ np.linalg.solve(value.pose.covariance, away) < 16.3


def test_the_evidence_of_the_closure_is_given_in_lengths_and_ends_with_its_acceptance():
    run, _ = around_the_ring()
    best = run.replica.best_hypothesis
    a, b, _ = closures(run, best)[0]
    known = {one.hypothesis: one.steps for one in run.tsbi.evidence.hypotheses}
    step = next(one for one in known[best] if one.kind == "closure")
    assert {step.area, step.other} == {a, b}
    assert 0.0 < step.prior < 1.0
    assert step.matched > 10.0 * step.contradicting
    assert all(one.kind in ("new_area", "unchanged") for h in known.keys() - {best} for one in known[h][-1:])
    run.accept(best)
    assert run.tsbi.evidence.hypotheses == ()


def test_two_runs_are_the_same_to_the_bit(ring):
    run, _ = ring
    again, _ = around_the_ring()
    for a, b in zip(run.answers, again.answers, strict=True):
        assert [(x.id, x.probability, x.area) for x in a.hypotheses] == [
            (x.id, x.probability, x.area) for x in b.hypotheses
        ]


def test_a_hypothesis_that_branched_has_children_with_new_ids(ring):
    run, _ = ring
    seen = set()
    for answer in run.answers:
        parents = [hypothesis.parent for hypothesis in answer.hypotheses]
        for hypothesis in answer.hypotheses:
            if hypothesis.id != hypothesis.parent:
                assert hypothesis.id not in seen
            elif hypothesis.id == hypothesis.parent:
                assert parents.count(hypothesis.parent) == 1
        seen |= {hypothesis.id for hypothesis in answer.hypotheses}
