"""The recorder listens to the five processes and keeps what the output folder needs.

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
from hmt_slam_ros.hybrid_map.keyframe_pruning import Successor, successor
from hmt_slam_ros.hybrid_map.shortest_path import reachable
from hmt_slam_ros.messages.map_changes import AreaPose, Forgotten
from hmt_slam_ros.messages.messages import (
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
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.results.record import EstimateTable, ProbabilityTable, Record, TopologyProbability, TrailTable
from hmt_slam_ros.results.trajectories import (
    Anchored,
    OnlinePose,
    OnlinePoses,
    Trajectory,
    Verdict,
    anchored,
    carried,
    of_all,
)

# Keyframe events whose messages are kept at least, and as a share of all before: a record is written anew as a whole.
_FOLDED, _SHARE = 64, 32

Numbered = TypeVar("Numbered", Keyframe, Hypotheses, Accepted)


@dataclass(frozen=True, eq=False)
class Recording:
    """What a run came to.

    :ivar replica: scans and maps of the hypotheses that are alive at the end.
    :ivar area_poses: {area: belief over ``map_T_area``} of the most probable hypothesis.
    :ivar stamps: shape (n,), of all scans of all logs, ns, increasing.
    :ivar first_scans: number of the first scan of each log.
    :ivar scans: the scans relative to the keyframes of the most probable hypothesis.
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
    first_scans: tuple[int, ...]
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
    :ivar past: what was recorded before the run, if it goes on from there.
    :ivar keyframes: {keyframe event: message}, likewise ``hypotheses`` and ``accepted``.
    :ivar trails: {(hypothesis, first scan): message}.
    :ivar estimates: {scan index: what is kept of the message}; ``last``, the message of the last scan.
    :ivar notices: {(process, text): message} in the order of arrival.
    :ivar finished: the last word of metric SLAM, None before it.
    """

    configuration: Configuration
    past: Record = field(default_factory=Record)
    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    hypotheses: dict[int, Hypotheses] = field(default_factory=dict)
    accepted: dict[int, Accepted] = field(default_factory=dict)
    trails: dict[tuple[int, int], Trail] = field(default_factory=dict)
    estimates: dict[int, OnlinePose] = field(default_factory=dict)
    last: LocalEstimate | None = None
    notices: dict[tuple[str, str], Notice] = field(default_factory=dict)
    finished: Finished | None = None

    def __post_init__(self) -> None:
        self.last = self.past.last
        self.notices = {(notice.process, notice.text): notice for notice in self.past.notices}

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
        events, estimates = len(self.keyframes), len(self.past.estimates.scans) + len(self.estimates)
        return (
            self.finished is not None
            and len(self.hypotheses) == len(self.accepted) == events
            and estimates >= self.finished.processed
        )

    def record(self) -> Record:
        """All that was heard up to now, when the answers to all keyframe events are here.

        :raises HmtSlamError: where messages were lost on the way.
        """
        past, first = self.past, self.past.events
        events = 1 + max([first - 1, *self.keyframes, *self.hypotheses, *self.accepted])
        keyframes = _gapless("Keyframe", self.keyframes, first, events)
        hypotheses = _gapless("Hypotheses", self.hypotheses, first, events)
        accepted = _gapless("Accepted", self.accepted, first, events)
        replica, sizes, probabilities, successors = _replay(past, keyframes, hypotheses, accepted)
        branched = {leaf.hypothesis: leaf.parent for message in hypotheses for leaf in _branched(message)}
        given = [verdict.global_poses for verdict in accepted if verdict.global_poses]
        found = replace(
            past,
            events=events,
            replica=replica.state,
            sizes=sizes,
            parents={**past.parents, **branched},
            probabilities=past.probabilities.and_then(ProbabilityTable.of(probabilities)),
            global_poses=given[-1] if given else past.global_poses,
            estimates=past.estimates.and_then(EstimateTable.of(self.estimates)),
            online=np.concatenate((past.online, self._online(keyframes, accepted))),
            last=self.last if self.last is None or not hypotheses else _in_area_now(self.last, hypotheses[-1]),
            notices=tuple(self.notices.values()),
        )
        alive = {known for hypothesis in replica.maps for known in found.lineage(hypothesis)}
        trails = past.trails.and_then(TrailTable.of(self.trails.values()))
        return replace(
            found,
            parents={child: parent for child, parent in found.parents.items() if child in alive},
            trails=trails.of_hypotheses(alive).related_to(successors),
        )

    def fold(self) -> None:
        """Keep a record of what was heard instead of the messages, if these are many by now.

        They take ten times as much memory. To be called when the answers to all keyframe events are here.
        """
        if len(self.accepted) < max(_FOLDED, self.past.events // _SHARE):
            return
        self.past = self.record()
        for messages in (self.keyframes, self.hypotheses, self.accepted, self.trails, self.estimates):
            messages.clear()

    def _online(self, keyframes: list[Keyframe], accepted: list[Accepted]) -> Trajectory:
        """The poses of the scans that came since the past."""
        past = self.past
        before = None if not past.online.size else (past.online[-1], past.estimates.odometry[-1])
        verdicts = [
            Verdict(keyframe.scan.stamp, {entry.area: entry.pose.mean for entry in verdict.global_poses})
            for keyframe, verdict in zip(keyframes, accepted, strict=True)
        ]
        poses = OnlinePoses({entry.area: entry.pose.mean for entry in past.global_poses}, before)
        return poses.of([self.estimates[scan] for scan in sorted(self.estimates)], verdicts)

    def finish(
        self, stamps: NDArray[np.int64], first_scans: tuple[int, ...] = (0,), earlier: Anchored | None = None
    ) -> Recording:
        """Work out the final map, trajectories and probabilities.

        :param stamps: shape (n,), stamps of all scans as the processes got them, ns, increasing; the trajectories have
            a pose for each.
        :param first_scans: number of the first scan of each log, where they are of several.
        :param earlier: where scans of earlier logs were taken after the final refinement of that time.
        :raises HmtSlamError: where no scan gave a pose, or messages were lost on the way.
        """
        if self.last is None or self.finished is None or not (self.keyframes or self.past.events):
            raise HmtSlamError(
                f"none of the {stamps.size} scans gave a pose: check that their ranges lie between range_min and "
                "range_max and that the log has odometry"
            )
        record = self.record()
        assert record.last is not None
        replica, given = Replica.of(record.replica), record.estimates
        area_poses = placed_areas(replica.maps[replica.best], record.global_poses)
        poses = keyframe_poses(replica.maps[replica.best], area_poses)
        scans = anchored(stamps, record.own_trails(replica.best)).beginning_with(earlier or Anchored.none(), poses)
        return Recording(
            replica,
            area_poses,
            stamps,
            first_scans,
            scans,
            of_all(stamps, given.stamps, given.odometry),
            carried(scans, poses),
            of_all(stamps, given.stamps, record.online),
            record.probabilities.rows(),
            record.last,
            self.finished,
            record.notices,
        )


def _in_area_now(last: LocalEstimate, newest: Hypotheses) -> LocalEstimate:
    """The last estimate, where its area became part of another since in the frame of that one."""
    for leaf in newest.leaves:
        if leaf.merged is not None and leaf.merged.area == last.area:
            return replace(last, area=leaf.merged.into, pose=leaf.merged.pose.compose(last.pose))
    return last


def _branched(message: Hypotheses) -> list[Leaf]:
    return [leaf for leaf in message.leaves if leaf.hypothesis != leaf.parent]


def _gapless(name: str, messages: dict[int, Numbered], first: int, events: int) -> list[Numbered]:
    missing = next((sequence for sequence in range(first, events) if sequence not in messages), None)
    if missing is not None:
        raise HmtSlamError(f"the message {name} {missing} was lost: run again, with robot.paced=true in a replay")
    return [messages[sequence] for sequence in range(first, events)]


def _replay(
    past: Record, keyframes: list[Keyframe], hypotheses: list[Hypotheses], accepted: list[Accepted]
) -> tuple[Replica, Mapping[int, tuple[int, int]], list[TopologyProbability], dict[int, Successor]]:
    """The maps after some events, their numbers of areas and loop closures, and the probabilities at the events.

    Last, in their order, the keyframes that were forgotten and those that stand for them since then.
    """
    replica, sizes, probabilities = Replica.of(past.replica), past.sizes, list[TopologyProbability]()
    successors: dict[int, Successor] = {}
    for keyframe, belief, verdict in zip(keyframes, hypotheses, accepted, strict=True):
        replica.add(keyframe)
        successors |= _successors(replica, belief.forgotten)
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
    return replica, sizes, probabilities, successors


def _successors(replica: Replica, forgotten: Sequence[Forgotten]) -> dict[int, Successor]:
    """{keyframe that is forgotten: the one that stands for it}, of the one hypothesis that there is then."""
    gone, hybrid_map = {one.keyframe for one in forgotten}, replica.maps[replica.best]
    found = {}
    for one in forgotten:
        placed = hybrid_map.keyframes(one.area)
        found[one.keyframe] = successor(placed[one.keyframe], {k: at for k, at in placed.items() if k not in gone})
    return found


def _size(replica: Replica, leaf: Leaf, sizes: Mapping[int, tuple[int, int]]) -> tuple[int, int]:
    """Areas and loop closures of a leaf, counted anew only where the leaf changed."""
    if leaf.hypothesis in sizes and not (leaf.arcs or leaf.relabelled or leaf.withdrawn or leaf.merged):
        return sizes[leaf.hypothesis]
    hybrid_map = replica.maps[leaf.hypothesis]
    return len(hybrid_map.area_ids()), sum(arc.closure for _, _, arc in hybrid_map.all_arcs())


def placed_areas(hybrid_map: HybridMap, given: Sequence[AreaPose]) -> dict[int, PoseGaussian]:
    """``map_T_area`` of every area: as TLCA last gave it, else along the arcs from an area that TLCA did give."""
    known = {entry.area: entry.pose for entry in given}
    areas = hybrid_map.area_ids()
    start = next((area for area in areas if area in known), areas[0])
    along_arcs = reachable(hybrid_map, start)
    origin = known.get(start, along_arcs[start])
    return {area: known[area] if area in known else origin.compose(along_arcs[area]) for area in areas}


def keyframe_poses(hybrid_map: HybridMap, area_poses: Mapping[int, PoseGaussian]) -> dict[int, NDArray[np.float64]]:
    """{keyframe: ``map_T_base``, shape (3,)} in the order of the areas."""
    return {
        keyframe: se2.compose(area_poses[area].mean, pose)
        for area in hybrid_map.area_ids()
        for keyframe, pose in hybrid_map.keyframes(area).items()
    }
