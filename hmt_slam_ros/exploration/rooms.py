"""Rooms behind the doors of a chart to which a robot may be sent, and where it is in one of them.

Tomatis, Nourbakhsh and Siegwart (2003), sections 3.4 and 3.6: the metric filter starts with the first two moments of
what the door tells of the robot's pose. The map stays as it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.tree import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.surroundings import Neighborhood, areas_around, stack_poses
from hmt_slam_ros.landmarks.line_filter import FilterSelector
from hmt_slam_ros.places.area_views import AreaViewCache
from hmt_slam_ros.places.chart import DOOR, Chart, build_chart
from hmt_slam_ros.places.floor import SideOpening
from hmt_slam_ros.places.place_graph import DIRECTION_NAMES, PlaceGraph
from hmt_slam_ros.places.policy import MetricInitialPose
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.motion_model import NO_MOTION, Prediction, RelativeMotion
from hmt_slam_ros.submap.local_filter import PlacedKeyframe
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan

# Areas whose place is known this well, m, and whose keyframes are this near, m, are the surroundings of an area.
_NEARNESS = Neighborhood(0.3, 3.0)
# A keyframe so far behind a door, m, and beside its middle up to this share of that, was taken in the door's room.
_BEHIND, _ASIDE = (0.8, 4.0), 0.6


@dataclass(frozen=True, eq=False)
class KnownBuilding:
    """A map with its places.

    :ivar chart: of the map.
    :ivar graph: of the chart.
    :ivar hybrid_map: the map.
    :ivar scans: {keyframe: scan}.
    """

    chart: Chart
    graph: PlaceGraph
    hybrid_map: HybridMap
    scans: Mapping[int, Scan]

    @classmethod
    def from_map(cls, hybrid_map: HybridMap, scans: Mapping[int, Scan], configuration: Configuration) -> KnownBuilding:
        """Make the chart of a map.

        :raises HmtSlamError: where no place is in it.
        """
        views = AreaViewCache(LocalMapping(configuration), scans).views_of_map(hybrid_map)
        chart = build_chart(hybrid_map, views, configuration.features)
        if not chart.edges:
            raise HmtSlamError(
                "the map has no door or crossing along a hallway, so that there is no place to be at: map a building "
                "along its hallways, and see places.json of hmt_slam export"
            )
        return cls(chart, chart.graph(configuration.places), hybrid_map, scans)

    def keyframe_poses_around(self, area: int) -> dict[int, Float64]:
        """{keyframe: ``area_T_base`` (3,)} of an area and those around it."""
        around = areas_around(self.hybrid_map, area, _NEARNESS)
        return {
            keyframe: se2.compose(frame.mean, pose)
            for other, frame in around.items()
            for keyframe, pose in self.hybrid_map.keyframes(other).items()
        }


class Destination(NamedTuple):
    """A place in a room.

    :ivar node: before the room's door.
    :ivar opening: the door.
    :ivar position: shape (2,), in the frame of the opening's area, m.
    """

    node: int
    opening: SideOpening
    position: Float64

    @property
    def pose(self) -> Float64:
        """Of a robot that comes there straight from the door, in the same frame, shape (3,)."""
        x, y = self.position - self.opening.landmark.pose.mean[:2]
        return np.array((*self.position, math.atan2(y, x)))


def destinations(known: KnownBuilding) -> dict[int, Destination]:
    """{node: the place behind its door}, where the robot was farthest in the room; of doors that it passed."""
    return {destination.node: destination for destination in _all_destinations(known)}


def named_destinations(known: KnownBuilding) -> dict[str, Destination]:
    """{name: the place in it}; "room 3" is behind "door 3", with a direction where there is one on either side."""
    found = list(_all_destinations(known))
    nodes = [destination.node for destination in found]
    return {
        f"room {one.node}" + f" {DIRECTION_NAMES[one.opening.direction]}" * (nodes.count(one.node) > 1): one
        for one in found
    }


def _all_destinations(known: KnownBuilding) -> Iterator[Destination]:
    """Those to whose doors a way leads; a door seen from within its room is a node by itself."""
    reached = {edge.end for edge in known.chart.edges}
    for number, node in enumerate(known.chart.nodes):
        for opening in node.openings if node.kind == DOOR and number in reached else ():
            place = _position_behind(known, opening)
            if place is not None:
                yield Destination(number, opening, place)


def _position_behind(known: KnownBuilding, opening: SideOpening) -> Float64 | None:
    poses = stack_poses(known.keyframe_poses_around(opening.area))
    there = se2.transform(se2.inverse(opening.landmark.pose.mean), poses[:, :2])
    within = (_BEHIND[0] <= there[:, 0]) & (there[:, 0] <= _BEHIND[1])
    within &= np.abs(there[:, 1]) <= _ASIDE * there[:, 0]
    if not within.any():
        return None
    return np.asarray(poses[int(np.argmax(np.where(within, there[:, 0], -np.inf))), :2])


class RoomFilter:
    """The metric filter of a room.

    :ivar area: in whose frame it is.
    """

    def __init__(self, mapping: LocalMapping, known: KnownBuilding, start: MetricInitialPose) -> None:
        self.area = start.area
        self._mapping = mapping
        content = [
            PlacedKeyframe(keyframe, start.area, known.scans[keyframe], pose)
            for keyframe, pose in known.keyframe_poses_around(start.area).items()
        ]
        self._filter = FilterSelector(mapping).new(0, start.area)
        self._filter.change_area(start.area, NO_MOTION.increment, content)
        self._filter.initialize(start.pose)
        self._pending_step = NO_MOTION

    @property
    def pose(self) -> Float64:
        """``area_T_base``, shape (3,)."""
        return self._filter.pose

    def predict(self, step: RelativeMotion) -> None:
        """The robot moved."""
        self._pending_step = self._pending_step.compose(step)

    def observe(self, scan: Scan) -> None:
        """Correct the pose by a scan."""
        self._filter.track(
            PreparedScan(self._mapping, scan), Prediction(self._pending_step, self._pending_step, self._pending_step)
        )
        self._pending_step = NO_MOTION

    def release(self) -> None:
        """Give the map up."""
        self._filter.release()
