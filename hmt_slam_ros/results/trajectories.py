"""A pose for every scan of the log, in the final map and as it was known at the time."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.messages import ScanPoses
from hmt_slam_ros.messages.replica import FIRST_AREA

Trajectory = NDArray[np.float64]
"""Shape (scans, 3), ``map_T_base`` as (x, y, theta), m and rad, in the order of the log."""


class RelativeTrajectory(NamedTuple):
    """Where the scans of a log were taken, relative to keyframes.

    :ivar keyframes: shape (n,), the keyframe to which a scan is related, -1 for none.
    :ivar poses: shape (n, 3), ``keyframe_T_base``, m and rad.
    """

    keyframes: Int64
    poses: Float64

    @classmethod
    def empty(cls) -> RelativeTrajectory:
        """Of no scan."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)))

    def replace_start(self, better: RelativeTrajectory, known: Collection[int]) -> RelativeTrajectory:
        """The same with the first scans where they are better known to be, relative to keyframes that are known."""
        keyframes, poses = self.keyframes.copy(), self.poses.copy()
        rows = np.flatnonzero(np.isin(better.keyframes, list(known)))
        keyframes[rows], poses[rows] = better.keyframes[rows], better.poses[rows]
        return RelativeTrajectory(keyframes, poses)

    def with_trajectory(
        self, trajectory: Trajectory, keyframes: Mapping[int, NDArray[np.float64]]
    ) -> RelativeTrajectory:
        """The same scans where a trajectory has them.

        :param keyframes: {keyframe: ``map_T_base``, shape (3,)}.
        """
        poses, known = self.poses.copy(), self.keyframes >= 0
        map_T_keyframe = np.array([keyframes[keyframe] for keyframe in self.keyframes[known].tolist()])
        poses[known] = se2.between(map_T_keyframe, trajectory[known])
        return RelativeTrajectory(self.keyframes, poses)


class OnlineEstimate(NamedTuple):
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


def relative_trajectory_of(stamps: NDArray[np.int64], trails: Sequence[ScanPoses]) -> RelativeTrajectory:
    """The scans of one hypothesis relative to its keyframes.

    :param stamps: shape (n,), of all scans, ns, increasing.
    :param trails: of one hypothesis; where two speak of the same scan the later one counts.
    :raises HmtSlamError: where no trail holds any scan.
    """
    keyframes, poses = np.full(stamps.size, -1, dtype=np.int64), np.zeros((stamps.size, 3))
    for trail in trails:
        rows = _rows_of_stamps(stamps, trail.stamps)
        keyframes[rows], poses[rows] = trail.keyframes, trail.poses
    if not (keyframes >= 0).any():
        raise HmtSlamError(f"none of the {len(poses)} scans gave a pose: check the ranges and the odometry of the log")
    return RelativeTrajectory(keyframes, poses)


def trajectory_in_map(scans: RelativeTrajectory, keyframes: Mapping[int, NDArray[np.float64]]) -> Trajectory:
    """``map_T_keyframe`` * ``keyframe_T_base`` of every scan.

    :param keyframes: {keyframe: ``map_T_base``, shape (3,)}.
    """
    poses = np.full(scans.poses.shape, np.nan)
    known = scans.keyframes >= 0
    map_T_keyframe = np.array([keyframes[keyframe] for keyframe in scans.keyframes[known].tolist()])
    poses[known] = se2.compose(map_T_keyframe, scans.poses[known])
    return _fill_gaps(poses)


def complete_trajectory(stamps: NDArray[np.int64], given: NDArray[np.int64], poses: Trajectory) -> Trajectory:
    """A pose for every scan, of which some are given.

    :param stamps: shape (n,), of all scans, ns, increasing.
    :param given: shape (m,), stamps of those whose poses are given.
    :param poses: shape (m, 3), these poses.
    :raises HmtSlamError: where a stamp is of none of the scans, or no pose is given.
    """
    found = np.full((stamps.size, 3), np.nan)
    found[_rows_of_stamps(stamps, given)] = poses
    return _fill_gaps(found)


class AreaPoseUpdate(NamedTuple):
    """TLCA's answer to a keyframe event.

    :ivar stamp: of the keyframe's scan, ns.
    :ivar area_poses: {area: ``map_T_area``, shape (3,)}, empty where they stay as they were.
    """

    stamp: int
    area_poses: Mapping[int, NDArray[np.float64]]


class OnlineTrajectory:
    """``map_T_base`` of one scan after the other from what was known when it was taken.

    The verdict on a keyframe holds for the scans after it. In an area that no verdict has placed yet, the pose goes on
    from the one before it along the odometry.
    """

    def __init__(
        self, areas: Mapping[int, NDArray[np.float64]], previous: tuple[NDArray[np.float64], NDArray[np.float64]] | None
    ) -> None:
        """:param areas: {area: ``map_T_area``}, of the last verdict that gave any; empty before the first.

        :param previous: of the scan before, ``map_T_base`` and ``odom_T_base``, shape (3,); None before the first.
        """
        self._area_poses = areas or {FIRST_AREA: np.zeros(3)}
        self._previous = previous

    def advance(self, estimates: Sequence[OnlineEstimate], updates: Sequence[AreaPoseUpdate]) -> Trajectory:
        """The poses of the scans to come, shape (n, 3)."""
        poses, given = np.zeros((len(estimates), 3)), 0
        for k, estimate in enumerate(estimates):
            while given < len(updates) and updates[given].stamp < estimate.stamp:
                self._area_poses = updates[given].area_poses or self._area_poses
                given += 1
            poses[k] = self._pose_in_map(estimate)
            self._previous = (poses[k], estimate.odometry)
        return poses

    def _pose_in_map(self, estimate: OnlineEstimate) -> NDArray[np.float64]:
        if estimate.area in self._area_poses or self._previous is None:
            return se2.compose(self._area_poses.get(estimate.area, np.zeros(3)), estimate.pose)
        return se2.compose(self._previous[0], se2.between(self._previous[1], estimate.odometry))


def _rows_of_stamps(stamps: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.intp]:
    """The scans that have the given stamps."""
    rows = np.minimum(np.searchsorted(stamps, wanted), stamps.size - 1)
    strange = wanted[stamps[rows] != wanted]
    if strange.size:
        raise HmtSlamError(f"a scan of stamp {strange[0]} ns is not in the log: stop other sources of /scan")
    return rows


def _fill_gaps(poses: Trajectory) -> Trajectory:
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
