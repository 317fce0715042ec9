"""The occupancy grid of the whole map from the keyframes' scans, in the format of nav2's map_server."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml

from hmt_slam_ros.arrays import Bool, Float64, Int32, UInt8
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.traversal import begin_walk, next_cell
from hmt_slam_ros.own_files import write_file
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.sensors.plausibility import MAX_COORDINATE, check_planar_pose
from hmt_slam_ros.untrusted_input import read_file, read_yaml

OCCUPIED, FREE, UNKNOWN = np.uint8(0), np.uint8(254), np.uint8(205)

_OCCUPIED_RATIO = 0.4
"""Share of hits from which a cell is occupied: beams that graze a wall pass its cells, too."""

_MARGIN = 0.5
"""Unknown space around all points, m."""

_MAX_CELLS = 1 << 26
"""Cells of an image at most."""

_MAX_IMAGE_BYTES = _MAX_CELLS + 1000
"""Of map.pgm, whose header has some 20."""

_FINEST, _COARSEST = 1e-3, 1e3
"""Limits of the resolution of an image that is read, m; that of a map of 10 km is doubled up to some meters."""

_HITS, _MISSES, _LAST_SCAN = 0, 1, 2
"""Layers of the votes."""


class OccupancyImage(NamedTuple):
    """A trinary occupancy image.

    :ivar pixels: shape (height, width), uint8, ``OCCUPIED``, ``FREE`` or ``UNKNOWN``; row 0 is the top, largest y.
    :ivar resolution: side of a pixel, m.
    :ivar origin: shape (2,), lower left corner of the image in the map frame, m.
    """

    pixels: UInt8
    resolution: float
    origin: Float64


def occupancy_image(scans: Sequence[Scan], poses: Float64, resolution: float, max_range: float) -> OccupancyImage:
    """The occupancy of each cell, from the number of scans that hit it and of those that passed it.

    A beam without a return has no effect. A beam longer than ``max_range`` clears cells up to there.

    :param scans: n scans.
    :param poses: shape (n, 3), ``map_T_base``, m and rad.
    :param resolution: side of a cell, m; doubled until the image has 2^26 cells at most.
    :param max_range: m.
    """
    beams = [_clip_beams(scan, pose, max_range) for scan, pose in zip(scans, poses, strict=True)]
    lasers = [se2.transform(pose, scan.laser_pose[:2])[None] for scan, pose in zip(scans, poses, strict=True)]
    corners = np.concatenate([points for starts, ends, _ in beams for points in (starts, ends)] + lasers)
    low, high = corners.min(axis=0) - _MARGIN, corners.max(axis=0) + _MARGIN
    while np.prod((high - low) / resolution) > _MAX_CELLS:
        resolution *= 2.0
    origin = np.floor(low / resolution) * resolution
    width, height = (np.ceil((high - origin) / resolution).astype(int) + 1).tolist()
    # Zeros that no beam touches take no memory, and most cells of a large map are such.
    votes = np.zeros((3, height, width), dtype=np.int32)
    for k, (starts, ends, returned) in enumerate(beams, start=1):
        _vote((starts - origin) / resolution, (ends - origin) / resolution, returned, k, votes)
    return OccupancyImage(_classify(votes[_HITS], votes[_MISSES])[::-1], resolution, origin)


def _classify(hits: Int32, misses: Int32) -> UInt8:
    """The pixels of cells, row by row, which takes little memory besides."""
    pixels = np.full(hits.shape, UNKNOWN)
    for row, row_hits, row_misses in zip(pixels, hits, misses, strict=True):
        votes = row_hits + row_misses
        row[votes > 0] = FREE
        row[(votes > 0) & (row_hits >= _OCCUPIED_RATIO * votes)] = OCCUPIED
    return pixels


def _clip_beams(scan: Scan, pose: Float64, max_range: float) -> tuple[Float64, Float64, Bool]:
    """Starts and ends (k, 2) of the valid beams cut off at ``max_range``, and whether each end is a return."""
    ranges = np.hypot(*scan.beams.T)
    cut = scan.beams * (np.minimum(ranges, max_range) / np.maximum(ranges, 1e-9))[:, None] + scan.origins
    return se2.transform(pose, scan.origins), se2.transform(pose, cut), ranges <= max_range


@njit(cache=True)
def _vote(
    starts: Float64,
    ends: Float64,
    returned: Bool,
    scan: int,
    votes: Int32,
) -> None:
    """Add the votes of one scan: at most one per cell, hits before misses. Coordinates in cells.

    :param scan: its number, from 1 on.
    """
    for k in range(ends.shape[0]):
        i, j = math.floor(ends[k, 1]), math.floor(ends[k, 0])
        if returned[k] and votes[_LAST_SCAN, i, j] != scan:
            votes[_LAST_SCAN, i, j] = scan
            votes[_HITS, i, j] += 1
    for k in range(ends.shape[0]):
        _clear(starts[k], ends[k], scan, votes)


@njit(cache=True)
def _clear(start: Float64, end: Float64, scan: int, votes: Int32) -> None:
    """Add misses to all cells that a beam crosses, without its last cell."""
    walk, steps = begin_walk(start[0], start[1], end[0], end[1])
    for _ in range(steps):
        i, j = walk.row, walk.column
        if votes[_LAST_SCAN, i, j] != scan:
            votes[_LAST_SCAN, i, j] = scan
            votes[_MISSES, i, j] += 1
        walk = next_cell(walk)


def write_map(directory: Path, image: OccupancyImage) -> None:
    """Write map.pgm and map.yaml."""
    height, width = image.pixels.shape
    header = f"P5\n{width} {height}\n255\n".encode()
    write_file(directory / "map.pgm", header + np.ascontiguousarray(image.pixels).tobytes())
    # 205 reads as (255 - 205) / 255 = 0.1961 occupied: unknown only if free_thresh is not above that.
    description = {
        "image": "map.pgm",
        "mode": "trinary",
        "resolution": image.resolution,
        "origin": [*image.origin.tolist(), 0.0],
        "negate": 0,
        "occupied_thresh": 0.65,
        "free_thresh": 0.196,
    }
    write_file(directory / "map.yaml", yaml.safe_dump(description, sort_keys=False).encode())


def read_map(directory: Path) -> OccupancyImage:
    """The image in map.pgm and map.yaml as :func:`write_map` writes them.

    :raises HmtSlamError: where they are missing or have another form.
    """
    try:
        description = read_yaml(directory / "map.yaml")
        content = read_file(directory / "map.pgm", _MAX_IMAGE_BYTES)
        magic, size, depth, pixels = content.split(b"\n", 3)
        width, height = (int(number) for number in size.split())
        if (magic, depth) != (b"P5", b"255"):
            raise ValueError(magic)
        image = np.frombuffer(pixels, dtype=np.uint8).reshape(height, width)
        resolution, origin = float(description["resolution"]), np.array(description["origin"][:2], dtype=float)
        if not (image.size and _FINEST <= resolution <= _COARSEST and origin.shape == (2,)):
            raise ValueError(resolution)
        check_planar_pose(origin, "origin", MAX_COORDINATE)
        return OccupancyImage(image, resolution, origin)
    except (HmtSlamError, ValueError, KeyError, TypeError) as fault:
        raise HmtSlamError(f"{directory} holds no complete map.pgm and map.yaml: map the log again") from fault
