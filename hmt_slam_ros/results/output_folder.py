"""The output folder of a run, written complete or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import StampedPoses, write_tum
from hmt_slam_ros.grids.occupancy_map import occupancy_image, write_map
from hmt_slam_ros.results.export import LANDMARKS, PLACES, TOPOLOGY
from hmt_slam_ros.results.final_map import FinalMap
from hmt_slam_ros.results.hmt_map import MapWriter
from hmt_slam_ros.results.recorder import Recording, keyframe_poses
from hmt_slam_ros.results.report import RunMetrics, build_report, write_cost, write_probabilities, write_report
from hmt_slam_ros.saved_map.folder import HMT_MAP, MANIFEST, replace_folder

EARLIER_LOGS = "earlier"
"""The folder of the trajectories of earlier logs, 1.tum, 2.tum and so on."""

# Everything that ever stands in an output folder; a folder with anything else in it is not ours to replace.
OUTPUT_NAMES = frozenset(
    {
        "trajectory.tum",
        "trajectory_online.tum",
        "stages",
        EARLIER_LOGS,
        "map.pgm",
        "map.yaml",
        "map.png",
        HMT_MAP,
        "graph.g2o",
        TOPOLOGY,
        LANDMARKS,
        PLACES,
        "report.json",
        "pmf.csv",
        "pmf.png",
        "cost.csv",
        "cost.png",
    }
)


@contextmanager
def atomic_output(directory: Path) -> Iterator[Path]:
    """A folder to write into that becomes ``directory`` if all goes well, and vanishes if not.

    :raises HmtSlamError: where ``directory`` is something else than an old output folder, or cannot be made.
    """
    target = directory.absolute()
    check_replaceable(target)
    existing = next(parent for parent in target.parents if parent.exists())
    try:
        scratch = Path(tempfile.mkdtemp(prefix=f".{target.name}.partial-", dir=existing))
    except OSError as fault:
        raise HmtSlamError(f"{existing} cannot be written to ({fault.strerror}): choose another --out") from fault
    try:
        folder = scratch / "new"
        folder.mkdir()
        yield folder
        check_replaceable(target)
        target.parent.mkdir(parents=True, exist_ok=True)
        replace_folder(folder, target)
    except OSError as fault:
        raise HmtSlamError(f"{directory} cannot be written ({fault.strerror}): choose another --out") from fault
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def check_replaceable(directory: Path) -> None:
    """Refuse a path that holds something that would be lost.

    :raises HmtSlamError: unless there is nothing, an empty folder or an old output folder.
    """
    if directory.is_symlink() or (directory.exists() and not directory.is_dir()):
        raise HmtSlamError(f"{directory} is not a folder: choose another --out")
    blocking = next((parent for parent in directory.parents if parent.exists() and not parent.is_dir()), None)
    if blocking is not None:
        raise HmtSlamError(f"{directory} cannot be made since {blocking} is not a folder: choose another --out")
    names = {entry.name for entry in directory.iterdir()} if directory.exists() else set()
    strange = sorted(names - OUTPUT_NAMES)
    if strange or (names and not (directory / HMT_MAP / MANIFEST).is_file()):
        found = strange[0] if strange else min(names)
        raise HmtSlamError(f"{directory} is not an output folder, it holds {found}: choose another --out or empty it")


def write_output(
    directory: Path,
    final: FinalMap,
    source_stamps: NDArray[np.int64],
    figures: RunMetrics,
    configuration: Configuration,
    state: MapWriter | None = None,
) -> None:
    """Write every file of a run.

    :param directory: an empty folder, see :func:`replacing`.
    :param source_stamps: shape (n,), the logs' own stamps of all scans, ns, in file order.
    :param state: of :func:`map_writer`, where the state of the run was kept.
    """
    recording = final.recording
    _write_trajectories(directory, final, source_stamps)
    _write_map(directory, recording, configuration)
    saved = state or map_writer(directory)
    saved.write_map(recording.replica, recording.area_poses, recording.last_estimate, recording.relative_trajectory)
    saved.finish(configuration)
    write_graph(directory / "graph.g2o", recording)
    write_probabilities(directory / "pmf.csv", recording.probabilities)
    write_cost(directory / "cost.csv", figures.seconds_per_scan)
    write_report(directory / "report.json", build_report(recording, configuration, figures))
    # matplotlib is loaded when the processes have given their memory back, and only where something is drawn.
    from hmt_slam_ros.results.plots import plot_map  # noqa: PLC0415

    plot_map(directory)


def _write_trajectories(directory: Path, final: FinalMap, source_stamps: NDArray[np.int64]) -> None:
    """Those of the newest log, and of the earlier ones where they are in the final map."""
    recording = final.recording
    trajectories = {"trajectory": recording.trajectory, "trajectory_online": recording.online_trajectory}
    trajectories |= {f"stages/{name}": trajectory for name, trajectory in final.stages.items()}
    (directory / "stages").mkdir()
    newest = slice(recording.first_scans[-1], None)
    for name, trajectory in trajectories.items():
        write_tum(directory / f"{name}.tum", StampedPoses(source_stamps[newest], trajectory[newest]))
    for number, (first, end) in enumerate(pairwise(recording.first_scans), start=1):
        (directory / EARLIER_LOGS).mkdir(exist_ok=True)
        poses = StampedPoses(source_stamps[first:end], recording.trajectory[first:end])
        write_tum(directory / EARLIER_LOGS / f"{number}.tum", poses)


def map_writer(directory: Path) -> MapWriter:
    """What writes the map of an output folder."""
    return MapWriter(directory / HMT_MAP)


def _write_map(directory: Path, recording: Recording, configuration: Configuration) -> None:
    placed = keyframe_poses(recording.hybrid_map, recording.area_poses)
    scans = [recording.replica.scans[keyframe] for keyframe in placed]
    settings = configuration.local_map
    write_map(directory, occupancy_image(scans, np.array(list(placed.values())), settings.cell, settings.max_range))


def write_graph(path: Path, recording: Recording) -> None:
    """Areas as VERTEX_SE2 and arcs as EDGE_SE2.

    The error that g2o weighs is the vector (x, y, theta) of measurement^-1 * estimate, which to first order is the
    right tangent xi of our covariances, so the information matrix is their inverse.
    """
    lines = [f"VERTEX_SE2 {area} {_format_numbers(pose.mean)}\n" for area, pose in sorted(recording.area_poses.items())]
    upper = np.triu_indices(3)
    for a, b, arc in recording.hybrid_map.all_arcs():
        information = np.linalg.inv(arc.pose.covariance)
        lines.append(f"EDGE_SE2 {a} {b} {_format_numbers(arc.pose.mean)} {_format_numbers(information[upper])}\n")
    path.write_text("".join(lines), encoding="utf-8")


def _format_numbers(values: NDArray[Any]) -> str:
    return " ".join(f"{value:.12g}" for value in values)
