"""The processes with their messages, and a keyframe event over time."""

from __future__ import annotations

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from concept_pictures.canvas import BLUE, DARK, GRAY, GREEN, ORANGE, PALE_GRAY, PALE_GREEN, arrow, as_canvas, box


def data_flow() -> Figure:
    """The five processes with their messages, and one keyframe event over time."""
    figure: Figure = plt.figure(figsize=(9.4, 6.6), layout="constrained")
    figure.set_facecolor("white")
    upper, lower = figure.subplots(2, 1, height_ratios=(1.25, 1.0))
    _draw_processes(upper)
    _event_over_time(lower)
    return figure


def _draw_processes(axis: Axes) -> None:
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
    note = (
        "Hypotheses and ClosureDecision also go to the other processes, which apply them to their replicas of the map"
    )
    axis.text(9.5, 5.75, note, ha="center", color=GRAY, fontsize=8.0)


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
