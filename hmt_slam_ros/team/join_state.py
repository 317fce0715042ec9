"""Joins of two robots' maps that grow: by a placement that was sure before, while it is the most probable one."""

from __future__ import annotations

from dataclasses import dataclass, replace

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.messages.map_changes import Pose
from hmt_slam_ros.messages.team import JoiningArc, Verdict
from hmt_slam_ros.team.join import Meeting
from hmt_slam_ros.team.placement import is_same_placement

_MIN_PROBABILITY = 0.5
"""Probability of the best placement below which a join is withdrawn."""


@dataclass(frozen=True, eq=False)
class JoinState:
    """How far the join with another robot's map is.

    :ivar pose: shape (3,), ``first_T_second``, of the placement by which the two maps are joined, as of the last
        comparison; None where they are not joined.
    :ivar joining_arcs: of the join, with ``team.uses_ground``; none without.
    :ivar sent_version: of the other map, up to which its ground was sent to TLCA.
    """

    pose: Pose | None = None
    joining_arcs: tuple[JoiningArc, ...] = ()
    sent_version: int = 0

    @property
    def is_joined(self) -> bool:
        """Whether the two maps are joined."""
        return self.pose is not None

    def holds(self, meeting: Meeting) -> bool:
        """Whether two joined maps stay so after a comparison: at the same placement, which is still probable.

        No two answers at the border of what is sure alternate. Maps that grow may bend, so that the pose is compared
        with that of the last comparison.
        """
        best = meeting.distribution.best
        if self.pose is None or best is None or meeting.verdict not in (Verdict.JOINED, Verdict.OPEN):
            return False
        return best.probability >= _MIN_PROBABILITY and is_same_placement(self.pose, best.pose)


def next_join(
    join: JoinState, meeting: Meeting, configuration: Configuration, *, is_first: bool, has_lasted: bool
) -> JoinState:
    """How far a join is after a comparison.

    :param is_first: whether the first component is the robot's own.
    :param has_lasted: whether the placement was sure before, too: many are tried, so that it joins only then.
    """
    join, best = join if join.holds(meeting) else JoinState(), meeting.distribution.best
    is_sure = meeting.verdict is Verdict.JOINED and (join.is_joined or has_lasted)
    if best is None or not (join.is_joined or is_sure):
        return join
    # Registration takes longer than the comparison, and only those who use the ground need the arcs.
    if is_sure and configuration.team.uses_ground:
        join = replace(join, joining_arcs=_joining_arcs(join, meeting, configuration, is_first=is_first))
    return replace(join, pose=best.pose)


def _joining_arcs(
    join: JoinState, meeting: Meeting, configuration: Configuration, *, is_first: bool
) -> tuple[JoiningArc, ...]:
    """The arcs of a join, from the robot's own areas.

    Those of earlier comparisons stay while their areas are there: a robot prunes what it mapped in the ground of
    another one, and with that the windows by which it was joined.

    :param is_first: whether the first component is the robot's own.
    """
    pair = meeting.pair
    known_areas, other_areas = set(pair.known), {area - pair.area_shift for area in pair.other}
    own_areas, foreign_areas = (known_areas, other_areas) if is_first else (other_areas, known_areas)
    arcs = {
        (arc.own_area, arc.foreign_area): arc
        for arc in join.joining_arcs
        if arc.own_area in own_areas and arc.foreign_area in foreign_areas
    }
    for known, other, arc in meeting.refine(configuration).hybrid_map.all_arcs():
        if known in pair.known and other in pair.other:
            number = other - pair.area_shift
            own = JoiningArc(known, number, arc.pose) if is_first else JoiningArc(number, known, arc.pose.inverse())
            arcs[own.own_area, own.foreign_area] = own
    return tuple(arcs.values())
