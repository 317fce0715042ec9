"""The comparison of keyframes with known areas, area by area, which goes on from event to event."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.registration.area_to_area import MatchMode
from hmt_slam_ros.registration.consistency import Agreement
from hmt_slam_ros.topological_inference.candidate_gating import AreaCandidate, EntryPrior, Query, Transition
from hmt_slam_ros.topological_inference.marks import AreaMark, MarkEntry

ComparisonKind = Literal["cut", "recheck", "retry", "stated"]


class StatedPair(NamedTuple):
    """Two areas that a person states to be one place.

    :ivar statement: number of the statement.
    :ivar area: the area whose keyframes are compared.
    :ivar other: the area with which they are.
    """

    statement: int
    area: int
    other: int


class Fit(NamedTuple):
    """One way in which the keyframes lie in a known area.

    :ivar area: the known area.
    :ivar mode: of their match with it.
    :ivar log_weight: log pi p(z), p(z) relative to new ground, nats. The appearance of the place adds nothing to the
        evidence of its surfaces (docs/decisions/0019-appearance-for-retrieval.md).
    :ivar prior: pi, the probability of the place before its surfaces were compared.
    :ivar agreement: of the surfaces of the keyframes with the area's map.
    """

    area: int
    mode: MatchMode
    log_weight: float
    prior: float
    agreement: Agreement


class AreaComparison(NamedTuple):
    """The comparison of keyframes with the known areas.

    :ivar transition: pi of the known areas and of new ground.
    :ivar fits: the heaviest modes in each examined area.
    :ivar examined_areas: those areas.
    :ivar pending_candidates: areas beside whose place the keyframes fit; they are not in it yet, so they were not
        examined.
    :ivar skipped_weight: weight of the other areas and modes, on the scale of ``exp(Fit.log_weight)``.
    """

    transition: Transition
    fits: tuple[Fit, ...]
    examined_areas: tuple[int, ...]
    pending_candidates: tuple[int, ...]
    skipped_weight: float

    def promised_probability(self, compared: Collection[int]) -> float:
        """Probability by the arcs of the examined areas but those of ``compared``."""
        return sum(self.transition.known[area] for area in self.examined_areas if area not in compared)

    def new_probability(self, compared: Collection[int]) -> float:
        """Probability that the keyframes lie in new ground, or in an area where earlier ones did not fit either.

        What keeps them from fitting, people or a changed room, lasts: that nothing fits again tells nothing more.

        :param compared: areas with which earlier keyframes were compared.
        """
        again = [area for area in self.examined_areas if area in compared and not self.fits]
        return self.transition.new + sum(self.transition.known[area] for area in again)


class ExaminedArea(NamedTuple):
    """A known area with which the keyframes were compared.

    :ivar area: the known area.
    :ivar prior: belief over ``area_T_reference`` by the arcs.
    :ivar entry: whether they lie in its place, by the arcs.
    :ivar modes: the ways in which they lie in it.
    :ivar agreements: of their surfaces with the area's map, one for each mode.
    :ivar is_pending: whether they fit best beside its place.
    :ivar mark: whether they lie in it by a mark, if there is one.
    """

    area: int
    prior: PoseGaussian
    entry: EntryPrior
    modes: tuple[MatchMode, ...] = ()
    agreements: tuple[Agreement, ...] = ()
    is_pending: bool = False
    mark: MarkEntry | None = None

    @property
    def is_possible(self) -> bool:
        """Whether they may lie in it."""
        return self.entry.probability > 0.0 or (self.mark is not None and self.mark.probability > 0.0)


@dataclass(frozen=True, eq=False)
class OngoingComparison:
    """A comparison of keyframes with known areas before its end.

    :ivar query: the keyframes, in the robot's area, or in that of the stated pair.
    :ivar excluded: areas that are neither candidates nor part of a candidate's map.
    :ivar kind: of a cut, of a recheck with all areas that the arcs admit, of a retry with some of them, or of two areas
        that a person states to be one place.
    :ivar candidates: {area: its prior} of those that were not examined yet, the most probable first.
    :ivar skipped: {area: bound on its probability} of those that are not examined.
    :ivar elsewhere: some areas in which the keyframes surely do not lie, without those that were tried.
    :ivar examined: what was found in the others.
    :ivar negative_shares: matched shares in those that were tried.
    :ivar prepared: the area whose map was made at an earlier step, and which is matched next; else None.
    :ivar marks: {area: mark that puts them there}.
    :ivar stated_pair: the two areas that a person states to be one place; else None.
    """

    query: Query
    excluded: frozenset[int]
    kind: ComparisonKind
    candidates: Mapping[int, AreaCandidate]
    skipped: Mapping[int, float]
    elsewhere: tuple[int, ...]
    examined: tuple[ExaminedArea, ...] = ()
    negative_shares: tuple[float, ...] = ()
    prepared: int | None = None
    marks: Mapping[int, AreaMark] = field(default_factory=dict)
    stated_pair: StatedPair | None = None
