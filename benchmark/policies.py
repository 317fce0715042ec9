"""Policies of area abstraction compared: doors found, closures, errors and areas."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from benchmark.logs import LOGS, WITH_RELATIONS, MeasuredLog, open_logs
from benchmark.loops import loops_to_close, missed_share
from benchmark.report import Columns, Report, Requirement, format_share, mean, table, table_of
from benchmark.runs import Case, Run
from benchmark.scoring import POLICY as RELATIONS
from benchmark.scoring import SeedMeans, over_seeds, score
from benchmark.settings import Settings, chosen_seeds
from benchmark.simulated.records import Record, Records
from benchmark.simulated.worlds import INSTITUTE, World
from hmt_slam_ros.errors import HmtSlamError

SEEDS = 4
"""Worlds of every family."""

FAMILIES = ("office", "busy", INSTITUTE, "hall")

POLICIES = ("ncut", "both")

NEAR, PORTAL = 1.0, 0.5
"""Largest distance of a change of areas from a true opening, and of a portal, m."""

_LOG_SEEDS = 2

# Bounds for policies with openings: share of doors found, of true portals, of missed loops; errors relative to ncut.
_DOORS, _TRUE, _MISSED, _WORSE = 0.9, 0.9, 0.05, 1.1

POLICY = (
    "Doors are the open doors on the path, crossings the intersections of hallways; each counts once, and is found if "
    f"the path changes areas within {NEAR:g} m of the door, or of the crossing's border. Corners of hallways and halls "
    "have openings, too, which are no doors. So a portal is true if there is any gap between walls within "
    f"{PORTAL:g} m, to which its error is measured. The error of the pose is RTL's in the map, mean over drive and "
    "runs. Closures and loops are defined as in `loops`. " + RELATIONS
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
    """Requirements on a policy.

    :param records: of this policy and of ncut.
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
    """The share of the distances of a kind up to a limit, m; NaN if there are none."""
    return mean(_distances(records, kind) <= within)


def _distances(records: Sequence[Record], kind: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Distances of a kind, m; inf where a record has None, for nothing in reach."""
    return np.array(
        [math.inf if distance is None else distance for record in records for distance in record["doors"][kind]]
    )


def _count_false(records: Sequence[Record]) -> int:
    return sum(not closure["right"] for record in records for closure in record["accepted"])


def _mean_pose_error(records: Sequence[Record]) -> float:
    """Mean error of the pose in the map, m."""
    return float(np.mean([pose["map"]["translation"] for record in records for pose in record["poses"]]))


def _table(records: Mapping[str, Sequence[Record]], families: Sequence[str]) -> str:
    rows = [
        (family, policy, [record for record in records[policy] if record["family"] == family])
        for family in families
        for policy in records
    ]
    columns: Columns[tuple[str, str, list[Record]]] = [
        ("world", lambda row: row[0]),
        ("policy", lambda row: row[1]),
        ("runs", lambda row: str(len(row[2]))),
        ("areas", lambda row: f"{mean([record['doors']['areas'] for record in row[2]]):.1f}"),
        ("changes of areas", lambda row: str(_distances(row[2], "changes").size)),
        ("at a door or crossing", lambda row: format_share(_distances(row[2], "changes") <= NEAR)),
        ("doors", lambda row: str(_distances(row[2], "doors").size)),
        ("found", lambda row: format_share(_distances(row[2], "doors") <= NEAR)),
        ("crossings", lambda row: str(_distances(row[2], "crossings").size)),
        ("found", lambda row: format_share(_distances(row[2], "crossings") <= NEAR)),
        ("portals", lambda row: str(_distances(row[2], "portals").size)),
        ("true", lambda row: format_share(_distances(row[2], "portals") <= PORTAL)),
        ("doors with one", lambda row: format_share(_distances(row[2], "doors_portals") <= PORTAL)),
        ("portals' error [m]", lambda row: _format_portal_error(row[2])),
        ("error of the pose [m]", lambda row: f"{_mean_pose_error(row[2]):.3f}"),
        ("closures", lambda row: str(sum(len(record["accepted"]) for record in row[2]))),
        ("false", lambda row: str(_count_false(row[2]))),
        ("loops", lambda row: str(len(loops_to_close(row[2])))),
        ("in time", lambda row: str(sum(loop["in_time"] for loop in loops_to_close(row[2])))),
    ]
    return table_of(columns, rows)


def _format_portal_error(records: Sequence[Record]) -> str:
    """The mean distance of true portals from their gaps, m; "-" if there are none."""
    portals = _distances(records, "portals")
    true = portals[portals <= PORTAL]
    return f"{true.mean():.2f}" if true.size else "-"


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
