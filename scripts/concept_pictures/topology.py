"""Areas, branching, loop closure and relocalization."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from concept_pictures.canvas import (
    BLUE,
    GRAY,
    GREEN,
    ORANGE,
    PALE_BLUE,
    PALE_GRAY,
    PALE_GREEN,
    PALE_ORANGE,
    PALE_RED,
    RED,
    Float64,
    arrow,
    as_canvas,
    box,
    covariance_ellipse,
    draw_walls,
    new_figure,
    rays,
)


def areas_and_partition() -> Figure:
    """Keyframes through two rooms, their overlap, and the normalized cut that separates them."""
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
    for i, scan in enumerate(seen):
        for j in range(i):
            near = np.hypot(*(scan[:, None] - seen[j][None]).transpose(2, 0, 1)) <= radius
            found[i, j] = found[j, i] = 0.5 * (near.any(axis=1).mean() + near.any(axis=0).mean())
    return found


def _ncut(similarity: Float64, side: NDArray[np.bool_]) -> float:
    cut = similarity[side][:, ~side].sum()
    return float(cut / similarity[side].sum() + cut / similarity[~side].sum())


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


def relocalization() -> Figure:
    """The statistic that detects a kidnapping, and the states of a hypothesis."""
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
    _draw_states(states)
    return figure


def _draw_states(axis: Axes) -> None:
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
