"""The output folder of a run, written complete or not at all: trajectories, map, report and tables."""

from __future__ import annotations

import csv
import json
import platform
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros import __version__
from hmt_slam_ros.configuration import Configuration, as_nested
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import StampedPoses, write_tum
from hmt_slam_ros.grids.occupancy_map import occupancy_image, write_map
from hmt_slam_ros.own_files import ScratchFolder, is_remains_of, replace_folder
from hmt_slam_ros.results.export import LANDMARKS, PLACES, TOPOLOGY
from hmt_slam_ros.results.final_map import FinalMap
from hmt_slam_ros.results.hmt_map import MapWriter
from hmt_slam_ros.results.record import TopologyProbability
from hmt_slam_ros.results.recorder import Recording, keyframe_poses
from hmt_slam_ros.saved_map.folder import FORMAT, HMT_MAP, MANIFEST, foreign_entry
from hmt_slam_ros.sensors import Scan

TRAJECTORY = "trajectory.tum"
"""File of the pose of every scan."""

EARLIER_LOGS = "earlier"
"""Folder of the trajectories of earlier logs: 1.tum, 2.tum and so on."""

STAGES = "stages"
"""Folder of the trajectories before each step of the final refinement."""

MERGE_REPORT, TEAM_PICTURE = "merge.json", "team.png"
"""File that says how a map was made of several."""

OUTPUT_FILES = frozenset(
    {
        TRAJECTORY,
        "trajectory_online.tum",
        "map.pgm",
        "map.yaml",
        "map.png",
        "graph.g2o",
        TOPOLOGY,
        LANDMARKS,
        PLACES,
        "report.json",
        MERGE_REPORT,
        TEAM_PICTURE,
        "pmf.csv",
        "pmf.png",
        "cost.csv",
        "cost.png",
    }
)
"""All files of output folders; beside them are :data:`STAGES`, :data:`EARLIER_LOGS` and the map."""

_ROBOT = re.compile(r"robot_\d{1,3}")
"""Names of the output folders of robots in that of their team: those of :func:`robot_folder`."""

_STAGE_FILES = frozenset({"filter.tum", "arcs.tum", "keyframes.tum"})
"""All files in :data:`STAGES`."""

_LIBRARIES = ("numpy", "scipy", "networkx", "numba", "rosbags", "matplotlib")
"""Libraries whose versions the report has."""

_PROBABILITY_COLUMNS = {"path_length": "travelled"}
"""Columns of pmf.csv with another name than the field."""


@dataclass(frozen=True, eq=False)
class RunMetrics:
    """The measured cost of a run.

    :ivar log: name of the log.
    :ivar runtime: "lock-step" or "nodes".
    :ivar seconds_per_scan: {process: shape (n,), computing time for each scan, s}.
    :ivar peak_rss: {OS process: largest resident memory, bytes}.
    :ivar pss: {OS process: proportional set size at the end, bytes}: memory that n processes share counts 1/n in each.
    :ivar wall_seconds: time from the first record to the last answer, s.
    :ivar cpu_seconds: CPU time of all OS processes together, s.
    :ivar refinement_seconds: CPU time of the final refinement, s.
    :ivar memory: {part of the program: bytes}, where it is known.
    :ivar speculation: how often metric SLAM worked ahead, {name: value}; empty where it did not.
    """

    log: str
    runtime: str
    seconds_per_scan: Mapping[str, NDArray[np.float64]]
    peak_rss: Mapping[str, int]
    pss: Mapping[str, int]
    wall_seconds: float
    cpu_seconds: float
    refinement_seconds: float
    memory: Mapping[str, int] = field(default_factory=dict)
    speculation: Mapping[str, Any] = field(default_factory=dict)


@contextmanager
def atomic_output(directory: Path) -> Iterator[Path]:
    """A context with a folder that becomes ``directory`` at the end, and is deleted on an exception.

    :raises HmtSlamError: where ``directory`` is anything but an old output folder, or cannot be written.
    """
    target = directory.absolute()
    check_replaceable(target)
    existing = next(parent for parent in target.parents if parent.exists())
    try:
        scratch = ScratchFolder(target, existing)
    except OSError as fault:
        raise HmtSlamError(f"{existing} cannot be written to ({fault.strerror}): choose another --out") from fault
    try:
        folder = scratch.path / "new"
        folder.mkdir()
        yield folder
        check_replaceable(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        replace_folder(folder, target)
    except OSError as fault:
        raise HmtSlamError(f"{directory} cannot be written ({fault.strerror}): choose another --out") from fault
    finally:
        scratch.remove()


def robot_folder(number: int) -> str:
    """Name of the output folder of a robot in that of its team.

    :param number: from 1 on.
    """
    return f"robot_{number}"


def robot_folders(directory: Path) -> list[str]:
    """Names of the output folders of robots in that of their team, none where it is no such folder."""
    return sorted(each.name for each in directory.glob("robot_*")) if directory.is_dir() else []


def check_replaceable(directory: Path) -> None:
    """Check that writing to a path loses no data.

    :raises HmtSlamError: unless there is nothing, an empty folder or an old output folder.
    """
    if directory.is_symlink() or (directory.exists() and not directory.is_dir()):
        raise HmtSlamError(f"{directory} is not a folder: choose another --out")
    blocking = next((parent for parent in directory.parents if parent.exists() and not parent.is_dir()), None)
    if blocking is not None:
        raise HmtSlamError(f"{directory} cannot be made since {blocking} is not a folder: choose another --out")
    foreign = _foreign_entry(directory) if directory.exists() else None
    if foreign is not None:
        found = foreign.relative_to(directory)
        raise HmtSlamError(f"{directory} is not an output folder, it holds {found}: choose another --out or empty it")


def _foreign_entry(directory: Path) -> Path | None:
    """The first entry of a folder, at any depth, that no run wrote; None where there is none."""
    entries = sorted(directory.iterdir())
    if entries and not (directory / HMT_MAP / MANIFEST).is_file():
        return next((entry for entry in entries if entry.name not in OUTPUT_FILES), entries[0])
    return next((foreign for entry in entries if (foreign := _foreign_part(entry)) is not None), None)


def _foreign_part(entry: Path) -> Path | None:
    """An entry of an output folder, or one below it, that no run wrote; None where there is none."""
    if entry.is_symlink():
        return entry
    if entry.is_file():
        own = entry.name in OUTPUT_FILES or is_remains_of(entry, OUTPUT_FILES)
        return None if own else entry
    if entry.name == HMT_MAP:
        return foreign_entry(entry, FORMAT)
    if entry.is_dir() and _ROBOT.fullmatch(entry.name):
        return _foreign_entry(entry)
    if not entry.is_dir() or entry.name not in (STAGES, EARLIER_LOGS):
        return entry
    return next((file for file in sorted(entry.iterdir()) if not _is_trajectory(file)), None)


def _is_trajectory(file: Path) -> bool:
    """Whether an entry of the folder of stages or of earlier logs is one of those that a run writes."""
    named = file.name in _STAGE_FILES if file.parent.name == STAGES else file.suffix == ".tum" and file.stem.isdecimal()
    return named and file.is_file() and not file.is_symlink()


def write_output(
    directory: Path,
    final: FinalMap,
    source_stamps: NDArray[np.int64],
    figures: RunMetrics,
    configuration: Configuration,
    state: MapWriter | None = None,
) -> None:
    """Write every file of a run.

    :param directory: an empty folder, see :func:`atomic_output`.
    :param source_stamps: shape (n,), the logs' own stamps of all scans, ns, in file order.
    :param state: the :func:`map_writer` that wrote the state of the run, None for a map without a state.
    """
    recording = final.recording
    _write_trajectories(directory, final, source_stamps)
    _write_map(directory, recording, configuration)
    writer = state or map_writer(directory)
    writer.write_map(recording.replica, recording.area_poses, recording.last_estimate, recording.relative_trajectory)
    writer.finish(configuration)
    write_graph(directory / "graph.g2o", recording)
    write_probabilities(directory / "pmf.csv", recording.probabilities)
    write_cost(directory / "cost.csv", figures.seconds_per_scan)
    report = json.dumps(build_report(recording, configuration, figures), indent=1, allow_nan=False)
    (directory / "report.json").write_text(report + "\n", encoding="utf-8")
    # matplotlib is loaded only here, after the processes have released their memory.
    from hmt_slam_ros.results.plots import plot_map  # noqa: PLC0415

    plot_map(directory)


def _write_trajectories(directory: Path, final: FinalMap, source_stamps: NDArray[np.int64]) -> None:
    """Write the trajectories of the newest log, and the final ones of the earlier logs."""
    recording = final.recording
    trajectories = {"trajectory": recording.trajectory, "trajectory_online": recording.online_trajectory}
    trajectories |= {f"{STAGES}/{name}": trajectory for name, trajectory in final.stages.items()}
    (directory / STAGES).mkdir()
    newest = slice(recording.first_scans[-1], None)
    for name, trajectory in trajectories.items():
        write_tum(directory / f"{name}.tum", StampedPoses(source_stamps[newest], trajectory[newest]))
    for number, (first, end) in enumerate(pairwise(recording.first_scans), start=1):
        (directory / EARLIER_LOGS).mkdir(exist_ok=True)
        poses = StampedPoses(source_stamps[first:end], recording.trajectory[first:end])
        write_tum(directory / EARLIER_LOGS / f"{number}.tum", poses)


def map_writer(directory: Path) -> MapWriter:
    """The writer of the map of an output folder."""
    return MapWriter(directory / HMT_MAP)


def _write_map(directory: Path, recording: Recording, configuration: Configuration) -> None:
    poses = keyframe_poses(recording.hybrid_map, recording.area_poses)
    scans = [recording.replica.scans[keyframe] for keyframe in poses]
    settings = configuration.local_map
    write_map(directory, occupancy_image(scans, np.array(list(poses.values())), settings.cell, settings.max_range))


def write_graph(path: Path, recording: Recording) -> None:
    """Write areas as VERTEX_SE2 and arcs as EDGE_SE2 of g2o.

    The error of g2o is the vector (x, y, theta) of measurement^-1 * estimate. To first order this is the right tangent
    of the covariances, so that the information matrix is their inverse.
    """
    lines = [f"VERTEX_SE2 {area} {_format_numbers(pose.mean)}\n" for area, pose in sorted(recording.area_poses.items())]
    upper = np.triu_indices(3)
    for a, b, arc in recording.hybrid_map.all_arcs():
        information = np.linalg.inv(arc.pose.covariance)
        lines.append(f"EDGE_SE2 {a} {b} {_format_numbers(arc.pose.mean)} {_format_numbers(information[upper])}\n")
    path.write_text("".join(lines), encoding="utf-8")


def _format_numbers(values: NDArray[Any]) -> str:
    return " ".join(f"{value:.12g}" for value in values)


def build_report(recording: Recording, configuration: Configuration, figures: RunMetrics) -> dict[str, Any]:
    """The content of report.json."""
    totals, replica, hybrid_map = recording.own_totals, recording.replica, recording.hybrid_map
    arcs = [arc for _, _, arc in hybrid_map.all_arcs()]
    return {
        "log": figures.log,
        "runtime": figures.runtime,
        "scans": {"in": totals.received, "processed": totals.processed, "dropped": totals.dropped},
        "scans_of_earlier_logs": recording.first_scans[-1],
        "travelled_m": recording.own_path_length,
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
        "particles": {
            "least_effective_samples": min(row.effective_samples for row in recording.probabilities),
            "most_modes": max(row.mode_count for row in recording.probabilities),
            "events_with_several_modes": len({row.keyframe for row in recording.probabilities if row.mode_count > 1}),
        },
        "notices": [{"process": notice.process, "text": notice.text} for notice in recording.notices],
        "processes": {name: _cost_summary(seconds) for name, seconds in figures.seconds_per_scan.items()},
        "peak_rss_bytes": dict(figures.peak_rss),
        "pss_bytes": dict(figures.pss),
        "memory_bytes": dict(figures.memory) | {"keyframe_scans": scan_bytes(replica.scans.values())},
        "speculation": dict(figures.speculation),
        "wall_s": figures.wall_seconds,
        "cpu_s": figures.cpu_seconds,
        "refinement_s": figures.refinement_seconds,
        "seed": configuration.seed,
        "configuration": as_nested(configuration),
        "versions": _versions(),
    }


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
    """Write cost.csv: milliseconds of every process for every scan."""
    rows = np.round(1e3 * np.column_stack(list(seconds_per_scan.values())), 4).tolist() if seconds_per_scan else []
    _write_table(path, [f"{name}_ms" for name in seconds_per_scan], rows)


def write_probabilities(path: Path, probabilities: list[TopologyProbability]) -> None:
    """Write pmf.csv: Eq. (14), one line for every hypothesis at every keyframe event."""
    header = [_PROBABILITY_COLUMNS.get(name, name) for name in TopologyProbability._fields]
    rows = [[int(value) if isinstance(value, bool) else value for value in row] for row in probabilities]
    _write_table(path, header, rows)


def _write_table(path: Path, names: list[str], rows: list[list[float]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        writer.writerows(rows)


def code_bytes() -> dict[str, int]:
    """Resident memory of this OS process that is mapped from ``libraries``, and that of compiled ``kernels``, bytes.

    :returns: {} without /proc.
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
    """Memory of scans with their cached points, bytes."""
    return sum(value.nbytes for scan in scans for value in vars(scan).values() if isinstance(value, np.ndarray))
