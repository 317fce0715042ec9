"""Sections of the live page from ROS messages: what a page cannot show is refused, whoever sent it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point, Pose, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from visualization_msgs.msg import Marker, MarkerArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import ELLIPSE_95
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.ros.conversions import (
    area_from_frame,
    gaussian_from_message,
    pose_from_message,
    stamp_from_time,
    time_message,
)
from hmt_slam_ros.ros.diagnostics import HARDWARE_ID
from hmt_slam_ros.ros.landmark_markers import MAX_LANDMARKS, POINTS_PER_LANDMARK
from hmt_slam_ros.sensors.plausibility import MAX_COORDINATE, check_quaternion
from hmt_slam_ros.untrusted_input import shorten
from hmt_slam_ros.view.incidents import Incident

_MAX_CELLS = 64_000_000
"""Of a map: 400 m by 400 m in cells of 5 cm; its picture takes about a second."""
_MAX_FRAME = 40
"""Characters of an area's frame."""
_MAX_ROOMS = 500
"""Rooms whose names are shown."""
_MAX_MARKERS = 1000
"""Of one message, in which a room has one, and all landmarks of a kind have one."""
_MAX_VARIANCE = 1e14
"""m^2 or rad^2 of a pose; the robot may be anywhere with 1e8."""


def finite(value: float, name: str, reach: float = math.inf) -> float:
    """A number, where it is one.

    :param reach: its largest magnitude.
    :raises HmtSlamError: where it is not finite or beyond.
    """
    if not (math.isfinite(value) and abs(value) <= reach):
        raise HmtSlamError(f"{name} = {value} cannot be shown on the page: look who publishes it")
    return value


def robot_section(message: PoseWithCovarianceStamped) -> dict[str, Any]:
    """Pose of the robot in the map, m and rad, its 95 % ellipse, and standard deviations, m and degrees.

    :raises HmtSlamError: where a number is not finite, or the orientation is no rotation.
    """
    _check_pose(message.pose.pose)
    _check_all(message.pose.covariance, "covariance", _MAX_VARIANCE)
    belief = gaussian_from_message(message.pose)
    ellipse, (x, y, theta) = belief.position_ellipse(), belief.mean.tolist()
    return {
        "time": round(stamp_from_time(message.header.stamp) / NANOSECONDS, 3),
        "pose": [round(x, 3), round(y, 3), round(theta, 4)],
        "ellipse": None if is_uninformative(belief) else [round(value, 4) for value in ellipse],
        "deviation": round(ellipse.semi_major / ELLIPSE_95, 3),
        "turn": round(math.degrees(math.sqrt(max(0.0, belief.covariance[2, 2]))), 2),
    }


def area_section(message: PoseWithCovarianceStamped) -> str:
    """Number of the area that the robot is in.

    :raises HmtSlamError: where the frame is none of an area.
    """
    frame = message.header.frame_id
    if len(frame) > _MAX_FRAME or not frame.isascii():
        raise HmtSlamError(f"a frame of {len(frame)} characters is none of an area: run the same version everywhere")
    return str(area_from_frame(frame))


def planar_pose(message: Pose) -> list[float]:
    """x, y, m, and heading, rad, of a pose.

    :raises HmtSlamError: where a number is not finite, or the orientation is no rotation.
    """
    _check_pose(message)
    x, y, theta = pose_from_message(message).tolist()
    return [round(x, 3), round(y, 3), round(theta, 4)]


def rooms_section(message: MarkerArray) -> list[list[Any]]:
    """Name, x and y, m, of the rooms that texts name.

    :raises HmtSlamError: where there are too many, or a number is not finite.
    """
    _check_count(message)
    texts = [marker for marker in message.markers if marker.type == Marker.TEXT_VIEW_FACING and marker.text]
    if len(texts) > _MAX_ROOMS:
        raise HmtSlamError(f"{len(texts)} rooms are too many to be shown: look who publishes it")
    return [[shorten(marker.text), *_round_position(marker.pose.position)] for marker in texts]


def landmarks_section(message: MarkerArray) -> dict[str, list[int]]:
    """{kind: coordinates of its landmarks, one landmark after the other, cm}.

    A corner has 8 numbers, of two lines along its walls; an opening has 4, of its jambs.

    :raises HmtSlamError: where there are too many, a number is not finite, or one is missing.
    """
    _check_count(message)
    found: dict[str, list[int]] = {kind: [] for kind in POINTS_PER_LANDMARK}
    for marker in message.markers:
        if marker.ns in found and marker.type == Marker.LINE_LIST:
            size, count = POINTS_PER_LANDMARK[marker.ns], len(marker.points)
            if count % size or count > size * MAX_LANDMARKS:
                raise HmtSlamError(
                    f"{count} points of {marker.ns} are none of landmarks, or too many: look who publishes it"
                )
            found[marker.ns] = [round(100.0 * value) for point in marker.points for value in _round_position(point)]
    return found


def _check_count(message: MarkerArray) -> None:
    if len(message.markers) > _MAX_MARKERS:
        raise HmtSlamError(f"{len(message.markers)} markers are too many to be shown: look who publishes it")


def _round_position(point: Point) -> list[float]:
    """x and y of a point, m."""
    return [round(finite(value, "position", MAX_COORDINATE), 3) for value in (point.x, point.y)]


def map_cells(message: OccupancyGrid) -> NDArray[np.int8]:
    """Cells of a map, shape (height, width), row 0 with the smallest y.

    :raises HmtSlamError: where there are none, too many, or not as many as its size says.
    """
    width, height, count = message.info.width, message.info.height, len(message.data)
    if count != width * height:
        raise HmtSlamError(f"a map of {width} x {height} cells has {count}: look who publishes it")
    if not 0 < count <= _MAX_CELLS:
        raise HmtSlamError(
            f"a map of {width} x {height} cells is empty or too large to be shown: look who publishes it"
        )
    return np.frombuffer(message.data, dtype=np.int8).reshape(height, width)


def map_section(message: OccupancyGrid) -> dict[str, Any]:
    """Lower left corner and size of a map, m.

    :raises HmtSlamError: where a number is not finite or the resolution is not positive.
    """
    info = message.info
    resolution = finite(info.resolution, "resolution", MAX_COORDINATE)
    if resolution <= 0.0:
        raise HmtSlamError(f"resolution = {resolution} m is none of a map: look who publishes it")
    _check_pose(info.origin)
    origin = pose_from_message(info.origin)
    return {
        "origin": origin[:2].tolist(),
        "size": [round(info.width * resolution, 3), round(info.height * resolution, 3)],
    }


def _check_pose(pose: Pose) -> None:
    _check_all((pose.position.x, pose.position.y), "position", MAX_COORDINATE)
    q = pose.orientation
    check_quaternion((q.x, q.y, q.z, q.w))


def _check_all(values: Iterable[float], name: str, reach: float) -> None:
    for value in values:
        finite(float(value), name, reach)


_LEVELS = {"good": DiagnosticStatus.OK, "attention": DiagnosticStatus.WARN, "fault": DiagnosticStatus.ERROR}


def incident_message(incident: Incident, namespace: str) -> DiagnosticArray:
    """An incident as a status of its node, with the time at which it happened.

    :param namespace: of the node.
    """
    name = f"{namespace.rstrip('/')}/{incident.node}"
    status = DiagnosticStatus(level=_LEVELS[incident.level], name=name, message=incident.text, hardware_id=HARDWARE_ID)
    message = DiagnosticArray(status=[status])
    message.header.stamp = time_message(round(incident.time * NANOSECONDS))
    return message
