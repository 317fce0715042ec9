"""A small floor: a hallway with two doors, one opposite the other, a third one, and a crossing; and its chart."""

import math

import numpy as np
from worlds import scan_at

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.places.area_views import AreaViewCache
from hmt_slam_ros.places.chart import build_chart
from hmt_slam_ros.simulation.building import FloorPlan
from hmt_slam_ros.submap.local_mapping import LocalMapping

CONFIGURATION = Configuration()
# The world's pose of the second area, which begins behind the first door, and where the building stands.
AREAS = {0: np.zeros(3), 1: np.array([9.0, 0.3, 2.0])}
BUILDING = np.array([3.0, -2.0, 0.4])


def walls():
    """A hallway along x from 0 to 22 m, doors to the north at 5 m, on both sides at 10 m, another hallway at 16 m."""
    plan = FloorPlan()
    plan.cut_rectangle(0.0, -1.0, 22.0, 1.0)
    plan.cut_rectangle(15.0, 1.0, 17.0, 12.0)
    for x, side in ((5.0, 1.0), (10.1, 1.0), (9.9, -1.0)):
        plan.cut_rectangle(x - 0.5, min(side, 1.3 * side), x + 0.5, max(side, 1.3 * side))
        plan.cut_rectangle(x - 2.0, min(1.2 * side, 5.0 * side), x + 2.0, max(1.2 * side, 5.0 * side))
    found = plan.walls()
    return np.concatenate([se2.transform(BUILDING, found[:, k : k + 2]) for k in (0, 2)], axis=1)


def keyframes(crossing_driven=True):
    """Along the hallway, into the first room and up the other hallway."""
    places = [(x, 0.1, 0.0) for x in np.arange(1.0, 21.2, 0.5)]
    places += [(5.0, y, 0.5 * math.pi) for y in np.arange(0.5, 3.2, 0.5)]
    if crossing_driven:
        places += [(16.0, y, 0.5 * math.pi) for y in np.arange(0.5, 11.2, 0.5)]
    return np.array(places)


def seen_at(pose, rng, barred=None):
    """The scan at a pose (3,) of the floor, the hallway being barred there, m along it, where it is."""
    bar = np.array([[barred, -1.0, barred, 1.0]] if barred else []).reshape(-1, 2)
    surfaces = np.concatenate((walls(), se2.transform(BUILDING, bar).reshape(-1, 4)))
    return scan_at(surfaces, se2.compose(BUILDING, pose), 0.01, rng, 720)


def make_chart(crossing_driven=True, again=()):
    """The chart, the map that it is of, and what its areas show.

    :param again: places, m along the hallway, where the robot looks once more afterwards, and where it is barred then.
    """
    hybrid_map, scans = make_map(crossing_driven)
    rng = np.random.default_rng(2)
    for x, barred in again:
        keyframe, area, pose = len(scans), int(x > 8.0), np.array([x, 0.1, 0.0])
        hybrid_map.set_keyframe(keyframe, area, se2.between(AREAS[area], pose))
        scans[keyframe] = seen_at(pose, rng, barred)
    views = AreaViewCache(LocalMapping(CONFIGURATION), scans).views_of_map(hybrid_map)
    return build_chart(hybrid_map, views, CONFIGURATION.features), hybrid_map, views


def make_map(crossing_driven=True):
    """The map and its scans."""
    hybrid_map, scans, rng = HybridMap(), {}, np.random.default_rng(1)
    for k, pose in enumerate(keyframes(crossing_driven)):
        area = int(pose[0] > 8.0)
        hybrid_map.set_keyframe(k, area, se2.between(AREAS[area], pose))
        scans[k] = seen_at(pose, rng)
    arc = se2.between(AREAS[0], AREAS[1])
    hybrid_map.set_arc(0, 1, PoseGaussian(arc, np.diag([0.03, 0.03, 0.003]) ** 2), closure=False)
    return hybrid_map, scans
