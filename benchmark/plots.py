"""Pictures of reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.special import gammainc

from benchmark.forecasts import Reliability
from benchmark.scoring import FINAL, ONLINE
from hmt_slam_ros.evaluation import PairErrors, RelationErrors

_DPI = 110
_BINS = 12
_LEAST = 20  # errors of a bin that is drawn
_SHORTEST = 0.1  # s; shorter spans are drawn there


def plot_errors_by_seed(
    path: Path, scores: Mapping[str, Mapping[str, Sequence[RelationErrors]]], bounds: Mapping[str, float]
) -> None:
    """Mean translation errors of every seed, one panel for each log.

    :param scores: {log: {file of the trajectory: score of each seed}}.
    :param bounds: {log: largest mean over the seeds, m}.
    """
    figure = Figure(figsize=(5.0 * len(scores), 4.0), layout="constrained")
    for axes, (name, own) in zip(_panels(figure, len(scores)), scores.items(), strict=True):
        final = own[FINAL]
        axes.plot([s.overall.translation.mean for s in final], "o-", color="C0", label="final, all relations")
        axes.plot([s.over_60_s.translation.mean for s in final], "s-", color="C3", label="final, over 60 s")
        axes.plot([s.overall.translation.mean for s in own[ONLINE]], "^:", color="C2", label="online, all relations")
        if name in bounds:
            axes.axhline(bounds[name], color="black", linewidth=0.8)
        axes.set_xticks(range(len(final)))
        axes.set_ylim(bottom=0.0)
        axes.set_title(name)
        axes.set_xlabel("number of the seed")
        axes.set_ylabel("mean error of translation [m]")
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)


def plot_errors_by_span(path: Path, pairs: Mapping[str, Sequence[PairErrors]]) -> None:
    """Translation error against the time span of the relations, one panel for each log.

    :param pairs: {log: errors of each seed}.
    """
    figure = Figure(figsize=(5.0 * len(pairs), 4.0), layout="constrained")
    for axes, (name, own) in zip(_panels(figure, len(pairs)), pairs.items(), strict=True):
        seconds = np.maximum(np.concatenate([errors.span[errors.found] for errors in own]) * 1e-9, _SHORTEST)
        translation = np.concatenate([errors.translation[errors.found] for errors in own])
        axes.plot(seconds, translation, ".", markersize=1.5, color="0.7", rasterized=True)
        edges = np.geomspace(seconds.min(), seconds.max(), _BINS + 1)
        bins = np.clip(np.searchsorted(edges, seconds, side="right") - 1, 0, _BINS - 1)
        filled = np.flatnonzero(np.bincount(bins) >= _LEAST)
        centres = [np.median(seconds[bins == k]) for k in filled]
        for share, style in ((50, "o-"), (95, "^--")):
            heights = [np.percentile(translation[bins == k], share) for k in filled]
            axes.plot(centres, heights, style, label=f"{share} %")
        axes.axvline(60.0, color="black", linewidth=0.8)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylim(bottom=1e-3)
        axes.set_title(name)
        axes.set_xlabel("time between the two poses [s]")
        axes.set_ylabel("error of translation [m]")
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)


def _panels(figure: Figure, count: int) -> Sequence[Axes]:
    panels: Sequence[Axes] = figure.subplots(1, count, squeeze=False)[0]
    return panels


def plot_reliability(path: Path, curves: Mapping[str, Reliability]) -> None:
    """Frequency against probability with Wilson's 95 % intervals, and how many answers are in each bin.

    :param curves: {of what: its reliability}.
    """
    figure = Figure(figsize=(5.0 * len(curves), 6.0), layout="constrained")
    grid = figure.subplots(2, len(curves), squeeze=False, height_ratios=(3.0, 1.0))
    for column, (name, curve) in enumerate(curves.items()):
        upper, lower = grid[0][column], grid[1][column]
        filled = curve.counts > 0
        said, came, counts = curve.said[filled], curve.came[filled], curve.counts[filled]
        low, high = _wilson(came, counts)
        upper.plot([0.0, 1.0], [0.0, 1.0], color="black", linewidth=0.8)
        bars = np.maximum(0.0, np.stack((came - low, high - came)))
        upper.errorbar(said, came, bars, fmt="o-", capsize=3)
        upper.set_title(f"{name}: expected error {curve.error:.3f}")
        upper.set_ylabel("share that is true")
        lower.bar(said, counts, width=0.04)
        lower.set_yscale("log")
        lower.set_xlim(upper.get_xlim())
        lower.set_xlabel("probability")
        lower.set_ylabel("answers")
    figure.savefig(path, dpi=_DPI)


def _wilson(shares: NDArray[np.float64], counts: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The 95 % intervals of some shares of so many."""
    z2 = 1.96**2
    middle = (shares + z2 / (2.0 * counts)) / (1.0 + z2 / counts)
    half = np.sqrt(z2 * (shares * (1.0 - shares) / counts + z2 / (4.0 * counts**2))) / (1.0 + z2 / counts)
    return middle - half, middle + half


def plot_nees(path: Path, samples: Mapping[str, Sequence[float]]) -> None:
    """Cumulative distributions of normalised errors.

    :param samples: {of what: NEES}.
    """
    figure = Figure(figsize=(6.0, 4.5), layout="constrained")
    axes = figure.subplots()
    errors = np.geomspace(0.01, 100.0, 200)
    for name, own in samples.items():
        axes.plot(np.sort(own), (np.arange(len(own)) + 1.0) / max(1, len(own)), label=name)
    axes.plot(errors, gammainc(1.5, 0.5 * errors), color="black", linewidth=0.8, label="as it should be")
    axes.set_xscale("log")
    axes.set_xlim(0.01, 100.0)
    axes.set_xlabel("NEES")
    axes.set_ylabel("share of errors below")
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)


def plot_scale(
    path: Path,
    cuts: Mapping[int, Sequence[float]],
    scans: Mapping[int, Mapping[str, float]],
    bounds: Mapping[int, float],
) -> None:
    """Cost against the number of areas.

    :param cuts: {number of areas: ms of each cut}.
    :param scans: {number of areas: {process: ms a scan}}.
    :param bounds: {number of areas: ms that a cut may take}.
    """
    figure = Figure(figsize=(10.0, 4.0), layout="constrained")
    left, right = _panels(figure, 2)
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
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("areas")
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)


def plot_oracle(path: Path, distances: Mapping[str, Mapping[int, float]], bound: float) -> None:
    """Total variation distance against the number of hypotheses.

    :param distances: {under what: {number of hypotheses: mean distance}}.
    """
    figure = Figure(figsize=(6.0, 4.5), layout="constrained")
    axes = figure.subplots()
    for name, own in distances.items():
        axes.plot(list(own), list(own.values()), "o-", label=name)
    axes.axhline(bound, color="black", linewidth=0.8)
    axes.set_xscale("log", base=2)
    axes.set_xlabel("hypotheses")
    axes.set_ylabel("mean total variation distance")
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=_DPI)
