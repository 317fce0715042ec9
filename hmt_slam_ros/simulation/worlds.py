"""Simulated worlds: families of buildings by name, and world files."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmt_slam_ros.configuration.flat import Value
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.simulation import corridors
from hmt_slam_ros.simulation.building import Building, outline_of_cells
from hmt_slam_ros.simulation.institute import institute
from hmt_slam_ros.simulation.settings import Settings
from hmt_slam_ros.untrusted_input import read_file, read_yaml, shorten


@dataclass(frozen=True)
class Family:
    """A kind of building.

    :ivar build: draws a building of the kind.
    :ivar description: one sentence.
    :ivar default_settings: settings of the family that differ from the common defaults.
    """

    build: Callable[[np.random.Generator, Settings], Building]
    description: str
    default_settings: Mapping[str, Value] = field(default_factory=dict)


FAMILIES: dict[str, Family] = {
    "office": Family(corridors.office, "Offices with furniture on both sides of a ring of corridors."),
    "busy": Family(
        corridors.office,
        "The same with people in the corridors, and furniture that is moved between visits.",
        {"people": 6, "moved": 0.5},
    ),
    "nested": Family(
        corridors.nested,
        "Loops inside loops, 0.5 km of corridors with niches; size=4 makes 2 km of them.",
        {"laps": 1},
    ),
    "grid": Family(corridors.grid, "Corridors that cross at equal distances and look all alike.", {"laps": 1}),
    "ring": Family(corridors.symmetric_ring, "A square ring of corridors whose four sides are alike."),
    "straight": Family(corridors.straight, "A ring with two long halls without any feature.", {"range": 10.0}),
    "hall": Family(
        corridors.hall, "An open hall in whose middle the laser reaches nothing.", {"range": 8.0, "laps": 1}
    ),
    "twins": Family(
        corridors.twins,
        "Two identical rooms; lost in a hall in between, the robot enters one of them again.",
        {"range": 4.0, "laps": 1},
    ),
    "institute": Family(
        institute,
        "Hallways of 50 m x 25 m with crossings, offices and meeting rooms, of which 9 are open, and people; a visit "
        "finds others open.",
        {"laps": 1, "people": 4, "field_of_view": 360.0, "beams": 720},
    ),
}

_KEYS = ("walls", "furniture", "route", "settings", "image", "resolution", "origin", "negate", "occupied_thresh")
_IGNORED = ("free_thresh", "mode")
"""Keys of map_server that have no effect here."""

_MAX_ROWS, _MAX_LENGTH = 20_000, 1e4
"""Of a table of a world: rows, and the magnitude of its numbers, m or degrees."""

_FINEST, _COARSEST = 1e-3, 10.0
"""Limits of the resolution of an image, m."""

_MAX_PIXELS = 1 << 26
"""Of an image of a world."""


def read_world(path: Path) -> tuple[Building, dict[str, Any]]:
    """The building and the settings of a world file.

    It has ``walls`` as lists of x0, y0, x1, y1 (m), ``route`` of x, y (m), and ``furniture`` of x, y, heading
    (degrees), length, width (m). ``image`` (relative to the file), ``resolution``, ``origin``, ``negate`` and
    ``occupied_thresh`` are those of map_server's map.yaml: the edges of occupied pixels are walls.

    :raises HmtSlamError: if file or image cannot be read, a key is unknown, or a table is malformed.
    """
    content = _content(path)
    unknown = [key for key in content if key not in (*_KEYS, *_IGNORED)]
    if unknown:
        raise HmtSlamError(f"{path} has an unknown key {shorten(unknown[0])!r}: use {', '.join(_KEYS)}.")
    walls = [_table(path, content, "walls", 4)]
    if "image" in content:
        walls.append(_walls_of_image(path, content))
    route, furniture = _table(path, content, "route", 2), _table(path, content, "furniture", 5)
    if not sum(map(len, walls)) or len(route) < 2:
        raise HmtSlamError(f"{path} has no walls or fewer than two way-points: give walls or an image, and a route.")
    furniture[:, 2] = np.deg2rad(furniture[:, 2])
    settings = content.get("settings") or {}
    if not isinstance(settings, Mapping):
        raise HmtSlamError(f"settings in {path} is {shorten(settings)}: write lines such as 'range: 8.0' below it.")
    return Building(np.concatenate(walls), route, furniture), dict(settings)


def walls_of_image(occupied: NDArray[np.bool_], resolution: float, origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Walls (n, 4) at the edges of occupied pixels, m.

    :param occupied: shape (height, width); row 0 has the largest y.
    :param resolution: side of a pixel, m.
    :param origin: shape (3,), pose of the lower left corner of the image, m and rad.
    """
    height, width = occupied.shape
    edges = outline_of_cells(occupied[::-1], resolution * np.arange(width + 1.0), resolution * np.arange(height + 1.0))
    return np.concatenate((se2.transform(origin, edges[:, :2]), se2.transform(origin, edges[:, 2:])), axis=1)


def _content(path: Path) -> Mapping[str, Any]:
    content = read_yaml(path)
    if not isinstance(content, Mapping):
        raise HmtSlamError(f"the world {path} holds no keys: write lines such as 'route: [[0, 0], [5, 0]]'.")
    return content


def _table(path: Path, content: Mapping[str, Any], key: str, columns: int) -> NDArray[np.float64]:
    """The rows of a key, shape (n, columns); none without the key."""
    try:
        rows = np.array(content.get(key) or [], dtype=np.float64).reshape(-1, columns)
        lengths = {len(row) for row in content.get(key) or []}
    except (TypeError, ValueError, OverflowError):
        lengths = {0}
    if lengths - {columns} or not np.isfinite(rows).all():
        raise HmtSlamError(f"{key} in {path} is no list of rows of {columns} numbers: correct it.")
    if len(rows) > _MAX_ROWS or np.abs(rows).max(initial=0.0) > _MAX_LENGTH:
        raise HmtSlamError(
            f"{key} in {path} has more than {_MAX_ROWS} rows or a number beyond {_MAX_LENGTH:g}: give a smaller world."
        )
    return rows


def _walls_of_image(path: Path, content: Mapping[str, Any]) -> NDArray[np.float64]:
    from matplotlib.image import imread  # noqa: PLC0415  slow to import, and seldom needed
    from PIL.Image import open as open_image  # noqa: PLC0415

    file = path.parent / str(content["image"])
    try:
        resolution, threshold = float(content["resolution"]), float(content.get("occupied_thresh", 0.65))
        origin = np.array(content.get("origin", (0.0, 0.0, 0.0)), dtype=np.float64).reshape(3)
    except (KeyError, TypeError, ValueError) as fault:
        raise HmtSlamError(
            f"{path} lacks resolution or has a wrong origin ({shorten(fault)}): write map_server's."
        ) from fault
    try:
        image = read_file(file, 4 * _MAX_PIXELS)
        size = open_image(io.BytesIO(image)).size
        if size[0] * size[1] > _MAX_PIXELS:
            raise ValueError(f"it has {size[0]} x {size[1]} pixels")
        pixels = np.asarray(imread(io.BytesIO(image), format=file.suffix[1:].lower() or "png"))
    except Exception as fault:  # whatever Pillow meets in a damaged image
        raise HmtSlamError(f"the image {file} cannot be read ({shorten(fault)}): give a PGM or PNG file.") from fault
    brightness = pixels / 255.0 if pixels.dtype == np.uint8 else pixels.astype(np.float64)
    gray = brightness if brightness.ndim == 2 else brightness[..., : min(3, brightness.shape[2])].mean(axis=2)
    if not (_FINEST <= resolution <= _COARSEST and np.abs(origin).max() <= _MAX_LENGTH):
        raise HmtSlamError(f"{path} has resolution {resolution:g} and origin {origin.tolist()}: write map_server's.")
    occupancy = gray if content.get("negate") else 1.0 - gray
    return walls_of_image(occupancy > threshold, resolution, origin)
