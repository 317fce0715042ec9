"""Loop closures of the live hypotheses, their errors, and the accepted ones."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

from benchmark.simulated.examinations import Examination, known_is_right, new_is_right
from benchmark.simulated.truth import PlacementError, Truth
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.map_changes import Arc
from hmt_slam_ros.messages.messages import Hypotheses, Hypothesis
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, Replica

RECENT = 5
"""Newest keyframes of the robot's area that are compared with a known area."""


@dataclass(frozen=True, eq=False)
class Closure:
    """A loop that a hypothesis closed.

    :ivar event: the keyframe event.
    :ivar way: "cut" or "recheck" where it was one of several answers; "tracked" where the robot was known to be there.
    :ivar areas: the area that the robot was in, and the known one.
    :ivar assess: how right that is.
    """

    event: int
    way: str
    areas: tuple[int, int]
    assessment: PlacementError


@dataclass(frozen=True, eq=False)
class Path:
    """The closures of a live hypothesis, compared with the truth.

    :ivar wrong: whether it closed a false loop since the last acceptance.
    :ivar missing: whether its last answer was new ground instead of a known place.
    :ivar closures: that are not accepted yet.
    """

    wrong: bool = False
    missing: bool = False
    closures: tuple[Closure, ...] = ()

    @property
    def right(self) -> bool:
        """Whether it is the true one."""
        return not self.wrong and not self.missing


class Paths:
    """The paths of the live hypotheses."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self.paths: Mapping[int, Path] = {FIRST_HYPOTHESIS: Path()}

    def follow(self, hypotheses: Hypotheses, replica: Replica, examinations: Mapping[int, Examination]) -> None:
        """Update the paths by TSBI's answer.

        :param replica: before the answer.
        :param examinations: {parent: its examination at this event}.
        """
        self.paths = {
            hypothesis.id: self._continue(
                hypothesis, hypotheses.sequence, replica.maps[hypothesis.parent], examinations
            )
            for hypothesis in hypotheses.hypotheses
        }

    def _continue(
        self, hypothesis: Hypothesis, event: int, before: HybridMap, examinations: Mapping[int, Examination]
    ) -> Path:
        path = self.paths[hypothesis.parent]
        examination = examinations.get(hypothesis.parent)
        closures = [
            self._closure(hypothesis, arc, event, before, examination)
            for arc in closing_arcs(hypothesis, before, examination)
        ]
        path = replace(path, closures=(*path.closures, *closures))
        path = replace(path, wrong=path.wrong or not all(closure.assessment.true for closure in closures))
        if examination is None:
            return path
        return replace(path, missing=not closures and not new_is_right(examination, self._truth))

    def _closure(
        self, hypothesis: Hypothesis, arc: Arc, event: int, before: HybridMap, examination: Examination | None
    ) -> Closure:
        known_area = known_end(hypothesis, arc)
        other, pose = (arc.source, arc.pose.inverse()) if arc.target == known_area else (arc.target, arc.pose)
        moved_keyframes = {
            r.keyframe: r.pose for r in hypothesis.moved_keyframes if r.area == known_area and r.previous_area != r.area
        }
        recent_keyframes = examination.keyframes if examination else list(before.keyframes(other))[-RECENT:]
        recent_poses = {
            k: se2.compose(pose.mean, at) for k, at in before.keyframes(other).items() if k in recent_keyframes
        }
        known, query = before.keyframes(known_area), moved_keyframes or recent_poses
        assessment = self._truth.assess(known, query, pose.covariance, pose.mean)
        way = examination.kind if examination else "tracked"
        return Closure(event, way, (other, known_area), assessment)

    def take_accepted(self, hypothesis: int, chosen: HybridMap) -> list[Closure]:
        """The closures that become definite with a hypothesis, with their current errors."""
        path = self.paths[hypothesis]
        self.paths = {hypothesis: replace(path, wrong=False, closures=())}
        return [self._reassess(closure, chosen) for closure in path.closures]

    def _reassess(self, closure: Closure, chosen: HybridMap) -> Closure:
        """The closure with its current error by the same keyframes; unchanged if one of them left the two areas."""
        other, known_area = closure.areas
        known, query = closure.assessment.pair
        pose = chosen.arc(known_area, other)
        ours, theirs = chosen.keyframes(known_area), chosen.keyframes(other)
        if pose is None or known not in ours or query not in {*ours, *theirs}:
            return closure
        at = ours[query] if query in ours else se2.compose(pose.mean, theirs[query])
        assessment = self._truth.assess({known: ours[known]}, {query: at}, pose.covariance, pose.mean)
        return replace(closure, assessment=assessment)


def closing_arcs(hypothesis: Hypothesis, before: HybridMap, examination: Examination | None) -> Iterator[Arc]:
    """The arcs of a hypothesis that place the robot in a known area.

    They close a new loop, or have a new measurement by keyframes that TSBI matched with the area.
    """
    if hypothesis.removed_arcs:
        return  # a revision by TLCA, without an observation
    found = examination is not None and bool(hypothesis.moved_keyframes) and hypothesis.area in before.area_ids()
    for arc in hypothesis.arcs:
        value = before.arc_value(arc.source, arc.target)
        if found or (arc.closure and (value is None or not value.closure)):
            yield arc


def known_end(hypothesis: Hypothesis, arc: Arc) -> int:
    """The known area of an arc: the one that keyframes moved to, else the one without the robot."""
    if hypothesis.moved_keyframes:
        return hypothesis.area
    return arc.target if arc.source == hypothesis.area else arc.source


@dataclass(frozen=True)
class Answer:
    """The probability of one answer to the question in which known area keyframes lie.

    :ivar area: the known area, ``NEW`` for none, ``NOT_EXAMINED`` for a hypothesis without an examination.
    :ivar probability: of the forecast.
    :ivar right: whether the answer is true.
    """

    area: int
    probability: float
    right: bool


NEW, NOT_EXAMINED = -1, -2


def live_answers(
    hypotheses: Hypotheses, before: Replica, examinations: Mapping[int, Examination], paths: Mapping[int, Path]
) -> list[Answer]:
    """The answers of the live hypotheses after an event, with the probability of each.

    :param paths: after the event.
    """
    found = []
    for hypothesis in hypotheses.hypotheses:
        examination = examinations.get(hypothesis.parent)
        arcs = list(closing_arcs(hypothesis, before.maps[hypothesis.parent], examination))
        area = NOT_EXAMINED if examination is None else known_end(hypothesis, arcs[0]) if arcs else NEW
        found.append(Answer(area, hypothesis.probability, paths[hypothesis.id].right))
    return found


def answers_by_arcs(
    hypotheses: Iterable[tuple[int, float]],
    examinations: Mapping[int, Examination],
    paths: Mapping[int, Path],
    truth: Truth,
) -> list[tuple[Answer, int]]:
    """The answers by the arcs alone, without scans, each with the number of known areas.

    :param hypotheses: (id, probability) before the event.
    :param paths: before the event.
    """
    found = []
    for hypothesis, probability in hypotheses:
        wrong = paths[hypothesis].wrong
        if hypothesis not in examinations:
            found.append((Answer(NOT_EXAMINED, probability, paths[hypothesis].right), 0))
            continue
        examination = examinations[hypothesis]
        model = examination.found.transition
        right = not wrong and new_is_right(examination, truth)
        found.append((Answer(NEW, probability * model.new, right), len(model.known)))
        for area, share in model.known.items():
            right = not wrong and known_is_right(examination, truth, area)
            found.append((Answer(area, probability * share, right), len(model.known)))
    return found
