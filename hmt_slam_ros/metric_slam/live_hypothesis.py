"""One live hypothesis inside metric SLAM: its filter, its keyframes, and what its scans are related to."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Int64
from hmt_slam_ros.configuration.metric_slam import Filter
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.keyframe_pruning import Successor, in_place, successor
from hmt_slam_ros.lifelong.change_detection import Look, looked
from hmt_slam_ros.messages.map_changes import Merged, Relabelled
from hmt_slam_ros.messages.messages import Leaf, LeafEstimate, Trail
from hmt_slam_ros.registration.match_covariance import MatchError
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.submap.local_filter import (
    FilterFactory,
    FilterState,
    FilterStep,
    LineFilterState,
    LocalFilter,
    PlacedKeyframe,
)
from hmt_slam_ros.submap.local_mapping import Sighting
from hmt_slam_ros.submap.scan_evidence import NOTHING_SAID, Judgement

_FIRST_COVARIANCE = np.diag([1e-8, 1e-8, 1e-8])
_STAY = PoseGaussian.exactly(np.zeros(3))
# Doubt of a scan, nats, above which it contradicts what the robot should see: most who drive never meet one.
_CONTRADICTING = 4.0
_NO_ERROR = MatchError(_FIRST_COVARIANCE, _FIRST_COVARIANCE, np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class KeyframeCovariances:
    """Covariances by keyframe, in the order in which these came.

    :ivar keyframes: shape (n,).
    :ivar covariances: shape (n, 3, 3), right tangent frame.
    """

    keyframes: Int64
    covariances: NDArray[np.float64]

    @classmethod
    def of(cls, covariances: Mapping[int, NDArray[np.float64]]) -> KeyframeCovariances:
        """Of {keyframe: covariance}."""
        rows = np.array(list(covariances.values())).reshape(-1, 3, 3)
        return cls(np.array(list(covariances), dtype=np.int64), rows)

    def by_keyframe(self) -> dict[int, NDArray[np.float64]]:
        """{keyframe: covariance}."""
        return dict(zip(self.keyframes.tolist(), self.covariances, strict=True))


@dataclass(frozen=True, eq=False)
class LiveState:
    """One live hypothesis inside metric SLAM.

    :ivar grid: its particles, where its local map is a grid.
    :ivar lines: its filter, where its local map is one of lines.
    :ivar event_pose: ``area_T_base`` at the last keyframe event, shape (3,), m and rad.
    :ivar moved: the motion between the last two keyframe events, as matched, shape (3,).
    :ivar information: of the last keyframe event's match alone, in the frame of its pose, shape (3, 3).
    :ivar error: of that motion.
    :ivar anchor: the stored keyframe to which scans are now related.
    :ivar fresh: what the step which led to a keyframe adds to the drift, of those stored since the area was entered.
    :ivar placed: of the poses of keyframes in their areas' frames, of all that are known.
    :ivar drift: covariance of the pose at the last keyframe event in the area's frame, right tangent, shape (3, 3).
    :ivar trail: (stamp, anchor, ``anchor_T_base``) of the scans since the last keyframe event.
    :ivar contradicted: whether the scan of the last keyframe event contradicted what the robot should have seen.
    :ivar looks: the scans that the next keyframe's is compared with, in mode lifelong.
    """

    grid: FilterState | None
    lines: LineFilterState | None
    event_pose: NDArray[np.float64]
    moved: NDArray[np.float64]
    information: NDArray[np.float64]
    error: MatchError
    anchor: int
    fresh: KeyframeCovariances
    placed: KeyframeCovariances
    drift: NDArray[np.float64]
    trail: tuple[tuple[int, int, NDArray[np.float64]], ...]
    contradicted: bool
    looks: tuple[Look, ...]


@dataclass
class LiveHypothesis:
    """A filter and what metric SLAM remembers beside it.

    :ivar settings: when keyframes are taken, and how far their covariance is to be trusted.
    :ivar moved: the motion between the last two keyframe events, as matched, shape (3,).
    :ivar information: of the last keyframe event's match alone, in the frame of its pose, shape (3, 3).
    :ivar event_pose: ``area_T_base`` at the last keyframe event, shape (3,).
    :ivar anchor: the stored keyframe to which scans are now related.
    :ivar error: of that motion.
    :ivar fresh: {keyframe: covariance (3, 3) that the step which led to it adds to the drift}, of those stored since
        the area was entered.
    :ivar placed: {keyframe: covariance (3, 3) of its pose in its area's frame, right tangent}, of all that are known.
    :ivar drift: covariance of the pose at the last keyframe event in the area's frame, right tangent.
    :ivar trail: (stamp, anchor, ``anchor_T_base``) of the scans since the last keyframe event.
    :ivar contradicted: whether the scan of the last keyframe event contradicted what the robot should have seen.
    :ivar looks: the scans that the next keyframe's is compared with, in mode lifelong.
    """

    filter: LocalFilter
    settings: Filter
    event_pose: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    moved: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    information: NDArray[np.float64] = field(default_factory=lambda: np.zeros((3, 3)))
    error: MatchError = _NO_ERROR
    anchor: int = 0
    fresh: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    placed: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    drift: NDArray[np.float64] = field(default_factory=_FIRST_COVARIANCE.copy)
    trail: list[tuple[int, int, NDArray[np.float64]]] = field(default_factory=list)
    contradicted: bool = False
    looks: tuple[Look, ...] = ()

    @classmethod
    def of(cls, filters: FilterFactory, settings: Filter, state: LiveState) -> LiveHypothesis:
        """The hypothesis of a state, whose patches are in the pool."""
        own = state.grid or state.lines
        assert own is not None
        return cls(
            filters.restored(own),
            settings,
            state.event_pose,
            state.moved,
            state.information,
            state.error,
            state.anchor,
            state.fresh.by_keyframe(),
            state.placed.by_keyframe(),
            state.drift,
            list(state.trail),
            state.contradicted,
            state.looks,
        )

    def state(self) -> LiveState:
        """All that is remembered; tables of grids name patches by their numbers in the pool."""
        own = self.filter.state
        return LiveState(
            own if isinstance(own, FilterState) else None,
            None if isinstance(own, FilterState) else own,
            self.event_pose,
            self.moved,
            self.information,
            self.error,
            self.anchor,
            KeyframeCovariances.of(self.fresh),
            KeyframeCovariances.of(self.placed),
            self.drift,
            tuple(self.trail),
            self.contradicted,
            self.looks,
        )

    def branch(self, hypothesis: int) -> LiveHypothesis:
        """A child with its own filter, in the same state."""
        return LiveHypothesis(
            self.filter.branch(hypothesis),
            self.settings,
            self.event_pose,
            self.moved,
            self.information,
            self.error,
            self.anchor,
            dict(self.fresh),
            dict(self.placed),
            self.drift,
            list(self.trail),
            self.contradicted,
            self.looks,
        )

    def event_due(self, sighting: Sighting) -> bool:
        """Whether the robot moved or turned far enough since the last keyframe event, or may have been displaced.

        :param sighting: the newest one. Where it is the first that contradicts what the robot should see, it is where
            the robot is now.
        """
        moved = se2.between(self.event_pose, self.filter.pose)
        far = math.hypot(moved[0], moved[1]) >= self.settings.keyframe_distance
        if far or abs(moved[2]) >= math.radians(self.settings.keyframe_angle):
            return True
        if self.contradicted:
            return False
        return self.filter.experience.judge(self.filter.compared(sighting)).doubt > _CONTRADICTING

    def event(
        self,
        sequence: int,
        sighting: Sighting,
        *,
        arriving: bool = False,
        storing: bool = True,
        wanted: Callable[[], bool] | None = None,
    ) -> LeafEstimate:
        """One filter step with a keyframe's scan, which enters the map where it adds something new.

        :param sequence: number of the keyframe event.
        :param sighting: of the scan.
        :param arriving: whether nothing tells how the robot came there: the scan is matched with nothing.
        :param storing: whether the hypothesis's map may change.
        :param wanted: asked after the filter step whether the scan adds something; a new place does if None.
        """
        if arriving:
            unmoved, nothing = np.zeros(3), np.zeros((3, 3))
            step = FilterStep(unmoved, _NO_ERROR, nothing, float(len(self.filter.poses)), False)
        else:
            step = self.filter.update(sighting, sequence)
        judgement = NOTHING_SAID if arriving else self._judge(sighting)
        self.looks = () if arriving else self.looks
        self.error, self.contradicted = step.error, judgement.doubt > _CONTRADICTING
        # Of a displaced robot it is the first of where it is now.
        stored = arriving or (storing and ((wanted or self.is_new)() or self.contradicted))
        self._drift_on(sequence if stored else None)
        if stored:
            self.filter.add_keyframe(sequence, sighting.scan)
        self.moved, self.information = step.moved, step.information
        self.event_pose = self.filter.pose
        self._relate()
        return LeafEstimate(
            self.filter.hypothesis,
            self.filter.area,
            PoseGaussian(self.filter.pose, self.drift),
            stored,
            judgement.log_evidence,
            judgement.doubt,
            self.filter.experience.clutter,
            step.effective_samples,
            self._revised(sequence) if step.history_changed and storing else (),
        )

    def _judge(self, sighting: Sighting) -> Judgement:
        """What the scan says of whether the robot is where the filter has it; learns from it what is usual."""
        found = self.filter.compared(sighting)
        judgement = self.filter.experience.judge(found)
        self.filter.experience = self.filter.experience.after(found)
        return judgement

    def note_look(self, scan: Scan) -> None:
        """Compare what follows with a scan that was taken where the filter is."""
        self.looks = looked(self.looks, Look(scan, self.filter.pose.copy()))

    def is_new(self) -> bool:
        """Whether no keyframe of the local map was taken from nearby with a like heading."""
        if not self.filter.keyframes:
            return True
        relative = se2.between(self.filter.leading_keyframe_poses(), self.filter.pose)
        return not bool(np.any(in_place(relative, self.settings)))

    def _drift_on(self, keyframe: int | None) -> None:
        """Carry the drift on to the pose now, of a keyframe that is stored, or of none over ground that is mapped."""
        ad = se2.adjoint(se2.between(self.filter.pose, self.event_pose))
        carried = ad @ self.drift @ ad.T
        if keyframe is None:
            self.drift = self._bounded(carried)
            return
        self.drift = carried + self.error.lasting
        self.fresh[keyframe] = self.error.lasting
        self.placed[keyframe] = self.drift

    def _bounded(self, carried: NDArray[np.float64]) -> NDArray[np.float64]:
        """The drift where the map bounds it, as far as the match tells: the pose is as far off as the map is there."""
        gain = self.error.gain
        free = np.eye(3) - gain
        return gain @ self._mapped() @ gain.T + free @ carried @ free.T + self.error.matched

    def _mapped(self) -> NDArray[np.float64]:
        """How far off the map is here: covariance of the area's nearest keyframe, carried here; 0 where unknown."""
        kept = self.filter.keyframes, self.filter.keyframe_areas, self.filter.leading_keyframe_poses()
        own = [(k, pose) for k, area, pose in zip(*kept, strict=True) if area == self.filter.area and k in self.placed]
        if not own:
            return np.zeros((3, 3))
        relative = se2.between(self.filter.pose, np.array([pose for _, pose in own]))
        nearest = int(np.argmin(np.hypot(relative[:, 0], relative[:, 1])))
        ad = se2.adjoint(relative[nearest])
        covariance: NDArray[np.float64] = ad @ self.placed[own[nearest][0]] @ ad.T
        return covariance

    def _relate(self) -> None:
        """Relate the scans to come to the nearest keyframe."""
        relative = se2.between(self.filter.leading_keyframe_poses(), self.filter.pose)
        cost = np.hypot(relative[:, 0], relative[:, 1]) + np.abs(relative[:, 2])
        self.anchor = self.filter.keyframes[int(np.argmin(cost))]

    def forget(self, keyframes: Collection[int]) -> None:
        """Go on without some keyframes of known ground; scans related to them are related to those that stay.

        What they added to the local map stays there until that is loaded anew.
        """
        if not keyframes:
            return
        for keyframe in keyframes:
            self.fresh.pop(keyframe, None)
            self.placed.pop(keyframe, None)
        names, poses = list(self.filter.keyframes), self.filter.leading_keyframe_poses()
        areas, placed = dict(zip(names, self.filter.keyframe_areas, strict=True)), dict(zip(names, poses, strict=True))
        for lost in ({self.anchor} | {anchor for _, anchor, _ in self.trail}) & set(keyframes):
            staying = {k: at for k, at in placed.items() if k not in keyframes and areas[k] == areas[lost]}
            self._relate_anew(lost, successor(placed[lost], staying))
        self.filter.drop(keyframes)

    def _relate_anew(self, lost: int, held: Successor) -> None:
        """Relate to another keyframe what is related to one that is forgotten."""
        self.trail = [
            (stamp, held.keyframe, se2.compose(held.pose, pose)) if anchor == lost else (stamp, anchor, pose)
            for stamp, anchor, pose in self.trail
        ]
        if self.anchor == lost:
            self.anchor = held.keyframe

    def _revised(self, newest: int) -> tuple[Relabelled, ...]:
        # The messages must not hold on to the poses under all particles.
        poses = self.filter.leading_keyframe_poses().copy()
        return tuple(
            Relabelled(keyframe, self.filter.area, self.filter.area, poses[self.filter.keyframes.index(keyframe)])
            for keyframe in self.fresh
            if keyframe != newest
        )

    def note_scan(self, stamp: int) -> None:
        """Append the scan just processed to the trail."""
        anchor_pose = self.filter.leading_keyframe_poses()[self.filter.keyframes.index(self.anchor)]
        self.trail.append((stamp, self.anchor, se2.between(anchor_pose, self.filter.pose)))

    def take_trail(self, first_scan: int) -> list[Trail]:
        """The trail as a message, if there is one, and begin it anew."""
        if not self.trail:
            return []
        stamps, anchors, poses = zip(*self.trail, strict=True)
        self.trail = []
        return [
            Trail(
                self.filter.hypothesis,
                first_scan,
                np.array(stamps, dtype=np.int64),
                np.array(anchors, dtype=np.int64),
                np.array(poses),
            )
        ]

    def belief(self) -> PoseGaussian:
        """The belief over ``area_T_base`` now."""
        ad = se2.adjoint(se2.between(self.filter.pose, self.event_pose))
        return PoseGaussian(self.filter.pose, ad @ self.drift @ ad.T + self.filter.tracking_covariance)

    def change_area(self, leaf: Leaf, content: Sequence[PlacedKeyframe], filters: FilterFactory) -> None:
        """Change the reference frame and load the local map, as TSBI decided.

        :param content: the keyframes of the areas that it names, in the frame of the robot's area.
        :param filters: chooses the kind of local map of an area that is entered.
        """
        entered = leaf.area != self.filter.area
        if entered:
            self.filter = filters.entering(self.filter, leaf.area, content)
        area_T_previous = np.zeros(3) if leaf.rebase is None else leaf.rebase.mean
        self.filter.change_area(leaf.area, area_T_previous, content)
        self.event_pose = se2.compose(area_T_previous, self.event_pose)
        self.looks = tuple(Look(look.scan, se2.compose(area_T_previous, look.pose)) for look in self.looks)
        if entered and leaf.merged is None:
            moved = {relabelled.keyframe for relabelled in leaf.relabelled}
            self.fresh = {keyframe: step for keyframe, step in self.fresh.items() if keyframe in moved}
            self._drift_into(leaf.rebase or _STAY)
        self._relate()

    def merge(self, merged: Merged, keyframes: Mapping[int, NDArray[np.float64]]) -> None:
        """What is in an area is as uncertain in the one that it becomes part of as that is known relative to it.

        :param keyframes: {keyframe: ``area_T_base``, shape (3,)} of the area.
        """
        for keyframe, pose in keyframes.items():
            if keyframe in self.placed:
                known = PoseGaussian(pose, self.placed[keyframe])
                self.placed[keyframe] = merged.pose.compose(known).covariance
        if self.filter.area == merged.area:
            self.drift = merged.pose.compose(PoseGaussian(self.event_pose, self.drift)).covariance

    def _drift_into(self, rebase: PoseGaussian) -> None:
        """The drift in the area that was entered: along the keyframes that moved with the robot, or else by the map.

        :param rebase: belief over ``area_T_previous``.
        """
        moved = sorted(self.fresh)
        if not moved:
            self.drift = self._bounded(self.drift + _carried(rebase, self.event_pose))
            return
        poses = dict(zip(self.filter.keyframes, self.filter.leading_keyframe_poses(), strict=True))
        self.placed[moved[0]] = _FIRST_COVARIANCE
        for previous, keyframe in pairwise(moved):
            ad = se2.adjoint(se2.between(poses[keyframe], poses[previous]))
            self.placed[keyframe] = ad @ self.placed[previous] @ ad.T + self.fresh[keyframe]
        # TSBI knows how they lie in the area, and takes the drift from there on for what is added to it.
        self.drift = _carried(rebase, self.event_pose) + _FIRST_COVARIANCE

    def reload(self, content: Sequence[PlacedKeyframe]) -> None:
        """Build the local map anew after TLCA refined its keyframes; the robot stays where it is from its anchor.

        :param content: all keyframes of the local map, in the frame of the robot's area.
        """
        before = self.filter.pose
        self.filter.reload(content, self.anchor)
        self.event_pose = se2.compose(self.filter.pose, se2.between(before, self.event_pose))
        moved = [se2.compose(self.filter.pose, se2.between(before, look.pose)) for look in self.looks]
        self.looks = tuple(Look(look.scan, pose) for look, pose in zip(self.looks, moved, strict=True))


def _carried(rebase: PoseGaussian, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the uncertainty of ``area_T_previous`` adds to the covariance (3, 3) of a pose in the area, (3,)."""
    known = PoseGaussian.exactly(se2.between(rebase.mean, pose))
    return rebase.compose(known).covariance
