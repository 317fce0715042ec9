"""The probability of localization that a run states."""

from __future__ import annotations

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.topological_inference.hypothesis_agreement import LocalizedHypothesis, elsewhere_probability


def localization_probability(run: LockStepRun) -> float:
    """The probability that the robot is where the most probable hypothesis has it, after the last keyframe event.

    It is that of all tracked hypotheses, less those under which the robot is elsewhere. ``hmt/is_localized`` compares
    the rest with ``tsbi.lost_probability``. 0 before the first event.
    """
    slam, recorder = run.lock_step.processes["slam"], run.recorder
    assert isinstance(slam, MetricSlam)
    if not recorder.hypotheses:
        return 0.0
    event, replica = max(recorder.hypotheses), slam.replica
    estimates = {estimate.hypothesis: estimate.pose.mean for estimate in recorder.keyframes[event].estimates}
    tracked, probabilities = list[LocalizedHypothesis](), list[float]()
    for hypothesis in recorder.hypotheses[event].hypotheses:
        if hypothesis.lost or hypothesis.id not in replica.maps:
            continue
        pose, frame = estimates[hypothesis.parent], hypothesis.frame_change
        pose = pose if frame is None else se2.compose(frame.mean, pose)
        area = replica.robot_areas[hypothesis.id]
        tracked.append(LocalizedHypothesis(replica.maps[hypothesis.id], area, pose, {area}))
        probabilities.append(replica.probabilities[hypothesis.id])
    return sum(probabilities) - elsewhere_probability(tracked, probabilities)
