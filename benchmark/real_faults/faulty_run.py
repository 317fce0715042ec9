"""Plants a fault into a stretch of a log, and maps or examines it.

``python -m benchmark.real_faults.faulty_run map KIND LOG --out DIR ...`` maps the stretch as ``hmt_slam map`` does, and
compares the map with the truth. KIND is of ``benchmark/real_faults/kinds.py``, or ``none``. The seed of the run is also
that of the fault. DIR gets verdict.json, report.json, trajectory.tum and pmf.csv.

``python -m benchmark.real_faults.faulty_run doctor KIND LOG --out DIR ...`` writes findings.json: what ``hmt_slam
doctor`` says of the stretch.

``python -m benchmark.real_faults.faulty_run bag KIND LOG --out DIR ...`` writes the stretch as a rosbag2.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmark.real_faults.kinds import BY_NAME
from benchmark.real_faults.stream import FaultyStream, ListedLog
from benchmark.real_faults.verdict import StretchTruth, judge, select_relations
from benchmark.report import make_json_safe
from benchmark.runs import PARAMETERS
from benchmark.scoring import FINAL
from hmt_slam_ros.cli.run_commands import run_measured
from hmt_slam_ros.configuration import load_configuration
from hmt_slam_ros.doctor.examination import log_findings
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import (
    StampedPoses,
    read_odometry_poses,
    read_relations,
    read_tum,
    true_relations,
    write_tum,
)
from hmt_slam_ros.logs.writer import write_bag
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.output_folder import build_report, write_probabilities
from hmt_slam_ros.sensors import Scan

NONE = "none"
"""No fault."""

VERDICT, FINDINGS = "verdict.json", "findings.json"


def plant(kind: str, log: ListedLog, seed: int) -> FaultyStream:
    """The records of a log with a fault.

    :param kind: name of a kind, or ``NONE``.
    :param seed: of the fault, which is also another one for a log of another name.
    :raises HmtSlamError: for an unknown kind, or where the stretch has no place for the fault.
    """
    if kind == NONE:
        return FaultyStream(list(log.listed), ())
    if kind not in BY_NAME:
        raise HmtSlamError(f"{kind!r} is no kind of fault: choose one of {', '.join(BY_NAME)}")
    return BY_NAME[kind].plant(log.listed, BY_NAME[kind].random(log.name, seed))


def known_truth(recorded: ListedLog, relations_file: Path | None, reference: Path | None) -> StretchTruth:
    """The truth about a stretch without faults.

    :param relations_file: true relations; None for a log with true poses.
    :param reference: output folder of a run that is right, whose trajectory is compared with closures.
    """
    scans = [record for record in recorded.records() if isinstance(record.measurement, Scan)]
    stamps = np.array([scan.source_stamp for scan in scans], dtype=np.int64)
    odometry = read_odometry_poses(recorded)
    if relations_file is None:
        truth = StampedPoses(stamps, np.array([scan.true_pose for scan in scans]))
        return StretchTruth(true_relations(truth), odometry, dict(zip(stamps.tolist(), truth.poses, strict=True)))
    relations = read_relations(relations_file)
    first, last = stamps.min(), stamps.max()
    ends = np.stack((relations.starts, relations.ends))
    within = select_relations(relations, ((ends >= first) & (ends <= last)).all(axis=0))
    poses = None
    if reference is not None:
        trajectory = read_tum(reference / FINAL)
        poses = dict(zip(trajectory.stamps.tolist(), trajectory.poses, strict=True))
    return StretchTruth(within, odometry, poses)


def map_stretch(options: argparse.Namespace, recorded: ListedLog, faulty: FaultyStream) -> None:
    """Map the stretch, and write the results."""
    configuration = load_configuration(PARAMETERS, options.set, options.seed)
    log = ListedLog(recorded.name, faulty.records)
    final, source_stamps, figures = run_measured(log, configuration)
    recording = final.recording
    trajectory = StampedPoses(source_stamps, recording.trajectory)
    write_tum(options.out / FINAL, trajectory)
    write_probabilities(options.out / "pmf.csv", recording.probabilities)
    _write_json(options.out / "report.json", build_report(recording, configuration, figures))
    verdict = judge(recording, trajectory, faulty.records, known_truth(recorded, options.relations, options.reference))
    places = [place._asdict() for place in faulty.places]
    _write_json(options.out / VERDICT, asdict(verdict) | {"outcome": verdict.outcome, "places": places})


def examine_stretch(options: argparse.Namespace, recorded: ListedLog, faulty: FaultyStream) -> None:
    """Let the doctor examine the stretch, and write its findings."""
    findings = log_findings(ListedLog(recorded.name, faulty.records))
    places = [place._asdict() for place in faulty.places]
    _write_json(options.out / FINDINGS, {"findings": [one._asdict() for one in findings], "places": places})


def write_stretch(options: argparse.Namespace, recorded: ListedLog, faulty: FaultyStream) -> None:
    """Write the stretch as a rosbag2, whose headers have the stamps with the fault."""
    records = [replace(record, source_stamp=record.measurement.stamp) for record in faulty.records]
    write_bag(ListedLog(recorded.name, records), options.out / "bag")


_TASKS: dict[str, Callable[[argparse.Namespace, ListedLog, FaultyStream], None]] = {
    "map": map_stretch,
    "doctor": examine_stretch,
    "bag": write_stretch,
}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(make_json_safe(content), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmark.real_faults.faulty_run")
    parser.add_argument("task", choices=tuple(_TASKS))
    parser.add_argument("kind", choices=(NONE, *BY_NAME))
    parser.add_argument("log", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start", type=float, default=0.0)
    parser.add_argument("--duration", type=float)
    parser.add_argument("--relations", type=Path)
    parser.add_argument("--reference", type=Path)
    parser.add_argument("--set", action="append", default=[])
    return parser


def main(arguments: Sequence[str]) -> int:
    """Run; return the exit status."""
    options = _make_parser().parse_args(arguments)
    try:
        log = open_log(options.log, start=options.start, duration=options.duration)
        recorded = ListedLog(log.name, list(log.records()))
        options.out.mkdir(parents=True, exist_ok=True)
        _TASKS[options.task](options, recorded, plant(options.kind, recorded, options.seed))
    except HmtSlamError as fault:
        print(f"faulty_run: {fault}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
