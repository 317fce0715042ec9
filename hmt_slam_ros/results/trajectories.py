"""Trajectories: a pose for every scan, in the final map and as it was estimated at the time of the scan."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Float64, Int64
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import NO_KEYFRAME, HybridMap
from hmt_slam_ros.messages.messages import ScanPoses
from hmt_slam_ros.messages.replica import FIRST_AREA

Trajectory = NDArray[np.float64]
"""Shape (scans, 3), ``map_T_base`` as (x, y, theta), m and rad, in the order of the log."""


class RelativeTrajectory(NamedTuple):
    """Poses of scans relative to keyframes.

    :ivar keyframes: shape (n,), reference keyframe of each scan, -1 for none.
    :ivar poses: shape (n, 3), ``keyframe_T_base``, m and rad.
    """

    keyframes: Int64
    poses: Float64

    @classmethod
    def empty(cls) -> RelativeTrajectory:
        """The trajectory of no scan."""
        return cls(np.zeros(0, np.int64), np.zeros((0, 3)))

    def relative_to(self, kept: Collection[int], poses: Mapping[int, Float64]) -> RelativeTrajectory:
        """The trajectory relative to some of the keyframes: others give way to the nearest of these.

        :param kept: at least one.
        :param poses: {keyframe: ``map_T_base``, shape (3,)} of these and of all that the scans are relative to.
        """
        keyframes, relative = self.keyframes.copy(), self.poses.copy()
        numbers = np.array(sorted(kept), dtype=np.int64)
        there = np.array([poses[keyframe] for keyframe in numbers.tolist()])
        for row in np.flatnonzero((keyframes != NO_KEYFRAME) & ~np.isin(keyframes, numbers)):
            pose = se2.compose(poses[int(keyframes[row])], relative[row])
            nearest = int(np.argmin(np.hypot(*(there - pose)[:, :2].T)))
            keyframes[row], relative[row] = numbers[nearest], se2.between(there[nearest], pose)
        return RelativeTrajectory(keyframes, relative)

    def replace_start(self, better: RelativeTrajectory, known: Collection[int]) -> RelativeTrajectory:
        """The trajectory with the poses of its first scans taken from another one.

        :param better: refined trajectory of the first scans.
        :param known: keyframes that exist; scans relative to others keep their poses.
        """
        keyframes, poses = self.keyframes.copy(), self.poses.copy()
        rows = np.flatnonzero(np.isin(better.keyframes, list(known)))
        keyframes[rows], poses[rows] = better.keyframes[rows], better.poses[rows]
        return RelativeTrajectory(keyframes, poses)

    def with_trajectory(
        self, trajectory: Trajectory, keyframes: Mapping[int, NDArray[np.float64]]
    ) -> RelativeTrajectory:
        """The same reference keyframes with the poses of a trajectory.

        :param keyframes: {keyframe: ``map_T_base``, shape (3,)}.
        """
        poses, known = self.poses.copy(), self.keyframes != NO_KEYFRAME
        map_T_keyframe = np.array([keyframes[keyframe] for keyframe in self.keyframes[known].tolist()])
        poses[known] = se2.between(map_T_keyframe, trajectory[known])
        return RelativeTrajectory(self.keyframes, poses)

    def areas(self, hybrid_map: HybridMap) -> Int64:
        """The area of each scan, shape (n,); of a scan without a pose, that of the one before it."""
        area_of = {keyframe: area for area in hybrid_map.area_ids() for keyframe in hybrid_map.keyframes(area)}
        known = np.flatnonzero(self.keyframes != NO_KEYFRAME)
        areas = np.array([area_of[keyframe] for keyframe in self.keyframes[known].tolist()], dtype=np.int64)
        before = np.searchsorted(known, np.arange(self.keyframes.size), side="right") - 1
        return areas[np.maximum(before, 0)]


class OnlineEstimate(NamedTuple):
    """The part of a ``LocalEstimate`` that is recorded.

    :ivar stamp: stamp of the scan, ns.
    :ivar area: the robot's area.
    :ivar pose: shape (3,), ``area_T_base``.
    :ivar odometry: shape (3,), ``odom_T_base``.
    """

    stamp: int
    area: int
    pose: NDArray[np.float64]
    odometry: NDArray[np.float64]


def relative_trajectory_of(stamps: NDArray[np.int64], messages: Sequence[ScanPoses]) -> RelativeTrajectory:
    """The trajectory of one hypothesis relative to its keyframes.

    :param stamps: shape (n,), stamps of all scans, ns, increasing.
    :param messages: messages of that hypothesis and its ancestors; of two poses of a scan the later one counts.
    :raises HmtSlamError: where the messages have no scan.
    """
    keyframes, poses = np.full(stamps.size, NO_KEYFRAME, dtype=np.int64), np.zeros((stamps.size, 3))
    for message in messages:
        rows = _rows_of_stamps(stamps, message.stamps)
        keyframes[rows], poses[rows] = message.keyframes, message.poses
    if not (keyframes != NO_KEYFRAME).any():
        raise HmtSlamError(f"none of the {len(poses)} scans gave a pose: check the ranges and the odometry of the log")
    return RelativeTrajectory(keyframes, poses)


def trajectory_in_map(scans: RelativeTrajectory, keyframes: Mapping[int, NDArray[np.float64]]) -> Trajectory:
    """``map_T_base`` = ``map_T_keyframe`` * ``keyframe_T_base`` of every scan.

    :param keyframes: {keyframe: ``map_T_base``, shape (3,)}.
    """
    poses = np.full(scans.poses.shape, np.nan)
    known = scans.keyframes != NO_KEYFRAME
    map_T_keyframe = np.array([keyframes[keyframe] for keyframe in scans.keyframes[known].tolist()])
    poses[known] = se2.compose(map_T_keyframe, scans.poses[known])
    return _fill_gaps(poses)


def complete_trajectory(stamps: NDArray[np.int64], given: NDArray[np.int64], poses: Trajectory) -> Trajectory:
    """A pose for every scan, interpolated between given ones.

    :param stamps: shape (n,), stamps of all scans, ns, increasing.
    :param given: shape (m,), stamps of the scans with given poses.
    :param poses: shape (m, 3), the given poses.
    :raises HmtSlamError: where a given stamp belongs to no scan, or no pose is given.
    """
    trajectory = np.full((stamps.size, 3), np.nan)
    trajectory[_rows_of_stamps(stamps, given)] = poses
    return _fill_gaps(trajectory)


class AreaPoseUpdate(NamedTuple):
    """The poses of areas in TLCA's answer to a keyframe event.

    :ivar stamp: stamp of the keyframe's scan, ns.
    :ivar area_poses: {area: ``map_T_area``, shape (3,)}, empty where unchanged.
    """

    stamp: int
    area_poses: Mapping[int, NDArray[np.float64]]


def online_trajectory(
    estimates: Sequence[OnlineEstimate],
    updates: Sequence[AreaPoseUpdate],
    area_poses: Mapping[int, NDArray[np.float64]],
    previous: tuple[NDArray[np.float64], NDArray[np.float64]] | None,
) -> Trajectory:
    """``map_T_base`` of scans as it was estimated at the time of each scan, shape (n, 3).

    An update holds for the scans after its keyframe. In an area without a pose the odometry continues the last pose.

    :param estimates: estimates of the n scans, in their order.
    :param updates: poses of areas, in the order of their stamps.
    :param area_poses: {area: ``map_T_area``} of the last update before these; empty before the first.
    :param previous: ``map_T_base`` and ``odom_T_base``, shape (3,), of the scan before these; None before the first.
    """
    area_poses = area_poses or {FIRST_AREA: np.zeros(3)}
    poses, applied = np.zeros((len(estimates), 3)), 0
    for k, estimate in enumerate(estimates):
        while applied < len(updates) and updates[applied].stamp < estimate.stamp:
            area_poses = updates[applied].area_poses or area_poses
            applied += 1
        if estimate.area in area_poses or previous is None:
            poses[k] = se2.compose(area_poses.get(estimate.area, np.zeros(3)), estimate.pose)
        else:
            poses[k] = se2.compose(previous[0], se2.between(previous[1], estimate.odometry))
        previous = (poses[k], estimate.odometry)
    return poses


def _rows_of_stamps(stamps: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.intp]:
    """Numbers of the scans with given stamps.

    :raises HmtSlamError: where no scan has a given stamp.
    """
    rows = np.minimum(np.searchsorted(stamps, wanted), stamps.size - 1)
    unknown = wanted[stamps[rows] != wanted]
    if unknown.size:
        raise HmtSlamError(f"a scan of stamp {unknown[0]} ns is not in the log: stop other sources of /scan")
    return rows


def _fill_gaps(poses: Trajectory) -> Trajectory:
    """The poses with NaN replaced by interpolation between neighbors, or by the nearest pose at either end."""
    known = np.flatnonzero(~np.isnan(poses[:, 0]))
    if known.size == 0:
        raise HmtSlamError(f"none of the {len(poses)} scans gave a pose: check the ranges and the odometry of the log")
    index = np.arange(len(poses), dtype=np.float64)
    position = np.interp(index, known, np.arange(known.size))
    before = np.floor(position).astype(np.int64)
    after = np.minimum(before + 1, known.size - 1)
    between = se2.interpolate(poses[known[before]], poses[known[after]], position - before)
    return np.where(np.isnan(poses), between, poses)
