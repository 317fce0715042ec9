"""Byte-for-byte comparison of results with the digests in ``benchmark/identity.toml``.

A change of layout, of names or of speed changes no bit of any result. A fixed set of runs has a digest each of its
trajectories, probabilities, graph, closures and map; ``python -m benchmark identity`` compares them with the recorded
ones, and ``--write-expected`` records new ones. Digests hold for one kind of processor and one version of each
library, which are in the file: elsewhere, record those of the older code first.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import multiprocessing
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np

from benchmark.driven_run import DrivenRun
from benchmark.logs import BUNDLED, MeasuredLog, open_logs, reason_missing
from benchmark.report import Report, Requirement, describe_circumstances, table
from benchmark.runs import PARAMETERS, Case, Run
from benchmark.settings import Settings
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.exploration.pilot import PilotProcess
from hmt_slam_ros.logs.records import SIMULATION_PREFIX
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.tasks import Task, TaskResult
from hmt_slam_ros.results.hmt_map import read_run_state
from hmt_slam_ros.saved_map.folder import HMT_MAP
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.scenario import START

EXPECTED = Path(__file__).with_name("identity.toml")

_INSTITUTE = "institute,seed=1,laps=1,people=4,field_of_view=360,beams=720"
_EXPLORATION, _MISSION = 150.0, 120.0  # s, of the simulation


@dataclass(frozen=True)
class ReferenceRun:
    """A run whose results have digests.

    :ivar log: the name of a recorded log, or ``sim:WORLD,...``.
    :ivar changes: parameters that differ from the file, as ``name=value``.
    :ivar duration: seconds of the log that are used, 0 for all.
    :ivar source: name of the run whose map it continues, empty for none.
    """

    log: str
    changes: tuple[str, ...] = ()
    duration: float = 0.0
    source: str = ""


RUNS = {
    "bundled": ReferenceRun(BUNDLED),
    "aces": ReferenceRun("aces"),
    "intel": ReferenceRun("intel"),
    "office": ReferenceRun("sim:office,seed=2"),
    "nested": ReferenceRun("sim:nested,seed=2"),
    "grid": ReferenceRun("sim:grid,seed=2"),
    "ring": ReferenceRun("sim:ring,seed=2"),
    "hall": ReferenceRun("sim:hall,seed=2"),
    "twins": ReferenceRun("sim:twins,seed=2"),
    "busy": ReferenceRun("sim:busy,seed=2"),
    "lines": ReferenceRun("sim:office,laps=1,seed=4", ("local_map.kind=lines",)),
    "kidnapped": ReferenceRun("sim:office,seed=3,carried=0.55,to=0.72,turned=30"),
    "institute": ReferenceRun(f"{SIMULATION_PREFIX}{_INSTITUTE}"),
    "half": ReferenceRun("sim:office,seed=5", duration=100.0),
    "continued": ReferenceRun("sim:office,seed=5", source="half"),
    "relocalized": ReferenceRun("sim:office,seed=5,visit=1", source="half"),
    "localization": ReferenceRun("sim:office,seed=2,visit=1", ("mode=localization",), source="office"),
    "lifelong": ReferenceRun("sim:busy,seed=2,visit=1", ("mode=lifelong",), source="busy"),
}
"""{name of a run: run}; runs whose maps others continue are before these."""

Digests = dict[str, str]
"""{name of a result: its digest}."""


def measure_identity(settings: Settings) -> Report:
    """Run the set, and compare its digests with the recorded ones, or record them."""
    report = Report("identity", "Are results the same, byte for byte?", seeds=(0,))
    found = _run_set(settings, report)
    here = _describe_machine()
    if settings.write_expected:
        write_expected(EXPECTED, found, here)
    expected, recorded = read_expected(EXPECTED)
    if recorded != here:
        report.body.append(f"Recorded on another machine ({recorded}), so digests may differ: this is {here}.")
    report.requirements += differences(found, expected)
    rows = [
        [run, what, own, _compare_digest(own, expected.get(run, {}).get(what))]
        for run, what, own in _list_digests(found)
    ]
    report.body.append(table(["run", "of", "digest", ""], rows))
    report.data["digests"] = found
    return report


def differences(found: Mapping[str, Digests], expected: Mapping[str, Digests]) -> list[Requirement]:
    """Requirements on the number of digests of each run that differ from the recorded ones."""
    return [
        Requirement(f"{run}: digests that differ", sum(expected.get(run, {}).get(what) != own[what] for what in own), 0)
        for run, own in found.items()
    ]


def _compare_digest(own: str, expected: str | None) -> str:
    if expected is None:
        return "not recorded"
    return "the same" if own == expected else f"was {expected}"


def _list_digests(found: Mapping[str, Digests]) -> Iterable[tuple[str, str, str]]:
    return ((run, what, digest) for run, own in found.items() for what, digest in own.items())


def _run_set(settings: Settings, report: Report) -> dict[str, Digests]:
    """{run: digests} of all runs whose logs are there."""
    recorded = {run_of_set.log for run_of_set in RUNS.values() if not run_of_set.log.startswith(SIMULATION_PREFIX)}
    absent = {log: reason for log in recorded if (reason := reason_missing(log))}
    report.body += [f"Skipped {log}: {reason}." for log, reason in absent.items()]
    chosen = {
        name: run_of_set
        for name, run_of_set in RUNS.items()
        if run_of_set.log not in absent and name in (settings.logs or RUNS)
    }
    with open_logs(sorted(recorded - set(absent))) as logs:
        runs = _run_in_order(chosen, {log.name: log for log in logs}, settings)
    found = {name: digests_of(run.folder) for name, run in runs.items()}
    return found | _driven_digests(runs, settings) if "institute" in runs else found


def _run_in_order(
    chosen: Mapping[str, ReferenceRun], logs: Mapping[str, MeasuredLog], settings: Settings
) -> dict[str, Run]:
    """Make the runs, those that others continue before these."""
    done: dict[str, Run] = {}
    for _, group in groupby(chosen.items(), lambda item: bool(item[1].source)):
        group_runs = dict(group)
        cases = [_make_case(run_of_set, logs, done, settings.changes) for run_of_set in group_runs.values()]
        done |= zip(group_runs, settings.runner.runs(cases), strict=True)
    return done


def _make_case(
    run_of_set: ReferenceRun, logs: Mapping[str, MeasuredLog], done: Mapping[str, Run], changes: Sequence[str]
) -> Case:
    log = logs.get(run_of_set.log) or MeasuredLog(run_of_set.log.removeprefix(SIMULATION_PREFIX), Path(run_of_set.log))
    source = done[run_of_set.source].folder if run_of_set.source else None
    return Case(log, 0, "", (*run_of_set.changes, *changes), run_of_set.duration, source=source)


_TOPOLOGY_COLUMNS = 11
"""Columns of pmf.csv about topologies; those after them are about particles."""


def digests_of(folder: Path) -> Digests:
    """The digests of an output folder."""
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    events = [
        row[:_TOPOLOGY_COLUMNS] for row in csv.reader(io.StringIO((folder / "pmf.csv").read_text(encoding="utf-8")))
    ]
    closures = [[*row[:1], *row[3:5], *row[7:10]] for row in events[1:]]
    counts = [report[name] for name in ("keyframes", "areas", "arcs", "loop_closures")]
    return {
        "trajectory": _digest((folder / "trajectory.tum").read_bytes()),
        "online": _digest((folder / "trajectory_online.tum").read_bytes()),
        "probabilities": _digest(repr(events[1:]).encode()),
        "graph": _digest((folder / "graph.g2o").read_bytes()),
        "closures": _digest(repr((closures, counts)).encode()),
        "map": _digest((folder / "map.pgm").read_bytes()),
    }


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def _driven_digests(runs: Mapping[str, Run], settings: Settings) -> dict[str, Digests]:
    """The digests of drives by the explorer, and by the pilot in a saved map."""
    folder = runs["institute"].folder / HMT_MAP
    with ProcessPoolExecutor(settings.runner.jobs, multiprocessing.get_context("spawn")) as pool:
        explorer = pool.submit(_explorer_digests, settings.changes)
        pilot = pool.submit(_pilot_digests, folder, settings.changes)
        return {"explorer": explorer.result(), "pilot": pilot.result()}


def _explorer_digests(changes: Sequence[str]) -> Digests:
    """Digest of the path and the result of an exploration up to a time."""
    configuration = load_configuration(PARAMETERS, list(changes))
    run = DrivenRun(_make_robot(0), configuration, Explorer(configuration))
    outcome = run.run_task(Task("explore"), _EXPLORATION)
    return {"way": _path_digest(run.robot), "outcome": _describe_result(outcome)}


def _pilot_digests(folder: Path, changes: Sequence[str]) -> Digests:
    """Digest of the path and the result of a mission to the last room of a saved map, without an initial pose."""
    configuration = load_configuration(PARAMETERS, list(changes))
    state, _ = read_run_state(folder)
    pilot = PilotProcess(configuration, state.processes["tsbi"].replica)
    run = DrivenRun(_make_robot(1), configuration, pilot, state)
    outcome = run.run_task(Task("go", list(pilot.rooms)[-1]), _MISSION)
    return {"way": _path_digest(run.robot), "outcome": _describe_result(outcome)}


def _describe_result(outcome: TaskResult | None) -> str:
    return "none yet" if outcome is None else f"{outcome.succeeded}: {outcome.reason}"


def _make_robot(visit: int) -> DrivenRobot:
    return DrivenRobot(open_simulated(f"{SIMULATION_PREFIX}{_INSTITUTE},visit={visit}").scenario)


def _path_digest(robot: DrivenRobot) -> str:
    return _digest(robot.true_poses(np.arange(START, robot.stamp, NANOSECONDS // 10)).tobytes())


def _describe_machine() -> str:
    facts = describe_circumstances((0,), 1, ())
    return f"{facts['machine'].split(',')[0]}; {facts['versions']}"


def read_expected(path: Path) -> tuple[dict[str, Digests], str]:
    """{run: digests}, and the machine on which they were recorded.

    :raises HmtSlamError: where there is no such file.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as fault:
        raise HmtSlamError(f"{path} cannot be read: run 'python -m benchmark identity --write-expected'") from fault
    return content["digests"], content["machine"]


def write_expected(path: Path, found: Mapping[str, Digests], machine: str) -> None:
    """Record digests."""
    lines = [
        "# Digests of the set of runs in benchmark/identity.py.",
        "# Written by `python -m benchmark identity --write-expected`; do not edit.",
        f'commit = "{describe_circumstances((0,), 1, ())["commit"]}"',
        f'machine = "{machine}"',
    ]
    for run, own in found.items():
        lines += ["", f'[digests."{run}"]', *(f"{what} = {json.dumps(digest)}" for what, digest in own.items())]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
