"""Corridors that look alike: does the long world of nested loops end with the exact topology?"""

from __future__ import annotations

from benchmark.loops import closable
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings, chosen_seeds, records_of
from benchmark.simulated.records import Record
from benchmark.simulated.worlds import LONG

WORLDS = ("nested",)

INEXACT = 0.05
"""Largest share of runs that end otherwise."""

POLICY = (
    "A run ends with the exact topology where no closure in its most probable map is false, none was accepted falsely "
    "on the way, and every loop that can be closed is closed at the end, as defined for the closures above."
)


def measure_topology(settings: Settings) -> Report:
    """Map the worlds and judge how they end."""
    records = records_of(settings, WORLDS, others=(LONG,))
    report = Report("topology", "Exact topology of nested loops", seeds=chosen_seeds(settings))
    inexact = [record for record in records if faults(record)]
    share = len(inexact) / len(records)
    report.requirements.append(Requirement("runs that do not end with the exact topology, share", share, INEXACT))
    rows = [[record["world"], "; ".join(faults(record))] for record in inexact]
    counted = f"{len(records) - len(inexact)} of {len(records)} runs end with the exact topology."
    report.body += [counted, *([table(["run", "what is not exact"], rows)] if rows else []), POLICY]
    report.data["faults"] = {record["world"]: faults(record) for record in records}
    return report


def faults(record: Record) -> list[str]:
    """What is not exact in the topology that a run ended with."""
    accepted = sum(not closure["right"] for closure in record["accepted"])
    pending = sum(not closure["right"] for closure in record["pending"])
    unclosed = sum(loop["closed_at"] is None for loop in closable([record]))
    told = {"closures accepted falsely": accepted, "false closures pending": pending, "loops not closed": unclosed}
    return [f"{name}: {count}" for name, count in told.items() if count]
