"""What the output folder needs of a run so far, without the messages from which it came."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.keyframe_pruning import ReplacementKeyframe
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.messages import LocalEstimate, Notice, ScanPoses
from hmt_slam_ros.messages.replica import ReplicaState
from hmt_slam_ros.results.trajectories import OnlineEstimate


@dataclass(frozen=True)
class TopologyProbability:
    """P(gamma^t | d), Eq. (14), of one live topology at one keyframe event.

    :ivar keyframe: the keyframe event.
    :ivar stamp: of its scan, ns.
    :ivar path_length: path length since the start, m.
    :ivar hypothesis: id of the topology.
    :ivar parent: id before the event.
    :ivar probability: as TSBI gave it.
    :ivar area: the robot's area.
    :ivar areas: number of areas of the topology.
    :ivar closures: number of arcs that closed a loop.
    :ivar accepted: whether TLCA made this topology definite at this event.
    :ivar unexamined: probability of topologies not among the live ones.
    """

    keyframe: int
    stamp: int
    path_length: float
    hypothesis: int
    parent: int
    probability: float
    area: int
    areas: int
    closures: int
    accepted: bool
    unexamined: float


@dataclass(frozen=True, eq=False)
class ProbabilityTable:
    """The probabilities of all live topologies at all keyframe events, each column of shape (n,).

    :ivar keyframe: the keyframe event.
    :ivar stamp: of its scan, ns.
    :ivar path_length: path length since the start, m.
    :ivar hypothesis: id of the topology.
    :ivar parent: id before the event.
    :ivar probability: as TSBI gave it.
    :ivar area: the robot's area.
    :ivar areas: number of areas of the topology.
    :ivar closures: number of arcs that closed a loop.
    :ivar accepted: whether TLCA made this topology definite at this event.
    :ivar unexamined: probability of topologies not among the live ones.
    """

    keyframe: Int64
    stamp: Int64
    path_length: Float64
    hypothesis: Int64
    parent: Int64
    probability: Float64
    area: Int64
    areas: Int64
    closures: Int64
    accepted: Bool
    unexamined: Float64

    @classmethod
    def from_rows(cls, rows: Iterable[TopologyProbability] = ()) -> ProbabilityTable:
        """Of some rows."""
        kept = list(rows)
        kinds = {"int": np.int64, "float": np.float64, "bool": np.bool_}
        columns: dict[str, Any] = {
            entry.name: np.array([getattr(row, entry.name) for row in kept], dtype=kinds[str(entry.type)])
            for entry in fields(TopologyProbability)
        }
        return cls(**columns)

    def concatenate(self, later: ProbabilityTable) -> ProbabilityTable:
        """With those of later events."""
        return ProbabilityTable(*_concatenate_columns(self, later))

    def rows(self) -> list[TopologyProbability]:
        """Its rows."""
        columns = [getattr(self, entry.name).tolist() for entry in fields(self)]
        return [TopologyProbability(*row) for row in zip(*columns, strict=True)]


@dataclass(frozen=True, eq=False)
class EstimateTable:
    """What metric SLAM said of every scan, in their order.

    :ivar scans: shape (n,), number of the scan.
    :ivar stamps: shape (n,), ns.
    :ivar areas: shape (n,), the robot's area.
    :ivar poses: shape (n, 3), ``area_T_base``, m and rad.
    :ivar odometry: shape (n, 3), ``odom_T_base``, m and rad.
    """

    scans: Int64
    stamps: Int64
    areas: Int64
    poses: Float64
    odometry: Float64

    @classmethod
    def from_estimates(cls, estimates: Mapping[int, OnlineEstimate]) -> EstimateTable:
        """Of {number of the scan: what was said of it}."""
        numbers = sorted(estimates)
        rows = [estimates[number] for number in numbers]
        return cls(
            np.array(numbers, dtype=np.int64),
            np.array([row.stamp for row in rows], dtype=np.int64),
            np.array([row.area for row in rows], dtype=np.int64),
            np.array([row.pose for row in rows]).reshape(-1, 3),
            np.array([row.odometry for row in rows]).reshape(-1, 3),
        )

    def concatenate(self, later: EstimateTable) -> EstimateTable:
        """With those of later scans."""
        return EstimateTable(*_concatenate_columns(self, later))


@dataclass(frozen=True, eq=False)
class ScanPoseTable:
    """Where scans were taken, under one hypothesis or another, one trail after the other.

    :ivar hypotheses: shape (n,), of each trail.
    :ivar first_scans: shape (n,), number of the first scan of each.
    :ivar sizes: shape (n,), how many scans each has.
    :ivar stamps: shape (sum of the sizes,), of the scans, ns.
    :ivar keyframes: shape (sum of the sizes,), the stored keyframe to which a scan's pose is relative.
    :ivar poses: shape (sum of the sizes, 3), ``keyframe_T_base``, m and rad.
    """

    hypotheses: Int64
    first_scans: Int64
    sizes: Int64
    stamps: Int64
    keyframes: Int64
    poses: Float64

    @classmethod
    def from_messages(cls, trails: Iterable[ScanPoses] = ()) -> ScanPoseTable:
        """Of some trails."""
        kept = list(trails)
        return cls(
            np.array([trail.hypothesis for trail in kept], dtype=np.int64),
            np.array([trail.first_scan for trail in kept], dtype=np.int64),
            np.array([trail.stamps.size for trail in kept], dtype=np.int64),
            np.concatenate([np.zeros(0, np.int64), *(trail.stamps for trail in kept)]),
            np.concatenate([np.zeros(0, np.int64), *(trail.keyframes for trail in kept)]),
            np.concatenate([np.zeros((0, 3)), *(trail.poses for trail in kept)]),
        )

    def concatenate(self, later: ScanPoseTable) -> ScanPoseTable:
        """With other trails."""
        return ScanPoseTable(*_concatenate_columns(self, later))

    def select_hypotheses(self, hypotheses: Collection[int]) -> ScanPoseTable:
        """Those of some hypotheses alone."""
        kept = np.isin(self.hypotheses, list(hypotheses))
        scans = np.repeat(kept, self.sizes)
        return ScanPoseTable(
            self.hypotheses[kept],
            self.first_scans[kept],
            self.sizes[kept],
            self.stamps[scans],
            self.keyframes[scans],
            self.poses[scans],
        )

    def replace_pruned(self, successors: Mapping[int, ReplacementKeyframe]) -> ScanPoseTable:
        """With scans that are related to forgotten keyframes related to others.

        :param successors: {forgotten keyframe: the one instead}, in the order in which they were forgotten.
        """
        if not successors:
            return self
        anchors, poses = self.keyframes.copy(), self.poses.copy()
        for gone, held in successors.items():
            rows = np.flatnonzero(anchors == gone)
            anchors[rows], poses[rows] = held.keyframe, se2.compose(held.pose, poses[rows])
        return replace(self, keyframes=anchors, poses=poses)

    def to_messages(self) -> list[ScanPoses]:
        """The trails."""
        ends = np.cumsum(self.sizes)
        heads = zip(self.hypotheses.tolist(), self.first_scans.tolist(), ends - self.sizes, ends, strict=True)
        return [
            ScanPoses(hypothesis, first, self.stamps[begin:end], self.keyframes[begin:end], self.poses[begin:end])
            for hypothesis, first, begin, end in heads
        ]


Table = TypeVar("Table", ProbabilityTable, EstimateTable, ScanPoseTable)


def _concatenate_columns(table: Table, later: Table) -> list[NDArray[Any]]:
    """The columns of two tables, one after the other."""
    return [np.concatenate((getattr(table, entry.name), getattr(later, entry.name))) for entry in fields(table)]


@dataclass(frozen=True, eq=False)
class RunRecord:
    """A run up to some moment between two keyframe events.

    :ivar events: keyframe events.
    :ivar replica: the maps of the live hypotheses.
    :ivar map_sizes: {hypothesis: numbers of its areas and of its arcs that closed a loop}.
    :ivar parents: {hypothesis: the one from which it branched}, of the live ones and their ancestors.
    :ivar probabilities: of every live topology at every keyframe event, in their order.
    :ivar global_poses: ``map_T_area`` as TLCA told it last, ordered by area.
    :ivar scan_poses: where scans were taken, of the live hypotheses and their ancestors.
    :ivar estimates: what metric SLAM said of every scan.
    :ivar online_trajectory: shape (n, 3), ``map_T_base`` of these scans as it was known at the time.
    :ivar last_estimate: the last of what metric SLAM said, None before the first.
    :ivar notices: what the processes had to tell a person.
    """

    events: int = 0
    replica: ReplicaState = field(default_factory=ReplicaState)
    map_sizes: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    parents: Mapping[int, int] = field(default_factory=dict)
    probabilities: ProbabilityTable = field(default_factory=ProbabilityTable.from_rows)
    global_poses: tuple[AreaPose, ...] = ()
    scan_poses: ScanPoseTable = field(default_factory=ScanPoseTable.from_messages)
    estimates: EstimateTable = field(default_factory=lambda: EstimateTable.from_estimates({}))
    online_trajectory: Float64 = field(default_factory=lambda: np.zeros((0, 3)))
    last_estimate: LocalEstimate | None = None
    notices: tuple[Notice, ...] = ()

    @property
    def table_bytes(self) -> int:
        """What the tables take, which grow with every scan and every keyframe event."""
        tables = (self.probabilities, self.scan_poses, self.estimates)
        columns = [getattr(table, entry.name) for table in tables for entry in fields(table)]
        return self.online_trajectory.nbytes + sum(column.nbytes for column in columns)

    def lineage(self, hypothesis: int) -> list[int]:
        """A hypothesis and its ancestors; ids are never used twice."""
        found = [hypothesis]
        while found[-1] in self.parents:
            found.append(self.parents[found[-1]])
        return found

    def lineage_scan_poses(self, hypothesis: int) -> list[ScanPoses]:
        """The trails of a hypothesis and of its ancestors, in the order of their scans."""
        lineage = set(self.lineage(hypothesis))
        own = (trail for trail in self.scan_poses.to_messages() if trail.hypothesis in lineage)
        return sorted(own, key=lambda trail: (trail.first_scan, trail.hypothesis))
