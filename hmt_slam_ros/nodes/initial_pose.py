"""Where the robot is, as a person says in RViz or a parameter, turned into what the processes understand."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.processes.map_parts import AreaPose, Place
from hmt_slam_ros.topology.surroundings import positions
from hmt_slam_ros.topology.unknown import joined

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hmt_slam_ros.processes.slam import MetricSlam

# Nobody knows better where a robot is, m, m, rad: some programs send zeros.
_LEAST = np.diag([0.1, 0.1, math.radians(3.0)]) ** 2
# What RViz says of a pose that is drawn with the mouse.
_USUAL = np.diag([0.5, 0.5, math.radians(15.0)]) ** 2
_DEVIATIONS = 3.0


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
    return PoseGaussian(np.array(value, dtype=np.float64), _USUAL)


def place_of(process: MetricSlam, areas: Mapping[int, AreaPose], belief: PoseGaussian, radius: float) -> Place:
    """Where a robot is in the map of the most probable hypothesis.

    :param areas: ``map_T_area`` by area.
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
    near = _nearest(process, areas, belief.mean)
    if near is None:
        raise HmtSlamError("there is no map yet in which the robot could be: map, or start from a map")
    area, away = near
    reach = radius + _DEVIATIONS * math.sqrt(float(np.linalg.eigvalsh(belief.covariance[:2, :2])[-1]))
    if away > reach:
        raise HmtSlamError(
            f"({x:.2f}, {y:.2f}) is outside of the map, {away:.1f} m from where the robot ever was in it: give a pose "
            f"within {reach:.1f} m, or a larger covariance"
        )
    pose = se2.between(areas[area].pose.mean, belief.mean)
    return Place(area, PoseGaussian(pose, belief.covariance + _LEAST))


def _nearest(process: MetricSlam, areas: Mapping[int, AreaPose], pose: NDArray[np.float64]) -> tuple[int, float] | None:
    """The area with the keyframe nearest to a pose in the map (3,), and its distance, m; None where there is none.

    What a robot maps that may be anywhere is no part of the map.
    """
    replica = process.replica
    hybrid_map, here = replica.maps[replica.best], replica.areas[replica.best]
    beside = joined(hybrid_map, here) if process.lost else {}
    away = {
        area: float(np.hypot(*(positions(hybrid_map, area, areas[area].pose.mean) - pose[:2]).T).min())
        for area in hybrid_map.area_ids()
        if area in areas and area not in beside and hybrid_map.keyframes(area)
    }
    if not away:
        return None
    nearest = min(away, key=lambda area: (away[area], area))
    return nearest, away[nearest]
