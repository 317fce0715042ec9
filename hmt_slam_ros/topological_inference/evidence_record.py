"""Record of what spoke for the live hypotheses when they branched; it is for people, and decides nothing."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.evidence import BranchKind, BranchStep, Evidence, HypothesisEvidence
from hmt_slam_ros.messages.messages import Hypothesis
from hmt_slam_ros.registration.consistency import SAMPLE_SPACING
from hmt_slam_ros.topological_inference.area_comparison import Fit
from hmt_slam_ros.topological_inference.branches import Child

_MAX_STEPS = 20
"""Steps of a hypothesis that are kept, the newest."""


class EvidenceRecord:
    """The steps of the live hypotheses. No part of the state of the process, whose decisions do not depend on it.

    :ivar evidence: the message, which is replaced when a step is new or a hypothesis ends.
    """

    def __init__(self) -> None:
        self.evidence = Evidence(0)
        self._steps: dict[int, tuple[BranchStep, ...]] = {}

    def restore(self, evidence: Evidence) -> None:
        """Go on from the message of a process that was killed."""
        self.evidence = evidence
        self._steps = {one.hypothesis: one.steps for one in evidence.hypotheses}

    def after_event(
        self, sequence: int, maps: Mapping[int, HybridMap], hypotheses: Sequence[Hypothesis], children: Sequence[Child]
    ) -> None:
        """Note the steps of an event.

        :param maps: {hypothesis: map} before the event.
        :param hypotheses: those that survive it.
        :param children: the continuation that each of them is.
        """
        siblings = Counter(child.parent for child in children)
        before = self._steps
        self._steps = {}
        for hypothesis, child in zip(hypotheses, children, strict=True):
            is_branch = hypothesis.id != child.parent or siblings[child.parent] > 1
            new = _steps(sequence, maps[child.parent], hypothesis, child, is_branch=is_branch)
            self._steps[hypothesis.id] = (*before.get(child.parent, ()), *new)[-_MAX_STEPS:]
        if self._steps != before:
            self._publish(sequence)

    def clear(self, sequence: int) -> None:
        """Forget all steps, since one hypothesis is definite."""
        self._steps = {}
        if self.evidence.hypotheses:
            self._publish(sequence)

    def _publish(self, sequence: int) -> None:
        hypotheses = tuple(HypothesisEvidence(h, steps) for h, steps in sorted(self._steps.items()) if steps)
        if hypotheses or self.evidence.hypotheses:
            self.evidence = Evidence(sequence, hypotheses)


def _steps(
    sequence: int, hybrid_map: HybridMap, hypothesis: Hypothesis, child: Child, *, is_branch: bool
) -> list[BranchStep]:
    """The steps of a hypothesis at an event.

    :param hybrid_map: of its parent.
    :param is_branch: whether it is one of several continuations.
    """
    ends: list[tuple[BranchKind, int, int | None]] = [
        ("closure", arc.source, arc.target) for arc in child.arcs if arc.closure
    ]
    ends += [("withdrawal", arc.source, arc.target) for arc in child.removed_arcs]
    if not ends and is_branch:
        ends = [(_kind(hybrid_map, hypothesis, child), child.area, None)]
    details = _details(child.fit)
    return [BranchStep(sequence, kind, area, other, hypothesis.probability, *details) for kind, area, other in ends]


def _kind(hybrid_map: HybridMap, hypothesis: Hypothesis, child: Child) -> BranchKind:
    if not hybrid_map.has_area(child.area):
        return "lost" if hypothesis.lost else "new_area"
    return "known_area" if child.moved_keyframes else "unchanged"


def _details(fit: Fit | None) -> tuple[float | None, float | None, float | None]:
    """Prior, matching and contradicting lengths of a fit."""
    if fit is None:
        return None, None, None
    agreement = fit.agreement
    return fit.prior, agreement.on_surface * SAMPLE_SPACING, agreement.in_free_space * SAMPLE_SPACING
