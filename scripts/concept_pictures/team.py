"""The picture of two components: candidates of windows, and the placements that they imply."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from concept_pictures.canvas import BLUE, GRAY, GREEN, ORANGE, PALE_BLUE, PALE_ORANGE, RED, arrow, as_canvas, new_figure


def team() -> Figure:
    """Candidates of the windows of one component in another, and the PMF over placements."""
    figure, (maps, distribution) = new_figure(10.2, 4.2, (1.5, 1.0))
    as_canvas(maps, 13.0, 7.2)
    maps.set_title("Windows of B, searched in A")
    _draw_component(maps, [(1.0, 5.6), (3.2, 5.6), (5.4, 5.6), (7.6, 5.6)], "A", PALE_BLUE, BLUE)
    _draw_component(maps, [(3.2, 1.6), (5.4, 1.6), (7.6, 1.6), (9.8, 1.6)], "B", PALE_ORANGE, ORANGE)
    for b, a, color in ((3.2, 3.2, GREEN), (5.4, 5.4, GREEN), (7.6, 1.0, RED)):
        arrow(maps, (b, 2.2), (a, 5.0), color=color)
    maps.text(2.9, 3.4, "two windows agree", ha="right", color=GREEN, fontsize=8.0)
    maps.text(6.7, 3.4, "a similar place", ha="left", color=RED, fontsize=8.0)
    maps.text(9.8, 0.6, "on ground that A lacks", ha="center", color=GRAY, fontsize=8.0)
    prior = 0.5 / 16.0
    weights = prior * np.exp([4.5 + math.log(2.5), 2.0])
    rest = 1.0 - 2.0 * prior
    values = np.array([*weights, rest]) / (weights.sum() + rest)
    heights = np.arange(3)[::-1]
    distribution.set_title("Placements of B in A (example)")
    distribution.barh(heights, values, 0.5, color=[GREEN, RED, GRAY])
    distribution.set_yticks(heights, ["by two windows", "by one window", "apart"])
    distribution.set_xlim(0.0, 1.0)
    distribution.set_xlabel("probability")
    return figure


def _draw_component(axis: Axes, middles: list[tuple[float, float]], name: str, face: str, edge: str) -> None:
    """Areas in a row, with the name of the component at its end."""
    for n, (x, y) in enumerate(middles):
        axis.add_patch(Ellipse((x, y), 1.1, 1.1, facecolor=face, edgecolor=edge, linewidth=1.2, zorder=2))
        axis.text(x, y, str(n), ha="center", va="center")
        if n:
            axis.plot([middles[n - 1][0] + 0.55, x - 0.55], [y, y], color=edge, linewidth=1.4)
    axis.text(middles[-1][0] + 1.2, middles[0][1], name, va="center", color=edge, fontsize=12.0)
