"""The messages between the processes, as immutable values.

Scans, odometry and marks are :class:`~hmt_slam_ros.sensors.Scan`, :class:`~hmt_slam_ros.sensors.Odometry` and
:class:`~hmt_slam_ros.sensors.MarkObservation`. A *keyframe event* k starts the chain Keyframe(k) -> AreaEvents(k) ->
Hypotheses(k) -> ClosureDecision(k). After it metric SLAM processes the scans that waited.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.ambiguity import Ambiguity
from hmt_slam_ros.messages.map_changes import (
    Arc,
    ArcEnds,
    AreaMerge,
    AreaPose,
    ForeignGround,
    InitialPose,
    LocalArea,
    MovedKeyframe,
    Pose,
    PrunedKeyframe,
    StaleBeams,
)
from hmt_slam_ros.messages.statements import PlaceStatement, WeighedStatement
from hmt_slam_ros.messages.tasks import GoalPose, PlaceEstimate, Task, TaskResult, VelocityCommand
from hmt_slam_ros.messages.team import JoinedGround, TeamGoal, TeamMessage
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.sensors import MarkObservation, Odometry, Scan

MotionCondition = Literal["ordinary", "after_gap", "uncertain"]
"""What the motion since the last keyframe event rests on.

"ordinary": scans and odometry agree, or scans alone show it. "after_gap": scans were missing for a while, or stamps go
back by as much. "uncertain": scans contradict the odometry, or show so little that the motion is wide.
"""


@dataclass(frozen=True, eq=False, slots=True)
class HypothesisEstimate:
    """The estimate of metric SLAM for a live hypothesis at a keyframe event.

    :ivar hypothesis: id of the live hypothesis.
    :ivar area: the robot's area, gamma_t.
    :ivar pose: belief over ``area_T_base`` at the keyframe. Its covariance is the drift since the area's origin, or
        the uncertainty of localization on mapped ground.
    :ivar stored: whether the keyframe is stored in the hypothesis's map; False where it is redundant.
    :ivar log_evidence: log-likelihood ratio of the keyframe's scan at the pose of this hypothesis to a similar place,
        nats, of this keyframe alone.
    :ivar log_kidnapping_ratio: log-likelihood ratio of the scan for a kidnapping before it to none, nats, of this
        keyframe alone.
    :ivar clutter: usual rate of contradictions of the hypothesis's map.
    :ivar effective_samples: ESS of the hypothesis's particles, in [1, number of particles].
    :ivar revised_keyframes: earlier keyframes of the area whose pose changed because another particle leads now;
        ``previous_area`` and ``area`` are equal.
    :ivar mode_count: number of modes of the pose among the particles.
    """

    hypothesis: int
    area: int
    pose: PoseGaussian
    stored: bool
    log_evidence: float
    log_kidnapping_ratio: float
    clutter: Clutter
    effective_samples: float
    revised_keyframes: tuple[MovedKeyframe, ...] = ()
    mode_count: int = 1


@dataclass(frozen=True, eq=False, slots=True)
class Keyframe:
    """A keyframe event: slam -> aam, tsbi, tlca, recorder.

    :ivar sequence: 0, 1, 2, ... without gaps; it also names the keyframe.
    :ivar scan: the keyframe's scan.
    :ivar path_length: path length since the start, m.
    :ivar estimates: one estimate for every live hypothesis, ordered by hypothesis id.
    :ivar motion_unknown: whether the motion since the last keyframe is unknown.
    :ivar initial_pose: initial pose of the robot, None where none was given.
    :ivar mapping: whether the map may change. A lost robot may add to it even where it may not.
    :ivar stale_beams: beams in the map of the only hypothesis that the last scans refute.
    :ivar motion_condition: of the motion since the last keyframe.
    :ivar marks: the newest observation since then of each mark, at the pose of the keyframe.
    """

    sequence: int
    scan: Scan
    path_length: float
    estimates: tuple[HypothesisEstimate, ...]
    motion_unknown: bool = False
    initial_pose: InitialPose | None = None
    mapping: bool = True
    stale_beams: tuple[StaleBeams, ...] = ()
    motion_condition: MotionCondition = "ordinary"
    marks: tuple[MarkObservation, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class AreaEvent:
    """A change of the partition under one hypothesis.

    :ivar hypothesis: id of the live hypothesis.
    :ivar kind: "cut" where the newest keyframes separate from the current area, "moved" where the robot passed a known
        arc into a known area, "merged" where two areas with a definite arc become one.
    :ivar keyframes: for "cut": the stored keyframes that separate, ascending, including the newest; else empty.
    :ivar area: for "moved": the known area in which the robot is now; for "cut": the area that was left; for "merged":
        the area that becomes part of ``into``.
    :ivar score: for "cut": the normalized cut, 0 where a keyframe leaves since its pose is uncertain; for "moved": the
        overlap with the new area; for "merged": the least normalized cut of the joined graph.
    :ivar into: for "merged": the area that remains, else None.
    """

    hypothesis: int
    kind: Literal["cut", "moved", "merged"]
    keyframes: tuple[int, ...]
    area: int
    score: float
    into: int | None = None


@dataclass(frozen=True, eq=False, slots=True)
class AreaEvents:
    """aam -> tsbi, one for every keyframe event, mostly without events.

    :ivar sequence: the keyframe event that it answers.
    :ivar events: changes under the hypotheses.
    :ivar redundant_keyframes: keyframes that may be pruned, where there is one hypothesis.
    """

    sequence: int
    events: tuple[AreaEvent, ...]
    redundant_keyframes: tuple[PrunedKeyframe, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class Hypothesis:
    """A live hypothesis after keyframe event k, as changes against its parent before it.

    :ivar id: id of the hypothesis: that of the parent where it is the only child, else a new one.
    :ivar parent: id of the hypothesis that it continues.
    :ivar probability: P(gamma^t | d), Eq. (14).
    :ivar area: the robot's area now.
    :ivar frame_change: belief over ``area_T_previous``, the pose of the robot's previous area in ``area``, with the
        covariance of the newest keyframe that moved, or of the arc; None where area and pose are unchanged.
    :ivar moved_keyframes: keyframes that change their area.
    :ivar arcs: arcs that are new or replaced.
    :ivar local_areas: areas of the submap, the robot's own first; empty where the submap is unchanged.
    :ivar removed_arcs: arcs that are removed.
    :ivar area_merge: merge of two areas, where this is the only hypothesis; else None.
    :ivar lost: whether the hypothesis is lost: it maps around the robot until relocalization.
    :ivar tracking_reset: whether it is lost from now on without a stored keyframe, so that mapping begins with the next
        scan.
    """

    id: int
    parent: int
    probability: float
    area: int
    frame_change: PoseGaussian | None = None
    moved_keyframes: tuple[MovedKeyframe, ...] = ()
    arcs: tuple[Arc, ...] = ()
    local_areas: tuple[LocalArea, ...] = ()
    removed_arcs: tuple[ArcEnds, ...] = ()
    area_merge: AreaMerge | None = None
    lost: bool = False
    tracking_reset: bool = False


@dataclass(frozen=True, eq=False, slots=True)
class Hypotheses:
    """tsbi -> slam, aam, tlca, rtl, recorder; one for every keyframe event.

    :ivar sequence: the keyframe event that it answers.
    :ivar hypotheses: every live hypothesis, ordered by id; probabilities sum to 1 less ``unexamined``.
    :ivar unexamined: probability of topologies that the gate excluded or the reduction dropped.
    :ivar pruned_keyframes: keyframes that are removed from all maps, after all other changes.
    :ivar stale_beams: beams that are removed from keyframes' scans.
    :ivar statements: what people stated about places, in order, each with its probability now.
    """

    sequence: int
    hypotheses: tuple[Hypothesis, ...]
    unexamined: float = 0.0
    pruned_keyframes: tuple[PrunedKeyframe, ...] = ()
    stale_beams: tuple[StaleBeams, ...] = ()
    statements: tuple[WeighedStatement, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class ClosureDecision:
    """tlca -> slam, aam, tsbi, rtl, recorder; one for every keyframe event.

    :ivar sequence: the keyframe event that it answers.
    :ivar hypothesis: the hypothesis that is now definite, all others being dropped; None where none is accepted.
    :ivar arcs: arcs of that hypothesis refined by alignment and fusion, Eq. (10).
    :ivar moved_keyframes: keyframes of that hypothesis with refined poses.
    :ivar global_poses: ``map_T_area`` of all areas of the most probable hypothesis, ordered by id; empty where
        unchanged since the last message.
    :ivar revised_hypotheses: explanations of a contradiction between accepted closures, the most probable first. TSBI
        branches the hypothesis into these children at the next event, with new ids and submaps. Each child withdraws
        the closures that its explanation declares false. Else empty.
    :ivar ambiguity: shape (3, 3), second moment of the robot's pose under the other hypotheses about that under the
        most probable one: x, y along the axes of the map, m, and heading, rad; 0 for a single hypothesis.
    :ivar foreign_ground: ground of another robot that becomes part of the map, where this is the only hypothesis; else
        None.
    """

    sequence: int
    hypothesis: int | None = None
    arcs: tuple[Arc, ...] = ()
    moved_keyframes: tuple[MovedKeyframe, ...] = ()
    global_poses: tuple[AreaPose, ...] = ()
    revised_hypotheses: tuple[Hypothesis, ...] = ()
    ambiguity: NDArray[np.float64] = field(default_factory=partial(np.zeros, (3, 3)))
    foreign_ground: ForeignGround | None = None


@dataclass(frozen=True, eq=False, slots=True)
class LocalEstimate:
    """slam -> rtl, recorder, and to the robot as the acknowledgement of a scan; one for every scan.

    :ivar stamp: stamp of the scan, ns.
    :ivar scan_index: number of the scan since the start, 0, 1, 2, ... without gaps.
    :ivar area: area of the most probable hypothesis.
    :ivar pose: belief over ``area_T_base`` at the scan, the HMT pose s_t = (gamma_t, x_t).
    :ivar odometry: shape (3,), ``odom_T_base`` at the scan.
    :ivar dropped: number of scans dropped since the start.
    """

    stamp: int
    scan_index: int
    area: int
    pose: PoseGaussian
    odometry: Pose
    dropped: int


@dataclass(frozen=True, eq=False, slots=True)
class EarlyEstimate:
    """slam -> rtl: estimate of a scan that waits for topology or for later odometry; its ``LocalEstimate`` follows.

    :ivar stamp: stamp of the scan, ns.
    :ivar scan_index: as in ``LocalEstimate``; not all scans have an early estimate.
    :ivar event: the last keyframe event.
    :ivar area: area of the hypothesis that is the most probable.
    :ivar pose: belief over ``area_T_base`` at the scan.
    :ivar odometry: shape (3,), ``odom_T_base`` at the scan.
    """

    stamp: int
    scan_index: int
    event: int
    area: int
    pose: PoseGaussian
    odometry: Pose


@dataclass(frozen=True, eq=False, slots=True)
class ScanPoses:
    """slam -> tlca, recorder: poses of the scans since the last message, under one hypothesis.

    :ivar hypothesis: id of the live hypothesis.
    :ivar first_scan: ``scan_index`` of the first row.
    :ivar stamps: shape (n,), int64, ns.
    :ivar keyframes: shape (n,), int64, the stored keyframe to which the scan's pose is relative.
    :ivar poses: shape (n, 3), ``keyframe_T_base``.
    """

    hypothesis: int
    first_scan: int
    stamps: NDArray[np.int64]
    keyframes: NDArray[np.int64]
    poses: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RealTimePose:
    """rtl -> other programs; one for every odometry reading.

    :ivar stamp: stamp of the odometry reading, ns.
    :ivar area: area gamma of the pose.
    :ivar area_pose: belief over ``map_T_area``.
    :ivar estimate: belief over ``area_T_base`` at the last estimate.
    :ivar motion: belief over the motion of the base since then, from the odometry.
    :ivar odometry: ``odom_T_base`` of the reading, shape (3,).
    :ivar ambiguity: ambiguity of the newest ``ClosureDecision``, shape (3, 3).
    """

    stamp: int
    area: int
    area_pose: PoseGaussian
    estimate: PoseGaussian
    motion: PoseGaussian
    odometry: Pose
    ambiguity: NDArray[np.float64]

    # Computed on demand: an offline run needs none of these poses, and they take most of the time of rtl.
    @cached_property
    def pose_in_area(self) -> PoseGaussian:
        """Belief over ``area_T_base``: p(s_t+k | s_t, u), the HMT pose by dead reckoning from the last estimate.

        Its mean is that under the most probable hypothesis, its covariance that over all of them.
        """
        pose = self.estimate.compose(self.motion)
        turn = se2.adjoint((0.0, 0.0, -self.area_pose.mean[2] - pose.mean[2]))
        return PoseGaussian(pose.mean, pose.covariance + turn @ self.ambiguity @ turn.T)

    @cached_property
    def map_pose(self) -> PoseGaussian:
        """Belief over ``map_T_base``, likewise."""
        return self.area_pose.compose(self.pose_in_area)

    @property
    def map_T_odom(self) -> Pose:  # noqa: N802  named as every transform is
        """The transform from the odometry frame to the map, shape (3,)."""
        return se2.compose(self.map_pose.mean, se2.inverse(self.odometry))


@dataclass(frozen=True, eq=False, slots=True)
class PoseReset:
    """robot -> slam: reset the pose estimate before the next scan, with new odometry.

    :ivar initial_pose: initial pose, None for global localization. A lost robot that gets an initial pose was not
        kidnapped.
    """

    initial_pose: InitialPose | None = None


@dataclass(frozen=True, eq=False, slots=True)
class TrackingReset:
    """slam -> tsbi, rtl, robot: the robot's pose and the time are unknown from here on.

    :ivar event: the keyframe event that follows, which is the next one.
    :ivar scans_before: number of scans before the reset; estimates for these are obsolete.
    """

    event: int
    scans_before: int


@dataclass(frozen=True, eq=False, slots=True)
class EndOfLog:
    """robot -> slam: no more scans follow; slam answers with the last ``ScanPoses`` and ``EndOfRun``."""


@dataclass(frozen=True, eq=False, slots=True)
class EndOfRun:
    """slam -> recorder, robot: all scans are processed.

    :ivar received: number of scans received.
    :ivar processed: number of scans with a pose.
    :ivar dropped: number of scans refused or skipped.
    """

    received: int
    processed: int
    dropped: int


@dataclass(frozen=True, eq=False, slots=True)
class Notice:
    """Any process -> the log and the report: a sentence for people, sent once for each cause.

    :ivar process: name of the process.
    :ivar text: one sentence that names the value and the remedy.
    """

    process: str
    text: str


Message = (
    Scan
    | Odometry
    | MarkObservation
    | PlaceStatement
    | Keyframe
    | AreaEvents
    | Hypotheses
    | ClosureDecision
    | Ambiguity
    | LocalEstimate
    | EarlyEstimate
    | ScanPoses
    | RealTimePose
    | PoseReset
    | TrackingReset
    | EndOfLog
    | EndOfRun
    | Notice
    | Task
    | GoalPose
    | TaskResult
    | VelocityCommand
    | PlaceEstimate
    | TeamMessage
    | TeamGoal
    | JoinedGround
)
