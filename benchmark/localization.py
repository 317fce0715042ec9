"""The pose and the probability of localization that a run states after a keyframe event."""

from __future__ import annotations

from typing import NamedTuple

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hypothesis_agreement import LocalizedHypothesis, elsewhere_probability
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.offline.lock_step import LockStepRun


class RobotPose(NamedTuple):
    """The robot's pose under a hypothesis, after the last keyframe event.

    :ivar hypothesis: the hypothesis.
    :ivar area: the robot's area.
    :ivar pose: ``area_T_base``, shape (3,).
    :ivar probability: of the hypothesis.
    :ivar lost: whether it is lost.
    """

    hypothesis: int
    area: int
    pose: Float64
    probability: float
    lost: bool


def robot_poses(run: LockStepRun) -> list[RobotPose]:
    """The robot's pose under every live hypothesis, the most probable one first; none before the first event."""
    recorder, replica = run.recorder, slam_of(run).replica
    if not recorder.hypotheses:
        return []
    event = max(recorder.hypotheses)
    estimates = {estimate.hypothesis: estimate.pose.mean for estimate in recorder.keyframes[event].estimates}
    poses = []
    for one in recorder.hypotheses[event].hypotheses:
        if one.id in replica.maps:
            before, frame = estimates[one.parent], one.frame_change
            pose = before if frame is None else se2.compose(frame.mean, before)
            poses.append(RobotPose(one.id, replica.robot_areas[one.id], pose, replica.probabilities[one.id], one.lost))
    return sorted(poses, key=lambda pose: pose.hypothesis != replica.best_hypothesis)


def localization_probability(run: LockStepRun) -> float:
    """The probability that the robot is where the most probable hypothesis has it, after the last keyframe event.

    It is that of all tracked hypotheses, less those under which the robot is elsewhere. ``hmt/is_localized`` compares
    the rest with ``tsbi.lost_probability``. 0 before the first event.
    """
    maps = slam_of(run).replica.maps
    tracked = [pose for pose in robot_poses(run) if not pose.lost]
    probabilities = [pose.probability for pose in tracked]
    localized = [LocalizedHypothesis(maps[p.hypothesis], p.area, p.pose, {p.area}) for p in tracked]
    return sum(probabilities) - elsewhere_probability(localized, probabilities)


def slam_of(run: LockStepRun) -> MetricSlam:
    """The metric SLAM of a run."""
    slam = run.lock_step.processes["slam"]
    assert isinstance(slam, MetricSlam)
    return slam
