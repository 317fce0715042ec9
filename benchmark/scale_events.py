"""Time of TSBI for a keyframe event in a large map, with the bound of its work: driven out and back in, and lost."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from benchmark.lattice import OFFSETS, SPACING, Lattice, LatticeScans, LatticeStop, make_stops, shared_scan
from benchmark.report import Requirement, table
from benchmark.scripted import STEP, Script
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.messages import AreaEvents, Keyframe, Message
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, Replica
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.tsbi import Tsbi

MEDIAN, LONGEST = 20.0, 100.0
"""Largest median and largest 99.9th percentile of the time of an event, ms."""

_NEWEST_OF_MAP = 1_000_000_000
"""Keyframe event before those of the run, so that the map is older."""

_EXCURSIONS = 20
_LENGTH = 8  # crossings along the map


def event_requirements(times: dict[str, Float64]) -> list[Requirement]:
    """Requirements on the time of an event.

    :param times: {what the robot does: shape (n,), ms}.
    """
    return [
        Requirement(f"TSBI at 1,000 areas, {name}: {quantile:g} %", float(np.percentile(own, quantile)), bound, "ms")
        for name, own in times.items()
        for quantile, bound in ((50.0, MEDIAN), (99.9, LONGEST))
    ]


def event_table(times: dict[str, Float64]) -> str:
    """Quantiles of the time of an event."""
    rows = [
        [name, str(own.size), *(f"{value:.1f}" for value in np.percentile(own, (50, 99, 99.9, 100)))]
        for name, own in times.items()
    ]
    return table(["TSBI at 1,000 areas", "events", "median [ms]", "99 %", "99.9 %", "max"], rows)


def time_events(lattice: Lattice, configuration: Configuration) -> dict[str, Float64]:
    """{what the robot does: time of TSBI for each keyframe event, shape (n,), ms, wall time}."""
    excursions, lost = [], []
    for seed in range(_EXCURSIONS):
        column = seed * 5 % (lattice.columns - _LENGTH)
        excursions += _excursion(lattice, configuration, column, seed)
        if seed < _EXCURSIONS // 4:
            lost += _loss(lattice, configuration, column, 2 + seed)
    return {"driven beside the map and back into it": np.array(excursions), "lost in the map": np.array(lost)}


class _MeasuredTsbi:
    """TSBI in the map of a lattice.

    :ivar times: of the keyframe events, ms.
    :ivar is_next_unknown: whether the motion to the next keyframe is unknown.
    """

    def __init__(self, lattice: Lattice, configuration: Configuration) -> None:
        self._lattice = lattice
        self.times: list[float] = []
        self.is_next_unknown = False
        self._tsbi = Tsbi(configuration, self._branching)

    def _branching(self, configuration: Configuration, replica: Replica) -> Branching:
        replica.maps[FIRST_HYPOTHESIS] = self._lattice.hybrid_map()
        replica.scans = LatticeScans()
        return Branching(configuration, replica)

    def handle(self, message: Message) -> list[Message]:
        """Handle a message as TSBI."""
        if isinstance(message, Keyframe) and self.is_next_unknown:
            message, self.is_next_unknown = replace(message, motion_unknown=True), False
        begin = time.perf_counter()
        answers = self._tsbi.handle(message)
        if isinstance(message, AreaEvents):
            self.times.append(1e3 * (time.perf_counter() - begin))
        return answers


def _begin(lattice: Lattice, configuration: Configuration, area: int) -> tuple[_MeasuredTsbi, Script]:
    """TSBI, and a robot at the origin of an area, long after the map was made."""
    timed = _MeasuredTsbi(lattice, configuration)
    script = Script(timed)
    script.sequence = _NEWEST_OF_MAP
    script.go_to(area, shared_scan(0.0, 0))
    timed.times.clear()
    return timed, script


def _excursion(lattice: Lattice, configuration: Configuration, column: int, seed: int) -> list[float]:
    """The times on a path from row 0 along row -2 back to row 0, and on to row 1, with a new area at each crossing."""
    timed, script = _begin(lattice, configuration, column)
    end, poses = column + _LENGTH, lattice.poses()
    way = [(column, 0), (column, -1), *((c, -2) for c in range(column, end + 1)), (end, -1), (end, 0), (end, 1)]
    random, pose = np.random.default_rng(seed), np.array([SPACING * column, 0.0, 0.0])
    for stop, step in _steps(make_stops(way), pose):
        error = se2.exp(random.multivariate_normal(np.zeros(3), STEP))
        answer = script.keyframe(se2.compose(step, error), stop.scan, len(OFFSETS) if stop.last else 0)
        if len(answer.hypotheses) == 1 or stop.pose[1] > SPACING:
            best = max(answer.hypotheses, key=lambda hypothesis: hypothesis.probability)
            script.accept(best.id, poses)
    return timed.times


def _loss(lattice: Lattice, configuration: Configuration, column: int, row: int) -> list[float]:
    """The times of a robot whose motion is unknown once, and which drives through crossings that all look the same."""
    timed, script = _begin(lattice, configuration, 0)
    timed.is_next_unknown = True
    way = [*((column + k, row) for k in range(_LENGTH + 1)), *((column + _LENGTH, row + k) for k in range(1, _LENGTH))]
    for stop, step in _steps(make_stops(way), np.array([SPACING * column, SPACING * row, 0.0])):
        script.keyframe(step, stop.scan)
    return timed.times


def _steps(stops: Iterable[LatticeStop], pose: Float64) -> Iterable[tuple[LatticeStop, Float64]]:
    """Each stop with the motion (3,) to it, from a pose (3,) on."""
    for stop in stops:
        yield stop, se2.between(pose, stop.pose)
        pose = stop.pose
