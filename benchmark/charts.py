"""Pictures of what happens over the time of a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from benchmark.stories import HIGH, LOW, NEW, RIGHT, WRONG, Moment

_DPI = 80
_COLOURS = {RIGHT: "C0", WRONG: "C3", NEW: "C7"}


class Panel(NamedTuple):
    """A story to be drawn.

    :ivar marks: {what happened: seconds}.
    """

    moments: Sequence[Moment]
    marks: Mapping[str, float]


def plot_growth(path: Path, logs: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> None:
    """Memory above that before the first scan, and time for a scan, over the log; as Fig. 9e of the paper.

    :param logs: {log: {method: report of :mod:`benchmark.charted_run`}}.
    """
    figure = Figure(figsize=(4.5 * len(logs), 6.0), layout="constrained")
    panels = figure.subplots(2, len(logs), squeeze=False)
    for column, (name, methods) in enumerate(logs.items()):
        upper, lower = panels[0][column], panels[1][column]
        for method, report in methods.items():
            memory, cost = report["memory"], report["cost"]
            minutes = [sample["s"] / 60.0 for sample in memory]
            upper.plot(minutes, [(s["bytes"] - memory[0]["bytes"]) / 1e6 for s in memory], label=method)
            lower.plot([sample["s"] / 60.0 for sample in cost], [sample["ms"] for sample in cost], linewidth=0.8)
        upper.set_title(name)
        upper.set_ylabel("memory [MB]")
        upper.set_ylim(bottom=0.0)
        upper.legend(fontsize=7)
        lower.set_yscale("log")
        lower.set_ylabel("computing time of a scan [ms]")
        lower.set_xlabel("time of the log [min]")
    figure.savefig(path, dpi=_DPI)


def plot_processes(path: Path, logs: Mapping[str, Mapping[str, float]]) -> None:
    """Mean time of every process for a scan; as Fig. 9c of the paper.

    :param logs: {log: {process: ms}}.
    """
    figure = Figure(figsize=(6.0, 3.5), layout="constrained")
    axes = figure.subplots()
    processes = list(next(iter(logs.values())))
    width = 0.8 / len(logs)
    for k, (name, own) in enumerate(logs.items()):
        places = np.arange(len(processes)) + (k - 0.5 * (len(logs) - 1)) * width
        axes.bar(places, [own[process] for process in processes], width, label=name)
    axes.set_xticks(range(len(processes)), processes)
    axes.set_yscale("log")
    axes.set_ylabel("mean time for a scan [ms]")
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)


def plot_ambiguity(path: Path, panels: Mapping[str, Panel], particles: int) -> None:
    """ESS and the PMF of where the robot is over time; as Fig. 10 of the paper.

    :param panels: {log: its story}.
    :param particles: of a hypothesis.
    """
    figure = Figure(figsize=(4.5 * len(panels), 5.0), layout="constrained")
    grid = figure.subplots(2, len(panels), squeeze=False, sharex="col", height_ratios=(1.0, 2.0))
    for column, (name, panel) in enumerate(panels.items()):
        upper, lower = grid[0][column], grid[1][column]
        seconds = [moment.seconds for moment in panel.moments]
        upper.step(seconds, [100.0 * m.samples / particles for m in panel.moments], where="post", color="black")
        upper.set_ylim(0.0, 105.0)
        upper.set_ylabel("ESS [%]")
        upper.set_title(name, fontsize=9)
        for kind, colour in _COLOURS.items():
            shares = [moment.probabilities[kind] for moment in panel.moments]
            lower.step(seconds, shares, where="post", color=colour, label=kind)
        for axes in (upper, lower):
            for mark, style in zip(panel.marks.items(), ("--", ":"), strict=False):
                axes.axvline(mark[1], color="black", linewidth=0.8, linestyle=style, label=mark[0])
        lower.axhspan(LOW, HIGH, color="0.93")
        lower.set_ylim(-0.02, 1.02)
        lower.set_ylabel("probability")
        lower.set_xlabel("time [s]")
        lower.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)
