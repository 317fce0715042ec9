"""The recorder listens to the processes and keeps what the output folder needs.

Messages are filed by their own numbers, so that the order in which they arrive from several OS processes does not
matter; :meth:`Recorder.finish` then goes through the keyframe events in their order.
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
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
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
    OnlineTrajectory,
    RelativeTrajectory,
    Trajectory,
    complete_trajectory,
    relative_trajectory_of,
    trajectory_in_map,
)

# Keyframe events whose messages are kept at least, and as a share of all before: a record is written anew as a whole.
_MIN_EVENTS, _EVENT_SHARE = 64, 32

Numbered = TypeVar("Numbered", Keyframe, Hypotheses, ClosureDecision)


@dataclass(frozen=True, eq=False)
class Recording:
    """What a run came to.

    :ivar replica: scans and maps of the hypotheses that are alive at the end.
    :ivar area_poses: {area: belief over ``map_T_area``} of the most probable hypothesis.
    :ivar stamps: shape (n,), of all scans of all logs, ns, increasing.
    :ivar first_scans: number of the first scan of each log.
    :ivar relative_trajectory: the scans relative to the keyframes of the most probable hypothesis.
    :ivar odometry: ``odom_T_base`` of the scans.
    :ivar trajectory: ``map_T_base`` of the scans in the map.
    :ivar online_trajectory: the same as it was known when the scan was taken.
    :ivar probabilities: of every live topology at every keyframe event, in their order.
    :ivar last_estimate: the last estimate of metric SLAM.
    :ivar totals: scans received, processed and dropped.
    :ivar notices: what the processes had to tell a person.
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


@dataclass
class Recorder:
    """Value machine that answers nothing and remembers everything.

    :ivar configuration: that of the run, which goes into the output.
    :ivar earlier_record: what was recorded before the run, if it goes on from there.
    :ivar keyframes: {keyframe event: message}, likewise ``hypotheses`` and ``accepted``.
    :ivar scan_poses: {(hypothesis, first scan): message}.
    :ivar estimates: {scan index: what is kept of the message}; ``last``, the message of the last scan.
    :ivar notices: {(process, text): message} in the order of arrival.
    :ivar end_of_run: the last word of metric SLAM, None before it.
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
        """File a message; one that comes twice counts once."""
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
        # The pose is one of all particles', which a view of it would keep.
        kept = OnlineEstimate(message.stamp, message.area, message.pose.mean.copy(), message.odometry)
        self.estimates.setdefault(message.scan_index, kept)
        if self.last_estimate is None or message.scan_index > self.last_estimate.scan_index:
            self.last_estimate = message

    @property
    def is_complete(self) -> bool:
        """Whether the end has been heard and nothing is still on its way."""
        events, estimates = len(self.keyframes), len(self.earlier_record.estimates.scans) + len(self.estimates)
        return (
            self.end_of_run is not None
            and len(self.hypotheses) == len(self.decisions) == events
            and estimates >= self.end_of_run.processed
        )

    def record(self) -> RunRecord:
        """All that was heard up to now, when the answers to all keyframe events are here.

        :raises HmtSlamError: where messages were lost on the way.
        """
        past, first = self.earlier_record, self.earlier_record.events
        events = 1 + max([first - 1, *self.keyframes, *self.hypotheses, *self.decisions])
        keyframes = _ordered_messages("Keyframe", self.keyframes, first, events)
        hypotheses = _ordered_messages("Hypotheses", self.hypotheses, first, events)
        accepted = _ordered_messages("ClosureDecision", self.decisions, first, events)
        replica, sizes, probabilities, successors = _replay(past, keyframes, hypotheses, accepted)
        branched = {leaf.id: leaf.parent for message in hypotheses for leaf in _new_branches(message)}
        given = [verdict.global_poses for verdict in accepted if verdict.global_poses]
        found = replace(
            past,
            events=events,
            replica=replica.state,
            map_sizes=sizes,
            parents={**past.parents, **branched},
            probabilities=past.probabilities.concatenate(ProbabilityTable.from_rows(probabilities)),
            global_poses=given[-1] if given else past.global_poses,
            estimates=past.estimates.concatenate(EstimateTable.from_estimates(self.estimates)),
            online_trajectory=np.concatenate((past.online_trajectory, self._online_trajectory(keyframes, accepted))),
            last_estimate=self.last_estimate
            if self.last_estimate is None or not hypotheses
            else _follow_area_merge(self.last_estimate, hypotheses[-1]),
            notices=tuple(self.notices.values()),
        )
        alive = {known for hypothesis in replica.maps for known in found.lineage(hypothesis)}
        trails = past.scan_poses.concatenate(ScanPoseTable.from_messages(self.scan_poses.values()))
        return replace(
            found,
            parents={child: parent for child, parent in found.parents.items() if child in alive},
            scan_poses=trails.select_hypotheses(alive).replace_pruned(successors),
        )

    def compact(self) -> None:
        """Keep a record of what was heard instead of the messages, if these are many by now.

        They take ten times as much memory. To be called when the answers to all keyframe events are here.
        """
        if len(self.decisions) < max(_MIN_EVENTS, self.earlier_record.events // _EVENT_SHARE):
            return
        self.earlier_record = self.record()
        for messages in (self.keyframes, self.hypotheses, self.decisions, self.scan_poses, self.estimates):
            messages.clear()

    def _online_trajectory(self, keyframes: list[Keyframe], accepted: list[ClosureDecision]) -> Trajectory:
        """The poses of the scans that came since the past."""
        past = self.earlier_record
        before = None if not past.online_trajectory.size else (past.online_trajectory[-1], past.estimates.odometry[-1])
        verdicts = [
            AreaPoseUpdate(keyframe.scan.stamp, {entry.area: entry.pose.mean for entry in verdict.global_poses})
            for keyframe, verdict in zip(keyframes, accepted, strict=True)
        ]
        poses = OnlineTrajectory({entry.area: entry.pose.mean for entry in past.global_poses}, before)
        return poses.advance([self.estimates[scan] for scan in sorted(self.estimates)], verdicts)

    def finish(
        self, stamps: NDArray[np.int64], first_scans: tuple[int, ...] = (0,), earlier: RelativeTrajectory | None = None
    ) -> Recording:
        """Work out the final map, trajectories and probabilities.

        :param stamps: shape (n,), stamps of all scans as the processes got them, ns, increasing; the trajectories have
            a pose for each.
        :param first_scans: number of the first scan of each log, where they are of several.
        :param earlier: where scans of earlier logs were taken after the final refinement of that time.
        :raises HmtSlamError: where no scan gave a pose, or messages were lost on the way.
        """
        if self.last_estimate is None or self.end_of_run is None or not (self.keyframes or self.earlier_record.events):
            raise HmtSlamError(
                f"none of the {stamps.size} scans gave a pose: check that their ranges lie between range_min and "
                "range_max and that the log has odometry"
            )
        record = self.record()
        assert record.last_estimate is not None
        replica, given = Replica.from_state(record.replica), record.estimates
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
            complete_trajectory(stamps, given.stamps, given.odometry),
            trajectory_in_map(scans, poses),
            complete_trajectory(stamps, given.stamps, record.online_trajectory),
            record.probabilities.rows(),
            record.last_estimate,
            self.end_of_run,
            record.notices,
        )


def _follow_area_merge(last: LocalEstimate, newest: Hypotheses) -> LocalEstimate:
    """The last estimate, where its area became part of another since in the frame of that one."""
    for leaf in newest.hypotheses:
        if leaf.area_merge is not None and leaf.area_merge.area == last.area:
            return replace(last, area=leaf.area_merge.into, pose=leaf.area_merge.pose.compose(last.pose))
    return last


def _new_branches(message: Hypotheses) -> list[Hypothesis]:
    return [leaf for leaf in message.hypotheses if leaf.id != leaf.parent]


def _ordered_messages(name: str, messages: dict[int, Numbered], first: int, events: int) -> list[Numbered]:
    missing = next((sequence for sequence in range(first, events) if sequence not in messages), None)
    if missing is not None:
        raise HmtSlamError(
            f"the message {name} {missing} was lost: run again, with robot.flow_control=true in a replay"
        )
    return [messages[sequence] for sequence in range(first, events)]


def _replay(
    past: RunRecord, keyframes: list[Keyframe], hypotheses: list[Hypotheses], accepted: list[ClosureDecision]
) -> tuple[Replica, Mapping[int, tuple[int, int]], list[TopologyProbability], dict[int, ReplacementKeyframe]]:
    """The maps after some events, their numbers of areas and loop closures, and the probabilities at the events.

    Last, in their order, the keyframes that were forgotten and those that stand for them since then.
    """
    replica, sizes, probabilities = Replica.from_state(past.replica), past.map_sizes, list[TopologyProbability]()
    successors: dict[int, ReplacementKeyframe] = {}
    for keyframe, belief, verdict in zip(keyframes, hypotheses, accepted, strict=True):
        replica.add_keyframe(keyframe)
        successors |= _successors(replica, belief.pruned_keyframes)
        replica.apply_hypotheses(belief)
        sizes = {leaf.id: _map_size(replica, leaf, sizes) for leaf in belief.hypotheses}
        probabilities += [
            TopologyProbability(
                keyframe.sequence,
                keyframe.scan.stamp,
                keyframe.path_length,
                leaf.id,
                leaf.parent,
                leaf.probability,
                leaf.area,
                *sizes[leaf.id],
                leaf.id == verdict.hypothesis,
                belief.unexamined,
            )
            for leaf in belief.hypotheses
        ]
        replica.apply_decision(verdict)
    return replica, sizes, probabilities, successors


def _successors(replica: Replica, forgotten: Sequence[PrunedKeyframe]) -> dict[int, ReplacementKeyframe]:
    """{keyframe that is forgotten: the one that stands for it}, of the one hypothesis that there is then."""
    gone, hybrid_map = {one.keyframe for one in forgotten}, replica.maps[replica.best_hypothesis]
    found = {}
    for one in forgotten:
        placed = hybrid_map.keyframes(one.area)
        found[one.keyframe] = nearest_replacement(
            placed[one.keyframe], {k: at for k, at in placed.items() if k not in gone}
        )
    return found


def _map_size(replica: Replica, leaf: Hypothesis, sizes: Mapping[int, tuple[int, int]]) -> tuple[int, int]:
    """Areas and loop closures of a leaf, counted anew only where the leaf changed."""
    if leaf.id in sizes and not (leaf.arcs or leaf.moved_keyframes or leaf.removed_arcs or leaf.area_merge):
        return sizes[leaf.id]
    hybrid_map = replica.maps[leaf.id]
    return len(hybrid_map.area_ids()), sum(arc.closure for _, _, arc in hybrid_map.all_arcs())


def complete_area_poses(hybrid_map: HybridMap, given: Sequence[AreaPose]) -> dict[int, PoseGaussian]:
    """``map_T_area`` of every area: as TLCA last gave it, else along the arcs from an area that TLCA did give."""
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
