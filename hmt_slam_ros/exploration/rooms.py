"""Rooms behind the doors of a chart: destinations in them, and the metric filter of a robot there.

Tomatis, Nourbakhsh and Siegwart (2003), sections 3.4 and 3.6: the metric filter starts with the first two moments of
the robot's pose by the door. It does not change the map.
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
from hmt_slam_ros.sensors.motion_model import Prediction
from hmt_slam_ros.sensors.relative_motion import NO_MOTION, RelativeMotion
from hmt_slam_ros.submap.local_filter import PlacedKeyframe
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan

_NEIGHBORHOOD = Neighborhood(0.3, 3.0)
"""Areas around one: deviation of their position, m, and distance of their keyframes, m, at most."""

_DISTANCES_BEHIND = (0.8, 4.0)
"""Smallest and largest distance behind a door of a keyframe in its room, m."""

_MAX_SLOPE = 0.6
"""Largest lateral offset of such a keyframe from the door's middle, as a share of its distance behind the door."""


@dataclass(frozen=True, eq=False)
class KnownBuilding:
    """A map with its places.

    :ivar chart: of the map.
    :ivar graph: place graph of the chart.
    :ivar hybrid_map: the map.
    :ivar scans: {keyframe: scan}.
    """

    chart: Chart
    graph: PlaceGraph
    hybrid_map: HybridMap
    scans: Mapping[int, Scan]

    @classmethod
    def from_map(cls, hybrid_map: HybridMap, scans: Mapping[int, Scan], configuration: Configuration) -> KnownBuilding:
        """The places of a map.

        :raises HmtSlamError: for a map without places.
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
        around = areas_around(self.hybrid_map, area, _NEIGHBORHOOD)
        return {
            keyframe: se2.compose(frame.mean, pose)
            for other, frame in around.items()
            for keyframe, pose in self.hybrid_map.keyframes(other).items()
        }


class Destination(NamedTuple):
    """A place in a room.

    :ivar node: before the room's door.
    :ivar opening: the door.
    :ivar keyframe: at that place.
    :ivar position: shape (2,), of the keyframe in the frame of the opening's area, m.
    """

    node: int
    opening: SideOpening
    keyframe: int
    position: Float64

    @property
    def pose(self) -> Float64:
        """Pose of a robot that comes straight from the door, in the same frame, shape (3,), m and rad."""
        x, y = self.position - self.opening.landmark.pose.mean[:2]
        return np.array((*self.position, math.atan2(y, x)))


def destinations(known: KnownBuilding) -> dict[int, Destination]:
    """{node: destination behind its door} of doors that the robot passed, at the farthest keyframe in the room."""
    return {destination.node: destination for destination in _all_destinations(known)}


def named_destinations(known: KnownBuilding, numbers: Mapping[int, int]) -> dict[str, Destination]:
    """{name: destination}: "room 3" has the number that it has for the explorer, which begins with this map.

    A further door of a room is "room 3 by door 7". What the explorer takes for a hallway has a number after the rooms.

    :param numbers: {keyframe: number of its room}, of the explorer's roadmap.
    """
    named: dict[str, Destination] = {}
    further = max(numbers.values(), default=0)
    for each in _all_destinations(known):
        if each.keyframe not in numbers:
            further += 1
        room = f"room {numbers.get(each.keyframe, further)}"
        door = f"{room} by door {each.node}"
        names = (room, door, f"{door} {DIRECTION_NAMES[each.opening.direction]}")
        named[next(name for name in names if name not in named)] = each
    return named


def _all_destinations(known: KnownBuilding) -> Iterator[Destination]:
    """The destinations behind doors with an edge; a door that only its room shows is a node without edges."""
    with_edge = {edge.end for edge in known.chart.edges}
    for number, node in enumerate(known.chart.nodes):
        for opening in node.openings if node.kind == DOOR and number in with_edge else ():
            farthest = _farthest_behind(known, opening)
            if farthest is not None:
                yield Destination(number, opening, *farthest)


def _farthest_behind(known: KnownBuilding, opening: SideOpening) -> tuple[int, Float64] | None:
    """The farthest keyframe behind an opening, and its position, m, shape (2,); None for none."""
    around = known.keyframe_poses_around(opening.area)
    poses = stack_poses(around)
    ahead, lateral = se2.transform(se2.inverse(opening.landmark.pose.mean), poses[:, :2]).T
    nearest, farthest = _DISTANCES_BEHIND
    within = (nearest <= ahead) & (ahead <= farthest) & (np.abs(lateral) <= _MAX_SLOPE * ahead)
    if not within.any():
        return None
    row = int(np.argmax(np.where(within, ahead, -np.inf)))
    return list(around)[row], np.asarray(poses[row, :2])


class RoomFilter:
    """The metric filter of a room.

    :ivar area: of its frame.
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
        """Move the robot."""
        self._pending_step = self._pending_step.compose(step)

    def observe(self, scan: Scan) -> None:
        """Correct the pose by a scan."""
        step = self._pending_step
        self._filter.track(PreparedScan(self._mapping, scan), Prediction(step, step, step))
        self._pending_step = NO_MOTION

    def release(self) -> None:
        """Release the filter."""
        self._filter.release()
