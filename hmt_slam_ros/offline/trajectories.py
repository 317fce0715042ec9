"""A pose for every scan of the log, in the final map and as it was known at the time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.processes.messages import Accepted, Keyframe, Trail
from hmt_slam_ros.processes.replica import FIRST_AREA

Trajectory = NDArray[np.float64]
"""Shape (scans, 3), ``map_T_base`` as (x, y, theta), m and rad, in the order of the log."""


class Anchored(NamedTuple):
    """Where the scans of a log were taken, relative to keyframes.

    :ivar keyframes: shape (n,), the keyframe to which a scan is related, -1 for none.
    :ivar poses: shape (n, 3), ``keyframe_T_base``, m and rad.
    """

    keyframes: NDArray[np.int64]
    poses: Trajectory


class OnlinePose(NamedTuple):
    """What is kept of a ``LocalEstimate``.

    :ivar stamp: the scan's, ns.
    :ivar area: the robot's.
    :ivar pose: shape (3,), ``area_T_base``.
    :ivar odometry: shape (3,), ``odom_T_base``.
    """

    stamp: int
    area: int
    pose: NDArray[np.float64]
    odometry: NDArray[np.float64]


def anchored(stamps: NDArray[np.int64], trails: Sequence[Trail]) -> Anchored:
    """The scans of one hypothesis relative to its keyframes.

    :param stamps: shape (n,), of all scans, ns, increasing.
    :param trails: of one hypothesis; where two speak of the same scan the later one counts.
    :raises HmtSlamError: where no trail holds any scan.
    """
    keyframes, poses = np.full(stamps.size, -1, dtype=np.int64), np.zeros((stamps.size, 3))
    for trail in trails:
        rows = _rows(stamps, trail.stamps)
        keyframes[rows], poses[rows] = trail.anchors, trail.poses
    if not (keyframes >= 0).any():
        raise HmtSlamError(f"none of the {len(poses)} scans gave a pose: check the ranges and the odometry of the log")
    return Anchored(keyframes, poses)


def carried(scans: Anchored, keyframes: Mapping[int, NDArray[np.float64]]) -> Trajectory:
    """``map_T_keyframe`` * ``keyframe_T_base`` of every scan.

    :param keyframes: {keyframe: ``map_T_base``, shape (3,)}.
    """
    poses = np.full(scans.poses.shape, np.nan)
    known = scans.keyframes >= 0
    map_T_keyframe = np.array([keyframes[keyframe] for keyframe in scans.keyframes[known].tolist()])
    poses[known] = se2.compose(map_T_keyframe, scans.poses[known])
    return _filled(poses)


def odometry_trajectory(stamps: NDArray[np.int64], estimates: Mapping[int, OnlinePose]) -> Trajectory:
    """``odom_T_base`` at every scan, shape (n, 3).

    :param stamps: shape (n,), of all scans, ns, increasing.
    """
    poses = np.full((stamps.size, 3), np.nan)
    given = list(estimates.values())
    poses[_rows(stamps, np.array([estimate.stamp for estimate in given], dtype=np.int64))] = np.array(
        [estimate.odometry for estimate in given]
    )
    return _filled(poses)


def online_trajectory(
    stamps: NDArray[np.int64],
    estimates: Mapping[int, OnlinePose],
    keyframes: Sequence[Keyframe],
    accepted: Sequence[Accepted],
) -> Trajectory:
    """``map_T_base`` of every scan from what was known when it was taken.

    The verdict on a keyframe holds for the scans after it. In an area that no verdict has placed yet, the pose goes on
    from the one before it along the odometry.

    :param stamps: shape (n,), of all scans, ns, increasing.
    """
    poses = np.full((stamps.size, 3), np.nan)
    rows = _rows(stamps, np.array([estimates[index].stamp for index in sorted(estimates)], dtype=np.int64))
    areas = {FIRST_AREA: np.zeros(3)}
    verdicts, previous = 0, None
    for row, index in zip(rows, sorted(estimates), strict=True):
        estimate = estimates[index]
        while verdicts < len(keyframes) and keyframes[verdicts].scan.stamp < estimate.stamp:
            given = accepted[verdicts].global_poses
            areas = {entry.area: entry.pose.mean for entry in given} if given else areas
            verdicts += 1
        if estimate.area in areas or previous is None:
            pose = se2.compose(areas.get(estimate.area, np.zeros(3)), estimate.pose)
        else:
            pose = se2.compose(previous[0], se2.between(previous[1], estimate.odometry))
        poses[row] = pose
        previous = (pose, estimate.odometry)
    return _filled(poses)


def _rows(stamps: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.intp]:
    """The scans that have the given stamps."""
    rows = np.minimum(np.searchsorted(stamps, wanted), stamps.size - 1)
    strange = wanted[stamps[rows] != wanted]
    if strange.size:
        raise HmtSlamError(f"a scan of stamp {strange[0]} ns is not in the log: stop other sources of /scan")
    return rows


def _filled(poses: Trajectory) -> Trajectory:
    """Scans without a pose get one between their neighbours in the log, or the nearest one at either end."""
    known = np.flatnonzero(~np.isnan(poses[:, 0]))
    if known.size == 0:
        raise HmtSlamError(f"none of the {len(poses)} scans gave a pose: check the ranges and the odometry of the log")
    index = np.arange(len(poses), dtype=np.float64)
    position = np.interp(index, known, np.arange(known.size))
    before = np.floor(position).astype(np.int64)
    after = np.minimum(before + 1, known.size - 1)
    between = se2.interpolate(poses[known[before]], poses[known[after]], position - before)
    return np.where(np.isnan(poses), between, poses)
