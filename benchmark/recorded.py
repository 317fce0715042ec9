"""What landmarks, and being in a hallway or a room, add on recorded logs: to closures, calibration, awakening."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from benchmark.awakening import FAR, Awakening, made_starts
from benchmark.evidence import fitted as regression
from benchmark.logs import MeasuredLog, opened
from benchmark.looks import INSIDE, KEYFRAMES, OUTSIDE, RIGHT, RIGHT_ANGLE, Drive, Look, Looks, Part, mapped_part
from benchmark.prior import SURE, Scored, best_constant, by_a_constant, by_landmarks, scored_with
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.settings import Settings
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.logs import LogRecord
from hmt_slam_ros.offline.runtime import Run
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.topological_inference.global_localization import UNMAPPED

Array = NDArray[np.float64]

LOGS = ("aces", "intel", "freiburg-101", "edmonton")

AWAKENING = ("aces", "intel")
"""Logs with all of their scans, in which a robot can wake up and drive on."""

STARTS = 20
"""Of every kind of map of these."""

SHARES = (0.4, 0.6, 0.8)
"""Of a log that are mapped before the looks."""

NONE, CONSTANT, LANDMARKS, KINDS, BOTH = "nothing", "the best constant", "landmarks", "kind of area", "both"
"""What weighs the places that surfaces find."""

# Of a log that the robot drives on after the map ends, so that it comes back to where it looks.
_LATER = 0.02

POLICY = (
    f"A log is mapped up to {', '.join(f'{share:g}' for share in SHARES)} of its scans. A robot that wakes up later "
    f"looks where it is in that map once it saw {KEYFRAMES} keyframes, inside within {INSIDE:g} m of keyframes of the "
    f"map, outside farther than {OUTSIDE:g} m from all of them. The truth is the run over the whole log, relative to "
    f"the nearest keyframe of the map; a right place is off by {RIGHT:g} m and {math.degrees(RIGHT_ANGLE):.0f} degrees "
    f"at most. Log score and found as for `prior`: found is a probability of {SURE:g}, looks from outside weigh "
    f"{UNMAPPED:g}. Area under the ROC curve: probability that a right place of a log has more of this evidence than "
    "a wrong one that surfaces found, both in any look. Weights are those of a logistic regression of right and wrong "
    "on the log-probability by surfaces and this evidence: 0 where it adds nothing, 1 where it counts as it says. "
    f"Awakenings are those of `awakening`, the first {STARTS} starts of each kind of map, right within {FAR:g} m."
)


def measure_recorded(settings: Settings) -> Report:
    """Look at maps of logs, and wake up in them, with and without landmarks and kinds of areas."""
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    report = Report("recorded", "What landmarks and kinds of areas add on recorded logs", seeds=(configuration.seed,))
    with opened(settings.logs_or(LOGS)) as logs:
        looks = {log.name: list(looks_of(log, configuration)) for log in logs}
        woken = [row for log in logs if log.name in AWAKENING for row in _awakenings(log, settings)]
    every = [look for own in looks.values() for look in own]
    scores = {name: scored(own, configuration) for name, own in {**looks, "**all**": every}.items()}
    without, landmarks = (scores["**all**"][name].score for name in (NONE, LANDMARKS))
    report.requirements.append(Requirement("log score with landmarks / without", landmarks / without, 1.0))
    head = ["log", "looks from inside", "outside", "places weighed by", "log score", "found", "wrong", "outside"]
    report.body.append(table(head, _score_rows({**looks, "**all**": every}, scores)))
    parts = ("landmarks", "kind of area")
    head = ["log", "places right", "wrong", "ROC of surfaces", *(f"of {part}" for part in parts)]
    told = [_told_apart(name, own) for name, own in looks.items()]
    report.body.append(table([*head, *(f"weight of {part}" for part in parts)], [row for row in told if row]))
    head = ["log", "map of the", "landmarks", "starts", f"right within {FAR:g} m", "m until known, mean", "wrong"]
    report.body += [table([*head, "not known"], woken), POLICY]
    return report


def looks_of(log: MeasuredLog, configuration: Configuration) -> Iterator[Look]:
    """Looks at the maps of parts of a log."""
    records = list(open_log(log.path).records())
    scans = [record.measurement for record in records if isinstance(record.measurement, Scan)]
    parts, poses = _mapped(records, [int(share * len(scans)) for share in SHARES], configuration)
    drive = Drive(records, np.array([scan.stamp for scan in scans]), poses, scans.__getitem__)
    for part in parts:
        yield from Looks(drive, part, configuration).taken(part.last + int(_LATER * len(scans)))


def _mapped(
    records: Sequence[LogRecord], ends: Sequence[int], configuration: Configuration
) -> tuple[list[Part], Array]:
    """The maps up to scans, and where the run over the whole log has every scan, shape (n, 3)."""
    run, parts = Run(configuration), []
    for record in records:
        run.read(record)
        if isinstance(record.measurement, Scan) and run.scans - 1 in ends:
            parts.append(mapped_part(run, run.scans - 1))
            run = Run(configuration, state=run.state)
    result = run.finish()
    return parts, result.recorder.finish(result.log.stamps).trajectory


def scored(looks: Sequence[Look], configuration: Configuration) -> dict[str, Scored]:
    """What comes of looks by each way to weigh their places."""
    landmarks = by_landmarks(configuration.places.prior_temper)
    return {
        NONE: scored_with(looks),
        CONSTANT: scored_with(looks, by_a_constant(best_constant(looks))),
        LANDMARKS: scored_with(looks, landmarks),
        KINDS: scored_with(looks, lambda look: look.kinds),
        BOTH: scored_with(looks, lambda look: look.kinds + landmarks(look)),
    }


def _score_rows(looks: Mapping[str, Sequence[Look]], scores: Mapping[str, Mapping[str, Scored]]) -> Iterator[list[str]]:
    for log, own in looks.items():
        inside = sum(look.inside for look in own)
        for name, of in scores[log].items():
            shares = [f"{100.0 * share:.0f} %" for share in of[1:]]
            yield [log, str(inside), str(len(own) - inside), name, f"{of.score:.3f}", *shares]


def _told_apart(name: str, looks: Sequence[Look]) -> list[str]:
    """How well each kind of evidence tells right places from wrong ones; nothing where there are none of either."""
    right = np.concatenate([look.right for look in looks])
    if right.all() or not right.any():
        return []
    parts = [
        np.concatenate([np.log(np.maximum(look.where.probabilities, 1e-12)) for look in looks]),
        np.concatenate([look.ratios for look in looks]),
        np.concatenate([look.kinds for look in looks]),
    ]
    weights = [regression(np.column_stack((parts[0], part)), right)[0][2] for part in parts[1:]]
    areas = [f"{roc_area(part, right):.3f}" for part in parts]
    return [name, str(int(right.sum())), str(int((~right).sum())), *areas, *(f"{weight:.2f}" for weight in weights)]


def roc_area(evidence: Array, right: NDArray[np.bool_]) -> float:
    """The probability that evidence of a right place is larger than that of a wrong one."""
    count = int(right.sum())
    ranks = float(rankdata(evidence)[right].sum()) - 0.5 * count * (count + 1)
    return ranks / (count * (len(right) - count))


def _awakenings(log: MeasuredLog, settings: Settings) -> Iterator[list[str]]:
    """Rows of what came of waking up, without landmarks and with them."""
    count = len(settings.seeds_or(STARTS))
    for name, prior in (("without", "false"), ("with", "true")):
        changes = (*settings.changes, f"places.prior={prior}")
        asked = load_configuration(PARAMETERS, list(changes))
        for kind, starts in made_starts(log.name, log.path, asked, changes, count, settings.records).items():
            if starts:
                yield [log.name, kind, name, *_figures(starts)]


def _figures(starts: Sequence[Awakening]) -> list[str]:
    known = [one.found for one in starts if one.right]
    mean = f"{np.mean(known):.1f}" if known else "-"
    wrong, never = sum(one.wrong for one in starts), sum(math.isinf(one.found) for one in starts)
    return [str(len(starts)), f"{np.mean([one.good for one in starts]):.2f}", mean, str(wrong), str(never)]
