"""People who walk to and fro on the robot's route."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.simulation.drive import Drive

_RADIUS = 0.2
"""Radius of a person, m."""

_MIN_DISTANCE = 0.8
"""Smallest distance of a person's middle from the robot's, m."""

_MIN_SPEED, _MAX_SPEED = 0.7, 1.4
"""Slowest and fastest walk, m/s."""

_MAX_SPAN = 20.0
"""Longest walk before turning back, m."""

_STOP_DISTANCE = 1.0
"""Distance from an unpredictable robot at which a person stops, m."""

_MAX_WAIT = 2.0
"""Time after which a waiting person turns back, s."""

_MEMORY_TIME = 10.0
"""Time after turning back in which a person squeezes past the robot instead of turning again, s."""

_MAX_LATERAL_OFFSET = 0.25
"""Largest distance of a person's path from the robot's, m."""


@dataclass(frozen=True, eq=False)
class People:
    """People who each walk on a part of the robot's path; all arrays of shape (k,).

    :ivar drive: of the robot.
    :ivar begins: begin of each part on the path, m.
    :ivar spans: length of each part, m.
    :ivar speeds: m/s.
    :ivar phases: initial distance walked, m.
    :ivar lateral_offsets: of each person to the left of the path, m.
    """

    drive: Drive
    begins: NDArray[np.float64]
    spans: NDArray[np.float64]
    speeds: NDArray[np.float64]
    phases: NDArray[np.float64]
    lateral_offsets: NDArray[np.float64]

    def discs_at(self, seconds: float, robot: NDArray[np.float64]) -> NDArray[np.float64]:
        """People at a time, (k, 3) as x, y and radius, m; those too near the robot, (3,), are pushed aside."""
        return _discs(_push_away(self.positions(self.phases + self.speeds * seconds), robot))

    def positions(self, walked: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions (k, 2) after walking distances (k,) to and fro, m."""
        path = self.drive.path
        walked = np.mod(walked, 2.0 * self.spans)
        along = self.begins + np.minimum(walked, 2.0 * self.spans - walked)
        along = np.clip(along, 0.0, path.ends[-1] * (1.0 - 1e-12))
        segments = np.searchsorted(path.ends, along, side="right")
        poses = path.poses_at(segments, along - path.begins[segments])
        poses[:, 0] -= self.lateral_offsets * np.sin(poses[:, 2])
        poses[:, 1] += self.lateral_offsets * np.cos(poses[:, 2])
        return poses[:, :2]


class ReactivePeople:
    """People who react to a robot with an unknown path.

    A person who would come too near the robot stops. If the robot stays, the person turns back. If it is in the way
    back, too, the person squeezes past it, even through a wall.

    :ivar discs: shape (k, 3), x, y and radius now, m.
    """

    def __init__(self, people: People) -> None:
        self._people = people
        self._walked = people.phases.copy()
        self._waited = np.zeros_like(self._walked)
        self._squeezing = np.zeros(len(self._walked), dtype=np.bool_)
        self._memory_times = np.zeros_like(self._walked)
        self.discs = _discs(people.positions(self._walked))

    def walk(self, seconds: float, robot: NDArray[np.float64]) -> None:
        """Walk for a time, s, without reacting in between.

        :param robot: its pose, (3,).
        """
        people = self._people
        ahead = self._walked + people.speeds * seconds
        positions = people.positions(ahead)
        distances = [np.hypot(*(p[:, :2] - robot[:2]).T) for p in (self.discs, positions)]
        near = distances[1] < _STOP_DISTANCE
        stop = near & (distances[1] < distances[0]) & ~self._squeezing
        self._walked = np.where(stop, self._walked, ahead)
        self._waited = np.where(stop, self._waited + seconds, 0.0)
        tired = self._waited > _MAX_WAIT
        turned = self._memory_times > 0.0
        back = tired & ~turned
        self._walked, self._waited = np.where(back, -self._walked, self._walked), np.where(tired, 0.0, self._waited)
        self._squeezing = near & (self._squeezing | (tired & turned))
        self._memory_times = np.where(back, _MEMORY_TIME, np.maximum(self._memory_times - seconds, 0.0))
        if stop.any() or back.any():
            positions = people.positions(self._walked)
        self.discs = _discs(np.where(self._squeezing[:, None], _push_away(positions, robot), positions))


def _push_away(positions: NDArray[np.float64], robot: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions (k, 2), m, moved away from the robot, (3,), where they are too near."""
    offsets = positions - robot[:2]
    distances = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), 1e-6)
    moved: NDArray[np.float64] = robot[:2] + offsets * np.maximum(1.0, _MIN_DISTANCE / distances)[:, None]
    return moved


def _discs(positions: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate((positions, np.full((len(positions), 1), _RADIUS)), axis=1)


def draw_people(drive: Drive, count: int, seed: int) -> People:
    """Draw the walks of some people."""
    total = float(drive.path.lengths.sum())
    rows = []
    for person in range(count):
        draw = random_stream(seed, Purpose.PEOPLE, person)
        span = min(total, draw.uniform(0.3 * _MAX_SPAN, _MAX_SPAN))
        begin, phase = draw.uniform(0.0, total - span), draw.uniform(0.0, 2.0 * span)
        speed, offset = draw.uniform(_MIN_SPEED, _MAX_SPEED), draw.uniform(-_MAX_LATERAL_OFFSET, _MAX_LATERAL_OFFSET)
        rows.append((begin, span, speed, phase, offset))
    return People(drive, *np.array(rows).reshape(-1, 5).T)
