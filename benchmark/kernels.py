"""What the inner loops cost: ``python -m benchmark.kernels [LOG]``, in CPU time of this machine, kernels compiled.

A keyframe every half metre or twenty degrees of the log's odometry is entered into the maps of the particles, which
stand beside each other a few centimetres apart; every forty keyframes the maps are forgotten, as at a change of area.
The bundled log serves where none is named. Scans are simulated in an office with people in it, 361 beams each, by ray
casting alone and with all that belongs to a scan; a laser of 10 Hz takes 100 000 us for one.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmark.logs import ROOT
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.local_map import batch, matching, movers
from hmt_slam_ros.local_map.local_mapping import LocalMapping
from hmt_slam_ros.logs import open_log
from hmt_slam_ros.processes.messages import LocalEstimate
from hmt_slam_ros.processes.rtl import Rtl
from hmt_slam_ros.sensing import Odometry, Scan
from hmt_slam_ros.simulation import open_simulated
from hmt_slam_ros.topology.overlap import overlaps, sensed_points

_KEYFRAMES, _PER_AREA = 400, 40
_APART = 0.03  # m
_REPEATS = 3
_CONFIGURATION = Configuration()


class Figures:
    """CPU seconds of pieces of work, and how much of what they did.

    The least of several repetitions counts: what is above it is other programs' doing.
    """

    def __init__(self) -> None:
        self._seconds: dict[str, float] = {}
        self._amounts: dict[str, int] = {}

    def timed(self, name: str, amount: int, work: Callable[[], object]) -> None:
        """Do a piece of work, and add it to what was done under this name."""
        begin = time.process_time()
        work()
        self._seconds[name] = self._seconds.get(name, 0.0) + time.process_time() - begin
        self._amounts[name] = self._amounts.get(name, 0) + amount

    def microseconds(self) -> dict[str, float]:
        """{name: CPU time of one of its amounts}."""
        return {name: 1e6 * seconds / self._amounts[name] for name, seconds in self._seconds.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmark.kernels", description="What the inner loops cost.")
    parser.add_argument("log", nargs="?", type=Path, default=ROOT / "data" / "malaga_one_loop", metavar="LOG")
    keyframes, readings = _keyframes(parser.parse_args(arguments).log)
    rounds = []
    for _ in range(1 + _REPEATS):
        figures = Figures()
        _measure_maps(keyframes, figures)
        _measure_overlaps(keyframes, figures)
        _measure_rtl(readings, figures)
        _measure_simulation(figures)
        rounds.append(figures.microseconds())
    # The first round compiles, or loads what was compiled.
    for name in rounds[0]:
        print(f"{min(taken[name] for taken in rounds[1:]):10.2f} us {name}")


def _keyframes(path: Path) -> tuple[list[tuple[Scan, NDArray[np.float64]]], list[Odometry]]:
    """Keyframes with ``odom_T_base`` (3,), and all odometry readings."""
    keyframes: list[tuple[Scan, NDArray[np.float64]]] = []
    readings: list[Odometry] = []
    for record in open_log(path).records():
        if isinstance(record.measurement, Odometry):
            readings.append(record.measurement)
        elif readings and _is_due(keyframes, readings[-1].pose) and len(keyframes) < _KEYFRAMES:
            keyframes.append((record.measurement, readings[-1].pose))
    return keyframes, readings


def _is_due(keyframes: list[tuple[Scan, NDArray[np.float64]]], pose: NDArray[np.float64]) -> bool:
    if not keyframes:
        return True
    moved, settings = se2.between(keyframes[-1][1], pose), _CONFIGURATION.filter
    far = math.hypot(moved[0], moved[1]) >= settings.keyframe_distance
    return far or abs(moved[2]) >= math.radians(settings.keyframe_angle)


def _measure_maps(keyframes: list[tuple[Scan, NDArray[np.float64]]], figures: Figures) -> None:
    """Insertion into the maps of all particles, and matching with them."""
    mapping, count = LocalMapping(_CONFIGURATION), _CONFIGURATION.filter.particles
    beside = np.zeros((count, 3))
    beside[:, 1] = _APART * np.arange(count)
    tables = np.stack([mapping.pool.empty_table()] * count)
    first = keyframes[0][1]
    for k, (scan, odometry) in enumerate(keyframes):
        if k % _PER_AREA == 0:
            for table in tables:
                mapping.pool.release(table)
            first = odometry
        poses = se2.compose(beside, se2.between(first, odometry))
        if k % _PER_AREA:
            _measure_matching(mapping, mapping.matching_points(scan), tables, poses, figures)
        beams = len(scan.points) * count
        figures.timed("insertion, a beam and a map", beams, partial(mapping.insert, tables, poses, scan))


def _measure_matching(
    mapping: LocalMapping,
    points: NDArray[np.float64],
    tables: NDArray[np.int32],
    poses: NDArray[np.float64],
    figures: Figures,
) -> None:
    information = np.linalg.inv(np.diag([0.05, 0.05, 0.03]) ** 2)
    view, settings = mapping.pool.view(tables[0]), _CONFIGURATION.matching
    prior = matching.Prior(poses[0], information)
    figures.timed(
        "Gauss-Newton, a scan", 1, lambda: matching.align(points, poses[0], prior, view, mapping.alignment)
    )
    figures.timed(
        "things that moved, a scan", 1, lambda: movers.standing(points, prior, view, mapping.alignment)
    )
    figures.timed(
        "likelihood, a point",
        len(points),
        lambda: matching.log_ratio(points, *poses[0].tolist(), view, mapping.model),
    )
    figures.timed(
        "proposal, a scan and a particle",
        len(poses),
        lambda: batch.propose_all(
            points, points, poses, poses, information, tables, view, mapping.alignment, mapping.model,
            settings.sharpness, settings.temper,
        ),
    )  # fmt: skip


def _measure_overlaps(keyframes: list[tuple[Scan, NDArray[np.float64]]], figures: Figures) -> None:
    """Overlap of each keyframe with those of its area before it."""
    options, reach = _CONFIGURATION.aam, _CONFIGURATION.local_map.max_range
    points = [sensed_points(scan, reach, options.overlap_points) for scan, _ in keyframes]
    poses = np.array([pose for _, pose in keyframes])
    for k in range(1, len(keyframes)):
        before = slice(max(0, k - _PER_AREA), k)
        figures.timed(
            "overlap, a pair of keyframes",
            k - before.start,
            partial(overlaps, points[k], poses[k], points[before], poses[before], options.overlap_radius),
        )


def _measure_rtl(readings: list[Odometry], figures: Figures) -> None:
    """A pose for every reading, where every third brings a new estimate."""
    process, belief = Rtl(_CONFIGURATION), np.diag([1e-4, 1e-4, 1e-5])

    def play() -> None:
        for k, reading in enumerate(readings):
            process.handle(reading)
            if k % 3 == 0:
                estimate = PoseGaussian(reading.pose, belief)
                process.handle(LocalEstimate(reading.stamp, k, 0, estimate, reading.pose, 0))

    figures.timed("real-time localisation, an odometry reading", len(readings), play)


def _measure_simulation(figures: Figures) -> None:
    scenario = open_simulated("sim:busy").scenario
    numbers = range(0, scenario.scan_stamps.size, 10)
    poses = scenario.true_poses(scenario.scan_stamps)
    nobody = np.empty((0, 3))

    def cast_all() -> None:
        for number in numbers:
            scenario.laser.distances(poses[number : number + 1], scenario.walls, nobody)

    figures.timed("ray casting, a scan of 361 beams", len(numbers), cast_all)
    figures.timed("simulation, a scan of 361 beams", len(numbers), lambda: [scenario.scan(k) for k in numbers])


if __name__ == "__main__":
    main()
