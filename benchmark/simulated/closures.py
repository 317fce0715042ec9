"""Which loops the live hypotheses close, how right each of these closures is, and which are accepted."""

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

# Keyframes of the robot's area by which it is judged that this area joins another.
_RECENT = 5


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
    """What there is to say of a live hypothesis.

    :ivar wrong: whether it closed a loop that there is not, since the last time that a path was accepted.
    :ivar missing: whether its last answer was new ground where there was a known place.
    :ivar closures: those that are not accepted yet.
    """

    wrong: bool = False
    missing: bool = False
    closures: tuple[Closure, ...] = ()

    @property
    def right(self) -> bool:
        """Whether it is the true one."""
        return not self.wrong and not self.missing


class Paths:
    """Follows the live hypotheses."""

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self.paths: Mapping[int, Path] = {FIRST_HYPOTHESIS: Path()}

    def follow(self, hypotheses: Hypotheses, replica: Replica, examinations: Mapping[int, Examination]) -> None:
        """Learn of TSBI's answer.

        :param replica: as it was before.
        :param examinations: {parent: what it asked at this event}.
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
        recent_keyframes = examination.keyframes if examination else list(before.keyframes(other))[-_RECENT:]
        recent_poses = {
            k: se2.compose(pose.mean, at) for k, at in before.keyframes(other).items() if k in recent_keyframes
        }
        known, examinations = before.keyframes(known_area), moved_keyframes or recent_poses
        assessment = self._truth.assess(known, examinations, pose.covariance, pose.mean)
        way = examination.kind if examination else "tracked"
        return Closure(event, way, (other, known_area), assessment)

    def accepted(self, hypothesis: int, chosen: HybridMap) -> list[Closure]:
        """The closures that become definite with a hypothesis, judged as they now are."""
        path = self.paths[hypothesis]
        self.paths = {hypothesis: replace(path, wrong=False, closures=())}
        return [self._reassess(closure, chosen) for closure in path.closures]

    def _reassess(self, closure: Closure, chosen: HybridMap) -> Closure:
        """By the same keyframes; where one of them left the two areas, the verdict stands."""
        other, known_area = closure.areas
        known, examinations = closure.assessment.pair
        pose = chosen.arc(known_area, other)
        ours, theirs = chosen.keyframes(known_area), chosen.keyframes(other)
        if pose is None or known not in ours or examinations not in {*ours, *theirs}:
            return closure
        at = ours[examinations] if examinations in ours else se2.compose(pose.mean, theirs[examinations])
        assessment = self._truth.assess({known: ours[known]}, {examinations: at}, pose.covariance, pose.mean)
        return replace(closure, assessment=assessment)


def closing_arcs(hypothesis: Hypothesis, before: HybridMap, examination: Examination | None) -> Iterator[Arc]:
    """The arcs by which a leaf says where in a known area the robot is.

    They close a loop that its parent had not closed, or are measured anew by keyframes that TSBI found in the area.
    """
    if hypothesis.removed_arcs:
        return  # a question that TLCA opened again: nothing was observed
    found = examination is not None and bool(hypothesis.moved_keyframes) and hypothesis.area in before.area_ids()
    for arc in hypothesis.arcs:
        value = before.arc_value(arc.source, arc.target)
        if found or (arc.closure and (value is None or not value.closure)):
            yield arc


def known_end(hypothesis: Hypothesis, arc: Arc) -> int:
    """The known one of the two areas of an arc: that which keyframes moved to, else that in which the robot is not."""
    if hypothesis.moved_keyframes:
        return hypothesis.area
    return arc.target if arc.source == hypothesis.area else arc.source


@dataclass(frozen=True)
class Answer:
    """What a forecast says of one answer to "in which known area are these keyframes?".

    :ivar area: the known area, -1 for none, -2 for what a hypothesis is that did not ask.
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
    """The PMF over the live hypotheses after an event, by what each answered.

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
    """The forecast of one who knows the arcs but looks at no scan, with the number of its known areas.

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
