"""Hypotheses in identical places: their probabilities until the evidence, and the outcome after it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from benchmark.logs import BUNDLED, open_logs
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings, chosen_seeds, make_records
from benchmark.simulated.loops import ALIKE_BEAMS, ALIKE_RADIUS, ALIKE_VIEW
from benchmark.simulated.records import Record
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.recorder import Recorder

WORLDS = ("twins", "ring")
SEEDS = 10
_SHOWN = 15  # keyframe events before the question that are drawn, and after

LOW, HIGH = 0.2, 0.8
"""Probabilities between which a hypothesis is alive and does not exclude the other."""

SURE = 0.95
"""Probability that the true hypothesis has to exceed after the evidence."""

SOON = 2.0
"""Path within which it has to, m: ``tlca.accept_distance``."""

LATER = (SOON, 5.0, 10.0, 20.0)
"""Paths at which the table counts re-entries with a sure true hypothesis, m."""

DECIDED = 0.99
"""Probability by odometry from which on it separates the places alone."""

NEW, RIGHT, WRONG = "new ground", "the true place", "another place"
_DPI = 80
_COLORS = {RIGHT: "C0", WRONG: "C3", NEW: "C7"}

POLICY = (
    "A re-entry is the first keyframe event at which the robot, after new ground, is in a known place that looks like "
    "another known one. Two places look the same if a laser without noise sees the same from the robot's true pose and "
    f"from its image in the other place, up to {100.0 * ALIKE_BEAMS:.0f} % of the beams or {ALIKE_VIEW:g} m, and an "
    f"old keyframe is within {ALIKE_RADIUS:g} m of the image. *By odometry* is the probability of the true place among "
    "all of these, by the odometry since the robot last saw anything, under the true covariance of its errors. In the "
    "ring, where the robot always sees something, it is the odometry since it was there a lap ago. A value of "
    f"{DECIDED:g} or more means that odometry separates the places before the question. Otherwise the evidence is the "
    "first keyframe at which the views differ. The question is the first event at which known places together have "
    f"{LOW:g}. From it until the evidence, both the true and the other place should have between {LOW:g} and {HIGH:g}. "
    f"{SOON:g} m after the evidence, or after the question if that comes later, the true one should have more than "
    f"{SURE:g}. New ground and unexamined answers have the rest."
)


class Reentry(NamedTuple):
    """A re-entry, with the hypotheses over time and the verdict on them."""

    record: Record
    rivalry: Record
    moments: list[Moment]
    verdict: ReentryVerdict


def measure_ambiguity(settings: Settings) -> Report:
    """Map the worlds and the bundled log, and score the hypotheses at re-entries."""
    records = make_records(settings, WORLDS, SEEDS)
    found = [_judge_rivalry(record, rivalry) for record in records for rivalry in record["rivalries"]]
    report = Report("ambiguity", "Identical places", seeds=chosen_seeds(settings, SEEDS))
    for family in dict.fromkeys(record["family"] for record in records):
        report.requirements += requirements(family, [entry for entry in found if entry.record["family"] == family])
    report.body += [reentry_table(found), _by_odometry(found), decision_table(found), POLICY]
    report.data["reentries"] = [
        {"world": e.record["world"], **e.rivalry, **vars(e.verdict), "decided": is_decided(e.rivalry)} for e in found
    ]
    panels = _choose_panels(found) | _bundled_panel(settings)
    caption = "Effective sample size of the best hypothesis, and probabilities of the robot's place, over time."
    report.pictures["ambiguity.png"] = caption
    report.illustrations = ("ambiguity.png",)
    particles = settings.configuration.filter.particles
    plot_ambiguity(settings.out / "ambiguity.png", panels, particles)
    return report


def _judge_rivalry(record: Record, rivalry: Record) -> Reentry:
    moments = trace_hypotheses(record["pmf"], rivalry["event"])
    return Reentry(record, rivalry, moments, judge_reentry(moments, _evidence_event(rivalry)))


def _evidence_event(rivalry: Record) -> int:
    """The keyframe event from which on the places can be separated."""
    event: int = rivalry["event"] if is_decided(rivalry) or rivalry["evidence"] is None else rivalry["evidence"]
    return event


def is_decided(rivalry: Record) -> bool:
    """Whether odometry alone separates the places."""
    return bool(max(rivalry["by_odometry"], 1.0 - rivalry["by_odometry"]) >= DECIDED)


def requirements(family: str, found: Sequence[Reentry]) -> list[Requirement]:
    """Requirements on the re-entries of a family."""
    open_reentries, deciding = undecided_by_odometry(found), requiring_decision(found)
    alive_count = sum(entry.verdict.both_alive for entry in open_reentries)
    decided_count = sum(entry.verdict.is_decided_correctly for entry in deciding)
    count, total = len(open_reentries), f"of {len(deciding)}"
    # A requirement on no re-entries would always be met.
    alive_requirements = [
        Requirement(f"{family}: of these {count}, both alive until the evidence", alive_count, math.inf, least=count)
    ]
    return [
        Requirement(f"{family}: re-entries that odometry does not decide", count, math.inf, least=1),
        *(alive_requirements if open_reentries else []),
        Requirement(
            f"{family}: {total}, the true one sure after the evidence", decided_count, math.inf, least=len(deciding)
        ),
    ]


def decided_by_odometry(found: Sequence[Reentry]) -> list[Reentry]:
    """The re-entries that odometry alone decides."""
    return [entry for entry in found if is_decided(entry.rivalry)]


def undecided_by_odometry(found: Sequence[Reentry]) -> list[Reentry]:
    """The re-entries that odometry alone does not decide."""
    return [entry for entry in found if not is_decided(entry.rivalry)]


def requiring_decision(found: Sequence[Reentry]) -> list[Reentry]:
    """The re-entries in which the true place has to become sure."""
    return [entry for entry in found if entry.verdict.has_question or not is_decided(entry.rivalry)]


def decision_table(found: Sequence[Reentry]) -> str:
    """Number of re-entries whose true place is sure, and stays so, by the path after the evidence."""
    rows = []
    for family, own in _by_family(found).items():
        deciding = requiring_decision(own)
        for kind, entries in (
            ("decided by odometry", decided_by_odometry(deciding)),
            ("not decided by it", undecided_by_odometry(deciding)),
        ):
            counts = [
                sum(judge_reentry(e.moments, _evidence_event(e.rivalry), path).is_decided_correctly for e in entries)
                for path in LATER
            ]
            rows.append([f"{family}, {kind}", str(len(entries)), *map(str, counts)])
    return table(["re-entries", "number", *(f"sure {path:g} m after the evidence" for path in LATER)], rows)


def reentry_table(found: Sequence[Reentry]) -> str:
    """A line for every re-entry that odometry does not decide, and one for all others of a family."""
    head = ["re-entry in", "path since the last certain pose [m]", "by odometry", "evidence after [m]"]
    head += ["true one at the question", "before the evidence", "either, lowest", "highest", "alive", "sure after [m]"]
    head += [f"true one after {SOON:g} m", "sure"]
    rows = [_reentry_row(entry) for entry in undecided_by_odometry(found)]
    for family, own in _by_family(found).items():
        entries = [entry for entry in decided_by_odometry(own) if entry.verdict.has_question]
        least = min((entry.rivalry["by_odometry"] for entry in entries), default=math.nan)
        correct = f"{sum(entry.verdict.is_decided_correctly for entry in entries)} of {len(entries)}"
        final = min((entry.verdict.final for entry in entries), default=math.nan)
        name = f"{family}, decided by odometry"
        rows.append([name, "", f"at least {least:.4f}", *[""] * 7, f"at least {final:.3f}", correct])
    return table(head, rows)


def _by_family(found: Sequence[Reentry]) -> dict[str, list[Reentry]]:
    """The re-entries of each family, in the order of their first ones."""
    families = dict.fromkeys(entry.record["family"] for entry in found)
    return {family: [entry for entry in found if entry.record["family"] == family] for family in families}


def _by_odometry(found: Sequence[Reentry]) -> str:
    """A sentence with the number of re-entries that odometry alone leaves undecided."""
    open_reentries = undecided_by_odometry(found)
    undecided_count = sum(LOW <= entry.rivalry["by_odometry"] <= HIGH for entry in open_reentries)
    return (
        f"Of the {len(open_reentries)} re-entries that odometry does not decide, it alone leaves both places between "
        f"{LOW:g} and {HIGH:g} in {undecided_count}."
    )


def _reentry_row(entry: Reentry) -> list[str]:
    rivalry, verdict = entry.rivalry, entry.verdict
    distances = {moment["event"]: moment["traveled"] for moment in entry.record["pmf"]}
    to_evidence = None if rivalry["evidence"] is None else distances[rivalry["evidence"]] - distances[rivalry["event"]]
    return [
        entry.record["world"],
        f"{distances[rivalry['event']] - distances[rivalry['since']]:.0f}",
        f"{rivalry['by_odometry']:.3f}",
        _format_figure(to_evidence, 1),
        *(
            _format_figure(value, 3)
            for value in (verdict.at_question, verdict.at_evidence, verdict.lowest, verdict.highest)
        ),
        _format_verdict(verdict.both_alive),
        _format_figure(verdict.waited, 1),
        _format_figure(verdict.final, 3),
        _format_verdict(verdict.is_decided_correctly),
    ]


def _format_figure(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _format_verdict(met: bool) -> str:
    return "pass" if met else "FAIL"


def _choose_panels(found: Sequence[Reentry]) -> dict[str, Panel]:
    """One re-entry of each family: the first that odometry does not decide, else the first with a question."""
    panels = {}
    for own in _by_family([entry for entry in found if entry.verdict.has_question]).values():
        entry = (undecided_by_odometry(own) or own)[0]
        marks = {"in the known place again": entry.rivalry["event"]}
        if entry.rivalry["evidence"] is not None:
            marks["evidence"] = entry.rivalry["evidence"]
        panels[entry.record["world"]] = _cut_panel(entry.record["pmf"], entry.moments, marks)
    return panels


def _cut_panel(pmf: Sequence[Record], moments: Sequence[Moment], marks: dict[str, int]) -> Panel:
    question = next(moment.event for moment in moments if moment.has_question)
    begin, end = min(question, *marks.values()) - _SHOWN, max(question, *marks.values()) + _SHOWN
    seconds = {moment.event: moment.seconds for moment in trace_hypotheses(pmf, 0)}
    shown = [moment for moment in trace_hypotheses(pmf, begin) if moment.event <= end]
    return Panel(shown, {name: seconds[event] for name, event in marks.items()})


def _bundled_panel(settings: Settings) -> dict[str, Panel]:
    """The panel of the first loop of the bundled log; none if no hypothesis closes one."""
    with open_logs([BUNDLED]) as (log,):
        recorder = run_log(open_log(log.path), settings.configuration).recorder
    pmf = trace_of_recorder(recorder)
    moments = trace_hypotheses(pmf, 0)
    questions = [moment.event for moment in moments if moment.has_question]
    return {f"{BUNDLED}, the bundled log": _cut_panel(pmf, moments, {"loop closed": questions[0]})} if questions else {}


@dataclass(frozen=True)
class Moment:
    """The hypotheses at a keyframe event.

    :ivar seconds: since the first one.
    :ivar traveled: path length since the start, m.
    :ivar samples: effective sample size of the most probable hypothesis's particles.
    :ivar probabilities: {``NEW``, ``RIGHT`` or ``WRONG``: of the hypotheses of that class}.
    """

    event: int
    seconds: float
    traveled: float
    samples: float
    probabilities: dict[str, float]

    @property
    def has_question(self) -> bool:
        """Whether known places together have the probability ``LOW``."""
        return self.probabilities[RIGHT] + self.probabilities[WRONG] >= LOW


def trace_hypotheses(pmf: Sequence[Mapping[str, Any]], begin: int) -> list[Moment]:
    """The moments from a keyframe event on.

    A hypothesis is in new ground until it closes a loop; it is wrong from its first false closure on.

    :param pmf: as of :class:`benchmark.simulated.watch.Watch`.
    """
    kinds: dict[int, str] = {}
    moments = []
    for entry in pmf:
        if entry["event"] < begin:
            continue
        hypotheses = entry["hypotheses"]
        kinds = {
            hypothesis["hypothesis"]: _classify(kinds.get(hypothesis["parent"], NEW), hypothesis)
            for hypothesis in hypotheses
        }
        shares = {
            kind: sum(hypothesis["probability"] for hypothesis in hypotheses if kinds[hypothesis["hypothesis"]] == kind)
            for kind in (NEW, RIGHT, WRONG)
        }
        best = max(hypotheses, key=lambda hypothesis: float(hypothesis["probability"]))
        seconds = (entry["stamp"] - pmf[0]["stamp"]) / 1e9
        moments.append(Moment(entry["event"], seconds, entry["traveled"], best["samples"], shares))
    return moments


def _classify(before: str, hypothesis: Mapping[str, Any]) -> str:
    if hypothesis["wrong"]:
        return WRONG
    return RIGHT if hypothesis["right"] and before == NEW else before


@dataclass(frozen=True)
class ReentryVerdict:
    """The verdict on the hypotheses of a re-entry.

    :ivar has_question: whether known places together ever have the probability ``LOW``.
    :ivar lowest: the smallest probability of the true and of another place, from the question to the evidence.
    :ivar highest: the largest of the two; both None without a question before the evidence.
    :ivar at_question: probability of the true place at the question; ``at_evidence``, just before the evidence; None
        likewise.
    :ivar waited: path from the evidence, or the question if that comes later, until the true one is sure, m; None where
        it never is within ``SOON``.
    :ivar final: probability of the true place ``SOON`` after the evidence, or the question.
    """

    has_question: bool
    lowest: float | None
    highest: float | None
    at_question: float | None
    at_evidence: float | None
    waited: float | None
    final: float

    @property
    def both_alive(self) -> bool:
        """Whether both places are alive from the question to the evidence."""
        return self.lowest is not None and self.highest is not None and self.lowest >= LOW and self.highest <= HIGH

    @property
    def is_decided_correctly(self) -> bool:
        """Whether the true place is sure soon after the evidence, and stays so."""
        return self.waited is not None and self.final > SURE


def judge_reentry(moments: Sequence[Moment], evidence: int, soon: float = SOON) -> ReentryVerdict:
    """The verdict on the moments of a re-entry.

    :param evidence: the keyframe event from which on the places can be separated.
    :param soon: path within which the true place has to be sure, m.
    """
    question = next((moment for moment in moments if moment.has_question), None)
    if question is None:
        return ReentryVerdict(False, None, None, None, None, None, 0.0)
    open_moments = [moment for moment in moments if question.event <= moment.event < evidence]
    shares = [moment.probabilities[kind] for moment in open_moments for kind in (RIGHT, WRONG)]
    begin = next((m.traveled for m in moments if m.event >= max(evidence, question.event)), moments[-1].traveled)
    after = [m for m in moments if m.event >= max(evidence, question.event) and m.traveled <= begin + soon]
    sure = next((m.traveled - begin for m in after if m.probabilities[RIGHT] > SURE), None)
    return ReentryVerdict(
        True,
        min(shares, default=None),
        max(shares, default=None),
        open_moments[0].probabilities[RIGHT] if open_moments else None,
        open_moments[-1].probabilities[RIGHT] if open_moments else None,
        sure,
        after[-1].probabilities[RIGHT] if after else 0.0,
    )


def trace_of_recorder(recorder: Recorder) -> list[dict[str, Any]]:
    """The PMF of a run of a real log, as of ``Watch``; all closures count as right."""
    entries = []
    for event, message in sorted(recorder.hypotheses.items()):
        keyframe = recorder.keyframes[event]
        samples = {hypothesis.hypothesis: hypothesis.effective_samples for hypothesis in keyframe.estimates}
        entries_of_event = [
            {
                "hypothesis": hypothesis.id,
                "parent": hypothesis.parent,
                "probability": hypothesis.probability,
                "samples": samples[hypothesis.parent],
                "right": _count_true(arc.closure for arc in hypothesis.arcs),
                "wrong": 0,
            }
            for hypothesis in message.hypotheses
        ]
        position = {"event": event, "stamp": keyframe.scan.stamp, "traveled": keyframe.path_length}
        entries.append(position | {"unexamined": message.unexamined, "hypotheses": entries_of_event})
    return entries


def _count_true(flags: Iterable[bool]) -> int:
    return sum(flags)


class Panel(NamedTuple):
    """Moments to be drawn.

    :ivar marks: {name of a moment: seconds}.
    """

    moments: Sequence[Moment]
    marks: Mapping[str, float]


def plot_ambiguity(path: Path, panels: Mapping[str, Panel], particles: int) -> None:
    """Draw effective sample size and PMF of the robot's place over time, as Fig. 10 of the paper.

    :param panels: {log: panel}.
    :param particles: of a hypothesis.
    """
    figure = Figure(figsize=(4.5 * len(panels), 5.0), layout="constrained")
    grid = figure.subplots(2, len(panels), squeeze=False, sharex="col", height_ratios=(1.0, 2.0))
    for column, (name, panel) in enumerate(panels.items()):
        upper, lower = grid[0][column], grid[1][column]
        seconds = [moment.seconds for moment in panel.moments]
        upper.step(seconds, [100.0 * m.samples / particles for m in panel.moments], where="post", color="black")
        upper.set(ylim=(0.0, 105.0), ylabel="ESS [%]")
        upper.set_title(name, fontsize=9)
        for kind, color in _COLORS.items():
            shares = [moment.probabilities[kind] for moment in panel.moments]
            lower.step(seconds, shares, where="post", color=color, label=kind)
        for axes in (upper, lower):
            for mark, style in zip(panel.marks.items(), ("--", ":"), strict=False):
                axes.axvline(mark[1], color="black", linewidth=0.8, linestyle=style, label=mark[0])
        lower.axhspan(LOW, HIGH, color="0.93")
        lower.set(ylim=(-0.02, 1.02), ylabel="probability", xlabel="time [s]")
        lower.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)
