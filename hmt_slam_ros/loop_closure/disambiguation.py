"""Active disambiguation: where a look would decide between the live hypotheses, and by how much.

A look is at a pose relative to the robot, in the direction in which it arrives there. Under each hypothesis the map has
a scan for it, that of a keyframe beside it. All hypotheses weigh what of it the robot's laser would see, as TSBI does.
The expected information is that of all scans on the path.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.loop_closure.known_ground import REACH, ROBOT, KnownGround, known_ground
from hmt_slam_ros.messages.ambiguity import NOT_DRIVEN, Ambiguity, Look
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.registration.consistency import MAPS_OUTLIER_RATE, SCAN_IN_STORED_MAP, Agreement
from hmt_slam_ros.registration.likelihood_grid import GridModel, surface_points
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.polar_scan import FREE, SURFACE, PolarScan, classify_points, is_in_view, to_polar_scan

MIN_PROBABILITY = 0.02
"""Smallest probability of a hypothesis that is weighed."""

MAX_HYPOTHESES, MAX_LOOKS = 4, 40
"""Hypotheses that are weighed, the most probable, and looks, the nearest: they bound the work of an event."""

_SPACING = 1.0
"""Distance between looks, m."""

_VIEW_RADIUS = 1.0
"""Distance of a keyframe up to which its scan is what the robot would see, m."""

_VIEW_SCANS = 4
"""Keyframes beside a look, the nearest, of which the one with the most in the robot's field of view is chosen."""

_MAP_RADIUS, _MAP_SCANS = 1.5, 4
"""Distance of the keyframes from a predicted scan, m, and their number, that are the map for it."""

_SAME_PLACE = 0.5
"""Difference of poses of a keyframe, from the robot, up to which hypotheses have it in the same place, m and rad."""

_SAME_POSE = 1e-6
"""Likewise, up to which its scan needs no comparison with itself."""


class _Place(NamedTuple):
    """Where a look is.

    :ivar pose: shape (3,), ``base_T_look``, m and rad; it heads along the path.
    :ivar length: of the path there, m.
    :ivar previous: number of the look that the path passes last, ``NOT_DRIVEN`` for none.
    """

    pose: Float64
    length: float
    previous: int


class _View(NamedTuple):
    """The scan that a hypothesis predicts for a look.

    :ivar keyframe: of the scan.
    :ivar pose: shape (3,), ``base_T_keyframe``.
    :ivar points: shape (n, 2), surface points in the robot's field of view, frame of the keyframe, m.
    """

    keyframe: int
    pose: Float64
    points: Float64


class Disambiguation:
    """Computes the looks of the live hypotheses."""

    def __init__(self, configuration: Configuration) -> None:
        self._model = GridModel.from_configuration(configuration)

    def ambiguity(self, sequence: int, replica: Replica, poses: Mapping[int, Float64]) -> Ambiguity:
        """The ambiguity after a keyframe event.

        :param poses: {hypothesis: ``area_T_base`` in the hypothesis's area, shape (3,)}.
        """
        weights = probable_hypotheses(replica.probabilities)
        if len(weights) < 2:
            return Ambiguity(sequence, 0.0, (), "")
        grounds = [known_ground(replica.maps[h], replica.robot_areas[h], poses[h]) for h in weights]
        places = _choose_places(grounds)
        probabilities = np.array(list(weights.values()))
        information = _Information(replica.scans, self._model, grounds, probabilities).expected_information(places)
        best = next(iter(weights))
        frames = [_in_best_map(place.pose, grounds[0], replica, best, poses[best]) for place in places]
        looks = tuple(
            Look(area, pose, amount, place.length, place.previous)
            for (area, pose), amount, place in zip(frames, information, places, strict=True)
        )
        entropy = float(-(probabilities @ np.log(probabilities)))
        ambiguity = Ambiguity(sequence, entropy, looks, "")
        areas = [replica.robot_areas[h] for h in weights]
        text = _describe(ambiguity, [place.pose for place in places], areas, list(weights.values()))
        return Ambiguity(sequence, entropy, looks, text)


def probable_hypotheses(probabilities: Mapping[int, float]) -> dict[int, float]:
    """{hypothesis: probability} of those that are weighed, the most probable first; the sum is 1."""
    ranked = sorted(probabilities, key=lambda h: (-probabilities[h], h))[:MAX_HYPOTHESES]
    probable = {h: probabilities[h] for h in ranked if probabilities[h] >= MIN_PROBABILITY}
    total = sum(probable.values())
    return {h: probability / total for h, probability in probable.items()}


def _choose_places(grounds: Sequence[KnownGround]) -> list[_Place]:
    """The places of looks: keyframes of all hypotheses along their paths, the nearest, apart from each other."""
    rows = [(ground.lengths[row], n, row) for n, ground in enumerate(grounds) for row in range(len(ground.lengths))]
    places: list[_Place] = []
    # The look at, or beside, each keyframe.
    looks: list[dict[int, int]] = [{ROBOT: NOT_DRIVEN} for _ in grounds]
    for length, n, row in sorted(rows):
        ground = grounds[n]
        at = ground.poses[row]
        beside = _look_beside(places, at)
        if beside is None:
            if len(places) == MAX_LOOKS:
                break
            previous = looks[n][int(ground.previous[row])]
            before = np.zeros(2) if previous == NOT_DRIVEN else places[previous].pose[:2]
            heading = math.atan2(at[1] - before[1], at[0] - before[0])
            places.append(_Place(np.array((at[0], at[1], heading)), float(length), previous))
            beside = len(places) - 1
        looks[n][row] = beside
    return places


def _look_beside(places: Sequence[_Place], pose: Float64) -> int | None:
    """The nearest look that is too near to a pose for another one; ``NOT_DRIVEN`` beside the robot, None for none."""
    if math.hypot(pose[0], pose[1]) < _SPACING:
        return NOT_DRIVEN
    distances = [math.hypot(*(place.pose - pose)[:2]) for place in places]
    nearest = int(np.argmin(distances)) if distances else None
    return nearest if nearest is not None and distances[nearest] < _SPACING else None


class _Information:
    """The expected information of looks."""

    def __init__(
        self, scans: Mapping[int, Scan], model: GridModel, grounds: Sequence[KnownGround], probabilities: Float64
    ) -> None:
        """:param grounds: of the hypotheses.

        :param probabilities: of the hypotheses, shape (n,), of sum 1.
        """
        self._scans, self._model, self._grounds, self._probabilities = scans, model, grounds, probabilities
        self._points: dict[int, Float64] = {}
        self._polar_scans: dict[int, PolarScan] = {}
        self._laser = self._polar_scan(max(scans))

    def expected_information(self, places: Sequence[_Place]) -> list[float]:
        """The expected decrease of the entropy by the scans on the path to each place and there, nats."""
        count = len(self._grounds)
        sums: list[Float64] = []
        for place in places:
            before = np.zeros((count, count)) if place.previous == NOT_DRIVEN else sums[place.previous]
            sums.append(before + self._log_ratios(place.pose))
        return [self._expected_decrease(log_ratios) for log_ratios in sums]

    def _expected_decrease(self, log_ratios: Float64) -> float:
        """I = sum_h p_h log(L_h(z_h) / sum_j p_j L_j(z_h)), nats.

        :param log_ratios: log L_j(z_h), shape (n, n), a row for each h.
        """
        mixture = np.logaddexp.reduce(log_ratios + np.log(self._probabilities), axis=1)
        return max(0.0, float(self._probabilities @ (np.diag(log_ratios) - mixture)))

    def _log_ratios(self, pose: Float64) -> Float64:
        """The log-likelihood ratios of the scan that each hypothesis predicts, under each, relative to new ground.

        A hypothesis for which the robot would be on new ground predicts what a similar place shows.

        :param pose: ``base_T_look``.
        :returns: shape (n, n), a row for each predicted scan.
        """
        count = len(self._grounds)
        log_ratios = np.zeros((count, count))
        views = [self._predicted_view(ground, pose) for ground in self._grounds]
        if self._is_seen(pose, max(0 if view is None else len(view.points) for view in views)):
            return log_ratios
        samples = [0 if view is None else len(view.points) for view in views]
        for h, view in enumerate(views):
            for j in range(count):
                if view is None:
                    log_ratios[h, j] = SCAN_IN_STORED_MAP.log_ratio_in_similar_place(samples[j], MAPS_OUTLIER_RATE)
                elif views[j] is not None:
                    agreement = Agreement(samples[h], samples[h], 0) if h == j else self._agreement(view, j)
                    log_ratios[h, j] = SCAN_IN_STORED_MAP.log_likelihood_ratio(agreement, MAPS_OUTLIER_RATE)
        return log_ratios

    def _agreement(self, view: _View, hypothesis: int) -> Agreement:
        """The agreement of a predicted scan with the map of another hypothesis.

        What its scans do not see counts as agreement: a few scans know less than a map.
        """
        ground, points = self._grounds[hypothesis], view.points
        near = ground.rows_near(view.pose[:2], _MAP_RADIUS)[:_MAP_SCANS]
        if any(
            ground.keyframes[row] == view.keyframe and np.abs(ground.poses[row] - view.pose).max() <= _SAME_POSE
            for row in near
        ):
            return Agreement(len(points), len(points), 0)
        on_surface, is_free = np.zeros(len(points), np.bool_), np.zeros(len(points), np.bool_)
        for row in near:
            relative = se2.between(ground.poses[row], view.pose)
            classes = classify_points(self._polar_scan(int(ground.keyframes[row])), se2.transform(relative, points))
            on_surface |= classes == SURFACE
            is_free |= classes == FREE
        contradicting = int((is_free & ~on_surface).sum())
        return Agreement(len(points), len(points) - contradicting, contradicting)

    def _predicted_view(self, ground: KnownGround, pose: Float64) -> _View | None:
        """The scan of the keyframe beside a look that has the most in the robot's field of view, None on new ground.

        :param pose: ``base_T_look``.
        """
        rows = ground.rows_near(pose[:2], _VIEW_RADIUS)[:_VIEW_SCANS]
        views = (self._view(int(ground.keyframes[row]), ground.poses[row], pose) for row in rows)
        return max(views, key=lambda view: len(view.points), default=None)

    def _is_seen(self, pose: Float64, points: int) -> bool:
        """Whether the robot looked there before, wherever it is: all hypotheses have its keyframe at the same place.

        :param pose: ``base_T_look``.
        :param points: surface points of the predicted scans, of which the keyframe shows half at least.
        """
        first, *others = self._grounds
        for row in first.rows_near(pose[:2], _VIEW_RADIUS):
            keyframe, at = int(first.keyframes[row]), first.poses[row]
            if all(ground.has_keyframe_at(keyframe, at, _SAME_PLACE) for ground in others):
                view = self._view(keyframe, at, pose)
                if 2 * len(view.points) >= points:
                    return True
        return False

    def _view(self, keyframe: int, at: Float64, pose: Float64) -> _View:
        """The scan of a keyframe with what of it a robot sees at a look.

        :param at: ``base_T_keyframe``.
        :param pose: ``base_T_look``.
        """
        points = self._surface_points(keyframe)
        in_look = se2.transform(se2.between(pose, at), points)
        return _View(keyframe, at, points[is_in_view(self._laser, in_look)])

    def _surface_points(self, keyframe: int) -> Float64:
        if keyframe not in self._points:
            self._points[keyframe] = surface_points(self._scans[keyframe], self._model)
        return self._points[keyframe]

    def _polar_scan(self, keyframe: int) -> PolarScan:
        if keyframe not in self._polar_scans:
            self._polar_scans[keyframe] = to_polar_scan(self._scans[keyframe])
        return self._polar_scans[keyframe]


def _in_best_map(
    look: Float64, ground: KnownGround, replica: Replica, hypothesis: int, pose: Float64
) -> tuple[int, Float64]:
    """The area of a look and ``area_T_look`` (3,) in the map of a hypothesis; in the robot's area on new ground.

    :param look: ``base_T_look``.
    :param ground: under the hypothesis.
    :param pose: ``area_T_base`` of the robot.
    """
    near = ground.rows_near(look[:2], _VIEW_RADIUS)
    if not len(near):
        return replica.robot_areas[hypothesis], se2.compose(pose, look)
    area, hybrid_map = int(ground.areas[near[0]]), replica.maps[hypothesis]
    keyframe_pose = hybrid_map.keyframes(area)[int(ground.keyframes[near[0]])]
    return area, se2.compose(keyframe_pose, se2.between(ground.poses[near[0]], look))


def _describe(
    ambiguity: Ambiguity, places: Sequence[Float64], areas: Sequence[int], probabilities: Sequence[float]
) -> str:
    """One sentence about hypotheses and the best look.

    :param places: ``base_T_look`` of the looks.
    :param areas: the robot's, under each hypothesis, with its probability.
    """
    shares = (f"{probability:.2f} in area {area}" for area, probability in zip(areas, probabilities, strict=True))
    begin = f"{len(areas)} hypotheses are probable ({', '.join(shares)})"
    best = ambiguity.best_look()
    if best is None:
        return f"{begin}: no look within {REACH:g} m of path would decide"
    look = ambiguity.looks[best]
    verb = "decide" if look.information >= 0.5 * ambiguity.entropy else "help"
    return (
        f"{begin}: {look.path_length:.1f} m {_direction(places[best])}, in area {look.area}, a look would {verb}, "
        f"by {look.information / ambiguity.entropy:.0%} of what is open".replace("%", " %")
    )


def _direction(place: Float64) -> str:
    """Where a place is, in the frame of the robot."""
    quarter = round(math.atan2(place[1], place[0]) / (0.5 * math.pi)) % 4
    return ("ahead", "to the left", "behind", "to the right")[quarter]
