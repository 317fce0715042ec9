"""The filter in a bare corridor: ``python -m benchmark.corridor [--seeds N]``.

Between two straight walls without ends, scans have no information along the walls. The motion along them is that of the
odometry, whose noise is drawn from the motion model. The covariance, from which arcs are made, has to cover the truth.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmark.report import table
from hmt_slam_ros.cli.arguments import OneSentenceParser
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.metric_slam.live_hypothesis import LiveHypothesis
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.sensors.motion_model import MotionModel
from hmt_slam_ros.sensors.relative_motion import increment_covariance
from hmt_slam_ros.submap.local_mapping import LocalMapping, PreparedScan
from hmt_slam_ros.submap.particle_filter import ParticleFilter

SEEDS = 24
LEGS = {"a keyframe on": 1, "an arc, 20 keyframes on": 20}
"""{name of a motion: number of keyframes from its start to its end}."""

_LENGTH, _STEP, _PERIOD = 30.0, 0.25, 250_000_000  # m of the drive, m and ns between scans
_WEAVE = 0.05  # rad to each side by which the robot weaves
_HALF_WIDTH, _REACH, _NOISE = 1.1, 8.0, 0.01  # of the corridor, of the laser and of its ranges, m
_BEARINGS = np.radians(np.arange(-90.0, 91.0))
_COVERED = 3.841  # chi-square of 95 % in one dimension


class CorridorDrive(NamedTuple):
    """The estimates of the filter on one drive.

    :ivar truths: of the keyframes, x along the corridor, shape (k, 3).
    :ivar poses: as estimated, map frame, shape (k, 3).
    :ivar covariances: of the step to each keyframe, in its own frame, shape (k, 3, 3).
    :ivar odometry_errors: of the odometry along the corridor from the start to each, shape (k,), m.
    :ivar floor: smallest deviations of an arc, m and degrees.
    """

    truths: NDArray[np.float64]
    poses: NDArray[np.float64]
    covariances: NDArray[np.float64]
    odometry_errors: NDArray[np.float64]
    floor: tuple[float, float] = (0.0, 0.0)


class Errors(NamedTuple):
    """Errors of some motions, along the corridor and across it.

    :ivar errors: shape (n, 2), m.
    :ivar variances: stated, shape (n, 2), m^2.
    :ivar odometry_errors: along the corridor, shape (n,), m.
    :ivar lengths: of the true motions along the corridor, shape (n,), m.
    """

    errors: NDArray[np.float64]
    variances: NDArray[np.float64]
    odometry_errors: NDArray[np.float64]
    lengths: NDArray[np.float64]

    @property
    def nees(self) -> NDArray[np.float64]:
        """Normalized estimation error squared, 1 for a correct covariance, shape (2,)."""
        nees: NDArray[np.float64] = (self.errors**2 / self.variances).mean(axis=0)
        return nees

    @property
    def coverage(self) -> NDArray[np.float64]:
        """Share of the motions whose interval of 95 % covers the truth, shape (2,)."""
        coverage: NDArray[np.float64] = (self.errors**2 / self.variances < _COVERED).mean(axis=0)
        return coverage

    @property
    def shortening(self) -> tuple[float, float]:
        """Share by which the corridor is shorter than by odometry, and the deviation of that mean."""
        shorter = (self.odometry_errors - self.errors[:, 0]) / self.lengths.mean()
        return float(shorter.mean()), float(shorter.std() / np.sqrt(shorter.size))


def drive(seed: int, length: float = _LENGTH) -> CorridorDrive:
    """Drive along the corridor, weaving a little.

    :param length: m.
    """
    configuration = Configuration(seed=seed)
    mapping, motion = LocalMapping(configuration), MotionModel(configuration.motion)
    live = LiveHypothesis(ParticleFilter(mapping, 0, 0), configuration.filter)
    random = np.random.default_rng(seed)
    truths = _make_path(length, random)
    odometry, error, odometry_errors = np.zeros(3), 0.0, np.zeros(len(truths))
    for k, truth in enumerate(truths):
        if k:
            increment = se2.between(truths[k - 1], truth)
            deviations = np.sqrt(np.diag(increment_covariance(increment, configuration.motion)))
            slip = deviations * random.standard_normal(3)
            odometry = se2.compose(odometry, se2.compose(increment, se2.exp(slip)))
            error += float(np.cos(truth[2]) * slip[0] - np.sin(truth[2]) * slip[1])
            odometry_errors[k] = error
        motion.odometry.add(Odometry(k * _PERIOD, odometry))
        scan = _make_scan(k * _PERIOD, truth, random)
        _process_scan(live, motion, k, PreparedScan(mapping, scan))
    kept = live.filter.keyframes
    covariances = np.array([live.step_covariances[keyframe] for keyframe in kept])
    floor = configuration.tlca.arc_sigma_floor, configuration.tlca.arc_angle_floor
    return CorridorDrive(truths[kept], live.filter.leading_keyframe_poses(), covariances, odometry_errors[kept], floor)


def _make_path(length: float, random: np.random.Generator) -> NDArray[np.float64]:
    """Poses (n, 3) of the scans, near the middle of the corridor."""
    x = np.arange(0.0, length + 1e-9, _STEP)
    headings = _WEAVE * np.sin(x / 3.0 + random.uniform(0.0, 2.0 * np.pi))
    lateral = np.concatenate(([random.uniform(-0.4, 0.4)], _STEP * np.sin(headings[:-1])))
    return np.stack((x, np.cumsum(lateral), headings), axis=1)


def _make_scan(stamp: int, pose: NDArray[np.float64], random: np.random.Generator) -> Scan:
    sines = np.sin(_BEARINGS + pose[2])
    with np.errstate(divide="ignore"):
        ranges = (np.sign(sines) * _HALF_WIDTH - pose[1]) / sines
    noisy_ranges = ranges + _NOISE * random.standard_normal(ranges.size)
    noisy_ranges = np.where(ranges < _REACH, noisy_ranges, np.inf).astype(np.float32)
    return Scan(stamp, noisy_ranges, _BEARINGS[0], _BEARINGS[1] - _BEARINGS[0], 0.05, _REACH + 1.0)


def _process_scan(live: LiveHypothesis, motion: MotionModel, number: int, prepared_scan: PreparedScan) -> None:
    """Process a scan as metric SLAM does without the other processes."""
    prediction = motion.predict(prepared_scan.scan.stamp)
    if number:
        match = live.filter.track(prepared_scan, prediction)
        motion.observe(match.increment, match.information, match.contradicts_odometry)
    if not number or live.is_event_due(prepared_scan):
        scans = dict.fromkeys(live.filter.keyframes, prepared_scan.scan)
        is_new = partial(live.is_new_viewpoint, prepared_scan.scan, scans)
        live.process_keyframe(number, prepared_scan, after_reset=number == 0, is_informative=is_new)
        motion.observe_keyframe(live.event.motion, live.event.match_information)


def errors_of(drives: Sequence[CorridorDrive], stride: int) -> Errors:
    """Errors of the disjoint motions from one keyframe to the one ``stride`` later."""
    rows = []
    for drive in drives:
        rows += [_motion_error(drive, first, first + stride) for first in range(0, len(drive.poses) - stride, stride)]
    errors, variances, odometry_errors, lengths = zip(*rows, strict=True)
    return Errors(np.array(errors), np.array(variances), np.array(odometry_errors), np.array(lengths))


def _motion_error(
    drive: CorridorDrive, first: int, last: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    """Error (2,) and variance (2,) of a motion along and across the corridor, error of odometry and true length."""
    sigma, angle = drive.floor
    covariance = np.zeros((3, 3))
    for k in range(first + 1, last + 1):
        ad = se2.adjoint(se2.between(drive.poses[k], drive.poses[k - 1]))
        covariance = ad @ covariance @ ad.T + drive.covariances[k]
    true, found = (se2.between(poses[first], poses[last]) for poses in (drive.truths, drive.poses))
    covariance = covariance + np.diag([sigma, sigma, np.radians(angle)]) ** 2
    turn = se2.adjoint(np.array([0.0, 0.0, drive.truths[last, 2]]))
    error = turn @ se2.log(se2.between(true, found))
    odometry_error = float(drive.odometry_errors[last] - drive.odometry_errors[first])
    length = float(drive.truths[last, 0] - drive.truths[first, 0])
    return error[:2], np.diag(turn @ covariance @ turn.T)[:2], odometry_error, length


def report(drives: Sequence[CorridorDrive]) -> str:
    """The table of errors."""
    head = ["motion", "number", "shrink [%]", "odometry [m]", "error [m]", "stated [m]", "NEES along", "across"]
    head += ["covered along [%]", "across"]
    rows = []
    for name, stride in LEGS.items():
        found = errors_of(drives, stride)
        shortening, deviation = found.shortening
        wheels, along = (np.sqrt(np.mean(values**2)) for values in (found.odometry_errors, found.errors[:, 0]))
        figures = [f"{wheels:.3f}", f"{along:.3f}", f"{np.sqrt(found.variances[:, 0].mean()):.3f}"]
        shares = [f"{100.0 * share:.1f}" for share in found.coverage]
        shrunk = f"{100.0 * shortening:+.2f} ± {100.0 * deviation:.2f}"
        rows.append([name, str(len(found.errors)), shrunk, *figures, *(f"{n:.2f}" for n in found.nees), *shares])
    return table(head, rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Drive once for every seed, and print the table."""
    parser = OneSentenceParser(prog="python -m benchmark.corridor", description="A bare corridor in the filter.")
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N", help="seeds 0 to N-1")
    seeds = parser.parse_args(arguments).seeds
    if seeds < 1:
        parser.error(f"--seeds {seeds} is too small: give 1 or more")
    print(report([drive(seed) for seed in range(seeds)]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
