"""Scores of trajectories, by true relations or by the walls that later passes see again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from benchmark.logs import MeasuredLog
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import PairErrors, RelationErrors, StampedPoses, evaluate_relations, pair_errors, read_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.occupancy_map import FREE, OCCUPIED, occupancy_image
from hmt_slam_ros.sensors import Scan

FINAL, ONLINE = "trajectory.tum", "trajectory_online.tum"

POLICY = (
    "A relation is matched with the pose nearest in time within 0.1 s at both ends; where there is none, the nearest "
    "pose is extrapolated by the raw odometry; where that is not possible either, the relation counts as missed."
)
"""How relations are matched, see :func:`hmt_slam_ros.evaluation.pair_errors`."""

WALLS_POLICY = (
    "Every 10 m of the path are laid over the map of all that lies more than 20 m of path before. The agreement of a "
    "return is 1 on a wall, 0 at 0.3 m from the nearest one and -1 in free space. A stretch is torn where a shift "
    "within 1 m and 3 degrees raises its agreement by more than 0.2, or the agreement is below 0.1."
)
"""How walls are scored, in short."""

APART = 20.0
"""Path length after which ground counts as an earlier pass, m."""

TORN_GAIN = 0.2
"""Gain of agreement at another place within reach, above which a stretch is torn."""

TORN_AGREEMENT = 0.1
"""Agreement below which a stretch is torn, because its right place may be out of reach."""

_STRETCH = 10.0  # m of path that are scored together
_SPACING = 0.25  # m of path between the scans that are used
_RANGE = 15.0  # m to which beams are used; farther away, adjacent beams leave gaps in a wall
_CELL = 0.05  # m
_NEAR = 0.3  # m from a wall at which agreement with it ends
_SHARE = 0.2  # smallest share of a stretch's returns on known ground, for it to be scored
_SEARCHED = 600  # returns of a stretch that are used to search for a better place
_SHIFTS = np.linspace(-1.0, 1.0, 21)  # m
_TURNS = np.radians(np.linspace(-3.0, 3.0, 13))


def score(folder: Path, log: MeasuredLog, file: str = FINAL) -> RelationErrors:
    """Errors of one trajectory of an output folder.

    :param file: name of the trajectory.
    :raises HmtSlamError: where the log has no true relations, or there is no such trajectory.
    """
    return score_trajectory(read_tum(folder / file), log)


def score_trajectory(trajectory: StampedPoses, log: MeasuredLog) -> RelationErrors:
    """Errors of a trajectory of a log.

    :raises HmtSlamError: where the log has no true relations.
    """
    if log.relations is None:
        raise HmtSlamError(f"the log {log.name} has no true relations: its trajectory cannot be scored")
    return evaluate_relations(trajectory, log.relations, log.odometry)


def score_pairs(folder: Path, log: MeasuredLog, file: str = FINAL) -> PairErrors:
    """Errors of one trajectory of an output folder, relation by relation.\n
    :raises HmtSlamError: where the log has no true relations.
    """
    if log.relations is None:
        raise HmtSlamError(f"the log {log.name} has no true relations: its trajectory cannot be scored")
    return pair_errors(read_tum(folder / file), log.relations, log.odometry)


@dataclass(frozen=True)
class SeedMeans:
    """Means over seeds of the errors of one kind of trajectory.

    :ivar translation: mean over the seeds of the mean error, m.
    :ivar translation_std: sample deviation of the seeds' means, m.
    :ivar relations_std: mean over the seeds of the deviation over the relations, m.
    :ivar worst: largest mean of a seed, m.
    :ivar long: as ``translation``, of relations over more than 60 s, m.
    :ivar long_max: largest error of any of these, m.
    :ivar rotation: as ``translation``, degrees.
    :ivar matched: share of the relations.
    :ivar extrapolated: largest number of relations of a seed that needed the odometry.
    :ivar missed: largest number of relations of a seed that were missed.
    """

    translation: float
    translation_std: float
    relations_std: float
    worst: float
    long: float
    long_max: float
    rotation: float
    matched: float
    extrapolated: int
    missed: int


def over_seeds(scores: Sequence[RelationErrors]) -> SeedMeans:
    """Means over the scores of the seeds."""
    means = np.array([score.overall.translation.mean for score in scores])
    return SeedMeans(
        translation=float(means.mean()),
        translation_std=sample_deviation(means.tolist()),
        relations_std=float(np.mean([score.overall.translation.std for score in scores])),
        worst=float(means.max()),
        long=float(np.mean([score.over_60_s.translation.mean for score in scores])),
        long_max=float(np.max([score.over_60_s.translation.max for score in scores])),
        rotation=float(np.mean([score.overall.rotation.mean for score in scores])),
        matched=sum(s.overall.matched for s in scores) / sum(s.overall.count for s in scores),
        extrapolated=max(score.overall.extrapolated for score in scores),
        missed=max(score.overall.missed for score in scores),
    )


def sample_deviation(values: Sequence[float]) -> float:
    """Standard deviation with n - 1 in the denominator; 0 for a single value."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0


@dataclass(frozen=True)
class Stretch:
    """A stretch of the path, compared with the map of the path up to 20 m before it.

    The agreement is the mean over its returns on known ground: 1 on a wall, falling to 0 at
    0.3 m from the nearest wall, and -1 in free space.

    :ivar begin: path length at which it begins, m.
    :ivar returns: number of returns on known ground.
    :ivar agreement: at the pose of the trajectory.
    :ivar gain: of agreement at the best place within 1 m and 3 degrees.
    :ivar shift: distance to that place, m.
    """

    begin: float
    returns: int
    agreement: float
    gain: float
    shift: float

    @property
    def is_torn(self) -> bool:
        """Whether it fits much better elsewhere, or does not fit at all."""
        return self.gain > TORN_GAIN or self.agreement < TORN_AGREEMENT


@dataclass(frozen=True)
class Walls:
    """The agreement of later passes of a path with earlier ones.

    :ivar stretches: over known ground.
    :ivar new: number of stretches over new ground, although there are earlier passes.
    """

    stretches: tuple[Stretch, ...]
    new: int

    @property
    def agreement(self) -> float:
        """Mean over all returns; NaN if nothing was seen twice."""
        returns = sum(stretch.returns for stretch in self.stretches)
        return sum(s.returns * s.agreement for s in self.stretches) / returns if returns else float("nan")

    @property
    def torn_stretches(self) -> list[Stretch]:
        """The stretches that do not fit."""
        return [stretch for stretch in self.stretches if stretch.is_torn]


def judge_walls(scans: Sequence[Scan], poses: NDArray[np.float64]) -> Walls:
    """Compare every stretch of a path with the map of the path before it.

    :param scans: all scans of a log, in its order.
    :param poses: shape (n, 3), ``map_T_base`` of each, m and rad.
    """
    path_length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    used = np.flatnonzero(np.diff(np.floor(path_length / _SPACING), prepend=-1.0))
    number = np.floor(path_length[used] / _STRETCH)
    stretches = []
    for k in np.unique(number):
        begin = float(k * _STRETCH)
        earlier, later = used[path_length[used] < begin - APART], used[number == k]
        if earlier.size:
            grid = _AgreementGrid([scans[i] for i in earlier], poses[earlier])
            points = np.concatenate([se2.transform(poses[i], _returns(scans[i])) for i in later])
            stretches.append(_score_stretch(begin, points, poses[later[later.size // 2], :2], grid))
    compared = tuple(stretch for stretch in stretches if stretch is not None)
    return Walls(compared, len(stretches) - len(compared))


def _returns(scan: Scan) -> NDArray[np.float64]:
    """End points (n, 2) of the beams that are used, in the robot's frame."""
    from_laser: NDArray[np.float64] = scan.points - scan.laser_pose[:2]
    return scan.points[np.hypot(from_laser[:, 0], from_laser[:, 1]) <= _RANGE]


class _AgreementGrid:
    """A grid of agreement with the map of some scans, see :class:`Stretch`."""

    def __init__(self, scans: Sequence[Scan], poses: NDArray[np.float64]) -> None:
        image = occupancy_image(scans, poses, _CELL, _RANGE)
        pixels = image.pixels[::-1]
        distance = image.resolution * distance_transform_edt(pixels != OCCUPIED)
        elsewhere = np.where(pixels == FREE, -1.0, 0.0)
        self._values: NDArray[np.float64] = np.where(distance < _NEAR, 1.0 - distance / _NEAR, elsewhere)
        self._origin, self._resolution = image.origin, image.resolution

    def agreement_at(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Agreement of points (..., 2); 0 where nothing is known."""
        cells = np.floor((points - self._origin) / self._resolution).astype(np.int64)
        size = np.array(self._values.shape[::-1])
        inside = ((cells >= 0) & (cells < size)).all(axis=-1)
        x, y = np.moveaxis(np.clip(cells, 0, size - 1), -1, 0)
        return np.where(inside, self._values[y, x], 0.0)


def _score_stretch(
    begin: float, points: NDArray[np.float64], center: NDArray[np.float64], grid: _AgreementGrid
) -> Stretch | None:
    """The scored stretch, or None over new ground."""
    here = grid.agreement_at(points)
    known = int(np.count_nonzero(here))
    if known < _SHARE * len(points) or not known:
        return None
    thinned = points[:: max(1, len(points) // _SEARCHED)]
    kept = max(int(np.count_nonzero(grid.agreement_at(thinned))), 1)
    best, shift = _best_place(thinned, center, grid)
    gain = max(0.0, best - grid.agreement_at(thinned).sum()) / kept
    return Stretch(begin, known, float(here.sum() / known), float(gain), shift if gain else 0.0)


def _best_place(points: NDArray[np.float64], center: NDArray[np.float64], grid: _AgreementGrid) -> tuple[float, float]:
    """Largest sum of agreements over all nearby places, and the distance of that place, m."""
    dx, dy = (axis.ravel() for axis in np.meshgrid(_SHIFTS, _SHIFTS, indexing="ij"))
    shifts = np.stack([dx, dy], axis=1)
    best, distance = -np.inf, 0.0
    for turn in _TURNS:
        turned = se2.transform(np.array([*center, turn]), points - center)
        sums = grid.agreement_at(turned + shifts[:, None]).sum(axis=1)
        k = int(np.argmax(sums))
        if sums[k] > best:
            best, distance = float(sums[k]), float(np.hypot(*shifts[k]))
    return best, distance
