"""The verdict on the map of a stretch: right, open, or wrong, and with what probability."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmark.odometry import CLOSURE_ANGLE, CLOSURE_LIMIT, LONG_LIMIT, ClosureError, closure_errors
from hmt_slam_ros.arrays import Bool, Float64, Int64
from hmt_slam_ros.evaluation import Relations, StampedPoses, pair_errors
from hmt_slam_ros.evaluation.relations import LONG_SPAN
from hmt_slam_ros.hybrid_map.shortest_path import map_pieces
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.results.recorder import Recording
from hmt_slam_ros.sensors import Scan

CONFIDENT = 0.95
"""Probability from which a wrong topology is wrong confidently."""

SCORED_GAP = 1.0
"""Largest time from the end of a relation to the nearest scan, s; to there the odometry extrapolates."""

POLICY = (
    f"A map is right if it is in one piece, no relation over more than 60 s is off by more than {LONG_LIMIT:g} m, and "
    f"every arc that closed a loop is right to {CLOSURE_LIMIT:g} m and {CLOSURE_ANGLE:g} degrees. The arc is compared "
    "with the true poses, or on recorded logs with the run of the same stretch without the fault, if that is right; "
    "of its areas the two keyframes count that are nearest to each other. A map is wrong if one of these errors is "
    "larger; errors across two pieces do not count. It is wrong with confidence if its probability is over "
    f"{CONFIDENT:g}. All other maps are open: those in several pieces without such an error, and wrong ones of a lower "
    f"probability. Relations count whose ends are within {SCORED_GAP:g} s of a scan; poses are extrapolated to there "
    "by the odometry without the fault."
)


@dataclass(frozen=True)
class MapVerdict:
    """The verdict on a map.

    :ivar probability: of the most probable hypothesis, whose map it is.
    :ivar pieces: number of pieces that informative arcs hold together.
    :ivar error: mean error of all relations within pieces, m; NaN without any.
    :ivar long_error: largest error of a relation over more than 60 s within a piece, m; 0 without any.
    :ivar long_count: number of these.
    :ivar split_count: number of relations over more than 60 s between two pieces.
    :ivar closures: errors of the arcs that closed a loop; None where no truth is known.
    """

    probability: float
    pieces: int
    error: float
    long_error: float
    long_count: int
    split_count: int
    closures: tuple[ClosureError, ...] | None

    @property
    def false_closures(self) -> list[ClosureError]:
        """The arcs that closed a false loop."""
        return [c for c in self.closures or () if c.translation > CLOSURE_LIMIT or c.rotation > CLOSURE_ANGLE]

    @property
    def has_error(self) -> bool:
        """Whether a place of the map is wrong within its piece."""
        return self.long_error > LONG_LIMIT or bool(self.false_closures)

    @property
    def outcome(self) -> str:
        """``right``, ``wrong`` with confidence, or ``open``."""
        if self.has_error:
            return "wrong" if self.probability > CONFIDENT else "open"
        return "right" if self.pieces == 1 else "open"


@dataclass(frozen=True, eq=False)
class StretchTruth:
    """What is known about a stretch.

    :ivar relations: true ones within the stretch, by source stamps.
    :ivar odometry: without the fault, by source stamps.
    :ivar poses: {source stamp of a scan, ns: true pose (3,)}, in any one frame; None where unknown.
    """

    relations: Relations
    odometry: StampedPoses
    poses: Mapping[int, Float64] | None


def judge(
    recording: Recording, trajectory: StampedPoses, records: Sequence[LogRecord], truth: StretchTruth
) -> MapVerdict:
    """The verdict on the final map of a run.

    :param trajectory: final one, with source stamps.
    :param records: that were mapped.
    """
    piece_of_scan = pieces_of_scans(recording)
    relations = select_relations(truth.relations, near_scans(truth.relations, trajectory))
    errors = pair_errors(trajectory, relations, truth.odometry)
    starts, ends = (piece_of_scan[trajectory.nearest_indices(at)] for at in (relations.starts, relations.ends))
    within, is_long = errors.is_matched & (starts == ends), errors.span > LONG_SPAN
    return MapVerdict(
        probability=recording.replica.probabilities[recording.replica.best_hypothesis],
        pieces=len(set(piece_of_scan.tolist())),
        error=float(errors.translation[within].mean()) if within.any() else float("nan"),
        long_error=float(errors.translation[within & is_long].max(initial=0.0)),
        long_count=int((within & is_long).sum()),
        split_count=int((is_long & (starts != ends)).sum()),
        closures=None if truth.poses is None else score_closures(recording.replica, records, truth.poses),
    )


def pieces_of_scans(recording: Recording) -> Int64:
    """The piece of the map to which each scan belongs, by its smallest area, shape (n,)."""
    piece_of_area = {area: piece[0] for piece in map_pieces(recording.hybrid_map) for area in piece}
    areas = recording.relative_trajectory.areas(recording.hybrid_map)
    return np.array([piece_of_area[area] for area in areas.tolist()], dtype=np.int64)


def near_scans(relations: Relations, trajectory: StampedPoses) -> Bool:
    """Whether both ends of each relation are near a scan, shape (n,)."""
    near = [
        np.abs(trajectory.stamps[trajectory.nearest_indices(stamps)] - stamps) <= SCORED_GAP * NANOSECONDS
        for stamps in (relations.starts, relations.ends)
    ]
    return np.asarray(near[0] & near[1])


def select_relations(relations: Relations, chosen: Bool) -> Relations:
    """The relations that a mask (n,) selects."""
    return Relations(relations.starts[chosen], relations.ends[chosen], relations.poses[chosen])


def score_closures(
    replica: Replica, records: Sequence[LogRecord], poses: Mapping[int, Float64]
) -> tuple[ClosureError, ...]:
    """Errors of the arcs that closed a loop.

    :param records: that were mapped.
    :param poses: {source stamp of a scan, ns: true pose (3,)}.
    """
    scans = (record for record in records if isinstance(record.measurement, Scan))
    return tuple(closure_errors(replica, {scan.measurement.stamp: poses[scan.source_stamp] for scan in scans}))
