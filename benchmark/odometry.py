"""Accuracy and topology under degraded odometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from benchmark.degraded_odometry import KINDS
from benchmark.logs import WITH_RELATIONS, MeasuredLog, open_logs
from benchmark.report import Report, Requirement, table
from benchmark.runs import Case, Run
from benchmark.scoring import FINAL, over_seeds, score
from benchmark.settings import Settings
from hmt_slam_ros.evaluation import RelationErrors, read_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import ArcValue
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.results.hmt_map import read_saved_map

SEEDS = 5

LONG_LIMIT = 1.0
"""Largest error of a relation over more than 60 s in a map of the right topology, m."""

CLOSURE_LIMIT, CLOSURE_ANGLE = 0.5, 10.0
"""Largest error of an arc that closed a true loop, m and degrees."""

POLICY = (
    "The kinds are those of `benchmark/degraded_odometry.py`, with random numbers of the run's seed. A map has the "
    f"right topology if every relation over more than 60 s is within {LONG_LIMIT:g} m of the truth, and every arc that "
    f"closed a loop is within {CLOSURE_LIMIT:g} m and {CLOSURE_ANGLE:g} degrees of the run of the same seed with the "
    "recorded odometry, between the two keyframes of its areas that are nearest to each other there. Errors are means "
    "over all seeds, including those with a wrong topology; relations are matched as for accuracy."
)


@dataclass(frozen=True)
class TopologyVerdict:
    """The verdict on the topology of a run.

    :ivar scores: of the final trajectory; None for a run that failed.
    :ivar closures: errors of the arcs that closed a loop.
    """

    scores: RelationErrors | None
    closures: tuple[ClosureError, ...] = ()

    @property
    def wrong_closures(self) -> list[ClosureError]:
        """The arcs that closed a false loop."""
        return [c for c in self.closures if not (c.translation <= CLOSURE_LIMIT and c.rotation <= CLOSURE_ANGLE)]

    @property
    def is_right(self) -> bool:
        """Whether no loop is missed, and none is false."""
        if self.scores is None:
            return False
        return self.scores.over_60_s.translation.max <= LONG_LIMIT and not self.wrong_closures


def measure_odometry(settings: Settings) -> Report:
    """Map every log with every kind of degraded odometry and every seed."""
    seeds = settings.seeds_or(SEEDS)
    report = Report("odometry", "Accuracy with degraded odometry", seeds=seeds)
    rows: list[list[str]] = []
    with open_logs(settings.logs_or(WITH_RELATIONS)) as logs:
        for log in logs:
            references = settings.runner.runs([Case(log, seed, "", settings.changes) for seed in seeds])
            for kind in ("", *KINDS):
                runs = settings.runner.attempts([Case(log, seed, kind, settings.changes) for seed in seeds])
                verdicts = [judge_run(run, reference) for run, reference in zip(runs, references, strict=True)]
                name = kind or "as recorded"
                wrong = sum(not verdict.is_right for verdict in verdicts)
                report.requirements.append(Requirement(f"{log.name}, {name}: seeds with a wrong topology", wrong, 0))
                report.data[f"{log.name} {name}"] = [
                    asdict(verdict) | {"right": verdict.is_right} for verdict in verdicts
                ]
                rows.append([log.name, name, *_verdict_cells(runs, verdicts)])
    head = ["log", "odometry", "translation [m]", "between seeds", "worst seed", "over 60 s [m]", "its max"]
    head += ["rotation [deg]", "areas", "loop closures", "wrong ones", "right topology"]
    report.body += [table(head, rows), POLICY]
    return report


def judge_run(run: Run, reference: Run) -> TopologyVerdict:
    """The verdict on a run by the truth, and by the run with the recorded odometry."""
    if run.fault:
        return TopologyVerdict(None)
    closures = closure_errors(read_saved_map(run.folder / "hmt_map").replica, _true_poses(reference))
    return TopologyVerdict(score(run.folder, run.case.log), tuple(closures))


def _true_poses(reference: Run) -> dict[int, NDArray[np.float64]]:
    log: MeasuredLog = reference.case.log
    poses = read_tum(reference.folder / FINAL).poses
    # The run may be of the beginning of the log.
    return {scan.stamp: pose for scan, pose in zip(log.scans[: len(poses)], poses, strict=True)}


def _verdict_cells(runs: Sequence[Run], verdicts: Sequence[TopologyVerdict]) -> list[str]:
    scores = [verdict.scores for verdict in verdicts if verdict.scores is not None]
    right = f"{sum(verdict.is_right for verdict in verdicts)} of {len(verdicts)}"
    if not scores:
        return [*["-"] * 9, right]
    mean = over_seeds(scores)
    reports = [run.report for run in runs if not run.fault]
    return [
        f"{mean.translation:.3f}",
        f"± {mean.translation_std:.3f}",
        f"{mean.worst:.3f}",
        f"{mean.long:.3f}",
        f"{mean.long_max:.2f}",
        f"{mean.rotation:.2f}",
        f"{np.mean([report['areas'] for report in reports]):.1f}",
        f"{np.mean([report['loop_closures'] for report in reports]):.1f}",
        str(sum(len(verdict.wrong_closures) for verdict in verdicts)),
        right,
    ]


@dataclass(frozen=True)
class ClosureError:
    """The error of an arc that closed a loop.

    :ivar areas: that it joins.
    :ivar translation: m.
    :ivar rotation: degrees.
    """

    areas: tuple[int, int]
    translation: float
    rotation: float


def closure_errors(replica: Replica, truth: Mapping[int, NDArray[np.float64]]) -> list[ClosureError]:
    """Errors of all arcs of the most probable map that closed a loop.

    The error is that between the two keyframes of its areas that truly are nearest to each other.

    :param truth: {running stamp of a scan, ns: ``map_T_base`` (3,)}, of all scans of the log, in any one frame.
    """
    arcs = replica.maps[replica.best_hypothesis].all_arcs()
    return [_closure_error(replica, a, b, arc, truth) for a, b, arc in arcs if arc.closure]


def _closure_error(
    replica: Replica, a: int, b: int, arc: ArcValue, truth: Mapping[int, NDArray[np.float64]]
) -> ClosureError:
    (a_T_keyframes, true_in_a), (b_T_keyframes, true_in_b) = (_keyframe_poses(replica, area, truth) for area in (a, b))
    distances = np.hypot(*(true_in_a[:, None, :2] - true_in_b[None, :, :2]).transpose(2, 0, 1))
    k, m = np.unravel_index(np.argmin(distances), distances.shape)
    through_arc = se2.between(a_T_keyframes[k], se2.compose(arc.pose.mean, b_T_keyframes[m]))
    error = se2.between(se2.between(true_in_a[k], true_in_b[m]), through_arc)
    return ClosureError((a, b), float(np.hypot(error[0], error[1])), float(np.degrees(abs(error[2]))))


def _keyframe_poses(
    replica: Replica, area: int, truth: Mapping[int, NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (n, 3) of an area's keyframes in the area, and true ones."""
    keyframes = replica.maps[replica.best_hypothesis].keyframes(area)
    poses = np.array(list(keyframes.values())).reshape(-1, 3)
    return poses, np.array([truth[replica.scans[keyframe].stamp] for keyframe in keyframes]).reshape(-1, 3)
