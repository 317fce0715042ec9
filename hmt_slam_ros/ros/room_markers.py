"""Markers of named rooms, which explorer and pilot publish where they changed."""

from __future__ import annotations

import math
from collections.abc import Mapping

from geometry_msgs.msg import Point, Vector3
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.ros.conversions import header_message

ROOMS_NAMESPACE = "rooms"

_MIN_SHIFT = 0.05
"""Rooms that all moved less than this are not sent again, m."""

_HEIGHT, _TEXT_SIZE = 0.6, 0.7
"""Height of the names above the floor, and size of their letters, m."""

_COLOR = ColorRGBA(r=0.1, g=0.1, b=0.1, a=1.0)


class RoomMarkers:
    """Makes the message with the names of rooms."""

    def __init__(self, frame: str) -> None:
        """:param frame: name of the map's frame."""
        self._frame = frame
        self._sent: Mapping[str, Float64] | None = None

    def forget(self) -> None:
        """Make the next message also where nothing changed."""
        self._sent = None

    def make(self, rooms: Mapping[str, Float64]) -> MarkerArray | None:
        """The names as texts, without a stamp, so that they hold until the next message; None where nothing changed.

        :param rooms: {name: position in the map (2,), m}.
        """
        if self._sent is not None and _is_same(self._sent, rooms):
            return None
        self._sent = dict(rooms)
        markers = [Marker(action=Marker.DELETEALL)]
        for number, (name, position) in enumerate(rooms.items()):
            marker = Marker(header=header_message(0, self._frame), ns=ROOMS_NAMESPACE, id=number, text=name)
            marker.type, marker.color, marker.scale = Marker.TEXT_VIEW_FACING, _COLOR, Vector3(z=_TEXT_SIZE)
            marker.pose.position = Point(x=float(position[0]), y=float(position[1]), z=_HEIGHT)
            marker.pose.orientation.w = 1.0
            markers.append(marker)
        return MarkerArray(markers=markers)


def _is_same(sent: Mapping[str, Float64], rooms: Mapping[str, Float64]) -> bool:
    return list(sent) == list(rooms) and all(math.dist(sent[name], rooms[name]) < _MIN_SHIFT for name in rooms)
