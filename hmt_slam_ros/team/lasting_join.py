"""Joins of two robots' maps that grow: a placement joins them when it has lasted, until it is no longer probable."""

from __future__ import annotations

from dataclasses import dataclass, replace

from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.messages.map_changes import Pose
from hmt_slam_ros.messages.team import JoiningArc, Verdict
from hmt_slam_ros.team.join import Meeting
from hmt_slam_ros.team.placement import is_same_placement

_MIN_PROBABILITY = 0.5
"""Probability of the best placement below which a join is withdrawn."""

_CONFIRMING_KEYFRAMES = 20
"""New keyframes of both robots with which a placement has to stay sure before it joins them: many are tried."""


@dataclass(frozen=True, eq=False)
class SurePlacement:
    """A placement that is sure, and that joins two maps when it has lasted.

    :ivar keyframes: number of keyframes of both maps when it became sure.
    :ivar pose: shape (3,), of the placement then, m, rad.
    """

    keyframes: int
    pose: Pose


@dataclass(frozen=True, eq=False)
class JoinState:
    """How far the join with another robot's map is.

    :ivar sure: the placement that is sure, None where none is.
    :ivar is_joined: whether the two maps are joined.
    :ivar joining_arcs: of the join, with ``team.uses_ground``; none without.
    :ivar sent_version: of the other map, up to which its ground was sent to TLCA.
    """

    sure: SurePlacement | None = None
    is_joined: bool = False
    joining_arcs: tuple[JoiningArc, ...] = ()
    sent_version: int = 0


def next_join(
    join: JoinState,
    meeting: Meeting,
    keyframes: int,
    configuration: Configuration,
    *,
    is_first: bool,
    confirmed: Pose | None = None,
) -> JoinState:
    """How far a join is after a comparison.

    :param keyframes: number of keyframes of both maps.
    :param is_first: whether the first component is the robot's own.
    :param confirmed: shape (3,), the placement that has lasted with the other robot, None without.
    """
    if join.is_joined and not _may_hold(meeting):
        return JoinState()
    if meeting.verdict is not Verdict.JOINED:
        return replace(join, sure=None)
    best = meeting.distribution.best
    assert best is not None
    sure = join.sure
    if sure is None or not is_same_placement(sure.pose, best.pose):
        sure = SurePlacement(keyframes, best.pose)
    is_confirmed = confirmed is not None and is_same_placement(confirmed, best.pose)
    if not join.is_joined and not is_confirmed and keyframes - sure.keyframes < _CONFIRMING_KEYFRAMES:
        return replace(join, sure=sure)
    # Registration takes longer than the comparison, and only those who use the ground need the arcs.
    arcs = _joining_arcs(join, meeting, configuration, is_first=is_first) if configuration.team.uses_ground else ()
    return replace(join, sure=sure, is_joined=True, joining_arcs=arcs)


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
