"""Errors of a trajectory at relations between two of its poses (Kuemmerle et al. 2009), and true relations.

A relation is the true pose at one time in the frame of the pose at another. It needs no common frame, and an early
error of heading counts once, unlike in a comparison of absolute poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation.trajectory import StampedPoses, read_odometry_poses, read_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS, stamp_from_seconds
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors.plausibility import MAX_COORDINATE, check_planar_pose
from hmt_slam_ros.untrusted_input import MAX_TEXT_BYTES, read_text

MAX_TIME_GAP = NANOSECONDS // 10
"""Largest time between a relation's end and the pose taken for it, ns."""

LONG_SPAN = 60 * NANOSECONDS
"""Shortest time span of relations in which a missed loop shows, ns."""

_SPACING = 1.0
"""Traveled distance between poses with true relations, m."""

_FAR = 10
"""Poses between both ends of the longer true relations."""

_SAME_PLACE_RADIUS = 3.0
"""Largest distance between poses of one place, m."""


@dataclass(frozen=True, eq=False)
class Relations:
    """True relative poses.

    :ivar starts: shape (n,), stamps of the first poses, ns.
    :ivar ends: shape (n,), stamps of the second poses, ns; they may lie before the first.
    :ivar poses: shape (n, 3), ``start_T_end`` as (x, y, theta) in m and rad.
    """

    starts: NDArray[np.int64]
    ends: NDArray[np.int64]
    poses: NDArray[np.float64]


@dataclass(frozen=True)
class ErrorStatistics:
    """Mean, sample standard deviation (n - 1), root mean square and maximum of absolute errors; NaN for none."""

    mean: float
    std: float
    rms: float
    max: float


@dataclass(frozen=True)
class RelationScore:
    """Errors over a set of relations.

    :ivar count: relations in the set.
    :ivar matched: relations with a pose at both ends.
    :ivar missed: all others.
    :ivar extrapolated: matched relations with an end that was extrapolated along the odometry.
    :ivar translation: norm of the difference of the two translations, meters.
    :ivar rotation: absolute difference of heading, degrees.
    """

    count: int
    matched: int
    missed: int
    extrapolated: int
    translation: ErrorStatistics
    rotation: ErrorStatistics


@dataclass(frozen=True)
class RelationErrors:
    """Errors over all relations, and over those that span more than 60 s."""

    overall: RelationScore
    over_60_s: RelationScore


@dataclass(frozen=True, eq=False)
class PairErrors:
    """Error of every relation; arrays of shape (n,).

    :ivar translation: norm of the difference of the two translations, meters.
    :ivar rotation: absolute difference of heading, degrees.
    :ivar span: time between the two poses, ns, int64.
    :ivar is_matched: whether there is a pose at both ends; if not, the errors are meaningless.
    :ivar is_extrapolated: whether an end was extrapolated along the odometry.
    """

    translation: NDArray[np.float64]
    rotation: NDArray[np.float64]
    span: NDArray[np.int64]
    is_matched: NDArray[np.bool_]
    is_extrapolated: NDArray[np.bool_]


def read_relations(path: Path) -> Relations:
    """Relations from lines ``t1 t2 x y z roll pitch yaw`` (s, m, rad); ``#`` begins a comment.

    :raises HmtSlamError: if the file cannot be read, is empty or has a malformed line.
    """
    lines = read_text(path, MAX_TEXT_BYTES).splitlines()
    stamps: list[tuple[int, int]] = []
    poses: list[tuple[float, float, float]] = []
    for number, line in enumerate(lines, start=1):
        fields = line.partition("#")[0].split()
        if not fields:
            continue
        try:
            x, y, _, _, _, yaw = map(float, fields[2:])
            check_planar_pose(np.array([x, y, yaw]), "the pose", MAX_COORDINATE)
            stamps.append((stamp_from_seconds(fields[0]), stamp_from_seconds(fields[1])))
        except (ValueError, HmtSlamError):
            raise HmtSlamError(
                f"line {number} of {path} is not 't1 t2 x y z roll pitch yaw': mend that line."
            ) from None
        poses.append((x, y, yaw))
    if not stamps:
        raise HmtSlamError(f"{path} holds no relation: give a file of relations.")
    starts, ends = np.array(stamps, dtype=np.int64).T
    return Relations(starts, ends, np.array(poses))


def evaluate_folder(output_dir: Path, relations_file: Path, odometry_log: Path | None = None) -> RelationErrors:
    """Errors of the trajectory.tum of an output folder.

    :param odometry_log: its log, to extrapolate poses along the odometry where there is none within 0.1 s.
    :raises HmtSlamError: if one of the files cannot be read.
    """
    trajectory = read_tum(output_dir / "trajectory.tum")
    odometry = None if odometry_log is None else read_odometry_poses(open_log(odometry_log))
    return evaluate_relations(trajectory, read_relations(relations_file), odometry)


def evaluate_relations(
    trajectory: StampedPoses, relations: Relations, odometry: StampedPoses | None = None
) -> RelationErrors:
    """Errors of a trajectory over all relations and over the long ones; parameters as of :func:`pair_errors`."""
    errors = pair_errors(trajectory, relations, odometry)

    def score(chosen: NDArray[np.bool_]) -> RelationScore:
        kept = chosen & errors.is_matched
        return RelationScore(
            count=int(chosen.sum()),
            matched=int(kept.sum()),
            missed=int((chosen & ~errors.is_matched).sum()),
            extrapolated=int((kept & errors.is_extrapolated).sum()),
            translation=_statistics(errors.translation[kept]),
            rotation=_statistics(errors.rotation[kept]),
        )

    return RelationErrors(score(np.ones(errors.span.size, dtype=np.bool_)), score(errors.span > LONG_SPAN))


def pair_errors(trajectory: StampedPoses, relations: Relations, odometry: StampedPoses | None = None) -> PairErrors:
    """Errors of a trajectory at each relation.

    The pose at a stamp is the nearest one within 0.1 s. Else it is the nearest one, extrapolated along the odometry
    between the two times, if both have a reading within 0.1 s. Else the relation is missed.

    :param trajectory: under test, with source stamps.
    :param relations: the truth.
    :param odometry: raw wheel odometry with source stamps.
    """
    starts, start_found, start_extrapolated = _poses_at(relations.starts, trajectory, odometry)
    ends, end_found, end_extrapolated = _poses_at(relations.ends, trajectory, odometry)
    estimates = se2.between(starts, ends)
    return PairErrors(
        translation=np.hypot(*(estimates[:, :2] - relations.poses[:, :2]).T),
        rotation=np.rad2deg(np.abs(se2.wrap(estimates[:, 2] - relations.poses[:, 2]))),
        span=np.abs(relations.ends - relations.starts),
        is_matched=start_found & end_found,
        is_extrapolated=start_extrapolated | end_extrapolated,
    )


def _poses_at(
    stamps: NDArray[np.int64], trajectory: StampedPoses, odometry: StampedPoses | None
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Pose at each stamp (n, 3), whether there is one, and whether it was extrapolated along the odometry."""
    nearest = trajectory.nearest_indices(stamps)
    poses, times = trajectory.poses[nearest], trajectory.stamps[nearest]
    near = np.abs(times - stamps) <= MAX_TIME_GAP
    if odometry is None or not odometry.stamps.size:
        return poses, near, np.zeros_like(near)
    begin, end = odometry.nearest_indices(times), odometry.nearest_indices(stamps)
    covered = (np.abs(odometry.stamps[begin] - times) <= MAX_TIME_GAP) & (
        np.abs(odometry.stamps[end] - stamps) <= MAX_TIME_GAP
    )
    extrapolated = ~near & covered
    moved = se2.compose(poses, se2.between(odometry.poses[begin], odometry.poses[end]))
    return np.where(extrapolated[:, None], moved, poses), near | covered, extrapolated


def _statistics(errors: NDArray[np.float64]) -> ErrorStatistics:
    if not errors.size:
        return ErrorStatistics(np.nan, np.nan, np.nan, np.nan)
    std = float(np.std(errors, ddof=1)) if errors.size > 1 else 0.0
    return ErrorStatistics(float(np.mean(errors)), std, float(np.sqrt(np.mean(errors**2))), float(np.max(errors)))


def format_table(errors: RelationErrors) -> str:
    """The errors as a table of fixed-width lines, with the share of matched relations and the matching policy."""
    header = (
        f"{'relations':<10} {'matched':>18} {'carried':>8} "
        f"{'translation [m]':>18} {'rms':>7} {'max':>7} {'rotation [deg]':>18} {'rms':>7} {'max':>7}"
    )
    rows = [_table_row("all", errors.overall), _table_row("over 60 s", errors.over_60_s)]
    policy = "mean +- std; pose nearest in time within 0.1 s, else carried there along the odometry, else missed"
    return "\n".join([header, *rows, policy])


def _table_row(name: str, score: RelationScore) -> str:
    share = 100.0 * score.matched / score.count if score.count else 0.0
    matched = f"{score.matched}/{score.count} ({share:.1f} %)"
    errors = [
        f"{f'{e.mean:.3f} +- {e.std:.3f}':>18} {e.rms:>7.3f} {e.max:>7.3f}" for e in (score.translation, score.rotation)
    ]
    return f"{name:<10} {matched:>18} {score.extrapolated:>8} {errors[0]} {errors[1]}"


def true_relations(truth: StampedPoses) -> Relations:
    """True relations of the poses of every meter: to the next, to the tenth, and to an earlier visit of the place.

    The earlier pose is the nearest one within 3 m and more than 60 s before. In these relations a missed loop shows.

    :param truth: in the order of time.
    """
    steps = np.hypot(*np.diff(truth.poses[:, :2], axis=0).T)
    meters = np.floor(np.concatenate(([0.0], np.cumsum(steps))) / _SPACING)
    chosen = np.flatnonzero(np.diff(meters, prepend=-1.0) > 0.0)
    stamps, poses = truth.stamps[chosen], truth.poses[chosen]
    ahead = np.arange(len(chosen))
    pairs = [np.stack((ahead[:-gap], ahead[gap:]), axis=1) for gap in (1, _FAR) if len(chosen) > gap]
    starts, ends = np.concatenate([*pairs, _revisits(stamps, poses)]).T
    return Relations(stamps[starts], stamps[ends], se2.between(poses[starts], poses[ends]))


def _revisits(stamps: NDArray[np.int64], poses: NDArray[np.float64]) -> NDArray[np.intp]:
    """Pairs (n, 2) of an earlier pose and the later one that is nearest to it."""
    pairs = []
    for k in range(len(stamps)):
        long_ago = int(np.searchsorted(stamps, stamps[k] - LONG_SPAN, side="left"))
        if long_ago:
            distances = np.hypot(*(poses[:long_ago, :2] - poses[k, :2]).T)
            nearest = int(np.argmin(distances))
            if distances[nearest] < _SAME_PLACE_RADIUS:
                pairs.append((nearest, k))
    return np.array(pairs, dtype=np.intp).reshape(-1, 2)
