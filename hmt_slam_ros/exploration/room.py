"""Where a robot is in a room that it entered by a door, by the map of the room's area.

Tomatis, Nourbakhsh and Siegwart (2003), sections 3.4 and 3.6: the metric filter starts with the first two moments of
what the door tells of the robot's pose. The map stays as it is.
"""

from __future__ import annotations

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.exploration.destinations import KnownBuilding
from hmt_slam_ros.local_map.filters import new_filter
from hmt_slam_ros.local_map.local_filter import PlacedKeyframe
from hmt_slam_ros.local_map.local_mapping import LocalMapping
from hmt_slam_ros.local_map.sighting import Sighting
from hmt_slam_ros.places.switching import MetricStart
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.sensing.motion import NO_STEP, Prediction, Step


class RoomFilter:
    """The metric filter of a room.

    :ivar area: in whose frame it is.
    """

    def __init__(self, mapping: LocalMapping, known: KnownBuilding, start: MetricStart) -> None:
        self.area = start.area
        self._mapping = mapping
        content = [
            PlacedKeyframe(keyframe, start.area, known.scans[keyframe], pose)
            for keyframe, pose in known.surroundings(start.area).items()
        ]
        self._filter = new_filter(mapping, 0, start.area)
        self._filter.change_area(start.area, NO_STEP.increment, content)
        self._filter.stand(start.pose)
        self._step = NO_STEP

    @property
    def pose(self) -> Float64:
        """``area_T_base``, shape (3,)."""
        return self._filter.pose

    def moved(self, step: Step) -> None:
        """The robot moved."""
        self._step = self._step.then(step)

    def observe(self, scan: Scan) -> None:
        """Correct the pose by a scan."""
        self._filter.track(Sighting(self._mapping, scan), Prediction(self._step, self._step, self._step))
        self._step = NO_STEP

    def release(self) -> None:
        """Give the map up."""
        self._filter.release()
