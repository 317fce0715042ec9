"""Registration of scans, and change detection."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse, Polygon, Rectangle
from scipy.ndimage import distance_transform_edt

from concept_pictures.canvas import (
    BLUE,
    DARK,
    GRAY,
    GREEN,
    ORANGE,
    PALE_GRAY,
    PALE_GREEN,
    PALE_ORANGE,
    PALE_RED,
    RED,
    Float64,
    Point,
    arrow,
    as_canvas,
    draw_walls,
    new_figure,
    rays,
)


def registration() -> Figure:
    """The three kinds of registration of scans with maps, or with each other."""
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


def lifelong() -> Figure:
    """Change detection: static surfaces, stale beams, and shortened ones."""
    figure, axes = new_figure(10.6, 3.9, (1.0, 1.0, 1.0))
    titles = ("New: static, and in no keyframe", "Stale: the end is seen through", "Shortened: a door closed")
    for axis, title, draw in zip(axes, titles, (_draw_new, _draw_stale, _draw_shortened), strict=True):
        as_canvas(axis, 8.0, 7.6)
        axis.set_title(title)
        draw_walls(axis, np.array([[0.4, 6.4, 7.6, 6.4]]), 2.4)
        draw(axis)
    return figure


def _draw_beams(axis: Axes, robot: Point, ends: Sequence[Point], color: str, style: str = "-") -> None:
    for end in ends:
        axis.plot([robot[0], end[0]], [robot[1], end[1]], color=color, linewidth=0.9, linestyle=style)
        axis.plot(*end, ".", color=color, markersize=5.0)
    axis.plot(*robot, "^", color=color, markersize=8.0)


def _draw_new(axis: Axes) -> None:
    axis.add_patch(Rectangle((2.2, 4.4), 1.5, 0.9, facecolor=PALE_ORANGE, edgecolor=ORANGE))
    axis.text(2.95, 4.85, "box", ha="center", va="center", fontsize=8.0)
    _draw_beams(axis, (1.6, 1.3), [(2.25, 4.4), (2.6, 4.4), (3.0, 4.4)], GRAY)
    _draw_beams(axis, (4.0, 1.3), [(3.6, 4.4), (3.2, 4.4), (2.8, 4.4), (5.6, 3.72), (5.9, 3.72)], BLUE)
    axis.add_patch(Ellipse((5.8, 4.0), 0.75, 0.6, facecolor=PALE_GRAY, edgecolor=GRAY))
    axis.text(5.8, 4.6, "person: seen now only", ha="center", fontsize=8.0, color=GRAY)
    axis.text(1.6, 0.5, "a look 1 to 3 s ago", ha="center", fontsize=8.0, color=GRAY)
    axis.text(4.9, 0.5, "now", ha="right", fontsize=8.0, color=BLUE)
    axis.text(0.5, 5.65, "0.5 m of it: the keyframe is stored", fontsize=8.0, color=ORANGE)


def _draw_stale(axis: Axes) -> None:
    axis.add_patch(Rectangle((3.1, 4.2), 1.6, 0.9, fill=False, edgecolor=GRAY, linestyle=":"))
    axis.text(3.9, 4.65, "was here", ha="center", va="center", fontsize=8.0, color=GRAY)
    _draw_beams(axis, (2.0, 1.3), [(3.3, 4.2), (3.8, 4.2), (4.3, 4.2)], GRAY, "--")
    _draw_beams(axis, (5.6, 1.3), [(2.6, 6.4), (3.6, 6.4), (4.5, 6.4)], BLUE)
    for x in (3.3, 3.8, 4.3):
        axis.plot(x, 4.2, "x", color=RED, markersize=8.0, markeredgewidth=2.0)
    axis.text(2.0, 0.5, "stored keyframe", ha="center", fontsize=8.0, color=GRAY)
    axis.text(5.6, 0.5, "now", ha="center", fontsize=8.0, color=BLUE)
    axis.text(0.3, 3.1, "these beams\nare removed", fontsize=8.0, color=RED)


def _draw_shortened(axis: Axes) -> None:
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
