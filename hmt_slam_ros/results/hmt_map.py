"""hmt_map/: the HMT map as a folder, equal byte for byte for equal runs.

Part ``map`` is the map after the final refinement. The other parts are the state before it, from which a run continues.
docs/reference/map_format.md describes every file and field.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.configuration.documents import ros_yaml
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.messages.replica import Replica, ReplicaState
from hmt_slam_ros.metric_slam.slam import SlamState
from hmt_slam_ros.process_table import COORDINATOR, PROCESSES
from hmt_slam_ros.registration.consistency import NO_CLUTTER, Clutter
from hmt_slam_ros.results.log_reading import LogProgress
from hmt_slam_ros.results.record import RunRecord
from hmt_slam_ros.results.trajectories import RelativeTrajectory
from hmt_slam_ros.saved_map.folder import CONFIGURATION, FORMAT, VERSION, FileRecord, FolderReader, FolderWriter
from hmt_slam_ros.saved_map.validation import check_run_state


@dataclass(frozen=True, eq=False)
class RunState:
    """The state of a run in lock-step between two records of a log; by default before the first.

    :ivar log: progress through the logs.
    :ivar processes: {process: state}, of all processes of the table.
    :ivar recorder: record of the run.
    """

    log: LogProgress = field(default_factory=LogProgress)
    processes: Mapping[str, Any] = field(default_factory=lambda: {row.name: row.state_class() for row in PROCESSES})
    recorder: RunRecord = field(default_factory=RunRecord)

    @classmethod
    def from_parts(cls, parts: Mapping[str, Any]) -> RunState:
        """The state with given :attr:`parts`."""
        return cls(parts["log"], {row.name: parts[row.name] for row in PROCESSES}, parts["recorder"])

    @property
    def parts(self) -> dict[str, Any]:
        """{name in :data:`PARTS`: value}."""
        return {"log": self.log, **self.processes, "recorder": self.recorder}


@dataclass(frozen=True, eq=False)
class MapDocument:
    """The map after the final refinement.

    :ivar replica: the maps of the live hypotheses; that of the most probable one is refined.
    :ivar area_poses: ``map_T_area`` of all areas of the most probable hypothesis, ordered by id.
    :ivar last_estimate: last estimate of metric SLAM.
    :ivar relative_trajectory: poses of the scans of all logs; empty in a map that nodes saved.
    """

    replica: ReplicaState
    area_poses: tuple[AreaPose, ...]
    last_estimate: LocalEstimate
    relative_trajectory: RelativeTrajectory


@dataclass(frozen=True)
class ChainState:
    """The position in the sequence of keyframe events.

    :ivar events: number of keyframe events so far, which is the number of the next one.
    """

    events: int


PARTS: Mapping[str, type] = {
    "log": LogProgress,
    **{row.name: row.state_class for row in PROCESSES},
    "recorder": RunRecord,
}
"""{part of the state: class}; each is a file of the map."""


@dataclass(frozen=True, eq=False)
class SavedMap:
    """A map that was read.

    :ivar replica: scans and maps of the live hypotheses with their probabilities.
    :ivar area_poses: {area: belief over ``map_T_area``} of the most probable hypothesis.
    :ivar configuration: configuration of the run.
    :ivar relative_trajectory: poses of the scans of all logs, empty where unknown.
    """

    replica: Replica
    area_poses: dict[int, PoseGaussian]
    configuration: Configuration
    relative_trajectory: RelativeTrajectory = field(default_factory=RelativeTrajectory.empty)


class MapWriter:
    """Writes a map into a folder: first the state, where there is one, last the refined map."""

    def __init__(self, directory: Path) -> None:
        """:param directory: folder that is made."""
        self._folder = FolderWriter(directory)

    def write_state(self, state: RunState) -> None:
        """Write the state from which a run continues."""
        for name, part in state.parts.items():
            self._folder.write(name, part)
        self._folder.write("chain", ChainState(state.processes[COORDINATOR].keyframe_events))

    def write_slam_state(self, state: SlamState) -> None:
        """Write the state of metric SLAM; :meth:`add_files` takes those of the other nodes."""
        self._folder.write(COORDINATOR, state)
        self._folder.write("chain", ChainState(state.keyframe_events))

    def add_files(self, files: Iterable[FileRecord]) -> None:
        """Add files that other processes wrote into the folder."""
        self._folder.add_files(files)

    def write_map(
        self,
        replica: Replica,
        area_poses: Mapping[int, PoseGaussian],
        last_estimate: LocalEstimate,
        relative_trajectory: RelativeTrajectory | None = None,
    ) -> None:
        """Write the map, with the scans of its keyframes.

        :param area_poses: {area: belief over ``map_T_area``} of the most probable hypothesis.
        :param last_estimate: last estimate of metric SLAM.
        :param relative_trajectory: poses of the scans of all logs, None where unknown.
        """
        maps = replica.maps.values()
        mapped = sorted(
            {k for hybrid_map in maps for area in hybrid_map.area_ids() for k in hybrid_map.keyframes(area)}
        )
        scans = {keyframe: replica.scans[keyframe] for keyframe in mapped}
        saved = Replica(scans, replica.maps, replica.probabilities, replica.robot_areas)
        poses = tuple(AreaPose(area, pose) for area, pose in sorted(area_poses.items()))
        self._folder.write(
            "map", MapDocument(saved.state, poses, last_estimate, relative_trajectory or RelativeTrajectory.empty())
        )

    def finish(self, configuration: Configuration) -> None:
        """Write the configuration and the manifest."""
        self._folder.write_text(CONFIGURATION, ros_yaml(configuration))
        self._folder.finish(FORMAT, VERSION)


def read_saved_map(directory: Path) -> SavedMap:
    """The map in a folder.

    :raises HmtSlamError: where the folder holds no map, one of another version, or a damaged one.
    """
    document = FolderReader(directory, FORMAT, VERSION).read("map", MapDocument)
    poses = {entry.area: entry.pose for entry in document.area_poses}
    configuration = load_configuration(directory / CONFIGURATION)
    return SavedMap(Replica.from_state(document.replica), poses, configuration, document.relative_trajectory)


def read_clutter(directory: Path) -> Clutter:
    """Usual rate of contradictions of a map, none where it was saved without the state of a run.

    :raises HmtSlamError: as :func:`read_saved_map`.
    """
    folder = FolderReader(directory, FORMAT, VERSION)
    if "slam.json" not in folder.names:
        return NO_CLUTTER
    slam: SlamState = folder.read("slam", PARTS["slam"])
    live = slam.live_hypotheses[Replica.from_state(slam.replica).best_hypothesis]
    own = live.particle_filter or live.line_filter
    return NO_CLUTTER if own is None else own.clutter_estimate.clutter


def read_run_state(directory: Path) -> tuple[RunState, Configuration]:
    """The state from which a run continues, and the configuration of the run that saved it.

    :raises HmtSlamError: as :func:`read_saved_map`, and where the map was saved without its state.
    """
    folder = FolderReader(directory, FORMAT, VERSION)
    if not {f"{part}.json" for part in PARTS} <= folder.names:
        raise HmtSlamError(
            f"{directory} holds a map without the state of a run, so that none can go on from it: give one that "
            "hmt_slam map wrote, or start nodes from one that nodes saved"
        )
    state = RunState.from_parts({name: folder.read(name, kind) for name, kind in PARTS.items()})
    configuration = load_configuration(directory / CONFIGURATION)
    check_run_state(state.parts, configuration)
    return state, configuration
