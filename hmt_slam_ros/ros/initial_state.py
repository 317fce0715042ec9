"""Initial state of a node: none or its part of a saved map, and the initial pose in it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import connected_areas
from hmt_slam_ros.hybrid_map.surroundings import keyframe_positions
from hmt_slam_ros.messages.map_changes import AreaPose, InitialPose
from hmt_slam_ros.process_table import COORDINATOR
from hmt_slam_ros.results.log_reading import describe_parameter_changes, map_folder
from hmt_slam_ros.ros.parameters import ConfiguredNode, declare_pose
from hmt_slam_ros.ros.recovery import CHECKPOINT
from hmt_slam_ros.saved_map.folder import CONFIGURATION, FORMAT, VERSION, FolderReader
from hmt_slam_ros.saved_map.validation import check_slam_state

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hmt_slam_ros.metric_slam.slam import MetricSlam
    from hmt_slam_ros.results.hmt_map import MapDocument
    from hmt_slam_ros.ros.recovery import JournalHeader

State = TypeVar("State")

_START_FROM = ParameterDescriptor(description="Output folder or hmt_map to go on from.", read_only=True)
_START_LOST = ParameterDescriptor(
    description="Whether the robot may be anywhere in the map of start_from; otherwise it is where it was.",
    read_only=True,
)


class ConfigurationSource(Protocol):
    """A node whose parameters are compared with those of a map."""

    @property
    def configuration(self) -> Configuration:
        """The parameters of the node."""

    def get_logger(self) -> Any:  # noqa: ANN401  rclpy's
        """The logger of the node."""


class InitialState:
    """A saved map to start from, or nothing.

    :ivar events: number of keyframe events in the map, 0 without.
    :ivar lost: whether the robot may be anywhere in the map.
    :ivar folder: of the map, None without.
    :ivar previous_scans: number of scans with a pose before; new ones are numbered on from it.
    """

    def __init__(self, node: ConfigurationSource, path: str, *, lost: bool, previous_scans: int = 0) -> None:
        """Open and check the map.

        :param path: folder of the map or the output folder around it, empty for no map.
        :raises HmtSlamError: where the map is damaged, or differs from the node in a fixed parameter.
        """
        self.events, self.lost, self.previous_scans = 0, lost and bool(path), previous_scans
        self._configuration = node.configuration
        self._reader: FolderReader | None = None
        self._saved_events: int | None = None
        self.folder: Path | None = None
        if path:
            self.folder = map_folder(Path(path)).absolute()
            self._open(node, self.folder, FORMAT)
            self.events = self._saved_events = self._chain_events()

    @classmethod
    def from_checkpoint(cls, node: ConfigurationSource, state: Path, header: JournalHeader) -> InitialState:
        """The state of a node that was killed.

        :param state: folder of its checkpoint.
        :param header: of its journal.
        :raises HmtSlamError: as for a map.
        """
        initial_state = cls(node, "", lost=False)
        initial_state._open(node, state, CHECKPOINT)
        initial_state.events = header.events
        initial_state.folder = Path(header.folder) if header.folder else None
        initial_state.map = None  # the checkpoint holds what the node needs of it
        return initial_state

    def _open(self, node: ConfigurationSource, folder: Path, kind: str) -> None:
        self._reader = FolderReader(folder, kind, VERSION)
        saved = load_configuration(folder / CONFIGURATION)
        changes = describe_parameter_changes(saved, replace(node.configuration, robot=saved.robot))
        if changes:
            node.get_logger().warning(changes)

    def _chain_events(self) -> int:
        from hmt_slam_ros.results.hmt_map import ChainState  # noqa: PLC0415

        state = self.read_part("chain", ChainState)
        return 0 if state is None else state.events

    def read_part(self, name: str, kind: type[State]) -> State | None:
        """A part of the map, None without a map.

        :raises HmtSlamError: where the map lacks the part.
        """
        if self._reader is None:
            return None
        if f"{name}.json" not in self._reader.names:
            raise HmtSlamError(
                f"the map to start from lacks the part {name}: give one that hmt_slam map wrote or nodes saved"
            )
        part = self._reader.read(name, kind)
        if name == COORDINATOR:
            check_slam_state(part, self._configuration, self._saved_events)
        return part

    @cached_property
    def map(self) -> MapDocument | None:
        """The map itself, None without."""
        if self._reader is None:
            return None
        from hmt_slam_ros.results.hmt_map import MapDocument  # noqa: PLC0415  it loads all processes

        return self.read_part("map", MapDocument)


def declare_start_from(node: ConfiguredNode) -> str:
    """Declare ``start_from``, and return the path of the map, empty for none."""
    return str(node.declare_parameter("start_from", "", _START_FROM).value)


def declare_start_lost(node: ConfiguredNode) -> bool:
    """Declare ``start_lost``, and return whether the robot may be anywhere in the map."""
    return bool(node.declare_parameter("start_lost", True, _START_LOST).value)


_MIN_COVARIANCE = np.diag([0.1, 0.1, math.radians(3.0)]) ** 2
"""Added to the covariance of an initial pose, m2, m2, rad2; some programs send zeros."""
_RVIZ_COVARIANCE = np.diag([0.5, 0.5, math.radians(15.0)]) ** 2
"""Covariance of an initial pose that is drawn in RViz, m2, m2, rad2."""
_GATE_DEVIATIONS = 3.0
"""Standard deviations by which an initial pose may lie outside of the map."""


def declare_initial_pose(node: Node) -> PoseGaussian | None:
    """Declare ``initial_pose``, and return the belief over ``map_T_base``, None where it is empty.

    :raises HmtSlamError: for anything but three finite numbers.
    """
    pose = declare_pose(
        node,
        "initial_pose",
        "Pose (x, y, theta) of the robot in the map of start_from, m and rad, known to 0.5 m and 15 degrees; empty "
        "where the robot may be anywhere.",
    )
    return None if pose is None else PoseGaussian(pose, _RVIZ_COVARIANCE)


def locate_in_map(
    process: MetricSlam, area_poses: Mapping[int, AreaPose], belief: PoseGaussian, radius: float
) -> InitialPose:
    """Initial pose in an area of the most probable hypothesis.

    :param area_poses: ``map_T_area`` by area.
    :param belief: over ``map_T_base``.
    :param radius: largest distance to a keyframe of the area, m.
    :raises HmtSlamError: where the pose is outside of the map, or the belief is invalid.
    """
    if not np.isfinite(belief.mean).all() or not np.isfinite(belief.covariance).all():
        raise HmtSlamError("the pose or its covariance is not finite: give numbers")
    spread = np.linalg.eigvalsh(belief.covariance)
    if spread[0] < -1e-9:
        raise HmtSlamError("the covariance of the pose has a negative eigenvalue: give one that is positive")
    x, y, _ = belief.mean
    nearest = _nearest_area(process, area_poses, belief.mean)
    if nearest is None:
        raise HmtSlamError("there is no map yet in which the robot could be: map, or start from a map")
    area, distance = nearest
    reach = radius + _GATE_DEVIATIONS * math.sqrt(float(np.linalg.eigvalsh(belief.covariance[:2, :2])[-1]))
    if distance > reach:
        raise HmtSlamError(
            f"({x:.2f}, {y:.2f}) is outside of the map, {distance:.1f} m from where the robot ever was in it: give a "
            f"pose within {reach:.1f} m, or a larger covariance"
        )
    pose = se2.between(area_poses[area].pose.mean, belief.mean)
    return InitialPose(area, PoseGaussian(pose, belief.covariance + _MIN_COVARIANCE))


def _nearest_area(
    process: MetricSlam, area_poses: Mapping[int, AreaPose], pose: NDArray[np.float64]
) -> tuple[int, float] | None:
    """The area with the keyframe nearest to a pose in the map (3,), and its distance, m; None without areas.

    What a lost robot has mapped is not part of the map.
    """
    replica = process.replica
    hybrid_map, robot_area = replica.maps[replica.best_hypothesis], replica.robot_areas[replica.best_hypothesis]
    excluded = connected_areas(hybrid_map, robot_area) if process.is_lost else {}
    distances = {
        area: float(np.hypot(*(keyframe_positions(hybrid_map, area, area_poses[area].pose.mean) - pose[:2]).T).min())
        for area in hybrid_map.area_ids()
        if area in area_poses and area not in excluded and hybrid_map.keyframes(area)
    }
    if not distances:
        return None
    nearest = min(distances, key=lambda area: (distances[area], area))
    return nearest, distances[nearest]
