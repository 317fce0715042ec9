"""Colors, boxes, arrows, walls and beams of the pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, FancyArrowPatch, FancyBboxPatch
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Point = tuple[float, float]

BLUE, ORANGE, GREEN, RED, GRAY, DARK = "#2f6db3", "#d9822b", "#3c8d4f", "#c23b3b", "#8a8f98", "#22262c"
PALE_BLUE, PALE_ORANGE, PALE_GREEN, PALE_RED, PALE_GRAY = "#dfeaf7", "#fbe9d5", "#dff0e2", "#f7dddd", "#eceef1"


def new_figure(width: float, height: float, columns: Sequence[float] = (1.0,)) -> tuple[Figure, list[Axes]]:
    """A white figure with axes side by side, of which ``columns`` are the relative widths."""
    figure, axes = plt.subplots(
        1, len(columns), figsize=(width, height), layout="constrained", width_ratios=columns, squeeze=False
    )
    figure.set_facecolor("white")
    return figure, list(axes[0])


def as_canvas(axis: Axes, right: float, top: float) -> None:
    """Axes without ticks, from (0, 0) to (right, top), equal scales."""
    axis.set_axis_off()
    axis.set_xlim(0.0, right)
    axis.set_ylim(0.0, top)
    axis.set_aspect("equal")


def box(axis: Axes, center: Point, size: Point, text: str, face: str = PALE_BLUE, edge: str = BLUE) -> None:
    """A rounded box with a text in its middle."""
    x, y = center[0] - 0.5 * size[0], center[1] - 0.5 * size[1]
    style = "round,pad=0.0,rounding_size=0.12"
    axis.add_patch(FancyBboxPatch((x, y), *size, boxstyle=style, facecolor=face, edgecolor=edge, linewidth=1.2))
    axis.text(*center, text, ha="center", va="center", color=DARK, linespacing=1.25)


def arrow(
    axis: Axes,
    start: Point,
    end: Point,
    text: str = "",
    at: Point = (0.0, 0.15),
    *,
    color: str = DARK,
    line: str = "-",
    bend: float = 0.0,
) -> None:
    """An arrow with a text beside its middle, ``at`` from there."""
    patch = FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=10.0, connectionstyle=f"arc3,rad={bend}")
    patch.set(color=color, linewidth=1.1, linestyle=line)
    axis.add_patch(patch)
    if text:
        x, y = 0.5 * (start[0] + end[0]) + at[0], 0.5 * (start[1] + end[1]) + at[1]
        axis.text(x, y, text, ha="center", va="center", color=color, fontsize=8.0)


def rays(origin: Float64, walls: Float64, count: int, reach: float) -> Float64:
    """End points (k, 2) of a full circle of beams that hit walls (m, 4) within reach."""
    angles = np.linspace(-math.pi, math.pi, count, endpoint=False)
    direction = np.stack([np.cos(angles), np.sin(angles)], axis=1)[:, None]
    start, along = walls[None, :, :2], walls[None, :, 2:] - walls[None, :, :2]
    across = direction[..., 0] * along[..., 1] - direction[..., 1] * along[..., 0]
    offset = start - origin
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (offset[..., 0] * along[..., 1] - offset[..., 1] * along[..., 0]) / across
        share = (offset[..., 0] * direction[..., 1] - offset[..., 1] * direction[..., 0]) / across
    hit = (distance > 1e-9) & (share >= 0.0) & (share <= 1.0)
    ranges = np.where(hit, distance, np.inf).min(axis=1)
    return np.asarray((origin + ranges[:, None] * direction[:, 0])[ranges < reach], dtype=np.float64)


def draw_walls(axis: Axes, walls: Float64, width: float = 1.6) -> None:
    """Walls (m, 4) as lines."""
    for x0, y0, x1, y1 in walls:
        axis.plot([x0, x1], [y0, y1], color=DARK, linewidth=width, solid_capstyle="round")


def covariance_ellipse(axis: Axes, mean: Point, covariance: Float64, color: str, deviations: float = 2.0) -> None:
    """The ellipse of a covariance (2, 2)."""
    values, vectors = np.linalg.eigh(covariance)
    angle = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
    width, height = 2.0 * deviations * np.sqrt(values[::-1])
    axis.add_patch(Ellipse(mean, width, height, angle=angle, facecolor=color, alpha=0.22, edgecolor=color, zorder=1))
