"""Where the robot enters a place that looks like another one it knows, and what the truth lets it know of which it is.

Two things tell such places apart: odometry, and a view that is not the same in both. What odometry alone says is worked
out from the readings as the simulation made them, under the covariance that they truly have; what the views say, from
what a laser without noise would see from the true pose and from its image in the other place.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from benchmark.simulated.loops import OLD, Loop
from benchmark.simulated.truth import Pose, Truth
from hmt_slam_ros.configuration.metric_slam import Motion
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.sensors.motion_model import increment_covariance
from hmt_slam_ros.simulation import SimulatedLog
from hmt_slam_ros.simulation.sight import same_place

VIEW, BEAMS = 0.1, 0.05
"""Two views differ where more than this share of the beams differ by more than so many m."""

RADIUS = 2.0
"""The image of a pose is in a known place within this distance of an old keyframe, and in its sight, m."""


@dataclass(frozen=True)
class Rivalry:
    """A known place that the robot enters again, and others that it knows and that look the same.

    :ivar event: the first keyframe event there.
    :ivar since: the last keyframe event at which the robot knew where it was: the last before it saw nothing, or where
        it always saw something, when it was there last.
    :ivar by_odometry: probability of the true place among all that look the same, by odometry alone since then.
    :ivar evidence: the first keyframe event at which the view is not the same in all of them; None where that is never.
    """

    event: int
    since: int
    by_odometry: float
    evidence: int | None


def rivalries(log: SimulatedLog, truth: Truth, loops: list[Loop], travelled: Mapping[int, float]) -> list[Rivalry]:
    """All of a drive.

    :param loops: the places that the robot entered again.
    :param travelled: {keyframe event: path length since the start, m}.
    """
    moves = _moves(log.scenario.building.places)
    found = [_rivalry(log, truth, loop, moves, travelled) for loop in loops if moves]
    return [rivalry for rivalry in found if rivalry is not None]


def _rivalry(
    log: SimulatedLog, truth: Truth, loop: Loop, moves: list[Pose], travelled: Mapping[int, float]
) -> Rivalry | None:
    for event, partners in loop.partners.items():
        here = truth.poses[event]
        old = np.array([truth.poses[k] for k, at in travelled.items() if at <= travelled[event] - OLD])
        images = [move for move in moves if _known(log, se2.compose(move, here), old)]
        rivals = [move for move in images if looks_alike(log, here, se2.compose(move, here))]
        if rivals:
            since = _last_certain(log, truth, event, max(partners))
            poses = [here, *(se2.compose(move, here) for move in rivals)]
            weights = by_odometry(log, truth, since, event, poses)
            later = (k for k in loop.partners if k >= event)
            evidence = next((k for k in later if not _any_alike(log, truth.poses[k], rivals)), None)
            return Rivalry(event, since, float(weights[0]), evidence)
    return None


def _moves(places: Mapping[str, Pose]) -> list[Pose]:
    """The motions of the world, ``world_T_world``, that carry one of the places into another."""
    frames = list(places.values())
    pairs = [(a, b) for a in frames for b in frames if a is not b]
    moves = [se2.compose(b, se2.inverse(a)) for a, b in pairs]
    return [move for k, move in enumerate(moves) if not any(np.allclose(move, other) for other in moves[:k])]


def _known(log: SimulatedLog, image: Pose, poses: Pose) -> bool:
    return bool(same_place(log.scenario.walls, image[None], poses, RADIUS).any())


def _any_alike(log: SimulatedLog, pose: Pose, moves: list[Pose]) -> bool:
    return any(looks_alike(log, pose, se2.compose(move, pose)) for move in moves)


def looks_alike(log: SimulatedLog, pose: Pose, image: Pose) -> bool:
    """Whether a laser without noise sees the same from two poses, and something at all."""
    views = [_view(log, at) for at in (pose, image)]
    seen = [np.isfinite(view) for view in views]
    differs = seen[0] != seen[1]
    both = seen[0] & seen[1]
    differs[both] = np.abs(views[0][both] - views[1][both]) > VIEW
    return bool(seen[0].any() and np.mean(differs) <= BEAMS)


def _view(log: SimulatedLog, pose: Pose) -> Pose:
    return log.scenario.laser.distances(pose[None], log.scenario.walls, np.empty((0, 3)))


def _last_certain(log: SimulatedLog, truth: Truth, event: int, last_visit: int) -> int:
    """See :attr:`Rivalry.since`."""
    blind = [k for k in range(last_visit, event) if not np.isfinite(_view(log, truth.poses[k])).any()]
    return max(last_visit, blind[0] - 1) if blind else last_visit


def by_odometry(log: SimulatedLog, truth: Truth, since: int, event: int, poses: list[Pose]) -> Pose:
    """Probabilities, shape (n,), of some poses ``world_T_base`` at an event, all alike but for odometry.

    :param since: the event from which on there is only odometry.
    """
    scenario = log.scenario
    first, last = np.searchsorted(scenario.scan_stamps, [truth.stamps[since], truth.stamps[event]])
    readings = scenario.odometry[:: scenario.settings.readings][first : last + 1]
    belief = PoseGaussian(truth.poses[since], np.zeros((3, 3)))
    for increment in se2.between(readings[:-1], readings[1:]):
        covariance = scenario.settings.odometry**2 * increment_covariance(increment, Motion())
        belief = belief.compose(PoseGaussian(increment, covariance))
    errors = [se2.log(se2.between(belief.mean, pose)) for pose in poses]
    logs = np.array([-0.5 * error @ np.linalg.solve(belief.covariance, error) for error in errors])
    weights = np.exp(logs - logs.max())
    return np.asarray(weights / weights.sum())
