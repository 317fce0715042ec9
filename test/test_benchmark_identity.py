"""The oracle of identical bytes: a bit that differs is seen, and each kind of run is in the set."""

import json

import pytest

from benchmark.identity import EXPECTED, RUNS, differences, digests_of, read_expected, write_expected
from hmt_slam_ros.errors import HmtSlamError

DIGESTS = {"office": {"trajectory": "a1", "map": "b2"}, "continued": {"trajectory": "c3"}}

FILES = {
    "trajectory.tum": "1.0 0.5 0.25 0 0 0 0 1\n",
    "trajectory_online.tum": "1.0 0.5 0.25 0 0 0 0 1\n",
    "pmf.csv": "a,b,c,d,e,f,g,h,i,j,k\n0,1000,0.5,0,0,0.75,0,1,0,1,0.25\n",
    "graph.g2o": "VERTEX_SE2 0 0 0 0\n",
    "map.pgm": "P5 1 1 255 0",
    "report.json": json.dumps({"keyframes": 1, "areas": 1, "arcs": 0, "loop_closures": 0, "wall_s": 1.5}),
}


def folder_of(folder, changed=None):
    for name, content in (FILES | (changed or {})).items():
        (folder / name).write_text(content)
    return folder


def test_what_is_recorded_is_read(tmp_path):
    write_expected(tmp_path / "identity.toml", DIGESTS, "this machine")
    assert read_expected(tmp_path / "identity.toml") == (DIGESTS, "this machine")


def test_digests_that_differ_are_counted_and_fail():
    other = {"office": {"trajectory": "a1", "map": "b3"}, "continued": {"trajectory": "c3"}}
    assert [(one.value, one.is_met) for one in differences(other, DIGESTS)] == [(1, False), (0, True)]


def test_a_run_of_which_nothing_is_recorded_fails():
    assert not differences({"new": {"map": "b2"}}, DIGESTS)[0].is_met


@pytest.mark.parametrize(
    ("file", "content", "differs"),
    [
        ("trajectory.tum", "1.0 0.50000001 0.25 0 0 0 0 1\n", {"trajectory"}),
        ("trajectory_online.tum", "", {"online"}),
        ("pmf.csv", "a,b,c,d,e,f,g,h,i,j,k\n0,1000,0.5,0,0,0.7500001,0,1,0,1,0.25\n", {"probabilities"}),
        ("pmf.csv", "a,b,c,d,e,f,g,h,i,j,k\n0,1000,0.5,0,0,0.75,0,1,1,1,0.25\n", {"probabilities", "closures"}),
        ("pmf.csv", "other,b,c,d,e,f,g,h,i,j,k\n0,1000,0.5,0,0,0.75,0,1,0,1,0.25\n", set()),
        ("graph.g2o", "VERTEX_SE2 0 0 0 1e-9\n", {"graph"}),
        ("map.pgm", "P5 1 1 255 1", {"map"}),
        ("report.json", FILES["report.json"].replace("1.5", "2.5"), set()),
    ],
)
def test_each_part_of_a_result_has_a_digest_and_names_and_cost_have_none(tmp_path, file, content, differs):
    before = digests_of(folder_of(tmp_path))
    after = digests_of(folder_of(tmp_path, {file: content}))
    assert {what for what in before if before[what] != after[what]} == differs


def test_something_is_recorded_of_every_run():
    assert set(read_expected(EXPECTED)[0]) == {*RUNS, "explorer", "pilot"}


def test_maps_are_made_before_others_go_on_from_them():
    names = list(RUNS)
    assert all(names.index(one.source) < names.index(name) for name, one in RUNS.items() if one.source)


def test_without_a_record_it_says_how_to_make_one(tmp_path):
    with pytest.raises(HmtSlamError, match="--write-expected"):
        read_expected(tmp_path / "identity.toml")
