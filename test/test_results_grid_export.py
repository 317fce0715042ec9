"""The grid of a saved map as nav2's map_server reads it: its parameters, its thresholds, its rows upside down."""

from pathlib import Path

import numpy as np
import pytest
import yaml
from logs_for_nodes import WALLS, corridor_bag

from hmt_slam_ros.cli.main import main
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.results.export import export_grid
from hmt_slam_ros.results.hmt_map import read_saved_map

# What nav2_map_server's map_io wants of a yaml file, with the types as it reads them.
REQUIRED = {
    "image": str,
    "resolution": float,
    "origin": list,
    "negate": int,
    "occupied_thresh": float,
    "free_thresh": float,
}
OPTIONAL = {"mode": str}


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("corridor")
    assert main(["map", str(corridor_bag(folder, scans=60)), "--out", str(folder / "out")]) == 0
    return folder / "out"


def read_served_map(folder: Path) -> tuple[np.ndarray, float, np.ndarray]:
    """Cells (100, 0, -1), resolution and origin as map_server's map_io makes them of the files, in trinary mode."""
    description = yaml.safe_load((folder / "map.yaml").read_text())
    for name, kind in REQUIRED.items():
        assert isinstance(description[name], kind), name
    assert description.keys() <= REQUIRED.keys() | OPTIONAL.keys()
    assert description.get("mode", "trinary") == "trinary"
    assert not Path(description["image"]).is_absolute()
    assert len(description["origin"]) == 3
    magic, size, depth, pixels = (folder / description["image"]).read_bytes().split(b"\n", 3)
    assert (magic, depth) == (b"P5", b"255")
    width, height = map(int, size.split())
    shade = np.frombuffer(pixels, dtype=np.uint8).reshape(height, width) / 255.0
    occupancy = shade if description["negate"] else 1.0 - shade
    cells = np.full(shade.shape, -1)
    cells[occupancy > description["occupied_thresh"]] = 100
    cells[occupancy < description["free_thresh"]] = 0
    return cells[::-1], description["resolution"], np.array(description["origin"])


def distance_to_walls(points: np.ndarray) -> np.ndarray:
    """Of points (n, 2) from the nearest wall, m."""
    begin, end = WALLS[:, :2], WALLS[:, 2:]
    along = end - begin
    share = np.einsum("nwk,wk->nw", points[:, None] - begin, along) / np.einsum("wk,wk->w", along, along)
    nearest = begin + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.hypot(*(points[:, None] - nearest).transpose(2, 0, 1)).min(axis=1)


@pytest.mark.parametrize("resolution", [0.05, 0.1, 0.25])
def test_map_server_sees_the_walls_where_they_are_at_any_resolution(out: Path, tmp_path: Path, resolution) -> None:
    command = ["export", str(out), "--grid", str(tmp_path / "grid"), "--resolution", str(resolution)]
    assert main(command) == 0
    cells, found, origin = read_served_map(tmp_path / "grid")
    assert found == resolution
    assert origin[2] == 0.0
    rows, columns = np.nonzero(cells == 100)
    walls = origin[:2] + (np.column_stack([columns, rows]) + 0.5) * resolution
    assert len(walls) > 10.0 / resolution
    assert np.quantile(distance_to_walls(walls), 0.95) < resolution + 0.05
    assert (cells == 0).sum() * resolution**2 > 20.0
    assert (cells == -1).any()


def test_one_area_stands_in_its_own_frame(out: Path, tmp_path: Path) -> None:
    saved = read_saved_map(out / "hmt_map")
    (area,) = saved.replica.maps[saved.replica.best_hypothesis].area_ids()
    export_grid(out, tmp_path / "whole")
    files = export_grid(out / "hmt_map", tmp_path / "one", area=area)
    assert files == (tmp_path / "one" / "map.pgm", tmp_path / "one" / "map.yaml")
    # The map's frame is that of the first area.
    whole, one = read_served_map(tmp_path / "whole"), read_served_map(tmp_path / "one")
    assert one[1] == whole[1] == saved.configuration.local_map.cell
    assert np.array_equal(one[0], whole[0])


def test_what_there_is_no_grid_of_is_reported(out: Path, tmp_path: Path, capsys) -> None:
    with pytest.raises(HmtSlamError, match="--area 7 is not in the map: its areas are 0"):
        export_grid(out, tmp_path, area=7)
    with pytest.raises(HmtSlamError, match="--resolution 0 is none for a grid: give"):
        export_grid(out, tmp_path, 0.0)
    (tmp_path / "file").write_text("")
    with pytest.raises(HmtSlamError, match="cannot be written"):
        export_grid(out, tmp_path / "file")
    with pytest.raises(HmtSlamError, match="give an output folder"):
        export_grid(tmp_path, tmp_path)
    assert main(["export", str(out), "--area", "0"]) == 2
    assert "say with --grid into which folder" in capsys.readouterr().err
