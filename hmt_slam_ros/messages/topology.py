"""The message with all areas, keyframes and arcs of the map, for programs that do not follow its changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import AreaPair, HybridMap
from hmt_slam_ros.messages.map_changes import Pose
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.statements import WeighedStatement


@dataclass(frozen=True, eq=False, slots=True)
class TopologyHypothesis:
    """A live hypothesis.

    :ivar hypothesis: id of the hypothesis.
    :ivar probability: P(gamma^t | d), Eq. (14).
    :ivar area: the robot's area under it.
    """

    hypothesis: int
    probability: float
    area: int


@dataclass(frozen=True, eq=False, slots=True)
class TopologyArea:
    """An area with its keyframes.

    :ivar area: id of the area.
    :ivar pose: belief over ``map_T_area``.
    :ivar keyframes: numbers of its n keyframes; those of other robots are below -1.
    :ivar stamps: stamp of the scan of each, ns.
    :ivar poses: ``area_T_base`` of each, shape (3,), m and rad.
    """

    area: int
    pose: PoseGaussian
    keyframes: tuple[int, ...]
    stamps: tuple[int, ...]
    poses: tuple[Pose, ...]


@dataclass(frozen=True, eq=False, slots=True)
class TopologyArc:
    """An arc between two areas.

    :ivar source: the area with the smaller id.
    :ivar target: the area with the larger id.
    :ivar pose: belief over ``source_T_target``.
    :ivar closure: whether the arc closed a loop.
    :ivar probability: sum of the probabilities of the hypotheses that have an arc between the two areas.
    """

    source: int
    target: int
    pose: PoseGaussian
    closure: bool
    probability: float


@dataclass(frozen=True, eq=False, slots=True)
class Topology:
    """tlca -> other programs: the map of the most probable hypothesis, the whole of it.

    :ivar events: number of keyframe events that the map has; it grows with each change, until a reset.
    :ivar stamp: stamp of the newest keyframe, ns, 0 before the first.
    :ivar frame: name of the map's frame.
    :ivar hypotheses: all live hypotheses, the most probable one first.
    :ivar unexamined: probability of topologies that the gate excluded or the reduction dropped.
    :ivar area: the robot's area under the most probable hypothesis.
    :ivar pose: shape (3,), ``area_T_base`` of the robot at the newest keyframe event, m and rad.
    :ivar areas: ordered by id. An area that has no pose in the map yet is left out until it has one.
    :ivar arcs: all arcs between these areas, ordered by their ends.
    :ivar statements: what people stated about places, in order, each with its probability.
    """

    events: int
    stamp: int
    frame: str
    hypotheses: tuple[TopologyHypothesis, ...]
    unexamined: float
    area: int
    pose: Pose
    areas: tuple[TopologyArea, ...]
    arcs: tuple[TopologyArc, ...]
    statements: tuple[WeighedStatement, ...]

    @classmethod
    def from_replica(
        cls,
        replica: Replica,
        area_poses: Mapping[int, PoseGaussian],
        pose: Pose,
        frame: str,
        events: int,
        stamp: int,
    ) -> Topology:
        """The topology of a replica.

        :param area_poses: {area: belief over ``map_T_area``} of the most probable hypothesis.
        :param pose: shape (3,), ``area_T_base`` of the robot in its area under that hypothesis.
        :param frame: name of the map's frame.
        :param events: number of keyframe events.
        :param stamp: of the newest keyframe, ns.
        """
        probabilities, best = replica.probabilities, replica.best_hypothesis
        hybrid_map, examined = replica.maps[best], sum(probabilities.values())
        ordered = sorted(probabilities, key=lambda h: (-probabilities[h], h))
        missing = _missing_arc_probabilities(replica, hybrid_map)
        return cls(
            events,
            stamp,
            frame,
            tuple(TopologyHypothesis(h, probabilities[h], replica.robot_areas[h]) for h in ordered),
            max(0.0, 1.0 - examined),
            replica.robot_areas[best],
            pose,
            tuple(_area(replica, hybrid_map, a, area_poses[a]) for a in hybrid_map.area_ids() if a in area_poses),
            tuple(
                TopologyArc(a, b, arc.pose, arc.closure, examined - missing.get((a, b), 0.0))
                for a, b, arc in hybrid_map.all_arcs()
                if a in area_poses and b in area_poses
            ),
            replica.statements,
        )


def _area(replica: Replica, hybrid_map: HybridMap, area: int, pose: PoseGaussian) -> TopologyArea:
    keyframes = hybrid_map.keyframes(area)
    stamps = tuple(replica.scans[keyframe].stamp for keyframe in keyframes)
    return TopologyArea(area, pose, tuple(keyframes), stamps, tuple(keyframes.values()))


def _missing_arc_probabilities(replica: Replica, hybrid_map: HybridMap) -> dict[AreaPair, float]:
    """{arc: sum of the probabilities of the hypotheses without it}, of the arcs that some hypothesis changed."""
    changed = {pair for known in replica.maps.values() for pair in known.changed_arcs}
    return {
        pair: sum(replica.probabilities[h] for h, known in replica.maps.items() if known.arc_value(*pair) is None)
        for pair in changed
        if hybrid_map.arc_value(*pair) is not None
    }
