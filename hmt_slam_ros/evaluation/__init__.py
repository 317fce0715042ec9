"""Evaluation of trajectories: files of stamped poses, and errors of relations between them."""

from hmt_slam_ros.evaluation.relations import (
    ErrorStatistics,
    PairErrors,
    RelationErrors,
    Relations,
    RelationScore,
    evaluate_folder,
    evaluate_relations,
    format_table,
    pair_errors,
    read_relations,
    true_relations,
)
from hmt_slam_ros.evaluation.trajectory import StampedPoses, read_odometry_poses, read_true_poses, read_tum, write_tum

__all__ = [
    "ErrorStatistics",
    "PairErrors",
    "RelationErrors",
    "RelationScore",
    "Relations",
    "StampedPoses",
    "evaluate_folder",
    "evaluate_relations",
    "format_table",
    "pair_errors",
    "read_odometry_poses",
    "read_relations",
    "read_true_poses",
    "read_tum",
    "true_relations",
    "write_tum",
]
