"""The command ``merge``: maps of halves of a simulated drive, and what it refuses."""

import json
import re
import shutil

import pytest

from benchmark.merging import MappedHalf, merge_halves
from hmt_slam_ros.cli.main import FAULT, main
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.evaluation import read_true_poses, read_tum
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.grids.occupancy_map import read_map
from hmt_slam_ros.hybrid_map.shortest_path import map_pieces
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.registration.consistency import NO_CLUTTER
from hmt_slam_ros.results.hmt_map import read_clutter, read_saved_map
from hmt_slam_ros.results.log_reading import FIXED_PARAMETERS
from hmt_slam_ros.saved_map.folder import VERSION

WORLD, OTHER = "sim:office,size=0.7,seed=51", "sim:ring,seed=50"


def map_part(world, folder, first, share, *more):
    duration = open_log(world).duration
    window = ["--start", str(first * duration), "--duration", str(share * duration)]
    assert main(["map", world, *window, "--jobs", "1", "--out", str(folder), *more]) == 0


@pytest.fixture(scope="module")
def maps(tmp_path_factory):
    folder = tmp_path_factory.mktemp("maps")
    map_part(WORLD, folder / "one", 0.0, 0.5)
    map_part(WORLD, folder / "two", 0.5, 0.5)
    map_part(OTHER, folder / "elsewhere", 0.0, 0.5)
    return folder


def test_the_trajectory_of_a_joined_map_has_the_scans_of_all(maps, tmp_path):
    """The two drove one after another; with one of another building there is no trajectory."""
    assert merge(maps / "one", maps / "two", "--out", tmp_path / "joined") == 0
    whole = read_tum(tmp_path / "joined" / "trajectory.tum")
    one, two = (read_tum(maps / name / "trajectory.tum") for name in ("one", "two"))
    assert whole.stamps.tolist() == [*one.stamps, *two.stamps[1:]]
    truth = read_true_poses(open_log(WORLD)).poses
    # From the middle of the first lap to that of the second.
    a, b = len(one.stamps) // 2, len(one.stamps) + len(two.stamps) // 2
    error = se2.between(se2.between(truth[a], truth[b]), se2.between(whole.poses[a], whole.poses[b]))
    assert abs(error[0]) < 0.2 and abs(error[1]) < 0.2
    assert merge(maps / "one", maps / "elsewhere", "--out", tmp_path / "apart") == 0
    assert not (tmp_path / "apart" / "trajectory.tum").exists()


def merge(*arguments):
    return main(["merge", *map(str, arguments)])


def test_maps_are_joined_where_they_show_the_same_ground(maps, tmp_path, capsys):
    out = tmp_path / "out"
    assert merge(maps / "one", maps / "two" / "hmt_map", maps / "elsewhere", "--out", out) == 0
    joined, apart = capsys.readouterr().out.splitlines()
    found = re.fullmatch(r"two joins one with probability ([01]\.\d{3}), by \d+ places; apart has 0\.00\d", joined)
    assert found and float(found[1]) >= 0.99
    assert apart.startswith("elsewhere and one + two stay apart")
    assert {"map.pgm", "map.yaml", "map.png", "topology.graphml", "merge.json", "team.png", "hmt_map"} <= {
        path.name for path in out.iterdir()
    }
    saved = read_saved_map(out / "hmt_map")
    pieces = map_pieces(saved.replica.maps[0])
    assert len(pieces) == 2 and saved.area_poses.keys() == {area for piece in pieces for area in piece}
    parts = [read_saved_map(maps / name / "hmt_map") for name in ("one", "two", "elsewhere")]
    assert len(saved.replica.scans) == sum(len(part.replica.scans) for part in parts)
    assert saved.relative_trajectory.keyframes.size == sum(p.relative_trajectory.keyframes.size for p in parts)
    # How often scans contradict a map is known where a run made it.
    assert 0.0 < read_clutter(maps / "one" / "hmt_map").beam_outlier_rate < 0.01
    assert read_clutter(out / "hmt_map") == NO_CLUTTER
    report = json.loads((out / "merge.json").read_text())
    assert [met["verdict"] for met in report["meetings"]] == ["joined", "apart"]
    first = report["meetings"][0]
    assert first["placements"][0]["probability"] + first["apart"] == pytest.approx(1.0, abs=0.01)
    assert len(first["placements"][0]["agreeing"]) > 3


@pytest.mark.long
def test_a_merged_map_is_one_map_of_the_next_merge(maps, tmp_path, capsys):
    out = tmp_path / "out"
    assert merge(maps / "one", maps / "two", "--out", out) == 0
    first = read_map(out).pixels.tobytes()
    assert merge(maps / "one", maps / "two", "--out", out) == 0
    assert read_map(out).pixels.tobytes() == first
    assert merge(out, maps / "elsewhere", "--out", tmp_path / "more") == 0
    assert "stay apart" in capsys.readouterr().out.splitlines()[-1]


def fault(capsys, *arguments):
    capsys.readouterr()
    assert merge(*arguments) == FAULT
    return capsys.readouterr().err


def test_one_map_alone_is_refused(maps, tmp_path, capsys):
    assert "merge joins two maps or more" in fault(capsys, maps / "one", "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_map_that_is_given_twice_is_refused(maps, tmp_path, capsys):
    assert "leave it out" in fault(capsys, maps / "one", maps / "one", "--out", tmp_path / "out")


def test_maps_of_other_cells_are_refused(maps, tmp_path, capsys):
    assert "local_map.cell" in FIXED_PARAMETERS
    map_part(WORLD, tmp_path / "coarse", 0.5, 0.1, "--set", "local_map.cell=0.08")
    error = fault(capsys, maps / "one", tmp_path / "coarse", "--out", tmp_path / "out")
    assert "local_map.cell = 0.05, and coarse with 0.08: map one of them again" in error


def test_a_map_of_another_version_is_refused(maps, tmp_path, capsys):
    shutil.copytree(maps / "two", tmp_path / "two")
    manifest = tmp_path / "two" / "hmt_map" / "manifest.json"
    manifest.write_text(manifest.read_text().replace(f'"version": {VERSION}', '"version": 3'))
    assert "map the log again" in fault(capsys, maps / "one", tmp_path / "two", "--out", tmp_path / "out")


def test_programs_that_merge_grids_are_judged_by_the_true_poses(maps, tmp_path):
    truth = read_true_poses(open_log(WORLD))
    one, two = (MappedHalf("office", name, maps / name, truth) for name in ("one", "two"))
    # The frame of each map in that of the truth, by its first pose.
    paths = [read_tum(half.folder / "trajectory.tum") for half in (one, two)]
    starts = [truth.poses[truth.nearest_indices(path.stamps[:1])[0]] for path in paths]
    x, y, yaw = se2.between(*map(se2.compose, starts, [se2.inverse(path.poses[0]) for path in paths]))
    programs = {name: tmp_path / name for name in ("exact", "moved")}
    for path, shift in zip(programs.values(), (0.0, 1.2), strict=True):
        path.write_text(f'#!/bin/sh\n[ -f "$1" ] && [ -f "$2" ] && echo {x + shift} {y} {yaw} 1.5\n')
        path.chmod(0o755)
    found = merge_halves(Configuration(), one, two, programs)
    assert (found.outcome, found.is_due) == ("right", True)
    assert {each.program: each.outcome for each in found.programs} == {"exact": "right", "moved": "wrong"}
