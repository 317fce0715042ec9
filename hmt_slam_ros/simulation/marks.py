"""Marks with names on the ceiling, which the robot reads from below."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.random_streams import Purpose, random_stream
from hmt_slam_ros.sensors import MarkObservation
from hmt_slam_ros.simulation.laser import WallIndex, has_line_of_sight
from hmt_slam_ros.simulation.settings import Settings

_REACH = 1.5
"""Distance in the plane up to which the robot sees a mark, m."""

_DEVIATIONS = np.array([0.03, 0.03, math.radians(1.0)])
"""Deviations of an observation along the robot's axes, m, m and rad."""

_PASS_GAP = 50
"""Scans without an observation of a mark after which the robot passes it again."""


class CeilingMarks:
    """Marks on the ceiling, and how the robot reads them during a drive.

    The name of a mark is misread during a whole pass of it, or never: light and dirt stay as they are.
    """

    def __init__(
        self, poses: NDArray[np.float64], robot: NDArray[np.float64], walls: WallIndex, settings: Settings
    ) -> None:
        """:param poses: shape (m, 3), ``world_T_mark``; the headings are drawn.

        :param robot: shape (k, 3), ``world_T_base`` at the scans.
        """
        draw = random_stream(settings.seed, Purpose.MARKS, 0)
        self._poses = np.column_stack((poses[:, :2], draw.uniform(-math.pi, math.pi, len(poses))))
        self._robot, self._seed = robot, settings.run_seed
        self._names = np.column_stack(
            [np.empty((len(robot), 0), np.int64)]
            + [self._names_read(mark, walls, settings.wrong_marks) for mark in range(len(poses))]
        )

    def _names_read(self, mark: int, walls: WallIndex, wrong_share: float) -> NDArray[np.int64]:
        """The mark as which one is read at each scan, shape (k,), -1 where it is not seen."""
        position, eyes = self._poses[mark, :2], self._robot[:, :2]
        near = np.flatnonzero(np.hypot(*(eyes - position).T) <= _REACH)
        seen = near[has_line_of_sight(walls, eyes[near].copy(), np.tile(position, (len(near), 1)))]
        passes = np.cumsum(np.diff(seen, prepend=seen[:1]) > _PASS_GAP)
        draw = random_stream(self._seed, Purpose.MARKS, 1 + mark)
        count = int(passes.max(initial=-1)) + 1
        others = (mark + draw.integers(1, max(2, len(self._poses)), count)) % len(self._poses)
        read = np.where(draw.random(count) < wrong_share, others, mark)
        names = np.full(len(self._robot), -1)
        names[seen] = read[passes]
        return names

    def observe(self, scan: int, stamp: int) -> list[MarkObservation]:
        """The observations at a scan; no two of them have one name.

        :param scan: its number.
        :param stamp: of the scan, ns.
        """
        draw = random_stream(self._seed, Purpose.MARKS, 1_000 + scan)
        observations: dict[str, MarkObservation] = {}
        for mark in np.flatnonzero(self._names[scan] >= 0).tolist():
            true = se2.between(self._poses[mark], self._robot[scan])
            measured = se2.compose(true, se2.exp(draw.normal(0.0, _DEVIATIONS)))
            name = f"mark_{self._names[scan, mark]}"
            observations[name] = MarkObservation(stamp, name, PoseGaussian(measured, np.diag(_DEVIATIONS**2)))
        return list(observations.values())
