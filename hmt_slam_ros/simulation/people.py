"""People who walk to and fro on the robot's way, and step aside for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.simulation.drive import Drive

_RADIUS = 0.2  # m
_BERTH = 0.8  # m, from the robot's middle to a person's
_SLOW, _FAST = 0.7, 1.4  # m/s
_SPAN = 20.0  # m, that a person walks at most before turning back
_STOP = 1.0  # m, likewise where they cannot step aside
_MAX_WAIT = 2.0  # s, that a person waits for the robot to go away
_MEMORY_TIME = 10.0  # s, that a person knows of having turned back for it, be it that the way back was a short one
_ASIDE = 0.25  # m, of the robot's way at most


@dataclass(frozen=True, eq=False)
class People:
    """Persons who each walk on a part of the robot's way; all arrays of shape (k,).

    :ivar drive: whose way it is.
    :ivar begins: where each part begins on the way, m.
    :ivar spans: length of each part, m.
    :ivar speeds: m/s.
    :ivar phases: where each person is at first, m.
    :ivar lateral_offsets: how far each walks to the left of the way, m.
    """

    drive: Drive
    begins: NDArray[np.float64]
    spans: NDArray[np.float64]
    speeds: NDArray[np.float64]
    phases: NDArray[np.float64]
    lateral_offsets: NDArray[np.float64]

    def discs_at(self, seconds: float, robot: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where they are, (k, 3) as x, y and radius, m; whoever is too near the robot, (3,), is beside it."""
        return _discs(_push_away(self.positions(self.phases + self.speeds * seconds), robot))

    def positions(self, walked: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where they are after walking so far, m, to and fro, shape (k,); shape (k, 2), m."""
        path = self.drive.path
        walked = np.mod(walked, 2.0 * self.spans)
        along = self.begins + np.minimum(walked, 2.0 * self.spans - walked)
        ends = np.cumsum(path.lengths)
        along = np.clip(along, 0.0, ends[-1] * (1.0 - 1e-12))
        stretch = np.searchsorted(ends, along, side="right")
        poses = path.poses_at(stretch, along - (ends - path.lengths)[stretch])
        left = np.stack((-np.sin(poses[:, 2]), np.cos(poses[:, 2])), axis=1)
        return poses[:, :2] + self.lateral_offsets[:, None] * left


class ReactivePeople:
    """The same persons before a robot of which nobody knows where it will go.

    Whoever would come too near the robot stops, turns back where it does not go away, and squeezes past it, be it
    through a wall, where it is in the way back as well.

    :ivar discs: shape (k, 3), where they are now, x, y and radius, m.
    """

    def __init__(self, people: People) -> None:
        self._people = people
        self._walked = people.phases.copy()
        self._waited = np.zeros_like(self._walked)
        self._squeezing = np.zeros(len(self._walked), dtype=np.bool_)
        self._memory_times = np.zeros_like(self._walked)
        self.discs = _discs(people.positions(self._walked))

    def walk(self, seconds: float, robot: NDArray[np.float64]) -> None:
        """Walk for a while in which they do not look again.

        :param robot: its pose, (3,).
        """
        people = self._people
        ahead = self._walked + people.speeds * seconds
        distances = [np.hypot(*(p[:, :2] - robot[:2]).T) for p in (self.discs, people.positions(ahead))]
        near = distances[1] < _STOP
        stop = near & (distances[1] < distances[0]) & ~self._squeezing
        self._walked = np.where(stop, self._walked, ahead)
        self._waited = np.where(stop, self._waited + seconds, 0.0)
        tired = self._waited > _MAX_WAIT
        turned = self._memory_times > 0.0
        back = tired & ~turned
        self._walked, self._waited = np.where(back, -self._walked, self._walked), np.where(tired, 0.0, self._waited)
        self._squeezing = near & (self._squeezing | (tired & turned))
        self._memory_times = np.where(back, _MEMORY_TIME, np.maximum(self._memory_times - seconds, 0.0))
        places = people.positions(self._walked)
        self.discs = _discs(np.where(self._squeezing[:, None], _push_away(places, robot), places))


def _push_away(places: NDArray[np.float64], robot: NDArray[np.float64]) -> NDArray[np.float64]:
    """Places (k, 2), m, moved away from the robot, (3,), where they are too near."""
    away = places - robot[:2]
    distances = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-6)
    moved: NDArray[np.float64] = robot[:2] + away * np.maximum(1.0, _BERTH / distances)[:, None]
    return moved


def _discs(places: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.concatenate((places, np.full((len(places), 1), _RADIUS)), axis=1)


def draw_people(drive: Drive, count: int, seed: int) -> People:
    """Draw where a number of persons walk."""
    total = float(drive.path.lengths.sum())
    rows = []
    for person in range(count):
        draw = random_stream(seed, Purpose.PEOPLE, person)
        span = min(total, draw.uniform(0.3 * _SPAN, _SPAN))
        begin, phase = draw.uniform(0.0, total - span), draw.uniform(0.0, 2.0 * span)
        rows.append((begin, span, draw.uniform(_SLOW, _FAST), phase, draw.uniform(-_ASIDE, _ASIDE)))
    return People(drive, *np.array(rows).reshape(-1, 5).T)
