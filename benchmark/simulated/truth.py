"""The truth of a simulated run: poses of keyframes, same places, errors of placements, and passed doors.

The true pose of an area follows from the keyframe nearest to its origin, with which the area began. The error of a
placement of keyframes in a known area is that between the two keyframes that truly are nearest to each other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.landmark_truth import Surroundings
from hmt_slam_ros.area_abstraction.doors import MAX_STEP, find_crossings
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.landmarks.area_landmarks import AreaLandmarkExtractor
from hmt_slam_ros.landmarks.portals import find_portals
from hmt_slam_ros.messages.messages import Keyframe
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation import SimulatedLog
from hmt_slam_ros.simulation.building import Building
from hmt_slam_ros.submap.local_mapping import LocalMapping

Pose = Float64

RADIUS = 2.0
"""Largest distance of keyframes in the same place, which also see each other, m: ``tsbi.place_radius``."""

TOLERANCE = 0.25
"""Part of the radius within which both answers on "the same place" count as right."""

NEAR, FAR, TURN = 0.5, 2.0, 10.0
"""Largest error of a true placement, m and degrees: ``NEAR``, or ``FAR`` if its covariance admits the error."""

_ADMITTED = 16.27  # chi-square with 3 degrees of freedom at 99.9 %

# Covariance of keyframes within their areas, which is not part of that of a placement: m, m, rad.
_WITHIN_AREAS = np.diag([0.1, 0.1, np.radians(1.0)]) ** 2


# Largest distance of keyframes that see a portal, m.
_AROUND = 2.0


class PlacementError(NamedTuple):
    """The error of a placement of keyframes in a known area.

    :ivar pair: the two keyframes of the error, the known one first.
    :ivar distances: true distance of the two, m.
    :ivar same_place: whether they are within the radius with its tolerance, and see each other.
    :ivar translation: error of their relative pose, m.
    :ivar rotation: likewise, degrees.
    :ivar mahalanobis2: squared, of that error under the covariance of the placement.
    """

    pair: tuple[int, int]
    apart: float
    same_place: bool
    translation: float
    rotation: float
    mahalanobis2: float

    @property
    def true(self) -> bool:
        """Whether the placement is true."""
        admitted = self.translation <= FAR and self.mahalanobis2 <= _ADMITTED
        return self.same_place and self.rotation <= TURN and (self.translation <= NEAR or admitted)


def placement_error(
    pair: tuple[int, int], poses: tuple[Pose, Pose], true: Pose, placement: PoseGaussian, *, same_place: bool
) -> PlacementError:
    """The error of a placement, between two keyframes.

    :param pair: the two, the known one first.
    :param poses: ``area_T_base`` of both in the known area, each of shape (3,).
    :param true: pose of the second in the frame of the first, shape (3,).
    :param placement: belief over ``area_T_origin``, where the second keyframe is fixed to the origin.
    :param same_place: whether the two are in the same place.
    """
    error = se2.between(se2.between(*poses), true)
    moved = PoseGaussian(se2.between(placement.mean, poses[1]), np.zeros((3, 3)))
    xi = se2.log(error)
    return PlacementError(
        pair,
        float(np.hypot(true[0], true[1])),
        same_place,
        float(np.hypot(error[0], error[1])),
        float(np.degrees(abs(error[2]))),
        float(xi @ np.linalg.solve(placement.compose(moved).covariance + _WITHIN_AREAS, xi)),
    )


class Truth:
    """The truth about the keyframes of a run.

    :ivar log: the simulated log.
    :ivar stamps: {keyframe: of its scan, ns}.
    :ivar poses: {keyframe: ``world_T_base``, shape (3,)}.
    """

    def __init__(self, log: SimulatedLog) -> None:
        self.log = log
        self.stamps: dict[int, int] = {}
        self.poses: dict[int, Pose] = {}

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Add a keyframe event."""
        self.stamps[keyframe.sequence] = keyframe.scan.stamp
        self.poses[keyframe.sequence] = self.log.true_poses(np.array([keyframe.scan.stamp]))[0]

    def same_place(self, keyframes: Sequence[int], others: Sequence[int], radius: float = RADIUS) -> NDArray[np.bool_]:
        """Which of n keyframes are in the same place as which of m others, shape (n, m)."""
        return self.log.same_place(self._stamps(keyframes), self._stamps(others), radius)

    def shared_view(self, keyframe: int, others: Sequence[int]) -> Float64:
        """Share of a keyframe's view that each of the others has too, shape (m,), from 0 to 1."""
        shares = self.log.shared_view(self._stamps([keyframe]), self._stamps(others))
        return np.asarray(shares[0], dtype=np.float64)

    def share_in(self, keyframes: Sequence[int], known: Sequence[int], radius: float) -> float:
        """Share of the keyframes in the same place as any of the known ones."""
        return float(np.mean(self.same_place(keyframes, known, radius).any(axis=1))) if len(known) else 0.0

    def frame(self, hybrid_map: HybridMap, area: int) -> Pose:
        """``world_T_area``."""
        poses = hybrid_map.keyframes(area)
        first = min(poses, key=lambda keyframe: (_from_origin(poses[keyframe]), keyframe))
        return se2.compose(self.poses[first], se2.inverse(poses[first]))

    def assess(
        self, known: Mapping[int, Pose], query: Mapping[int, Pose], covariance: Float64, origin: Pose
    ) -> PlacementError:
        """The error of a placement of keyframes in a known area.

        :param known: {keyframe: ``area_T_base``} of the area.
        :param query: likewise of the keyframes in question.
        :param covariance: of the placement, right tangent of ``area_T_origin``, shape (3, 3).
        :param origin: ``area_T_origin``, shape (3,).
        """
        true_known, true_asked = (np.array([self.poses[k] for k in poses]) for poses in (known, query))
        apart = np.hypot(*(true_known[:, None, :2] - true_asked[None, :, :2]).transpose(2, 0, 1))
        same = self.same_place(list(known), list(query), (1.0 + TOLERANCE) * RADIUS)
        # A wall may be between the nearest two.
        k, m = np.unravel_index(np.argmin(np.where(same, apart, apart + 1e6)), apart.shape)
        pair, poses = (list(known)[k], list(query)[m]), (list(known.values())[k], list(query.values())[m])
        true = se2.between(true_known[k], true_asked[m])
        return placement_error(pair, poses, true, PoseGaussian(origin, covariance), same_place=bool(same[k, m]))

    def _stamps(self, keyframes: Sequence[int]) -> NDArray[np.int64]:
        return np.array([self.stamps[keyframe] for keyframe in keyframes], dtype=np.int64)


def _from_origin(pose: Pose) -> float:
    """Distance from the origin, m, where a radian of turn counts as a meter."""
    return float(np.hypot(pose[0], pose[1]) + abs(pose[2]))


def nees(belief: PoseGaussian, truth: Pose) -> float:
    """Normalized estimation error squared: chi-square with 3 degrees of freedom for a consistent belief.

    :param truth: true pose, shape (3,).
    """
    xi = se2.log(se2.between(belief.mean, truth))
    return float(xi @ np.linalg.solve(belief.covariance, xi))


class Doors(NamedTuple):
    """Open doors, or crossings of hallways.

    :ivar poses: shape (n, 3), the middles of the openings, m, with the heading through them, rad.
    :ivar widths: shape (n,), m.
    :ivar middles: shape (n, 2), the center of a crossing, or the middle of a door, m.
    :ivar halves: shape (n,), distance from there to the border of a crossing, m; 0 for a door.
    """

    poses: Float64
    widths: Float64
    middles: Float64
    halves: Float64

    def select_passed(self, path: Float64) -> Doors:
        """The openings that a path (n, 2) passes."""
        openings = zip(self.poses, self.widths, strict=True)
        chosen = np.array([any(find_crossings(path, *opening)) for opening in openings], dtype=np.bool_)
        return Doors(*(column[chosen] for column in self))

    def distances(self, places: Float64) -> Float64:
        """Distances (n, m) of places (m, 2) from them, m."""
        away = np.hypot(*(self.middles[:, None] - places[None]).transpose(2, 0, 1))
        return np.asarray(np.maximum(0.0, away - self.halves[:, None]))


def doors_of(building: Building) -> Doors:
    """The open doors of a building."""
    ends = building.doors.reshape(-1, 2, 2)
    along, middles = ends[:, 1] - ends[:, 0], ends.mean(axis=1)
    poses = np.column_stack((middles, np.arctan2(along[:, 1], along[:, 0]) + 0.5 * math.pi))
    return Doors(poses, np.hypot(*along.T), middles, np.zeros(len(poses)))


def crossings_of(building: Building) -> Doors:
    """The crossings of hallways of a building."""
    states, own = building.states, building.states.crossings
    return Doors(states.openings[own], states.widths[own], states.poses[own, :2], states.ahead[own])


def score_openings(
    truth: Truth, hybrid_map: HybridMap, scans: Mapping[int, Scan], configuration: Configuration
) -> dict[str, Any]:
    """Distances of the openings that the robot passed from area changes and portals, m, inf for nothing in reach.

    :param hybrid_map: of the run.
    :returns: ``changes``, of each area change along the path from a door or crossing; ``doors`` and ``crossings`` that
        were passed, from an area change; ``portals``, from any true gap between walls; and ``doors_portals``, of each
        door from a portal.
    """
    scenario = truth.log.scenario
    path, building = scenario.poses[:, :2], scenario.building
    passed, crossed = doors_of(building).select_passed(path), crossings_of(building).select_passed(path)
    changes = _area_changes(truth, hybrid_map)
    portals = _portal_places(truth, hybrid_map, scans, configuration)
    to_changes = np.concatenate((passed.distances(changes), crossed.distances(changes)))
    return {
        "areas": len(hybrid_map.area_ids()),
        "changes": to_changes.min(axis=0, initial=math.inf).tolist(),
        "doors": passed.distances(changes).min(axis=1, initial=math.inf).tolist(),
        "crossings": crossed.distances(changes).min(axis=1, initial=math.inf).tolist(),
        "portals": [_distance_from_gap(truth, place, configuration) for place in portals],
        "doors_portals": passed.distances(portals).min(axis=1, initial=math.inf).tolist(),
    }


def _area_changes(truth: Truth, hybrid_map: HybridMap) -> Float64:
    """True positions (n, 2) of area changes along the path, each between two keyframes."""
    path = sorted((k, area) for area in hybrid_map.area_ids() for k in hybrid_map.keyframes(area))
    ends = [(truth.poses[a][:2], truth.poses[b][:2]) for (a, left), (b, entered) in pairwise(path) if left != entered]
    return np.array([0.5 * (a + b) for a, b in ends if np.hypot(*(a - b)) <= MAX_STEP]).reshape(-1, 2)


def _portal_places(
    truth: Truth, hybrid_map: HybridMap, scans: Mapping[int, Scan], configuration: Configuration
) -> Float64:
    """Positions (n, 2) of the portals in the world, by the true frame of their first area."""
    known, landmarks = AreaLandmarkExtractor(LocalMapping(configuration)), {}
    for area in hybrid_map.area_ids():
        poses = hybrid_map.keyframes(area)
        landmarks[area] = known.extract([scans[k] for k in poses], np.array(list(poses.values())).reshape(-1, 3))
    portals = find_portals(hybrid_map, landmarks, configuration.features)
    frames = [truth.frame(hybrid_map, portal.areas[0]) for portal in portals]
    portal_poses = [se2.compose(frame, portal.pose_in_a.mean) for frame, portal in zip(frames, portals, strict=True)]
    return np.array(portal_poses).reshape(-1, 3)[:, :2]


def _distance_from_gap(truth: Truth, place: Float64, configuration: Configuration) -> float:
    """Distance of a position (2,) from the nearest gap between walls that keyframes around see, m."""
    least = math.inf
    for k, pose in truth.poses.items():
        if math.dist(pose[:2], place) <= _AROUND:
            gaps = Surroundings(truth.log.scenario, truth.stamps[k], pose).openings(configuration.features).poses
            away = se2.compose(pose, gaps)[:, :2] - place
            least = min(least, float(np.hypot(*away.T).min(initial=math.inf)))
    return least
