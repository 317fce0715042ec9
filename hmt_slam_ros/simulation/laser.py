"""The laser of the simulated robot."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.random_streams import Purpose, stream
from hmt_slam_ros.sensing import Scan
from hmt_slam_ros.simulation.raycast import WallIndex, cast, cast_discs
from hmt_slam_ros.simulation.settings import Settings

_RANGE_MIN = 0.02  # m


class Laser:
    """A planar range finder that looks ahead.

    :ivar pose: shape (3,), ``base_T_laser``, m and rad.
    :ivar angles: shape (n,), of the beams, rad.
    :ivar half_field: largest angle to either side at which it sees, rad.
    :ivar reach: m.
    :ivar times: shape (n,), of each beam after the first, s; shape (1,) where there is no time between them.
    """

    def __init__(self, settings: Settings) -> None:
        self.pose = np.array([settings.forward, 0.0, 0.0])
        self.times = np.linspace(0.0, settings.sweep, settings.beams if settings.sweep > 0.0 else 1)
        self._settings = settings
        self.reach = settings.range
        field = math.radians(settings.field_of_view)
        self.half_field = 0.5 * field
        # Beams all around: the last is not the first once more.
        gaps = settings.beams - 1 if settings.field_of_view < 360.0 else settings.beams
        self._first, self._gap = -self.half_field, field / gaps
        self.angles = self._first + self._gap * np.arange(settings.beams)

    def distances(
        self, poses: NDArray[np.float64], walls: WallIndex, discs: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """True distance along each beam, shape (n,), m; inf where there is nothing within reach.

        :param poses: shape (n, 3), ``world_T_base`` at each beam, or (1, 3) for all.
        :param discs: shape (k, 3), x, y and radius of people, m.
        """
        lasers = se2.compose(poses, self.pose)
        origins = np.ascontiguousarray(np.broadcast_to(lasers[:, :2], (self.angles.size, 2)))
        angles = lasers[:, 2] + self.angles
        distances = cast(walls, origins, angles, self.reach)
        cast_discs(discs, origins, angles, distances)
        return distances

    def scan(self, number: int, stamp: int, distances: NDArray[np.float64]) -> Scan:
        """What the laser makes of true distances (n,), m: noise, and beams that do not return, which read inf.

        :param number: of the scan, which determines its noise.
        """
        settings = self._settings
        draw = stream(settings.run_seed, Purpose.LASER, number)
        ranges = distances + settings.range_noise * draw.standard_normal(distances.size)
        lost = (draw.random(distances.size) < settings.dropout) | (ranges >= settings.range)
        kept = np.where(lost, np.inf, np.maximum(ranges, 0.0))
        gap = settings.sweep / max(1, settings.beams - 1)
        return Scan(stamp, kept.astype(np.float32), self._first, self._gap, _RANGE_MIN, settings.range, self.pose, gap)
