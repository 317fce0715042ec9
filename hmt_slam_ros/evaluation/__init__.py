"""How good a trajectory is: files of stamped poses, and errors of relations between them."""

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
from hmt_slam_ros.evaluation.trajectory import StampedPoses, odometry_of, read_tum, truth_of, write_tum

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
    "odometry_of",
    "pair_errors",
    "read_relations",
    "read_tum",
    "true_relations",
    "truth_of",
    "write_tum",
]
