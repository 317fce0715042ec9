"""How long does TSBI take for a cut in a map of many areas?"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from benchmark.lattice import OFFSETS, SPACING, Lattice, LatticeScans, shared_scan, stops
from benchmark.scripted import STEP, Script
from benchmark.simulated.examinations import Examination, WatchedBranching
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, Replica
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.tsbi import Tsbi

_EXCURSIONS = 6
_LONGEST = 8  # crossings along the map
_SMALL = 1000  # maps of at most so many areas are made anew for every excursion


class Cut(NamedTuple):
    """One cut.

    :ivar ms: CPU time from the keyframe to the acceptance.
    :ivar compared: known areas that the keyframes were compared with, under all hypotheses.
    :ivar hypotheses: alive after it.
    :ivar unexamined: probability of what was not looked at.
    """

    ms: float
    compared: int
    hypotheses: int
    unexamined: float


class _Timed:
    """A TSBI in a map, of which the CPU time and the comparisons are counted until they are taken."""

    def __init__(self, lattice: Lattice, configuration: Configuration) -> None:
        self._lattice = lattice
        self._seconds, self._compared = 0.0, 0
        self._tsbi = Tsbi(configuration, self._branching)

    def _branching(self, configuration: Configuration, replica: Replica) -> Branching:
        replica.maps[FIRST_HYPOTHESIS] = self._lattice.hybrid_map()
        replica.scans = LatticeScans()
        return WatchedBranching(configuration, replica, self._count)

    def _count(self, examination: Examination) -> None:
        self._compared += len(examination.found.examined)

    def handle(self, message: Message) -> list[Message]:
        """As TSBI does."""
        begin = time.process_time()
        said = self._tsbi.handle(message)
        self._seconds += time.process_time() - begin
        return said

    def take(self) -> tuple[float, int]:
        """Milliseconds and comparisons since the last call."""
        taken = 1e3 * self._seconds, self._compared
        self._seconds, self._compared = 0.0, 0
        return taken


def measured_cuts(lattice: Lattice, configuration: Configuration, excursions: int = _EXCURSIONS) -> list[Cut]:
    """The cuts of some ways out of the map and back in, after one that compiles kernels and is not counted."""
    _Robot(Lattice(5, 2), configuration).excursion(0, 0)
    cuts: list[Cut] = []
    robot = _Robot(lattice, configuration)
    for seed in range(excursions):
        if lattice.areas <= _SMALL:
            cuts += _Robot(lattice, configuration).excursion(0, seed)
        else:
            cuts += robot.excursion(seed * (_LONGEST + 2), seed)
    return cuts


class _Robot:
    """Drives out of a lattice and back in."""

    def __init__(self, lattice: Lattice, configuration: Configuration) -> None:
        self._lattice = lattice
        self._timed = _Timed(lattice, configuration)
        self._script = Script(self._timed)
        self._poses = lattice.poses()

    def excursion(self, column: int, seed: int) -> list[Cut]:
        """The cuts on the way from a crossing of row 0 along row -2 to a later crossing of row 0, and into row 1."""
        end = min(column + _LONGEST, self._lattice.columns - 1)
        way = [(column, 0), (column, -1), *((c, -2) for c in range(column, end + 1)), (end, -1), (end, 0), (end, 1)]
        self._script.go_to(column, shared_scan(0.0, 0))
        random = np.random.default_rng(seed)
        here, cuts = np.array([SPACING * column, 0.0, 0.0]), []
        for stop in stops(way):
            error = se2.exp(random.multivariate_normal(np.zeros(3), STEP))
            step, here = se2.compose(se2.between(here, stop.pose), error), stop.pose
            self._timed.take()
            said = self._script.keyframe(step, stop.scan, len(OFFSETS) if stop.last else 0)
            if len(said.leaves) == 1 or stop.pose[1] > SPACING:
                best = max(said.leaves, key=lambda leaf: leaf.probability)
                self._script.accept(best.hypothesis, self._poses)
            if stop.last:
                cuts.append(Cut(*self._timed.take(), len(said.leaves), said.unexamined))
        return cuts
