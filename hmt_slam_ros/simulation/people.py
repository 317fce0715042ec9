"""People who walk to and fro on the robot's way, and step aside for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.random_streams import Purpose, stream
from hmt_slam_ros.simulation.driver import Drive

_RADIUS = 0.2  # m
_BERTH = 0.8  # m, from the robot's middle to a person's
_SLOW, _FAST = 0.7, 1.4  # m/s
_SPAN = 20.0  # m, that a person walks at most before turning back
_ASIDE = 0.25  # m, of the robot's way at most


@dataclass(frozen=True, eq=False)
class People:
    """Persons who each walk on a part of the robot's way; all arrays of shape (k,).

    :ivar drive: whose way it is.
    :ivar begins: where each part begins on the way, m.
    :ivar spans: length of each part, m.
    :ivar speeds: m/s.
    :ivar phases: where each person is at first, m.
    :ivar asides: how far each walks to the left of the way, m.
    """

    drive: Drive
    begins: NDArray[np.float64]
    spans: NDArray[np.float64]
    speeds: NDArray[np.float64]
    phases: NDArray[np.float64]
    asides: NDArray[np.float64]

    def discs(self, seconds: float, robot: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where they are, (k, 3) as x, y and radius, m; whoever is too near the robot, (3,), is beside it."""
        path = self.drive.path
        walked = np.mod(self.phases + self.speeds * seconds, 2.0 * self.spans)
        along = self.begins + np.minimum(walked, 2.0 * self.spans - walked)
        ends = np.cumsum(path.lengths)
        along = np.clip(along, 0.0, ends[-1] * (1.0 - 1e-12))
        stretch = np.searchsorted(ends, along, side="right")
        poses = path.pose(stretch, along - (ends - path.lengths)[stretch])
        left = np.stack((-np.sin(poses[:, 2]), np.cos(poses[:, 2])), axis=1)
        places = poses[:, :2] + self.asides[:, None] * left
        away = places - robot[:2]
        distances = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-6)
        places = robot[:2] + away * np.maximum(1.0, _BERTH / distances)[:, None]
        return np.concatenate((places, np.full((len(places), 1), _RADIUS)), axis=1)


def people_on(drive: Drive, count: int, seed: int) -> People:
    """Draw where a number of persons walk."""
    total = float(drive.path.lengths.sum())
    rows = []
    for person in range(count):
        draw = stream(seed, Purpose.PEOPLE, person)
        span = min(total, draw.uniform(0.3 * _SPAN, _SPAN))
        begin, phase = draw.uniform(0.0, total - span), draw.uniform(0.0, 2.0 * span)
        rows.append((begin, span, draw.uniform(_SLOW, _FAST), phase, draw.uniform(-_ASIDE, _ASIDE)))
    return People(drive, *np.array(rows).reshape(-1, 5).T)
