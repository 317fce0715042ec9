"""What the processes say to each other, as immutable values.

Scans and odometry enter as :class:`~hmt_slam_ros.sensors.Scan` and :class:`~hmt_slam_ros.sensors.Odometry`. One
*keyframe event* k sets off the chain Keyframe(k) -> AreaEvents(k) -> Hypotheses(k) -> ClosureDecision(k), after which
metric SLAM takes up the scans that waited.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import (
    Arc,
    ArcEnds,
    AreaMerge,
    AreaPose,
    InitialPose,
    LocalArea,
    MovedKeyframe,
    Pose,
    PrunedKeyframe,
    StaleBeams,
)
from hmt_slam_ros.messages.tasks import GoalPose, PlaceEstimate, Task, TaskResult, VelocityCommand
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.sensors import Odometry, Scan


@dataclass(frozen=True, eq=False, slots=True)
class HypothesisEstimate:
    """What metric SLAM says of one live hypothesis at a keyframe event.

    :ivar hypothesis: id of the live hypothesis.
    :ivar area: the robot's area, gamma_t.
    :ivar pose: belief over ``area_T_base`` at the keyframe. Its covariance is the drift since the area's origin, or
        the uncertainty of localization where the robot moves over ground that is already mapped.
    :ivar stored: whether the keyframe enters this hypothesis's map; False where it would add nothing new.
    :ivar log_evidence: log-likelihood of the keyframe's scan where it is in the place that this hypothesis has it in,
        relative to a place that looks alike; nats, not accumulated over keyframes.
    :ivar log_kidnapping_ratio: by how much likelier the scan is where the robot was displaced before it, nats,
        likewise.
    :ivar clutter: what contradicts the hypothesis's map usually.
    :ivar effective_samples: ESS of the hypothesis's particles, in [1, number of particles].
    :ivar revised_keyframes: earlier keyframes of the area whose pose changed because another particle leads now;
        ``source`` and ``area`` are equal.
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


@dataclass(frozen=True, eq=False, slots=True)
class Keyframe:
    """A keyframe event: slam -> aam, tsbi, tlca, recorder.

    :ivar sequence: 0, 1, 2, ... without gaps; it also names the keyframe.
    :ivar scan: the keyframe's scan.
    :ivar path_length: path length since the start, m.
    :ivar estimates: one estimate for every live hypothesis, ordered by hypothesis id.
    :ivar motion_unknown: whether nothing tells how the robot came there from the keyframe before.
    :ivar initial_pose: where that is as somebody says, None where nobody did.
    :ivar mapping: whether the map may change; what a robot adds to it that may be anywhere changes nothing of it.
    :ivar stale_beams: what the one hypothesis's map holds that is no more, as the last scans see it.
    """

    sequence: int
    scan: Scan
    path_length: float
    estimates: tuple[HypothesisEstimate, ...]
    motion_unknown: bool = False
    initial_pose: InitialPose | None = None
    mapping: bool = True
    stale_beams: tuple[StaleBeams, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class AreaEvent:
    """The AAM's finding for one hypothesis.

    :ivar hypothesis: id of the live hypothesis.
    :ivar kind: "cut" where the newest keyframes separate from the current area, "moved" where the robot went over a
        known arc into a known area, "merged" where two areas that a definite arc joins are one.
    :ivar keyframes: for "cut": the stored keyframes that leave, ascending, the newest among them; else empty.
    :ivar area: for "moved": the known area in which the robot is now; for "cut": the area that was left; for "merged":
        the area that becomes part of ``into``.
    :ivar score: for "cut": the normalized cut; for "moved": the overlap with the new area; for "merged": the least
        normalized cut of the two together.
    :ivar into: for "merged": the area that stays, else None.
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
    :ivar events: of the hypotheses.
    :ivar redundant_keyframes: keyframes that may be forgotten, where this is the map of one hypothesis alone.
    """

    sequence: int
    events: tuple[AreaEvent, ...]
    redundant_keyframes: tuple[PrunedKeyframe, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class Hypothesis:
    """A live hypothesis after keyframe event k, as changes against the leaf ``parent`` before it.

    :ivar id: its id; equal to ``parent`` where nothing branched; of several children of one parent each has a
        new id.
    :ivar parent: the hypothesis it continues.
    :ivar probability: P(gamma^t | d), Eq. (14).
    :ivar area: the robot's area now.
    :ivar frame_change: belief over ``area_T_previous``: the frame of the robot's area before the event in that of
        ``area``, as uncertain as the newest keyframe that came over is in the area, or as the arc; None where the area
        did not change and the robot's pose stands.
    :ivar moved_keyframes: keyframes that change area.
    :ivar arcs: arcs that are new or replaced.
    :ivar local_areas: the areas of the local map, the current one first; empty where the local map stays as it is.
    :ivar removed_arcs: arcs that this hypothesis does not believe any more.
    :ivar area_merge: two areas that are one, where this is the only hypothesis; else None.
    :ivar lost: whether the robot may be anywhere in the map, and maps around itself until it is recognized where.
    :ivar tracking_reset: whether it is lost since now, and nothing was stored that it could map on from: it does from
        the next scan on.
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
    :ivar unexamined: probability of topologies that the gate did not examine or the reduction dropped.
    :ivar pruned_keyframes: keyframes that are no more, in any map, after all other changes.
    :ivar stale_beams: beams that are left out of keyframes' scans from now on.
    """

    sequence: int
    hypotheses: tuple[Hypothesis, ...]
    unexamined: float = 0.0
    pruned_keyframes: tuple[PrunedKeyframe, ...] = ()
    stale_beams: tuple[StaleBeams, ...] = ()


@dataclass(frozen=True, eq=False, slots=True)
class ClosureDecision:
    """tlca -> slam, aam, tsbi, rtl, recorder; one for every keyframe event.

    :ivar sequence: the keyframe event that it answers.
    :ivar hypothesis: the hypothesis whose history is now definite, all others being dropped; None where the question
        stays open.
    :ivar arcs: arcs of that hypothesis refined by alignment and fusion, Eq. (10).
    :ivar moved_keyframes: keyframes of that hypothesis whose pose in their area was refined.
    :ivar global_poses: ``map_T_area`` of all areas of the most probable hypothesis, ordered by id; empty where
        unchanged since the last message.
    :ivar revised_hypotheses: where accepted closures contradict each other, the explanations of that, the most probable
        first: the children into which TSBI branches the hypothesis at the next event, with ids of its own and their
        local maps. Each child withdraws what its explanation takes for false. Else empty.
    :ivar ambiguity: shape (3, 3), the second moment of the robot's pose under the other live hypotheses about that
        under the most probable one: x, y along the axes of the map, m, and heading, rad; 0 where there is no other.
    """

    sequence: int
    hypothesis: int | None = None
    arcs: tuple[Arc, ...] = ()
    moved_keyframes: tuple[MovedKeyframe, ...] = ()
    global_poses: tuple[AreaPose, ...] = ()
    revised_hypotheses: tuple[Hypothesis, ...] = ()
    ambiguity: NDArray[np.float64] = field(default_factory=partial(np.zeros, (3, 3)))


@dataclass(frozen=True, eq=False, slots=True)
class LocalEstimate:
    """slam -> rtl, recorder, and to the robot as the acknowledgement of a scan; one for every scan.

    :ivar stamp: the scan's, ns.
    :ivar scan_index: 0, 1, 2, ... of the scan since the start, without gaps.
    :ivar area: area of the most probable hypothesis.
    :ivar pose: belief over ``area_T_base`` at the scan, the HMT pose s_t = (gamma_t, x_t).
    :ivar odometry: shape (3,), ``odom_T_base`` at the scan.
    :ivar dropped: scans dropped since the start.
    """

    stamp: int
    scan_index: int
    area: int
    pose: PoseGaussian
    odometry: Pose
    dropped: int


@dataclass(frozen=True, eq=False, slots=True)
class ScanPoses:
    """slam -> tlca, recorder: where the scans since the last trail were taken, under one hypothesis.

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
    """rtl -> the robot's other programs; one for every odometry reading.

    :ivar stamp: of the odometry reading, ns.
    :ivar area: area gamma of the pose.
    :ivar area_pose: belief over ``map_T_area``.
    :ivar estimate: belief over ``area_T_base`` at the last estimate.
    :ivar motion: belief over the motion of the base since then, from the odometry.
    :ivar odometry: the reading, ``odom_T_base``, shape (3,).
    :ivar ambiguity: of the newest ``ClosureDecision``, shape (3, 3).
    """

    stamp: int
    area: int
    area_pose: PoseGaussian
    estimate: PoseGaussian
    motion: PoseGaussian
    odometry: Pose
    ambiguity: NDArray[np.float64]

    # In an offline run nobody asks for the poses, and they take longer than all else that rtl does.
    @cached_property
    def pose_in_area(self) -> PoseGaussian:
        """Belief over ``area_T_base``, p(s_t+k | s_t, u), the HMT pose by dead reckoning from the last estimate."""
        return self.estimate.compose(self.motion)

    @cached_property
    def map_pose(self) -> PoseGaussian:
        """Belief over ``map_T_base``: its mean under the most probable hypothesis, its covariance over all of them."""
        pose = self.area_pose.compose(self.pose_in_area)
        turn = se2.adjoint((0.0, 0.0, -pose.mean[2]))
        return PoseGaussian(pose.mean, pose.covariance + turn @ self.ambiguity @ turn.T)

    @property
    def map_T_odom(self) -> Pose:  # noqa: N802  named as every transform is
        """What takes the odometry's pose to the map, shape (3,)."""
        return se2.compose(self.map_pose.mean, se2.inverse(self.odometry))


@dataclass(frozen=True, eq=False, slots=True)
class PoseReset:
    """robot -> slam: the next scan may be from anywhere, at any time; odometry begins anew.

    :ivar initial_pose: where it is as somebody says, None where nobody knows. A robot that may be anywhere was not
        carried then: that its place was not known is why it is said.
    """

    initial_pose: InitialPose | None = None


@dataclass(frozen=True, eq=False, slots=True)
class TrackingReset:
    """slam -> tsbi, rtl, robot: where the robot is, and when, is not known from here on.

    :ivar event: the keyframe event with which it arrives, which is the next one.
    :ivar scans_before: scans before it; what slam says of these is past.
    """

    event: int
    scans_before: int


@dataclass(frozen=True, eq=False, slots=True)
class EndOfLog:
    """robot -> slam: no more scans will come; slam answers with the last trails and ``EndOfRun``."""


@dataclass(frozen=True, eq=False, slots=True)
class EndOfRun:
    """slam -> recorder, robot: every scan received has been processed.

    :ivar received: scans received.
    :ivar processed: scans for which a pose was given.
    :ivar dropped: scans refused or skipped.
    """

    received: int
    processed: int
    dropped: int


@dataclass(frozen=True, eq=False, slots=True)
class Notice:
    """Any process -> the log and the report: something a person should know; said once per cause.

    :ivar process: who says it.
    :ivar text: one sentence that names the value and the remedy.
    """

    process: str
    text: str


Message = (
    Scan
    | Odometry
    | Keyframe
    | AreaEvents
    | Hypotheses
    | ClosureDecision
    | LocalEstimate
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
)
