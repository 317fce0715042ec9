"""The command line of the measurements: ``python -m benchmark KIND [KIND ...]``, with ``all`` for those on real logs
and ``validation`` for those on simulated worlds.

Exit status: 0 where all requirements are met, 1 where one is not, 2 where the measurement failed.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path

from benchmark.logs import LOGS, ROOT
from benchmark.report import (
    ACCURACY,
    VALIDATION,
    Report,
    copy_illustrations,
    describe_circumstances,
    summarize_circumstances,
    write_between_marks,
)
from benchmark.runs import Runner
from benchmark.settings import Settings
from benchmark.simulated.records import Records
from benchmark.simulated.worlds import CAMPUS, FAMILIES, INSTITUTE, LONG
from hmt_slam_ros.cli.arguments import OneSentenceParser
from hmt_slam_ros.errors import HmtSlamError

UNMET, FAULT = 1, 2
_LEAST_MINUTES = 12.0

MEASUREMENTS = {
    "accuracy": "trajectory errors at true relations; torn walls where there is no truth",
    "odometry": "the same with degraded odometry",
    "robustness": "topology under faults of real sensors, in stretches of logs",
    "sessions": "accuracy of a log mapped in two sessions instead of one",
    "speed": "CPU time, memory, cost of a scan, start of the nodes",
    "live": "latency of the nodes' poses, with a fast laser and in replays at ten times real time",
    "timeline": "which process computes when, around a loop closure",
    "calibration": "calibration of the probabilities of topological paths",
    "loops": "precision and recall of loop closures",
    "topology": "exactness of the final topology in the world of nested loops",
    "consistency": "NEES of arcs, of areas' poses and of RTL's pose",
    "institute": "missions and global localization over places in an institute",
    "threeloops": "loop closures that only the belief over places proposes",
    "explore": "exploration of an institute, and missions to its rooms",
    "pilot": "tasks of the pilot through nodes in an explored institute",
    "policies": "areas that end at doors, and portals against true doors",
    "ambiguity": "hypotheses in identical places until the evidence separates them",
    "table": "time and memory against a global metric RBPF at equal accuracy (Table II)",
    "oracle": "TSBI's PMF against an exact enumeration of all topologies",
    "weighing": "hypotheses weighed by the filter's evidence, Eq. (14), instead of contradictions",
    "modes": "the distribution of the pose over a doorway, scan by scan",
    "awakening": "global localization in a saved map",
    "kidnapping": "recovery of a robot that is kidnapped while it drives",
    "recorded": "closures, starts and displacements on recorded logs, right or wrong",
    "disambiguation": "path until a robot is sure of its place, driving to where a look decides, or on",
    "marks": "error, closures and the path until the first one with marks that have names, some of them wrong",
    "relocalization": "global localization in a saved map with marks that have names, some of them wrong",
    "merge": "maps of halves of a drive that are made apart and joined",
    "team": "robots that map at once from unknown starts: joins, right or wrong, and the path until then",
    "team_exploration": "exploration of an institute by two robots, and by one",
    "team_scale": "cost of the process team in maps of up to 1,000 areas",
    "team_link": "robots on hosts of their own, whose link loses, repeats and reorders frames, and breaks",
    "laps": "memory, cost and errors over repeated laps on known ground",
    "changes": "maps of changing worlds in mode lifelong, among people",
    "scale": "time and memory in maps of up to 100,000 areas",
    "page": "share of a core that the live page takes with a map of 200 areas",
    "kernels": "CPU time and memory allocations of the inner loops",
    "soak": "memory of nodes that run for an hour, and what they leave behind",
    "structure": "how large the package is, and how many files one scan, one keyframe and one closure pass",
    "mutants": "small faults of the numerical core that the unit tests notice",
    "fuzz": "mutated and hostile logs, results, settings and maps against every command that reads them",
    "faults": "a fault at every call that writes a map, a bag, a journal or results",
    "identity": "byte-for-byte identity of results with those on record",
    "short": "accuracy against benchmark/expected.toml, for CI",
}
_MODULES = {
    "consistency": "calibration",
    "topology": "loops",
    "merge": "merging",
    "team": "teams",
    "sessions": "accuracy",
    "fuzz": "fuzz.measurement",
    "mutants": "mutants.measurement",
    "faults": "write_faults.measurement",
}
_GROUPS = {
    "all": ("accuracy", "odometry", "robustness", "sessions", "speed", "live"),
    "validation": (
        "calibration",
        "loops",
        "topology",
        "consistency",
        "institute",
        "threeloops",
        "explore",
        "pilot",
        "policies",
        "ambiguity",
        "table",
        "oracle",
        "awakening",
        "kidnapping",
        "recorded",
        "laps",
        "changes",
        "scale",
    ),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and write the reports; return the exit status."""
    options = _make_parser().parse_args(arguments)
    try:
        reports = _measure(options)
    except HmtSlamError as fault:
        print(f"benchmark: {fault}", file=sys.stderr)
        return FAULT
    return 0 if all(report.is_met for report in reports) else UNMET


def _measure(options: argparse.Namespace) -> list[Report]:
    if options.write_docs and (options.set or options.logs or options.training):
        raise HmtSlamError("--write-docs is for the whole measurement: leave --set and --logs away, and --training")
    out = _create_report_folder(options)
    runner = Runner(out / "runs", options.jobs)
    changes, first = tuple(options.set), options.first_seed
    seeds = tuple(range(first, first + options.seeds))
    records = Records(options.runs or out / "runs", options.jobs)
    settings = Settings(
        options.logs,
        seeds,
        changes,
        out,
        options.write_expected,
        runner,
        records,
        options.training,
        options.minutes,
        options.first_seed,
    )
    reports = []
    for kind in _list_kinds(options):
        module = import_module(f"benchmark.{_MODULES.get(kind, kind)}")
        report: Report = getattr(module, f"measure_{kind}")(settings)
        facts = describe_circumstances(report.seeds, options.jobs, options.set)
        report.write(out, facts)
        if options.write_docs:
            document = VALIDATION if kind in _GROUPS["validation"] else ACCURACY
            write_between_marks(
                document, kind, f"{summarize_circumstances(facts)}\n\n{report.text}{copy_illustrations(report, out)}"
            )
        print(f"\n# {report.title}\n\n{report.text}\n\n{out / f'{kind}.md'}", flush=True)
        reports.append(report)
    return reports


def _list_kinds(options: argparse.Namespace) -> tuple[str, ...]:
    kinds = [kind for name in options.measurements for kind in _GROUPS.get(name, (name,))]
    return tuple(dict.fromkeys(kinds))


def _create_report_folder(options: argparse.Namespace) -> Path:
    """The empty folder of the report, which is created."""
    chosen: Path | None = options.out
    if chosen is None:
        name = f"{datetime.now(UTC).date()}-{'-'.join(options.measurements)}"
        names = [name, *(f"{name}-{k}" for k in range(2, 1000))]
        chosen = next(folder for folder in (ROOT / "benchmark" / "reports" / n for n in names) if not folder.exists())
    if chosen.exists() and (not chosen.is_dir() or any(chosen.iterdir())):
        raise HmtSlamError(f"{chosen} is there already: choose another --out or remove it")
    chosen.mkdir(parents=True, exist_ok=True)
    return chosen


def _make_parser() -> argparse.ArgumentParser:
    parser = OneSentenceParser(
        prog="python -m benchmark",
        description="Measurements of hmt_slam_ros on recorded and simulated logs.",
        epilog=_describe_kinds(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("measurements", nargs="+", choices=(*MEASUREMENTS, *_GROUPS), metavar="KIND", help="see below")
    names = ", ".join((*LOGS, *FAMILIES, INSTITUTE, LONG, CAMPUS))
    parser.add_argument("--logs", type=_parse_names, default=(), metavar="A,B", help=f"of {names}")
    parser.add_argument(
        "--seeds", type=_parse_count, default=0, metavar="N", help="seeds 0 to N-1; simulated: from 1000"
    )
    parser.add_argument("--first-seed", type=_parse_seed, default=0, metavar="K", help="seeds K to K+N-1")
    parser.add_argument("--jobs", type=_parse_count, default=2, metavar="N", help="runs at the same time; 1 for speed")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder of the report")
    parser.add_argument("--runs", type=Path, metavar="DIR", help="keeps simulated runs and starts, for later calls")
    parser.add_argument(
        "--minutes", type=_parse_minutes, default=60.0, metavar="M", help="of soak and fuzz --logs guided"
    )
    parser.add_argument("--training", action="store_true", help="simulated worlds of seeds 0 to N-1")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="set one parameter")
    parser.add_argument("--write-expected", action="store_true", help="record the figures of short or identity")
    parser.add_argument("--write-docs", action="store_true", help="put the tables into docs/")
    return parser


def _describe_kinds() -> str:
    """The kinds of measurements and their groups, one on each line."""
    kinds = [f"  {name:<14} {text}" for name, text in MEASUREMENTS.items()]
    groups = [f"  {name:<14} {', '.join(kinds)}" for name, kinds in _GROUPS.items()]
    return "\n".join(["kinds:", *kinds, "", "groups of kinds:", *groups])


def _parse_names(text: str) -> tuple[str, ...]:
    return tuple(text.split(","))


def _parse_minutes(text: str) -> float:
    minutes = float(text)
    if not minutes >= _LEAST_MINUTES:
        raise argparse.ArgumentTypeError(
            f"{text} minutes are too few for two hours of the log: give {_LEAST_MINUTES:g} or more"
        )
    return minutes


def _parse_seed(text: str) -> int:
    seed = int(text)
    if seed < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative: seeds begin at 0")
    return seed


def _parse_count(text: str) -> int:
    count = int(text)
    if count < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return count


if __name__ == "__main__":
    sys.exit(main())
