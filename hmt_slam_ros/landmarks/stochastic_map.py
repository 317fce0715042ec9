"""The stochastic map of a room: the robot and the lines around it in one Gaussian, with all correlations.

Where nothing shows how far the robot went it drifts, and a line that is seen again tells later how far. That corrects
the robot and the lines seen meanwhile by what their errors have in common, and so it does the poses of keyframes that
were taken on the way: their covariances with the state are kept (stochastic cloning, Roumeliotis and Burdick 2002). Of
the marks among each other no covariance is needed, as nothing is observed from one.

After Tomatis, Nourbakhsh and Siegwart (2003), section 3.6; equation numbers are theirs. The state is Eq. (6), the
robot's (x, y, theta) and the (alpha, r) of each line, in the frame of the map, where r may have either sign: alpha
points from where the line was seen across it, since the face of a wall is seen from one side only, and its other face,
a few centimetres away, is another line. Only where the robot is as near to a line as noise is, in a door, may it be
seen with alpha turned round: of (alpha, r) and (alpha + pi, -r) that one counts whose angle is nearer to the map's.

Eq. (12) compares lines in the frame of the map, where an observed one depends on the robot's heading by its r too. Here
they are compared in the robot's frame, which is the same to first order; but there the heading turns alpha alone, and
nothing is bent by a heading that is uncertain by degrees after a turn, against lines that are known to millimetres.

A line is infinite, a wall is not, and walls stand beside each other a few centimetres off the same line. So Eq. (13) is
asked only of lines of which much the same piece was seen. Pieces of one wall are lines of their own at first; they are
joined when they are known so well that being one line is no coincidence. A line that only one or two scans show is the
mistake of a scan or a person, and is given up.
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
from hmt_slam_ros.sensors.motion_model import RelativeMotion
from hmt_slam_ros.submap.line_map_state import NO_CLONES, LineMapState, PoseClones, WallLine


def overlap_ratio(pieces: Float64, others: Float64) -> float:
    """What two lines have in common along them, as a share of the shorter of the two."""
    common = np.minimum(pieces[:, None, 1], others[None, :, 1]) - np.maximum(pieces[:, None, 0], others[None, :, 0])
    return float(np.maximum(common, 0.0).sum()) / max(1e-9, min(_total_length(pieces), _total_length(others)))


def join_segments(pieces: Float64, max_gap: float) -> Float64:
    """Pieces of one line, joined where the gap between them is no larger than ``max_gap``, m."""
    pieces = pieces[np.argsort(pieces[:, 0])]
    reached = np.maximum.accumulate(pieces[:, 1])
    first = np.concatenate(([True], pieces[1:, 0] > reached[:-1] + max_gap))
    return np.stack((pieces[first, 0], np.maximum.reduceat(pieces[:, 1], np.flatnonzero(first))), axis=1)


def mean_position(pieces: Float64) -> float:
    """Mean of what was seen, m along the line."""
    return 0.5 * float((pieces**2 @ (-1.0, 1.0)).sum()) / max(1e-9, _total_length(pieces))


def _total_length(pieces: Float64) -> float:
    return float((pieces[:, 1] - pieces[:, 0]).sum())


def most_similar_pair(lines: Float64, covariance: Float64, middles: Float64, gate: MergeGate) -> tuple[int, int] | None:
    """The two lines that differ least, if there are two that are one.

    :param lines: alpha and r, shape (n, 2), rad and m.
    :param covariance: of all of them, shape (2 n, 2 n).
    :param middles: of what was seen of each, shape (n,), m along it.
    :returns: numbers, the smaller one first; None where none of the lines are one.
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
    """Of the distance of a point of a line from another one, shape (n,), m^2.

    :param spread: covariance of the difference of alpha and r, shape (n, 2, 2).
    :param along: where the point is on the line, shape (n,), m.
    """
    return along * along * spread[:, 0, 0] - 2.0 * along * spread[:, 0, 1] + spread[:, 1, 1]


_DEVIATIONS = 4.0
_OTHER_SIDE = np.array([[1.0, -1.0], [-1.0, 1.0]])  # on a covariance where r changes its sign


class LineAssociations(NamedTuple):
    """What became of the lines of a scan and of the map; lines of the map are told by their names.

    :ivar matched: pairs of a line of the scan and the line of the map that it re-observed.
    :ivar new: pairs of a line of the scan and the line of the map that it became.
    :ivar merged: pairs of a line of the map and the one that became part of it.
    """

    matched: tuple[tuple[int, int], ...] = ()
    new: tuple[tuple[int, int], ...] = ()
    merged: tuple[tuple[int, int], ...] = ()


class _OrientedLine(NamedTuple):
    """An observed line, on that of its sides that the map has.

    :ivar observed: alpha and r in the robot's frame, (2,).
    :ivar covariance: of these, (2, 2).
    :ivar line: alpha and r in the frame of the map, (2,), Eq. (9).
    :ivar segments: what was seen of it, (m, 2), m along it in that frame.
    """

    observed: Float64
    covariance: Float64
    line: Float64
    segments: Float64


class LineMap:
    """An extended Kalman filter over the robot's pose and the lines of a room.

    :ivar mean: shape (3 + 2 n,), x and y in m, theta in rad, then alpha in rad and r in m of each line.
    :ivar covariance: shape (3 + 2 n, 3 + 2 n).
    :ivar walls: the n lines, in the order of the state.
    :ivar clones: poses where the robot was, corrected by what it learns later.
    """

    def __init__(self, features: FeatureParameters, start: PoseGaussian | None = None) -> None:
        """:param start: ``map_T_base``; the origin, for certain, unless it is given."""
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
        """All that is known; none of its arrays is written to later."""
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
        """The robot moved, Eqs. (7) and (8)."""
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
        """The robot is elsewhere, and how it came there the lines do not tell."""
        turn = _rotation(pose.mean[2])
        self.mean[:3] = pose.mean
        self.covariance[:3], self.covariance[:, :3] = 0.0, 0.0
        self.covariance[:3, :3] = turn @ pose.covariance @ turn.T
        self.clones = self.clones.decorrelate_robot()

    def clone_pose(self) -> None:
        """Note where the robot is."""
        self.clones = self.clones.add_robot_pose(self.mean, self.covariance)

    def observe(self, lines: Lines, *, keep_new: bool = False) -> LineAssociations:
        """Correct robot and lines by those that are known, take in those that are new, and join what is one.

        :param keep_new: whether what is new stays though no other scan shows it.
        """
        pairings = [pairing for k in range(len(lines)) for pairing in self._pairings(lines, k)]
        chosen = compatible_pairings(self.covariance, pairings, self._features.pair_probability)
        self._update_with_pairings(chosen)
        for line in {pairing.map_line for pairing in chosen}:
            self.walls[line] = self.walls[line]._replace(sightings=self.walls[line].sightings + 1)
        for pairing in chosen:
            self._extend_segments(
                pairing.map_line, self._orient_line(lines, pairing.scan_line, self.lines[pairing.map_line, 0]).segments
            )
        known = {pairing.scan_line: self.walls[pairing.map_line].number for pairing in chosen}
        # Against the lines that were there before the scan: its own lines have been told apart already.
        unknown = [k for k in range(len(lines)) if k not in known and not self._pairings(lines, k)]
        sightings = self._features.min_sightings if keep_new else 1
        new = {k: self._add_line(self._orient_line(lines, k, None), sightings) for k in unknown}
        self._prune_lines({*known.values(), *new.values()})
        return LineAssociations(tuple(known.items()), tuple(new.items()), tuple(self._merge_lines()))

    def _orient_line(self, lines: Lines, k: int, alpha: float | None) -> _OrientedLine:
        """A line of a scan; one on which the robot is, on that side on which its angle is nearer to ``alpha``."""
        (angle, r), covariance = lines.parameters[k].tolist(), lines.covariances[k]
        pieces = lines.segments[lines.owners == k]
        x, y, theta = self.mean[:3].tolist()
        near = r <= _DEVIATIONS * math.sqrt(covariance[1, 1])
        if alpha is not None and near and math.cos(angle + theta - alpha) < 0.0:
            angle, r, covariance, pieces = angle + math.pi, -r, covariance * _OTHER_SIDE, -pieces[:, ::-1]
        cos, sin = math.cos(angle + theta), math.sin(angle + theta)
        line = np.array([float(se2.wrap(angle + theta)), r + x * cos + y * sin])
        return _OrientedLine(np.array([angle, r]), covariance, line, pieces + (y * cos - x * sin))

    def _pair_lines(self, lines: Lines, k: int, line: int) -> Pairing | None:
        """An observed line as a re-observation of a line of the map, Eq. (12); None where other pieces were seen."""
        alpha, r = self.lines[line].tolist()
        placed = self._orient_line(lines, k, alpha)
        if overlap_ratio(placed.segments, self.walls[line].segments) < self._features.min_overlap:
            return None
        x, y, theta = self.mean[:3].tolist()
        cos, sin = math.cos(alpha), math.sin(alpha)
        difference = placed.observed - (alpha - theta, r - x * cos - y * sin)
        difference[0] = float(se2.wrap(difference[0]))
        jacobian = np.zeros((2, self.mean.size))
        jacobian[0, 2], jacobian[1, :2] = -1.0, (-cos, -sin)
        jacobian[:, _state_slice(line)] = ((1.0, 0.0), (x * sin - y * cos, 1.0))
        return Pairing(k, line, difference, jacobian, placed.covariance)

    def _parallel_lines(self, lines: Lines, k: int) -> list[int]:
        """The lines of the map that an observed line may be by its direction alone: all others are beyond the gate."""
        away = np.abs(se2.wrap(lines.parameters[k, 0] + self.mean[2] - self.lines[:, 0]))
        variances = np.diagonal(self.covariance)
        # A deviation of a sum is no larger than the sum of the deviations.
        deviations = math.sqrt(lines.covariances[k, 0, 0]) + math.sqrt(variances[2]) + np.sqrt(variances[3::2])
        within = np.minimum(away, np.pi - away) <= math.sqrt(self._gate) * deviations
        found: list[int] = np.flatnonzero(within).tolist()
        return found

    def _pairings(self, lines: Lines, k: int) -> list[Pairing]:
        """All lines of the map that an observed line may be, Eq. (13)."""
        every = (self._pair_lines(lines, k, line) for line in self._parallel_lines(lines, k))
        return [each for each in every if each and each.distance2(self.covariance) <= self._gate]

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

    def _add_line(self, placed: _OrientedLine, sightings: int) -> int:
        """Take a new line in, Eqs. (9) to (11); return its name."""
        size = self.mean.size
        covariance = np.zeros((size + 2, size + 2))
        covariance[:size, :size] = self.covariance
        cos, sin = math.cos(placed.line[0]), math.sin(placed.line[0])
        along = self.mean[1] * cos - self.mean[0] * sin
        by_robot, by_line = np.array([[0.0, 0.0, 1.0], [cos, sin, along]]), np.array([[1.0, 0.0], [along, 1.0]])
        covariance[size:, :size] = by_robot @ self.covariance[:3]
        covariance[:size, size:] = covariance[size:, :size].T
        own = by_line @ placed.covariance @ by_line.T
        covariance[size:, size:] = by_robot @ self.covariance[:3, :3] @ by_robot.T + own
        self.mean, self.covariance = np.concatenate((self.mean, placed.line)), covariance
        self.clones = self.clones.add_line(by_robot)
        self.walls.append(
            WallLine(self._next_number, sightings, join_segments(placed.segments, self._features.max_gap))
        )
        self._next_number += 1
        return self.walls[-1].number

    def _extend_segments(self, line: int, pieces: Float64) -> None:
        """Join what was seen of a line with what had been."""
        wall = self.walls[line]
        pieces = join_segments(np.concatenate((wall.segments, pieces)), self._features.max_gap)
        self.walls[line] = wall._replace(segments=pieces)

    def _prune_lines(self, seen: Collection[int]) -> None:
        """Forget the lines that were seen too seldom and, by their names, not this time."""
        enough = self._features.min_sightings
        for line in reversed(range(len(self))):
            if self.walls[line].sightings < enough and self.walls[line].number not in seen:
                self._remove_line(line)

    def _merge_lines(self) -> Iterator[tuple[int, int]]:
        """Make one of lines that are one; their names."""
        while pair := most_similar_pair(self.lines, self.covariance[3:, 3:], self._mean_positions(), self._merge_gate):
            one, other = pair
            jacobian = np.zeros((2, self.mean.size))
            jacobian[:, _state_slice(one)], jacobian[:, _state_slice(other)] = np.eye(2), -np.eye(2)
            difference = self.lines[other] - self.lines[one]
            difference[0] = se2.wrap(difference[0])
            # Eqs. (14) to (17), observed for certain: their difference is 0.
            self._correct(jacobian, difference, np.zeros((2, 2)))
            wall, part = self.walls[one], self.walls[other]
            self.walls[one] = wall._replace(sightings=wall.sightings + part.sightings)
            self._extend_segments(one, part.segments)
            self._remove_line(other)
            yield wall.number, part.number

    def _mean_positions(self) -> Float64:
        return np.array([mean_position(wall.segments) for wall in self.walls])

    def _remove_line(self, line: int) -> None:
        """Take a line out of the state; what it told of the others stays."""
        left = np.delete(np.arange(self.mean.size), _state_slice(line))
        self.mean, self.covariance = self.mean[left], self.covariance[np.ix_(left, left)]
        self.clones = self.clones.select_columns(left)
        del self.walls[line]


def _state_slice(line: int) -> slice:
    """Where a line is in the state."""
    return slice(3 + 2 * line, 5 + 2 * line)


def _rotation(theta: float) -> Float64:
    """From the robot's frame to that of the map, (3, 3)."""
    cos, sin = math.cos(theta), math.sin(theta)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
