"""Where areas end and where portals are, against the true openings that a simulated robot passes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.landmark_truth import World
from benchmark.simulated.truth import Truth
from hmt_slam_ros.area_abstraction.doors import STEP, crossings
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.landmarks.area_landmarks import AreaLandmarks
from hmt_slam_ros.landmarks.portals import portals_of
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation.building import Building
from hmt_slam_ros.submap.local_mapping import LocalMapping

Array = NDArray[np.float64]


# Keyframes that are so near to a portal see what is true of it, m.
_AROUND = 2.0


class Doors(NamedTuple):
    """Open doors, or crossings of hallways.

    :ivar poses: shape (n, 3), the middles of the openings, m, with the heading through them, rad.
    :ivar widths: shape (n,), m.
    :ivar middles: shape (n, 2), from where it is as far to each of what bounds it: the middle of a crossing, else of
        the door, m.
    :ivar halves: shape (n,), how far that is, m; 0 of a door.
    """

    poses: Array
    widths: Array
    middles: Array
    halves: Array

    def passed(self, path: Array) -> Doors:
        """Those that a path (n, 2) passes."""
        each = zip(self.poses, self.widths, strict=True)
        chosen = np.array([any(crossings(path, *one)) for one in each], dtype=np.bool_)
        return Doors(*(column[chosen] for column in self))

    def apart(self, places: Array) -> Array:
        """Distances (n, m), m, of places (m, 2) from them."""
        away = np.hypot(*(self.middles[:, None] - places[None]).transpose(2, 0, 1))
        return np.asarray(np.maximum(0.0, away - self.halves[:, None]))


def doors_of(building: Building) -> Doors:
    """The open doors of a building."""
    ends = building.doors.reshape(-1, 2, 2)
    along, middles = ends[:, 1] - ends[:, 0], ends.mean(axis=1)
    poses = np.column_stack((middles, np.arctan2(along[:, 1], along[:, 0]) + 0.5 * math.pi))
    return Doors(poses, np.hypot(*along.T), middles, np.zeros(len(poses)))


def crossings_of(building: Building) -> Doors:
    """The crossings of hallways in a building in which they are counted."""
    states, own = building.states, building.states.crossings
    return Doors(states.openings[own], states.widths[own], states.poses[own, :2], states.ahead[own])


def doors(
    truth: Truth, hybrid_map: HybridMap, scans: Mapping[int, Scan], configuration: Configuration
) -> dict[str, Any]:
    """What came of the openings that the robot passed: distances, m, inf where there is nothing.

    :param hybrid_map: what was mapped, with its keyframes' scans.
    :returns: ``changes``, of each change of areas along the path from a door or crossing; ``doors`` and ``crossings``
        that were passed, from a change of areas each; ``portals``, from any true gap between walls, a door or not; and
        ``doors_portals``, of each door from a portal.
    """
    scenario = truth.log.scenario
    path, building = scenario.poses[:, :2], scenario.building
    passed, crossed = doors_of(building).passed(path), crossings_of(building).passed(path)
    changes = _changes(truth, hybrid_map)
    portals = _portals(truth, hybrid_map, scans, configuration)
    to_changes = np.concatenate((passed.apart(changes), crossed.apart(changes)))
    return {
        "areas": len(hybrid_map.area_ids()),
        "changes": to_changes.min(axis=0, initial=math.inf).tolist(),
        "doors": passed.apart(changes).min(axis=1, initial=math.inf).tolist(),
        "crossings": crossed.apart(changes).min(axis=1, initial=math.inf).tolist(),
        "portals": [_from_gap(truth, place, configuration) for place in portals],
        "doors_portals": passed.apart(portals).min(axis=1, initial=math.inf).tolist(),
    }


def _changes(truth: Truth, hybrid_map: HybridMap) -> Array:
    """True places (n, 2) where the path goes from one area into another, each between two keyframes."""
    path = sorted((k, area) for area in hybrid_map.area_ids() for k in hybrid_map.keyframes(area))
    ends = [(truth.poses[a][:2], truth.poses[b][:2]) for (a, left), (b, entered) in pairwise(path) if left != entered]
    return np.array([0.5 * (a + b) for a, b in ends if np.hypot(*(a - b)) <= STEP]).reshape(-1, 2)


def _portals(truth: Truth, hybrid_map: HybridMap, scans: Mapping[int, Scan], configuration: Configuration) -> Array:
    """Places (n, 2) of the portals in the world, by the true frame of the area that they are told in."""
    known, landmarks = AreaLandmarks(LocalMapping(configuration)), {}
    for area in hybrid_map.area_ids():
        placed = hybrid_map.keyframes(area)
        landmarks[area] = known.of([scans[k] for k in placed], np.array(list(placed.values())).reshape(-1, 3))
    portals = portals_of(hybrid_map, landmarks, configuration.features)
    frames = [truth.frame(hybrid_map, portal.areas[0]) for portal in portals]
    poses = [se2.compose(frame, one.pose_in_a.mean) for frame, one in zip(frames, portals, strict=True)]
    return np.array(poses).reshape(-1, 3)[:, :2]


def _from_gap(truth: Truth, place: Array, configuration: Configuration) -> float:
    """Distance of a place (2,) from the next gap that the walls have, as it shows from keyframes around, m."""
    least = math.inf
    for k, pose in truth.poses.items():
        if math.dist(pose[:2], place) <= _AROUND:
            gaps = World(truth.log.scenario, truth.stamps[k], pose).openings(configuration.features).poses
            away = se2.compose(pose, gaps)[:, :2] - place
            least = min(least, float(np.hypot(*away.T).min(initial=math.inf)))
    return least
