"""What grows with the number of areas? Cuts, scans and memory in maps of up to a hundred thousand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmark.lattice import BEAMS, PER_AREA, Lattice
from benchmark.plots import plot_scale
from benchmark.report import Report, Requirement, table
from benchmark.runs import PARAMETERS
from benchmark.scale_cuts import Cut, measured_cuts
from benchmark.scale_maps import BEAMS as SAVED_BEAMS
from benchmark.scale_maps import SCANS_PER_KEYFRAME, Lasting, lasting
from benchmark.scale_memory import BEAMS as STORED_BEAMS
from benchmark.scale_memory import Stored, stored
from benchmark.scale_scans import cost_of_scans
from benchmark.settings import Settings
from hmt_slam_ros.configuration import Configuration, load_configuration
from hmt_slam_ros.topological_inference.branching import FEWEST

SMALL = (Lattice(5, 2), Lattice(10, 10), Lattice(50, 20))
LARGE = (Lattice(100, 100), Lattice(1000, 100))

CUT_BOUNDS = {10_000: 100.0, 100_000: 1000.0}
"""Largest time of a cut, ms, by the number of areas."""

STRESS = ("tsbi.prior_scale=5", "tsbi.temper=0.03")
"""Changes under which arcs admit more areas than are looked at, and scans decide little."""

GROWTH = 0.1
"""Largest growth of what a scan costs in SLAM and RTL, from the smallest to the largest of the small maps."""

STORED = 20.0
"""Largest memory of a stored area, kB."""

LASTING = Lattice(50, 40)
"""The map that is saved and loaded."""

SAVED_AND_LOADED = 5.0
"""Largest time to save and load it, s."""

_FEW = 2  # excursions under stress

POLICY = (
    "Maps are lattices of corridors, all crossings alike, made as data: every crossing is an area of "
    f"{PER_AREA} keyframes with arcs to the next ones, {BEAMS} beams to a scan. For the cuts a robot leaves the "
    "lattice, goes along beside it for up to eight crossings with a new area at each, and comes back; its odometry "
    "errs as its covariance says, and a stand-in for metric SLAM and acceptance hands TSBI its poses. A cut is timed "
    "from the keyframe to the acceptance, CPU time of one process, under all hypotheses that are alive. Under stress "
    f"({', '.join(STRESS)}) arcs admit far more areas than are looked at, which counts as not examined, and scans "
    "decide little. For the scans all five processes run in a loop through known ground; CPU time a "
    "scan, the median of the repetitions. Memory is what Python allocates: poses and arcs in each process that keeps "
    f"the map, and the ranges of its scans, here of {STORED_BEAMS} beams; what can be computed anew from them is told, "
    "and does not count. What is saved is the whole state of a run that mapped the lattice in one pass, under one "
    f"hypothesis, with a scan of its own of {SAVED_BEAMS} beams for every keyframe and {SCANS_PER_KEYFRAME} scans of "
    "the log to each. Saving ends when all is on the disk of the system's folder for temporary files, loading with "
    "processes that can go on; wall time."
)


def measure_scale(settings: Settings) -> Report:
    """Time cuts and scans, weigh a stored area."""
    configuration = load_configuration(PARAMETERS, list(settings.changes))
    report = Report("scale", "Cost against the number of areas", seeds=(0,))
    cuts = {lattice.areas: measured_cuts(lattice, configuration) for lattice in (*SMALL, *LARGE)}
    report.requirements += [cut_requirement(areas, cuts[areas]) for areas in CUT_BOUNDS]
    stressed = measured_cuts(LARGE[0], load_configuration(PARAMETERS, [*settings.changes, *STRESS]), _FEW)
    scans = cost_of_scans(SMALL, configuration)
    report.requirements += [growth_requirement(process, scans) for process in ("slam", "rtl")]
    area = stored(LARGE[0])
    report.requirements.append(Requirement("memory of a stored area with its scans", area.whole, STORED, "kB"))
    saved = lasting(LASTING, configuration)
    name = f"saving and loading a map of {saved.areas} areas"
    report.requirements.append(Requirement(name, saved.whole, SAVED_AND_LOADED, "s"))
    named = {str(areas): own for areas, own in cuts.items()} | {f"{LARGE[0].areas}, stress": stressed}
    bound = _bound(configuration, [cut for own in named.values() for cut in own])
    report.body += [_cut_table(named), bound, _scan_table(scans), _stored_table(area), _lasting_table(saved), POLICY]
    report.data |= {
        "cuts": {name: [cut._asdict() for cut in own] for name, own in named.items()},
        "ms_per_scan": scans,
        "stored_kB": area._asdict(),
        "saved": saved._asdict(),
    }
    report.pictures["scale.png"] = "Time of a cut, and of a scan in every process, against the number of areas."
    plot_scale(settings.out / "scale.png", {n: [cut.ms for cut in own] for n, own in cuts.items()}, scans, CUT_BOUNDS)
    return report


def cut_requirement(areas: int, cuts: Sequence[Cut]) -> Requirement:
    """That no cut takes longer than is asked for."""
    return Requirement(f"longest cut at {areas} areas", max(cut.ms for cut in cuts), CUT_BOUNDS[areas], "ms")


def growth_requirement(process: str, scans: Mapping[int, Mapping[str, float]]) -> Requirement:
    """That a scan costs the same in the largest map as in the smallest.

    :param scans: {number of areas: {process: ms a scan}}.
    """
    least, most = scans[min(scans)][process], scans[max(scans)][process]
    name = f"{process}: growth of a scan's cost from {min(scans)} to {max(scans)} areas"
    return Requirement(name, most / least - 1.0, GROWTH)


def _cut_table(cuts: Mapping[str, Sequence[Cut]]) -> str:
    head = ["areas", "cuts", "median [ms]", "95 %", "max", "cuts near known areas", "median [ms]", "95 %", "max"]
    head += ["areas compared at most", "hypotheses at most", "not examined at most"]
    return table(head, [_cut_row(name, own) for name, own in cuts.items()])


def _cut_row(name: str, cuts: Sequence[Cut]) -> list[str]:
    near = [cut for cut in cuts if cut.compared]
    return [
        name,
        str(len(cuts)),
        *_quantiles(cuts),
        str(len(near)),
        *_quantiles(near),
        str(max(cut.compared for cut in cuts)),
        str(max(cut.hypotheses for cut in cuts)),
        f"{max(cut.unexamined for cut in cuts):.3f}",
    ]


def _bound(configuration: Configuration, cuts: Sequence[Cut]) -> str:
    """How long a cut can take."""
    options = configuration.tsbi
    most = options.max_comparisons + FEWEST * options.max_hypotheses
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


def _stored_table(area: Stored) -> str:
    rows: list[tuple[str, Any]] = [
        ("poses of its keyframes and arcs", area.graph),
        ("scans of its keyframes", area.scans),
        ("their end points, kept where the area was compared", area.points),
    ]
    return table(["of a stored area", "memory [kB]"], [[name, f"{size:.2f}"] for name, size in rows])


def _lasting_table(saved: Lasting) -> str:
    head = ["areas", "files [MB]", "save [s]", "load [s]", "load the map alone [s]"]
    return table(head, [[str(saved.areas), *(f"{value:.1f}" for value in saved[1:])]])
