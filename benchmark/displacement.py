"""Robots that are lifted and put down elsewhere in a recorded log."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmark.awakening import path_lengths, stays_within
from benchmark.kidnapped_drive import Kidnapping, LocalizationReport, MonitoredRun, summarize_drive
from benchmark.recorded_drive import MappedDrive, odometry_at_scans
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs import LogRecord
from hmt_slam_ros.sensors import Odometry, Scan

KINDS = ("before", "again", "new")
"""Where the robot is put down: on the path so far, on known ground of its later path, or on unmapped ground."""

WAY = 25.0
"""Path after the displacement, m."""

APART, KNOWN, UNKNOWN = 3.0, 2.0, 4.0
"""Least distance of a displacement; largest distance of known ground from the path so far, and least of unmapped, m."""

_KNOWN_WAY, _UNKNOWN_WAY = 10.0, 5.0  # m of path, along which the ground has to be known or unmapped
_LEAST_WAY = 10.0  # m of path that the log has to go on for
_DRAWS = 2010


@dataclass(frozen=True)
class Splice:
    """Where a drive is left and joined.

    :ivar left: number of the last scan before the displacement.
    :ivar joined: number of the first scan after it.
    :ivar kind: one of ``KINDS``.
    """

    left: int
    joined: int
    kind: str


@dataclass(frozen=True)
class WrongAnswer:
    """A keyframe event at which the robot was sure of a wrong place after it was noticed, or at the end.

    :ivar event: the keyframe event.
    :ivar traveled: path since the displacement, m.
    :ivar off: error of the pose, m.
    :ivar probability: of localization.
    """

    event: int
    traveled: float
    off: float
    probability: float


@dataclass(frozen=True)
class Displacement:
    """The outcome of a displacement.

    :ivar splice: what was joined.
    :ivar scores: as of a kidnapping; its errors are NaN.
    :ivar wrong: the worst wrong answer, None without one.
    """

    splice: Splice
    scores: Kidnapping
    wrong: WrongAnswer | None

    @property
    def document(self) -> dict[str, Any]:
        """The outcome as a JSON document."""
        return asdict(self)

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> Displacement:
        """The outcome of a document."""
        scores = dict(document["scores"])
        scores["localizations"] = tuple((p, right) for p, right in scores["localizations"])
        wrong = document["wrong"]
        return cls(Splice(**document["splice"]), Kidnapping(**scores), None if wrong is None else WrongAnswer(**wrong))


def draw_splice(drive: MappedDrive, number: int) -> Splice | None:
    """The splice of a number, which is the same in every draw; None where the robot can be put down nowhere.

    Splices go round the states, and at each state round the kinds; a kind without a place gives way to the next.
    """
    states = sorted(drive.states)
    # Few splices are spread over the drive as many are.
    left = states[(number * _stride(len(states))) % len(states)]
    places = find_places(drive.whole.truth, left)
    random = np.random.Generator(np.random.Philox(key=[_DRAWS, number]))
    first = number + number // len(states)
    for kind in (KINDS[(first + k) % len(KINDS)] for k in range(len(KINDS))):
        candidates = np.flatnonzero(places[kind])
        if candidates.size:
            return Splice(left, int(random.choice(candidates)), kind)
    return None


def _stride(states: int) -> int:
    """A step near 0.38 of the states that reaches all of them."""
    return next(step for step in range(max(1, round(0.38 * states)), states + 2) if math.gcd(step, states) == 1)


def find_places(truth: Float64, left: int) -> dict[str, NDArray[np.bool_]]:
    """The scans at which a robot can be put down, {kind: shape (n,)}.

    :param truth: shape (n, 3), poses of the scans.
    :param left: number of the last scan before that.
    """
    travel, numbers = np.array(list(path_lengths(truth))), np.arange(len(truth))
    from_path, _ = cKDTree(truth[: left + 1, :2]).query(truth[:, :2])
    away = np.hypot(*(truth - truth[left])[:, :2].T) >= APART
    possible = away & (travel[-1] - travel >= _LEAST_WAY)
    known = stays_within(from_path, truth, KNOWN, _KNOWN_WAY)
    unmapped = stays_within(-from_path, truth, -UNKNOWN, _UNKNOWN_WAY)
    later = numbers > left
    return {"before": possible & ~later, "again": possible & later & known, "new": possible & later & unmapped}


def joined_records(drive: MappedDrive, splice: Splice) -> Iterator[LogRecord]:
    """The records from the joined scan on, with stamps and odometry that continue those of the last scan before."""
    records, scans = drive.whole.records, drive.whole.scans
    before = records[: scans[splice.left] + 1]
    at = odometry_at_scans(before)[-1]
    begin = int(scans[splice.joined - 1]) + 1 if splice.joined else 0
    first = next(record.measurement.pose for record in records[begin:] if isinstance(record.measurement, Odometry))
    stamps = np.array([records[scan].measurement.stamp for scan in scans])
    shift = before[-1].measurement.stamp + int(np.median(np.diff(stamps))) - records[begin].measurement.stamp
    for record in records[begin:]:
        measurement = replace(record.measurement, stamp=record.measurement.stamp + shift)
        if isinstance(measurement, Odometry):
            measurement = replace(measurement, pose=se2.compose(at, se2.between(first, measurement.pose)))
        yield LogRecord(record.source_stamp + shift, measurement, None)


def displace(drive: MappedDrive, splice: Splice) -> Displacement:
    """Continue a drive elsewhere, for 25 m of path."""
    whole = drive.whole
    stamps = {whole.records[scan].measurement.stamp: pose for scan, pose in zip(whole.scans, whole.truth, strict=True)}
    # A run changes arrays of the state from which it starts, and several start from each.
    monitored = MonitoredRun(whole.configuration, deepcopy(drive.states[splice.left]), stamps)
    reports, traveled = list[LocalizationReport](), 0.0
    travel = path_lengths(whole.truth[splice.joined :])
    true = iter(whole.truth[splice.joined :])
    for record in joined_records(drive, splice):
        monitored.run.process_record(record)
        if not isinstance(record.measurement, Scan):
            continue
        monitored.kidnap_stamp = monitored.kidnap_stamp or record.measurement.stamp
        traveled = next(travel)
        report = monitored.report(record.measurement.stamp, next(true), traveled)
        reports += [] if report is None else [report]
        if traveled >= WAY:
            break
    scores = summarize_drive(reports, (math.nan, math.nan), traveled)
    return Displacement(splice, scores, worst_answer(reports, scores.noticed))


def worst_answer(reports: Sequence[LocalizationReport], noticed: float) -> WrongAnswer | None:
    """The wrong answer that is farthest off, after the displacement was noticed or at the end; None without one."""
    wrong = [
        report
        for report in reports
        if report.localized and not report.is_right and (report.traveled > noticed or report is reports[-1])
    ]
    worst = max(wrong, key=lambda report: report.off, default=None)
    return None if worst is None else WrongAnswer(worst.event, worst.traveled, worst.off, worst.probability)
