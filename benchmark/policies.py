"""Policies of area abstraction compared: doors found, closures, errors and areas."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from benchmark.logs import LOGS, WITH_RELATIONS, MeasuredLog, open_logs
from benchmark.loops import loops_to_close, missed_share
from benchmark.report import Report, Requirement, table
from benchmark.runs import Case, Run
from benchmark.scoring import POLICY as RELATIONS
from benchmark.scoring import SeedMeans, over_seeds, score
from benchmark.settings import Settings, chosen_seeds
from benchmark.simulated.records import Record, Records
from benchmark.simulated.worlds import INSTITUTE, World
from hmt_slam_ros.errors import HmtSlamError

SEEDS = 4
"""Worlds of every family, and runs of every log where two are as many as are asked for."""

FAMILIES = ("office", "busy", INSTITUTE, "hall")

POLICIES = ("ncut", "both")

NEAR, PORTAL = 1.0, 0.5
"""How far from a true opening an area may end there, and a portal be there, m."""

_LOG_SEEDS = 2

# What is asked of the policies that ask for openings: doors found, portals true, and errors relative to ncut.
_DOORS, _TRUE, _MISSED, _WORSE = 0.9, 0.9, 0.05, 1.1

POLICY = (
    "Doors are the open doors that the path passes, crossings the places where hallways cross; both are counted once, "
    f"and are found where the path changes areas within {NEAR:g} m of the door, or of the crossing's border. Corners "
    "of hallways and halls have openings, too, which are no doors: so a portal is true where there is any gap between "
    f"walls within {PORTAL:g} m, as those that landmarks have to show. Their error is from there. The pose's error is "
    "that of RTL in the map, mean over the drive and the runs. Closures and loops as of `loops`. " + RELATIONS
)


def measure_policies(settings: Settings) -> Report:
    """Map simulated worlds and recorded logs by every policy."""
    names = settings.logs_or((*FAMILIES, *WITH_RELATIONS))
    for name in names:
        if name not in (*FAMILIES, *LOGS):
            raise HmtSlamError(f"there is no world or log {name!r}: choose from {', '.join((*FAMILIES, *LOGS))}")
    seeds = chosen_seeds(settings, SEEDS)
    report = Report("policies", "Where areas end: at cuts, at doors, or both", seeds=seeds)
    families = [name for name in FAMILIES if name in names]
    if families:
        records = {policy: _make_records(settings, policy, families, seeds) for policy in POLICIES}
        report.requirements += [r for policy in POLICIES[1:] for r in requirements(policy, records)]
        report.body.append(_table(records, families))
        report.data["doors"] = {
            policy: {record["world"]: record["doors"] for record in own} for policy, own in records.items()
        }
    with open_logs([name for name in names if name in LOGS]) as logs:
        _score(report, settings, logs)
    report.body.append(POLICY)
    return report


def _changes(settings: Settings, policy: str) -> tuple[str, ...]:
    return (*settings.changes, f"aam.area_policy={policy}")


def _make_records(settings: Settings, policy: str, families: Sequence[str], seeds: Sequence[int]) -> list[Record]:
    records = Records(settings.records.folder / policy, settings.records.jobs)
    return records.make([World(family, seed) for family in families for seed in seeds], _changes(settings, policy))


def requirements(policy: str, records: Mapping[str, Sequence[Record]]) -> list[Requirement]:
    """What is asked of a policy.

    :param records: of this one and of ncut.
    """
    own = records[policy]
    return [
        Requirement(f"{policy}: doors at which areas end", share_within(own, "doors", NEAR), 1.0, least=_DOORS),
        Requirement(f"{policy}: portals that are true", share_within(own, "portals", PORTAL), 1.0, least=_TRUE),
        Requirement(f"{policy}: closures accepted falsely", _count_false(own), 0),
        Requirement(f"{policy}: loops that could be closed and were not, share", missed_share(list(own)), _MISSED),
        Requirement(
            f"{policy}: error of the pose / that by ncut",
            _mean_pose_error(own) / _mean_pose_error(records["ncut"]),
            _WORSE,
        ),
    ]


def share_within(records: Sequence[Record], kind: str, within: float) -> float:
    """Of all distances of a kind those that are within some, m; NaN where there are none."""
    apart = _distances(records, kind)
    return float(np.mean(apart <= within)) if apart.size else math.nan


def _distances(records: Sequence[Record], kind: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Distances, m; a record holds None where there is nothing."""
    return np.array(
        [math.inf if distance is None else distance for record in records for distance in record["doors"][kind]]
    )


def _count_false(records: Sequence[Record]) -> int:
    return sum(not closure["right"] for record in records for closure in record["accepted"])


def _mean_pose_error(records: Sequence[Record]) -> float:
    """Mean error of the pose in the map, m."""
    return float(np.mean([pose["map"]["translation"] for record in records for pose in record["poses"]]))


def _table(records: Mapping[str, Sequence[Record]], families: Sequence[str]) -> str:
    head = ["world", "policy", "runs", "areas", "changes of areas", "at a door or crossing", "doors", "found"]
    head += ["crossings", "found", "portals", "true", "doors with one", "portals' error [m]", "error of the pose [m]"]
    head += ["closures", "false", "loops", "in time"]
    rows = [
        [family, policy, *_record_cells([record for record in records[policy] if record["family"] == family])]
        for family in families
        for policy in records
    ]
    return table(head, rows)


def _record_cells(records: Sequence[Record]) -> list[str]:
    portals, loops = _distances(records, "portals"), loops_to_close(list(records))
    right = portals[portals <= PORTAL]
    return [
        str(len(records)),
        f"{np.mean([record['doors']['areas'] for record in records]):.1f}",
        *_count_cells(records, "changes", NEAR),
        *_count_cells(records, "doors", NEAR),
        *_count_cells(records, "crossings", NEAR),
        *_count_cells(records, "portals", PORTAL),
        _count_cells(records, "doors_portals", PORTAL)[1],
        f"{right.mean():.2f}" if right.size else "-",
        f"{_mean_pose_error(records):.3f}",
        str(sum(len(record["accepted"]) for record in records)),
        str(_count_false(records)),
        str(len(loops)),
        str(sum(loop["in_time"] for loop in loops)),
    ]


def _count_cells(records: Sequence[Record], kind: str, within: float) -> list[str]:
    """How many there are, and which share of them is within a distance."""
    count = _distances(records, kind).size
    return [str(count), f"{100.0 * share_within(records, kind, within):.0f} %" if count else "-"]


def _score(report: Report, settings: Settings, logs: Sequence[MeasuredLog]) -> None:
    """Errors at true relations of recorded logs."""
    if not logs:
        return
    seeds = settings.seeds_or(_LOG_SEEDS)
    cases = {
        (log, policy): [Case(log, seed, changes=_changes(settings, policy)) for seed in seeds]
        for log in logs
        for policy in POLICIES
    }
    runs = {key: settings.runner.runs(own) for key, own in cases.items()}
    means = {key: over_seeds([score(run.folder, key[0]) for run in own]) for key, own in runs.items()}
    for log in logs:
        for policy in POLICIES[1:]:
            ratio = means[log, policy].translation / means[log, "ncut"].translation
            report.requirements.append(Requirement(f"{log.name}, {policy}: translation / that by ncut", ratio, _WORSE))
    head = ["log", "policy", "runs", "areas", "loop closures", "translation [m]", "over 60 s [m]", "rotation [deg]"]
    rows = [[log.name, policy, *_log_cells(runs[log, policy], mean)] for (log, policy), mean in means.items()]
    report.body.append(table(head, rows))


def _log_cells(runs: Sequence[Run], mean: SeedMeans) -> list[str]:
    return [
        str(len(runs)),
        f"{np.mean([run.report['areas'] for run in runs]):.1f}",
        f"{np.mean([run.report['loop_closures'] for run in runs]):.1f}",
        f"{mean.translation:.4f}",
        f"{mean.long:.4f}",
        f"{mean.rotation:.3f}",
    ]
