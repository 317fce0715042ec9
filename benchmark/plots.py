"""Pictures of reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

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
