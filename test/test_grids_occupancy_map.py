"""The occupancy image against scans made by hand."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.grids.occupancy_map import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyImage,
    occupancy_image,
    read_map,
    write_map,
)
from hmt_slam_ros.results.plots import _draw_grid
from hmt_slam_ros.sensors import Scan

AHEAD = np.zeros(3)


def beam(*ranges: float, angle: float = 0.0, increment: float = 0.0, laser: tuple = (0.0, 0.0, 0.0)) -> Scan:
    return Scan(0, np.array(ranges, dtype=np.float32), angle, increment, 0.1, 20.0, np.array(laser))


def draw_map(scans: list[Scan], poses: list, max_range: float = 10.0) -> OccupancyImage:
    return occupancy_image(scans, np.array(poses, dtype=float), 0.1, max_range)


def color(image: OccupancyImage, x: float, y: float) -> int:
    column = int(np.floor((x - image.origin[0]) / image.resolution))
    row = image.pixels.shape[0] - 1 - int(np.floor((y - image.origin[1]) / image.resolution))
    return int(image.pixels[row, column])


def test_one_beam_clears_its_way_and_blackens_its_end() -> None:
    image = draw_map([beam(2.05)], [[0.05, 0.05, 0.0]])
    along = [color(image, 0.05 + 0.1 * k, 0.05) for k in range(-1, 23)]
    assert along == [UNKNOWN, *[FREE] * 20, OCCUPIED, UNKNOWN, UNKNOWN]
    assert (image.pixels == OCCUPIED).sum() == 1
    assert (image.pixels == FREE).sum() == 20


def test_a_beam_crosses_the_cells_that_a_fine_walk_along_it_meets() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        pose = np.array([*rng.uniform(-1, 1, 2), rng.uniform(-np.pi, np.pi)])
        length = float(np.float32(rng.uniform(0.2, 5.0)))
        image = draw_map([beam(length)], [pose])
        steps = np.linspace(0.0, length, 20001)[:, None]
        walk = pose[:2] + steps * np.array([np.cos(pose[2]), np.sin(pose[2])])
        cells = {tuple(cell) for cell in np.floor((walk - image.origin) / 0.1).astype(int)}
        rows, columns = np.nonzero(image.pixels != UNKNOWN)
        found = set(zip(columns.tolist(), (image.pixels.shape[0] - 1 - rows).tolist(), strict=True))
        assert len(cells - found) == 0
        assert len(found - cells) <= 1  # a corner cut by less than the step of the walk


@pytest.mark.parametrize("value", [20.0, 25.0, np.nan, np.inf, 0.0, 0.05, -1.0])
def test_a_beam_without_a_return_has_no_information(value: float) -> None:
    image = draw_map([beam(1.0, value, increment=np.pi / 2)], [AHEAD])
    assert (image.pixels == OCCUPIED).sum() == 1
    assert color(image, 0.05, 0.35) == UNKNOWN


def test_a_beam_beyond_the_range_clears_only() -> None:
    image = draw_map([beam(8.0)], [[0.05, 0.05, 0.0]], max_range=3.0)
    assert (image.pixels == OCCUPIED).sum() == 0
    assert color(image, 2.85, 0.05) == FREE
    assert image.pixels.shape[1] * 0.1 < 4.5


def test_the_laser_stands_where_its_pose_says() -> None:
    image = draw_map([beam(1.0, laser=(0.55, 0.25, np.pi / 2))], [[1.0, 0.0, 0.0]])
    assert color(image, 1.55, 1.25) == OCCUPIED
    assert color(image, 1.55, 0.75) == FREE


def test_x_points_right_and_y_points_up() -> None:
    image = draw_map([beam(1.05), beam(2.05)], [[0.05, 0.05, 0.0], [0.05, 0.05, np.pi / 2]])
    rows, columns = np.nonzero(image.pixels == OCCUPIED)
    top, right = (rows[0], columns[0]), (rows[1], columns[1])
    assert top[0] < right[0]
    assert top[1] < right[1]


def test_one_scan_is_one_vote_however_many_beams_cross_a_cell() -> None:
    wall, through = beam(1.0), beam(*[2.0] * 50)
    assert color(draw_map([wall, through], [AHEAD, AHEAD]), 1.0, 0.0) == OCCUPIED
    assert color(draw_map([wall, through, through], [AHEAD] * 3), 1.0, 0.0) == FREE


def test_a_hit_goes_before_the_misses_of_the_same_scan() -> None:
    grazing = beam(1.0, 2.0)
    assert color(draw_map([grazing], [AHEAD]), 1.0, 0.0) == OCCUPIED


def test_a_map_without_bounds_is_drawn_coarser() -> None:
    image = draw_map([beam(1.0), beam(1.0)], [AHEAD, [2000.0, 2000.0, 0.0]])
    assert image.pixels.size < 1.01 * 2**26
    assert image.resolution == pytest.approx(0.4)


def test_the_files_follow_map_server(tmp_path: Path) -> None:
    image = draw_map([beam(2.05), beam(1.0)], [[-3.0, 0.05, 0.0], AHEAD])
    write_map(tmp_path, image)
    description = yaml.safe_load((tmp_path / "map.yaml").read_text())
    assert (description["image"], description["mode"], description["negate"]) == ("map.pgm", "trinary", 0)
    assert description["origin"][2] == 0.0
    for pixel, meaning in ((OCCUPIED, "occupied"), (FREE, "free"), (UNKNOWN, "unknown")):
        occupied = (255 - int(pixel)) / 255.0
        read = "occupied" if occupied > description["occupied_thresh"] else "unknown"
        assert ("free" if occupied < description["free_thresh"] else read) == meaning
    again = read_map(tmp_path)
    np.testing.assert_array_equal(again.pixels, image.pixels)
    np.testing.assert_array_equal(again.origin, image.origin)
    assert again.resolution == image.resolution


@pytest.mark.parametrize("name", ["map.pgm", "map.yaml"])
def test_a_damaged_map_is_refused(tmp_path: Path, name: str) -> None:
    write_map(tmp_path, draw_map([beam(2.0)], [AHEAD]))
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[:20])
    with pytest.raises(HmtSlamError, match=r"no complete map\.pgm"):
        read_map(tmp_path)


@pytest.mark.parametrize("cells", [25, 400], ids=["enlarged", "reduced"])
def test_the_picture_shows_every_wall_where_it_is(cells: int) -> None:
    pixels = np.full((cells, cells), FREE)
    # Lower left quarter; a single wall across the upper half.
    pixels[cells // 2 :, : cells // 2] = UNKNOWN
    pixels[cells // 4] = OCCUPIED
    figure = Figure(figsize=(1.0, 1.0), dpi=100)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    _draw_grid(axes, OccupancyImage(pixels, 0.1, np.zeros(2)))
    axes.set_axis_off()
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    seen = np.asarray(canvas.buffer_rgba())[..., 0]
    assert (seen[60:95, 5:45] == UNKNOWN).all()
    assert (seen[60:95, 55:95] == FREE).all()
    walls = np.flatnonzero((seen[5:-5, 5:-5] == OCCUPIED).all(axis=1)) + 5
    assert walls.size == max(1, 100 // cells)
    assert abs(walls.mean() - 100.0 * (cells // 4 + 0.5) / cells) <= 1.5
