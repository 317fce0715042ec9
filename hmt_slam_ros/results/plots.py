"""Pictures of an output folder, from its files alone."""

from __future__ import annotations

import colorsys
import csv
import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backend_bases import RendererBase
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse as EllipsePatch
from matplotlib.path import Path as PlotPath
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import read_tum
from hmt_slam_ros.geometry.gaussian import Ellipse, PoseGaussian
from hmt_slam_ros.grids.occupancy_map import OCCUPIED, UNKNOWN, OccupancyImage
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import is_uninformative
from hmt_slam_ros.own_files import write_file
from hmt_slam_ros.results.hmt_map import SavedMap, read_saved_map
from hmt_slam_ros.results.pieces import MapPiece, image_corners, split_map
from hmt_slam_ros.results.trajectories import Trajectory
from hmt_slam_ros.untrusted_input import MAX_TEXT_BYTES, read_text

Color = tuple[float, float, float]

_DPI = 150
"""Resolution of the pictures, pixels per inch."""

_CLOSURE, _ARC, _PATH = "#d62728", "#1f3b70", "#555555"
"""Colors of arcs that closed a loop, of other arcs and of the path."""

_MAX_STEP = 2.0
"""Longest step between two scans that is drawn, m; beyond it the robot was moved, or scans are missing."""

_MIN_SHARE = 0.25
"""Least width of a piece of the map in its picture, as a share of the widest."""

_BAND_SHARE = 0.025
"""Width of the hatched band along the frame, as a share of the longer side of the map."""

_GOLDEN = 0.6180339887498949
"""Golden section: steps of the hue from one number to the next."""


def plot_all(directory: Path) -> list[Path]:
    """Draw map.png, pmf.png and cost.png.

    :returns: the pictures.
    :raises HmtSlamError: where the folder is no complete output folder.
    """
    return [plot_map(directory), plot_probabilities(directory), plot_cost(directory)]


def plot_map(directory: Path) -> Path:
    """Draw map.png: the occupancy grid with path, areas, arcs and the 95 % ellipses of the areas' origins.

    The extent is that of the grid and the keyframes. An ellipse that exceeds it is cut off at the frame, and hatched
    there. Pieces whose place in the map is unknown stand beside it, in frames of their own.
    """
    saved = read_saved_map(directory / "hmt_map")
    return draw_map(directory, saved, read_tum(directory / "trajectory.tum").poses)


def draw_map(directory: Path, saved: SavedMap, trajectory: Trajectory) -> Path:
    """Draw map.png as :func:`plot_map` does.

    :param saved: the map in the folder.
    :param trajectory: shape (n, 3), ``map_T_base`` of the last n scans of the map; a line ends at NaN.
    """
    hybrid_map = saved.replica.maps[saved.replica.best_hypothesis]
    trajectory = _break_at_jumps(trajectory)
    pieces = split_map(directory, saved, trajectory)
    sizes = np.array([np.diff(piece.corners, axis=0)[0] for piece in pieces])
    widths = np.maximum(sizes[:, 0], _MIN_SHARE * sizes[:, 0].max())
    figure = Figure(figsize=_figure_size(float(widths.sum()), float(sizes[:, 1].max())), layout="constrained")
    row = figure.subplots(1, len(pieces), squeeze=False, width_ratios=widths)[0]
    for axes, piece in zip(row, pieces, strict=True):
        _draw_piece(axes, hybrid_map, piece)
        axes.set_title("place unknown", fontsize=9)
    row[0].set_title(_map_title(hybrid_map, trajectory[:, :2]), fontsize=9)
    row[0].legend(loc="best", fontsize=7, framealpha=0.9)
    return _save(figure, directory / "map.png")


def _break_at_jumps(trajectory: Trajectory) -> Trajectory:
    """The trajectory without the first scan after each jump, so that no line leads through walls."""
    jumps = np.flatnonzero(np.hypot(*np.diff(trajectory[:, :2], axis=0).T) > _MAX_STEP) + 1
    broken = trajectory.copy()
    broken[jumps] = np.nan
    return broken


def draw_team(path: Path, surfaces: Mapping[str, NDArray[np.float64]]) -> Path:
    """Draw what each robot saw, in its color.

    :param path: of the picture.
    :param surfaces: {name of a robot: shape (n, 2), end points of its beams in the map, m}.
    """
    everything = np.concatenate(list(surfaces.values()))
    size = np.ptp(everything, axis=0) if len(everything) else np.ones(2)
    figure = Figure(figsize=_figure_size(float(size[0]), float(size[1])), layout="constrained")
    axes = figure.subplots()
    for number, (name, points) in enumerate(surfaces.items()):
        color = color_of(number)
        axes.plot(points[:, 0], points[:, 1], ",", color=color, alpha=0.6, rasterized=True)
        axes.plot([], [], "s", color=color, label=name)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(loc="best", fontsize=8, framealpha=0.9)
    return _save(figure, path)


def _draw_piece(axes: Axes, hybrid_map: HybridMap, piece: MapPiece) -> None:
    _draw_grid(axes, piece.image)
    left, bottom, right, top = piece.corners.ravel().tolist()
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.plot(piece.path[:, 0], piece.path[:, 1], color=_PATH, linewidth=0.8, label="path", zorder=2)
    for area, positions in piece.keyframes.items():
        axes.plot(positions[:, 0], positions[:, 1], ".", color=color_of(area), markersize=4, zorder=3)
    _draw_arcs(axes, hybrid_map, piece.area_poses)
    _draw_areas(axes, piece.area_poses, 0.01 * float(np.diff(piece.corners, axis=0).max()))


def _figure_size(width: float, height: float) -> tuple[float, float]:
    longest = 11.0  # inches
    return max(4.5, longest * min(1.0, width / height)), max(3.5, longest * min(1.0, height / width))


def _draw_grid(axes: Axes, image: OccupancyImage) -> None:
    axes.add_artist(_GridArtist(axes, image, walls_only=False))
    axes.add_artist(_GridArtist(axes, image, walls_only=True))
    axes.set_facecolor(str(int(UNKNOWN) / 255))
    left, bottom, right, top = image_corners(image).ravel().tolist()
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.tick_params(labelsize=7)


class _GridArtist(Artist):
    """The occupancy grid. ``imshow`` would take 60 MB more for colors and interpolation.

    The walls alone are drawn once more, over the fill of the ellipses.
    """

    def __init__(self, axes: Axes, image: OccupancyImage, *, walls_only: bool) -> None:
        super().__init__()
        self._grid_axes, self._image, self._walls_only = axes, image, walls_only
        self.set_zorder(1.5 if walls_only else 0)

    def draw(self, renderer: RendererBase) -> None:
        """Paint each pixel in the darkest gray of its cells, so that walls stay visible."""
        corners = self._grid_axes.transData.transform(image_corners(self._image)).round().astype(int)
        (left, bottom), (width, height) = corners[0].tolist(), np.diff(corners, axis=0)[0].tolist()
        gray = _darkest_rows(_darkest_rows(self._image.pixels, height).T, width).T[::-1]
        colors = np.full((height, width, 4), 255, np.uint8)
        colors[..., :3] = gray[..., None]
        if self._walls_only:
            colors[..., 3] *= gray == OCCUPIED
        renderer.draw_image(renderer.new_gc(), left, bottom, colors)


def _darkest_rows(pixels: NDArray[np.uint8], count: int) -> NDArray[np.uint8]:
    """Rows (n, m) resampled to ``count``: the minimum of the rows that each covers, or the nearest row."""
    starts = np.arange(count) * len(pixels) // count
    return pixels[starts] if count >= len(pixels) else np.minimum.reduceat(pixels, starts)


def _draw_arcs(axes: Axes, hybrid_map: HybridMap, area_poses: Mapping[int, PoseGaussian]) -> None:
    """Draw the arcs within a piece, uninformative ones dashed."""
    for closure, color, label in ((False, _ARC, "arc"), (True, _CLOSURE, "arc that closed a loop")):
        arcs = [
            ((area_poses[a].mean[:2], area_poses[b].mean[:2]), "--" if is_uninformative(arc.pose) else "-")
            for a, b, arc in hybrid_map.all_arcs()
            if arc.closure == closure and {a, b} <= area_poses.keys()
        ]
        if arcs:
            ends, styles = map(list, zip(*arcs, strict=True))
            lines = LineCollection(ends, colors=color, linestyles=styles, linewidths=1.2, label=label, zorder=4)
            axes.add_collection(lines)


def _draw_areas(axes: Axes, area_poses: Mapping[int, PoseGaussian], visible: float) -> None:
    """Draw origins, ids and ellipses.

    :param visible: least semi-major axis of the largest ellipse, m; smaller ones are enlarged by a round factor.
    """
    ellipses = {area: belief.position_ellipse() for area, belief in area_poses.items()}
    largest = max(ellipse.semi_major for ellipse in ellipses.values())
    factor = 1 if largest <= 0.0 else int(10 ** np.clip(np.ceil(np.log10(visible / largest)), 0, 2))
    is_exceeding = [
        _draw_ellipse(axes, area_poses[area].mean, ellipse, factor, color_of(area))
        for area, ellipse in ellipses.items()
    ]
    for area, belief in area_poses.items():
        axes.annotate(
            str(area),
            belief.mean[:2].tolist(),
            ha="center",
            va="center",
            fontsize=7,
            fontweight="bold",
            zorder=6,
            bbox={"boxstyle": "circle,pad=0.25", "facecolor": "white", "edgecolor": color_of(area), "linewidth": 1.5},
        )
    enlarged = f", enlarged {factor} times" if factor > 1 else ""
    hatched = ", hatched where it exceeds the map" if any(is_exceeding) else ""
    axes.plot([], [], "o", markerfacecolor="none", color="black", label=f"area, 95 % ellipse{enlarged}{hatched}")


def _draw_ellipse(axes: Axes, mean: NDArray[np.float64], ellipse: Ellipse, factor: int, color: Color) -> bool:
    """Draw an ellipse under the walls; returns whether it exceeds the map.

    One that does is hatched along the frame and has no fill, which would hide the map.
    """
    major, minor = factor * ellipse.semi_major, factor * ellipse.semi_minor
    cos, sin = np.cos(ellipse.angle), np.sin(ellipse.angle)
    extent = np.array([np.hypot(major * cos, minor * sin), np.hypot(major * sin, minor * cos)])
    low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
    exceeds = bool((mean[:2] - extent < low).any() or (mean[:2] + extent > high).any())
    shape = {"xy": mean[:2].tolist(), "width": 2.0 * major, "height": 2.0 * minor, "angle": np.degrees(ellipse.angle)}
    fill = "none" if exceeds else (*color, 0.25)
    axes.add_patch(EllipsePatch(**shape, zorder=1, facecolor=fill, edgecolor=color, linewidth=0.5 if exceeds else 1.0))
    if exceeds:
        hatch = EllipsePatch(**shape, zorder=1, facecolor="none", edgecolor=color, linewidth=0.0, hatch="////")
        axes.add_patch(hatch)
        hatch.set_clip_path(_frame_band(low, high), axes.transData)
    return exceeds


def _frame_band(low: NDArray[np.float64], high: NDArray[np.float64]) -> PlotPath:
    """The band inside the frame from one corner to the other: its outline, and that of the hole the other way round."""
    width = _BAND_SHARE * float((high - low).max())
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1), (0, 0)], dtype=float)
    outer = low + corners * (high - low)
    inner = low + width + corners[::-1] * (high - low - 2.0 * width)
    codes = [PlotPath.MOVETO, *[PlotPath.LINETO] * 3, PlotPath.CLOSEPOLY]
    return PlotPath(np.concatenate((outer, inner)), codes * 2)


def _map_title(hybrid_map: HybridMap, path: NDArray[np.float64]) -> str:
    arcs = [arc for _, _, arc in hybrid_map.all_arcs()]
    length = float(np.nansum(np.hypot(*np.diff(path, axis=0).T)))
    closures = sum(arc.closure for arc in arcs)
    return f"areas: {len(hybrid_map.area_ids())}   arcs: {len(arcs)}   loop closures: {closures}   path: {length:.0f} m"


_PROBABILITY_COLUMNS = ("stamp", "keyframe", "hypothesis", "probability", "accepted")
"""Columns of pmf.csv that are drawn."""


def plot_probabilities(directory: Path) -> Path:
    """Draw pmf.png: the probabilities of the hypotheses at every keyframe event, Eq. (14), and their number."""
    table = read_table(directory / "pmf.csv")
    if not set(_PROBABILITY_COLUMNS) <= set(table) or not table["stamp"].size:
        raise HmtSlamError(f"{directory / 'pmf.csv'} holds no probabilities: map the log again")
    minutes = (table["stamp"] - table["stamp"][0]) / 60e9
    firsts = np.flatnonzero(np.diff(table["keyframe"], prepend=-1))
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    _draw_bars(upper, table, minutes, firsts)
    accepted = np.flatnonzero(table["accepted"])
    upper.plot(minutes[accepted], np.full(accepted.size, 1.03), "v", color="black", markersize=4, label="accepted")
    upper.set_ylabel("P(topology | data)")
    upper.set_ylim(0.0, 1.06)
    upper.legend(loc="lower left", fontsize=7)
    lower.stairs(np.diff(np.append(firsts, minutes.size)), _bar_edges(minutes[firsts]), color=_ARC, baseline=None)
    lower.yaxis.set_major_locator(MaxNLocator(integer=True))
    lower.set_ylabel("live topologies")
    lower.set_xlabel("time [min]")
    return _save(figure, directory / "pmf.png")


def _draw_bars(
    axes: Axes, table: Mapping[str, NDArray[np.float64]], minutes: NDArray[np.float64], firsts: NDArray[np.intp]
) -> None:
    """Draw one stack for each keyframe event, up to the next, with one color for each hypothesis."""
    counts = np.diff(np.append(firsts, minutes.size))
    tops = np.cumsum(table["probability"])
    tops -= np.repeat(tops[firsts] - table["probability"][firsts], counts)
    bottoms = tops - table["probability"]
    edges = _bar_edges(minutes[firsts])
    left, right = edges[:-1].repeat(counts), edges[1:].repeat(counts)
    corners = np.stack([(left, bottoms), (right, bottoms), (right, tops), (left, tops)]).transpose(2, 0, 1)
    colors = [color_of(int(hypothesis)) for hypothesis in table["hypothesis"]]
    axes.add_collection(PolyCollection(list(corners), facecolors=colors, edgecolors="none"))
    axes.plot([], [], "s", color="none", markeredgecolor="gray", label="white: not examined or dropped")
    axes.set_xlim(edges[0], edges[-1])


def _bar_edges(starts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Starts of all bars and the end of the last one, which has the median width."""
    return np.append(starts, starts[-1] + (float(np.median(np.diff(starts))) if starts.size > 1 else 1.0))


def plot_cost(directory: Path) -> Path:
    """Draw cost.png: the computing time of every process for every scan."""
    table = read_table(directory / "cost.csv")
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    axes = figure.add_subplot()
    for k, (name, cost) in enumerate(table.items()):
        if cost.size:
            spread = f"p95 {np.percentile(cost, 95):.2f}, max {cost.max():.1f} ms"
            label = f"{name.removesuffix('_ms')}: mean {cost.mean():.2f}, {spread}"
            scans = np.flatnonzero(cost)
            axes.plot(scans, cost[scans], ".", markersize=3, color=f"C{k}", label=label)
    axes.set_yscale("log")
    axes.set_xlabel("scan")
    axes.set_ylabel("computing time [ms]")
    axes.grid(alpha=0.3)
    if table:
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, fontsize=7)
    return _save(figure, directory / "cost.png")


def read_table(path: Path) -> dict[str, NDArray[np.float64]]:
    """The columns of pmf.csv or cost.csv, {name: shape (lines,)}.

    :raises HmtSlamError: where the file is missing or damaged.
    """
    try:
        names, *lines = csv.reader(io.StringIO(read_text(path, MAX_TEXT_BYTES), newline=""))
        columns = np.array([[float(text) for text in line] for line in lines]).reshape(len(lines), len(names))
        if not np.isfinite(columns).all():
            raise ValueError("a number that is not finite")
    except (HmtSlamError, ValueError, csv.Error) as fault:
        raise HmtSlamError(f"{path} is missing or damaged: map the log again") from fault
    return {name: columns[:, k] for k, name in enumerate(names)}


def color_of(number: int) -> Color:
    """The color of an area or hypothesis, RGB in [0, 1], as on the live page.

    Hues by the golden section, in two shades.
    """
    return colorsys.hsv_to_rgb((0.58 + number * _GOLDEN) % 1.0, 0.85, 0.85 if number % 2 else 0.65)


def _save(figure: Figure, path: Path) -> Path:
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=_DPI)
    write_file(path, picture.getvalue())
    return path
