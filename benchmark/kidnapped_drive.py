"""Drives of a robot that is kidnapped: its localization at every keyframe event, and the scores."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.localization import localization_probability, robot_poses, slam_of
from benchmark.tail import Pair
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.topological_inference.tsbi import Tsbi

RIGHT, RIGHT_ANGLE, DRIFT = 0.5, math.radians(10.0), 0.03
"""Largest error of a right estimate, m and rad, and what is added to it for each meter from the nearest keyframe."""


@dataclass(frozen=True)
class Kidnapping:
    """The scores of one drive.

    :ivar noticed: path until the robot was not localized, or right again, m; inf if it never was.
    :ivar again: path until it was sure of the right place and stayed so, m; inf if it never was.
    :ivar confident: path after the detection on which it was sure of a wrong place, m.
    :ivar wrong: whether it was sure of a wrong place at the end.
    :ivar errors: mean error of translation at relations before and after the kidnapping, m.
    :ivar driven: path after the kidnapping, m.
    :ivar localizations: probability of localization at every keyframe event after the kidnapping, and whether its
        estimate is right.
    """

    noticed: float
    again: float
    confident: float
    wrong: bool
    errors: tuple[float, float]
    driven: float
    localizations: tuple[Pair, ...]


class LocalizationReport(NamedTuple):
    """The localization of a robot at a keyframe event.

    :ivar traveled: path since the kidnapping, m.
    :ivar localized: as ``hmt/is_localized``.
    :ivar is_right: whether its estimate is right.
    :ivar probability: of localization.
    :ivar event: the keyframe event.
    :ivar off: distance of its estimate from the right one, m; inf where it has none in the map.
    """

    traveled: float
    localized: bool
    is_right: bool
    probability: float
    event: int = -1
    off: float = math.inf


class EstimateError(NamedTuple):
    """The error of an estimate by the nearest keyframe of before a kidnapping.

    :ivar distance: m.
    :ivar angle: rad.
    :ivar allowed: distance up to which it is right, m.
    """

    distance: float
    angle: float
    allowed: float

    @property
    def is_right(self) -> bool:
        """Whether it is near enough."""
        return self.distance <= self.allowed and self.angle <= RIGHT_ANGLE


_NO_ESTIMATE = EstimateError(math.inf, math.inf, 0.0)


class MonitoredRun:
    """A run with the truth, which reports its localization.

    :ivar run: the five processes.
    :ivar true: {keyframe event: ``world_T_base`` (3,)}.
    :ivar kidnap_stamp: of the first scan after the kidnapping, ns; None before.
    :ivar kidnap_event: the first keyframe event after the kidnapping, -1 before.
    """

    def __init__(
        self,
        configuration: Configuration,
        state: RunState | None = None,
        truth: Mapping[int, NDArray[np.float64]] | None = None,
    ) -> None:
        """:param state: state from which the run continues.

        :param truth: {stamp of a scan up to then: ``world_T_base`` (3,)}.
        """
        self.run = LockStepRun(configuration, state=state)
        self.kidnap_stamp: int | None = None
        self.kidnap_event = -1
        self._truth = dict(truth or {})
        scans = slam_of(self.run).replica.scans
        self.true: dict[int, NDArray[np.float64]] = {k: self._truth[scan.stamp] for k, scan in scans.items()}
        self._reported = self.events

    @property
    def events(self) -> int:
        """Number of keyframe events."""
        return self.run.recorder.earlier_record.events + len(self.run.recorder.keyframes)

    def is_localized(self) -> bool:
        """As ``hmt/is_localized``."""
        tsbi = self.run.lock_step.processes["tsbi"]
        assert isinstance(tsbi, Tsbi)
        return tsbi.localization.localized

    def estimate_error(self, true: NDArray[np.float64]) -> EstimateError:
        """The error of the most probable pose after the last keyframe event, in the map of before the kidnapping.

        :param true: ``world_T_base``, shape (3,).
        """
        replica, areas, estimate = slam_of(self.run).replica, self._areas(), robot_poses(self.run)[0]
        if estimate.area not in areas:
            return _NO_ESTIMATE
        hybrid_map = replica.maps[replica.best_hypothesis]
        placed = [
            (keyframe, area, pose)
            for area in hybrid_map.area_ids()
            for keyframe, pose in hybrid_map.keyframes(area).items()
            if keyframe < self.kidnap_event and area in areas
        ]
        away = np.hypot(*(np.array([self.true[keyframe] for keyframe, _, _ in placed]) - true)[:, :2].T)
        nearest, area, pose = placed[int(np.argmin(away))]
        expected = se2.compose(se2.compose(areas[area], pose), se2.between(self.true[nearest], true))
        error = se2.between(expected, se2.compose(areas[estimate.area], estimate.pose))
        allowed = RIGHT + DRIFT * float(away.min())
        return EstimateError(math.hypot(error[0], error[1]), abs(float(error[2])), allowed)

    def _areas(self) -> dict[int, NDArray[np.float64]]:
        """{area: ``map_T_area``, shape (3,)} of the last closure decision with poses."""
        decisions = self.run.recorder.decisions
        for sequence in sorted(decisions, reverse=True):
            if decisions[sequence].global_poses:
                return {entry.area: entry.pose.mean for entry in decisions[sequence].global_poses}
        return {entry.area: entry.pose.mean for entry in self.run.recorder.earlier_record.global_poses}

    def report(self, stamp: int, true: NDArray[np.float64], traveled: float) -> LocalizationReport | None:
        """The report at a keyframe event after the kidnapping; None for other scans.

        Scans may have waited for odometry, so there may be several events since the last scan, and those of scans from
        before the kidnapping come after it.

        :param stamp: of the scan, ns.
        :param true: ``world_T_base``, shape (3,), at the scan.
        """
        self._truth[stamp] = true
        new = range(self._reported, self.events)
        self._reported = self.events
        for event in new:
            taken = self.run.recorder.keyframes[event].scan.stamp
            self.true[event] = self._truth[taken]
            if self.kidnap_event < 0 and self.kidnap_stamp is not None and taken >= self.kidnap_stamp:
                self.kidnap_event = event
        if not new or self.kidnap_event < 0:
            return None
        event, probability = self.events - 1, localization_probability(self.run)
        error = self.estimate_error(self.true[event])
        return LocalizationReport(traveled, self.is_localized(), error.is_right, probability, event, error.distance)


def summarize_drive(reports: Sequence[LocalizationReport], errors: tuple[float, float], traveled: float) -> Kidnapping:
    """The scores of a drive.

    :param reports: after the kidnapping, at least one.
    :param errors: before and after the kidnapping, m.
    :param traveled: path after the kidnapping, m.
    """
    noticed = next((report.traveled for report in reports if not report.localized or report.is_right), math.inf)
    again = math.inf
    for report in reversed(reports):
        if not (report.localized and report.is_right):
            break
        again = report.traveled
    wrong = [
        later.traveled - report.traveled
        for report, later in pairwise(reports)
        if report.traveled > noticed and report.localized and not report.is_right
    ]
    last = reports[-1]
    wrong_at_end = last.localized and not last.is_right
    localizations = tuple((report.probability, report.is_right) for report in reports)
    return Kidnapping(noticed, again, sum(wrong), wrong_at_end, errors, traveled, localizations)
