"""Maps of many areas on disk and in memory: times of saving and loading, and memory of an area."""

from __future__ import annotations

import tempfile
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from benchmark.lattice import ARC, FIRST_KEYFRAME, PER_AREA, Lattice, scan_at, shared_scan
from hmt_slam_ros.area_abstraction.overlap_graph import OverlapGraph
from hmt_slam_ros.area_abstraction.partition import Partition
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.loop_closure.closure_history import PathStep
from hmt_slam_ros.messages.messages import LocalEstimate, ScanPoses
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, Replica
from hmt_slam_ros.metric_slam.live_hypothesis import KeyframeCovariances
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.own_files import replace_folder
from hmt_slam_ros.results.hmt_map import MapWriter, RunState, read_run_state, read_saved_map
from hmt_slam_ros.results.log_reading import LogProgress
from hmt_slam_ros.results.record import EstimateTable, ProbabilityTable, ScanPoseTable, TopologyProbability
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.submap.local_filter import ParticleFilterState
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState

BEAMS = 181
"""Beams of the scans that are saved or measured."""

SCANS_PER_KEYFRAME = 10
"""Scans of the log, with poses in the trajectory, for each keyframe."""

_PERIOD = 100_000_000  # ns
_DRIVE, _SECONDS = "sim:office", 20.0
_ROBOT = LocalEstimate(0, 0, 0, PoseGaussian.from_pose(np.zeros(3)), np.zeros(3), 0)
_AREAS_OF_SCANS = 100
Made = TypeVar("Made")


class SaveTimes(NamedTuple):
    """Times of saving and loading a map.

    :ivar areas: number of areas.
    :ivar megabytes: of its files.
    :ivar save: s, from the running processes to the last byte on the disk.
    :ivar load: s, from the files to processes that can continue.
    :ivar load_map: s, from the files to the map without the state.
    """

    areas: int
    megabytes: float
    save: float
    load: float
    load_map: float

    @property
    def whole(self) -> float:
        """Time of saving and loading, s."""
        return self.save + self.load


def time_saving(lattice: Lattice, configuration: Configuration) -> SaveTimes:
    """Save and load a map of all crossings of a lattice, after a small one that loads code and does not count."""
    _time_once(Lattice(5, 2), configuration)
    return _time_once(lattice, configuration)


def _time_once(lattice: Lattice, configuration: Configuration) -> SaveTimes:
    run = LockStepRun(configuration, state=state_of(lattice, configuration))
    with tempfile.TemporaryDirectory() as folder:
        scratch, directory = Path(folder) / "new", Path(folder) / "hmt_map"
        begin = time.perf_counter()
        state = run.state
        writer = MapWriter(scratch)
        writer.write_state(state)
        writer.write_map(
            Replica.from_state(state.processes["tlca"].replica),
            {entry.area: entry.pose for entry in lattice.poses()},
            _ROBOT,
        )
        writer.finish(configuration)
        replace_folder(scratch, directory)
        written = time.perf_counter()
        LockStepRun(configuration, state=read_run_state(directory)[0])
        loaded = time.perf_counter()
        read_saved_map(directory)
        map_loaded = time.perf_counter()
        size = sum(path.stat().st_size for path in directory.iterdir()) / 1e6
    return SaveTimes(lattice.areas, size, written - begin, loaded - written, map_loaded - loaded)


def state_of(lattice: Lattice, configuration: Configuration) -> RunState:
    """The state of a run that mapped all crossings of a lattice, each by a separate path.

    The particle filter is that of a drive through a simulated building.
    """
    drive_state = _drive_state(configuration)
    hybrid_map = lattice.hybrid_map()
    keyframes = [k for area in hybrid_map.area_ids() for k in hybrid_map.keyframes(area)]
    scans = {k: _own_scan(shared_scan((k - FIRST_KEYFRAME) % 2 * 1.6, 0), k) for k in keyframes}
    maps, probabilities = {FIRST_HYPOTHESIS: hybrid_map}, {FIRST_HYPOTHESIS: 1.0}
    replica = Replica(scans, maps, probabilities, {FIRST_HYPOTHESIS: 0}).state
    covariances = KeyframeCovariances.from_dict(dict.fromkeys(keyframes, ARC))
    live = {
        hypothesis: replace(
            own,
            keyframe_covariances=covariances,
            particle_filter=_at_first_keyframes(own.particle_filter, keyframes),
            event=replace(own.event, anchor=keyframes[0]),
            scan_poses=(),
        )
        for hypothesis, own in drive_state.processes["slam"].live_hypotheses.items()
    }
    graph = OverlapGraph(tuple(range(PER_AREA)), np.full((PER_AREA, PER_AREA), 0.5))
    graphs = {a: replace(graph, keyframes=tuple(hybrid_map.keyframes(a))) for a in hybrid_map.area_ids()}
    partition = Partition(0, {area: area for area in hybrid_map.area_ids()}, frozenset(keyframes[:PER_AREA]))
    path = drive_state.processes["tlca"].paths[FIRST_HYPOTHESIS]
    arcs = [(a, b) for a, b, _ in hybrid_map.all_arcs()]
    steps = tuple(PathStep(k, a, b, ((a, b),), frozenset({k})) for k, (a, b) in enumerate(arcs))
    path = replace(path, arc_keyframes={pair: frozenset(pair) for pair in arcs}, history=steps)
    return RunState(
        _log_state(keyframes),
        {
            "slam": replace(
                drive_state.processes["slam"], replica=replica, live_hypotheses=live, keyframe_events=max(keyframes) + 1
            ),
            "aam": replace(
                drive_state.processes["aam"], replica=replica, graphs=graphs, partitions={FIRST_HYPOTHESIS: partition}
            ),
            "tsbi": replace(
                drive_state.processes["tsbi"],
                replica=replica,
                global_poses=lattice.poses(),
                hypothesis_states={FIRST_HYPOTHESIS: HypothesisState()},
            ),
            "tlca": replace(drive_state.processes["tlca"], replica=replica, paths={FIRST_HYPOTHESIS: path}),
            "rtl": replace(drive_state.processes["rtl"], area_poses=lattice.poses()),
        },
        replace(drive_state.recorder, replica=replica, **_recorder_fields(keyframes)),
    )


def _at_first_keyframes(own: ParticleFilterState | None, keyframes: Sequence[int]) -> ParticleFilterState:
    """The filter of the drive, whose keyframes are now the first of the map."""
    assert own is not None
    return replace(own, keyframes=tuple(keyframes[: len(own.keyframes)]))


def _drive_state(configuration: Configuration) -> RunState:
    """The state after the first seconds of a simulated drive."""
    run = LockStepRun(configuration)
    for record in open_log(_DRIVE, duration=_SECONDS).records():
        run.process_record(record)
    return run.state


def _own_scan(scan: Scan, keyframe: int) -> Scan:
    """A distinct scan of a keyframe, of ``BEAMS`` beams."""
    ranges = np.resize(scan.ranges, BEAMS) + np.float32(1e-6 * (keyframe - FIRST_KEYFRAME))
    return replace(scan, stamp=_stamp(keyframe), ranges=ranges)


def _stamp(keyframe: int) -> int:
    return (keyframe - FIRST_KEYFRAME) * SCANS_PER_KEYFRAME * _PERIOD


def _log_state(keyframes: Sequence[int]) -> LogProgress:
    """The progress of a log with an odometry reading for each scan."""
    stamps = _stamp(keyframes[0]) + _PERIOD * np.arange(len(keyframes) * SCANS_PER_KEYFRAME)
    return LogProgress(2 * stamps.size, stamps, stamps)


def _recorder_fields(keyframes: Sequence[int]) -> dict[str, Any]:
    """Fields of the recorder for all scans, and for events with a keyframe each."""
    scans = np.arange(len(keyframes) * SCANS_PER_KEYFRAME)
    stamps, poses = _stamp(keyframes[0]) + _PERIOD * scans, np.zeros((scans.size, 3))
    each = zip(np.split(scans, len(keyframes)), np.split(stamps, len(keyframes)), keyframes, strict=True)
    rows = [
        TopologyProbability(event, 0, 0.0, FIRST_HYPOTHESIS, FIRST_HYPOTHESIS, 1.0, 0, 1, 0, True, 0.0, 12.0, 1)
        for event in keyframes
    ]
    return {
        "events": max(keyframes) + 1,
        "probabilities": ProbabilityTable.from_rows(rows),
        "scan_poses": ScanPoseTable.from_messages(
            ScanPoses(FIRST_HYPOTHESIS, int(own[0]), moments, np.full(own.size, keyframe), np.zeros((own.size, 3)))
            for own, moments, keyframe in each
        ),
        "estimates": EstimateTable(scans, stamps, np.zeros_like(scans), poses, poses),
        "online_trajectory": poses,
    }


class AreaMemory(NamedTuple):
    """Memory of a stored area, kB.

    :ivar graph: poses of its keyframes and its arcs.
    :ivar scans: the scans of its keyframes, as received.
    :ivar points: their end points, if they were computed.
    """

    graph: float
    scans: float
    points: float

    @property
    def whole(self) -> float:
        """Memory of all data that cannot be computed from other data, kB."""
        return self.graph + self.scans


def weigh_areas(lattice: Lattice) -> AreaMemory:
    """Measure the memory of the areas of a lattice, each with distinct scans."""
    graph = measure_memory(lattice.hybrid_map)[0] / lattice.areas
    make_scan(0)
    scans, kept = measure_memory(lambda: [make_scan(keyframe) for keyframe in range(_AREAS_OF_SCANS * PER_AREA)])
    points, _ = measure_memory(lambda: [scan.points for scan in kept])
    return AreaMemory(graph, scans / _AREAS_OF_SCANS, points / _AREAS_OF_SCANS)


def make_scan(keyframe: int) -> Scan:
    """A distinct scan of a keyframe in a crossing, of ``BEAMS`` beams."""
    return scan_at(np.zeros(3), keyframe, keyframe, BEAMS)


def measure_memory(make: Callable[[], Made]) -> tuple[float, Made]:
    """The memory of a value, kB, and the value."""
    tracemalloc.start()
    try:
        made = make()
        return tracemalloc.get_traced_memory()[0] / 1e3, made
    finally:
        tracemalloc.stop()
