"""What a filter of one hypothesis in its current area is to metric SLAM, whatever its map is made of."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from hmt_slam_ros.arrays import Float64, Int32
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.registration.consistency import ClutterEstimate, MapAgreement
from hmt_slam_ros.registration.match_covariance import MatchError
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import Prediction, RelativeMotion
from hmt_slam_ros.submap.line_map_state import LineMapState
from hmt_slam_ros.submap.local_mapping import PreparedScan


@dataclass(frozen=True, eq=False)
class ParticleFilterState:
    """M particles of one hypothesis in one area; the map frame is that of the area.

    :ivar hypothesis: id of the hypothesis.
    :ivar area: the current area.
    :ivar poses: shape (M, 3), ``map_T_base``, m and rad.
    :ivar log_weights: shape (M,), nats, the largest is 0.
    :ivar keyframes: the local map's keyframes, ids.
    :ivar keyframe_areas: their areas.
    :ivar keyframe_poses: shape (M, K, 3), ``map_T_base`` of each under each particle.
    :ivar tables: shape (M, T, T), of each particle's map the numbers of its patches, [row, column], -1 for one never
        seen; the origin lies at the corner between the four middle ones.
    :ivar predicted_poses: shape (M, 3), the poses as predicted by odometry and inertia since the last filter step.
    :ivar last_poses: shape (M, 3), those at the last filter step.
    :ivar motion_since_update: the predicted motion since then.
    :ivar leader: the particle whose pose is the filter's.
    :ivar tracking_covariance: of the leader's motion since the last filter step, shape (3, 3), right tangent frame.
    :ivar residual_covariance: covariance of the leader's pose that the scans since the last filter step leave,
        likewise.
    :ivar clutter_estimate: of the scans so far.
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
    motion_since_update: RelativeMotion
    leader: int
    tracking_covariance: Float64
    residual_covariance: Float64
    clutter_estimate: ClutterEstimate


@dataclass(frozen=True, eq=False)
class LineFilterState:
    """The belief of one hypothesis in one area whose local map is one of lines; its frame is that of the area.

    :ivar hypothesis: id of the hypothesis.
    :ivar area: the current area.
    :ivar line_map: over the robot's pose and the lines; its marks are the pose at the last filter step, and the
        keyframes'.
    :ivar keyframes: the local map's keyframes, ids.
    :ivar keyframe_areas: their areas.
    :ivar reported_poses: shape (K, 3), ``map_T_base`` of each as it was told, m and rad.
    :ivar last_covariance: of the robot's pose at the last filter step, shape (3, 3), right tangent frame.
    :ivar motion_since_update: the predicted motion since then.
    :ivar information: of the newest scan's known lines alone, in the frame of the pose, shape (3, 3).
    :ivar tracking_covariance: of the motion since the last filter step, shape (3, 3), right tangent frame.
    :ivar clutter_estimate: of the scans so far.
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
    """What tracking made of a prediction.

    :ivar increment: the matched motion, ``start_T_end``, shape (3,).
    :ivar information: of the match, for correlated beams, in the frame of its end, shape (3, 3).
    :ivar contradicts_odometry: whether there was odometry and the scan contradicts it.
    """

    increment: Float64
    information: Float64
    contradicts_odometry: bool


@dataclass(frozen=True, eq=False)
class FilterStep:
    """What a filter step found.

    :ivar increment: the motion of what leads since the last step, ``start_T_end``, shape (3,).
    :ivar match_error: of that motion.
    :ivar information: of the match alone, for correlated beams, in the frame of the pose, shape (3, 3).
    :ivar effective_samples: ESS before resampling.
    :ivar keyframes_moved: whether keyframe poses differ from those told.
    """

    increment: Float64
    match_error: MatchError
    information: Float64
    effective_samples: float
    keyframes_moved: bool


class LocalFilter(Protocol):
    """The belief over the robot's pose and the map of what is around it; the map frame is that of the area.

    :ivar hypothesis: id of the hypothesis.
    :ivar area: the current area.
    :ivar keyframes: the local map's keyframes, ids.
    :ivar keyframe_areas: their areas.
    :ivar tracking_covariance: of the motion since the last filter step, shape (3, 3), right tangent frame.
    :ivar clutter_estimate: of the scans so far.
    """

    hypothesis: int
    area: int
    keyframes: list[int]
    keyframe_areas: list[int]
    tracking_covariance: Float64
    clutter_estimate: ClutterEstimate

    @property
    def state(self) -> ParticleFilterState | LineFilterState:
        """All that the filter remembers."""
        ...

    @property
    def pose(self) -> Float64:
        """``map_T_base``, shape (3,)."""
        ...

    @property
    def poses(self) -> Float64:
        """``map_T_base`` of its samples, shape (M, 3)."""
        ...

    def leading_keyframe_poses(self) -> Float64:
        """``map_T_base`` of the local map's keyframes, shape (K, 3)."""
        ...

    def branch(self, hypothesis: int) -> LocalFilter:
        """A filter of the same state for a child hypothesis."""
        ...

    def release(self) -> None:
        """Give up the map; the filter is not used any more."""
        ...

    def initialize(self, pose: PoseGaussian) -> None:
        """The robot stands at ``map_T_base``, known so well, and is predicted from there."""
        ...

    def track(self, prepared: PreparedScan, prediction: Prediction) -> TrackedMotion:
        """A pose for a scan between two keyframes."""
        ...

    def update(self, prepared: PreparedScan, step: int) -> FilterStep:
        """The filter step with a keyframe's scan, which was tracked before.

        :param step: number of the keyframe event, for the random streams.
        """
        ...

    def compare_scan(self, prepared: PreparedScan) -> MapAgreement:
        """A scan in the map, where that has the robot."""
        ...

    def add_keyframe(self, keyframe: int, scan: Scan) -> None:
        """Enter a scan into the map where the robot is."""
        ...

    def drop_keyframes(self, keyframes: Collection[int]) -> None:
        """Forget keyframes, but not what the map holds of them."""
        ...

    def change_area(self, area: int, area_T_previous: Float64, content: Sequence[PlacedKeyframe]) -> None:
        """Go over to the frame of another area and load its local map.

        :param area: the area now.
        :param area_T_previous: shape (3,).
        :param content: all keyframes of the local map, in the new frame.
        """
        ...

    def reload(self, content: Sequence[PlacedKeyframe], anchor: int) -> None:
        """Build the local map anew after its keyframes moved; the robot stays where it is from one of them.

        :param content: all keyframes of the local map.
        :param anchor: the keyframe by which the robot's place is known.
        """
        ...


class FilterFactory(Protocol):
    """Makes filters, and chooses their kind for each area."""

    def new(self, hypothesis: int, area: int) -> LocalFilter:
        """A filter that knows nothing yet."""
        ...

    def restore(self, state: ParticleFilterState | LineFilterState) -> LocalFilter:
        """The filter of a state; the patches of grids are in the pool.

        :raises HmtSlamError: for a state of a kind that this factory does not make.
        """
        ...

    def select(self, own: LocalFilter, area: int, content: Sequence[PlacedKeyframe]) -> LocalFilter:
        """The filter to go on with: ``own``, or one of another kind that has the robot where ``own`` has it.

        It knows nothing of what is around the robot until it changes to the area. ``own`` is given up if it is not it.

        :param area: the one that is entered.
        :param content: keyframes in its frame, of which those of the area tell what it is.
        """
        ...
