"""Joins of two robots' maps that grow: by a placement that was sure before, until it is no longer probable."""

from __future__ import annotations

from dataclasses import dataclass, replace

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.messages.team import JoiningArc, Verdict
from hmt_slam_ros.team.join import Meeting

_MIN_PROBABILITY = 0.5
"""Probability of the best placement below which a join is withdrawn."""


@dataclass(frozen=True, eq=False)
class JoinState:
    """How far the join with another robot's map is.

    :ivar is_joined: whether the two maps are joined.
    :ivar joining_arcs: of the join, with ``team.uses_ground``; none without.
    :ivar sent_version: of the other map, up to which its ground was sent to TLCA.
    """

    is_joined: bool = False
    joining_arcs: tuple[JoiningArc, ...] = ()
    sent_version: int = 0


def next_join(
    join: JoinState, meeting: Meeting, configuration: Configuration, *, is_first: bool, has_lasted: bool
) -> JoinState:
    """How far a join is after a comparison.

    :param is_first: whether the first component is the robot's own.
    :param has_lasted: whether the placement was sure before, too: many are tried, so that it joins only then.
    """
    if join.is_joined and not _may_hold(meeting):
        return JoinState()
    if meeting.verdict is not Verdict.JOINED or not (join.is_joined or has_lasted):
        return join
    # Registration takes longer than the comparison, and only those who use the ground need the arcs.
    arcs = _joining_arcs(join, meeting, configuration, is_first=is_first) if configuration.team.uses_ground else ()
    return replace(join, is_joined=True, joining_arcs=arcs)


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


def _may_hold(meeting: Meeting) -> bool:
    """Whether a join holds: no two answers at the border of what is sure alternate."""
    best = meeting.distribution.best
    is_possible = meeting.verdict in (Verdict.JOINED, Verdict.OPEN)
    return is_possible and best is not None and best.probability >= _MIN_PROBABILITY
