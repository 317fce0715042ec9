"""Drives for the landmarks of areas, and the true ones around many places."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.landmark_scans import LASERS, keyframes_of
from benchmark.landmark_truth import World, alike
from benchmark.simulated.worlds import World as Drive
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.landmarks import Features
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.landmark import Landmark
from hmt_slam_ros.landmarks.landmarks import INNER, OPENING, OUTER
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.simulation.scenario import Scenario

Array = NDArray[np.float64]

WITHIN, TURN = (0.3, 0.5), 0.5
"""m, of corners and openings, and rad: how far from a true one a landmark is, at most, that is one."""


class TrueLandmarks(NamedTuple):
    """True landmarks in one frame.

    :ivar kinds: shape (n,).
    :ivar poses: shape (n, 3), m and rad.
    :ivar due: shape (n,), from how many places one had to be found.
    """

    kinds: NDArray[np.int64]
    poses: Array
    due: NDArray[np.int64]


class Visit:
    """The first round of a drive: its keyframes."""

    def __init__(self, drive: Drive, laser: str, visit: int, configuration: Configuration) -> None:
        name = ",".join(filter(None, (drive.log, LASERS[laser], f"visit={visit},changed=1,laps=1")))
        self.scenario: Scenario = open_simulated(name).scenario
        poses = self.scenario.true_poses(self.scenario.scan_stamps)
        self.numbers = keyframes_of(poses, configuration)
        self.poses = poses[self.numbers]

    def world(self, k: int) -> World:
        """What is around a keyframe."""
        return World(self.scenario, int(self.scenario.scan_stamps[self.numbers[k]]), self.poses[k])


def truth_of(visit: Visit, keyframes: Sequence[int], every: int, frame: Array, features: Features) -> TrueLandmarks:
    """All that is true around keyframes, each once.

    :param every: one keyframe of so many is asked what had to be found from there.
    """
    kinds: list[int] = []
    due: list[int] = []
    poses = np.zeros((0, 3))
    for number, k in enumerate(keyframes):
        world, asked = visit.world(k), number % every == 0
        corners, openings = world.corners(features), world.openings(features)
        own = np.where(corners.kinds > 0.0, OUTER, INNER).tolist() + [OPENING] * len(openings.poses)
        local = np.concatenate((corners.poses, openings.poses))
        shown = (asked & np.concatenate((corners.due, openings.due))).tolist()
        for kind, pose, is_due in zip(own, se2.compose(se2.between(frame, visit.poses[k]), local), shown, strict=True):
            known = np.flatnonzero(alike(poses, pose, 0.05, 0.1) & (np.array(kinds, dtype=np.int64) == kind))
            if known.size:
                due[int(known[0])] += is_due
            else:
                kinds.append(kind)
                due.append(int(is_due))
                poses = np.concatenate((poses, pose[None]))
    return TrueLandmarks(np.array(kinds, dtype=np.int64), poses, np.array(due, dtype=np.int64))


def matching(landmark: Landmark, truth: TrueLandmarks) -> NDArray[np.bool_]:
    """Which true landmarks one of a map may be."""
    near = alike(truth.poses, landmark.pose.mean, WITHIN[landmark.kind == OPENING], TURN)
    return np.asarray(near & (truth.kinds == landmark.kind))
