"""Time and memory in maps of up to 100,000 areas: cuts, scans, storage."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmark.lattice import BEAMS, OFFSETS, PER_AREA, SPACING, Lattice, LatticeScans, make_stops, scan_at, shared_scan
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.scale_events import event_requirements, event_table, time_events
from benchmark.scale_maps import BEAMS as STORED_BEAMS
from benchmark.scale_maps import SCANS_PER_KEYFRAME, AreaMemory, SaveTimes, time_saving, weigh_areas
from benchmark.scripted import STEP, Script
from benchmark.settings import Settings
from benchmark.simulated.examinations import Examination, ObservedBranching
from hmt_slam_ros.area_abstraction.aam import Aam
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.loop_closure.tlca import Tlca
from hmt_slam_ros.messages.messages import Message
from hmt_slam_ros.messages.replica import FIRST_HYPOTHESIS, Replica
from hmt_slam_ros.messages.routing import Process
from hmt_slam_ros.metric_slam.slam import MetricSlam
from hmt_slam_ros.offline.lock_step import LockStep
from hmt_slam_ros.real_time_localization.rtl import Rtl
from hmt_slam_ros.sensors import Odometry
from hmt_slam_ros.topological_inference.branching import MIN_EXAMINED_AREAS, Branching
from hmt_slam_ros.topological_inference.tsbi import Tsbi

SMALL = (Lattice(5, 2), Lattice(10, 10), Lattice(50, 20))
LARGE = (Lattice(100, 100), Lattice(1000, 100))

CUT_BOUNDS = {10_000: 100.0, 100_000: 1000.0}
"""Largest time of a cut, ms, by the number of areas."""

STRESS = ("tsbi.prior_scale=5", "tsbi.temper=0.03")
"""Parameters under which arcs admit more areas than are compared, and scans are nearly uninformative."""

GROWTH = 0.1
"""Largest growth of the cost of a scan in SLAM, in RTL and in all processes, from the smallest of the small maps on."""

ALL = "all processes"

STORED = 20.0
"""Largest memory of a stored area, kB."""

LASTING = Lattice(50, 40)
"""The map that is saved and loaded."""

SAVED_AND_LOADED = 5.0
"""Largest time to save and load it, s."""

_FEW = 2  # excursions under stress

POLICY = (
    f"Maps are synthetic lattices of corridors with equal crossings: every crossing is an area of {PER_AREA} keyframes "
    f"with arcs to the next ones, {BEAMS} beams to a scan. For the cuts a robot leaves the lattice, drives beside it "
    "for up to eight crossings with a new area at each, and returns. Its odometry errs by its covariance, and a "
    "replacement of metric SLAM and acceptance gives its poses to TSBI. The time of a cut is that from the keyframe to "
    "the acceptance, CPU time of one process, under all live hypotheses. The time of an event is that of TSBI alone, "
    "wall time, with the bound of its work, which cuts lack; a lost robot drives where all looks the same. "
    f"Under stress ({', '.join(STRESS)}) arcs admit far more areas than are compared, which counts as unexamined, and "
    "scans are nearly uninformative. For the scans all five processes run in a loop through known ground; CPU time of "
    "a scan, median of the repetitions. "
    "Memory is what Python allocates: poses and arcs in each process that keeps the map, and the ranges of its scans, "
    f"here of {STORED_BEAMS} beams. Data that can be computed from these is listed, and does not count. The saved "
    f"state is that of a run that mapped the lattice in one pass, under one hypothesis, with a scan of {STORED_BEAMS} "
    f"beams for every keyframe and {SCANS_PER_KEYFRAME} scans of the log to each. Saving ends with all files on the "
    "disk of the system's temporary folder, loading with processes that can continue; wall time."
)

_EXCURSIONS = 6
_LONGEST = 8  # crossings along the map
_SMALL = 1000  # largest number of areas of a map that is made for every excursion
_REPEATS = 5
_STEP, _TURN = 0.1, 10  # m and degrees between scans
_PERIOD = 200_000_000  # ns
_LOOP = ((0, 0), (2, 0), (2, 1), (0, 1), (0, 0))
_DPI = 110


def measure_scale(settings: Settings) -> Report:
    """Measure times of cuts, scans and files, and the memory of an area."""
    configuration = settings.configuration
    report = Report("scale", "Cost against the number of areas", seeds=(0,))
    cuts = {lattice.areas: measured_cuts(lattice, configuration) for lattice in (*SMALL, *LARGE)}
    report.requirements += [cut_requirement(areas, cuts[areas]) for areas in CUT_BOUNDS]
    stressed = measured_cuts(LARGE[0], load_configuration(PARAMETERS, [*settings.changes, *STRESS]), _FEW)
    scans = cost_of_scans(SMALL, configuration)
    report.requirements += [growth_requirement(process, scans) for process in ("slam", "rtl", ALL)]
    events = time_events(SMALL[-1], configuration)
    report.requirements += event_requirements(events)
    area = weigh_areas(LARGE[0])
    report.requirements.append(Requirement("memory of a stored area with its scans", area.whole, STORED, "kB"))
    saved = time_saving(LASTING, configuration)
    name = f"saving and loading a map of {saved.areas} areas"
    report.requirements.append(Requirement(name, saved.whole, SAVED_AND_LOADED, "s"))
    named = {str(areas): own for areas, own in cuts.items()} | {f"{LARGE[0].areas}, stress": stressed}
    bound = _describe_bound(configuration, [cut for own in named.values() for cut in own])
    report.body += [
        _cut_table(named),
        bound,
        event_table(events),
        _scan_table(scans),
        _stored_table(area),
        _lasting_table(saved),
        POLICY,
    ]
    report.data |= {
        "cuts": {name: [cut._asdict() for cut in own] for name, own in named.items()},
        "ms_per_event": {name: own.tolist() for name, own in events.items()},
        "ms_per_scan": scans,
        "stored_kB": area._asdict(),
        "saved": saved._asdict(),
    }
    report.pictures["scale.png"] = "Time of a cut, and of a scan in every process, against the number of areas."
    plot_scale(settings.out / "scale.png", {n: [cut.ms for cut in own] for n, own in cuts.items()}, scans, CUT_BOUNDS)
    return report


def cut_requirement(areas: int, cuts: Sequence[Cut]) -> Requirement:
    """Requirement on the longest cut."""
    return Requirement(f"longest cut at {areas} areas", max(cut.ms for cut in cuts), CUT_BOUNDS[areas], "ms")


def growth_requirement(process: str, scans: Mapping[int, Mapping[str, float]]) -> Requirement:
    """Requirement on the growth of the cost of a scan from the smallest to the largest map.

    :param process: one, or :data:`ALL` together.
    :param scans: {number of areas: {process: ms a scan}}.
    """
    costs = {areas: sum(own.values()) if process == ALL else own[process] for areas, own in scans.items()}
    least, most = costs[min(costs)], costs[max(costs)]
    name = f"{process}: growth of a scan's cost from {min(scans)} to {max(scans)} areas"
    return Requirement(name, most / least - 1.0, GROWTH)


def _cut_table(cuts: Mapping[str, Sequence[Cut]]) -> str:
    head = ["areas", "cuts", "median [ms]", "95 %", "max", "cuts near known areas", "median [ms]", "95 %", "max"]
    head += ["areas compared at most", "hypotheses at most", "not examined at most"]
    rows = []
    for name, own in cuts.items():
        near = [cut for cut in own if cut.compared]
        most = [max(getattr(cut, count) for cut in own) for count in ("compared", "hypotheses")]
        unexamined = f"{max(cut.unexamined for cut in own):.3f}"
        times = [name, str(len(own)), *_quantiles(own), str(len(near)), *_quantiles(near)]
        rows.append([*times, *map(str, most), unexamined])
    return table(head, rows)


def _describe_bound(configuration: Configuration, cuts: Sequence[Cut]) -> str:
    """A sentence with the upper bound of the time of a cut."""
    options = configuration.tsbi
    most = options.max_comparisons + MIN_EXAMINED_AREAS * options.max_hypotheses
    each = max(cut.ms / cut.compared for cut in cuts if cut.compared)
    return (
        f"At a cut at most {most} areas are compared, under at most {options.max_hypotheses} hypotheses of "
        f"{configuration.filter.particles} particles. One comparison took {each:.0f} ms at most with all that belongs "
        f"to it, so that no cut takes longer than {1e-3 * most * each:.0f} s on this machine."
    )


def _quantiles(cuts: Sequence[Cut]) -> list[str]:
    if not cuts:
        return ["-"] * 3
    return [f"{value:.1f}" for value in np.percentile([cut.ms for cut in cuts], (50, 95, 100))]


def _scan_table(scans: Mapping[int, Mapping[str, float]]) -> str:
    processes = list(scans[min(scans)])
    rows = [[str(areas), *(f"{own[process]:.3f}" for process in processes)] for areas, own in scans.items()]
    return table(["areas", *(f"{process} [ms a scan]" for process in processes)], rows)


def _stored_table(area: AreaMemory) -> str:
    rows: list[tuple[str, Any]] = [
        ("poses of its keyframes and arcs", area.graph),
        ("scans of its keyframes", area.scans),
        ("their end points, cached if the area was compared", area.points),
    ]
    return table(["of a stored area", "memory [kB]"], [[name, f"{size:.2f}"] for name, size in rows])


def _lasting_table(saved: SaveTimes) -> str:
    head = ["areas", "files [MB]", "save [s]", "load [s]", "load the map alone [s]"]
    return table(head, [[str(saved.areas), *(f"{value:.1f}" for value in saved[1:])]])


class Cut(NamedTuple):
    """The cost of a cut.

    :ivar ms: CPU time from the keyframe to the acceptance.
    :ivar compared: number of known areas compared with the keyframes, under all hypotheses.
    :ivar hypotheses: number of live hypotheses after it.
    :ivar unexamined: probability that was not examined.
    """

    ms: float
    compared: int
    hypotheses: int
    unexamined: float


class _TimedTsbi:
    """TSBI in a map, which counts CPU time and comparisons between calls of ``take``."""

    def __init__(self, lattice: Lattice, configuration: Configuration) -> None:
        self._lattice = lattice
        self._seconds, self._compared = 0.0, 0
        self._tsbi = Tsbi(configuration, self._branching)

    def _branching(self, configuration: Configuration, replica: Replica) -> Branching:
        replica.maps[FIRST_HYPOTHESIS] = self._lattice.hybrid_map()
        replica.scans = LatticeScans()
        return ObservedBranching(configuration, replica, self._count, is_bounded=False)

    def _count(self, examination: Examination) -> None:
        self._compared += len(examination.found.examined_areas)

    def handle(self, message: Message) -> list[Message]:
        """Handle a message as TSBI."""
        begin = time.process_time()
        messages = self._tsbi.handle(message)
        self._seconds += time.process_time() - begin
        return messages

    def take(self) -> tuple[float, int]:
        """Milliseconds and comparisons since the last call."""
        taken = 1e3 * self._seconds, self._compared
        self._seconds, self._compared = 0.0, 0
        return taken


def measured_cuts(lattice: Lattice, configuration: Configuration, excursions: int = _EXCURSIONS) -> list[Cut]:
    """The cuts of some excursions out of the map, after one that compiles kernels and does not count."""
    _ExcursionRobot(Lattice(5, 2), configuration).excursion(0, 0)
    cuts: list[Cut] = []
    robot = _ExcursionRobot(lattice, configuration)
    for seed in range(excursions):
        if lattice.areas <= _SMALL:
            cuts += _ExcursionRobot(lattice, configuration).excursion(0, seed)
        else:
            cuts += robot.excursion(seed * (_LONGEST + 2), seed)
    return cuts


class _ExcursionRobot:
    """A robot that drives out of a lattice and back in."""

    def __init__(self, lattice: Lattice, configuration: Configuration) -> None:
        self._lattice = lattice
        self._timed = _TimedTsbi(lattice, configuration)
        self._script = Script(self._timed)
        self._poses = lattice.poses()

    def excursion(self, column: int, seed: int) -> list[Cut]:
        """The cuts on a path from a crossing of row 0 along row -2 to a later crossing of row 0, and into row 1."""
        end = min(column + _LONGEST, self._lattice.columns - 1)
        way = [(column, 0), (column, -1), *((c, -2) for c in range(column, end + 1)), (end, -1), (end, 0), (end, 1)]
        self._script.go_to(column, shared_scan(0.0, 0))
        random = np.random.default_rng(seed)
        pose, cuts = np.array([SPACING * column, 0.0, 0.0]), []
        for stop in make_stops(way):
            error = se2.exp(random.multivariate_normal(np.zeros(3), STEP))
            step, pose = se2.compose(se2.between(pose, stop.pose), error), stop.pose
            self._timed.take()
            answer = self._script.keyframe(step, stop.scan, len(OFFSETS) if stop.last else 0)
            if len(answer.hypotheses) == 1 or stop.pose[1] > SPACING:
                best = max(answer.hypotheses, key=lambda hypothesis: hypothesis.probability)
                self._script.accept(best.id, self._poses)
            if stop.last:
                cuts.append(Cut(*self._timed.take(), len(answer.hypotheses), answer.unexamined))
        return cuts


class _TimedProcess:
    """A process that counts its CPU time."""

    def __init__(self, process: Process) -> None:
        self._process = process
        self.seconds = 0.0

    def handle(self, message: Message) -> list[Message]:
        """Handle a message as the process."""
        begin = time.process_time()
        messages = self._process.handle(message)
        self.seconds += time.process_time() - begin
        return messages


def cost_of_scans(
    lattices: Sequence[Lattice], configuration: Configuration, repeats: int = _REPEATS
) -> dict[int, dict[str, float]]:
    """{number of areas: {process: median ms a scan}}, with the maps in turn, for the same load of the machine."""
    _scan_costs(lattices[0], configuration)
    measured = [{lattice.areas: _scan_costs(lattice, configuration) for lattice in lattices} for _ in range(repeats)]
    return {
        lattice.areas: {
            process: float(np.median([costs[lattice.areas][process] for costs in measured]))
            for process in measured[0][lattice.areas]
        }
        for lattice in lattices
    }


def _scan_costs(lattice: Lattice, configuration: Configuration) -> dict[str, float]:
    """{process: ms a scan} of one drive around the loop."""
    slam, aam, tlca = MetricSlam(configuration), Aam(configuration), Tlca(configuration)
    tsbi = Tsbi(configuration, lambda c, replica: Branching(c, _fill_replica(replica, lattice)))
    for process in (slam, aam, tlca):
        _fill_replica(process._replica, lattice)
    processes: dict[str, Process] = {"slam": slam, "aam": aam, "tsbi": tsbi, "tlca": tlca, "rtl": Rtl(configuration)}
    timed = {name: _TimedProcess(process) for name, process in processes.items()}
    lock_step = LockStep(timed)
    poses = _loop_poses()
    for k, pose in enumerate(poses):
        stamp = _PERIOD * (k + 1)
        lock_step.feed(Odometry(stamp, pose))
        lock_step.feed(scan_at(pose, stamp, k))
    return {name: 1e3 * process.seconds / len(poses) for name, process in timed.items()}


def _fill_replica(replica: Replica, lattice: Lattice) -> Replica:
    """Fill a replica with the map, and return it."""
    replica.maps[FIRST_HYPOTHESIS] = lattice.hybrid_map()
    replica.scans = LatticeScans()
    return replica


def _loop_poses() -> Float64:
    """Poses around the loop, turning in place at its corners, shape (n, 3)."""
    poses: list[Float64] = []
    for side, (start, end) in enumerate(pairwise(SPACING * np.array(_LOOP, dtype=np.float64))):
        heading = 0.5 * math.pi * side
        count = round(float(np.hypot(*(end - start))) / _STEP)
        poses += [np.array([*(start + k / count * (end - start)), heading]) for k in range(count)]
        poses += [np.array([*end, heading + math.radians(turn)]) for turn in range(0, 90, _TURN)]
    return np.array(poses)


def plot_scale(
    path: Path,
    cuts: Mapping[int, Sequence[float]],
    scans: Mapping[int, Mapping[str, float]],
    bounds: Mapping[int, float],
) -> None:
    """Draw the cost against the number of areas.

    :param cuts: {number of areas: ms of each cut}.
    :param scans: {number of areas: {process: ms a scan}}.
    :param bounds: {number of areas: largest time of a cut, ms}.
    """
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    for areas, own in cuts.items():
        left.plot([areas] * len(own), own, ".", color="0.6")
    for share, style in ((50, "o-"), (95, "^--")):
        left.plot(list(cuts), [np.percentile(own, share) for own in cuts.values()], style, label=f"{share} %")
    left.plot(list(bounds), list(bounds.values()), "_", color="black", markersize=20.0, label="bound")
    left.set_ylabel("time of a cut [ms]")
    for process in scans[min(scans)]:
        right.plot(list(scans), [own[process] for own in scans.values()], "o-", label=process)
    right.set_ylabel("time of a scan [ms]")
    for axes in (left, right):
        axes.set(xscale="log", yscale="log", xlabel="areas")
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)
