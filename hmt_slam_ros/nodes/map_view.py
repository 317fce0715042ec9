"""The map for people and other programs to see: an occupancy grid, and areas and arcs as markers."""

from __future__ import annotations

from array import array
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import Point, Vector3
from nav_msgs.msg import MapMetaData, OccupancyGrid
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.nodes.conversions import header, time_message
from hmt_slam_ros.processes.messages import Accepted, Hypotheses, Keyframe, Message
from hmt_slam_ros.processes.replica import Replica

if TYPE_CHECKING:
    from hmt_slam_ros.offline.saved_map import MapDocument

_AREA = ColorRGBA(r=0.12, g=0.47, b=0.71, a=0.9)
_ROBOT_AREA = ColorRGBA(r=0.84, g=0.15, b=0.16, a=0.9)
_ARC = ColorRGBA(r=0.3, g=0.3, b=0.3, a=0.9)
_CLOSURE = ColorRGBA(r=1.0, g=0.5, b=0.05, a=0.9)
_TEXT = ColorRGBA(a=1.0)


class MapView:
    """Follows the chain, and draws the most probable hypothesis.

    :ivar stamp: of the newest keyframe, ns.
    :ivar version: number of changes so far.
    """

    def __init__(self, configuration: Configuration, frame: str, known: MapDocument | None = None) -> None:
        """:param known: the map to begin with."""
        self.stamp = known.robot.stamp if known else 0
        self.version = 1 if known else 0
        self._settings, self._frame = configuration.local_map, frame
        self._replica = Replica.of(known.replica) if known else Replica()
        poses = known.area_poses if known else ()
        self._poses = {entry.area: entry.pose.mean for entry in poses}

    def hear(self, message: Message) -> None:
        """Take in a message of the chain."""
        if isinstance(message, Keyframe):
            self._replica.add(message)
            self.stamp = message.scan.stamp
        elif isinstance(message, Hypotheses):
            self._replica.apply(message)
        elif isinstance(message, Accepted):
            self._replica.accept(message)
            if message.global_poses:
                self._poses = {area.area: area.pose.mean for area in message.global_poses}
            self.version += 1

    def _areas(self) -> list[int]:
        return [area for area in self._replica.maps[self._replica.best].area_ids() if area in self._poses]

    def grid(self) -> OccupancyGrid | None:
        """The occupancy grid, None while there is no keyframe."""
        from hmt_slam_ros.offline.map_image import occupancy_image  # noqa: PLC0415  only where someone looks

        best = self._replica.maps[self._replica.best]
        placed = {
            keyframe: se2.compose(self._poses[area], pose)
            for area in self._areas()
            for keyframe, pose in best.keyframes(area).items()
        }
        if not placed:
            return None
        scans = [self._replica.scans[keyframe] for keyframe in placed]
        poses = np.array(list(placed.values()))
        image = occupancy_image(scans, poses, self._settings.cell, self._settings.max_range)
        return grid_message(self.stamp, self._frame, image)

    def graph(self) -> MarkerArray:
        """Areas as labelled discs, arcs as lines; the robot's area and the arcs that closed a loop stand out."""
        best, areas = self._replica.maps[self._replica.best], self._areas()
        here = self._replica.areas[self._replica.best]
        markers = [Marker(action=Marker.DELETEALL)]
        for area in areas:
            at = _point(self._poses[area])
            disc = self._marker("areas", area, Marker.CYLINDER, (0.6, 0.6, 0.1), _ROBOT_AREA if area == here else _AREA)
            label = self._marker("labels", area, Marker.TEXT_VIEW_FACING, (0.0, 0.0, 0.5), _TEXT)
            disc.pose.position, label.pose.position, label.text = at, Point(x=at.x, y=at.y, z=0.6), str(area)
            markers += [disc, label]
        for number, (a, b, arc) in enumerate(best.all_arcs()):
            if a in self._poses and b in self._poses:
                color = _CLOSURE if arc.closure else _ARC
                line = self._marker("arcs", number, Marker.LINE_STRIP, (0.08, 0.0, 0.0), color)
                line.points = [_point(self._poses[a]), _point(self._poses[b])]
                markers.append(line)
        return MarkerArray(markers=markers)

    def _marker(
        self, group: str, number: int, kind: int, size: tuple[float, float, float], color: ColorRGBA
    ) -> Marker:
        marker = Marker(header=header(self.stamp, self._frame), ns=group, id=number, type=kind, color=color)
        marker.scale = Vector3(x=size[0], y=size[1], z=size[2])
        marker.pose.orientation.w = 1.0
        return marker


def grid_message(stamp: int, frame: str, image: Any) -> OccupancyGrid:  # noqa: ANN401  an OccupancyImage, see grid()
    """ROS's occupancy grid: row 0 is the smallest y, 100 occupied, 0 free, -1 unknown."""
    from hmt_slam_ros.offline.map_image import FREE, OCCUPIED  # noqa: PLC0415

    pixels = image.pixels[::-1]
    cells = np.full(pixels.shape, -1, dtype=np.int8)
    cells[pixels == OCCUPIED] = 100
    cells[pixels == FREE] = 0
    info = MapMetaData(
        map_load_time=time_message(stamp), resolution=image.resolution, width=cells.shape[1], height=cells.shape[0]
    )
    info.origin.position.x, info.origin.position.y = image.origin.tolist()
    info.origin.orientation.w = 1.0
    return OccupancyGrid(header=header(stamp, frame), info=info, data=array("b", cells.tobytes()))


def _point(pose: NDArray[np.float64]) -> Point:
    return Point(x=float(pose[0]), y=float(pose[1]))
