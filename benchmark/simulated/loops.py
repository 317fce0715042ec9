"""True loops of a drive, and the time at which the map closed each.

A re-entry is the arrival of the robot, after meters of new ground, at the place of an old keyframe. Such a loop can
be closed if the robot stays on known ground for some meters, with a shared view, and the definite map had not joined
the two places. It is closed when a keyframe of the definite map from there on is in the same area as an old one of its
place, or in an adjacent area.

A re-entered place may look like others. Odometry or a different view can separate them. The probability by odometry
follows from the simulated readings under their true covariance. Views are those of a laser without noise, at the true
pose and at its image in the other place.
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
from hmt_slam_ros.sensors.relative_motion import increment_covariance
from hmt_slam_ros.simulation import SimulatedLog
from hmt_slam_ros.simulation.simulated_log import same_place

OLD = 10.0
"""Smallest path between two keyframes of a loop, m."""

AWAY, STAY = 5.0, 5.0
"""Path on new ground before, and on known ground after, a re-entry, m."""

VIEW = 0.5
"""Smallest share of a keyframe's view that an old keyframe has too, for scans that can show the loop."""

GRACE = 10.0
"""Path beyond the known ground within which a loop still counts as closed in time, m."""

_VIEW_STRETCH = 10.0  # m of known ground, on which half of the keyframes must have a shared view
_PARTNERS = 3

ALIKE_VIEW, ALIKE_BEAMS = 0.1, 0.05
"""Largest difference of beams, m, and largest share of beams beyond that, of views that look the same."""

ALIKE_RADIUS = 2.0
"""Largest distance of the image of a pose from an old keyframe of its place, m."""


@dataclass
class Loop:
    """A re-entry into a known place.

    :ivar event: the first keyframe event there.
    :ivar begin: path length since the start at that event, m; ``end``, at the last on known ground.
    :ivar length: path since the robot was there before, m.
    :ivar partners: {keyframe event: old keyframes of its place, the nearest first}.
    :ivar linked: whether the map had joined the two places before.
    :ivar closed_at: path length at which the definite map joined them, m; None before.
    :ivar closed_by_event: the keyframe event of that.
    :ivar view: share of the first keyframes there with a shared view.
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
        """Whether the places were not joined, and scans can show that they are the same."""
        return not self.linked and self.end - self.begin >= STAY and self.view >= 0.5

    @property
    def in_time(self) -> bool:
        """Whether it was closed before the end of the known ground."""
        return self.closed_at is not None and self.closed_at <= self.end + GRACE


class Loops:
    """Finds the loops of a drive.

    :ivar found: in the order of time.
    """

    def __init__(self, truth: Truth) -> None:
        self._truth = truth
        self._traveled: dict[int, float] = {}
        self.found: list[Loop] = []
        self._new_ground = 0.0
        self._before = 0.0

    def add_event(self, event: int, traveled: float, known: HybridMap, area: int) -> None:
        """Add a keyframe event.

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
        """Update the loops by the definite map after a keyframe event, and the robot's area in it."""
        unclosed = [loop for loop in self.found if loop.closed_at is None]
        areas = _area_of_keyframes(known) if unclosed else {}
        for loop in unclosed:
            area_of_event = {k: areas[k] for k in loop.partners if k in areas}
            if event in loop.partners:
                # Redundant keyframes are in no area.
                area_of_event[event] = area
            if any(_is_linked(known, areas, area_then, loop.partners[k]) for k, area_then in area_of_event.items()):
                loop.closed_at, loop.closed_by_event = self._traveled[event], event

    def finish(self) -> None:
        """Compute the shared view of each loop."""
        for loop in self.found:
            if not loop.linked and loop.end - loop.begin >= STAY:
                first = [k for k in loop.partners if self._traveled[k] <= loop.begin + _VIEW_STRETCH]
                is_shared = [self._truth.shared_view(k, loop.partners[k]).max() >= VIEW for k in first]
                loop.view = float(np.mean(is_shared))

    def _partners(self, event: int, old: list[int]) -> tuple[int, ...]:
        """The nearest old keyframes in whose place the robot is."""
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
    """Whether one of the keyframes is in an area or in an adjacent one."""
    near = {area, *hybrid_map.neighbors(area)}
    return any(areas.get(keyframe) in near for keyframe in keyframes)


@dataclass(frozen=True)
class Rivalry:
    """A re-entry into a known place that looks the same as other known places.

    :ivar event: the first keyframe event there.
    :ivar since: the last keyframe event with a certain pose: the last before the robot saw nothing, or if it always saw
        something, the last one in this place.
    :ivar by_odometry: probability of the true place among all that look the same, by odometry alone since then.
    :ivar evidence: the first keyframe event at which the views differ; None if there is none.
    """

    event: int
    since: int
    by_odometry: float
    evidence: int | None


def find_rivalries(log: SimulatedLog, truth: Truth, loops: list[Loop], traveled: Mapping[int, float]) -> list[Rivalry]:
    """The rivalries of a drive.

    :param loops: of the drive.
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
    """The motions of the world, ``world_T_world``, that map one of the places to another."""
    frames = list(places.values())
    pairs = [(a, b) for a in frames for b in frames if a is not b]
    moves = [se2.compose(b, se2.inverse(a)) for a, b in pairs]
    return [move for k, move in enumerate(moves) if not any(np.allclose(move, other) for other in moves[:k])]


def _is_known_place(log: SimulatedLog, image: Pose, poses: Pose) -> bool:
    return bool(same_place(log.scenario.walls, image[None], poses, ALIKE_RADIUS).any())


def _is_any_alike(log: SimulatedLog, pose: Pose, moves: list[Pose]) -> bool:
    return any(looks_alike(log, pose, se2.compose(move, pose)) for move in moves)


def looks_alike(log: SimulatedLog, pose: Pose, image: Pose) -> bool:
    """Whether the views of a laser without noise from two poses are the same, and not empty."""
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
    """Probabilities (n,) of some poses ``world_T_base`` at an event, by odometry alone.

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
