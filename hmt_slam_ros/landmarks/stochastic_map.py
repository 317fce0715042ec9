"""The stochastic map: the robot and the lines around it in one Gaussian, with all correlations.

Tomatis, Nourbakhsh and Siegwart (2003), section 3.6; equation numbers are theirs. The state, Eq. (6), is (x, y, theta)
of the robot and (alpha, r) of each line, in the frame of the map. It differs from the paper in these points:

- **Two faces.** r may have either sign: alpha points from the observed face of a wall across it. The other face is
  another line. A line within the noise of the robot, as in a door, may be observed with alpha turned by pi; of (alpha,
  r) and (alpha + pi, -r) the one with the nearer angle counts.
- **Innovation in the robot's frame.** Eq. (12) compares lines in the frame of the map, where r depends on the robot's
  heading. In the robot's frame only alpha does. Both agree to first order, but this one is more nearly linear.
- **Overlap.** Walls may be nearly collinear. So Eq. (13) is applied only to lines with much the same visible segment.
  Segments of one wall are separate lines at first, and merged once they are certain enough.
- **Pruning.** A line that only one or two scans show is removed.
- **Clones.** The poses of keyframes are corrected with the robot's, by their covariances with the state (stochastic
  cloning, Roumeliotis and Burdick 2002). Those among clones are not needed, as nothing is observed from one.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration.landmarks import FeatureParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, chi_square_gate
from hmt_slam_ros.landmarks.data_association import Pairing, compatible_pairings
from hmt_slam_ros.landmarks.line_extraction import Lines
from hmt_slam_ros.landmarks.line_fit import MergeGate
from hmt_slam_ros.sensors.relative_motion import RelativeMotion
from hmt_slam_ros.submap.line_map_state import NO_CLONES, LineMapState, PoseClones, WallLine


def overlap_ratio(segments: Float64, others: Float64) -> float:
    """Common length of the segments of two lines, as a share of the shorter one."""
    common = np.minimum(segments[:, None, 1], others[None, :, 1]) - np.maximum(segments[:, None, 0], others[None, :, 0])
    return float(np.maximum(common, 0.0).sum()) / max(1e-9, min(_total_length(segments), _total_length(others)))


def join_segments(segments: Float64, max_gap: float) -> Float64:
    """Segments of one line, joined over gaps up to ``max_gap``, m."""
    segments = segments[np.argsort(segments[:, 0])]
    reached = np.maximum.accumulate(segments[:, 1])
    first = np.concatenate(([True], segments[1:, 0] > reached[:-1] + max_gap))
    return np.stack((segments[first, 0], np.maximum.reduceat(segments[:, 1], np.flatnonzero(first))), axis=1)


def mean_position(segments: Float64) -> float:
    """Mean position of the segments, m along the line."""
    return 0.5 * float((segments**2 @ (-1.0, 1.0)).sum()) / max(1e-9, _total_length(segments))


def _total_length(segments: Float64) -> float:
    return float((segments[:, 1] - segments[:, 0]).sum())


def most_similar_pair(lines: Float64, covariance: Float64, middles: Float64, gate: MergeGate) -> tuple[int, int] | None:
    """The two most similar lines that the gate admits to be one; None for none.

    :param lines: alpha and r, shape (n, 2), rad and m.
    :param covariance: of all of them, shape (2 n, 2 n).
    :param middles: mean position of the segments of each, shape (n,), m along it.
    :returns: their numbers, the smaller one first.
    """
    count = len(lines)
    one, other = np.triu_indices(count, 1)
    blocks = covariance.reshape(count, 2, count, 2).transpose(0, 2, 1, 3)
    # S of Eq. (13) of Tomatis et al.
    spread = blocks[one, one] + blocks[other, other] - blocks[one, other] - blocks[other, one]
    difference = lines[one] - lines[other]
    difference[:, 0] = se2.wrap(difference[:, 0])
    distance2 = np.einsum("ni,nij,nj->n", difference, np.linalg.inv(spread), difference)
    variance = np.minimum(_distance_variances(spread, middles[one]), _distance_variances(spread, middles[other]))
    distance2[variance > gate.deviation**2] = np.inf
    least = int(np.argmin(distance2)) if count > 1 else -1
    return (int(one[least]), int(other[least])) if least >= 0 and distance2[least] <= gate.distance2 else None


def _distance_variances(spread: Float64, along: Float64) -> Float64:
    """Variances of the distances of points on lines from other lines, shape (n,), m^2.

    :param spread: covariance of the difference of alpha and r, shape (n, 2, 2).
    :param along: positions of the points on the lines, shape (n,), m.
    """
    return along * along * spread[:, 0, 0] - 2.0 * along * spread[:, 0, 1] + spread[:, 1, 1]


_MAX_ORIGIN_DEVIATIONS = 4.0
"""A line is within the noise of the robot if its distance is at most so many deviations."""

_FLIPPED_SIGNS = np.array([[1.0, -1.0], [-1.0, 1.0]])
"""Factor on a covariance of alpha and r where r changes its sign."""


class LineAssociations(NamedTuple):
    """Associations of the lines of a scan with those of the map, which are given by their numbers (`WallLine`).

    :ivar matched: pairs of a line of the scan and the re-observed line of the map.
    :ivar new: pairs of a line of the scan and the new line of the map.
    :ivar merged: pairs of a line of the map and the one merged into it.
    """

    matched: tuple[tuple[int, int], ...] = ()
    new: tuple[tuple[int, int], ...] = ()
    merged: tuple[tuple[int, int], ...] = ()


class _OrientedLine(NamedTuple):
    """An observed line, in the representation of the map.

    :ivar observed: alpha and r in the robot's frame, (2,).
    :ivar covariance: of these, (2, 2).
    :ivar line: alpha and r in the frame of the map, (2,), Eq. (9).
    :ivar segments: its visible segments, (m, 2), m along it in that frame.
    """

    observed: Float64
    covariance: Float64
    line: Float64
    segments: Float64


class LineMap:
    """An extended Kalman filter over the robot's pose and the lines around it.

    :ivar mean: shape (3 + 2 n,), x and y in m, theta in rad, then alpha in rad and r in m of each line.
    :ivar covariance: shape (3 + 2 n, 3 + 2 n).
    :ivar walls: the n lines, in the order of the state.
    :ivar clones: earlier poses of the robot, which later observations correct.
    """

    def __init__(self, features: FeatureParameters, start: PoseGaussian | None = None) -> None:
        """:param start: belief over ``map_T_base``; None for the origin, for certain."""
        self._features = features
        self._gate = chi_square_gate(features.pair_probability, 2)
        self._merge_gate = MergeGate(chi_square_gate(features.merge_probability, 2), features.map_merge_deviation)
        start = start or PoseGaussian.from_pose(np.zeros(3))
        self.mean: Float64 = start.mean.copy()
        turn = _rotation(start.mean[2])
        self.covariance: Float64 = turn @ start.covariance @ turn.T
        self.walls: list[WallLine] = []
        self.clones: PoseClones = NO_CLONES
        self._next_number = 0

    @classmethod
    def from_state(cls, features: FeatureParameters, state: LineMapState) -> LineMap:
        """The map of a state."""
        found = cls(features)
        found.mean, found.covariance = state.mean, state.covariance
        found.walls, found._next_number, found.clones = list(state.walls), state.next_number, state.clones
        return found

    @property
    def state(self) -> LineMapState:
        """The state of the map; none of its arrays is written to later."""
        return LineMapState(self.mean.copy(), self.covariance.copy(), tuple(self.walls), self._next_number, self.clones)

    def __len__(self) -> int:
        return len(self.walls)

    @property
    def pose(self) -> PoseGaussian:
        """The belief over ``map_T_base``."""
        turn = _rotation(self.mean[2])
        return PoseGaussian(self.mean[:3].copy(), turn.T @ self.covariance[:3, :3] @ turn)

    @property
    def lines(self) -> Float64:
        """alpha and r of each line, shape (n, 2), rad and m; r of either sign."""
        return self.mean[3:].reshape(-1, 2)

    def predict(self, step: RelativeMotion) -> None:
        """Add a motion, Eqs. (7) and (8)."""
        x, y, _ = self.mean[:3]
        self.mean[:3] = se2.compose(self.mean[:3], step.increment)
        by_robot = np.eye(3)
        by_robot[:2, 2] = y - self.mean[1], self.mean[0] - x
        self.covariance[:3] = by_robot @ self.covariance[:3]
        self.covariance[:, :3] = self.covariance[:, :3] @ by_robot.T
        self.clones = self.clones.propagate(by_robot)
        turn = _rotation(self.mean[2])
        self.covariance[:3, :3] += turn @ step.covariance @ turn.T

    def reset_pose(self, pose: PoseGaussian) -> None:
        """Replace the robot's pose by one that is independent of the lines."""
        turn = _rotation(pose.mean[2])
        self.mean[:3] = pose.mean
        self.covariance[:3], self.covariance[:, :3] = 0.0, 0.0
        self.covariance[:3, :3] = turn @ pose.covariance @ turn.T
        self.clones = self.clones.decorrelate_robot()

    def clone_pose(self) -> None:
        """Clone the robot's pose."""
        self.clones = self.clones.add_robot_pose(self.mean, self.covariance)

    def observe(self, lines: Lines, *, keep_new: bool = False) -> LineAssociations:
        """Correct robot and lines by known lines, add new ones, and merge those that are one.

        :param keep_new: whether new lines stay without a second observation.
        """
        pairings = [pairing for k in range(len(lines)) for pairing in self._pairings(lines, k)]
        chosen = compatible_pairings(self.covariance, pairings, self._features.pair_probability)
        self._update_with_pairings(chosen)
        for line in {pairing.map_line for pairing in chosen}:
            self.walls[line] = self.walls[line]._replace(sightings=self.walls[line].sightings + 1)
        for pairing in chosen:
            oriented = self._orient_line(lines, pairing.scan_line, self.lines[pairing.map_line, 0])
            self._extend_segments(pairing.map_line, oriented.segments)
        known = {pairing.scan_line: self.walls[pairing.map_line].number for pairing in chosen}
        # Compared with the lines of before the scan: its own ones are distinct already.
        unknown = [k for k in range(len(lines)) if k not in known and not self._pairings(lines, k)]
        sightings = self._features.min_sightings if keep_new else 1
        new = {k: self._add_line(self._orient_line(lines, k, None), sightings) for k in unknown}
        self._prune_lines({*known.values(), *new.values()})
        return LineAssociations(tuple(known.items()), tuple(new.items()), tuple(self._merge_lines()))

    def _orient_line(self, lines: Lines, k: int, alpha: float | None) -> _OrientedLine:
        """A line of a scan; one within the noise of the robot in the representation nearer to ``alpha``."""
        (angle, r), covariance = lines.parameters[k].tolist(), lines.covariances[k]
        segments = lines.segments[lines.owners == k]
        x, y, theta = self.mean[:3].tolist()
        near = r <= _MAX_ORIGIN_DEVIATIONS * math.sqrt(covariance[1, 1])
        if alpha is not None and near and math.cos(angle + theta - alpha) < 0.0:
            angle, r, covariance, segments = angle + math.pi, -r, covariance * _FLIPPED_SIGNS, -segments[:, ::-1]
        cos, sin = math.cos(angle + theta), math.sin(angle + theta)
        line = np.array([float(se2.wrap(angle + theta)), r + x * cos + y * sin])
        return _OrientedLine(np.array([angle, r]), covariance, line, segments + (y * cos - x * sin))

    def _pair_lines(self, lines: Lines, k: int, line: int) -> Pairing | None:
        """The pairing of an observed line with a line of the map, Eq. (12); None where they do not overlap."""
        alpha, r = self.lines[line].tolist()
        oriented = self._orient_line(lines, k, alpha)
        if overlap_ratio(oriented.segments, self.walls[line].segments) < self._features.min_overlap:
            return None
        x, y, theta = self.mean[:3].tolist()
        cos, sin = math.cos(alpha), math.sin(alpha)
        difference = oriented.observed - (alpha - theta, r - x * cos - y * sin)
        difference[0] = float(se2.wrap(difference[0]))
        jacobian = np.zeros((2, self.mean.size))
        jacobian[0, 2], jacobian[1, :2] = -1.0, (-cos, -sin)
        jacobian[:, _state_slice(line)] = ((1.0, 0.0), (x * sin - y * cos, 1.0))
        return Pairing(k, line, difference, jacobian, oriented.covariance)

    def _parallel_lines(self, lines: Lines, k: int) -> list[int]:
        """The lines of the map whose direction may be that of an observed line; all others are beyond the gate."""
        away = np.abs(se2.wrap(lines.parameters[k, 0] + self.mean[2] - self.lines[:, 0]))
        variances = np.diagonal(self.covariance)
        # The deviation of a sum is at most the sum of the deviations.
        deviations = math.sqrt(lines.covariances[k, 0, 0]) + math.sqrt(variances[2]) + np.sqrt(variances[3::2])
        within = np.minimum(away, np.pi - away) <= math.sqrt(self._gate) * deviations
        found: list[int] = np.flatnonzero(within).tolist()
        return found

    def _pairings(self, lines: Lines, k: int) -> list[Pairing]:
        """The pairings of an observed line within the gate, Eq. (13)."""
        pairings = (self._pair_lines(lines, k, line) for line in self._parallel_lines(lines, k))
        return [each for each in pairings if each and each.distance2(self.covariance) <= self._gate]

    def _update_with_pairings(self, chosen: Sequence[Pairing]) -> None:
        """Eqs. (14) to (17) for all pairings at once, the covariance in Joseph's form."""
        if not chosen:
            return
        jacobian = np.concatenate([pairing.jacobian for pairing in chosen])
        difference = np.concatenate([pairing.difference for pairing in chosen])
        noise = np.zeros((len(difference), len(difference)))
        for k, pairing in enumerate(chosen):
            noise[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = pairing.noise
        self._correct(jacobian, difference, noise)

    def _correct(self, jacobian: Float64, difference: Float64, noise: Float64) -> None:
        spread = jacobian @ self.covariance @ jacobian.T + noise
        gain = np.linalg.solve(spread, jacobian @ self.covariance).T
        self.mean = self.mean + gain @ difference
        self.mean[2] = se2.wrap(self.mean[2])
        kept = np.eye(self.mean.size) - gain @ jacobian
        self.clones = self.clones.correct(jacobian.T @ np.linalg.solve(spread, difference), kept)
        self.covariance = kept @ self.covariance @ kept.T + gain @ noise @ gain.T

    def _add_line(self, oriented: _OrientedLine, sightings: int) -> int:
        """Add a new line, Eqs. (9) to (11), and return its number."""
        size = self.mean.size
        covariance = np.zeros((size + 2, size + 2))
        covariance[:size, :size] = self.covariance
        cos, sin = math.cos(oriented.line[0]), math.sin(oriented.line[0])
        along = self.mean[1] * cos - self.mean[0] * sin
        by_robot, by_line = np.array([[0.0, 0.0, 1.0], [cos, sin, along]]), np.array([[1.0, 0.0], [along, 1.0]])
        covariance[size:, :size] = by_robot @ self.covariance[:3]
        covariance[:size, size:] = covariance[size:, :size].T
        own = by_line @ oriented.covariance @ by_line.T
        covariance[size:, size:] = by_robot @ self.covariance[:3, :3] @ by_robot.T + own
        self.mean, self.covariance = np.concatenate((self.mean, oriented.line)), covariance
        self.clones = self.clones.add_line(by_robot)
        self.walls.append(
            WallLine(self._next_number, sightings, join_segments(oriented.segments, self._features.max_gap))
        )
        self._next_number += 1
        return self.walls[-1].number

    def _extend_segments(self, line: int, segments: Float64) -> None:
        """Add segments to a line."""
        wall = self.walls[line]
        segments = join_segments(np.concatenate((wall.segments, segments)), self._features.max_gap)
        self.walls[line] = wall._replace(segments=segments)

    def _prune_lines(self, observed: Collection[int]) -> None:
        """Remove the lines with too few observations whose numbers are not among ``seen``."""
        enough = self._features.min_sightings
        for line in reversed(range(len(self))):
            if self.walls[line].sightings < enough and self.walls[line].number not in observed:
                self._remove_line(line)

    def _merge_lines(self) -> Iterator[tuple[int, int]]:
        """Merge lines that are one, and return pairs of their numbers."""
        while pair := most_similar_pair(self.lines, self.covariance[3:, 3:], self._mean_positions(), self._merge_gate):
            one, other = pair
            jacobian = np.zeros((2, self.mean.size))
            jacobian[:, _state_slice(one)], jacobian[:, _state_slice(other)] = np.eye(2), -np.eye(2)
            difference = self.lines[other] - self.lines[one]
            difference[0] = se2.wrap(difference[0])
            # Eqs. (14) to (17), with a difference of 0 observed without noise.
            self._correct(jacobian, difference, np.zeros((2, 2)))
            wall, part = self.walls[one], self.walls[other]
            self.walls[one] = wall._replace(sightings=wall.sightings + part.sightings)
            self._extend_segments(one, part.segments)
            self._remove_line(other)
            yield wall.number, part.number

    def _mean_positions(self) -> Float64:
        return np.array([mean_position(wall.segments) for wall in self.walls])

    def _remove_line(self, line: int) -> None:
        """Remove a line from the state."""
        kept = np.delete(np.arange(self.mean.size), _state_slice(line))
        self.mean, self.covariance = self.mean[kept], self.covariance[np.ix_(kept, kept)]
        self.clones = self.clones.select_columns(kept)
        del self.walls[line]


def _state_slice(line: int) -> slice:
    """The rows of a line in the state."""
    return slice(3 + 2 * line, 5 + 2 * line)


def _rotation(theta: float) -> Float64:
    """Rotation of (x, y, theta) from the robot's frame to that of the map, (3, 3)."""
    cos, sin = math.cos(theta), math.sin(theta)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
