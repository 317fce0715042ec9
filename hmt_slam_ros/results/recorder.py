"""The recorder: receives the messages of the processes and keeps what the output folder needs.

It stores messages by their numbers, so that their order of arrival from several OS processes does not matter.
:meth:`Recorder.finish` then applies the keyframe events in their order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import NO_KEYFRAME, HybridMap
from hmt_slam_ros.hybrid_map.keyframe_pruning import ReplacementKeyframe, nearest_replacement
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.messages.map_changes import AreaPose, PrunedKeyframe
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    EndOfRun,
    Hypotheses,
    Hypothesis,
    Keyframe,
    LocalEstimate,
    Message,
    Notice,
    ScanPoses,
)
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.results.record import EstimateTable, ProbabilityTable, RunRecord, ScanPoseTable, TopologyProbability
from hmt_slam_ros.results.trajectories import (
    AreaPoseUpdate,
    OnlineEstimate,
    RelativeTrajectory,
    Trajectory,
    complete_trajectory,
    online_trajectory,
    relative_trajectory_of,
    trajectory_in_map,
)

_MIN_EVENTS, _EVENT_SHARE = 64, 32
"""Least number of keyframe events, and inverse of their share of all, after which messages become a record."""

Numbered = TypeVar("Numbered", Keyframe, Hypotheses, ClosureDecision)


@dataclass(frozen=True, eq=False)
class Recording:
    """The results of a run.

    :ivar replica: scans and maps of the hypotheses that are alive at the end.
    :ivar area_poses: {area: belief over ``map_T_area``} of the most probable hypothesis.
    :ivar stamps: shape (n,), stamps of all scans of all logs, ns, increasing.
    :ivar first_scans: number of the first scan of each log.
    :ivar relative_trajectory: the scans relative to the keyframes of the most probable hypothesis.
    :ivar odometry: ``odom_T_base`` of the scans.
    :ivar trajectory: ``map_T_base`` of the scans in the map.
    :ivar online_trajectory: ``map_T_base`` of the scans as it was estimated at their time.
    :ivar probabilities: probability of every hypothesis at every keyframe event, in their order.
    :ivar last_estimate: the last estimate of metric SLAM.
    :ivar totals: scans received, processed and dropped.
    :ivar notices: notices of the processes.
    """

    replica: Replica
    area_poses: dict[int, PoseGaussian]
    stamps: NDArray[np.int64]
    first_scans: tuple[int, ...]
    relative_trajectory: RelativeTrajectory
    odometry: Trajectory
    trajectory: Trajectory
    online_trajectory: Trajectory
    probabilities: list[TopologyProbability]
    last_estimate: LocalEstimate
    totals: EndOfRun
    notices: tuple[Notice, ...]

    @property
    def hybrid_map(self) -> HybridMap:
        """The map of the most probable hypothesis."""
        return self.replica.maps[self.replica.best_hypothesis]

    @property
    def own_totals(self) -> EndOfRun:
        """Scans of the newest log that were received, processed and dropped."""
        first = self.first_scans[-1]
        earlier = int((self.relative_trajectory.keyframes[:first] != NO_KEYFRAME).sum())
        return EndOfRun(
            self.totals.received - first, self.totals.processed - earlier, self.totals.dropped - (first - earlier)
        )

    @property
    def own_path_length(self) -> float:
        """Length of the path of the newest log up to its last keyframe, m."""
        begin = self.stamps[self.first_scans[-1]]
        earlier = [row.path_length for row in self.probabilities if row.stamp < begin]
        return self.probabilities[-1].path_length - (earlier[-1] if earlier else 0.0)


@dataclass
class Recorder:
    """A value machine that records messages and sends none.

    :ivar configuration: configuration of the run.
    :ivar earlier_record: the record up to the first of the messages below.
    :ivar keyframes: {keyframe event: message}, as ``hypotheses`` and ``decisions``.
    :ivar scan_poses: {(hypothesis, first scan): message}.
    :ivar estimates: {scan index: part of the message}; ``last_estimate`` is the message of the last scan.
    :ivar notices: {(process, text): message} in the order of arrival.
    :ivar end_of_run: last message of metric SLAM, None before it.
    """

    configuration: Configuration
    earlier_record: RunRecord = field(default_factory=RunRecord)
    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    hypotheses: dict[int, Hypotheses] = field(default_factory=dict)
    decisions: dict[int, ClosureDecision] = field(default_factory=dict)
    scan_poses: dict[tuple[int, int], ScanPoses] = field(default_factory=dict)
    estimates: dict[int, OnlineEstimate] = field(default_factory=dict)
    last_estimate: LocalEstimate | None = None
    notices: dict[tuple[str, str], Notice] = field(default_factory=dict)
    end_of_run: EndOfRun | None = None

    def __post_init__(self) -> None:
        self.last_estimate = self.earlier_record.last_estimate
        self.notices = {(notice.process, notice.text): notice for notice in self.earlier_record.notices}

    def handle(self, message: Message) -> list[Message]:
        """Store a message; a repeated message is ignored."""
        match message:
            case Keyframe():
                self.keyframes.setdefault(message.sequence, message)
            case Hypotheses():
                self.hypotheses.setdefault(message.sequence, message)
            case ClosureDecision():
                self.decisions.setdefault(message.sequence, message)
            case ScanPoses():
                self.scan_poses[message.hypothesis, message.first_scan] = message
            case LocalEstimate():
                self._add_estimate(message)
            case Notice():
                self.notices.setdefault((message.process, message.text), message)
            case EndOfRun():
                self.end_of_run = message
        return []

    def _add_estimate(self, message: LocalEstimate) -> None:
        # The mean is a view of the poses of all particles: a copy releases them.
        estimate = OnlineEstimate(message.stamp, message.area, message.pose.mean.copy(), message.odometry)
        self.estimates.setdefault(message.scan_index, estimate)
        if self.last_estimate is None or message.scan_index > self.last_estimate.scan_index:
            self.last_estimate = message

    @property
    def is_complete(self) -> bool:
        """Whether the end of the run and all messages before it have arrived."""
        events, estimates = len(self.keyframes), len(self.earlier_record.estimates.scans) + len(self.estimates)
        return (
            self.end_of_run is not None
            and len(self.hypotheses) == len(self.decisions) == events
            and estimates >= self.end_of_run.processed
        )

    def record(self) -> RunRecord:
        """The record up to now. The answers to all keyframe events must have arrived.

        :raises HmtSlamError: where a message was lost.
        """
        past, first = self.earlier_record, self.earlier_record.events
        events = 1 + max([first - 1, *self.keyframes, *self.hypotheses, *self.decisions])
        keyframes = _ordered_messages("Keyframe", self.keyframes, first, events)
        hypotheses = _ordered_messages("Hypotheses", self.hypotheses, first, events)
        decisions = _ordered_messages("ClosureDecision", self.decisions, first, events)
        replica, sizes, probabilities, successors = _replay(past, keyframes, hypotheses, decisions)
        branched = {h.id: h.parent for message in hypotheses for h in message.hypotheses if h.id != h.parent}
        global_poses = [decision.global_poses for decision in decisions if decision.global_poses]
        record = replace(
            past,
            events=events,
            replica=replica.state,
            map_sizes=sizes,
            parents={**past.parents, **branched},
            probabilities=past.probabilities.concatenate(ProbabilityTable.from_rows(probabilities)),
            global_poses=global_poses[-1] if global_poses else past.global_poses,
            estimates=past.estimates.concatenate(EstimateTable.from_estimates(self.estimates)),
            online_trajectory=np.concatenate((past.online_trajectory, self._online_trajectory(keyframes, decisions))),
            last_estimate=self.last_estimate
            if self.last_estimate is None or not hypotheses
            else _follow_area_merge(self.last_estimate, hypotheses[-1]),
            notices=tuple(self.notices.values()),
        )
        alive = {ancestor for hypothesis in replica.maps for ancestor in record.lineage(hypothesis)}
        scan_poses = past.scan_poses.concatenate(ScanPoseTable.from_messages(self.scan_poses.values()))
        return replace(
            record,
            parents={child: parent for child, parent in record.parents.items() if child in alive},
            scan_poses=scan_poses.select_hypotheses(alive).replace_pruned(successors),
        )

    def compact(self) -> None:
        """Replace the messages by a record where they are many: they take ten times as much memory.

        The answers to all keyframe events must have arrived.
        """
        if len(self.decisions) < max(_MIN_EVENTS, self.earlier_record.events // _EVENT_SHARE):
            return
        self.earlier_record = self.record()
        for messages in (self.keyframes, self.hypotheses, self.decisions, self.scan_poses, self.estimates):
            messages.clear()

    def _online_trajectory(self, keyframes: list[Keyframe], decisions: list[ClosureDecision]) -> Trajectory:
        """The poses of the scans since the earlier record."""
        past = self.earlier_record
        previous = (
            None if not past.online_trajectory.size else (past.online_trajectory[-1], past.estimates.odometry[-1])
        )
        updates = [
            AreaPoseUpdate(keyframe.scan.stamp, {entry.area: entry.pose.mean for entry in decision.global_poses})
            for keyframe, decision in zip(keyframes, decisions, strict=True)
        ]
        estimates = [self.estimates[scan] for scan in sorted(self.estimates)]
        area_poses = {entry.area: entry.pose.mean for entry in past.global_poses}
        return online_trajectory(estimates, updates, area_poses, previous)

    def finish(
        self, stamps: NDArray[np.int64], first_scans: tuple[int, ...] = (0,), earlier: RelativeTrajectory | None = None
    ) -> Recording:
        """The results of the run: maps, trajectories and probabilities.

        :param stamps: shape (n,), stamps of all scans as the processes received them, ns, increasing; the trajectories
            have a pose for each.
        :param first_scans: number of the first scan of each log.
        :param earlier: refined trajectory of the earlier logs.
        :raises HmtSlamError: where no scan has a pose, or a message was lost.
        """
        if self.last_estimate is None or self.end_of_run is None or not (self.keyframes or self.earlier_record.events):
            raise HmtSlamError(
                f"none of the {stamps.size} scans gave a pose: check that their ranges lie between range_min and "
                "range_max and that the log has odometry"
            )
        record = self.record()
        assert record.last_estimate is not None
        replica, estimates = Replica.from_state(record.replica), record.estimates
        area_poses = complete_area_poses(replica.maps[replica.best_hypothesis], record.global_poses)
        poses = keyframe_poses(replica.maps[replica.best_hypothesis], area_poses)
        scans = relative_trajectory_of(stamps, record.lineage_scan_poses(replica.best_hypothesis)).replace_start(
            earlier or RelativeTrajectory.empty(), poses
        )
        return Recording(
            replica,
            area_poses,
            stamps,
            first_scans,
            scans,
            complete_trajectory(stamps, estimates.stamps, estimates.odometry),
            trajectory_in_map(scans, poses),
            complete_trajectory(stamps, estimates.stamps, record.online_trajectory),
            record.probabilities.rows(),
            record.last_estimate,
            self.end_of_run,
            record.notices,
        )


def _follow_area_merge(last: LocalEstimate, newest: Hypotheses) -> LocalEstimate:
    """The last estimate, in the frame of the merged area where its area was merged into another."""
    for merge in (hypothesis.area_merge for hypothesis in newest.hypotheses):
        if merge is not None and merge.area == last.area:
            return replace(last, area=merge.into, pose=merge.pose.compose(last.pose))
    return last


def _ordered_messages(name: str, messages: dict[int, Numbered], first: int, events: int) -> list[Numbered]:
    missing = next((sequence for sequence in range(first, events) if sequence not in messages), None)
    if missing is not None:
        raise HmtSlamError(
            f"the message {name} {missing} was lost: run again, with robot.flow_control=true in a replay"
        )
    return [messages[sequence] for sequence in range(first, events)]


def _replay(
    past: RunRecord, keyframes: list[Keyframe], hypotheses: list[Hypotheses], decisions: list[ClosureDecision]
) -> tuple[Replica, Mapping[int, tuple[int, int]], list[TopologyProbability], dict[int, ReplacementKeyframe]]:
    """The maps after the events, their numbers of areas and loop closures, the probabilities at the events.

    The last value is {pruned keyframe: replacement}, in the order of pruning.
    """
    replica, sizes, probabilities = Replica.from_state(past.replica), past.map_sizes, list[TopologyProbability]()
    successors: dict[int, ReplacementKeyframe] = {}
    for keyframe, message, decision in zip(keyframes, hypotheses, decisions, strict=True):
        replica.add_keyframe(keyframe)
        successors |= _successors(replica, message.pruned_keyframes)
        replica.apply_hypotheses(message)
        estimates = {estimate.hypothesis: estimate for estimate in keyframe.estimates}
        sizes = {h.id: _map_size(replica, h, sizes) for h in message.hypotheses}
        probabilities += [
            TopologyProbability(
                keyframe.sequence,
                keyframe.scan.stamp,
                keyframe.path_length,
                h.id,
                h.parent,
                h.probability,
                h.area,
                *sizes[h.id],
                h.id == decision.hypothesis,
                message.unexamined,
                estimates[h.parent].effective_samples,
                estimates[h.parent].mode_count,
            )
            for h in message.hypotheses
        ]
        replica.apply_decision(decision)
    return replica, sizes, probabilities, successors


def _successors(replica: Replica, pruned: Sequence[PrunedKeyframe]) -> dict[int, ReplacementKeyframe]:
    """{pruned keyframe: replacement}. Keyframes are pruned only where there is one hypothesis."""
    numbers, hybrid_map = {entry.keyframe for entry in pruned}, replica.maps[replica.best_hypothesis]
    replacements = {}
    for entry in pruned:
        poses = hybrid_map.keyframes(entry.area)
        remaining = {keyframe: pose for keyframe, pose in poses.items() if keyframe not in numbers}
        replacements[entry.keyframe] = nearest_replacement(poses[entry.keyframe], remaining)
    return replacements


def _map_size(replica: Replica, h: Hypothesis, sizes: Mapping[int, tuple[int, int]]) -> tuple[int, int]:
    """Numbers of areas and loop closures of a hypothesis, counted again only where its map changed."""
    if h.id in sizes and not (h.arcs or h.moved_keyframes or h.removed_arcs or h.area_merge):
        return sizes[h.id]
    hybrid_map = replica.maps[h.id]
    return len(hybrid_map.area_ids()), sum(arc.closure for _, _, arc in hybrid_map.all_arcs())


def complete_area_poses(hybrid_map: HybridMap, given: Sequence[AreaPose]) -> dict[int, PoseGaussian]:
    """``map_T_area`` of every area: the given one, else along the arcs from an area with a given one.

    :param given: the last global poses from TLCA.
    """
    known = {entry.area: entry.pose for entry in given}
    areas = hybrid_map.area_ids()
    start = next((area for area in areas if area in known), areas[0])
    along_arcs = shortest_path_beliefs(hybrid_map, start)
    origin = known.get(start, along_arcs[start])
    return {area: known[area] if area in known else origin.compose(along_arcs[area]) for area in areas}


def keyframe_poses(hybrid_map: HybridMap, area_poses: Mapping[int, PoseGaussian]) -> dict[int, NDArray[np.float64]]:
    """{keyframe: ``map_T_base``, shape (3,)} in the order of the areas."""
    return {
        keyframe: se2.compose(area_poses[area].mean, pose)
        for area in hybrid_map.area_ids()
        for keyframe, pose in hybrid_map.keyframes(area).items()
    }
