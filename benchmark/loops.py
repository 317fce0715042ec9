"""Precision and recall of loop closures, and the topology that runs end with, on simulated worlds."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings, chosen_seeds, group_by_family, make_records
from benchmark.simulated.loops import AWAY, GRACE, OLD, STAY, VIEW
from benchmark.simulated.records import Record
from benchmark.simulated.truth import FAR, NEAR, RADIUS, TOLERANCE, TURN
from benchmark.simulated.worlds import LONG

MISSED = 0.05
"""Largest share of loops that could be closed and were not."""

POLICY = (
    f"A closure is true where the keyframes that are said to meet truly are within {(1.0 + TOLERANCE) * RADIUS:g} m and in "
    f"sight of each other and their relative pose is right to {NEAR:g} m (to {FAR:g} m where the arc's covariance "
    f"admits the error at 99.9 %) and {TURN:g} degrees, between the two keyframes that truly are nearest to each "
    "other. Every closure that TLCA accepts is judged, also where the robot was known to be there, and also where it "
    "enters a known area over an arc that is known. A loop begins where the robot, after "
    f"{AWAY:g} m of new ground, comes to the place of a keyframe of {OLD:g} m of path before. It can be closed where "
    f"the definite map had not joined the two places, the robot stays on known ground for {STAY:g} m at least, and "
    f"half of the keyframes of the first ten metres share {100.0 * VIEW:.0f} % of what they see with a keyframe of "
    f"before. It is closed in time where the definite map joins the two places before {GRACE:g} m beyond the known "
    "ground; the distance is the path from the loop's begin to that."
)

WORLDS = ("nested",)

INEXACT = 0.05
"""Largest share of runs that end otherwise."""

TOPOLOGY_POLICY = (
    "A run ends with the exact topology where no closure in its most probable map is false, none was accepted falsely "
    "on the way, and every loop that can be closed is closed at the end, as defined for the closures above."
)


def measure_loops(settings: Settings) -> Report:
    """Map the worlds and compare closures with the truth."""
    records = make_records(settings)
    report = Report("loops", "Precision and recall of loop closures", seeds=chosen_seeds(settings))
    wrong = [(record, closure) for record in records for closure in record["accepted"] if not closure["right"]]
    report.requirements += [
        Requirement("closures accepted falsely", len(wrong), 0),
        Requirement("loops that could be closed and were not, share", missed_share(records), MISSED),
    ]
    report.body += [_table(records), *([_wrong_table(wrong)] if wrong else []), POLICY]
    report.data["accepted"] = {record["world"]: record["accepted"] for record in records}
    report.data["loops"] = {record["world"]: record["loops"] for record in records}
    return report


def loops_to_close(records: Sequence[Record]) -> list[Record]:
    """All loops that can be closed."""
    return [loop for record in records for loop in record["loops"] if loop["can_be_closed"]]


def missed_share(records: Sequence[Record]) -> float:
    """Share of the loops that could be closed and were not in time; NaN where there are none."""
    loops = loops_to_close(records)
    return sum(not loop["in_time"] for loop in loops) / len(loops) if loops else math.nan


def closing_distances(records: Sequence[Record]) -> list[float]:
    """Path from the begin of a loop to its acceptance, m, of those that were closed in time."""
    return [loop["closed_at"] - loop["begin"] for loop in loops_to_close(records) if loop["in_time"]]


def _table(records: list[Record]) -> str:
    head = ["family", "runs", "closures accepted", "of them false", "precision", "loops to close", "closed in time"]
    head += ["recall", "distance, median [m]", "90 % [m]", "closed late"]
    rows = [[family, *_loop_cells(own)] for family, own in group_by_family(records).items()]
    return table(head, [*rows, ["**all**", *_loop_cells(records)]])


def _loop_cells(records: list[Record]) -> list[str]:
    accepted = [closure for record in records for closure in record["accepted"]]
    false = sum(not closure["right"] for closure in accepted)
    loops, distances = loops_to_close(records), closing_distances(records)
    late = sum(loop["closed_at"] is not None and not loop["in_time"] for loop in loops)
    return [
        str(len(records)),
        str(len(accepted)),
        str(false),
        f"{1.0 - false / len(accepted):.3f}" if accepted else "-",
        str(len(loops)),
        str(len(distances)),
        f"{len(distances) / len(loops):.3f}" if loops else "-",
        f"{np.median(distances):.1f}" if distances else "-",
        f"{np.percentile(distances, 90):.1f}" if distances else "-",
        str(late),
    ]


def _wrong_table(wrong: list[tuple[Record, Record]]) -> str:
    head = ["false closure in", "keyframe event", "found by", "areas", "apart [m]", "error [m]", "error [deg]"]
    head.append("probability")
    return table(
        head,
        [
            [
                record["world"],
                str(closure["event"]),
                closure["way"],
                f"{closure['areas'][0]} and {closure['areas'][1]}",
                f"{closure['apart']:.1f}",
                f"{closure['translation']:.2f}",
                f"{closure['rotation']:.1f}",
                f"{closure['probability']:.4f}",
            ]
            for record, closure in wrong
        ],
    )


def measure_topology(settings: Settings) -> Report:
    """Map the worlds and judge how they end."""
    records = make_records(settings, WORLDS, others=(LONG,))
    report = Report("topology", "Exact topology of nested loops", seeds=chosen_seeds(settings))
    inexact = [record for record in records if find_faults(record)]
    share = len(inexact) / len(records)
    report.requirements.append(Requirement("runs that do not end with the exact topology, share", share, INEXACT))
    rows = [[record["world"], "; ".join(find_faults(record))] for record in inexact]
    summary = f"{len(records) - len(inexact)} of {len(records)} runs end with the exact topology."
    report.body += [summary, *([table(["run", "what is not exact"], rows)] if rows else []), TOPOLOGY_POLICY]
    report.data["faults"] = {record["world"]: find_faults(record) for record in records}
    return report


def find_faults(record: Record) -> list[str]:
    """What is not exact in the topology that a run ended with."""
    accepted = sum(not closure["right"] for closure in record["accepted"])
    pending = sum(not closure["right"] for closure in record["pending"])
    unclosed = sum(loop["closed_at"] is None for loop in loops_to_close([record]))
    counts = {"closures accepted falsely": accepted, "false closures pending": pending, "loops not closed": unclosed}
    return [f"{name}: {count}" for name, count in counts.items() if count]
