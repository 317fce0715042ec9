"""report.json and the tables beside it: what a run came to and what it cost."""

from __future__ import annotations

import csv
import json
import platform
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros import __version__
from hmt_slam_ros.configuration import Configuration, as_nested
from hmt_slam_ros.results.record import TopologyProbability
from hmt_slam_ros.results.recorder import Recording
from hmt_slam_ros.sensors import Scan

# Columns of pmf.csv that are not called as the fields.
_PROBABILITY_COLUMNS = {"path_length": "travelled"}


def code_bytes() -> dict[str, int]:
    """Resident memory of this OS process, bytes, that is mapped from ``libraries``, and what compiled ``kernels`` take.

    :returns: nothing where the system does not tell.
    """
    try:
        lines = Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines()
    except OSError:
        return {}
    parts = {"libraries": 0, "kernels": 0}
    part = None
    for line in lines:
        words = line.split()
        if not words[0].endswith(":"):
            # begin-end permissions offset device inode path
            executable, file = "x" in words[1], words[4] != "0"
            part = "libraries" if file else "kernels" if executable and len(words) == 5 else None
        elif words[0] == "Rss:" and part is not None:
            parts[part] += 1024 * int(words[1])
    return parts


def scan_bytes(scans: Iterable[Scan]) -> int:
    """What scans take, with the points that were worked out of them, bytes."""
    return sum(value.nbytes for scan in scans for value in vars(scan).values() if isinstance(value, np.ndarray))


_LIBRARIES = ("numpy", "scipy", "networkx", "numba", "rosbags", "matplotlib")


@dataclass(frozen=True, eq=False)
class RunMetrics:
    """What a run cost, as whoever ran it measured.

    :ivar log: name of the log.
    :ivar runtime: "lock-step" or "nodes".
    :ivar seconds_per_scan: {process: shape (n,) seconds of computing for each scan}.
    :ivar peak_rss: {OS process: largest resident memory, bytes}.
    :ivar wall_seconds: from the first record to the last answer.
    :ivar cpu_seconds: of all OS processes together.
    :ivar refinement_seconds: CPU time of the final refinement.
    :ivar memory: {part of the program: bytes}, where that is known.
    """

    log: str
    runtime: str
    seconds_per_scan: Mapping[str, NDArray[np.float64]]
    peak_rss: Mapping[str, int]
    wall_seconds: float
    cpu_seconds: float
    refinement_seconds: float
    memory: Mapping[str, int] = field(default_factory=dict)


def build_report(recording: Recording, configuration: Configuration, figures: RunMetrics) -> dict[str, Any]:
    """The content of report.json."""
    totals, replica, hybrid_map = recording.totals, recording.replica, recording.hybrid_map
    arcs = [arc for _, _, arc in hybrid_map.all_arcs()]
    return {
        "log": figures.log,
        "runtime": figures.runtime,
        "scans": {"in": totals.received, "processed": totals.processed, "dropped": totals.dropped},
        "travelled_m": recording.probabilities[-1].path_length,
        "keyframe_events": recording.probabilities[-1].keyframe + 1,
        "keyframes": sum(len(hybrid_map.keyframes(area)) for area in hybrid_map.area_ids()),
        "areas": len(hybrid_map.area_ids()),
        "arcs": len(arcs),
        "loop_closures": sum(arc.closure for arc in arcs),
        "hypotheses": {
            "alive": len(replica.maps),
            "most_probable": replica.best_hypothesis,
            "probability": replica.probabilities[replica.best_hypothesis],
        },
        "notices": [{"process": notice.process, "text": notice.text} for notice in recording.notices],
        "processes": {name: _cost_summary(seconds) for name, seconds in figures.seconds_per_scan.items()},
        "peak_rss_bytes": dict(figures.peak_rss),
        "memory_bytes": dict(figures.memory) | {"keyframe_scans": scan_bytes(replica.scans.values())},
        "wall_s": figures.wall_seconds,
        "cpu_s": figures.cpu_seconds,
        "refinement_s": figures.refinement_seconds,
        "seed": configuration.seed,
        "configuration": as_nested(configuration),
        "versions": _versions(),
    }


def write_report(path: Path, content: Mapping[str, Any]) -> None:
    """report.json."""
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def _cost_summary(seconds: NDArray[np.float64]) -> dict[str, float]:
    milliseconds = 1e3 * seconds if seconds.size else np.zeros(1)
    return {
        "total_s": float(seconds.sum()),
        "mean_ms_per_scan": float(milliseconds.mean()),
        "p95_ms_per_scan": float(np.percentile(milliseconds, 95)),
        "max_ms_per_scan": float(milliseconds.max()),
    }


def _versions() -> dict[str, str]:
    return {"hmt_slam_ros": __version__, "python": platform.python_version()} | {
        name: _installed_version(name) for name in _LIBRARIES
    }


def _installed_version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "unknown"


def write_cost(path: Path, seconds_per_scan: Mapping[str, NDArray[np.float64]]) -> None:
    """cost.csv: milliseconds of every process for every scan."""
    rows = np.round(1e3 * np.column_stack(list(seconds_per_scan.values())), 4).tolist() if seconds_per_scan else []
    _write_table(path, [f"{name}_ms" for name in seconds_per_scan], rows)


def write_probabilities(path: Path, probabilities: list[TopologyProbability]) -> None:
    """pmf.csv: Eq. (14), one line for every live topology at every keyframe event."""
    names = [entry.name for entry in fields(TopologyProbability)]
    header = [_PROBABILITY_COLUMNS.get(name, name) for name in names]
    _write_table(path, header, [[_csv_value(getattr(row, name)) for name in names] for row in probabilities])


def _csv_value(value: float) -> float:
    return int(value) if isinstance(value, bool) else value


def _write_table(path: Path, names: list[str], rows: list[list[float]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(rows)


def read_table(path: Path) -> dict[str, NDArray[np.float64]]:
    """The columns of a table written here, by name; each has shape (lines,)."""
    with path.open(encoding="utf-8", newline="") as file:
        names = next(csv.reader(file))
        rows = [[float(text) for text in line] for line in csv.reader(file)]
    columns = np.array(rows, dtype=np.float64).reshape(len(rows), len(names))
    return {name: columns[:, k] for k, name in enumerate(names)}
