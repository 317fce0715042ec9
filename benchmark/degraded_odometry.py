"""Logs with degraded odometry, and the program that maps them.

``python -m benchmark.degraded_odometry KIND LOG --out DIR ...`` maps a log as ``hmt_slam map`` does. The seed of the
run is also the seed of what is drawn for the odometry.

==========  ==========================================================================================================
kind        degradation of the odometry
==========  ==========================================================================================================
noise-2x    Gaussian noise on every increment, so that the error of the motion model's defaults grows twofold
noise-4x    the same, fourfold
slip        at random turns of more than 45 degrees, one in five, the heading slips by 20 degrees within a second
missing     5 % of the readings, drawn at random, are missing
none        all readings are missing
==========  ==========================================================================================================

The noise is a random walk: its variance grows with the distance and the angle traveled, for any rate of the
readings, and over one meter or one radian the deviation is the motion model's. The same log, kind and seed give the
same readings, bit for bit.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmark.real_faults.stream import chain_increments
from hmt_slam_ros.cli.arguments import build_parser, chosen_configuration
from hmt_slam_ros.cli.run_commands import run_measured
from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.records import Log, LogRecord
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.output_folder import atomic_output, write_output
from hmt_slam_ros.sensors import Odometry

KINDS = ("noise-2x", "noise-4x", "slip", "missing", "none")
_MISSING_SHARE = 0.05
_SLIP_SHARE = 0.2
_SLIP = math.radians(20.0)
_SLIP_SECONDS = 1.0
_TURN = math.radians(45.0)
_TURNING_RATE = math.radians(5.0)


@dataclass(frozen=True, eq=False)
class DegradedLog:
    """A log whose odometry is replaced.

    :ivar original: the log as it was recorded.
    :ivar kind: one of ``KINDS``.
    :ivar readings: {index of an odometry reading among the log's readings: ``odom_T_base`` (3,)}, of those kept.
    """

    original: Log
    kind: str
    readings: dict[int, NDArray[np.float64]]

    @property
    def name(self) -> str:
        """The log's name and the kind."""
        return f"{self.original.name} {self.kind}"

    @property
    def scan_count(self) -> int:
        """Number of scans, the same as of the original."""
        return self.original.scan_count

    @property
    def duration(self) -> float:
        """Seconds, the same as of the original."""
        return self.original.duration

    def records(self) -> Iterator[LogRecord]:
        """All measurements in file order, with the remaining odometry readings."""
        index = 0
        for record in self.original.records():
            measurement = record.measurement
            if not isinstance(measurement, Odometry):
                yield record
                continue
            if index in self.readings:
                yield replace(record, measurement=Odometry(measurement.stamp, self.readings[index]))
            index += 1


def degrade_log(log: Log, kind: str, seed: int) -> DegradedLog:
    """The log with its odometry degraded.

    :param kind: one of ``KINDS``.
    :param seed: of what is drawn.
    :raises ValueError: where the kind is another.
    """
    if kind not in KINDS:
        raise ValueError(f"{kind!r} is no kind of degradation: choose one of {', '.join(KINDS)}")
    random = np.random.Generator(np.random.Philox(key=[seed, KINDS.index(kind)]))
    readings = [record.measurement for record in log.records() if isinstance(record.measurement, Odometry)]
    if kind == "none" or not readings:
        return DegradedLog(log, kind, {})
    if kind == "missing":
        kept = np.flatnonzero(random.random(len(readings)) >= _MISSING_SHARE)
        return DegradedLog(log, kind, {int(k): readings[k].pose for k in kept})
    poses = np.array([reading.pose for reading in readings])
    increments = se2.between(poses[:-1], poses[1:])
    if kind == "slip":
        errors = _slip_errors(np.array([reading.stamp for reading in readings]) / NANOSECONDS, increments, random)
    else:
        errors = _noise_errors(increments, {"noise-2x": 2.0, "noise-4x": 4.0}[kind], random)
    return DegradedLog(log, kind, dict(enumerate(chain_increments(poses[0], se2.compose(increments, errors)))))


def _noise_errors(increments: NDArray[np.float64], factor: float, random: np.random.Generator) -> NDArray[np.float64]:
    """Errors (n, 3), in the frame of each increment's end, that add up with the odometry's own to ``factor`` times."""
    motion = MotionParameters()
    distance, angle = np.hypot(increments[:, 0], increments[:, 1]), np.abs(increments[:, 2])
    translation = np.hypot(
        motion.translation_from_translation * np.sqrt(distance),
        motion.translation_from_rotation * math.degrees(1.0) * np.sqrt(angle),
    )
    rotation = np.hypot(
        math.radians(motion.rotation_from_translation) * np.sqrt(distance),
        motion.rotation_from_rotation * np.sqrt(angle),
    )
    deviations = math.sqrt(factor**2 - 1.0) * np.stack((translation, translation, rotation), axis=1)
    return deviations * random.standard_normal(increments.shape)


def _slip_errors(
    seconds: NDArray[np.float64], increments: NDArray[np.float64], random: np.random.Generator
) -> NDArray[np.float64]:
    """Errors (n, 3) of heading, each slip spread evenly over a second from the middle of its turn."""
    heading = np.concatenate(([0.0], np.cumsum(increments[:, 2])))
    middles = _middles_of_turns(seconds, heading)
    slipping = random.random(middles.size) < _SLIP_SHARE
    signs = np.where(random.random(middles.size) < 0.5, -1.0, 1.0)
    slipped = np.zeros_like(heading)
    for middle, sign in zip(middles[slipping], signs[slipping], strict=True):
        slipped += sign * _SLIP * np.clip((seconds - middle) / _SLIP_SECONDS, 0.0, 1.0)
    errors = np.zeros_like(increments)
    errors[:, 2] = np.diff(slipped)
    return errors


def _middles_of_turns(seconds: NDArray[np.float64], heading: NDArray[np.float64]) -> NDArray[np.float64]:
    """Time in s at which each turn of more than 45 degrees is half done; a turn ends where it slows down or reverses.

    :param heading: unwrapped, rad, of each reading, as many as ``seconds``.
    """
    rate = np.interp(seconds + 0.5, seconds, heading) - np.interp(seconds - 0.5, seconds, heading)
    direction = np.sign(rate) * (np.abs(rate) > _TURNING_RATE)
    edges = np.concatenate(([0], np.flatnonzero(np.diff(direction)) + 1, [len(heading)]))
    middles = []
    for begin, end in zip(edges[:-1], edges[1:] - 1, strict=True):
        turned = heading[end] - heading[begin]
        if direction[begin] and abs(turned) > _TURN:
            half = begin + int(np.argmax(np.abs(heading[begin : end + 1] - heading[begin]) >= 0.5 * abs(turned)))
            middles.append(seconds[half])
    return np.array(middles)


def main(arguments: list[str]) -> int:
    """Run; return the exit status."""
    kind, *rest = arguments
    options = build_parser().parse_args(["map", *rest])
    try:
        configuration = chosen_configuration(options)
        part = configuration.robot
        recorded = open_log(options.log, start=part.start, duration=part.duration or None)
        log = degrade_log(recorded, kind, configuration.seed)
        with atomic_output(options.out) as folder:
            final, source_stamps, figures = run_measured(log, configuration)
            write_output(folder, final, source_stamps, figures, configuration)
    except HmtSlamError as fault:
        print(f"degraded_odometry: {fault}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
