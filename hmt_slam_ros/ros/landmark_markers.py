"""Markers of landmarks: the walls of corners, and the gaps of openings, as lines."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np
from geometry_msgs.msg import Point, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.ros.conversions import header_message

CORNERS, CONVEX_CORNERS, OPENINGS = "corners", "convex_corners", "openings"
KINDS = (CORNERS, CONVEX_CORNERS, OPENINGS)
"""Namespaces of the markers, in the order of the kinds of landmarks."""

POINTS_PER_LANDMARK = {CORNERS: 4, CONVEX_CORNERS: 4, OPENINGS: 2}
"""Points of a landmark: two lines from the corner along its walls, or one line from jamb to jamb."""

MAX_LANDMARKS = 10_000
"""Landmarks that are published, those that most probably exist."""

_MIN_EXISTENCE = 0.5
"""Probability that a landmark exists from which on it is published."""

_ARM = 0.4
"""Length of the line along each wall of a corner, m."""

_BESIDE_FREE_SPACE = {CORNERS: 0.25 * math.pi, CONVEX_CORNERS: 0.75 * math.pi}
"""Angle between the bisector of the free space and the walls of a corner, rad."""

_WIDTH = 0.08
"""Width of the lines, m."""

_COLORS = {
    CORNERS: ColorRGBA(r=0.3, g=0.49, b=0.06, a=1.0),
    CONVEX_CORNERS: ColorRGBA(r=0.3, g=0.49, b=0.06, a=1.0),
    OPENINGS: ColorRGBA(r=0.0, g=0.6, b=0.53, a=1.0),
}

Lines = dict[str, Float64]
"""{namespace: ends of lines in the map, shape (n, 2), m; two ends that follow each other are a line}."""


def landmark_lines(landmarks: Iterable[tuple[Float64, Iterable[Landmark]]]) -> Lines:
    """The lines of landmarks.

    :param landmarks: pairs of ``map_T_area`` (3,), m and rad, and the landmarks of that area.
    """
    probable = [
        (landmark, se2.compose(frame, landmark.pose.mean))
        for frame, own in landmarks
        for landmark in own
        if landmark.existence.probability >= _MIN_EXISTENCE
    ]
    probable.sort(key=lambda pair: -pair[0].existence.probability)
    ends: dict[str, list[Float64]] = {kind: [] for kind in KINDS}
    for landmark, pose in probable[:MAX_LANDMARKS]:
        kind = KINDS[landmark.kind]
        ends[kind].append(_opening(pose, landmark.width) if kind == OPENINGS else _corner(pose, kind))
    return {kind: np.concatenate(found) if found else np.empty((0, 2)) for kind, found in ends.items()}


def _opening(pose: Float64, width: float) -> Float64:
    return np.asarray(se2.transform(pose, 0.5 * width * np.array([[0.0, -1.0], [0.0, 1.0]])))


def _corner(pose: Float64, kind: str) -> Float64:
    angle = _BESIDE_FREE_SPACE[kind]
    x, y = _ARM * math.cos(angle), _ARM * math.sin(angle)
    return np.asarray(se2.transform(pose, np.array([[0.0, 0.0], [x, y], [0.0, 0.0], [x, -y]])))


def landmark_markers(lines: Mapping[str, Float64], stamp: int, frame: str) -> MarkerArray:
    """Lines as one marker for each kind.

    :param lines: of :func:`landmark_lines`.
    :param stamp: of the newest keyframe, ns.
    :param frame: name of the map's frame.
    """
    markers = [Marker(action=Marker.DELETEALL)]
    for kind, ends in lines.items():
        marker = Marker(header=header_message(stamp, frame), ns=kind, type=Marker.LINE_LIST, color=_COLORS[kind])
        marker.scale, marker.pose.orientation.w = Vector3(x=_WIDTH), 1.0
        marker.points = [Point(x=x, y=y) for x, y in ends.tolist()]
        if marker.points:  # RViz warns of a list without points
            markers.append(marker)
    return MarkerArray(markers=markers)
