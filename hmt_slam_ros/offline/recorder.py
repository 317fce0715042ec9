"""The recorder listens to the five processes and keeps what the output folder needs.

Messages are filed by their own numbers, so that the order in which they arrive from several OS processes does not
matter; :meth:`Recorder.finish` then goes through the keyframe events in their order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.offline.trajectories import (
    Anchored,
    OnlinePose,
    Trajectory,
    anchored,
    carried,
    odometry_trajectory,
    online_trajectory,
)
from hmt_slam_ros.processes.messages import (
    Accepted,
    Finished,
    Hypotheses,
    Keyframe,
    Leaf,
    LocalEstimate,
    Message,
    Notice,
    Trail,
)
from hmt_slam_ros.processes.replica import Replica
from hmt_slam_ros.topology.hybrid_map import HybridMap
from hmt_slam_ros.topology.shortest_path import reachable

Numbered = TypeVar("Numbered", Keyframe, Hypotheses, Accepted)


@dataclass(frozen=True)
class TopologyProbability:
    """P(gamma^t | d), Eq. (14), of one live topology at one keyframe event.

    :ivar keyframe: the keyframe event.
    :ivar stamp: of its scan, ns.
    :ivar travelled: path length since the start, m.
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
    travelled: float
    hypothesis: int
    parent: int
    probability: float
    area: int
    areas: int
    closures: int
    accepted: bool
    unexamined: float


@dataclass(frozen=True, eq=False)
class Recording:
    """What a run came to.

    :ivar replica: scans and maps of the hypotheses that are alive at the end.
    :ivar area_poses: {area: belief over ``map_T_area``} of the most probable hypothesis.
    :ivar stamps: shape (n,), of all scans of the log, ns, increasing.
    :ivar scans: the scans of the log relative to the keyframes of the most probable hypothesis.
    :ivar odometry: ``odom_T_base`` of the scans.
    :ivar trajectory: ``map_T_base`` of the scans in the map.
    :ivar online: the same as it was known when the scan was taken.
    :ivar probabilities: of every live topology at every keyframe event, in their order.
    :ivar last: the last estimate of metric SLAM.
    :ivar totals: scans received, processed and dropped.
    :ivar notices: what the processes had to tell a person.
    """

    replica: Replica
    area_poses: dict[int, PoseGaussian]
    stamps: NDArray[np.int64]
    scans: Anchored
    odometry: Trajectory
    trajectory: Trajectory
    online: Trajectory
    probabilities: list[TopologyProbability]
    last: LocalEstimate
    totals: Finished
    notices: tuple[Notice, ...]

    @property
    def hybrid_map(self) -> HybridMap:
        """The map of the most probable hypothesis."""
        return self.replica.maps[self.replica.best]


@dataclass
class Recorder:
    """Value machine that answers nothing and remembers everything.

    :ivar configuration: that of the run, which goes into the output.
    :ivar keyframes: {keyframe event: message}, likewise ``hypotheses`` and ``accepted``.
    :ivar trails: {(hypothesis, first scan): message}.
    :ivar estimates: {scan index: what is kept of the message}; ``last``, the message of the last scan.
    :ivar notices: {(process, text): message} in the order of arrival.
    :ivar finished: the last word of metric SLAM, None before it.
    """

    configuration: Configuration
    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    hypotheses: dict[int, Hypotheses] = field(default_factory=dict)
    accepted: dict[int, Accepted] = field(default_factory=dict)
    trails: dict[tuple[int, int], Trail] = field(default_factory=dict)
    estimates: dict[int, OnlinePose] = field(default_factory=dict)
    last: LocalEstimate | None = None
    notices: dict[tuple[str, str], Notice] = field(default_factory=dict)
    finished: Finished | None = None

    def handle(self, message: Message) -> list[Message]:
        """File a message; one that comes twice counts once."""
        match message:
            case Keyframe():
                self.keyframes.setdefault(message.sequence, message)
            case Hypotheses():
                self.hypotheses.setdefault(message.sequence, message)
            case Accepted():
                self.accepted.setdefault(message.sequence, message)
            case Trail():
                self.trails[message.hypothesis, message.first_scan] = message
            case LocalEstimate():
                self._keep(message)
            case Notice():
                self.notices.setdefault((message.process, message.text), message)
            case Finished():
                self.finished = message
        return []

    def _keep(self, message: LocalEstimate) -> None:
        # The pose is one of all particles', which a view of it would keep.
        kept = OnlinePose(message.stamp, message.area, message.pose.mean.copy(), message.odometry)
        self.estimates.setdefault(message.scan_index, kept)
        if self.last is None or message.scan_index > self.last.scan_index:
            self.last = message

    @property
    def complete(self) -> bool:
        """Whether the end has been heard and nothing is still on its way."""
        events = len(self.keyframes)
        return (
            self.finished is not None
            and len(self.hypotheses) == len(self.accepted) == events
            and len(self.estimates) >= self.finished.processed
        )

    def finish(self, stamps: NDArray[np.int64]) -> Recording:
        """Work out the final map, trajectories and probabilities.

        :param stamps: shape (n,), stamps of all scans of the log as the processes got them, ns, increasing; the
            trajectories have a pose for each.
        :raises HmtSlamError: where no scan gave a pose, or messages were lost on the way.
        """
        if self.last is None or not self.keyframes or self.finished is None:
            raise HmtSlamError(
                f"none of the {stamps.size} scans gave a pose: check that their ranges lie between range_min and "
                "range_max and that the log has odometry"
            )
        events = 1 + max(max(heard) for heard in (self.keyframes, self.hypotheses, self.accepted) if heard)
        keyframes = _gapless("Keyframe", self.keyframes, events)
        hypotheses = _gapless("Hypotheses", self.hypotheses, events)
        accepted = _gapless("Accepted", self.accepted, events)
        replica, probabilities = _replay(keyframes, hypotheses, accepted)
        area_poses = _area_poses(replica.maps[replica.best], accepted)
        scans = anchored(stamps, self._own_trails(replica.best))
        return Recording(
            replica,
            area_poses,
            stamps,
            scans,
            odometry_trajectory(stamps, self.estimates),
            carried(scans, keyframe_poses(replica.maps[replica.best], area_poses)),
            online_trajectory(stamps, self.estimates, keyframes, accepted),
            probabilities,
            _in_area_now(self.last, hypotheses[-1]),
            self.finished,
            tuple(self.notices.values()),
        )

    def _own_trails(self, hypothesis: int) -> list[Trail]:
        """The trails of a hypothesis and of its ancestors, in the order of their scans; ids are never used twice."""
        parents = {leaf.hypothesis: leaf.parent for message in self.hypotheses.values() for leaf in _branched(message)}
        lineage = [hypothesis]
        while lineage[-1] in parents:
            lineage.append(parents[lineage[-1]])
        return sorted(
            (trail for trail in self.trails.values() if trail.hypothesis in lineage),
            key=lambda trail: (trail.first_scan, trail.hypothesis),
        )


def _in_area_now(last: LocalEstimate, newest: Hypotheses) -> LocalEstimate:
    """The last estimate, where its area became part of another since in the frame of that one."""
    for leaf in newest.leaves:
        if leaf.merged is not None and leaf.merged.area == last.area:
            return replace(last, area=leaf.merged.into, pose=leaf.merged.pose.compose(last.pose))
    return last


def _branched(message: Hypotheses) -> list[Leaf]:
    return [leaf for leaf in message.leaves if leaf.hypothesis != leaf.parent]


def _gapless(name: str, messages: dict[int, Numbered], events: int) -> list[Numbered]:
    missing = next((sequence for sequence in range(events) if sequence not in messages), None)
    if missing is not None:
        raise HmtSlamError(f"the message {name} {missing} was lost: run again, with robot.paced=true in a replay")
    return [messages[sequence] for sequence in range(events)]


def _replay(
    keyframes: list[Keyframe], hypotheses: list[Hypotheses], accepted: list[Accepted]
) -> tuple[Replica, list[TopologyProbability]]:
    replica, probabilities, sizes = Replica(), list[TopologyProbability](), dict[int, tuple[int, int]]()
    for keyframe, belief, verdict in zip(keyframes, hypotheses, accepted, strict=True):
        replica.add(keyframe)
        replica.apply(belief)
        sizes = {leaf.hypothesis: _size(replica, leaf, sizes) for leaf in belief.leaves}
        probabilities += [
            TopologyProbability(
                keyframe.sequence,
                keyframe.scan.stamp,
                keyframe.travelled,
                leaf.hypothesis,
                leaf.parent,
                leaf.probability,
                leaf.area,
                *sizes[leaf.hypothesis],
                leaf.hypothesis == verdict.hypothesis,
                belief.unexamined,
            )
            for leaf in belief.leaves
        ]
        replica.accept(verdict)
    return replica, probabilities


def _size(replica: Replica, leaf: Leaf, sizes: dict[int, tuple[int, int]]) -> tuple[int, int]:
    """Areas and loop closures of a leaf, counted anew only where the leaf changed."""
    if leaf.hypothesis in sizes and not (leaf.arcs or leaf.relabelled or leaf.withdrawn or leaf.merged):
        return sizes[leaf.hypothesis]
    hybrid_map = replica.maps[leaf.hypothesis]
    return len(hybrid_map.area_ids()), sum(arc.closure for _, _, arc in hybrid_map.all_arcs())


def _area_poses(hybrid_map: HybridMap, accepted: list[Accepted]) -> dict[int, PoseGaussian]:
    """``map_T_area`` of every area: as TLCA last gave it, else along the arcs from an area that TLCA did give."""
    known = latest_poses(accepted)
    areas = hybrid_map.area_ids()
    start = next((area for area in areas if area in known), areas[0])
    along_arcs = reachable(hybrid_map, start)
    origin = known.get(start, along_arcs[start])
    return {area: known[area] if area in known else origin.compose(along_arcs[area]) for area in areas}


def keyframe_poses(
    hybrid_map: HybridMap, area_poses: Mapping[int, PoseGaussian]
) -> dict[int, NDArray[np.float64]]:
    """{keyframe: ``map_T_base``, shape (3,)} in the order of the areas."""
    return {
        keyframe: se2.compose(area_poses[area].mean, pose)
        for area in hybrid_map.area_ids()
        for keyframe, pose in hybrid_map.keyframes(area).items()
    }


def latest_poses(accepted: list[Accepted]) -> dict[int, PoseGaussian]:
    """``map_T_area`` of the last verdict that gave any."""
    given = next((verdict.global_poses for verdict in reversed(accepted) if verdict.global_poses), ())
    return {entry.area: entry.pose for entry in given}
