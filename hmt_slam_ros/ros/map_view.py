"""Rendering of the map: an occupancy grid, areas and arcs as markers or as data, and the path."""

from __future__ import annotations

import math
from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import Point, Vector3
from nav_msgs.msg import MapMetaData, OccupancyGrid
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import ELLIPSE_95, PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import NO_KEYFRAME, KeyframePoses
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative
from hmt_slam_ros.hybrid_map.surroundings import stack_poses
from hmt_slam_ros.messages.alternatives import Alternatives, alternative_hypotheses
from hmt_slam_ros.messages.map_changes import AreaPose
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Keyframe, Message
from hmt_slam_ros.messages.replica import Replica, ReplicaState
from hmt_slam_ros.messages.topology import Topology
from hmt_slam_ros.ros.conversions import header_message, quaternion_message, time_message
from hmt_slam_ros.ros.keyframe_path import serialized_path

if TYPE_CHECKING:
    from hmt_slam_ros.results.hmt_map import MapDocument
    from hmt_slam_ros.sensors import Scan

_AREA = ColorRGBA(r=0.12, g=0.47, b=0.71, a=0.9)
_ROBOT_AREA = ColorRGBA(r=0.84, g=0.15, b=0.16, a=0.9)
_ARC = ColorRGBA(r=0.3, g=0.3, b=0.3, a=0.9)
_CLOSURE = ColorRGBA(r=1.0, g=0.5, b=0.05, a=0.9)
_TEXT = ColorRGBA(a=1.0)
_ELLIPSE_OPACITY = 0.3
_MIN_SIZE = 1e-3
"""Smallest size of a marker, m; RViz refuses zero."""


@dataclass(frozen=True, eq=False)
class MapRendererState:
    """State of a renderer.

    :ivar stamp: of the newest keyframe, ns, 0 before the first.
    :ivar replica: the maps of the live hypotheses.
    :ivar area_poses: ``map_T_area`` of the areas of the most probable hypothesis.
    """

    stamp: int = 0
    replica: ReplicaState = field(default_factory=ReplicaState)
    area_poses: tuple[AreaPose, ...] = ()

    @classmethod
    def from_document(cls, document: MapDocument | None) -> MapRendererState:
        """The state for a saved map, or for none."""
        return cls() if document is None else cls(document.last_estimate.stamp, document.replica, document.area_poses)


class MapRenderer:
    """Renders the most probable hypothesis from the messages of the chain.

    :ivar stamp: of the newest keyframe, ns.
    :ivar events: number of keyframe events that the map has.
    :ivar frame: name of the map's frame.
    """

    def __init__(self, configuration: Configuration, frame: str, state: MapRendererState, events: int = 0) -> None:
        """Start with a state.

        :param frame: name of the map's frame.
        :param events: number of keyframe events before.
        """
        self.stamp, self.events = state.stamp, events
        self._settings, self.frame = configuration.local_map, frame
        self._replica = Replica.from_state(state.replica)
        self._area_poses = {entry.area: entry.pose for entry in state.area_poses}

    @property
    def state(self) -> MapRendererState:
        """The state of the renderer."""
        poses = tuple(AreaPose(area, pose) for area, pose in self._area_poses.items())
        return MapRendererState(self.stamp, self._replica.state, poses)

    @property
    def version(self) -> int:
        """The number of keyframe events."""
        return self.events

    @property
    def scans(self) -> Mapping[int, Scan]:
        """{keyframe: scan}, of the same map the same object."""
        return self._replica.scans

    def update(self, message: Message) -> None:
        """Take in a message of the chain."""
        if isinstance(message, Keyframe | Hypotheses | ClosureDecision):
            self._replica.apply_message(message)
        if isinstance(message, Keyframe):
            self.stamp = message.scan.stamp
        elif isinstance(message, ClosureDecision):
            if message.global_poses:
                self._area_poses = {entry.area: entry.pose for entry in message.global_poses}
            self.events = message.sequence + 1

    def pose_in_map(self, area: int, pose: Float64) -> Float64 | None:
        """``map_T_base`` (3,) of a pose in an area, None where the area has no pose in the map.

        :param pose: ``area_T_base``, shape (3,).
        """
        belief = self._area_poses.get(area)
        return None if belief is None else se2.compose(belief.mean, pose)

    def _area_ids(self) -> list[int]:
        hybrid_map = self._replica.maps[self._replica.best_hypothesis]
        return [area for area in hybrid_map.area_ids() if area in self._area_poses]

    def area_keyframes(self) -> dict[int, KeyframePoses]:
        """{area: its keyframes with ``area_T_base``}, that of the robot, which grows, at the end."""
        best = self._replica.best_hypothesis
        hybrid_map, robot_area = self._replica.maps[best], self._replica.robot_areas[best]
        return {area: hybrid_map.keyframes(area) for area in sorted(self._area_ids(), key=lambda a: a == robot_area)}

    def known_area_poses(self) -> dict[int, Float64]:
        """{area: ``map_T_area`` (3,)} of areas whose place in the map is known."""
        poses = ((area, self._area_poses[area]) for area in self._area_ids())
        return {area: belief.mean for area, belief in poses if not is_uninformative(belief)}

    def occupancy_grid(self) -> OccupancyGrid | None:
        """The occupancy grid, None before the first keyframe."""
        from hmt_slam_ros.grids.occupancy_map import occupancy_image  # noqa: PLC0415  only for subscribers

        hybrid_map = self._replica.maps[self._replica.best_hypothesis]
        keyframe_poses = {
            keyframe: se2.compose(self._area_poses[area].mean, pose)
            for area in self._area_ids()
            for keyframe, pose in hybrid_map.keyframes(area).items()
        }
        if not keyframe_poses:
            return None
        scans = [self._replica.scans[keyframe] for keyframe in keyframe_poses]
        poses = np.array(list(keyframe_poses.values()))
        image = occupancy_image(scans, poses, self._settings.cell, self._settings.max_range)
        return grid_message(self.stamp, self.frame, image)

    def path(self) -> bytes:
        """The serialized nav_msgs/Path of the robot's own keyframes, in the order of their numbers.

        Without keyframes in areas whose place in the map is unknown.
        """
        hybrid_map = self._replica.maps[self._replica.best_hypothesis]
        known = self.known_area_poses()
        numbers = np.array([k for area in known for k in hybrid_map.keyframes(area)], dtype=np.int64)
        blocks = [se2.compose(frame, stack_poses(hybrid_map.keyframes(area))) for area, frame in known.items()]
        own = [k for k in np.argsort(numbers).tolist() if numbers[k] > NO_KEYFRAME]
        stamps = np.array([self._replica.scans[k].stamp for k in numbers[own].tolist()], dtype=np.int64)
        poses = np.concatenate(blocks)[own] if blocks else np.zeros((0, 3))
        return serialized_path(self.stamp, self.frame, stamps, poses)

    def topology(self, robot_poses: Mapping[int, Float64]) -> Topology:
        """The areas and arcs as data.

        :param robot_poses: {hypothesis: ``area_T_base`` of the robot at the newest keyframe event, shape (3,)}.
        """
        pose = robot_poses[self._replica.best_hypothesis]
        return Topology.from_replica(self._replica, self._area_poses, pose, self.frame, self.events, self.stamp)

    def alternatives(self, robot_poses: Mapping[int, Float64]) -> Alternatives:
        """The maps of the other hypotheses as data.

        :param robot_poses: of :meth:`topology`.
        """
        from hmt_slam_ros.hybrid_map.pose_graph import consistent_poses  # noqa: PLC0415  only for subscribers

        maps = self._replica.maps
        poses = {h: consistent_poses(maps[h]) for h in alternative_hypotheses(self._replica) if h in robot_poses}
        return Alternatives.from_replica(self._replica, poses, robot_poses, self.events)

    def graph_markers(self) -> MarkerArray:
        """Areas as labeled discs, arcs as lines, both with 95 % ellipses and texts.

        The robot's area and loop closures have colors of their own. An area's ellipse is that of its position in the
        map; an arc's, in its middle, is that of one area in the other. An uninformative pose has no ellipse.
        """
        hybrid_map = self._replica.maps[self._replica.best_hypothesis]
        robot_area = self._replica.robot_areas[self._replica.best_hypothesis]
        markers = [Marker(action=Marker.DELETEALL)]
        for area in self._area_ids():
            belief, color = self._area_poses[area], _ROBOT_AREA if area == robot_area else _AREA
            disc = self._marker("areas", area, Marker.CYLINDER, (0.6, 0.6, 0.1), color)
            label = self._marker("labels", area, Marker.TEXT_VIEW_FACING, (0.0, 0.0, 0.5), _TEXT)
            at = disc.pose.position = _point_message(belief.mean)
            label.pose.position, label.text = Point(x=at.x, y=at.y, z=0.6), str(area)
            text = f"Area {area} in the map: {_deviation_text(belief)}"
            markers += [disc, label, *self._ellipse_markers("area_uncertainty", area, belief, at, color, text)]
        for number, (a, b, arc) in enumerate(hybrid_map.all_arcs()):
            if a in self._area_poses and b in self._area_poses:
                color, group = (_CLOSURE, "closures") if arc.closure else (_ARC, "arcs")
                line = self._marker(group, number, Marker.LINE_STRIP, (0.08, 0.0, 0.0), color)
                start, end = line.points = [
                    _point_message(self._area_poses[a].mean),
                    _point_message(self._area_poses[b].mean),
                ]
                belief = PoseGaussian.from_pose(self._area_poses[a].mean).compose(arc.pose)
                middle = Point(x=0.5 * (start.x + end.x), y=0.5 * (start.y + end.y))
                text = f"Area {b} seen from {a}: {_deviation_text(arc.pose)}{', closed a loop' * arc.closure}"
                markers += [line, *self._ellipse_markers("arc_uncertainty", number, belief, middle, color, text)]
        return MarkerArray(markers=markers)

    def _ellipse_markers(
        self, group: str, number: int, belief: PoseGaussian, at: Point, color: ColorRGBA, text: str
    ) -> list[Marker]:
        """The 95 % ellipse of a pose, none for an uninformative one, which would hide the map."""
        if is_uninformative(belief):
            return []
        ellipse = belief.position_ellipse()
        faint = ColorRGBA(r=color.r, g=color.g, b=color.b, a=_ELLIPSE_OPACITY)
        size = (max(2.0 * ellipse.semi_major, _MIN_SIZE), max(2.0 * ellipse.semi_minor, _MIN_SIZE), 0.02)
        marker = self._marker(group, number, Marker.CYLINDER, size, faint)
        marker.pose.position, marker.pose.orientation, marker.text = at, quaternion_message(ellipse.angle), text
        return [marker]

    def _marker(self, group: str, number: int, kind: int, size: tuple[float, float, float], color: ColorRGBA) -> Marker:
        marker = Marker(header=header_message(self.stamp, self.frame), ns=group, id=number, type=kind, color=color)
        marker.scale = Vector3(x=size[0], y=size[1], z=size[2])
        marker.pose.orientation.w = 1.0
        return marker


def grid_message(stamp: int, frame: str, image: Any) -> OccupancyGrid:  # noqa: ANN401  an OccupancyImage, see grid()
    """ROS occupancy grid of an image: row 0 has the smallest y; 100 is occupied, 0 free, -1 unknown."""
    from hmt_slam_ros.grids.occupancy_map import FREE, OCCUPIED  # noqa: PLC0415

    pixels = image.pixels[::-1]
    cells = np.full(pixels.shape, -1, dtype=np.int8)
    cells[pixels == OCCUPIED] = 100
    cells[pixels == FREE] = 0
    info = MapMetaData(
        map_load_time=time_message(stamp), resolution=image.resolution, width=cells.shape[1], height=cells.shape[0]
    )
    info.origin.position.x, info.origin.position.y = image.origin.tolist()
    info.origin.orientation.w = 1.0
    return OccupancyGrid(header=header_message(stamp, frame), info=info, data=array("b", cells.tobytes()))


def _deviation_text(belief: PoseGaussian) -> str:
    """Standard deviations of a pose: the largest of its position, and that of its heading."""
    heading_deviation = math.degrees(math.sqrt(belief.covariance[2, 2]))
    return f"±{belief.position_ellipse().semi_major / ELLIPSE_95:.2f} m, ±{heading_deviation:.1f}°"


def _point_message(pose: NDArray[np.float64]) -> Point:
    return Point(x=float(pose[0]), y=float(pose[1]))
