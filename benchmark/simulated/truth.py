"""What is true of a simulated run: where keyframes were taken, which places are the same, how right a claim is.

An area's frame has no place in the world of its own: what can be seen of it are its keyframes. Its true pose is told by
the keyframe that lies nearest to its origin, which is the one that it began with. A claim that keyframes lie in a known
area is judged where it matters, between the two keyframes that truly are nearest to each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.messages import Keyframe
from hmt_slam_ros.simulation import SimulatedLog

Pose = NDArray[np.float64]

RADIUS = 2.0
"""Keyframes within this distance and in sight of each other are in the same place, m: ``tsbi.place_radius``."""

GREY = 0.25
"""Part of the radius by which either verdict on "the same place" counts as right."""

NEAR, FAR, TURN = 0.5, 2.0, 10.0
"""Largest error of a true claim, m and degrees: ``NEAR``, or up to ``FAR`` where the claim's covariance admits it."""

_ADMITTED = 16.27  # chi-square with 3 degrees of freedom at 99.9 %
# What keyframes are off within their areas, of which the covariance of a claim knows nothing: m, m, rad.
_WITHIN_AREAS = np.diag([0.1, 0.1, np.radians(1.0)]) ** 2


class Claim(NamedTuple):
    """How right it is to say where some keyframes lie in a known area.

    :ivar pair: the two keyframes by which it is judged, the known one first.
    :ivar apart: true distance of the two, m.
    :ivar same_place: whether they are within the radius, the grey part included, and in sight of each other.
    :ivar translation: error of their relative pose, m.
    :ivar rotation: likewise, degrees.
    :ivar mahalanobis2: squared, of that error under the claim's covariance.
    """

    pair: tuple[int, int]
    apart: float
    same_place: bool
    translation: float
    rotation: float
    mahalanobis2: float

    @property
    def true(self) -> bool:
        """Whether the areas meet there, and as claimed."""
        admitted = self.translation <= FAR and self.mahalanobis2 <= _ADMITTED
        return self.same_place and self.rotation <= TURN and (self.translation <= NEAR or admitted)


class Truth:
    """The truth about the keyframes of a run.

    :ivar log: the simulated log.
    :ivar stamps: {keyframe: of its scan, ns}.
    :ivar poses: {keyframe: ``world_T_base``, shape (3,)}.
    """

    def __init__(self, log: SimulatedLog) -> None:
        self.log = log
        self.stamps: dict[int, int] = {}
        self.poses: dict[int, Pose] = {}

    def note(self, keyframe: Keyframe) -> None:
        """Learn of a keyframe event."""
        self.stamps[keyframe.sequence] = keyframe.scan.stamp
        self.poses[keyframe.sequence] = self.log.true_poses(np.array([keyframe.scan.stamp]))[0]

    def same_place(self, keyframes: Sequence[int], others: Sequence[int], radius: float = RADIUS) -> NDArray[np.bool_]:
        """Which of n keyframes were taken where which of m others were, shape (n, m)."""
        return self.log.same_place(self._stamps(keyframes), self._stamps(others), radius)

    def shared_view(self, keyframe: int, others: Sequence[int]) -> NDArray[np.float64]:
        """How much of what a keyframe saw the others saw too, shape (m,), from 0 to 1."""
        shares = self.log.shared_view(self._stamps([keyframe]), self._stamps(others))
        return np.asarray(shares[0], dtype=np.float64)

    def share_in(self, keyframes: Sequence[int], known: Sequence[int], radius: float) -> float:
        """Share of the keyframes that were taken in the same place as any of the known ones."""
        return float(np.mean(self.same_place(keyframes, known, radius).any(axis=1))) if len(known) else 0.0

    def frame(self, hybrid_map: HybridMap, area: int) -> Pose:
        """``world_T_area``."""
        placed = hybrid_map.keyframes(area)
        first = min(placed, key=lambda keyframe: (_from_origin(placed[keyframe]), keyframe))
        return se2.compose(self.poses[first], se2.inverse(placed[first]))

    def claim(
        self, known: Mapping[int, Pose], asked: Mapping[int, Pose], covariance: NDArray[np.float64], origin: Pose
    ) -> Claim:
        """Judge where keyframes are said to lie in a known area.

        :param known: {keyframe: ``area_T_base``} of the area.
        :param asked: likewise of the keyframes in question.
        :param covariance: of the claim, right tangent of ``area_T_origin``, shape (3, 3).
        :param origin: ``area_T_origin``, shape (3,).
        """
        true_known, true_asked = (np.array([self.poses[k] for k in placed]) for placed in (known, asked))
        apart = np.hypot(*(true_known[:, None, :2] - true_asked[None, :, :2]).transpose(2, 0, 1))
        same = self.same_place(list(known), list(asked), (1.0 + GREY) * RADIUS)
        # A wall may stand between the two that are nearest.
        k, m = np.unravel_index(np.argmin(np.where(same, apart, apart + 1e6)), apart.shape)
        ours, theirs = list(known.values())[k], list(asked.values())[m]
        claimed = se2.between(ours, theirs)
        error = se2.between(claimed, se2.between(true_known[k], true_asked[m]))
        spread = (
            PoseGaussian(origin, covariance)
            .compose(PoseGaussian(se2.between(origin, theirs), np.zeros((3, 3))))
            .covariance
            + _WITHIN_AREAS
        )
        xi = se2.log(error)
        return Claim(
            (list(known)[k], list(asked)[m]),
            float(apart[k, m]),
            bool(same[k, m]),
            float(np.hypot(error[0], error[1])),
            float(np.degrees(abs(error[2]))),
            float(xi @ np.linalg.solve(spread, xi)),
        )

    def _stamps(self, keyframes: Sequence[int]) -> NDArray[np.int64]:
        return np.array([self.stamps[keyframe] for keyframe in keyframes], dtype=np.int64)


def _from_origin(pose: Pose) -> float:
    """Distance from the origin, m, a radian of turn counted as a metre."""
    return float(np.hypot(pose[0], pose[1]) + abs(pose[2]))


def nees(belief: PoseGaussian, truth: Pose) -> float:
    """Normalised estimation error squared: chi-square with 3 degrees of freedom where a belief is as right as it says.

    :param truth: of the pose that the belief is over, shape (3,).
    """
    xi = se2.log(se2.between(belief.mean, truth))
    return float(xi @ np.linalg.solve(belief.covariance, xi))
