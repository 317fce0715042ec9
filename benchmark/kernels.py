"""Cost of the inner loops: CPU time, and memory taken from the heap."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmark.allocations import count_allocations, describe_counts, requirements_on
from benchmark.logs import BUNDLED, open_logs
from benchmark.report import Report, table
from benchmark.settings import Settings
from hmt_slam_ros.area_abstraction.overlap_graph import overlaps, sensed_points
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.logs import Log
from hmt_slam_ros.messages.messages import LocalEstimate
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.real_time_localization.rtl import Rtl
from hmt_slam_ros.registration import dynamic_rejection, scan_to_map
from hmt_slam_ros.sensors import Odometry, Scan
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.submap.local_mapping import LocalMapping

_KEYFRAMES, _PER_AREA = 400, 40
_APART = 0.03  # m
_REPEATS = 3

Keyframes = list[tuple[Scan, NDArray[np.float64]]]

TIMES = (
    "CPU time, the least of three repetitions, with compiled kernels. A keyframe every half meter or twenty degrees of "
    "odometry is inserted into the maps of the particles, which are a few centimeters apart; the maps are cleared "
    "every forty keyframes, as at a change of area. Scans are simulated in an office with people, 361 beams each, by "
    "ray casting alone and with all other steps; a laser of 10 Hz has 100 000 us for one."
)
ALLOCATIONS = (
    "The whole log is mapped. The table counts the arrays that numba's runtime allocates in a call of each kernel from "
    "Python, including the kernels that it calls. Their number is independent of beams, particles and steps: the loops "
    "over these allocate none."
)


class Timer:
    """CPU time of pieces of work, with their amounts.

    Use the least of several repetitions: the rest is time of other programs.
    """

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._amounts: dict[str, int] = {}

    def add(self, name: str, amount: int, work: Callable[[], object]) -> None:
        """Do a piece of work, and add its time and amount to those of a name."""
        begin = time.process_time()
        work()
        self._seconds[name] = self._seconds.get(name, 0.0) + time.process_time() - begin
        self._amounts[name] = self._amounts.get(name, 0) + amount

    def microseconds(self) -> dict[str, float]:
        """{name: CPU time for a unit of its amount, us}."""
        return {name: 1e6 * seconds / self._amounts[name] for name, seconds in self._seconds.items()}


def measure_kernels(settings: Settings) -> Report:
    """Measure time and allocations of the inner loops on some logs, by default the bundled one."""
    report = Report("kernels", "What the inner loops cost", seeds=(0,))
    configuration = load_configuration(settings=settings.changes)
    with open_logs(settings.logs_or((BUNDLED,))) as logs:
        for log in logs:
            _report_times(report, log.name, open_log(log.path), configuration)
            _report_allocations(report, log.name, open_log(log.path), configuration)
    return report


def _report_times(report: Report, name: str, log: Log, configuration: Configuration) -> None:
    keyframes, readings = _keyframes(log, configuration)
    rounds = []
    for _ in range(1 + _REPEATS):
        timer = Timer()
        _measure_maps(keyframes, configuration, timer)
        _measure_overlaps(keyframes, configuration, timer)
        _measure_rtl(readings, configuration, timer)
        _measure_simulation(timer)
        rounds.append(timer.microseconds())
    # The first round compiles kernels, or loads them.
    least = {work: min(times[work] for times in rounds[1:]) for work in rounds[0]}
    report.body += [TIMES, table([name, "[us]"], [[work, f"{times:.2f}"] for work, times in least.items()])]
    report.data[f"{name}_us"] = least


def _report_allocations(report: Report, name: str, log: Log, configuration: Configuration) -> None:
    run_log(log, configuration)
    with count_allocations() as counts:
        run_log(log, configuration)
    report.requirements += requirements_on(counts)
    text, report.data[f"{name}_arrays"] = describe_counts(counts, log.scan_count)
    report.body += [ALLOCATIONS, text]


def _keyframes(log: Log, configuration: Configuration) -> tuple[Keyframes, list[Odometry]]:
    """Keyframes with ``odom_T_base`` (3,), and all odometry readings."""
    keyframes: Keyframes = []
    readings: list[Odometry] = []
    for record in log.records():
        if isinstance(record.measurement, Odometry):
            readings.append(record.measurement)
        elif (
            isinstance(record.measurement, Scan)
            and readings
            and len(keyframes) < _KEYFRAMES
            and _is_due(keyframes, readings[-1].pose, configuration)
        ):
            keyframes.append((record.measurement, readings[-1].pose))
    return keyframes, readings


def _is_due(keyframes: Keyframes, pose: NDArray[np.float64], configuration: Configuration) -> bool:
    if not keyframes:
        return True
    moved, settings = se2.between(keyframes[-1][1], pose), configuration.filter
    far = math.hypot(moved[0], moved[1]) >= settings.keyframe_distance
    return far or abs(moved[2]) >= math.radians(settings.keyframe_angle)


def _measure_maps(keyframes: Keyframes, configuration: Configuration, timer: Timer) -> None:
    """Insertion into the maps of all particles, and matching with them."""
    mapping, count = LocalMapping(configuration), configuration.filter.particles
    offsets = np.zeros((count, 3))
    offsets[:, 1] = _APART * np.arange(count)
    tables = np.stack([mapping.pool.empty_table()] * count)
    first = keyframes[0][1]
    for k, (scan, odometry) in enumerate(keyframes):
        if k % _PER_AREA == 0:
            for table in tables:
                mapping.pool.release(table)
            first = odometry
        poses = se2.compose(offsets, se2.between(first, odometry))
        if k % _PER_AREA:
            _measure_matching(mapping, mapping.matching_surfels(scan), tables, poses, timer)
        beams = len(scan.points) * count
        timer.add("insertion, a beam and a map", beams, partial(mapping.insert_scan, tables, poses, scan))


def _measure_matching(
    mapping: LocalMapping,
    points: NDArray[np.float64],
    tables: NDArray[np.int32],
    poses: NDArray[np.float64],
    timer: Timer,
) -> None:
    information = np.linalg.inv(np.diag([0.05, 0.05, 0.03]) ** 2)
    view, settings = mapping.pool.view(tables[0]), mapping.configuration.matching
    prior = scan_to_map.Prior(poses[0], information)
    timer.add("Gauss-Newton, a scan", 1, lambda: scan_to_map.align(points, poses[0], prior, view, mapping.alignment))
    timer.add(
        "dynamic rejection, a scan",
        1,
        lambda: dynamic_rejection.reject_dynamic(points, prior.mean, prior, view, mapping.alignment),
    )
    timer.add(
        "likelihood, a point",
        len(points),
        lambda: scan_to_map.log_ratio(points, *poses[0].tolist(), view, mapping.beam_model),
    )
    timer.add(
        "proposal, a scan and a particle",
        len(poses),
        lambda: scan_to_map.propose_all(
            points,
            points,
            poses,
            poses,
            information,
            tables,
            view,
            mapping.alignment,
            mapping.beam_model,
            settings.sharpness,
            settings.temper,
        ),
    )


def _measure_overlaps(keyframes: Keyframes, configuration: Configuration, timer: Timer) -> None:
    """Overlap of each keyframe with those of its area before it."""
    options, reach = configuration.aam, configuration.local_map.max_range
    points = [sensed_points(scan, reach, options.overlap_points) for scan, _ in keyframes]
    poses = np.array([pose for _, pose in keyframes])
    for k in range(1, len(keyframes)):
        before = slice(max(0, k - _PER_AREA), k)
        timer.add(
            "overlap, a pair of keyframes",
            k - before.start,
            partial(overlaps, points[k], poses[k], points[before], poses[before], options.overlap_radius),
        )


def _measure_rtl(readings: list[Odometry], configuration: Configuration, timer: Timer) -> None:
    """A pose for every reading, with a new estimate at every third."""
    process, belief = Rtl(configuration), np.diag([1e-4, 1e-4, 1e-5])

    def play() -> None:
        for k, reading in enumerate(readings):
            process.handle(reading)
            if k % 3 == 0:
                estimate = PoseGaussian(reading.pose, belief)
                process.handle(LocalEstimate(reading.stamp, k, 0, estimate, reading.pose, 0))

    timer.add("real-time localization, an odometry reading", len(readings), play)


def _measure_simulation(timer: Timer) -> None:
    scenario = open_simulated("sim:busy").scenario
    numbers = range(0, scenario.scan_stamps.size, 10)
    poses = scenario.true_poses(scenario.scan_stamps)
    no_people = np.empty((0, 3))

    def cast_all() -> None:
        for number in numbers:
            scenario.laser.distances(poses[number : number + 1], scenario.walls, no_people)

    timer.add("ray casting, a scan of 361 beams", len(numbers), cast_all)
    timer.add("simulation, a scan of 361 beams", len(numbers), lambda: [scenario.scan(k) for k in numbers])
