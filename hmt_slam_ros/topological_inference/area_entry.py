"""How the children of a hypothesis enter areas: keyframes that move, arcs, and the covariances of both."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import informative_arc, shortest_path_beliefs, uninformative_belief
from hmt_slam_ros.messages.map_changes import Arc, MovedKeyframe
from hmt_slam_ros.messages.replica import FIRST_AREA, Replica
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.relative_motion import has_wide_heading
from hmt_slam_ros.topological_inference.area_comparison import Fit, OngoingComparison
from hmt_slam_ros.topological_inference.branches import Branches, Child, Parent
from hmt_slam_ros.topological_inference.candidate_gating import Query
from hmt_slam_ros.topological_inference.closure_search import ClosureSearch
from hmt_slam_ros.topological_inference.hypothesis_tree import Lost, PoseInArea, relative_covariance

_UNCONFIRMED_INFLATION = 100.0
"""Factor on the covariance of an arc along other arcs that no match confirms: it adds next to nothing to those."""


class AreaEntry:
    """Makes the children that enter an area, and numbers new areas.

    :ivar largest_area: the largest number that an area was given.
    :ivar covariance_floor: covariance of a keyframe's pose at least, shape (3, 3).
    """

    def __init__(self, configuration: Configuration, replica: Replica, search: ClosureSearch) -> None:
        self._filter = configuration.filter
        self._replica = replica
        self._search = search
        sigma, angle = configuration.tlca.arc_sigma_floor, math.radians(configuration.tlca.arc_angle_floor)
        self.covariance_floor = np.diag([sigma**2, sigma**2, angle**2])
        self.largest_area = FIRST_AREA
        self._new_areas: dict[tuple[int, ...], int] = {}

    def begin_event(self) -> None:
        """Begin an event, in which new areas of the same keyframes have the same number."""
        self._new_areas = {}

    def new_area(self, parent: Parent, query: Query) -> int:
        """The number of an area that keyframes begin, the same for all hypotheses of an event."""
        keyframes = tuple(query.poses)
        if keyframes not in self._new_areas:
            self.largest_area = max(self.largest_area, parent.hybrid_map.max_area_id) + 1
            self._new_areas[keyframes] = self.largest_area
        return self._new_areas[keyframes]

    def query(self, parent: Parent, keyframes: Sequence[int], first: int | None = None) -> Query:
        """The query of some keyframes of the robot's area.

        :param first: the reference among them; the first of them if None.
        """
        poses, first = parent.hybrid_map.keyframes(parent.area), keyframes[0] if first is None else first
        reference = poses[first]
        covariance = parent.covariance(first) + self.covariance_floor
        relative_poses = {keyframe: se2.between(reference, poses[keyframe]) for keyframe in keyframes}
        return Query(PoseGaussian(reference, covariance), relative_poses)

    def belief(self, parent: Parent, area: int) -> PoseGaussian:
        """The belief over ``area_T_other``, with the submap's mean, so that the robot does not jump."""
        arc = informative_arc(parent.hybrid_map, parent.area, area)
        belief = arc or shortest_path_beliefs(parent.hybrid_map, parent.area, targets=(area,))[area]
        return PoseGaussian(parent.state.local_area_poses.get(area, belief.mean), belief.covariance)

    def enter_new(self, parent: Parent, query: Query, log_factor: float) -> Child:
        """New ground: the reference keyframe becomes the frame of a new area."""
        origin = PoseGaussian.from_pose(np.zeros(3))
        child = self.enter_area(parent, query, self.new_area(parent, query), origin, query.belief, log_factor)
        return lose(child, parent, query) if self.is_lost_beyond(parent, query) else child

    def is_lost_beyond(self, parent: Parent, query: Query) -> bool:
        """Whether the robot is lost on new ground behind an arc of unknown heading.

        With any heading, gates admit all places, and a search of the whole map costs less than comparisons.
        """
        return not parent.state.is_lost and has_wide_heading(query.belief.covariance, self._filter)

    def enter_meanwhile(self, parent: Parent, query: Query, comparison: OngoingComparison) -> Child:
        """The only child, in a new area of the keyframes ``query``, while the comparison of some of them goes on."""
        child = self.enter_new(parent, query, 0.0)
        reference = next(iter(comparison.query.poses))
        belief = PoseGaussian(np.zeros(3), child.state.covariances[reference] + self.covariance_floor)
        comparison = replace(comparison, query=Query(belief, comparison.query.poses), kind="recheck")
        return replace(child, state=replace(child.state, comparison=comparison))

    def enter_unknown(
        self, parent: Parent, query: Query, log_factor: float, drawn_pose: Float64 | None = None
    ) -> Child:
        """An area that the keyframes begin, behind an arc of which nothing is known.

        :param drawn_pose: where the area is drawn, shape (3,), in the robot's area; where it was tracked if None.
        """
        origin = PoseGaussian.from_pose(np.zeros(3))
        arc = uninformative_belief(query.belief.mean if drawn_pose is None else drawn_pose)
        return self.enter_area(parent, query, self.new_area(parent, query), origin, arc, log_factor)

    def enter_tracked(self, parent: Parent, query: Query, area: int) -> Child:
        """A known area in whose place the robot is tracked.

        If no arc joins the two areas, the newest of the keyframes measures a new one.
        """
        belief = self.belief(parent, area)
        entry = belief.inverse().compose(query.belief)
        is_linked = informative_arc(parent.hybrid_map, parent.area, area) is not None
        arc = None if is_linked else self._measure_arc(parent, query, area, belief)
        return self.enter_area(parent, query, area, entry, arc, 0.0)

    def _measure_arc(self, parent: Parent, query: Query, area: int, belief: PoseGaussian) -> PoseGaussian:
        newest, pose = list(query.poses.items())[-1]
        area_T_base = query.belief.compose(PoseGaussian(pose, np.zeros((3, 3))))
        scan, prior = self._replica.scans[newest], belief.inverse().compose(area_T_base)
        measured = self._search.measure_pose(parent.hybrid_map, area, parent.area, scan, prior)
        if measured is None:
            return PoseGaussian(belief.mean, _UNCONFIRMED_INFLATION * belief.covariance)
        return area_T_base.compose(measured.inverse())

    def enter_known(self, parent: Parent, query: Query, fit: Fit) -> Child:
        """A known area, recognized."""
        arc = query.belief.compose(fit.mode.measured.inverse())
        return replace(self.enter_area(parent, query, fit.area, fit.mode.pose, arc, fit.log_weight), fit=fit)

    def enter_area(
        self, parent: Parent, query: Query, area: int, entry: PoseGaussian, arc: PoseGaussian | None, log_factor: float
    ) -> Child:
        """The robot and the query's keyframes in ``area``, at ``entry`` = ``area_T_reference``.

        :param arc: belief over the pose of ``area`` in the robot's area, if there is a new one.
        :param log_factor: log of the factor on the weight.
        """
        moved = tuple(
            MovedKeyframe(keyframe, parent.area, area, se2.compose(entry.mean, pose))
            for keyframe, pose in query.poses.items()
        )
        covariances = {
            keyframe: entry.compose(self._keyframe_belief(parent, query, keyframe)).covariance
            for keyframe in query.poses
        }
        return Child(
            parent.hypothesis,
            parent.log_weight + log_factor,
            area,
            parent.state.after_area_change(covariances),
            _frame_change(query, entry, covariances),
            moved,
            () if arc is None else (_make_arc(parent, area, arc),),
            reload_local_map=True,
        )

    def move(self, parent: Parent, area: int) -> Branches:
        """The robot in a known area; the keyframes stay where they are."""
        child = Child(
            parent.hypothesis,
            parent.log_weight,
            area,
            parent.state.after_area_change({}),
            frame_change=self.belief(parent, area).inverse(),
            reload_local_map=True,
        )
        return Branches([child])

    def link(self, parent: Parent, area: int, scan: Scan, pose: PoseGaussian) -> Branches:
        """Join the robot's area to one in which it is tracked by the arc that the newest scan measures.

        :param pose: belief over ``area_T_base`` of the scan, in the robot's area.
        """
        belief = self.belief(parent, area)
        prior = belief.inverse().compose(PoseGaussian(pose.mean, pose.covariance + self.covariance_floor))
        measured = self._search.measure_pose(parent.hybrid_map, area, parent.area, scan, prior)
        child = parent.unchanged_child(parent.state.after_overlap(None))
        if measured is not None:
            arc = Arc(parent.area, area, pose.compose(measured.inverse()), closure=True)
            child = replace(child, arcs=(arc,))
        return Branches([child])

    def _keyframe_belief(self, parent: Parent, query: Query, keyframe: int) -> PoseGaussian:
        """The belief over ``reference_T_base`` of a keyframe."""
        pose, reference = query.poses[keyframe], query.belief.covariance - self.covariance_floor
        return PoseGaussian(pose, relative_covariance(parent.covariance(keyframe), reference, pose, np.zeros((3, 3))))


def lose(child: Child, parent: Parent, query: Query) -> Child:
    """The child, whose keyframes are searched in the map of before."""
    first = next(iter(query.poses))
    lost = Lost(first, tracked_pose=PoseInArea(parent.area, first, query.belief.mean), counted_evidence=None)
    return replace(child, state=replace(child.state, localization=lost))


def _make_arc(parent: Parent, area: int, belief: PoseGaussian) -> Arc:
    """The arc from the robot's area; it closes a loop where it joins two known areas that no arc joined."""
    known = parent.hybrid_map.arc_value(parent.area, area)
    closure = parent.hybrid_map.has_area(area) if known is None else known.closure
    return Arc(parent.area, area, belief, closure)


def _frame_change(query: Query, entry: PoseGaussian, covariances: Mapping[int, Float64]) -> PoseGaussian:
    """``area_T_previous`` with the uncertainty of the newest keyframe in the area, so that its drift continues."""
    newest, pose = list(query.poses.items())[-1]
    belief = PoseGaussian(se2.compose(entry.mean, pose), covariances[newest])
    return belief.compose(PoseGaussian.from_pose(se2.inverse(se2.compose(query.belief.mean, pose))))
