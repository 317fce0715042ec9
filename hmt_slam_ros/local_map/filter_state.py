"""What a filter remembers, as a value."""

from __future__ import annotations

from dataclasses import dataclass

from hmt_slam_ros.arrays import Float64, Int32
from hmt_slam_ros.features.line_map_state import LineMapState
from hmt_slam_ros.local_map.judgement import Experience
from hmt_slam_ros.sensing.motion import Step


@dataclass(frozen=True, eq=False)
class FilterState:
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
    :ivar priors: shape (M, 3), the poses as predicted by odometry and inertia since the last filter step.
    :ivar last_poses: shape (M, 3), those at the last filter step.
    :ivar since_update: the predicted motion since then.
    :ivar leader: the particle whose pose is the filter's.
    :ivar tracking_covariance: of the leader's motion since the last filter step, shape (3, 3), right tangent frame.
    :ivar left_open: covariance of the leader's pose that the scans since the last filter step leave, likewise.
    :ivar experience: of the scans so far.
    """

    hypothesis: int
    area: int
    poses: Float64
    log_weights: Float64
    keyframes: tuple[int, ...]
    keyframe_areas: tuple[int, ...]
    keyframe_poses: Float64
    tables: Int32
    priors: Float64
    last_poses: Float64
    since_update: Step
    leader: int
    tracking_covariance: Float64
    left_open: Float64
    experience: Experience


@dataclass(frozen=True, eq=False)
class LineFilterState:
    """The belief of one hypothesis in one area whose local map is one of lines; its frame is that of the area.

    :ivar hypothesis: id of the hypothesis.
    :ivar area: the current area.
    :ivar room: over the robot's pose and the lines; its marks are the pose at the last filter step, and the keyframes'.
    :ivar keyframes: the local map's keyframes, ids.
    :ivar keyframe_areas: their areas.
    :ivar told: shape (K, 3), ``map_T_base`` of each as it was told, m and rad.
    :ivar last_covariance: of the robot's pose at the last filter step, shape (3, 3), right tangent frame.
    :ivar since_update: the predicted motion since then.
    :ivar information: of the newest scan's known lines alone, in the frame of the pose, shape (3, 3).
    :ivar tracking_covariance: of the motion since the last filter step, shape (3, 3), right tangent frame.
    :ivar experience: of the scans so far.
    """

    hypothesis: int
    area: int
    room: LineMapState
    keyframes: tuple[int, ...]
    keyframe_areas: tuple[int, ...]
    told: Float64
    last_covariance: Float64
    since_update: Step
    information: Float64
    tracking_covariance: Float64
    experience: Experience
