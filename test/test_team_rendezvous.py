"""Rendezvous of two robots: one observes the other, which tells how their maps lie, unless scans contradict it."""

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.team import TeamRendezvous, Verdict
from hmt_slam_ros.offline.team_run import TeamRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.team.rendezvous import KnownRendezvous
from hmt_slam_ros.team.team import Team

WORLD, LAP_SHARE = "sim:office,size=0.7,seed=51", 0.4
SIGMA = np.diag([0.1, 0.1, 0.05]) ** 2


def logs():
    """Two robots that drive a part of a lap each, so that little tells how their maps lie."""
    lap = 0.5 * open_log(WORLD).duration
    starts = {"ann": 0.0, "bob": lap + 0.3 * lap}
    return {name: open_log(WORLD, start=start, duration=LAP_SHARE * lap) for name, start in starts.items()}


@cache
def drive():
    """The run, and {robot: (stamp, true pose) of each scan}."""
    run = TeamRun(Configuration(seed=50), logs())
    run.run()
    tracks = {}
    for name, log in logs().items():
        stamps = [r.measurement.stamp for r in log.records() if isinstance(r.measurement, Scan)]
        tracks[name] = (stamps, log.true_poses(np.array(stamps)))
    return run, tracks


def rendezvous(shift=0.0, robot="ann", other="bob", share=0.5):
    """One observes the other at a share of its drive; the pose is wrong by ``shift`` m."""
    _, tracks = drive()
    (stamps, poses), (other_stamps, others) = tracks[robot], tracks[other]
    i, j = int(share * len(stamps)), int(share * len(other_stamps))
    pose = se2.between(poses[i], others[j]) + np.array([shift, 0.0, 0.0])
    return TeamRendezvous(robot, stamps[i], other, other_stamps[j], PoseGaussian(pose, SIGMA))


def answer(robot, *seen):
    """What a robot finds with some rendezvous: its process is a copy."""
    team = deepcopy(drive()[0].teams[robot])
    for each in seen:
        team.handle(each)
    while team.is_searching:
        team.search(8, may_wait=False)
    (meeting,) = team.meetings.values()
    return meeting


def error_of(meeting):
    """Distance of the best placement from the truth, m, as the observed pose has it."""
    _, tracks = drive()
    starts = [poses[0] for _, poses in tracks.values()]
    return float(np.hypot(*se2.between(se2.between(*starts), meeting.distribution.best.pose)[:2]))


def test_a_rendezvous_joins_maps_that_scans_leave_open():
    open_, joined = answer("ann"), answer("ann", rendezvous())
    assert open_.joined is None and 0.2 < open_.distribution.best.probability < 0.9
    assert joined.verdict is Verdict.JOINED and joined.distribution.best.probability > 0.99
    assert error_of(joined) < 0.3


def test_both_robots_find_the_same_whoever_observes_the_other():
    by_ann = rendezvous()
    by_bob = TeamRendezvous("bob", by_ann.other_stamp, "ann", by_ann.stamp, by_ann.pose.inverse())
    answers = [answer(robot, seen).distribution.best for robot in ("ann", "bob") for seen in (by_ann, by_bob)]
    for each in answers:
        assert each.probability == pytest.approx(answers[0].probability, abs=1e-4)
        np.testing.assert_allclose(each.pose, answers[0].pose, atol=1e-6)


def test_a_robot_that_is_taken_for_another_one_joins_nothing():
    """It was 8 m off: what the scans tell remains."""
    wrong = answer("ann", rendezvous(shift=8.0), rendezvous(shift=8.0, share=0.8))
    assert wrong.joined is None
    assert error_of(wrong) < 0.3


def test_a_rendezvous_counts_from_the_keyframe_after_it():
    late = rendezvous()
    for changed in ({"stamp": late.stamp + 10**12}, {"other_stamp": late.other_stamp - 10**12}):
        assert answer("ann", replace(late, **changed)).joined is None


def test_others_get_what_this_robot_observes_once():
    team = deepcopy(drive()[0].teams["ann"])
    seen = rendezvous(share=0.1)
    assert team.handle(seen) == [seen]
    assert team.handle(replace(seen, stamp=seen.stamp + NANOSECONDS)) == []
    by_bob = rendezvous(robot="bob", other="ann", share=0.9)
    assert team.handle(by_bob) == []
    assert team.state.rendezvous == (seen, by_bob)
    assert Team(Configuration(seed=50), team.state).state.rendezvous == (seen, by_bob)


def test_the_number_of_rendezvous_is_bounded():
    known = KnownRendezvous("ann")
    pose = PoseGaussian(np.zeros(3), SIGMA)
    kept = [known.add(TeamRendezvous("ann", n * 10**11, "bob", n * 10**11, pose)) for n in range(100)]
    assert kept.count("bob") == len(known.state) == 32
    assert known.add(TeamRendezvous("cid", 0, "ann", 0, pose)) == "cid"
    assert known.add(TeamRendezvous("cid", 0, "bob", 0, pose)) == ""
    assert [len(known.with_robot(name)) for name in ("bob", "cid", "dan")] == [32, 1, 0]
