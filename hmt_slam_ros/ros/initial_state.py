"""What a node begins with: nothing, or its part of a saved map, and where in it the robot is."""

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
from rclpy.parameter import Parameter

from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.shortest_path import connected_areas
from hmt_slam_ros.hybrid_map.surroundings import keyframe_positions
from hmt_slam_ros.messages.map_changes import AreaPose, InitialPose
from hmt_slam_ros.results.log_reading import describe_parameter_changes, map_folder
from hmt_slam_ros.ros.parameters import ConfiguredNode
from hmt_slam_ros.ros.recovery import CHECKPOINT
from hmt_slam_ros.saved_map.folder import CONFIGURATION, FORMAT, VERSION, FolderReader

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
    """A node with parameters, as a map is compared with them."""

    @property
    def configuration(self) -> Configuration:
        """The parameters of the node."""

    def get_logger(self) -> Any:  # noqa: ANN401  rclpy's
        """The logger of the node."""


class InitialState:
    """A saved map, or nothing.

    :ivar events: keyframe events in it, 0 without.
    :ivar lost: whether nothing tells how the robot came from where it was then.
    :ivar folder: of the map, None without.
    :ivar previous_scans: scans that had a pose before; those to come are numbered on, so that they are told from these.
    """

    def __init__(self, node: ConfigurationSource, path: str, *, lost: bool, previous_scans: int = 0) -> None:
        """Check the map.

        :param path: its folder or the output folder around it, empty for nothing.
        :raises HmtSlamError: where it is damaged, or the node's parameters do not go with it.
        """
        self.events, self.lost, self.previous_scans = 0, lost and bool(path), previous_scans
        self._reader: FolderReader | None = None
        self.folder: Path | None = None
        if path:
            self.folder = map_folder(Path(path)).absolute()
            self._open(node, self.folder, FORMAT)
            # The other processes need not be loaded for it.
            self.events = self._chain_events()

    @classmethod
    def from_checkpoint(cls, node: ConfigurationSource, state: Path, header: JournalHeader) -> InitialState:
        """Where a node that was killed goes on.

        :param state: the folder of its checkpoint.
        :param header: what it was then.
        :raises HmtSlamError: as for a map.
        """
        made = cls(node, "", lost=False)
        made._open(node, state, CHECKPOINT)
        made.events, made.folder = header.events, Path(header.folder) if header.folder else None
        made.map = None  # what was shown of it is part of the checkpoint
        return made

    def _open(self, node: ConfigurationSource, folder: Path, kind: str) -> None:
        self._reader = FolderReader(folder, kind, VERSION)
        saved = load_configuration(folder / CONFIGURATION)
        told = describe_parameter_changes(saved, replace(node.configuration, robot=saved.robot))
        if told:
            node.get_logger().warning(told)

    def _chain_events(self) -> int:
        from hmt_slam_ros.results.hmt_map import ChainState  # noqa: PLC0415

        state = self.read_part("chain", ChainState)
        return 0 if state is None else state.events

    def read_part(self, name: str, kind: type[State]) -> State | None:
        """A part of the map, None where the node begins with nothing.

        :raises HmtSlamError: where the map lacks it.
        """
        if self._reader is None:
            return None
        if f"{name}.json" not in self._reader.names:
            raise HmtSlamError(
                f"the map to start from lacks the part {name}: give one that hmt_slam map wrote or nodes saved"
            )
        return self._reader.read(name, kind)

    @cached_property
    def map(self) -> MapDocument | None:
        """The map itself."""
        from hmt_slam_ros.results.hmt_map import MapDocument  # noqa: PLC0415  for those who ask for it

        return self.read_part("map", MapDocument)


def declare_start_from(node: ConfiguredNode) -> str:
    """Path of the map, empty for none."""
    return str(node.declare_parameter("start_from", "", _START_FROM).value)


def declare_initial_state(node: ConfiguredNode) -> tuple[str, bool]:
    """Path of the map, empty for none, and whether the robot may be anywhere in it."""
    return declare_start_from(node), bool(node.declare_parameter("start_lost", True, _START_LOST).value)


# Nobody knows better where a robot is, m, m, rad: some programs send zeros.
_MIN_COVARIANCE = np.diag([0.1, 0.1, math.radians(3.0)]) ** 2
# What RViz says of a pose that is drawn with the mouse.
_RVIZ_COVARIANCE = np.diag([0.5, 0.5, math.radians(15.0)]) ** 2
_GATE_DEVIATIONS = 3.0


def declare_initial_pose(node: Node) -> PoseGaussian | None:
    """Belief over ``map_T_base`` from the parameter ``initial_pose``, None where it is not set.

    :raises HmtSlamError: where it is set to something else than three numbers.
    """
    descriptor = ParameterDescriptor(
        description="Pose (x, y, theta) of the robot in the map of start_from, m and rad, known to 0.5 m and 15 "
        "degrees; where it is not set, the robot may be anywhere.",
        read_only=True,
    )
    value = node.declare_parameter("initial_pose", Parameter.Type.DOUBLE_ARRAY, descriptor).value
    if value is None:
        return None
    if len(value) != 3 or not np.isfinite(value).all():
        raise HmtSlamError(f"initial_pose = {list(value)} is no pose: give x, y in m and theta in rad")
    return PoseGaussian(np.array(value, dtype=np.float64), _RVIZ_COVARIANCE)


def locate_in_map(
    process: MetricSlam, area_poses: Mapping[int, AreaPose], belief: PoseGaussian, radius: float
) -> InitialPose:
    """Where a robot is in the map of the most probable hypothesis.

    :param area_poses: ``map_T_area`` by area.
    :param belief: over ``map_T_base``.
    :param radius: farthest distance to a keyframe of an area's place, m.
    :raises HmtSlamError: where the map does not reach there, or the belief is none.
    """
    if not np.isfinite(belief.mean).all() or not np.isfinite(belief.covariance).all():
        raise HmtSlamError("the pose or its covariance is not finite: give numbers")
    spread = np.linalg.eigvalsh(belief.covariance)
    if spread[0] < -1e-9:
        raise HmtSlamError("the covariance of the pose has a negative eigenvalue: give one that is positive")
    x, y, _ = belief.mean
    near = _nearest_area(process, area_poses, belief.mean)
    if near is None:
        raise HmtSlamError("there is no map yet in which the robot could be: map, or start from a map")
    area, away = near
    reach = radius + _GATE_DEVIATIONS * math.sqrt(float(np.linalg.eigvalsh(belief.covariance[:2, :2])[-1]))
    if away > reach:
        raise HmtSlamError(
            f"({x:.2f}, {y:.2f}) is outside of the map, {away:.1f} m from where the robot ever was in it: give a pose "
            f"within {reach:.1f} m, or a larger covariance"
        )
    pose = se2.between(area_poses[area].pose.mean, belief.mean)
    return InitialPose(area, PoseGaussian(pose, belief.covariance + _MIN_COVARIANCE))


def _nearest_area(
    process: MetricSlam, area_poses: Mapping[int, AreaPose], pose: NDArray[np.float64]
) -> tuple[int, float] | None:
    """The area with the keyframe nearest to a pose in the map (3,), and its distance, m; None where there is none.

    What a robot maps that may be anywhere is no part of the map.
    """
    replica = process.replica
    hybrid_map, here = replica.maps[replica.best_hypothesis], replica.robot_areas[replica.best_hypothesis]
    beside = connected_areas(hybrid_map, here) if process.is_lost else {}
    away = {
        area: float(np.hypot(*(keyframe_positions(hybrid_map, area, area_poses[area].pose.mean) - pose[:2]).T).min())
        for area in hybrid_map.area_ids()
        if area in area_poses and area not in beside and hybrid_map.keyframes(area)
    }
    if not away:
        return None
    nearest = min(away, key=lambda area: (away[area], area))
    return nearest, away[nearest]
