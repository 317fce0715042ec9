"""What does a scan cost in each of the five processes, in a map of many areas?"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from benchmark.lattice import SPACING, Lattice, LatticeScans, scan_at
from hmt_slam_ros.area_abstraction.aam import Aam
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.loop_closure.tlca import Tlca
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, Replica
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.offline.runtime import LockStep
from hmt_slam_ros.real_time_localization.rtl import Rtl
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.tsbi import Tsbi

_REPEATS = 5
_STEP, _TURN = 0.1, 10  # m and degrees between scans
_PERIOD = 200_000_000  # ns
_LOOP = ((0, 0), (2, 0), (2, 1), (0, 1), (0, 0))


class _Timed:
    """A process whose CPU time is counted."""

    def __init__(self, process: Process) -> None:
        self._process = process
        self.seconds = 0.0

    def handle(self, message: Message) -> list[Message]:
        """As the process does."""
        begin = time.process_time()
        said = self._process.handle(message)
        self.seconds += time.process_time() - begin
        return said


def cost_of_scans(
    lattices: Sequence[Lattice], configuration: Configuration, repeats: int = _REPEATS
) -> dict[int, dict[str, float]]:
    """{number of areas: {process: ms a scan}}, medians; the maps take turns, so that all see the same machine."""
    _costs(lattices[0], configuration)
    measured = [{lattice.areas: _costs(lattice, configuration) for lattice in lattices} for _ in range(repeats)]
    return {
        lattice.areas: {
            process: float(np.median([costs[lattice.areas][process] for costs in measured]))
            for process in measured[0][lattice.areas]
        }
        for lattice in lattices
    }


def _costs(lattice: Lattice, configuration: Configuration) -> dict[str, float]:
    """{process: ms a scan} of one drive around the loop."""
    slam, aam, tlca = MetricSlam(configuration), Aam(configuration), Tlca(configuration)
    tsbi = Tsbi(configuration, lambda c, replica: Branching(c, _filled(replica, lattice)))
    for process in (slam, aam, tlca):
        _filled(process._replica, lattice)
    processes: dict[str, Process] = {"slam": slam, "aam": aam, "tsbi": tsbi, "tlca": tlca, "rtl": Rtl(configuration)}
    timed = {name: _Timed(process) for name, process in processes.items()}
    lock_step = LockStep(timed)
    poses = _drive()
    for k, pose in enumerate(poses):
        stamp = _PERIOD * (k + 1)
        lock_step.feed(Odometry(stamp, pose))
        lock_step.feed(scan_at(pose, stamp, k))
    return {name: 1e3 * process.seconds / len(poses) for name, process in timed.items()}


def _filled(replica: Replica, lattice: Lattice) -> Replica:
    """A replica that knows the map, as if its process had been there."""
    replica.maps[FIRST_HYPOTHESIS] = lattice.hybrid_map()
    replica.scans = LatticeScans()
    return replica


def _drive() -> Float64:
    """Poses around the loop, turning on the spot at its corners, shape (n, 3)."""
    poses: list[Float64] = []
    for side, (start, end) in enumerate(pairwise(SPACING * np.array(_LOOP, dtype=np.float64))):
        heading = 0.5 * math.pi * side
        count = round(float(np.hypot(*(end - start))) / _STEP)
        poses += [np.array([*(start + k / count * (end - start)), heading]) for k in range(count)]
        poses += [np.array([*end, heading + math.radians(turn)]) for turn in range(0, 90, _TURN)]
    return np.array(poses)
