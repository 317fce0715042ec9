"""Statistics of a log or of running topics, gathered in one pass, before any check.

The robot's motion comes from the scans alone, so that odometry can be compared with it. A search over shifts of the
beams gives the turn between two scans, and point-to-line registration refines the motion.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from hmt_slam_ros.arrays import Bool, Float32, Float64, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.configuration.topology import RefinementParameters
from hmt_slam_ros.doctor.frames import MessageStatistics
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.registration.scan_to_scan import Weighting, extract_surfaces, normal_equations
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.scan import SweepCheck

_MIN_INTERVAL = 0.15
"""Least time between two scans that are registered, s: over less, a robot moves no farther than the match errs."""

_BATCH = 256
"""Pairs of scans that are registered together."""

_MAX_RANGE, _MAX_POINTS = 30.0, 180
"""Largest range, m, and number of points of a scan that are used."""

_MIN_POINTS = 40
"""Least number of points of a match."""

_MAX_TURN, _TURN_STEP, _MAX_BEAMS = math.radians(80.0), math.radians(1.0), 180
"""Turns that are searched, to each side, rad, the step between them, rad, and the number of beams compared."""

_MIN_OVERLAP, _MAX_DIFFERENCE = 0.4, 1.0
"""Least share of the beams that both scans have, and the limit of a difference of ranges, m."""

_GATES = (1.5, 1.0, 1.0, 0.7, 0.5, 0.4, 0.3, 0.3, 0.2, 0.2)
"""Largest distance of points that correspond, in each iteration, m."""

_WEAK_PRIOR = np.diag([1.0, 1.0, math.radians(30.0) ** -2])
"""Information of the prior on a motion, for directions that the scans do not show: 1 m, 1 m and 30 degrees."""


class BeamCounts(NamedTuple):
    """Numbers of beams by kind in each of n scans, shape (n,) each.

    :ivar beams: all beams.
    :ivar returns: beams with a valid range.
    :ivar nan: NaN.
    :ivar infinite: infinite, of either sign.
    :ivar near: finite, below the least range.
    :ivar far: finite, at or beyond the largest range.
    """

    beams: Int64
    returns: Int64
    nan: Int64
    infinite: Int64
    near: Int64
    far: Int64


class BeamStatistics(NamedTuple):
    """Ranges of each of the b beams, over the scans that have as many beams as the first.

    :ivar returns: shape (b,), number of valid ranges.
    :ivar nearest: shape (b,), the smallest of them, m.
    :ivar farthest: shape (b,), the largest of them, m.
    """

    returns: Int64
    nearest: Float64
    farthest: Float64


@dataclass(frozen=True, eq=False)
class ScanStatistics:
    """Statistics of n scans.

    :ivar source_stamps: shape (n,), the source's own stamps, ns, in the order of arrival.
    :ivar stamps: shape (n,), on the running clock of `LogRecord`, ns.
    :ivar geometry: shape (n, 5): first angle, increment, rad; least and largest range, m; time from beam to beam, s.
    :ivar laser_poses: shape (n, 3), ``base_T_laser``, m and rad.
    :ivar counts: beams by kind.
    :ivar beam_statistics: ranges by beam.
    :ivar sweep_fault_count: number of scans with an impossible ``time_increment``.
    :ivar first_sweep_fault: sentence about the first of them.
    """

    source_stamps: Int64
    stamps: Int64
    geometry: Float64
    laser_poses: Float64
    counts: BeamCounts
    beam_statistics: BeamStatistics
    sweep_fault_count: int
    first_sweep_fault: str


@dataclass(frozen=True, eq=False)
class OdometryStatistics:
    """Statistics of m odometry readings.

    :ivar source_stamps: shape (m,), the source's own stamps, ns, in the order of arrival.
    :ivar stamps: shape (m,), on the running clock, ns.
    :ivar poses: shape (m, 3), ``odom_T_base``, m and rad, finite.
    :ivar non_finite_count: number of readings that are NaN or infinite, which are left out.
    """

    source_stamps: Int64
    stamps: Int64
    poses: Float64
    non_finite_count: int

    @property
    def distance(self) -> float:
        """Length of the path, m."""
        return float(np.hypot(*np.diff(self.poses[:, :2], axis=0).T).sum()) if len(self.poses) else 0.0

    def poses_at(self, stamps: Float64) -> Float64:
        """Interpolated poses, shape (k, 3), with unwrapped headings; constant before the first and after the last.

        :param stamps: shape (k,), ns.
        """
        times = (self.stamps - self.stamps[0]).astype(np.float64)
        wanted = stamps - float(self.stamps[0])
        x, y, heading = self.poses[:, 0], self.poses[:, 1], np.unwrap(self.poses[:, 2])
        return np.stack([np.interp(wanted, times, part) for part in (x, y, heading)], axis=1)


@dataclass(frozen=True, eq=False)
class ScanMotions:
    """The robot's motion between pairs of scans, from the scans alone.

    :ivar starts: shape (p,), stamps of the first scans, ns.
    :ivar ends: shape (p,), stamps of the second scans, ns.
    :ivar motions: shape (p, 3), ``start_T_end``, m and rad.
    :ivar information: shape (p, 3, 3), information matrix of the motion in the frame of its end.
    :ivar matched: shape (p,), share of the points of one scan that match a wall of the other.
    """

    starts: Int64
    ends: Int64
    motions: Float64
    information: Float64
    matched: Float64

    def select(self, chosen: Bool | Int64) -> ScanMotions:
        """The motions that a mask or an index array selects."""
        return ScanMotions(*(getattr(self, column.name)[chosen] for column in fields(self)))


@dataclass(frozen=True, eq=False)
class Statistics:
    """All statistics of a log.

    :ivar name: name of the log.
    :ivar scans: statistics of the scans.
    :ivar odometry: statistics of the odometry.
    :ivar motions: motions between scans.
    :ivar messages: statistics of the messages, None where the log is no bag.
    """

    name: str
    scans: ScanStatistics
    odometry: OdometryStatistics
    motions: ScanMotions
    messages: MessageStatistics | None = None

    @property
    def duration(self) -> float:
        """Time from the first to the last stamp on the running clock, s."""
        stamps = np.concatenate((self.scans.stamps, self.odometry.stamps))
        return float(stamps.max() - stamps.min()) * 1e-9 if stamps.size else 0.0


def seconds_between(stamps: Int64) -> Float64:
    """Times between consecutive stamps, s, shape (n - 1,)."""
    return np.diff(stamps) * 1e-9


class ScanPair(NamedTuple):
    """Two scans, and a guess of the robot's motion between them, ``start_T_end``, shape (3,)."""

    start: Scan
    end: Scan
    guess: Float64


MAX_LASERS = 8
"""Lasers of a robot that are distinguished."""

_PAIR_INTERVAL, _PAIR_AGES = 400_000_000, (0, 3, 6)
"""Least time between two scans of a laser that are paired, ns; and which of the last of them are paired with a scan."""

_MAX_PAIRS = 1000
"""Pairs of scans of different lasers, which take two seconds."""


class _PlacedScan(NamedTuple):
    """A scan, and the pose of the robot by the last odometry before it, ``odom_T_base``, shape (3,)."""

    scan: Scan
    pose: Float64


class LaserPairs:
    """Pairs of scans of different lasers from a few seconds, in which both may see the same surfaces.

    :ivar pairs: the pairs, guessed by odometry; the first is the earlier one.
    """

    def __init__(self) -> None:
        self.pairs: list[ScanPair] = []
        self._recent: dict[bytes, deque[_PlacedScan]] = {}
        self._pose: Float64 | None = None

    def note_odometry(self, reading: Odometry) -> None:
        """Take note of the newest reading."""
        self._pose = reading.pose

    def add_scan(self, scan: Scan) -> None:
        """Pair a scan with some of the last scans of the other lasers."""
        key = scan.laser_pose.tobytes()
        if self._pose is None or (key not in self._recent and len(self._recent) == MAX_LASERS):
            return
        own = self._recent.setdefault(key, deque(maxlen=_PAIR_AGES[-1] + 1))
        if own and 0 < scan.stamp - own[-1].scan.stamp < _PAIR_INTERVAL:
            return
        own.append(_PlacedScan(scan, self._pose))
        for recent in self._recent.values():
            for age in _PAIR_AGES if recent is not own else ():
                if age < len(recent) and len(self.pairs) < _MAX_PAIRS:
                    earlier = recent[-1 - age]
                    self.pairs.append(ScanPair(earlier.scan, scan, se2.between(earlier.pose, self._pose)))


class ScanMotionFinder:
    """Registers scans, which are added one after the other, with the scans before them."""

    def __init__(self) -> None:
        self._last: Scan | None = None
        self._pairs: list[ScanPair] = []
        self._motions: list[ScanMotions] = []

    def add(self, scan: Scan) -> None:
        """Pair a scan with the last one that is old enough, and register full batches."""
        last = self._last
        if last is not None and 0 < scan.stamp - last.stamp < _MIN_INTERVAL * 1e9:
            return
        self._last = scan
        if last is None:
            return
        self._pairs.append(ScanPair(last, scan, np.array([0.0, 0.0, turn_between(last, scan)])))
        if len(self._pairs) == _BATCH:
            self._register()

    def finish(self) -> ScanMotions:
        """Register the last batch and return all motions."""
        self._register()
        stamps, values = np.zeros(0, np.int64), np.zeros(0)
        parts = [ScanMotions(stamps, stamps, values.reshape(0, 3), values.reshape(0, 3, 3), values), *self._motions]
        return ScanMotions(
            *(np.concatenate([getattr(part, column.name) for part in parts]) for column in fields(ScanMotions))
        )

    def _register(self) -> None:
        pairs, self._pairs = self._pairs, []
        if pairs:
            self._motions.append(register_pairs(pairs))


def register_pairs(pairs: Sequence[ScanPair]) -> ScanMotions:
    """The motions between pairs of scans, each near its guess."""
    scans = list({id(scan): scan for pair in pairs for scan in (pair.start, pair.end)}.values())
    numbers = {id(scan): number for number, scan in enumerate(scans)}
    surfaces = extract_surfaces(scans, _MAX_RANGE, _MAX_POINTS)
    starts, ends = (np.array([numbers[id(pair[side])] for pair in pairs]) for side in (0, 1))
    options = RefinementParameters()
    guess = np.array([pair.guess for pair in pairs])
    motions = guess
    for gate in _GATES:
        weights = Weighting(options.sigma, max(options.robust_scale, 0.3 * gate), 1.0)
        information, gradient, matched = normal_equations(surfaces, ends, surfaces, starts, motions, gate, weights, 1)
        slope = gradient + se2.log(se2.between(guess, motions)) @ _WEAK_PRIOR
        step = np.linalg.solve(information + _WEAK_PRIOR, slope[..., None])[..., 0]
        motions = se2.compose(motions, se2.exp(-np.clip(step, -1.0, 1.0)))
    matched[np.diff(surfaces.starts)[ends] < _MIN_POINTS] = 0.0
    stamps = np.array([scan.stamp for scan in scans])
    return ScanMotions(stamps[starts], stamps[ends], motions, information, matched)


def turn_between(start: Scan, end: Scan) -> float:
    """The robot's turn between two scans, rad, to about a degree; 0 where their beams differ."""
    if start.ranges.size != end.ranges.size or start.angle_increment != end.angle_increment or not end.angle_increment:
        return 0.0
    size, increment = end.ranges.size, end.angle_increment
    around = size * abs(increment) > 2.0 * math.pi - 1.5 * abs(increment)
    shift = max(1, round(_TURN_STEP / abs(increment)))
    steps = int(_MAX_TURN / abs(increment)) // shift
    best = _best_shift(_capped_ranges(start), _capped_ranges(end), shift, steps, max(1, size // _MAX_BEAMS), around)
    return best * increment + start.angle_min - end.angle_min


def _capped_ranges(scan: Scan) -> Float32:
    """Ranges, shape (n,), m, at most ``_MAX_RANGE``, which also stands for no return."""
    return np.where(scan.valid, np.minimum(scan.ranges, _MAX_RANGE), np.float32(_MAX_RANGE)).astype(np.float32)


@njit(cache=True)
def _best_shift(start: Float32, end: Float32, shift: int, steps: int, every: int, around: bool) -> int:
    """The shift, in beams, of the ranges (n,) of the start against those of the end with the least difference."""
    best, least, size = 0, np.inf, end.size
    for k in range(-steps, steps + 1):
        total, seen = 0.0, 0
        for i in range(0, size, every):
            j = i + k * shift
            if around:
                j %= size
            elif j < 0 or j >= size:
                continue
            total += min(abs(start[j] - end[i]), _MAX_DIFFERENCE)
            seen += 1
        if seen * every >= _MIN_OVERLAP * size and total < least * seen:
            best, least = k * shift, total / seen
    return best


class Gatherer:
    """Gathers the statistics of records, which are added one after the other, for each laser."""

    def __init__(self) -> None:
        self._odometry_stamps, self._odometry_rows, self._non_finite_count = array("q"), array("d"), 0
        self._lasers: dict[bytes, _LaserGatherer] = {}
        self._pairs = LaserPairs()

    def add(self, record: LogRecord) -> None:
        """Add a scan or an odometry reading; observations of marks are passed over."""
        if isinstance(record.measurement, Scan):
            self._laser_of(record.measurement).add(record.source_stamp, record.measurement)
            self._pairs.add_scan(record.measurement)
        elif isinstance(record.measurement, Odometry):
            self._add_odometry(record.source_stamp, record.measurement)

    def _laser_of(self, scan: Scan) -> _LaserGatherer:
        """Where the scans of a laser are gathered; a laser in more places is one that moves."""
        key = scan.laser_pose.tobytes()
        if key not in self._lasers and len(self._lasers) == MAX_LASERS:
            key = next(iter(self._lasers))
        return self._lasers.setdefault(key, _LaserGatherer())

    def _add_odometry(self, source_stamp: int, reading: Odometry) -> None:
        if not np.isfinite(reading.pose).all():
            self._non_finite_count += 1
            return
        self._odometry_stamps.extend((source_stamp, reading.stamp))
        self._odometry_rows.extend(reading.pose)
        self._pairs.note_odometry(reading)

    def finish(self, name: str, messages: MessageStatistics | None = None) -> tuple[Statistics, ...]:
        """The statistics of all records, for each laser.

        :param name: name of the log.
        :param messages: statistics of its messages, None where it is no bag.
        """
        stamps = np.array(self._odometry_stamps, np.int64).reshape(-1, 2)
        poses = np.array(self._odometry_rows, np.float64).reshape(-1, 3)
        odometry = OdometryStatistics(stamps[:, 0], stamps[:, 1], poses, self._non_finite_count)
        lasers = self._lasers.values() or [_LaserGatherer()]
        return tuple(Statistics(name, laser.scans(), odometry, laser.motions(), messages) for laser in lasers)

    @property
    def laser_pairs(self) -> LaserPairs:
        """Pairs of scans of different lasers."""
        return self._pairs


class _LaserGatherer:
    """Gathers the statistics of the scans of a laser."""

    def __init__(self) -> None:
        self._scan_stamps, self._scan_rows, self._counts = array("q"), array("d"), array("q")
        self._beam_statistics = BeamStatistics(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))
        self._sweep_check, self._sweep_fault_count, self._first_sweep_fault = SweepCheck(), 0, ""
        self._motions = ScanMotionFinder()

    def add(self, source_stamp: int, scan: Scan) -> None:
        """Add a scan."""
        if not self._scan_stamps:
            size = scan.ranges.size
            self._beam_statistics = BeamStatistics(np.zeros(size, np.int64), np.full(size, np.inf), np.zeros(size))
        self._scan_stamps.extend((source_stamp, scan.stamp))
        self._scan_rows.extend((scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max))
        self._scan_rows.extend((scan.time_increment, *scan.laser_pose))
        self._counts.extend(
            _count_beams(scan.ranges, max(scan.range_min, 1e-3), scan.range_max, *self._beam_statistics)
        )
        scan, fault = self._sweep_check.check(scan)
        self._sweep_fault_count += fault is not None
        self._first_sweep_fault = self._first_sweep_fault or fault or ""
        self._motions.add(scan)

    def scans(self) -> ScanStatistics:
        """The statistics of the scans."""
        stamps = np.array(self._scan_stamps, np.int64).reshape(-1, 2)
        rows = np.array(self._scan_rows, np.float64).reshape(-1, 8)
        counts = BeamCounts(*np.array(self._counts, np.int64).reshape(-1, 6).T)
        return ScanStatistics(
            stamps[:, 0],
            stamps[:, 1],
            rows[:, :5],
            rows[:, 5:],
            counts,
            self._beam_statistics,
            self._sweep_fault_count,
            self._first_sweep_fault,
        )

    def motions(self) -> ScanMotions:
        """The robot's motions by the scans."""
        return self._motions.finish()


@njit(cache=True)
def _count_beams(
    ranges: Float32, nearest: float, farthest: float, returns: Int64, least: Float64, most: Float64
) -> tuple[int, int, int, int, int, int]:
    """The row of `BeamCounts` of a scan; updates the statistics of each beam where the number of beams is the same.

    :param ranges: shape (n,), m.
    :param nearest: least valid range, m.
    :param farthest: least range that means "no return", m.
    :param returns: shape (b,), of `BeamStatistics`, written to, as ``least`` and ``most``, shape (b,), m.
    """
    valid = nan = infinite = near = far = 0
    same = ranges.size == returns.size
    for k in range(ranges.size):
        value = np.float64(ranges[k])
        if np.isnan(value):
            nan += 1
        elif np.isinf(value):
            infinite += 1
        elif value < nearest:
            near += 1
        elif value >= farthest:
            far += 1
        else:
            valid += 1
            if same:
                returns[k] += 1
                least[k] = min(least[k], value)
                most[k] = max(most[k], value)
    return ranges.size, valid, nan, infinite, near, far
