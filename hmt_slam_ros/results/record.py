"""The record of a run: the tables and maps from which the output folder is written."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import NamedTuple, Self, get_type_hints

import numpy as np

from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.keyframe_pruning import ReplacementKeyframe
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.messages import LocalEstimate, Notice, ScanPoses
from hmt_slam_ros.messages.replica import ReplicaState
from hmt_slam_ros.results.trajectories import OnlineEstimate


class TopologyProbability(NamedTuple):
    """A row of :class:`ProbabilityTable`, which describes the fields."""

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
    effective_samples: float
    mode_count: int


@dataclass(frozen=True, eq=False)
class Table:
    """Columns as arrays."""

    def concatenate(self, later: Self) -> Self:
        """The rows of this table, then those of another."""
        return type(self)(*(np.concatenate((getattr(self, c.name), getattr(later, c.name))) for c in fields(self)))

    @property
    def nbytes(self) -> int:
        """Memory of the columns, bytes."""
        return sum(getattr(self, column.name).nbytes for column in fields(self))


@dataclass(frozen=True, eq=False)
class ProbabilityTable(Table):
    """Probabilities of all hypotheses at all keyframe events, Eq. (14); each column has shape (n,).

    :ivar keyframe: number of the keyframe event.
    :ivar stamp: stamp of its scan, ns.
    :ivar path_length: path length since the start, m.
    :ivar hypothesis: id of the hypothesis.
    :ivar parent: id of the hypothesis that it continues.
    :ivar probability: P(gamma^t | d).
    :ivar area: the robot's area.
    :ivar areas: number of areas.
    :ivar closures: number of arcs that closed a loop.
    :ivar accepted: whether TLCA made the hypothesis definite at this event.
    :ivar unexamined: probability of the topologies that are not among the hypotheses.
    :ivar effective_samples: ESS of the particles of the hypothesis that it continues.
    :ivar mode_count: number of modes of the pose among them.
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
    effective_samples: Float64
    mode_count: Int64

    @classmethod
    def from_rows(cls, rows: Iterable[TopologyProbability] = ()) -> ProbabilityTable:
        """The table of rows."""
        kinds = get_type_hints(TopologyProbability).values()
        columns = list(zip(*rows, strict=True)) or [()] * len(kinds)
        return cls(*(np.array(column, dtype=kind) for column, kind in zip(columns, kinds, strict=True)))

    def rows(self) -> list[TopologyProbability]:
        """The rows."""
        columns = [getattr(self, entry.name).tolist() for entry in fields(self)]
        return [TopologyProbability(*row) for row in zip(*columns, strict=True)]


@dataclass(frozen=True, eq=False)
class EstimateTable(Table):
    """Estimates of metric SLAM for all scans, in their order.

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
        """The table of {number of the scan: estimate}."""
        numbers = sorted(estimates)
        rows = [estimates[number] for number in numbers]
        return cls(
            np.array(numbers, dtype=np.int64),
            np.array([row.stamp for row in rows], dtype=np.int64),
            np.array([row.area for row in rows], dtype=np.int64),
            np.array([row.pose for row in rows]).reshape(-1, 3),
            np.array([row.odometry for row in rows]).reshape(-1, 3),
        )


@dataclass(frozen=True, eq=False)
class ScanPoseTable(Table):
    """The messages ``ScanPoses`` of all hypotheses, one after the other.

    :ivar hypotheses: shape (n,), hypothesis of each message.
    :ivar first_scans: shape (n,), number of the first scan of each message.
    :ivar sizes: shape (n,), number of scans of each message.
    :ivar stamps: shape (sum of the sizes,), stamps of the scans, ns.
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
    def from_messages(cls, messages: Iterable[ScanPoses] = ()) -> ScanPoseTable:
        """The table of messages."""
        kept = list(messages)
        return cls(
            np.array([message.hypothesis for message in kept], dtype=np.int64),
            np.array([message.first_scan for message in kept], dtype=np.int64),
            np.array([message.stamps.size for message in kept], dtype=np.int64),
            np.concatenate([np.zeros(0, np.int64), *(message.stamps for message in kept)]),
            np.concatenate([np.zeros(0, np.int64), *(message.keyframes for message in kept)]),
            np.concatenate([np.zeros((0, 3)), *(message.poses for message in kept)]),
        )

    def select_hypotheses(self, hypotheses: Collection[int]) -> ScanPoseTable:
        """The messages of some hypotheses."""
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
        """The table with poses relative to pruned keyframes made relative to their replacements.

        :param successors: {pruned keyframe: replacement}, in the order of pruning.
        """
        if not successors:
            return self
        anchors, poses = self.keyframes.copy(), self.poses.copy()
        for pruned, replacement in successors.items():
            rows = np.flatnonzero(anchors == pruned)
            anchors[rows], poses[rows] = replacement.keyframe, se2.compose(replacement.pose, poses[rows])
        return replace(self, keyframes=anchors, poses=poses)

    def to_messages(self) -> list[ScanPoses]:
        """The messages."""
        ends = np.cumsum(self.sizes)
        headers = zip(self.hypotheses.tolist(), self.first_scans.tolist(), ends - self.sizes, ends, strict=True)
        return [
            ScanPoses(hypothesis, first, self.stamps[begin:end], self.keyframes[begin:end], self.poses[begin:end])
            for hypothesis, first, begin, end in headers
        ]


@dataclass(frozen=True, eq=False)
class RunRecord:
    """The record of a run up to a moment between two keyframe events.

    :ivar events: number of keyframe events.
    :ivar replica: the maps of the live hypotheses.
    :ivar map_sizes: {hypothesis: numbers of its areas and of its arcs that closed a loop}.
    :ivar parents: {hypothesis: the one from which it branched}, of the live ones and their ancestors.
    :ivar probabilities: probability of every hypothesis at every keyframe event, in their order.
    :ivar global_poses: the last ``map_T_area`` from TLCA, ordered by area.
    :ivar scan_poses: poses of the scans, of the live hypotheses and their ancestors.
    :ivar estimates: estimates of metric SLAM for all scans.
    :ivar online_trajectory: shape (n, 3), ``map_T_base`` of these scans as it was estimated at their time.
    :ivar last_estimate: the last estimate of metric SLAM, None before the first.
    :ivar notices: notices of the processes.
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
        """Memory of the tables, which grow with every scan and every keyframe event, bytes."""
        tables = (self.probabilities, self.scan_poses, self.estimates)
        return self.online_trajectory.nbytes + sum(table.nbytes for table in tables)

    def lineage(self, hypothesis: int) -> list[int]:
        """A hypothesis and its ancestors, the newest first. Ids are unique in a run."""
        lineage = [hypothesis]
        while lineage[-1] in self.parents:
            lineage.append(self.parents[lineage[-1]])
        return lineage

    def lineage_scan_poses(self, hypothesis: int) -> list[ScanPoses]:
        """The messages of a hypothesis and of its ancestors, in the order of their scans."""
        messages = self.scan_poses.select_hypotheses(self.lineage(hypothesis)).to_messages()
        return sorted(messages, key=lambda message: (message.first_scan, message.hypothesis))
