"""Precision and recall of loop closures, and the topology that runs end with, on simulated worlds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmark.report import Columns, Report, Requirement, mean, table, table_of
from benchmark.settings import Settings, chosen_seeds, group_by_family, make_records
from benchmark.simulated.loops import AWAY, GRACE, OLD, STAY, VIEW
from benchmark.simulated.records import Record
from benchmark.simulated.truth import FAR, NEAR, RADIUS, TOLERANCE, TURN
from benchmark.simulated.worlds import LONG
from benchmark.tail import POLICY as TAIL_POLICY
from benchmark.tail import Pair, tail_requirement, tail_table
from hmt_slam_ros.errors import HmtSlamError

MISSED = 0.05
"""Largest share of missed loops among those that could be closed."""

POLICY = (
    f"A closure is true if two keyframes of the areas that it joins truly are within {(1.0 + TOLERANCE) * RADIUS:g} m "
    f"and in sight of each other, and their relative pose is right to {NEAR:g} m (to {FAR:g} m if the arc's covariance "
    f"admits the error at 99.9 %) and {TURN:g} degrees. The relative pose is that of the two keyframes that truly are "
    "nearest to each other. Every closure that TLCA accepts is scored, including those of known poses, and those that "
    f"enter a known area over a known arc. A loop begins when the robot, after {AWAY:g} m of new ground, comes to the "
    f"place of a keyframe of {OLD:g} m of path before. It can be closed if the definite map had not joined the two "
    f"places, the robot stays on known ground for {STAY:g} m at least, and half of the keyframes of the first ten "
    f"meters share {100.0 * VIEW:.0f} % of their view with an earlier keyframe. It is closed in time if the definite "
    f"map joins the two places before {GRACE:g} m beyond the known ground; the distance is the path from the loop's "
    "begin to that. Above 0.9 counts every accepted closure, by the probability of its path when that was accepted."
)

WORLDS = ("nested",)

INEXACT = 0.05
"""Largest share of runs that end with another topology."""

TOPOLOGY_POLICY = (
    "A run ends with the exact topology if no closure in its most probable map is false, none was accepted falsely, "
    "and every loop that can be closed is closed at the end, as defined for the closures above."
)


def measure_loops(settings: Settings) -> Report:
    """Map the worlds and compare closures with the truth."""
    records = make_records(settings)
    report = Report("loops", "Precision and recall of loop closures", seeds=chosen_seeds(settings))
    wrong = false_closures(records)
    report.requirements += [
        Requirement("closures accepted falsely", len(wrong), 0),
        Requirement("loops that could be closed and were not, share", missed_share(records), MISSED),
        tail_requirement("accepted closures", acceptances(records)),
    ]
    tail = tail_table({"accepted closures": acceptances(records)})
    report.body += [_table(records), *([_wrong_table(wrong)] if wrong else []), tail, POLICY, TAIL_POLICY]
    report.data["accepted"] = {record["world"]: record["accepted"] for record in records}
    report.data["loops"] = {record["world"]: record["loops"] for record in records}
    return report


def loops_to_close(records: Sequence[Record]) -> list[Record]:
    """All loops of some runs that can be closed."""
    return [loop for record in records for loop in record["loops"] if loop["can_be_closed"]]


def missed_share(records: Sequence[Record]) -> float:
    """Share of the loops that could be closed and were not in time; NaN if there are none."""
    loops = loops_to_close(records)
    return mean([not loop["in_time"] for loop in loops])


def closing_distances(records: Sequence[Record]) -> list[float]:
    """Path from the begin of each loop that was closed in time to its acceptance, m."""
    return [loop["closed_at"] - loop["begin"] for loop in loops_to_close(records) if loop["in_time"]]


def _table(records: list[Record]) -> str:
    columns: Columns[tuple[str, list[Record]]] = [
        ("family", lambda row: row[0]),
        ("runs", lambda row: str(len(row[1]))),
        ("closures accepted", lambda row: str(sum(len(record["accepted"]) for record in row[1]))),
        ("of them false", lambda row: str(len(false_closures(row[1])))),
        ("precision", lambda row: _format_precision(row[1])),
        ("loops to close", lambda row: str(len(loops_to_close(row[1])))),
        ("closed in time", lambda row: str(len(closing_distances(row[1])))),
        ("recall", lambda row: f"{1.0 - missed_share(row[1]):.3f}" if loops_to_close(row[1]) else "-"),
        ("distance, median [m]", lambda row: _format_percentile(closing_distances(row[1]), 50)),
        ("90 % [m]", lambda row: _format_percentile(closing_distances(row[1]), 90)),
        ("closed late", lambda row: str(_count_late(row[1]))),
    ]
    return table_of(columns, [*group_by_family(records).items(), ("**all**", records)])


def false_closures(records: Sequence[Record]) -> list[tuple[Record, Record]]:
    """The accepted closures that are false, each with the record of its run."""
    return [(record, closure) for record in records for closure in record["accepted"] if not closure["right"]]


def acceptances(records: Sequence[Record]) -> list[Pair]:
    """The probability of every closure when it was accepted, and whether it is right."""
    return [(closure["probability"], closure["right"]) for record in records for closure in record["accepted"]]


def _format_precision(records: Sequence[Record]) -> str:
    accepted = sum(len(record["accepted"]) for record in records)
    return f"{1.0 - len(false_closures(records)) / accepted:.3f}" if accepted else "-"


def _format_percentile(values: Sequence[float], share: float) -> str:
    return f"{np.percentile(values, share):.1f}" if values else "-"


def _count_late(records: Sequence[Record]) -> int:
    return sum(loop["closed_at"] is not None and not loop["in_time"] for loop in loops_to_close(records))


def _wrong_table(wrong: list[tuple[Record, Record]]) -> str:
    columns: Columns[tuple[Record, Record]] = [
        ("false closure in", lambda row: row[0]["world"]),
        ("keyframe event", lambda row: str(row[1]["event"])),
        ("found by", lambda row: row[1]["way"]),
        ("areas", lambda row: "{} and {}".format(*row[1]["areas"])),
        ("apart [m]", lambda row: f"{row[1]['apart']:.1f}"),
        ("error [m]", lambda row: f"{row[1]['translation']:.2f}"),
        ("error [deg]", lambda row: f"{row[1]['rotation']:.1f}"),
        ("probability", lambda row: f"{row[1]['probability']:.4f}"),
    ]
    return table_of(columns, wrong)


def measure_topology(settings: Settings) -> Report:
    """Map the worlds, and compare the final topology with the truth."""
    records = make_records(settings, WORLDS, others=(LONG,))
    report = Report("topology", "Exact topology of nested loops", seeds=chosen_seeds(settings))
    if not records:
        raise HmtSlamError("topology has no world of these: name nested in --logs, or leave them out")
    inexact = [record for record in records if find_faults(record)]
    share = len(inexact) / len(records)
    report.requirements.append(Requirement("runs that do not end with the exact topology, share", share, INEXACT))
    rows = [[record["world"], "; ".join(find_faults(record))] for record in inexact]
    summary = f"{len(records) - len(inexact)} of {len(records)} runs end with the exact topology."
    report.body += [summary, *([table(["run", "what is not exact"], rows)] if rows else []), TOPOLOGY_POLICY]
    report.data["faults"] = {record["world"]: find_faults(record) for record in records}
    return report


def find_faults(record: Record) -> list[str]:
    """The faults of the final topology of a run, as sentences."""
    accepted = sum(not closure["right"] for closure in record["accepted"])
    pending = sum(not closure["right"] for closure in record["pending"])
    unclosed = sum(loop["closed_at"] is None for loop in loops_to_close([record]))
    counts = {"closures accepted falsely": accepted, "false closures pending": pending, "loops not closed": unclosed}
    return [f"{name}: {count}" for name, count in counts.items() if count]
