"""The output folder is made whole or not at all, and replaces nothing but an earlier one."""

from pathlib import Path

import pytest
from test_results_output_folder import contents

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.results.output_folder import atomic_output
from hmt_slam_ros.saved_map.folder import FolderWriter


def test_a_failed_run_leaves_nothing_behind(tmp_path: Path) -> None:
    def run() -> None:
        with atomic_output(tmp_path / "deep" / "out") as scratch:
            (scratch / "map.pgm").write_text("half")
            raise HmtSlamError("stop")

    with pytest.raises(HmtSlamError, match="stop"):
        run()
    assert list(tmp_path.iterdir()) == []


def test_a_successful_run_makes_missing_folders_and_leaves_no_scratch(tmp_path: Path) -> None:
    with atomic_output(tmp_path / "deep" / "out") as scratch:
        (scratch / "map.pgm").write_text("whole")
    assert [entry.name for entry in tmp_path.iterdir()] == ["deep"]
    assert (tmp_path / "deep" / "out" / "map.pgm").read_text() == "whole"


def write_old_output(directory: Path) -> None:
    """An output folder with a map, a stage, an earlier log, and what a killed ``plot`` left."""
    for name in ("pmf.png", "stages/filter.tum", "earlier/1.tum", ".pmf.png.partial-123"):
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        (directory / name).write_text("old")
    writer = FolderWriter(directory / "hmt_map")
    writer.write_text("configuration.yaml", "old")
    writer.finish("hmt_map", 3)


def test_an_old_output_folder_is_replaced_whole(tmp_path: Path) -> None:
    write_old_output(tmp_path / "out")
    with atomic_output(tmp_path / "out") as scratch:
        (scratch / "map.pgm").write_text("new")
    assert contents(tmp_path) == {"out/map.pgm": b"new"}


@pytest.mark.parametrize(
    "name",
    [
        "hmt_map/notes.txt",
        "hmt_map/more/notes.txt",
        "stages/notes.txt",
        "stages/1.tum",
        "stages/filter.tum.d/notes.txt",
        "earlier/notes.tum",
        "earlier/1.tum.d/notes.txt",
        "map.png.d/notes.txt",
        ".notes.txt.partial-123",
    ],
)
def test_a_file_of_others_within_an_old_output_folder_is_named_and_kept(tmp_path: Path, name: str) -> None:
    write_old_output(tmp_path / "out")
    foreign = tmp_path / "out" / name
    foreign.parent.mkdir(exist_ok=True)
    foreign.write_text("precious")
    before = contents(tmp_path)
    first = name.removesuffix("/notes.txt") if name.count("/") == 2 or ".d/" in name else name
    with pytest.raises(HmtSlamError, match=f"it holds {first}: choose another"), atomic_output(tmp_path / "out"):
        pass
    assert contents(tmp_path) == before


def test_a_link_and_the_manifest_of_something_else_are_of_others_too(tmp_path: Path) -> None:
    write_old_output(tmp_path / "out")
    (tmp_path / "out" / "map.pgm").symlink_to(tmp_path)
    with pytest.raises(HmtSlamError, match=r"it holds map\.pgm: choose"), atomic_output(tmp_path / "out"):
        pass
    (tmp_path / "out" / "map.pgm").unlink()
    (tmp_path / "out" / "hmt_map" / "manifest.json").write_text('{"name": "web app"}')
    with pytest.raises(HmtSlamError, match=r"it holds hmt_map/manifest\.json: choose"), atomic_output(tmp_path / "out"):
        pass


def test_a_file_that_comes_while_the_run_goes_on_is_kept(tmp_path: Path) -> None:
    write_old_output(tmp_path / "out")

    def run() -> None:
        with atomic_output(tmp_path / "out"):
            (tmp_path / "out" / "notes.txt").write_text("precious")

    with pytest.raises(HmtSlamError, match=r"it holds notes\.txt: choose another"):
        run()
    assert (tmp_path / "out" / "notes.txt").read_text() == "precious"


@pytest.mark.parametrize("name", ["notes.txt", "trajectory.tum", "hmt_map/manifest.json and notes.txt"])
def test_a_folder_with_anything_else_is_refused_and_kept(tmp_path: Path, name: str) -> None:
    for part in name.split(" and "):
        (tmp_path / "out" / part).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "out" / part).write_text("precious")
    before = contents(tmp_path)
    with pytest.raises(HmtSlamError, match="is not an output folder"), atomic_output(tmp_path / "out"):
        pass
    assert contents(tmp_path) == before


def test_a_file_in_the_way_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("precious")
    for path in (tmp_path / "out", tmp_path / "out" / "below"):
        with pytest.raises(HmtSlamError, match="choose another --out"), atomic_output(path):
            pass
    assert (tmp_path / "out").read_text() == "precious"
