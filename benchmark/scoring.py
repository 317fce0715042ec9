"""Trajectories of output folders against true relations, and means over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmark.logs import MeasuredLog
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import PairErrors, RelationErrors, StampedPoses, evaluate_relations, pair_errors, read_tum

FINAL, ONLINE = "trajectory.tum", "trajectory_online.tum"

POLICY = (
    "A relation is matched with the pose nearest in time within 0.1 s at both ends; where there is none, the nearest "
    "pose is carried there along the raw odometry; where that is not possible either, the relation counts as missed."
)
"""How relations are matched, see :func:`hmt_slam_ros.evaluation.pair_errors`."""


def score(folder: Path, log: MeasuredLog, file: str = FINAL) -> RelationErrors:
    """Errors of one trajectory of an output folder.

    :param file: name of the trajectory.
    :raises HmtSlamError: where the log has no true relations, or there is no such trajectory.
    """
    return scored(read_tum(folder / file), log)


def scored(trajectory: StampedPoses, log: MeasuredLog) -> RelationErrors:
    """Errors of a trajectory of a log.

    :raises HmtSlamError: where the log has no true relations.
    """
    if log.relations is None:
        raise HmtSlamError(f"the log {log.name} has no true relations: its trajectory cannot be scored")
    return evaluate_relations(trajectory, log.relations, log.odometry)


def errors(folder: Path, log: MeasuredLog, file: str = FINAL) -> PairErrors:
    """Likewise, relation by relation."""
    if log.relations is None:
        raise HmtSlamError(f"the log {log.name} has no true relations: its trajectory cannot be scored")
    return pair_errors(read_tum(folder / file), log.relations, log.odometry)


@dataclass(frozen=True)
class SeedMeans:
    """Means over seeds of the errors of one kind of trajectory.

    :ivar translation: mean over the seeds of the mean error, m.
    :ivar translation_std: sample deviation of the seeds' means, m.
    :ivar relations_std: mean over the seeds of the deviation over the relations, m.
    :ivar worst: largest mean of a seed, m.
    :ivar long: as ``translation``, of relations over more than 60 s, m.
    :ivar long_max: largest error of any of these, m.
    :ivar rotation: as ``translation``, degrees.
    :ivar matched: share of the relations.
    :ivar carried: relations of a seed that needed the odometry, at most.
    :ivar missed: relations of a seed that were missed, at most.
    """

    translation: float
    translation_std: float
    relations_std: float
    worst: float
    long: float
    long_max: float
    rotation: float
    matched: float
    carried: int
    missed: int


def over_seeds(scores: Sequence[RelationErrors]) -> SeedMeans:
    """Means over the seeds, one score each."""
    means = np.array([score.overall.translation.mean for score in scores])
    return SeedMeans(
        translation=float(means.mean()),
        translation_std=sample_deviation(means.tolist()),
        relations_std=float(np.mean([score.overall.translation.std for score in scores])),
        worst=float(means.max()),
        long=float(np.mean([score.over_60_s.translation.mean for score in scores])),
        long_max=float(np.max([score.over_60_s.translation.max for score in scores])),
        rotation=float(np.mean([score.overall.rotation.mean for score in scores])),
        matched=sum(s.overall.matched for s in scores) / sum(s.overall.count for s in scores),
        carried=max(score.overall.carried for score in scores),
        missed=max(score.overall.missed for score in scores),
    )


def sample_deviation(values: Sequence[float]) -> float:
    """With n - 1; 0 for a single value."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
