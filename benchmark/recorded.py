"""Reliability on recorded logs: accepted closures, starts in the map of the other half, and displacements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmark.accepted_closures import NOTHING, RELATIONS, TRAJECTORY
from benchmark.awakening import COLUMNS, FAR, HELD, HELD_WAY, RIGHT_SHARE, Awakening, first_localizations, starts_row
from benchmark.displacement import APART, KINDS, KNOWN, UNKNOWN, WAY, Displacement
from benchmark.kidnapped_drive import DRIFT, RIGHT, RIGHT_ANGLE
from benchmark.kidnapping import SHARE, SOON
from benchmark.logs import open_logs
from benchmark.recorded_drive import POINTS
from benchmark.recorded_outcomes import RUNS, TENTH, RecordedOutcomes, complete_outcomes
from benchmark.relation_chains import BESIDE, LONGEST
from benchmark.report import Columns, Report, Requirement, format_share, table, table_of
from benchmark.settings import Settings
from benchmark.simulated.truth import FAR as ADMITTED
from benchmark.simulated.truth import NEAR, TURN
from benchmark.tail import POLICY as TAIL_POLICY
from benchmark.tail import Pair, tail_requirement, tail_table

LOGS = ("aces", "intel", "csail", "hospital")
DISPLACEMENTS = 100
"""Displacements in every log; also the starts in each half and, up to a bound, the runs that count closures."""

WRONG_SHARE = 0.01
"""Largest share of displacements after which the robot is sure of a wrong place."""

POLICY = (
    f"Closures: all that TLCA accepts in up to {RUNS} runs with seeds from 0, by the probability of their path when "
    "it was accepted. One is right if the relative pose of a keyframe that it placed and one of the known area, which "
    f"truly are nearest to each other, is right to {NEAR:g} m (to {ADMITTED:g} m if the arc's covariance admits the "
    f"error at 99.9 %) and {TURN:g} degrees. The true relative pose is that of the shortest chain of true relations, "
    f"of {LONGEST:g} m at most. A keyframe without a relation joins the next one within {BESIDE:g} m of path by the "
    "log's trajectory. Where no chain joins the two areas, the trajectory judges alone; it is that of the final map of "
    "seed 0, which contains the closure itself, so that it finds those only that were withdrawn or contradicted. "
    "Nothing judges a closure whose areas were merged at once. "
    f"Starts: as in awakening, in the map of one half of the log alone, at every {TENTH}th keyframe event of the other "
    f"half that is within {HELD:g} m of a keyframe of the map. Those whose next {HELD_WAY:g} m of path are, too, stay "
    "there, and have to be right. "
    f"Displacements: after one of {POINTS} scans, spread over the path from 15 to 90 %, the robot continues at another "
    f"scan, at least {APART:g} m away, for {WAY:g} m of path or to the end of the log. Stamps and odometry continue as "
    "if it had stood for one scan. It is put down on its path so far (before), on ground within "
    f"{KNOWN:g} m of that path that it comes back to later (again), or farther than {UNKNOWN:g} m from it (new). It is "
    f"noticed and right as in kidnapping: within {RIGHT:g} m and {math.degrees(RIGHT_ANGLE):.0f} degrees of the pose "
    f"by the nearest keyframe of before, with {100 * DRIFT:g} % of the distance to that added. Confident and wrong is "
    "a drive with hmt/is_localized at a wrong place, at any keyframe event after the displacement was noticed or at "
    "the last one. The truth of starts and displacements is the trajectory of the final map. "
    "Above 0.9 counts closures judged by relations, first localizations, and keyframe events after displacements; "
    "those of a drive depend on each other."
)

_Logs = dict[str, RecordedOutcomes]


def measure_recorded(settings: Settings) -> Report:
    """Map the logs, and let robots start and be displaced in them."""
    report = Report("recorded", "Reliability on recorded logs", seeds=(0,))
    count = len(settings.seeds_or(DISPLACEMENTS))
    with open_logs(settings.logs_or(LOGS)) as logs:
        found = {log.name: complete_outcomes(log, settings, count) for log in logs}
    for name, outcomes in found.items():
        report.requirements += _requirements(name, outcomes)
        report.data[name] = _data(outcomes)
    tails = _tails(found)
    report.requirements += [tail_requirement(name, pairs) for name, pairs in tails.items() if pairs]
    report.body += [
        table_of(_TRUTH_COLUMNS, found.items()),
        table_of(_CLOSURE_COLUMNS, found.items()),
        table(
            COLUMNS,
            [row for name, outcomes in found.items() for row in _starts_rows(name, outcomes)],
        ),
        table_of(_DISPLACEMENT_COLUMNS, list(_by_kind(found))),
        tail_table(tails),
        table(_WRONG_HEAD, [row for name, outcomes in found.items() for row in _wrong_rows(name, outcomes)]),
        POLICY,
        TAIL_POLICY,
    ]
    return report


def _requirements(name: str, outcomes: RecordedOutcomes) -> list[Requirement]:
    false = sum(not closure["right"] for closure in outcomes.closures_by(RELATIONS))
    required = [Requirement(f"{name}: closures accepted falsely, by relations", false, 0)]
    for half, starts in outcomes.starts.items():
        kind, staying = f"{name}, map of the {half}", outcomes.staying[half]
        if staying:
            good = float(np.mean([start.good for start in staying]))
            required.append(Requirement(f"{kind}: right within {FAR:g} m", good, 1.0, least=RIGHT_SHARE))
        wrong = sum(start.wrong for start in starts)
        required.append(Requirement(f"{kind}: confident wrong answers", wrong, 0))
    return required + displacement_requirements(name, outcomes.displacements)


def displacement_requirements(name: str, found: Sequence[Displacement]) -> list[Requirement]:
    """Requirements on the delay of detections, and on confident wrong answers."""
    noticed = float(np.mean([one.scores.noticed <= SOON for one in found])) if found else math.nan
    wrong = float(np.mean([one.wrong is not None for one in found])) if found else math.nan
    return [
        Requirement(f"{name}: displacements noticed within {SOON:g} m", noticed, 1.0, least=SHARE),
        Requirement(f"{name}: displacements, confident and wrong", wrong, WRONG_SHARE),
    ]


def _starts_rows(name: str, outcomes: RecordedOutcomes) -> list[list[str]]:
    kinds = {"": outcomes.starts, ", that stay there": outcomes.staying}
    return [starts_row(name, f"{half}{kind}", own[half]) for half in outcomes.starts for kind, own in kinds.items()]


def _data(outcomes: RecordedOutcomes) -> dict[str, Any]:
    return {
        "truth": outcomes.errors,
        "closures": outcomes.closures,
        "starts": {half: [asdict(start) for start in starts] for half, starts in outcomes.starts.items()},
        "staying": {half: [start.start for start in starts] for half, starts in outcomes.staying.items()},
        "displacements": [displacement.document for displacement in outcomes.displacements],
    }


def _tails(found: _Logs) -> dict[str, list[Pair]]:
    """The answers of each part, of all logs together."""
    tails: dict[str, list[Pair]] = {"closures": [], "first localizations": [], "events after displacements": []}
    for outcomes in found.values():
        tails["closures"] += [(one["probability"], one["right"]) for one in outcomes.closures_by(RELATIONS)]
        for starts in outcomes.starts.values():
            tails["first localizations"] += first_localizations(starts)
        for displacement in outcomes.displacements:
            tails["events after displacements"] += displacement.scores.localizations
    return tails


_TRUTH_COLUMNS: Columns[tuple[str, RecordedOutcomes]] = [
    ("truth: trajectory of the log", lambda row: row[0]),
    ("relations", lambda row: str(row[1].errors["relations"])),
    ("error, mean [m]", lambda row: f"{row[1].errors['mean']:.4f}"),
    ("over 60 s [m]", lambda row: f"{row[1].errors['over_60_s']:.4f}"),
    ("its max [m]", lambda row: f"{row[1].errors['over_60_s_max']:.2f}"),
]


def _count(outcomes: RecordedOutcomes, by: str, *, false: bool = False) -> str:
    return str(sum(not (false and closure["right"]) for closure in outcomes.closures_by(by)))


_CLOSURE_COLUMNS: Columns[tuple[str, RecordedOutcomes]] = [
    ("closures of", lambda row: row[0]),
    ("runs", lambda row: str(row[1].runs)),
    ("accepted", lambda row: str(len(row[1].closures))),
    ("judged by relations", lambda row: _count(row[1], RELATIONS)),
    ("of them false", lambda row: _count(row[1], RELATIONS, false=True)),
    ("by the trajectory", lambda row: _count(row[1], TRAJECTORY)),
    ("of them false", lambda row: _count(row[1], TRAJECTORY, false=True)),
    ("by nothing", lambda row: _count(row[1], NOTHING)),
]

_DISPLACEMENT_COLUMNS: Columns[tuple[str, str, list[Displacement]]] = [
    ("log", lambda row: row[0]),
    ("put down", lambda row: row[1]),
    ("drives", lambda row: str(len(row[2]))),
    (f"noticed within {SOON:g} m", lambda row: format_share([one.scores.noticed <= SOON for one in row[2]])),
    ("m until noticed, median", lambda row: f"{np.median([one.scores.noticed for one in row[2]]):.1f}"),
    ("right at the end", lambda row: format_share([not math.isinf(one.scores.again) for one in row[2]])),
    ("confident and wrong", lambda row: str(sum(one.wrong is not None for one in row[2]))),
    ("m sure of a wrong place", lambda row: f"{np.mean([one.scores.confident for one in row[2]]):.2f}"),
]


def _by_kind(found: _Logs) -> list[tuple[str, str, list[Displacement]]]:
    rows = [
        (name, kind, [one for one in outcomes.displacements if one.splice.kind == kind])
        for name, outcomes in found.items()
        for kind in KINDS
    ]
    return [row for row in rows if row[2]]


_WRONG_HEAD = ("wrong in", "what", "scan", "event", "m of path", "off [m]", "probability")


def _wrong_rows(name: str, outcomes: RecordedOutcomes) -> list[list[str]]:
    """The lines of all wrong answers in a log."""
    closures = outcomes.closures_by(RELATIONS) + outcomes.closures_by(TRAJECTORY)
    rows = [_wrong_closure(name, one) for one in closures if not one["right"]]
    for half, starts in outcomes.starts.items():
        rows += [_wrong_start(name, half, start) for start in starts if start.wrong]
    for one in outcomes.displacements:
        if one.wrong is not None or one.scores.noticed > SOON:
            rows.append(_wrong_displacement(name, one))
    return rows


def _wrong_closure(name: str, one: dict[str, Any]) -> list[str]:
    what = f"closure, seed {one['seed']}, by {one['by']}"
    off, probability = f"{one['translation']:.2f}", f"{one['probability']:.4f}"
    return [name, what, str(one["scan"]), str(one["event"]), "-", off, probability]


def _wrong_start(name: str, half: str, start: Awakening) -> list[str]:
    found, probability = f"{start.found:.1f}", f"{start.probability:.4f}"
    return [name, f"start in the {half}", str(start.start), "-", found, f"{start.off:.2f}", probability]


def _wrong_displacement(name: str, one: Displacement) -> list[str]:
    scans, wrong = f"{one.splice.left} to {one.splice.joined}", one.wrong
    what = f"displacement, {one.splice.kind}, noticed after {one.scores.noticed:.1f} m"
    if wrong is None:
        return [name, what, scans, "-", "-", "-", "-"]
    figures = [str(wrong.event), f"{wrong.traveled:.1f}", f"{wrong.off:.2f}", f"{wrong.probability:.4f}"]
    return [name, what, scans, *figures]
