"""What became of the hypotheses after the robot entered a place that looks like another one it knows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hmt_slam_ros.results.recorder import Recorder

LOW, HIGH = 0.2, 0.8
"""Between these probabilities a hypothesis is alive, and does not rule the other out."""

SURE = 0.95
"""The true hypothesis exceeds this after the evidence."""

SOON = 2.0
"""Path within which it does, m: ``tlca.accept_distance``."""

LATER = (SOON, 5.0, 10.0, 20.0)
"""Paths after which it is told of how many re-entries the true hypothesis is sure, m."""

DECIDED = 0.99
"""Odometry that says as much tells the places apart by itself."""

NEW, RIGHT, WRONG = "new ground", "the true place", "another place"


@dataclass(frozen=True)
class Moment:
    """A keyframe event.

    :ivar seconds: since the first one.
    :ivar travelled: path length since the start, m.
    :ivar samples: effective sample size of the most probable hypothesis's particles.
    :ivar probabilities: {``NEW``, ``RIGHT`` or ``WRONG``: of the hypotheses that say so}.
    """

    event: int
    seconds: float
    travelled: float
    samples: float
    probabilities: dict[str, float]

    @property
    def asked(self) -> bool:
        """Whether it may be that the robot is in a known place."""
        return self.probabilities[RIGHT] + self.probabilities[WRONG] >= LOW


def story(pmf: Sequence[Mapping[str, Any]], begin: int) -> list[Moment]:
    """All that follows from a keyframe event on.

    A hypothesis is in new ground until it closes a loop; from the first closure on that is not true, it is wrong.

    :param pmf: as :class:`benchmark.simulated.watch.Watch` keeps it.
    """
    kinds: dict[int, str] = {}
    moments = []
    for entry in pmf:
        if entry["event"] < begin:
            continue
        leaves = entry["leaves"]
        kinds = {leaf["hypothesis"]: _kind(kinds.get(leaf["parent"], NEW), leaf) for leaf in leaves}
        shares = {
            kind: sum(leaf["probability"] for leaf in leaves if kinds[leaf["hypothesis"]] == kind)
            for kind in (NEW, RIGHT, WRONG)
        }
        best = max(leaves, key=lambda leaf: float(leaf["probability"]))
        seconds = (entry["stamp"] - pmf[0]["stamp"]) / 1e9
        moments.append(Moment(entry["event"], seconds, entry["travelled"], best["samples"], shares))
    return moments


def _kind(before: str, leaf: Mapping[str, Any]) -> str:
    if leaf["wrong"]:
        return WRONG
    return RIGHT if leaf["right"] and before == NEW else before


@dataclass(frozen=True)
class Verdict:
    """Whether the hypotheses fared as they should.

    :ivar asked: whether it ever may be that the robot is in a known place: with probability ``LOW``.
    :ivar lowest: the smallest probability of the true and of another place, from the question to the evidence.
    :ivar highest: the largest of the two; both None where nothing was asked before the evidence.
    :ivar when_asked: probability of the true place at the question; ``at_evidence``, just before the evidence; None
        likewise.
    :ivar waited: path from the evidence, or the question if that comes later, until the true one is sure, m; None where
        it never is within ``SOON``.
    :ivar final: probability of the true place ``SOON`` after the evidence, or the question.
    """

    asked: bool
    lowest: float | None
    highest: float | None
    when_asked: float | None
    at_evidence: float | None
    waited: float | None
    final: float

    @property
    def both_alive(self) -> bool:
        """Whether both are from the question to the evidence."""
        return self.lowest is not None and self.highest is not None and self.lowest >= LOW and self.highest <= HIGH

    @property
    def settled(self) -> bool:
        """Whether the true one is sure soon after the evidence, and stays so."""
        return self.waited is not None and self.final > SURE


def verdict(moments: Sequence[Moment], evidence: int, soon: float = SOON) -> Verdict:
    """Judge a story.

    :param evidence: the keyframe event from which on the places can be told apart.
    :param soon: path within which the true one is to be sure, m.
    """
    asked = next((moment for moment in moments if moment.asked), None)
    if asked is None:
        return Verdict(False, None, None, None, None, None, 0.0)
    open_ones = [moment for moment in moments if asked.event <= moment.event < evidence]
    shares = [moment.probabilities[kind] for moment in open_ones for kind in (RIGHT, WRONG)]
    begin = next((m.travelled for m in moments if m.event >= max(evidence, asked.event)), moments[-1].travelled)
    after = [m for m in moments if m.event >= max(evidence, asked.event) and m.travelled <= begin + soon]
    sure = next((m.travelled - begin for m in after if m.probabilities[RIGHT] > SURE), None)
    return Verdict(
        True,
        min(shares, default=None),
        max(shares, default=None),
        open_ones[0].probabilities[RIGHT] if open_ones else None,
        open_ones[-1].probabilities[RIGHT] if open_ones else None,
        sure,
        after[-1].probabilities[RIGHT] if after else 0.0,
    )


def told(recorder: Recorder) -> list[dict[str, Any]]:
    """The PMF of a run of a real log, where every closure that a hypothesis makes is taken for right."""
    entries = []
    for event, hypotheses in sorted(recorder.hypotheses.items()):
        keyframe = recorder.keyframes[event]
        samples = {leaf.hypothesis: leaf.effective_samples for leaf in keyframe.leaves}
        leaves = [
            {
                "hypothesis": leaf.hypothesis,
                "parent": leaf.parent,
                "probability": leaf.probability,
                "samples": samples[leaf.parent],
                "right": _count(arc.closure for arc in leaf.arcs),
                "wrong": 0,
            }
            for leaf in hypotheses.leaves
        ]
        where = {"event": event, "stamp": keyframe.scan.stamp, "travelled": keyframe.travelled}
        entries.append(where | {"unexamined": hypotheses.unexamined, "leaves": leaves})
    return entries


def _count(flags: Iterable[bool]) -> int:
    return sum(flags)
