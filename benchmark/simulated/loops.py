"""Loops that a drive offers to close, by the truth alone, and when the map closed each.

The robot *enters again* where, after some metres on ground that it had not driven on, it comes to the place of a
keyframe of long before. Such a loop can be closed where the robot stays on known ground for some metres, sees there
what it saw before, and where the definite map did not know yet that the two places meet. It is closed when the definite
map has a keyframe from there on in the same area as one of the old ones of its place, or in an area beside it.

A place that is entered again may look like others. Two things tell them apart: odometry, and a view that differs.
What odometry says follows from the simulated readings under their true covariance. What views say follows from a laser
without noise, at the true pose and at its image in the other place.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from benchmark.simulated.truth import Pose, Truth
from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.sensors.motion_model import increment_covariance
from hmt_slam_ros.simulation import SimulatedLog
from hmt_slam_ros.simulation.sight import same_place

OLD = 10.0
"""Path between two keyframes from which on the second enters again, m."""

AWAY, STAY = 5.0, 5.0
"""Path on new ground before, and on known ground after, a place is entered again, m."""

VIEW = 0.5
"""Share of what a keyframe sees that was seen before where the scans can show that it is the same place."""

GRACE = 10.0
"""Path beyond the known ground within which a loop still counts as closed in time, m."""

_VIEW_STRETCH = 10.0  # m of the known ground, on half of whose keyframes the view must be shared
_PARTNERS = 3

ALIKE_VIEW, ALIKE_BEAMS = 0.1, 0.05
"""Two views differ where more than this share of the beams differ by more than so many m."""

ALIKE_RADIUS = 2.0
"""The image of a pose is in a known place within this distance of an old keyframe, and in its sight, m."""


@dataclass
class Loop:
    """A place that was entered again.

    :ivar event: the first keyframe event there.
    :ivar begin: path length since the start at that event, m; ``end``, at the last on known ground.
    :ivar length: path since the robot was there before, m.
    :ivar partners: {keyframe event: old keyframes of its place, the nearest first}.
    :ivar linked: whether the map had joined the two places already.
    :ivar closed_at: path length at which the definite map joined them, m; None before.
    :ivar closed_by_event: the keyframe event of that.
    :ivar view: share of the first keyframes there that see what was seen before.
    """

    event: int
    begin: float
    end: float
    length: float
    partners: dict[int, tuple[int, ...]] = field(default_factory=dict)
    linked: bool = False
    closed_at: float | None = None
    closed_by_event: int | None = None
    view: float = 0.0

    @property
    def can_be_closed(self) -> bool:
        """Whether there was something to close and the scans could show it."""
        return not self.linked and self.end - self.begin >= STAY and self.view >= 0.5

    @property
    def in_time(self) -> bool:
        """Whether it was closed before the robot was off again."""
        return self.closed_at is not None and self.closed_at <= self.end + GRACE


class Loops:
    """Finds loops while the robot drives.

    :ivar found: in the order of time.
    """

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self._traveled: dict[int, float] = {}
        self.found: list[Loop] = []
        self._new_ground = 0.0
        self._before = 0.0

    def add_event(self, event: int, traveled: float, known: HybridMap, area: int) -> None:
        """Learn of a keyframe event.

        :param known: the map of the most probable hypothesis before it.
        :param area: the robot's area there.
        """
        old = [k for k, at in self._traveled.items() if at <= traveled - OLD]
        partners = self._partners(event, old)
        self._traveled[event] = traveled
        step, self._before = traveled - self._before, traveled
        if not partners:
            self._new_ground += step
            return
        if not self.found or self._new_ground >= AWAY:
            length = traveled - max(self._traveled[k] for k in partners)
            linked = _is_linked(known, _area_of_keyframes(known), area, partners)
            self.found.append(Loop(event, traveled, traveled, length, linked=linked))
        self._new_ground = 0.0
        self.found[-1].partners[event] = partners
        self.found[-1].end = traveled

    def update_definite(self, event: int, known: HybridMap, area: int) -> None:
        """Learn of the definite map at a keyframe event, and of the robot's area in it."""
        unclosed = [loop for loop in self.found if loop.closed_at is None]
        areas = _area_of_keyframes(known) if unclosed else {}
        for loop in unclosed:
            area_of_event = {k: areas[k] for k in loop.partners if k in areas}
            if event in loop.partners:
                # Keyframes that tell nothing new are in no area.
                area_of_event[event] = area
            if any(_is_linked(known, areas, area_then, loop.partners[k]) for k, area_then in area_of_event.items()):
                loop.closed_at, loop.closed_by_event = self._traveled[event], event

    def finish(self) -> None:
        """Work out what of each loop could be seen."""
        for loop in self.found:
            if not loop.linked and loop.end - loop.begin >= STAY:
                first = [k for k in loop.partners if self._traveled[k] <= loop.begin + _VIEW_STRETCH]
                is_shared = [self._truth.shared_view(k, loop.partners[k]).max() >= VIEW for k in first]
                loop.view = float(np.mean(is_shared))

    def _partners(self, event: int, old: list[int]) -> tuple[int, ...]:
        """The old keyframes in whose place the robot is, the nearest of them."""
        if not old:
            return ()
        inside = self._truth.same_place([event], old)[0]
        here = self._truth.poses[event]
        near = [k for k, same in zip(old, inside, strict=True) if same]
        return tuple(sorted(near, key=lambda k: float(np.hypot(*(self._truth.poses[k] - here)[:2])))[:_PARTNERS])


def _area_of_keyframes(hybrid_map: HybridMap) -> dict[int, int]:
    """{keyframe: its area}."""
    return {k: area for area in hybrid_map.area_ids() for k in hybrid_map.keyframes(area)}


def _is_linked(hybrid_map: HybridMap, areas: Mapping[int, int], area: int, keyframes: tuple[int, ...]) -> bool:
    """Whether one of the keyframes is in an area or in one beside it."""
    near = {area, *hybrid_map.neighbors(area)}
    return any(areas.get(keyframe) in near for keyframe in keyframes)


@dataclass(frozen=True)
class Rivalry:
    """A known place that the robot enters again, and others that it knows and that look the same.

    :ivar event: the first keyframe event there.
    :ivar since: the last keyframe event at which the robot knew where it was: the last before it saw nothing, or where
        it always saw something, when it was there last.
    :ivar odometry_probabilities: probability of the true place among all that look the same, by odometry alone since then.
    :ivar evidence: the first keyframe event at which the view is not the same in all of them; None where that is never.
    """

    event: int
    since: int
    odometry_probabilities: float
    evidence: int | None


def find_rivalries(log: SimulatedLog, truth: Truth, loops: list[Loop], traveled: Mapping[int, float]) -> list[Rivalry]:
    """All of a drive.

    :param loops: the places that the robot entered again.
    :param traveled: {keyframe event: path length since the start, m}.
    """
    moves = _twin_motions(log.scenario.building.twin_frames)
    found = [_find_rivalry(log, truth, loop, moves, traveled) for loop in loops if moves]
    return [rivalry for rivalry in found if rivalry is not None]


def _find_rivalry(
    log: SimulatedLog, truth: Truth, loop: Loop, moves: list[Pose], traveled: Mapping[int, float]
) -> Rivalry | None:
    for event, partners in loop.partners.items():
        here = truth.poses[event]
        old = np.array([truth.poses[k] for k, at in traveled.items() if at <= traveled[event] - OLD])
        images = [move for move in moves if _is_known_place(log, se2.compose(move, here), old)]
        rivals = [move for move in images if looks_alike(log, here, se2.compose(move, here))]
        if rivals:
            since = _last_certain(log, truth, event, max(partners))
            poses = [here, *(se2.compose(move, here) for move in rivals)]
            weights = odometry_probabilities(log, truth, since, event, poses)
            later = (k for k in loop.partners if k >= event)
            evidence = next((k for k in later if not _is_any_alike(log, truth.poses[k], rivals)), None)
            return Rivalry(event, since, float(weights[0]), evidence)
    return None


def _twin_motions(places: Mapping[str, Pose]) -> list[Pose]:
    """The motions of the world, ``world_T_world``, that carry one of the places into another."""
    frames = list(places.values())
    pairs = [(a, b) for a in frames for b in frames if a is not b]
    moves = [se2.compose(b, se2.inverse(a)) for a, b in pairs]
    return [move for k, move in enumerate(moves) if not any(np.allclose(move, other) for other in moves[:k])]


def _is_known_place(log: SimulatedLog, image: Pose, poses: Pose) -> bool:
    return bool(same_place(log.scenario.walls, image[None], poses, ALIKE_RADIUS).any())


def _is_any_alike(log: SimulatedLog, pose: Pose, moves: list[Pose]) -> bool:
    return any(looks_alike(log, pose, se2.compose(move, pose)) for move in moves)


def looks_alike(log: SimulatedLog, pose: Pose, image: Pose) -> bool:
    """Whether a laser without noise sees the same from two poses, and something at all."""
    views = [_noiseless_ranges(log, at) for at in (pose, image)]
    seen = [np.isfinite(view) for view in views]
    differs = seen[0] != seen[1]
    both = seen[0] & seen[1]
    differs[both] = np.abs(views[0][both] - views[1][both]) > ALIKE_VIEW
    return bool(seen[0].any() and np.mean(differs) <= ALIKE_BEAMS)


def _noiseless_ranges(log: SimulatedLog, pose: Pose) -> Pose:
    return log.scenario.laser.distances(pose[None], log.scenario.walls, np.empty((0, 3)))


def _last_certain(log: SimulatedLog, truth: Truth, event: int, last_visit: int) -> int:
    """See :attr:`Rivalry.since`."""
    blind = [k for k in range(last_visit, event) if not np.isfinite(_noiseless_ranges(log, truth.poses[k])).any()]
    return max(last_visit, blind[0] - 1) if blind else last_visit


def odometry_probabilities(log: SimulatedLog, truth: Truth, since: int, event: int, poses: list[Pose]) -> Pose:
    """Probabilities, shape (n,), of some poses ``world_T_base`` at an event, all alike but for odometry.

    :param since: the event from which on there is only odometry.
    """
    scenario = log.scenario
    first, last = np.searchsorted(scenario.scan_stamps, [truth.stamps[since], truth.stamps[event]])
    readings = scenario.odometry[:: scenario.settings.readings][first : last + 1]
    belief = PoseGaussian(truth.poses[since], np.zeros((3, 3)))
    for increment in se2.between(readings[:-1], readings[1:]):
        covariance = scenario.settings.odometry**2 * increment_covariance(increment, MotionParameters())
        belief = belief.compose(PoseGaussian(increment, covariance))
    errors = [se2.log(se2.between(belief.mean, pose)) for pose in poses]
    logs = np.array([-0.5 * error @ np.linalg.solve(belief.covariance, error) for error in errors])
    weights = np.exp(logs - logs.max())
    return np.asarray(weights / weights.sum())
