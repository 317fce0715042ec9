"""The protocol of the filters of metric SLAM, whatever their maps are made of, and their states as values."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from hmt_slam_ros.arrays import Float64, Int32, Int64
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.registration.consistency import ClutterEstimate, MapAgreement
from hmt_slam_ros.registration.match_covariance import MatchError
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import RelativeMotion
from hmt_slam_ros.submap.line_map_state import LineMapState
from hmt_slam_ros.submap.local_mapping import PreparedScan


@dataclass(frozen=True, eq=False)
class TrackedMode:
    """A mode of the pose, whose particles are matched together between two filter steps.

    :ivar motion_since_update: the predicted motion since the last filter step.
    :ivar residual_covariance: of the pose after the scans since the last filter step, shape (3, 3), right tangent
        frame.
    :ivar counted_evidence: of matches since the last filter step, in the weights until the next one, which counts that
        of its own scan, nats.
    :ivar shows_map: whether the last scan showed anything of the map.
    """

    motion_since_update: RelativeMotion
    residual_covariance: Float64
    counted_evidence: float = 0.0
    shows_map: bool = True


@dataclass(frozen=True, eq=False)
class ParticleFilterState:
    """State of M particles of one hypothesis in one area; the map frame is that of the area.

    :ivar hypothesis: id of the hypothesis.
    :ivar area: the current area.
    :ivar poses: shape (M, 3), ``map_T_base``, m and rad.
    :ivar log_weights: shape (M,), nats, the largest is 0.
    :ivar keyframes: the local map's keyframes, ids.
    :ivar keyframe_areas: their areas.
    :ivar keyframe_poses: shape (M, K, 3), ``map_T_base`` of each under each particle.
    :ivar tables: shape (M, T, T), numbers of the patches of each particle's map, [row, column], -1 for a patch never
        seen; the origin is the corner between the four middle patches.
    :ivar predicted_poses: shape (M, 3), the poses as predicted by odometry and inertia since the last filter step.
    :ivar last_poses: shape (M, 3), the poses at the last filter step.
    :ivar modes: the modes between which the weights have yet to decide, mostly one.
    :ivar members: shape (M,), number of the mode of each particle.
    :ivar leader: number of the particle whose pose is the filter's.
    :ivar tracking_covariance: of the motion since the last filter step, under all modes, shape (3, 3), right tangent
        frame.
    :ivar clutter_estimate: usual contradictions of scans so far.
    """

    hypothesis: int
    area: int
    poses: Float64
    log_weights: Float64
    keyframes: tuple[int, ...]
    keyframe_areas: tuple[int, ...]
    keyframe_poses: Float64
    tables: Int32
    predicted_poses: Float64
    last_poses: Float64
    modes: tuple[TrackedMode, ...]
    members: Int64
    leader: int
    tracking_covariance: Float64
    clutter_estimate: ClutterEstimate


@dataclass(frozen=True, eq=False)
class LineFilterState:
    """State of the line filter of one hypothesis in one area; the map frame is that of the area.

    :ivar hypothesis: id of the hypothesis.
    :ivar area: the current area.
    :ivar line_map: belief over the robot's pose and the lines; its clones are the pose at the last filter step, and
        those of the keyframes.
    :ivar keyframes: the local map's keyframes, ids.
    :ivar keyframe_areas: their areas.
    :ivar reported_poses: shape (K, 3), ``map_T_base`` of each as last published, m and rad.
    :ivar last_covariance: of the robot's pose at the last filter step, shape (3, 3), right tangent frame.
    :ivar motion_since_update: the predicted motion since the last filter step.
    :ivar information: of the newest scan's known lines alone, in the frame of the pose, shape (3, 3).
    :ivar tracking_covariance: of the motion since the last filter step, shape (3, 3), right tangent frame.
    :ivar clutter_estimate: usual contradictions of scans so far.
    """

    hypothesis: int
    area: int
    line_map: LineMapState
    keyframes: tuple[int, ...]
    keyframe_areas: tuple[int, ...]
    reported_poses: Float64
    last_covariance: Float64
    motion_since_update: RelativeMotion
    information: Float64
    tracking_covariance: Float64
    clutter_estimate: ClutterEstimate


@dataclass(frozen=True, eq=False)
class PlacedKeyframe:
    """A keyframe of the local map: its id, its area, its scan and ``map_T_base``, shape (3,)."""

    keyframe: int
    area: int
    scan: Scan
    pose: Float64


class TrackedMotion(NamedTuple):
    """Result of tracking: the matched motion since the last scan.

    :ivar increment: the matched motion, ``start_T_end``, shape (3,).
    :ivar information: of the match, for correlated beams, in the frame of its end, shape (3, 3).
    :ivar contradicts_odometry: whether the scan contradicts the odometry, if there was any.
    """

    increment: Float64
    information: Float64
    contradicts_odometry: bool


@dataclass(frozen=True, eq=False)
class FilterStep:
    """Result of a filter step.

    :ivar increment: the motion since the last step, ``start_T_end``, shape (3,).
    :ivar match_error: covariances of that motion.
    :ivar information: of the match alone, for correlated beams, in the frame of the pose, shape (3, 3).
    :ivar effective_samples: ESS before resampling.
    :ivar keyframes_moved: whether keyframe poses differ from those published.
    :ivar mode_count: number of modes of the pose.
    """

    increment: Float64
    match_error: MatchError
    information: Float64
    effective_samples: float
    keyframes_moved: bool
    mode_count: int = 1


class LocalFilter(Protocol):
    """The belief over the robot's pose and its submap; the map frame is that of the area.

    :ivar hypothesis: id of the hypothesis.
    :ivar area: the current area.
    :ivar keyframes: the local map's keyframes, ids.
    :ivar keyframe_areas: their areas.
    :ivar tracking_covariance: of the motion since the last filter step, shape (3, 3), right tangent frame.
    :ivar clutter_estimate: usual contradictions of scans so far.
    """

    hypothesis: int
    area: int
    keyframes: list[int]
    keyframe_areas: list[int]
    tracking_covariance: Float64
    clutter_estimate: ClutterEstimate

    @property
    def state(self) -> ParticleFilterState | LineFilterState:
        """The whole state, as a value."""

    @property
    def pose(self) -> Float64:
        """``map_T_base``, shape (3,)."""

    @property
    def poses(self) -> Float64:
        """``map_T_base`` of its samples, shape (M, 3)."""

    def leading_keyframe_poses(self) -> Float64:
        """``map_T_base`` of the local map's keyframes, shape (K, 3)."""

    def branch(self, hypothesis: int) -> LocalFilter:
        """A filter of the same state for a child hypothesis."""

    def release(self) -> None:
        """Free the map; the filter is not used afterwards."""

    def initialize(self, pose: PoseGaussian) -> None:
        """Set the belief over ``map_T_base``, and predict from there."""

    def track(self, prepared: PreparedScan, prediction: Prediction) -> TrackedMotion:
        """Match a scan between two keyframes. It replaces what it changes, so that a shallow copy can track instead."""

    def update(self, prepared: PreparedScan, step: int) -> FilterStep:
        """The filter step with the scan of a keyframe, which was tracked before.

        :param step: number of the keyframe event, for the random streams.
        """

    def compare_scan(self, prepared: PreparedScan) -> MapAgreement:
        """Agreement of a scan with the map, at the current pose."""

    def add_keyframe(self, keyframe: int, scan: Scan) -> None:
        """Insert a scan into the map at the current pose."""

    def drop_keyframes(self, keyframes: Collection[int]) -> None:
        """Remove keyframes, but not their scans from the map."""

    def change_area(self, area: int, area_T_previous: Float64, content: Sequence[PlacedKeyframe]) -> None:
        """Change to the frame of another area and load its local map.

        :param area: the area now.
        :param area_T_previous: shape (3,).
        :param content: all keyframes of the local map, in the new frame.
        """

    def reload(self, content: Sequence[PlacedKeyframe], anchor: int) -> None:
        """Rebuild the local map after its keyframes moved; the pose of the robot in one of them stays.

        :param content: all keyframes of the local map.
        :param anchor: the keyframe relative to which the robot stays.
        """


class FilterFactory(Protocol):
    """Makes filters, and selects their kind for each area."""

    def new(self, hypothesis: int, area: int) -> LocalFilter:
        """A filter with an empty map."""

    def restore(self, state: ParticleFilterState | LineFilterState) -> LocalFilter:
        """The filter of a state; the patches of grids are in the pool.

        :raises HmtSlamError: for a state of a kind that this factory does not make.
        """

    def select(self, own: LocalFilter, area: int, content: Sequence[PlacedKeyframe]) -> LocalFilter:
        """The filter for the next area: ``own``, or a filter of another kind with the same belief over the pose.

        A new filter has an empty map until it changes to the area, and ``own`` is released.

        :param area: the area that is entered.
        :param content: keyframes in its frame; those of the area show its kind.
        """
