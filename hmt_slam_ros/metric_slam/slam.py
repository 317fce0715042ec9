"""Metric SLAM: localization and mapping within the current area, for every live hypothesis.

Section V of Blanco et al. 2008; the second step of Eq. (6). Scans wait in a queue while the topological processes
answer a keyframe event.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.grids.patch_pool import PatchState
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.hybrid_map.surroundings import Neighborhood, areas_around
from hmt_slam_ros.lifelong.change_detection import (
    MAX_AREA_SIGMA,
    MAX_KEYFRAME_DISTANCE,
    Changes,
    RecentScan,
    combine_stale_beams,
    detect_changes,
)
from hmt_slam_ros.messages.map_changes import InitialPose
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    EndOfLog,
    EndOfRun,
    Hypotheses,
    Keyframe,
    LocalEstimate,
    Message,
    MotionCondition,
    PoseReset,
    TrackingReset,
)
from hmt_slam_ros.messages.replica import FIRST_AREA, FIRST_HYPOTHESIS, Replica, ReplicaState
from hmt_slam_ros.metric_slam.intake import Intake, OdometryMonitorState, ScanQueueState
from hmt_slam_ros.metric_slam.live_hypothesis import LiveHypothesis, LiveHypothesisState
from hmt_slam_ros.metric_slam.marks import MarkQueue
from hmt_slam_ros.sensors import MarkObservation, Measurement, Scan
from hmt_slam_ros.sensors.motion_model import MotionState, Prediction
from hmt_slam_ros.sensors.odometry import deskew_scan
from hmt_slam_ros.sensors.relative_motion import is_wide
from hmt_slam_ros.submap.local_filter import FilterFactory, PlacedKeyframe
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.particle_filter import ParticleFilters


@dataclass(frozen=True, eq=False)
class SlamState:
    """State of metric SLAM between two messages, by default before the first scan.

    :ivar replica: the maps of the live hypotheses.
    :ivar motion: the motion between scans.
    :ivar odometry_monitor: disagreements of odometry and scans.
    :ivar scan_queue: scans that wait for odometry, or for the answer to a keyframe event.
    :ivar patches: of the grids of all particles, None without grids.
    :ivar live_hypotheses: {hypothesis: its filter and keyframes}.
    :ivar keyframe_events: number of keyframe events.
    :ivar awaiting_decision: whether the answer to the last event is due.
    :ivar path_length: path length since the start, m.
    :ivar processed_scans: number of scans with a pose.
    :ivar dropped_scans: number of scans that were dropped.
    :ivar first_unpublished_scan: number of the first scan whose pose is not published.
    :ivar reset_pending: whether tracking restarts at the next scan.
    :ivar lost: whether the robot may be anywhere in the map, under all hypotheses.
    :ivar initial_pose: pose at the next scan that a person gave, None without one.
    :ivar motion_condition: of the motion since the last keyframe event.
    :ivar marks: observations of marks since then.
    """

    replica: ReplicaState = field(default_factory=ReplicaState)
    motion: MotionState = field(default_factory=MotionState)
    odometry_monitor: OdometryMonitorState = field(default_factory=OdometryMonitorState)
    scan_queue: ScanQueueState = field(default_factory=ScanQueueState)
    patches: PatchState | None = None
    live_hypotheses: Mapping[int, LiveHypothesisState] = field(default_factory=dict)
    keyframe_events: int = 0
    awaiting_decision: bool = False
    path_length: float = 0.0
    processed_scans: int = 0
    dropped_scans: int = 0
    first_unpublished_scan: int = 0
    reset_pending: bool = True
    lost: bool = False
    initial_pose: InitialPose | None = None
    motion_condition: MotionCondition = "ordinary"
    marks: MarkQueue = field(default_factory=MarkQueue)


class MetricSlam:
    """The metric SLAM process.

    Consumes Scan, Odometry, MarkObservation, PoseReset, Hypotheses, ClosureDecision, EndOfLog; produces TrackingReset,
    Keyframe, ScanPoses, LocalEstimate, Notice, EndOfRun.

    :ivar mapping: the parts that all filters share.
    :ivar intake: scans and odometry on their way into the filters.
    :ivar mode: mapping, localization or lifelong; a lost robot maps its surroundings in every mode.
    :ivar batch_size: most scans that are processed at a stretch, None for all that are ready.
    :ivar is_interrupted: whether scans are left since a batch was full; then measurements wait for the next
        :meth:`process_queue`.
    """

    def __init__(
        self,
        configuration: Configuration,
        state: SlamState | None = None,
        filters: Callable[[LocalMapping], FilterFactory] = ParticleFilters,
    ) -> None:
        """:param state: to go on from.

        :param filters: makes the factory of filters.
        """
        state = state or SlamState()
        self._configuration = configuration
        self.mode = configuration.mode
        self.mapping = LocalMapping(configuration)
        self._filters = filters(self.mapping)
        self._neighborhood = Neighborhood(MAX_AREA_SIGMA, MAX_KEYFRAME_DISTANCE)
        self._replica = Replica.from_state(state.replica)
        self.intake = Intake(configuration, state.motion, state.odometry_monitor, state.scan_queue)
        self._live_hypotheses = self._restored_hypotheses(state)
        # All but these parts, which change in place.
        self._state = replace(
            state,
            replica=ReplicaState(),
            motion=MotionState(),
            odometry_monitor=OdometryMonitorState(),
            scan_queue=ScanQueueState(),
            patches=None,
            live_hypotheses={},
        )
        self._ended = False
        # Not part of the state, since no decision depends on them.
        self.batch_size: int | None = None
        self.is_interrupted = False

    def _restored_hypotheses(self, state: SlamState) -> dict[int, LiveHypothesis]:
        if not state.live_hypotheses:
            first = self._filters.new(FIRST_HYPOTHESIS, FIRST_AREA)
            return {FIRST_HYPOTHESIS: LiveHypothesis(first, self._configuration.filter)}
        hypotheses = state.live_hypotheses
        tables = [live.particle_filter.tables for live in hypotheses.values() if live.particle_filter is not None]
        if state.patches is not None and tables:
            self.mapping.pool.load(state.patches, np.concatenate(tables))
        settings = self._configuration.filter
        return {name: LiveHypothesis.from_state(self._filters, settings, live) for name, live in hypotheses.items()}

    @property
    def state(self) -> SlamState:
        """The whole state, as a value."""
        live, patches = self._hypothesis_states()
        motion, odometry_monitor, scan_queue = self.intake.state
        return replace(
            self._state,
            replica=self._replica.state,
            motion=motion,
            odometry_monitor=odometry_monitor,
            scan_queue=scan_queue,
            patches=patches,
            live_hypotheses=live,
        )

    def _hypothesis_states(self) -> tuple[dict[int, LiveHypothesisState], PatchState | None]:
        """The states of the live hypotheses, and the patches of their grids, whose numbers are in the tables."""
        states = {name: live.state() for name, live in self._live_hypotheses.items()}
        grids = {name: state.particle_filter for name, state in states.items() if state.particle_filter is not None}
        if not grids:
            return states, None
        patches, tables = self.mapping.pool.state(np.concatenate([grid.tables for grid in grids.values()]))
        for (name, grid), own in zip(grids.items(), np.split(tables, len(grids)), strict=True):
            states[name] = replace(states[name], particle_filter=replace(grid, tables=own))
        return states, patches

    @property
    def is_mapping(self) -> bool:
        """Whether the map may change."""
        return self.mode != "localization"

    @property
    def replica(self) -> Replica:
        """The maps of the live hypotheses."""
        return self._replica

    @property
    def is_awaiting_decision(self) -> bool:
        """Whether the answer to a keyframe event is due."""
        return self._state.awaiting_decision

    @property
    def is_reset_pending(self) -> bool:
        """Whether tracking restarts at the next scan."""
        return self._state.reset_pending

    @property
    def keyframe_events(self) -> int:
        """Number of keyframe events so far."""
        return self._state.keyframe_events

    @property
    def processed_scans(self) -> int:
        """Number of scans with a pose."""
        return self._state.processed_scans

    @property
    def is_lost(self) -> bool:
        """Whether the robot may be anywhere in the map."""
        return self._state.lost

    @property
    def queued_scans(self) -> int:
        """Number of scans in the queue."""
        return len(self.intake.queue)

    @property
    def peak_map_bytes(self) -> int:
        """Largest memory of the maps of all particles, bytes."""
        return self.mapping.pool.peak_bytes

    @property
    def particles(self) -> tuple[int, Float64]:
        """Area of the most probable hypothesis and the poses of its particles, ``area_T_base``, shape (M, 3)."""
        return self.best_hypothesis.filter.area, self.best_hypothesis.filter.poses

    @property
    def best_hypothesis(self) -> LiveHypothesis:
        """The most probable hypothesis."""
        return self._live_hypotheses[self._replica.best_hypothesis]

    def handle(self, message: Message) -> list[Message]:
        """Process a message, and the scans that are ready then; returns the answers."""
        if isinstance(message, Measurement):
            notices = self.enqueue(message)
            return notices if self.is_interrupted else notices + self.process_queue()
        # A slam that handles the journal of a killed one reaches the event of an answer only here.
        answers = self.finish_queue() if self.is_interrupted else []
        return answers + self._handle_answer_or_request(message)

    def _handle_answer_or_request(self, message: Message) -> list[Message]:
        if isinstance(message, PoseReset):
            return self._set_initial_pose(message.initial_pose)
        if isinstance(message, Hypotheses):
            self._apply_hypotheses(message)
        elif isinstance(message, ClosureDecision):
            self._apply_decision(message)
        elif isinstance(message, EndOfLog):
            self._ended = True
        return self.process_queue()

    def _set_initial_pose(self, initial_pose: InitialPose | None) -> list[Message]:
        self._state = replace(self._state, initial_pose=initial_pose)
        return [] if self._state.lost and initial_pose is not None else self._reset_tracking()

    def enqueue(self, measurement: Measurement) -> list[Message]:
        """Add a measurement; returns notices of its faults."""
        if isinstance(measurement, MarkObservation):
            self._state = replace(self._state, marks=self._state.marks.add(measurement))
            return []
        return self.intake.add(measurement)

    def add_to_replica(self, keyframe: Keyframe) -> None:
        """Add a keyframe to the maps of the live hypotheses."""
        self._replica.add_keyframe(keyframe)

    @property
    def keyframe_scans(self) -> Mapping[int, Scan]:
        """{keyframe: its scan} of the live hypotheses."""
        return self._replica.scans

    def release(self) -> None:
        """Free the maps of all filters."""
        for live in self._live_hypotheses.values():
            live.filter.release()

    def finish_queue(self) -> list[Message]:
        """As :meth:`process_queue`, in one batch."""
        batch_size, self.batch_size = self.batch_size, None
        answers = self.process_queue()
        self.batch_size = batch_size
        return answers

    def process_queue(self) -> list[Message]:
        """Process a batch of the scans that are ready, up to the next keyframe event; returns their messages."""
        answers: list[Message] = []
        left, self.is_interrupted = self.batch_size, False
        while not self._state.awaiting_decision and self.intake.queue.is_ready(ended=self._ended):
            # Without odometry at once, before a reading lets them wait again.
            if left == 0 and self.intake.queue.waits_for_odometry:
                self.is_interrupted = True
                break
            taken = self.intake.take(ended=self._ended)
            if taken is None:
                break
            scan, notices = taken
            answers += notices + self._process_scan(scan)
            left = left and left - 1
        if self._ended and not self.intake.queue and not self._state.awaiting_decision:
            answers += self._finish()
        return answers

    def _reset_tracking(self) -> list[Message]:
        """Restart tracking at the next scan; scans that still wait are dropped, as they are from before."""
        dropped = self._state.dropped_scans + len(self.intake.queue)
        self.intake = self.intake.restart()
        self._state = replace(
            self._state, dropped_scans=dropped, reset_pending=True, motion_condition="ordinary", marks=MarkQueue()
        )
        return [TrackingReset(self._state.keyframe_events, self._state.processed_scans)]

    def _process_scan(self, scan: Scan) -> list[Message]:
        motion = self.intake.motion
        prediction = motion.predict(scan.stamp)
        prepared = PreparedScan(self.mapping, deskew_scan(scan, motion.odometry, self._configuration.rtl))
        messages: list[Message] = []
        if self._state.reset_pending:
            self._reset_filters(prediction)
        else:
            messages += self._track(prepared, prediction)
        if (
            self._state.reset_pending
            or self._state.initial_pose is not None
            or self.best_hypothesis.is_event_due(prepared)
        ):
            messages += self._keyframe_event(prepared)
        for live in self._live_hypotheses.values():
            live.add_scan_pose(scan.stamp)
        self._state = replace(self._state, processed_scans=self._state.processed_scans + 1)
        return [*messages, self._local_estimate(scan.stamp)]

    def _reset_filters(self, prediction: Prediction) -> None:
        """Initialize every filter at its pose after the predicted motion.

        The motion of a kidnapped robot is unknown and predicted as none; a robot that is lost may be so by mistake.
        """
        for live in self._live_hypotheses.values():
            pose = se2.compose(live.filter.pose, prediction.fused.increment)
            live.filter.initialize(PoseGaussian.from_pose(pose))

    def _track(self, prepared: PreparedScan, prediction: Prediction) -> list[Message]:
        """Match the scan under every hypothesis, and update the motion model by the best one."""
        tracked = {
            hypothesis: live.filter.track(prepared, prediction) for hypothesis, live in self._live_hypotheses.items()
        }
        best = tracked[self._replica.best_hypothesis]
        path_length = self._state.path_length + math.hypot(best.increment[0], best.increment[1])
        condition = self._motion_condition(prediction, contradicted=best.contradicts_odometry)
        marks = self._state.marks.after_scan(prepared.scan.stamp, best.increment)
        self._state = replace(self._state, path_length=path_length, motion_condition=condition, marks=marks)
        return self.intake.observe(prepared.scan.stamp, prediction, best)

    def _motion_condition(self, prediction: Prediction, *, contradicted: bool) -> MotionCondition:
        """The condition of the motion since the last keyframe event, with one more scan.

        :param contradicted: whether the scan contradicts odometry.
        """
        if prediction.after_gap or self._state.motion_condition == "after_gap":
            return "after_gap"
        if contradicted or is_wide(self.best_hypothesis.filter.tracking_covariance, self._configuration.filter):
            return "uncertain"
        return self._state.motion_condition

    def _keyframe_event(self, prepared: PreparedScan) -> list[Message]:
        sequence, scan = self._state.keyframe_events, prepared.scan
        scan_poses: list[Message] = self._take_scan_poses()
        may_store = self.is_mapping or self._state.lost
        changes: list[tuple[Changes, float]] = []
        estimates = tuple(
            live.process_keyframe(
                sequence,
                prepared,
                after_reset=self._state.reset_pending,
                may_store=may_store,
                is_informative=partial(self._shows_changes, live, scan, changes)
                if self._is_lifelong
                else partial(live.is_new_viewpoint, scan, self.keyframe_scans),
            )
            for live in self._live_hypotheses.values()
        )
        last = self.best_hypothesis.event
        self.intake.motion.observe_keyframe(last.motion, last.match_information)
        after_reset, initial_pose = self._state.reset_pending, self._state.initial_pose
        marks, queue = self._state.marks.take()
        keyframe = Keyframe(
            sequence,
            scan,
            self._state.path_length,
            estimates,
            after_reset and sequence > 0,
            initial_pose,
            self.is_mapping,
            combine_stale_beams(changes),
            self._state.motion_condition,
            marks,
        )
        self.add_to_replica(keyframe)
        # An initial pose is kept for one more event: the next scan is searched for there, even if the robot stands.
        self._state = replace(
            self._state,
            keyframe_events=sequence + 1,
            awaiting_decision=True,
            reset_pending=False,
            initial_pose=initial_pose if after_reset else None,
            motion_condition="ordinary",
            marks=queue,
        )
        return [*scan_poses, keyframe, *self.intake.check_noise()]

    @property
    def _is_lifelong(self) -> bool:
        """Whether the map changes only where the world is new or has changed."""
        return self.mode == "lifelong" and not self._state.lost

    def _shows_changes(self, live: LiveHypothesis, scan: Scan, found: list[tuple[Changes, float]]) -> bool:
        """Whether a scan shows changes of a hypothesis's map, which are appended with its probability."""
        own, hybrid_map = live.filter, self._replica.maps[live.filter.hypothesis]
        rows = zip(own.keyframes, own.keyframe_areas, own.leading_keyframe_poses(), strict=True)
        known = [PlacedKeyframe(k, area, self._replica.scans[k], pose) for k, area, pose in rows]
        # A laser sees farther than the local map reaches.
        around = areas_around(hybrid_map, own.area, self._neighborhood, own.keyframe_areas)
        beyond = self._area_keyframes(own.hypothesis, {area: belief.mean for area, belief in around.items()})
        changes = detect_changes(RecentScan(scan, own.pose), live.event.recent_scans, [*known, *beyond], live.settings)
        live.add_recent_scan(scan)
        found.append((changes, self._replica.probabilities[own.hypothesis]))
        return changes.has_new_surface or changes.has_changed_surface

    def _take_scan_poses(self) -> list[Message]:
        """The poses of the scans since the last event, of every hypothesis."""
        scan_poses: list[Message] = [
            message
            for live in self._live_hypotheses.values()
            for message in live.take_scan_poses(self._state.first_unpublished_scan)
        ]
        self._state = replace(self._state, first_unpublished_scan=self._state.processed_scans)
        return scan_poses

    def _local_estimate(self, stamp: int) -> LocalEstimate:
        best, state = self.best_hypothesis, self._state
        return LocalEstimate(
            stamp,
            state.processed_scans - 1,
            best.filter.area,
            best.pose_belief(),
            self.intake.motion.odometry_pose,
            state.dropped_scans,
        )

    def _apply_hypotheses(self, message: Hypotheses) -> None:
        """Branch, re-base and drop filters as TSBI decided."""
        for live in self._live_hypotheses.values():
            live.prune({pruned.keyframe for pruned in message.pruned_keyframes})
        for hypothesis in message.hypotheses:
            if hypothesis.area_merge is not None:
                keyframes = self._replica.maps[hypothesis.parent].keyframes(hypothesis.area_merge.area)
                self._live_hypotheses[hypothesis.parent].merge(hypothesis.area_merge, keyframes)
        self._replica.apply_hypotheses(message)
        self._state = replace(
            self._state,
            lost=all(hypothesis.lost for hypothesis in message.hypotheses),
            reset_pending=self._state.reset_pending or all(child.tracking_reset for child in message.hypotheses),
        )
        children = {}
        for hypothesis in message.hypotheses:
            parent = self._live_hypotheses[hypothesis.parent]
            live = parent if hypothesis.id == hypothesis.parent else parent.branch(hypothesis.id)
            if hypothesis.local_areas:
                areas = {local.area: local.pose for local in hypothesis.local_areas}
                live.change_area(hypothesis, self._area_keyframes(hypothesis.id, areas), self._filters)
            children[hypothesis.id] = live
        for live in children.values() if message.stale_beams else ():
            if live.filter.keyframes[-1:] == [message.sequence]:
                # A reload, since one scan does not outweigh the former evidence in a grid.
                live.reload(self._local_map_keyframes(live))
        self._replace_hypotheses(children)

    def _apply_decision(self, decision: ClosureDecision) -> None:
        self._replica.apply_decision(decision)
        if decision.hypothesis is not None:
            live = self._live_hypotheses[decision.hypothesis]
            self._replace_hypotheses({decision.hypothesis: live})
            if decision.moved_keyframes:
                live.reload(self._local_map_keyframes(live))
        self._state = replace(self._state, awaiting_decision=False)

    def _replace_hypotheses(self, children: dict[int, LiveHypothesis]) -> None:
        for hypothesis, live in self._live_hypotheses.items():
            if children.get(hypothesis) is not live:
                live.filter.release()
        self._live_hypotheses = children

    def _area_keyframes(self, hypothesis: int, areas: Mapping[int, Float64]) -> list[PlacedKeyframe]:
        """The keyframes of areas for the local map, in the frame of the robot's area.

        :param areas: {area: ``robot_area_T_area``, shape (3,)}.
        """
        hybrid_map = self._replica.maps[hypothesis]
        return [
            PlacedKeyframe(keyframe, area, self._replica.scans[keyframe], se2.compose(frame, pose))
            for area, frame in areas.items()
            for keyframe, pose in hybrid_map.keyframes(area).items()
        ]

    def _local_map_keyframes(self, live: LiveHypothesis) -> list[PlacedKeyframe]:
        """The keyframes of the local map's areas, at their poses in the hybrid map."""
        own, areas = live.filter, dict.fromkeys(live.filter.keyframe_areas)
        beliefs = shortest_path_beliefs(self._replica.maps[own.hypothesis], own.area, targets=areas)
        return self._area_keyframes(own.hypothesis, {area: beliefs[area].mean for area in areas if area in beliefs})

    def _finish(self) -> list[Message]:
        self._ended = False
        processed, dropped = self._state.processed_scans, self._state.dropped_scans
        finished = EndOfRun(processed + dropped, processed, dropped)
        return [*self._take_scan_poses(), *self.intake.end(), finished]
