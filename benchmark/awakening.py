"""Robot awakening [B]: global localization in a saved map, by distance and correctness."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import asdict, astuple, dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmark.localization import localization_probability
from benchmark.logs import open_logs
from benchmark.outcomes import OutcomesFile, fingerprint, map_shared
from benchmark.report import Report, Requirement, table
from benchmark.settings import Settings
from benchmark.simulated.records import Records
from benchmark.tail import POLICY as TAIL_POLICY
from benchmark.tail import Pair, tail_requirement, tail_table
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs import LogRecord
from hmt_slam_ros.logs.records import SIMULATION_PREFIX
from hmt_slam_ros.messages.messages import PoseReset
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.results.recorder import complete_area_poses
from hmt_slam_ros.sensors import Scan

LOGS = ("aces", "intel")
WORLDS = ("office", "nested", "grid")
ALIKE = ("grid",)
"""Worlds in which every place exists several times, so that the pose is ambiguous."""

KINDS = ("whole", "first half")
"""The maps of a log in which the robot starts."""

STARTS = 100
"""Starts in every log."""

FAR = 20.0
"""Path within which the robot has to be localized, m."""

SURE = 0.9
RIGHT_SHARE = 0.95

COLUMNS = (
    "log",
    "map of the",
    "starts",
    f"right within {FAR:g} m",
    "m until known, mean",
    "median",
    "most",
    "wrong",
    "not known",
)
"""The head of a table of starts."""

_RIGHT, _RIGHT_ANGLE = 1.0, math.radians(20.0)
# m that the robot drives on once it is localized; smallest step that counts as travel, m, against noise.
_ON, _STEP = 5.0, 0.1
# Last part of the log that is left out, because the drive ends before 20 m.
_LAST = 0.05
# Largest distance of a keyframe to a place that a map contains, m, and path from a start that has to be contained, m.
HELD, HELD_WAY = 2.0, 10.0
_DRAWS = 2008

POLICY = (
    "The robot starts at random scans of a log without an initial pose, and repeats the drive of the log in one of two "
    "maps. The map of the whole log contains the very scans of the drive, which is easy. The map of the log's first "
    "half (in simulation, the first of two laps) is of another time: the robot starts in the second half, if a "
    f"keyframe of the first is within {HELD:g} m all along the first {HELD_WAY:g} m of its path; after that it may "
    "leave the map. ACES has no such place. The robot is localized if the hypotheses that are not lost have a "
    f"probability of {SURE:g}. It then drives {_ON:g} m more, else {FAR:g} m in all. Its pose is right within "
    f"{_RIGHT:g} m and {math.degrees(_RIGHT_ANGLE):.0f} degrees of the pose of this scan in the run over the whole "
    "log, relative to the nearest keyframe of the map. A confident wrong answer is a larger error at any time after "
    "the localization. In grid every place exists several times, so that only wrong answers count. Above 0.9 counts "
    "every start, in all logs, by the probability that the robot is where the most probable hypothesis has it, and by "
    "its pose, at the scan of the first localization."
)


@dataclass(frozen=True)
class Awakening:
    """The outcome of one start.

    :ivar start: number of the record.
    :ivar found: path until the robot was localized, m; inf if it never was.
    :ivar right: whether its pose was right at the end of the path.
    :ivar wrong: whether it was localized at a wrong place at any time.
    :ivar probability: of localization when it was localized first; 0 if it never was.
    :ivar right_at_first: whether its pose was right then.
    :ivar off: largest distance of a wrong pose with which it was localized, m; 0 without one.
    """

    start: int
    found: float
    right: bool
    wrong: bool
    probability: float
    right_at_first: bool
    off: float

    @property
    def good(self) -> bool:
        """Whether the robot was localized in time, and never wrongly."""
        return self.right and not self.wrong and self.found <= FAR


@dataclass(frozen=True, eq=False)
class MappedLog:
    """A saved map, and a drive through it with its truth.

    :ivar configuration: of the runs.
    :ivar records: of the log.
    :ivar state: the saved map.
    :ivar scans: shape (n,), numbers of the records that are scans.
    :ivar truth: shape (n, 3), ``map_T_base`` of these.
    :ivar starts: numbers of scans at which the robot may start.
    """

    configuration: Configuration
    records: Sequence[LogRecord]
    state: RunState
    scans: NDArray[np.int64]
    truth: Float64
    starts: Sequence[int]

    @cached_property
    def numbers(self) -> dict[int, int]:
        """{stamp of a scan: its number}."""
        return {self.records[scan].measurement.stamp: n for n, scan in enumerate(self.scans)}


def measure_awakening(settings: Settings) -> Report:
    """Map the logs, and localize the robot from starts in them."""
    report = Report("awakening", "Global localization in a saved map", seeds=(0,))
    configuration = settings.configuration
    names = settings.logs_or((*LOGS, *WORLDS))
    rows, first = [], list[Pair]()
    with open_logs([name for name in names if name not in WORLDS]) as logs:
        paths: dict[str, Path | str] = {name: f"{SIMULATION_PREFIX}{name},laps=2" for name in names if name in WORLDS}
        paths |= {log.name: log.path for log in logs}
        count, records = len(settings.seeds_or(STARTS)), settings.records
        for name in names:
            for kind, found in complete_starts(
                name, paths[name], configuration, settings.changes, count, records
            ).items():
                rows.append(starts_row(name, kind, found))
                report.data[f"{name}, {kind}"] = [asdict(start) for start in found]
                first += first_localizations(found)
                if found:
                    report.requirements += requirements(
                        f"{name}, map of the {kind}", found, is_distinguishable=name not in ALIKE
                    )
    if first:
        report.requirements.append(tail_requirement("first localizations", first))
    tail = tail_table({"first localizations": first})
    report.body += [table(COLUMNS, rows), tail, POLICY, TAIL_POLICY]
    return report


def first_localizations(found: Sequence[Awakening]) -> list[Pair]:
    """The probability of localization of some starts when the robot was localized first, and whether it was right."""
    return [(start.probability, start.right_at_first) for start in found if not math.isinf(start.found)]


def complete_starts(
    name: str, path: Path | str, configuration: Configuration, changes: Sequence[str], count: int, records: Records
) -> dict[str, list[Awakening]]:
    """The first starts in each map of a log; missing ones are made.

    :param changes: parameters of the configuration that differ from the file.
    """
    file = StartsFile(records.folder / f"awakening-{name}-{fingerprint(changes, Path(__file__))}.json")
    file.complete(path, configuration, count, records.jobs)
    return file.starts(count)


def requirements(name: str, found: Sequence[Awakening], *, is_distinguishable: bool) -> list[Requirement]:
    """Requirements on the starts in one map.

    :param is_distinguishable: whether the places differ.
    """
    wrong = Requirement(f"{name}: confident wrong answers", sum(start.wrong for start in found), 0)
    share = float(np.mean([start.good for start in found]))
    right = Requirement(f"{name}: right within {FAR:g} m", share, 1.0, least=RIGHT_SHARE)
    return [right, wrong] if is_distinguishable else [wrong]


def map_log(path: Path | str, configuration: Configuration) -> dict[str, MappedLog]:
    """The maps of a whole log and of its first half, {kind: map}."""
    records = list(open_log(path).records())
    scans = scan_records(records)
    middle, last = len(scans) // 2, last_start(len(scans))
    half = process_records(LockStepRun(configuration), records[: scans[middle]]).state
    run = process_records(LockStepRun(configuration, state=deepcopy(half)), records[scans[middle] :])
    whole, result = run.state, run.finish()
    truth = result.recorder.finish(result.log_progress.stamps).trajectory
    easy = MappedLog(configuration, records, whole, scans, truth, range(last))
    return dict(zip(KINDS, (easy, in_map_of_part(easy, half, range(middle, last))), strict=True))


def in_map_of_part(whole: MappedLog, state: RunState, starts: Sequence[int], way: float = HELD_WAY) -> MappedLog:
    """The drive of a log in the map of a part of it, with those starts that stay on its ground.

    :param whole: the same in the map of the whole log.
    :param state: the map of the part.
    :param starts: numbers of scans outside of the part.
    :param way: path from a start that has to be on the map's ground, m.
    """
    records, scans, truth = whole.records, whole.scans, whole.truth
    pose_of_scan = {whole.numbers[stamp]: pose for stamp, pose in _keyframes(state).items()}
    known_scans, poses = np.array(list(pose_of_scan)), np.array(list(pose_of_scan.values()))
    distances, nearest = cKDTree(truth[known_scans, :2]).query(truth[:, :2])
    in_part = se2.compose(poses[nearest], se2.between(truth[known_scans[nearest]], truth))
    known = stays_within(distances, truth, HELD, way)
    return MappedLog(whole.configuration, records, state, scans, in_part, [n for n in starts if known[n]])


def stays_within(distances: Float64, truth: Float64, limit: float, way: float) -> NDArray[np.bool_]:
    """Whether the distances along a drive are within a limit from each scan on, shape (n,).

    :param distances: shape (n,), m.
    :param truth: shape (n, 3), poses of the scans.
    :param way: path along which they have to be, m.
    """
    travel = np.array(list(path_lengths(truth)))
    ends = np.searchsorted(travel, travel + way)
    return np.array([bool((distances[n:end] <= limit).all()) for n, end in enumerate(ends)])


def scan_records(records: Sequence[LogRecord]) -> NDArray[np.int64]:
    """The numbers (n,) of the records that are scans."""
    return np.array([n for n, record in enumerate(records) if isinstance(record.measurement, Scan)])


def last_start(scans: int) -> int:
    """The number of the scan after which no robot starts, because the drive ends too soon."""
    return int((1.0 - _LAST) * scans)


def process_records(run: LockStepRun, records: Sequence[LogRecord]) -> LockStepRun:
    """The run after some records."""
    for record in records:
        run.process_record(record)
    return run


def _keyframes(state: RunState) -> dict[int, Float64]:
    """{stamp of a keyframe's scan: ``map_T_base`` (3,)} of the most probable map."""
    replica = Replica.from_state(state.processes["tsbi"].replica)
    hybrid_map = replica.maps[replica.best_hypothesis]
    areas = complete_area_poses(hybrid_map, state.recorder.global_poses)
    return {
        replica.scans[keyframe].stamp: se2.compose(areas[area].mean, pose)
        for area in hybrid_map.area_ids()
        for keyframe, pose in hybrid_map.keyframes(area).items()
    }


def path_lengths(poses: Float64) -> Iterator[float]:
    """Path length up to each of the poses (n, 3), m."""
    total, last = 0.0, poses[0]
    for pose in poses:
        step = math.hypot(*(pose - last)[:2])
        if step >= _STEP:
            total, last = total + step, pose
        yield total


class StartsFile(OutcomesFile):
    """The file of the starts of a log: of each, the kind of its map and the fields of :class:`Awakening`."""

    def starts(self, count: int) -> dict[str, list[Awakening]]:
        """The first ``count`` starts in each map, as many as there are."""
        rows = self.rows()
        return {kind: [Awakening(*row[1:]) for row in rows if row[0] == kind][:count] for kind in KINDS}

    def complete(self, path: Path | str, configuration: Configuration, count: int, jobs: int) -> None:
        """Make the missing ones of the first ``count`` starts in each map."""
        made = {kind: len(start) for kind, start in self.starts(count).items()}
        if min(made.values()) >= count:
            return
        for kind, log in map_log(path, configuration).items():
            drawn = np.random.default_rng(_DRAWS).integers(0, max(1, len(log.starts)), count).tolist()
            starts = [log.starts[n] for n in drawn if log.starts]
            for start in map_shared(try_start, log, starts[made[kind] :], jobs):
                self.add([kind, *astuple(start)])


def try_start(log: MappedLog, start: int) -> Awakening:
    """Localize the robot globally at a scan of a drive and the scans after it."""
    # A run changes arrays of the state from which it starts.
    run = LockStepRun(log.configuration, state=deepcopy(log.state))
    run.lock_step.feed(PoseReset())
    found, right, wrong = math.inf, False, False
    probability, right_at_first, off = 0.0, False, 0.0
    travel, first = path_lengths(log.truth[start:]), int(log.scans[start])
    counted = -_STEP
    for record in log.records[first:]:
        run.process_record(record)
        if not isinstance(record.measurement, Scan):
            continue
        traveled = next(travel)
        if traveled < counted + _STEP:
            continue
        counted = traveled
        error = _pose_error(run, log) if _is_localized(run) else None
        if error is not None:
            right = _is_right(error)
            if math.isinf(found):
                probability, right_at_first = localization_probability(run), right
            found, wrong = min(found, traveled), wrong or not right
            off = off if right else max(off, math.hypot(error[0], error[1]))
        if traveled >= min(FAR, found + _ON):
            break
    return Awakening(start, found, right, wrong, probability, right_at_first, off)


def _is_localized(run: LockStepRun) -> bool:
    """Whether hypotheses that are not lost have the probability ``SURE``."""
    hypotheses = run.recorder.hypotheses
    if not hypotheses:
        return False
    return (
        sum(hypothesis.probability for hypothesis in hypotheses[max(hypotheses)].hypotheses if not hypothesis.lost)
        >= SURE
    )


def _pose_error(run: LockStepRun, log: MappedLog) -> Float64 | None:
    """The last estimate in the frame of the true pose of its scan, shape (3,).

    Later scans may wait for odometry. It is None if its area was merged with another since.
    """
    slam, last = run.lock_step.processes["slam"], run.recorder.last_estimate
    assert isinstance(slam, MetricSlam)
    assert last is not None
    decisions, before = run.recorder.decisions, log.state.recorder.global_poses
    global_poses = next(
        (decisions[n].global_poses for n in sorted(decisions, reverse=True) if decisions[n].global_poses), before
    )
    area = complete_area_poses(slam.replica.maps[slam.replica.best_hypothesis], global_poses).get(last.area)
    if area is None:
        return None
    return se2.between(log.truth[log.numbers[last.stamp]], se2.compose(area.mean, last.pose.mean))


def _is_right(error: Float64) -> bool:
    return bool(math.hypot(error[0], error[1]) <= _RIGHT and abs(error[2]) <= _RIGHT_ANGLE)


def starts_row(name: str, kind: str, found: Sequence[Awakening]) -> list[str]:
    """The line of the starts in one map, with the cells of ``COLUMNS``."""
    distances = [start.found for start in found if start.right]
    share = f"{np.mean([start.good for start in found]):.2f}" if found else "-"
    figures = (f"{statistic(distances):.1f}" if distances else "-" for statistic in (np.mean, np.median, max))
    wrong, never = sum(start.wrong for start in found), sum(math.isinf(start.found) for start in found)
    return [name, kind, str(len(found)), share, *figures, str(wrong), str(never)]
