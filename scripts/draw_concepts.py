#!/usr/bin/env python3
"""Draw the pictures of docs/concepts: docs/images/concept_*.svg, the same bytes at every call.

Usage: scripts/draw_concepts.py [--png FOLDER]; PNG copies are for looking at. What a picture computes, such as the
overlap of scans, is computed here in a few lines, so that the picture shows the idea and not the program.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, FancyArrowPatch, FancyBboxPatch, Polygon, Rectangle

Float64 = NDArray[np.float64]
Point = tuple[float, float]

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
BLUE, ORANGE, GREEN, RED, GRAY, DARK = "#2f6db3", "#d9822b", "#3c8d4f", "#c23b3b", "#8a8f98", "#22262c"
PALE_BLUE, PALE_ORANGE, PALE_GREEN, PALE_RED, PALE_GRAY = "#dfeaf7", "#fbe9d5", "#dff0e2", "#f7dddd", "#eceef1"
STYLE = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "svg.fonttype": "none",
    "svg.hashsalt": "hmt_slam_ros",
    "axes.titlesize": 10.0,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "mathtext.fontset": "dejavusans",
}


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


# Data flow


def data_flow() -> Figure:
    """The five processes with their messages, and one keyframe event over time."""
    figure: Figure = plt.figure(figsize=(9.4, 6.6), layout="constrained")
    figure.set_facecolor("white")
    upper, lower = figure.subplots(2, 1, height_ratios=(1.25, 1.0))
    _processes(upper)
    _event_over_time(lower)
    return figure


def _processes(axis: Axes) -> None:
    as_canvas(axis, 19.0, 6.4)
    axis.set_title("The processes and what they send")
    size = (2.5, 1.15)
    box(axis, (1.5, 4.4), size, "robot", PALE_GRAY, GRAY)
    box(axis, (6.4, 4.4), size, "metric SLAM\nslam")
    box(axis, (11.0, 4.4), size, "AAM\naam")
    box(axis, (16.9, 4.4), size, "TSBI\ntsbi")
    box(axis, (16.9, 1.2), size, "TLCA\ntlca")
    box(axis, (6.4, 1.2), size, "RTL\nrtl", PALE_GREEN, GREEN)
    arrow(axis, (2.75, 4.4), (5.15, 4.4), "Scan, Odometry", (0.0, 0.3))
    arrow(axis, (7.65, 4.4), (9.75, 4.4), "Keyframe(k)", (0.0, 0.3))
    arrow(axis, (12.25, 4.4), (15.65, 4.4), "AreaEvents(k)", (0.0, 0.3))
    arrow(axis, (16.9, 3.82), (16.9, 1.78), "Hypotheses(k)", (-1.25, 0.0))
    arrow(axis, (15.65, 1.35), (7.4, 3.82), "ClosureDecision(k)", (1.9, 0.05))
    arrow(axis, (6.1, 3.82), (6.1, 1.78), "LocalEstimate", (1.3, -0.15))
    arrow(axis, (2.0, 3.82), (5.15, 1.35), "Odometry", (-0.75, -0.25), color=GREEN)
    arrow(axis, (15.65, 1.05), (7.65, 1.05), "ClosureDecision(k): map_T_area", (0.0, -0.3))
    arrow(axis, (5.15, 1.05), (2.9, 1.05), color=GREEN)
    axis.text(2.8, 1.05, "pose,\nmap → odom", ha="right", va="center", color=GREEN, fontsize=8.0)
    hear = (
        "Hypotheses and ClosureDecision also go to the other processes, which apply them to their replicas of the map"
    )
    axis.text(9.5, 5.75, hear, ha="center", color=GRAY, fontsize=8.0)


def _event_over_time(axis: Axes) -> None:
    axis.set_title("One keyframe event: scans wait for the answer, RTL does not")
    lanes = ("rtl", "tlca", "tsbi", "aam", "slam")
    axis.set_yticks(range(len(lanes)), lanes)
    axis.set_xlim(-0.6, 10.4)
    axis.set_ylim(-0.6, 4.9)
    axis.set_xticks([])
    axis.set_xlabel("time")
    for y in range(len(lanes)):
        axis.axhline(y, color=PALE_GRAY, linewidth=6.0, zorder=0)
    blocks = ((3.0, 0.55, 4, BLUE), (3.7, 0.8, 3, BLUE), (4.6, 1.6, 2, BLUE), (6.3, 0.7, 1, BLUE))
    for start, length, y, color in blocks:
        axis.add_patch(Rectangle((start, y - 0.22), length, 0.44, facecolor=color, alpha=0.85, zorder=2))
    names = ("Keyframe", "AreaEvents", "Hypotheses", "ClosureDecision")
    ends = ((3.55, 4, 3.7, 3), (4.5, 3, 4.6, 2), (6.2, 2, 6.3, 1), (7.0, 1, 7.15, 4))
    for name, (x0, y0, x1, y1) in zip(names, ends, strict=True):
        arrow(axis, (x0, y0 - 0.22 if y1 < y0 else y0 + 0.22), (x1, y1 + 0.22 if y1 < y0 else y1 - 0.22), color=DARK)
        left = name == "Hypotheses"
        axis.text(
            x0 - 0.12 if left else x1 + 0.08,
            0.5 * (y0 + y1),
            name,
            ha="right" if left else "left",
            va="center",
            fontsize=8.0,
            color=DARK,
        )
    free = 0.0
    for x in np.arange(0.0, 10.2, 0.75):
        done = max(x, free, 7.3 if 3.0 < x < 7.3 else 0.0)
        free, waits = done + 0.16, done > x
        axis.plot(x, 4.45, "v", color=ORANGE if waits else BLUE, markersize=5.0)
        axis.add_patch(Rectangle((done, 3.78), 0.1, 0.44, facecolor=ORANGE if waits else BLUE, zorder=2))
    axis.text(10.35, 4.7, "scans arrive; orange ones are queued", ha="right", fontsize=8.0, color=ORANGE)
    ticks = np.arange(0.0, 10.2, 0.16)
    axis.plot(ticks, np.zeros_like(ticks), "|", color=GREEN, markersize=11.0)
    axis.text(10.35, 0.35, "a pose for every odometry reading", ha="right", fontsize=8.0, color=GREEN)


# Areas


def areas_and_partition() -> Figure:
    """Keyframes through two rooms, the overlap of what they see, and the normalized cut that parts them."""
    walls, poses = _two_rooms()
    seen = [rays(pose, walls, 180, 9.0) for pose in poses]
    overlap = _overlaps(seen, 0.2)
    cuts = np.array([_ncut(overlap, np.arange(len(poses)) > k) for k in range(len(poses) - 1)])
    split = int(np.argmin(np.where(np.arange(len(cuts)) < 3, np.inf, cuts)))
    figure, (plan, matrix, values) = new_figure(10.2, 3.5, (1.35, 1.0, 1.0))
    plan.set_title("Keyframes, by area")
    plan.set_aspect("equal")
    plan.set_axis_off()
    draw_walls(plan, walls)
    plan.plot(*poses.T, color=GRAY, linewidth=1.0, zorder=1)
    colors = [BLUE if k <= split else ORANGE for k in range(len(poses))]
    plan.scatter(poses[:, 0], poses[:, 1], c=colors, s=26, zorder=2)
    first = split + 1
    plan.plot(*np.stack([poses[0], poses[first]]).T, color=RED, linewidth=1.6, zorder=3)
    plan.plot(*poses[[0, first]].T, "s", color=RED, markersize=5.0, zorder=4)
    plan.annotate("frame of area 0", poses[0], (0.2, 0.4), fontsize=8.0, color=RED)
    plan.annotate("frame of area 1", poses[first], (6.6, 1.2), fontsize=8.0, color=RED)
    plan.annotate("arc", 0.5 * (poses[0] + poses[first]), (4.9, 3.05), fontsize=8.0, color=RED)
    matrix.set_title("Similarity A: overlap of sensed space")
    matrix.imshow(overlap, cmap="Blues", vmin=0.0, vmax=1.0, interpolation="nearest")
    matrix.axhline(split + 0.5, color=RED, linewidth=1.2)
    matrix.axvline(split + 0.5, color=RED, linewidth=1.2)
    matrix.set_xlabel("keyframe")
    matrix.set_ylabel("keyframe")
    values.set_title("NCut of the first k against the rest")
    values.plot(np.arange(1, len(cuts) + 1), cuts, "o-", color=BLUE, markersize=3.5, linewidth=1.0)
    values.plot(split + 1, cuts[split], "o", color=RED, markersize=6.0)
    values.axhline(0.35, color=GRAY, linestyle="--", linewidth=1.0)
    values.text(len(cuts), 0.37, "threshold", ha="right", fontsize=8.0, color=GRAY)
    values.set_ylim(0.0, 1.3)
    values.set_xlabel("k")
    return figure


def _two_rooms() -> tuple[Float64, Float64]:
    """Walls (m, 4) and keyframes (n, 2)."""
    walls = [
        *((0.0, 0.0, 6.0, 0.0), (0.0, 0.0, 0.0, 5.0), (0.0, 5.0, 6.0, 5.0), (6.0, 0.0, 6.0, 1.9), (6.0, 2.9, 6.0, 5.0)),
        *((6.3, 1.9, 6.3, -0.6), (6.3, 2.9, 6.3, 6.2), (6.3, -0.6, 13.0, -0.6), (13.0, -0.6, 13.0, 6.2)),
        *((6.3, 6.2, 13.0, 6.2), (6.0, 1.9, 6.3, 1.9), (6.0, 2.9, 6.3, 2.9)),
        *((2.6, 1.6, 3.4, 1.6), (2.6, 1.6, 2.6, 2.2)),
        *((9.6, 2.0, 10.4, 2.0), (9.6, 2.0, 9.6, 2.8), (10.4, 2.0, 10.4, 2.8), (9.6, 2.8, 10.4, 2.8)),
    ]
    corners = np.array(
        [[1.2, 1.0], [1.2, 3.8], [3.6, 3.6], [5.0, 2.4], [7.4, 2.4], [8.6, 4.8], [11.4, 4.6], [11.6, 0.8]]
    )
    steps = np.hypot(*np.diff(corners, axis=0).T)
    along = np.arange(0.0, steps.sum(), 0.75)
    at = np.concatenate(([0.0], np.cumsum(steps)))
    return np.array(walls), np.stack([np.interp(along, at, corners[:, k]) for k in (0, 1)], axis=1)


def _overlaps(seen: Sequence[Float64], radius: float) -> Float64:
    """Mean of the two shares of points that have one of the other scan near, shape (n, n), zero diagonal."""
    found = np.zeros((len(seen), len(seen)))
    for i, one in enumerate(seen):
        for j in range(i):
            near = np.hypot(*(one[:, None] - seen[j][None]).transpose(2, 0, 1)) <= radius
            found[i, j] = found[j, i] = 0.5 * (near.any(axis=1).mean() + near.any(axis=0).mean())
    return found


def _ncut(similarity: Float64, side: NDArray[np.bool_]) -> float:
    cut = similarity[side][:, ~side].sum()
    return float(cut / similarity[side].sum() + cut / similarity[~side].sum())


# Inference


def inference() -> Figure:
    """A hypothesis that branches at a cut, and the weights of its children."""
    figure, (tree, weights) = new_figure(10.2, 4.2, (1.5, 1.0))
    as_canvas(tree, 13.0, 7.2)
    tree.set_title("A cut: one hypothesis, its children")
    for x, name in ((0.9, "0"), (3.0, "1"), (5.1, "2")):
        tree.add_patch(Ellipse((x, 3.6), 1.1, 1.1, facecolor=PALE_BLUE, edgecolor=BLUE, linewidth=1.2))
        tree.text(x, 3.6, name, ha="center", va="center")
    for x in (1.45, 3.55):
        arrow(tree, (x, 3.6), (x + 1.0, 3.6), color=BLUE)
    tree.text(3.0, 2.6, "topological path of the parent", ha="center", fontsize=8.0, color=GRAY)
    rows = ((6.3, "new area 3"), (4.5, "area 0, mode 1"), (2.7, "area 0, mode 2"), (0.9, "area 1"))
    for (y, name), color in zip(rows, (GREEN, RED, RED, RED), strict=True):
        arrow(tree, (5.68, 3.6), (8.4, y), color=color)
        box(tree, (10.2, y), (3.5, 0.95), name, PALE_GREEN if color == GREEN else PALE_RED, color)
    tree.text(5.9, 5.6, "the newest\nkeyframes are in", ha="right", fontsize=8.0, color=GRAY)
    names = ("new area 3", "area 0, mode 1", "area 0, mode 2", "area 1", "unexamined")
    prior = np.array([0.30, 0.40, 0.40, 0.25, 0.05])
    evidence = np.exp(np.array([0.0, 2.6, 0.4, -2.4, 0.0]))
    posterior = prior * evidence / (prior * evidence).sum()
    at = np.arange(len(names))[::-1]
    weights.set_title("Weights (example)")
    shades = [GRAY, GRAY, PALE_GRAY, GRAY, GRAY]
    weights.barh(at + 0.2, prior, 0.36, color=shades, label=r"prior $\pi(\gamma)$ from the arcs")
    weights.text(0.41, at[2] + 0.2, "that of area 0, once more", va="center", fontsize=8.0, color=GRAY)
    weights.barh(at - 0.2, posterior, 0.36, color=BLUE, label="after the evidence, Eq. (14)")
    weights.set_yticks(at, names)
    weights.set_xlim(0.0, 1.0)
    weights.set_xlabel("probability")
    weights.legend(frameon=False, fontsize=8.0, loc="lower right")
    return figure


# Loop closure


def closure() -> Figure:
    """Areas around a loop before and after its closure is accepted."""
    true = np.array([[0, 0], [3, 0], [6, 0], [9, 0], [9, 3], [9, 6], [6, 6], [3, 6], [0, 6], [0, 3]], dtype=np.float64)
    measured = np.roll(true, -1, axis=0) - true
    turn = np.linspace(0.0, -0.17, len(true))
    rotated = [
        np.array([[math.cos(a), -math.sin(a)], [math.sin(a), math.cos(a)]]) @ step
        for a, step in zip(turn, measured, strict=True)
    ]
    arcs = np.array(rotated[:-1])
    before = np.concatenate((np.zeros((1, 2)), np.cumsum(arcs, axis=0)))
    gap = true[0] - true[-1]
    after = _least_squares(arcs, gap, len(true))
    figure, (left, right) = new_figure(9.6, 4.3, (1.0, 1.0))
    for axis, poses, title in ((left, before, "Before: composed arcs"), (right, after, "After acceptance: consistent")):
        axis.set_title(title)
        axis.set_aspect("equal")
        axis.set_axis_off()
        axis.plot(*poses.T, color=BLUE, linewidth=1.4, zorder=2)
        axis.plot(*true.T, ".", color=GRAY, markersize=4.0, zorder=1)
        for n, (x, y) in enumerate(poses):
            axis.text(x, y, str(n), ha="center", va="center", fontsize=7.5, color="white", zorder=4)
        axis.plot(*poses.T, "o", color=BLUE, markersize=12.0, zorder=3)
        axis.set_xlim(-2.6, 12.2)
        axis.set_ylim(-2.6, 8.4)
    for n, (x, y) in enumerate(before):
        covariance_ellipse(left, (x, y), np.diag([0.006, 0.012]) * (0.2 + n**1.8), BLUE)
    for n, (x, y) in enumerate(after):
        covariance_ellipse(right, (x, y), np.diag([0.006, 0.012]) * (0.2 + min(n, 10 - n) ** 1.8), BLUE)
    arrow(left, (before[-1][0], before[-1][1]), (0.0, 0.0), color=RED, line="--", bend=0.35)
    left.text(0.4, 1.2, "closing arc,\nfrom matching", color=RED, fontsize=8.0)
    right.plot(*np.stack([after[-1], after[0]]).T, color=RED, linewidth=1.8, zorder=2)
    left.text(5.0, -2.0, r"$\Sigma$ grows along the path, Eq. (15)", ha="center", color=GRAY, fontsize=8.0)
    right.text(5.0, -2.0, "gray: true places", ha="center", color=GRAY, fontsize=8.0)
    return figure


def _least_squares(arcs: Float64, gap: Float64, count: int) -> Float64:
    """Positions (count, 2) that agree best with arcs from each to the next and one from the last to the first."""
    rows, values = [np.eye(count)[0] * 100.0], [np.zeros(2)]
    for k in range(count):
        row = np.zeros(count)
        row[k], row[(k + 1) % count] = -1.0, 1.0
        weight = 1.0 if k < count - 1 else 3.0
        rows.append(weight * row)
        values.append(weight * (arcs[k] if k < count - 1 else gap))
    return np.asarray(np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0], dtype=np.float64)


# Relocalization


def relocalization() -> Figure:
    """The statistic by which a displacement is noticed, and the states that follow."""
    figure, (statistic, states) = new_figure(10.2, 4.2, (1.15, 1.0))
    generator = np.random.default_rng(3)
    ratio = np.where(np.arange(40) < 24, generator.normal(0.2, 0.6, 40), generator.normal(4.2, 1.0, 40))
    ratio[9] = 1.9
    total, path = 0.0, []
    for step in ratio:
        total = max(0.0, total + step - 1.0)
        path.append(total + math.log(1e-5))
    spawn = next(k for k, value in enumerate(path) if value > math.log(3e-5) and k > 24)
    statistic.set_title("CUSUM of each keyframe's log-likelihood ratio")
    statistic.plot(path, color=BLUE, linewidth=1.4)
    statistic.axvline(24, color=RED, linewidth=1.0, linestyle=":")
    statistic.text(23.7, 3.5, "robot is carried", ha="right", color=RED, fontsize=8.0)
    statistic.axhline(math.log(3e-5), color=ORANGE, linewidth=1.0, linestyle="--")
    statistic.text(0.0, math.log(3e-5) + 0.45, "TSBI spawns a kidnapped hypothesis", color=ORANGE, fontsize=8.0)
    statistic.axhline(0.0, color=GREEN, linewidth=1.0, linestyle="--")
    statistic.text(0.0, 0.45, "as probable as not (localization: lost)", color=GREEN, fontsize=8.0)
    statistic.plot(spawn, path[spawn], "o", color=ORANGE)
    statistic.text(9.4, -12.3, "a person in the way", fontsize=8.0, color=GRAY)
    statistic.set_xlim(-0.5, 34.0)
    statistic.set_ylim(-12.8, 5.0)
    statistic.set_xlabel("keyframe")
    statistic.set_ylabel("log-odds of a displacement, nats")
    _states(states)
    return figure


def _states(axis: Axes) -> None:
    as_canvas(axis, 10.0, 8.6)
    axis.set_title("States of a hypothesis")
    box(axis, (2.2, 7.2), (3.4, 1.2), "Tracking", PALE_GREEN, GREEN)
    box(axis, (2.2, 3.6), (3.4, 1.5), "Lost\nnew area, arc that\nis uninformative", PALE_ORANGE, ORANGE)
    box(axis, (7.7, 3.6), (3.6, 1.5), "search: all areas,\nall headings, every\nfew keyframes", PALE_GRAY, GRAY)
    box(axis, (7.7, 7.2), (3.6, 1.2), "closure joins\nthe two maps", PALE_GREEN, GREEN)
    arrow(axis, (1.6, 6.58), (1.6, 4.38), "kidnapped,\nor started lost", (1.35, 0.0), color=RED)
    arrow(axis, (3.95, 3.9), (5.85, 3.9))
    arrow(axis, (5.85, 3.3), (3.95, 3.3), "not sure", (0.0, -0.3))
    sure = "80 % at two searches\nin a row, or 90 %\nwith an initial pose"
    arrow(axis, (7.7, 4.38), (7.7, 6.58), sure, (-1.75, 0.0), color=GREEN)
    arrow(axis, (5.85, 7.2), (3.95, 7.2), "TLCA\naccepts", (0.0, 0.45), color=GREEN)
    axis.text(5.0, 1.3, "prior: flat over areas, a fifth (carried: half) is unmapped ground", ha="center", fontsize=8.0)
    axis.text(5.0, 0.6, "mapping goes on in the new area; no scan is lost", ha="center", fontsize=8.0, color=GRAY)


# Registration


def registration() -> Figure:
    """The three ways of laying scans on maps, or on each other."""
    figure, (field, window, pair) = new_figure(11.0, 3.9, (1.2, 1.0, 1.0))
    walls = np.array(
        [[0, 0, 7, 0], [7, 0, 7, 4], [0, 4, 3, 4], [4.2, 4, 7, 4], [3, 4, 3, 5.2], [4.2, 4, 4.2, 5.2]], dtype=np.float64
    )
    _draw_field(field, walls)
    _draw_window(window)
    _draw_pair(pair)
    return figure


def _draw_field(axis: Axes, walls: Float64) -> None:
    cell = 0.1
    grid = np.ones((66, 82), np.bool_)
    for x0, y0, x1, y1 in walls:
        for s in np.linspace(0.0, 1.0, 200):
            grid[int((y0 + s * (y1 - y0) + 0.6) / cell), int((x0 + s * (x1 - x0) + 0.6) / cell)] = False
    distance = np.minimum(distance_transform_edt(grid) * cell, 0.9)
    axis.set_title("Filter: Gauss-Newton on the\ndistance field, from a prediction")
    axis.imshow(distance, origin="lower", extent=(-0.6, 7.6, -0.6, 6.0), cmap="Greys_r", alpha=0.55, rasterized=True)
    origin = np.array([2.6, 1.7])
    ends = rays(origin, walls, 54, 6.0)
    shift = np.array([0.28, 0.22])
    moved = (ends - origin) @ np.array([[0.997, 0.07], [-0.07, 0.997]]) + origin + shift
    axis.plot(*moved.T, ".", color=RED, markersize=4.0)
    for start, end in list(zip(moved, ends, strict=True))[::3]:
        horizontal = min(abs(end[1]), abs(end[1] - 4.0)) < 0.05
        normal = np.array([0.0, 1.0]) if horizontal else np.array([1.0, 0.0])
        pull = normal * ((end - start) @ normal)
        if np.hypot(*pull) > 0.12:
            arrow(axis, (start[0], start[1]), (start[0] + 1.6 * pull[0], start[1] + 1.6 * pull[1]), color=BLUE)
    axis.plot(*(origin + shift), "^", color=RED, markersize=7.0)
    axis.set_axis_off()
    axis.text(3.5, -1.2, "each beam pulls along its surface normal", ha="center", fontsize=8.0, color=GRAY)
    axis.set_ylim(-1.6, 6.0)


def _draw_window(axis: Axes) -> None:
    x, y = np.meshgrid(np.linspace(-2.0, 2.0, 41), np.linspace(-2.0, 2.0, 41))
    score = sum(
        mass * np.exp(-0.5 * (((x - a) / 0.28) ** 2 + ((y - b) / 0.2) ** 2))
        for a, b, mass in ((-1.1, 0.2, 0.75), (0.5, 0.15, 1.0), (1.5, -0.2, 0.35))
    )
    axis.set_title("Inference: branch and bound\nover a window, all modes")
    axis.imshow(score, origin="lower", extent=(-2.05, 2.05, -2.05, 2.05), cmap="Blues", vmax=1.3, rasterized=True)
    for low_x in np.arange(-2.0, 2.0, 1.0):
        for low_y in (-2.0, 1.0):
            axis.add_patch(Rectangle((low_x, low_y), 1.0, 1.0, facecolor=PALE_RED, alpha=0.75, edgecolor=RED))
    for low_x in np.arange(-2.0, 2.0, 0.5):
        for low_y in np.arange(-1.0, 1.0, 0.5):
            axis.add_patch(Rectangle((low_x, low_y), 0.5, 0.5, fill=False, edgecolor=GRAY, linewidth=0.6))
    for a, b in ((-1.1, 0.2), (0.5, 0.15), (1.5, -0.2)):
        axis.plot(a, b, "+", color=DARK, markersize=9.0)
    axis.set_xticks([])
    axis.set_yticks([])
    axis.set_xlabel("red: bound too low, never searched", fontsize=8.0, color=GRAY)


def _draw_pair(axis: Axes) -> None:
    axis.set_title("Refinement: point to line,\nall pairs of keyframes jointly")
    wall = np.array([[0.3, 0.8], [5.7, 1.6]])
    direction = (wall[1] - wall[0]) / np.hypot(*(wall[1] - wall[0]))
    normal = np.array([-direction[1], direction[0]])
    along = np.linspace(0.25, 5.2, 9)
    known = wall[0] + along[:, None] * direction
    wiggle = np.array([0.03, -0.04, 0.02, 0.05, -0.02, 0.0, 0.04, -0.03, 0.01])
    other = known[:-1] + 0.3 * direction + (0.55 + 0.09 * np.arange(8))[:, None] * normal + wiggle[:-1, None] * normal
    axis.plot(*wall.T, color=GRAY, linewidth=1.0)
    axis.plot(*known.T, "o", color=BLUE, markersize=4.5)
    axis.plot(*other.T, "o", color=ORANGE, markersize=4.5)
    for point in other[::1]:
        foot = wall[0] + ((point - wall[0]) @ direction) * direction
        axis.plot(*np.stack([point, foot]).T, color=RED, linewidth=1.0)
    arrow(axis, (known[6][0], known[6][1]), tuple(known[6] - 0.9 * normal), color=BLUE)
    name = known[6] - 1.15 * normal
    axis.text(name[0], name[1], "normal n", color=BLUE, fontsize=8.0, ha="center", va="top")
    axis.text(0.6, 2.6, "scan i", color=ORANGE, fontsize=8.0)
    axis.text(0.3, 0.35, "scan j", color=BLUE, fontsize=8.0)
    axis.text(3.0, -0.75, r"error $n^\top (T p - q)$", ha="center", fontsize=9.0, color=RED)
    axis.set_xlim(0.0, 6.0)
    axis.set_ylim(-1.1, 3.6)
    axis.set_aspect("equal")
    axis.set_axis_off()


# Lifelong


def lifelong() -> Figure:
    """What a scan says of places, and what follows for stored scans."""
    figure, axes = new_figure(10.6, 3.9, (1.0, 1.0, 1.0))
    titles = ("New: static, and in no keyframe", "Stale: the end is seen through", "Shortened: a door closed")
    for axis, title, draw in zip(axes, titles, (_new, _stale, _cut), strict=True):
        as_canvas(axis, 8.0, 7.6)
        axis.set_title(title)
        draw_walls(axis, np.array([[0.4, 6.4, 7.6, 6.4]]), 2.4)
        draw(axis)
    return figure


def _fan(axis: Axes, robot: Point, ends: Sequence[Point], color: str, style: str = "-") -> None:
    for end in ends:
        axis.plot([robot[0], end[0]], [robot[1], end[1]], color=color, linewidth=0.9, linestyle=style)
        axis.plot(*end, ".", color=color, markersize=5.0)
    axis.plot(*robot, "^", color=color, markersize=8.0)


def _new(axis: Axes) -> None:
    axis.add_patch(Rectangle((2.2, 4.4), 1.5, 0.9, facecolor=PALE_ORANGE, edgecolor=ORANGE))
    axis.text(2.95, 4.85, "box", ha="center", va="center", fontsize=8.0)
    _fan(axis, (1.6, 1.3), [(2.25, 4.4), (2.6, 4.4), (3.0, 4.4)], GRAY)
    _fan(axis, (4.0, 1.3), [(3.6, 4.4), (3.2, 4.4), (2.8, 4.4), (5.6, 3.72), (5.9, 3.72)], BLUE)
    axis.add_patch(Ellipse((5.8, 4.0), 0.75, 0.6, facecolor=PALE_GRAY, edgecolor=GRAY))
    axis.text(5.8, 4.6, "person: seen now only", ha="center", fontsize=8.0, color=GRAY)
    axis.text(1.6, 0.5, "a look 1 to 3 s ago", ha="center", fontsize=8.0, color=GRAY)
    axis.text(4.9, 0.5, "now", ha="right", fontsize=8.0, color=BLUE)
    axis.text(0.5, 5.65, "0.5 m of it: the keyframe is stored", fontsize=8.0, color=ORANGE)


def _stale(axis: Axes) -> None:
    axis.add_patch(Rectangle((3.1, 4.2), 1.6, 0.9, fill=False, edgecolor=GRAY, linestyle=":"))
    axis.text(3.9, 4.65, "was here", ha="center", va="center", fontsize=8.0, color=GRAY)
    _fan(axis, (2.0, 1.3), [(3.3, 4.2), (3.8, 4.2), (4.3, 4.2)], GRAY, "--")
    _fan(axis, (5.6, 1.3), [(2.6, 6.4), (3.6, 6.4), (4.5, 6.4)], BLUE)
    for x in (3.3, 3.8, 4.3):
        axis.plot(x, 4.2, "x", color=RED, markersize=8.0, markeredgewidth=2.0)
    axis.text(2.0, 0.5, "stored keyframe", ha="center", fontsize=8.0, color=GRAY)
    axis.text(5.6, 0.5, "now", ha="center", fontsize=8.0, color=BLUE)
    axis.text(0.3, 3.1, "these beams\nare removed", fontsize=8.0, color=RED)


def _cut(axis: Axes) -> None:
    draw_walls(axis, np.array([[0.4, 3.6, 3.0, 3.6], [5.0, 3.6, 7.6, 3.6]]), 2.4)
    axis.plot([3.0, 5.0], [3.6, 3.6], color=ORANGE, linewidth=3.0)
    axis.text(5.1, 3.85, "closed now", fontsize=8.0, color=ORANGE)
    robot = (4.0, 1.2)
    for end in ((3.0, 6.4), (4.0, 6.4), (5.0, 6.4)):
        share = (3.6 - robot[1]) / (end[1] - robot[1])
        middle = (robot[0] + share * (end[0] - robot[0]), 3.6)
        axis.plot([robot[0], middle[0]], [robot[1], middle[1]], color=RED, linewidth=0.9, linestyle=":")
        axis.plot([middle[0], end[0]], [middle[1], end[1]], color=GRAY, linewidth=1.3)
        axis.plot(*end, ".", color=GRAY, markersize=5.0)
    axis.plot(*robot, "^", color=GRAY, markersize=8.0)
    axis.text(4.0, 0.5, "stored keyframe, door open", ha="center", fontsize=8.0, color=GRAY)
    axis.text(4.6, 2.4, "given up: the door\nstands in the way", fontsize=8.0, color=RED)
    axis.text(5.1, 5.2, "kept: the room\nis still there", fontsize=8.0, color=GRAY)
    axis.add_patch(Polygon([(0.7, 4.4), (2.7, 4.4), (2.7, 5.6), (0.7, 5.6)], facecolor=PALE_GREEN, edgecolor=GREEN))
    axis.text(1.7, 5.0, "room", ha="center", va="center", fontsize=8.0)


PICTURES: dict[str, Callable[[], Figure]] = {
    "data_flow": data_flow,
    "areas_and_partition": areas_and_partition,
    "inference": inference,
    "closure": closure,
    "relocalization": relocalization,
    "registration": registration,
    "lifelong": lifelong,
}


def write(folder: Path, png: Path | None = None) -> None:
    """Draw all pictures.

    :param folder: for the SVG files.
    :param png: for copies as PNG, None for none.
    """
    with mpl.rc_context(STYLE):
        for name, draw in PICTURES.items():
            figure = draw()
            path = folder / f"concept_{name}.svg"
            figure.savefig(path, metadata={"Date": None, "Creator": None})
            text = path.read_text(encoding="utf-8")
            path.write_text("\n".join(line.rstrip() for line in text.splitlines()) + "\n", encoding="utf-8")
            if png is not None:
                figure.savefig(png / f"concept_{name}.png", dpi=110)
            plt.close(figure)


def main() -> None:
    """Write docs/images/concept_*.svg."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--png", type=Path, metavar="FOLDER", help="copies as PNG, to look at")
    write(IMAGES, parser.parse_args().png)


if __name__ == "__main__":
    main()
