"""The grid of a saved map for nav2, at any resolution, of the whole or of one area."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.offline.going_on import map_folder
from hmt_slam_ros.offline.map_image import occupancy_image, write_map
from hmt_slam_ros.offline.saved_map import read_saved_map

_FINEST, _COARSEST = 0.005, 10.0  # m


def export_grid(
    directory: Path, to: Path, resolution: float | None = None, area: int | None = None
) -> tuple[Path, Path]:
    """Draw the keyframes of the most probable hypothesis anew, as map.pgm and map.yaml.

    :param directory: output folder, or the hmt_map in it or of nodes.
    :param to: folder, made where it is missing.
    :param resolution: side of a cell, m; that of the local maps where None.
    :param area: one area alone, in the frame of that area; the whole map in its own frame where None.
    :returns: the two files.
    :raises HmtSlamError: where the folder holds no complete map, no such area, or the resolution is none.
    """
    if resolution is not None and not _FINEST <= resolution <= _COARSEST:
        raise HmtSlamError(f"--resolution {resolution:g} is none for a grid: give {_FINEST:g} to {_COARSEST:g} m")
    saved = read_saved_map(map_folder(directory))
    hybrid_map = saved.replica.maps[saved.replica.best]
    areas = [known for known in hybrid_map.area_ids() if known in saved.area_poses]
    if area is not None and area not in areas:
        raise HmtSlamError(f"--area {area} is not in the map: its areas are {', '.join(map(str, areas))}")
    frames = {area: np.zeros(3)} if area is not None else {known: saved.area_poses[known].mean for known in areas}
    placed = {
        keyframe: se2.compose(frame, pose)
        for known, frame in frames.items()
        for keyframe, pose in hybrid_map.keyframes(known).items()
    }
    scans = [saved.replica.scans[keyframe] for keyframe in placed]
    settings = saved.configuration.local_map
    try:
        to.mkdir(parents=True, exist_ok=True)
        image = occupancy_image(scans, np.array(list(placed.values())), resolution or settings.cell, settings.max_range)
        write_map(to, image)
    except OSError as fault:
        raise HmtSlamError(f"{to} cannot be written ({fault.strerror}): choose another --grid") from fault
    return to / "map.pgm", to / "map.yaml"
