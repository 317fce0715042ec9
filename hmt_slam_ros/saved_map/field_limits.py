"""Shapes and numbers of the fields of a saved map: what a field has to be by itself.

Classes and fields are named and not imported, so that a node loads no code of other processes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.plain_data import field_names, is_record
from hmt_slam_ros.untrusted_input import shorten

MAX_AREAS = 1_000_000
"""Ids of areas are below; tables have a row for each."""

MAX_COUNT = 2**40
"""Counts and numbers of keyframes, scans and hypotheses are below, beyond any drive."""

MAX_STAMP = 2**62
"""Stamps are below, ns, so that their sums fit into 64 bits."""

MAX_COORDINATE = 1e7
"""Largest magnitude of x, y, m, and of a heading, rad."""

MAX_NUMBER = 1e15
"""Largest magnitude of any other number."""

SYMMETRY = 1e-6
"""Largest asymmetry of a covariance, and largest negative eigenvalue, as shares of its largest element."""

_FORMAT_DOC = "docs/reference/map_format.md"

_SHAPES: Mapping[str, Mapping[str, str]] = {
    "DoorCrossing": {"pose": "3"},
    "EstimateTable": {"scans": "n", "stamps": "n", "areas": "n", "poses": "n 3", "odometry": "n 3"},
    "GraphState": {
        "areas": "n",
        "keyframe_counts": "n",
        "keyframes": "k",
        "poses": "k 3",
        "arcs": "m 2",
        "means": "m 3",
        "covariances": "m 3 3",
        "closures": "m",
        "removed": "m",
    },
    "InertiaState": {"velocity": "3", "covariance": "3 3", "predicted_information": "3 3", "interval_error": "3"},
    "JoinedGraph": {"arc": "3"},
    "KeyframeCovariances": {"keyframes": "n", "covariances": "n 3 3"},
    "Landmark": {"scatter": "3 3", "scan_covariance_share": "3 3"},
    "LaserEvent": {"laser_pose": "3", "pose": "3"},
    "LaserPeriods": {"laser_pose": "3"},
    "LastEvent": {
        "pose": "3",
        "motion": "3",
        "match_information": "3 3",
        "pose_covariance": "3 3",
        "blind_drift": "3 3",
    },
    "LineFilterState": {
        "reported_poses": "k 3",
        "last_covariance": "3 3",
        "information": "3 3",
        "tracking_covariance": "3 3",
    },
    "LineMapState": {"mean": "s", "covariance": "s s"},
    "LocalArea": {"pose": "3"},
    "LocalEstimate": {"odometry": "3"},
    "LogProgress": {"stamps": "n", "source_stamps": "n"},
    "MatchError": {"pose_covariance": "3 3", "drift_covariance": "3 3", "gain": "3 3"},
    "MotionState": {"odometry_pose": "3"},
    "MovedKeyframe": {"pose": "3"},
    "Odometry": {"pose": "3"},
    "OdometryDisagreement": {
        "odometry_motion": "3",
        "scan_motion": "3",
        "odometry_motion_now": "3",
        "scan_motion_now": "3",
    },
    "OdometryNoiseState": {"weighted_ratios": "2", "weights": "2"},
    "OdometryPathPoint": {"measured": "3", "reset_free": "3"},
    "OverlapGraph": {"similarity": "n n"},
    "ParticleFilterState": {
        "poses": "m 3",
        "log_weights": "m",
        "keyframe_poses": "m k 3",
        "tables": "m t t",
        "predicted_poses": "m 3",
        "last_poses": "m 3",
        "members": "m",
        "tracking_covariance": "3 3",
    },
    "PatchState": {"odds": "n 32 32", "field": "n 32 32", "occupied": "n 32"},
    "PathPose": {"pose": "3"},
    "PoseClones": {"poses": "k 3", "cross_covariances": "k 3 s"},
    "PoseGaussian": {"mean": "3", "covariance": "3 3"},
    "PoseInArea": {"pose": "3"},
    "ProbabilityTable": dict.fromkeys(
        (
            "keyframe",
            "stamp",
            "path_length",
            "hypothesis",
            "parent",
            "probability",
            "area",
            "areas",
            "closures",
            "accepted",
            "unexamined",
            "effective_samples",
            "mode_count",
        ),
        "n",
    ),
    "RecentScan": {"pose": "3"},
    "RelativeMotion": {"increment": "3", "covariance": "3 3"},
    "RelativeTrajectory": {"keyframes": "n", "poses": "n 3"},
    "RtlState": {"ambiguity": "3 3"},
    "RunRecord": {"online_trajectory": "n 3"},
    "ScanPoseTable": {
        "hypotheses": "n",
        "first_scans": "n",
        "sizes": "n",
        "stamps": "k",
        "keyframes": "k",
        "poses": "k 3",
    },
    "ScanStep": {"increment": "3"},
    "ScanTable": {
        "names": "n",
        "stamps": "n",
        "beams": "n",
        "ranges": "r",
        "geometry": "n 5",
        "laser_poses": "n 3",
        "motions": "n 3",
        "partial_beams": "c",
        "partial_starts": "c",
    },
    "TrackedMode": {"residual_covariance": "3 3"},
    "WallLine": {"segments": "w 2"},
}
"""{class: {field: sizes}}: a size is a number, or a letter that stands for the same size in the whole record."""

_ANY_FLOATS = frozenset({("ScanTable", "ranges")})
"""Fields whose floats may be NaN or infinite: beams without a return."""

_AREA = (0, MAX_AREAS)
_NUMBER = (0, MAX_COUNT)
_NUMBER_OR_NONE = (-1, MAX_COUNT)
_KEYFRAME = (-MAX_COUNT, MAX_COUNT)  # those of other robots are below -1
_STAMP = (-MAX_STAMP, MAX_STAMP)
_SHARE = (0.0, 1.0)
_POSE = (-MAX_COORDINATE, MAX_COORDINATE)
_POSITIVE = (0.0, MAX_NUMBER)
_LIMITS: Mapping[str, tuple[float, float]] = {
    **dict.fromkeys(
        ("area", "previous_area", "into", "near", "far", "source", "target", "arcs", "keyframe_areas", "prune_queue"),
        _AREA,
    ),
    **dict.fromkeys(("merge_queue", "pairs_split_by_door", "reported_arcs", "new_arcs", "robot_areas"), _AREA),
    **dict.fromkeys(("max_area_id", "largest_area", "area_before", "area_after"), (-1, MAX_AREAS)),
    **dict.fromkeys(
        ("keyframe_counts", "records_read", "first_scans", "events", "keyframe_events", "version"), _NUMBER
    ),
    **dict.fromkeys(("processed_scans", "dropped_scans", "first_unpublished_scan", "next_hypothesis"), _NUMBER),
    **dict.fromkeys(("leader", "detections", "misses", "sightings", "next_number", "sizes"), _NUMBER),
    **dict.fromkeys(("scan_index", "dropped", "separation_count", "dominant_keyframes", "change_count"), _NUMBER),
    **dict.fromkeys(("members", "mode_count", "kidnappings", "first_event", "last_event"), _NUMBER),
    **dict.fromkeys(("unreported", "beams", "hypothesis", "graph", "map_sizes", "checksum"), _NUMBER),
    **dict.fromkeys(("keyframes", "keyframe", "anchor", "second_keyframes"), _KEYFRAME),
    **dict.fromkeys(("first_keyframe", "second_keyframe"), _KEYFRAME),
    **dict.fromkeys(("number", "compared_statement", "examined_statement"), _NUMBER),
    **dict.fromkeys(("event", "id", "parent", "hypotheses", "since", "published_change"), _NUMBER_OR_NONE),
    **dict.fromkeys(("requested_at", "newest_sampled", "scans", "areas"), _NUMBER_OR_NONE),
    **dict.fromkeys(("stamp", "stamps", "source_stamps", "last_stamp", "begin", "end", "clock_offset"), _STAMP),
    **dict.fromkeys(("probability", "probabilities", "unexamined", "presence", "confidence", "similarity"), _SHARE),
    **dict.fromkeys(("pose", "poses", "mean", "means", "increment", "motion", "odometry", "motions"), _POSE),
    **dict.fromkeys(("keyframe_poses", "predicted_poses", "last_poses", "reported_poses", "laser_poses"), _POSE),
    **dict.fromkeys(
        ("odometry_pose", "online_trajectory", "measured", "reset_free", "segments", "arc", "laser_pose"), _POSE
    ),
    **dict.fromkeys(
        ("path_length", "branched_at", "width", "width_deviation", "weighted_ratios", "weights"), _POSITIVE
    ),
    **dict.fromkeys(("inliers", "outliers", "distance", "angle", "periods", "last_interval", "min_ncut"), _POSITIVE),
    "kind": (0, 2),
    "reliability": (0.5, 0.999),
    **dict.fromkeys(
        ("long_term_period", "recent_period", "negative_shares", "effective_samples", "mark_gain"), _POSITIVE
    ),
}
"""{field of any record: smallest and largest value of its numbers}."""

_COVARIANCES = frozenset(
    {
        "covariance",
        "covariances",
        "pose_covariance",
        "drift_covariance",
        "blind_drift",
        "last_covariance",
        "tracking_covariance",
        "residual_covariance",
        "information",
        "match_information",
        "predicted_information",
        "ambiguity",
    }
)
"""Fields with second moments or information: symmetric, without a negative eigenvalue."""


def check_fields(record: Any, path: str) -> None:  # noqa: ANN401  any record of a document
    """Check the shapes and numbers of a record whose fields have their types, each by itself.

    :param path: of the record in its document.
    :raises HmtSlamError: names the field, its value and what it has to be.
    """
    kind: Any = type(record)
    shapes, sizes = _SHAPES.get(kind.__name__, {}), dict[str, int]()
    for name in field_names(kind):
        value, place = getattr(record, name), f"{path}.{name}"
        if isinstance(value, np.ndarray):
            if name in shapes:
                _check_shape(value, shapes[name], sizes, place)
            _check_array(value, name, place, finite=(kind.__name__, name) not in _ANY_FLOATS)
        elif not is_record(type(value)):
            _check_numbers(value, name, place)


def _check_shape(array: NDArray[Any], wanted: str, sizes: dict[str, int], path: str) -> None:
    words = wanted.split()
    matches = len(words) == array.ndim and all(
        size == (int(word) if word.isdigit() else sizes.setdefault(word, size))
        for word, size in zip(words, array.shape, strict=True)
    )
    require(matches, path, f"an array of shape {array.shape}", f"one of shape ({', '.join(words)})")


def _check_array(array: NDArray[Any], name: str, path: str, *, finite: bool) -> None:
    if array.dtype.kind == "f" and finite:
        require(bool(np.isfinite(array).all()), path, "NaN or infinite", "finite")
    if array.size == 0 or not finite or array.dtype.kind == "b":
        return
    low, high = _LIMITS.get(name, (-MAX_NUMBER, MAX_NUMBER) if array.dtype.kind == "f" else _STAMP)
    least, most = array.min(), array.max()
    require(bool(low <= least and most <= high), path, f"{least} to {most}", f"{low:g} to {high:g}")
    if name in _COVARIANCES:
        _check_covariances(array, path)


def _check_covariances(matrices: NDArray[np.float64], path: str) -> None:
    transposed = np.swapaxes(matrices, -1, -2)
    scale = np.abs(matrices).max(axis=(-1, -2))
    require(
        bool((np.abs(matrices - transposed).max(axis=(-1, -2)) <= SYMMETRY * scale).all()),
        path,
        "a matrix",
        "symmetric",
    )
    least = np.linalg.eigvalsh(0.5 * (matrices + transposed))[..., 0]
    require(bool((least >= -SYMMETRY * scale).all()), path, f"a matrix with an eigenvalue {least.min():g}", "positive")


def _check_numbers(value: object, name: str, path: str) -> None:
    """Check the numbers of a field, or those in its collections; keys are checked where they matter."""
    if isinstance(value, Mapping):
        value = value.values()
    if isinstance(value, bool | str) or value is None:
        return
    if isinstance(value, int | float):
        low, high = _LIMITS.get(name, (-MAX_NUMBER, MAX_NUMBER) if isinstance(value, float) else _STAMP)
        require(low <= value <= high, path, value, f"{low:g} to {high:g}")
    elif isinstance(value, np.ndarray):
        # Arrays in collections are poses or their covariances.
        is_pose = name not in _COVARIANCES
        _check_shape(value, "3" if is_pose else "3 3", {}, path)
        _check_array(value, "pose" if is_pose else name, path, finite=True)
    elif not is_record(type(value)) and isinstance(value, Iterable):
        for item in value:
            _check_numbers(item, name, path)


def require(holds: bool, path: str, value: object, wanted: str) -> None:
    """Refuse a value that is not what it has to be.

    :raises HmtSlamError: names the field, the value and what it has to be.
    """
    if not holds:
        raise HmtSlamError(f"{path} = {shorten(value)} is not {wanted}: see {_FORMAT_DOC}, or map the log again")
