"""The commands ``map --team`` and ``replay --team``."""

import json
import re

import pytest

from hmt_slam_ros.cli.main import main
from hmt_slam_ros.hybrid_map.hybrid_map import has_foreign_keyframes
from hmt_slam_ros.results.hmt_map import read_saved_map

FIRST = "sim:office,size=0.7,seed=51,laps=1"
SECOND = "sim:office,size=0.7,seed=51,laps=1,visit=1"
ROBOTS = ("robot_1", "robot_2")


def run_map(*arguments):
    return main(["map", *map(str, arguments)])


@pytest.mark.long
def test_robots_of_one_building_have_one_map_and_each_its_own(tmp_path, capsys):
    out = tmp_path / "out"
    words = ("--seed", "50", "--duration", "110", "--set", "team.uses_ground=true")
    assert run_map(FIRST, SECOND, "--team", *words, "--out", out) == 0
    printed = capsys.readouterr()
    assert re.search(r"robot_2 in the map of robot_1: joined, probability 0\.99\d", printed.err)
    assert re.search(r"robot_2 joins robot_1 with probability \d\.\d{3}, by \d+ places", printed.out)
    report = json.loads((out / "merge.json").read_text())
    assert [len(piece["components"]) for piece in report["pieces"]] == [2]
    assert any(has_foreign_keyframes(read_saved_map(out / robot / "hmt_map").replica.scans) for robot in ROBOTS)
    assert sum(each["keyframes"] for each in report["maps"]) == len(read_saved_map(out / "hmt_map").replica.scans)
    for robot in ROBOTS:
        assert {"hmt_map", "map.png", "report.json", "trajectory.tum"} <= {
            each.name for each in (out / robot).iterdir()
        }
        assert main(["plot", str(out / robot)]) == 0
    assert {"hmt_map", "map.png", "topology.graphml"} <= {each.name for each in out.iterdir()}
    # The team goes on, to the ends of the logs; ground that the robots have is not taken again.
    assert run_map(FIRST, SECOND, "--team", "--from", out, "--duration", "0", "--out", tmp_path / "further") == 0
    assert "joined" in capsys.readouterr().err
    for robot in ROBOTS:
        before, after = (read_saved_map(each / robot / "hmt_map").replica.scans for each in (out, tmp_path / "further"))
        assert len(after) > len(before)
        stamps = [scan.stamp for keyframe, scan in after.items() if has_foreign_keyframes([keyframe])]
        assert len(stamps) == len(set(stamps))
    # An old result is replaced.
    assert run_map(FIRST, SECOND, "--team", "--duration", "10", "--out", out) == 0


@pytest.mark.long
def test_nodes_of_two_robots_replay_their_logs_at_once(tmp_path, capsys):
    pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")
    out = tmp_path / "out"
    words = (FIRST, SECOND, "--team", "--duration", "12", "--set", "robot.rate=0", "--out", out)
    assert main(["replay", *map(str, words)]) == 0
    printed = capsys.readouterr().out
    assert len(re.findall(r"robot_[12]: 61 of 61 scans, 0 dropped", printed)) == 2
    assert re.search("robot_2 (joins|and) robot_1 ", printed)
    assert [each["name"] for each in json.loads((out / "merge.json").read_text())["maps"]] == list(ROBOTS)
    for robot in ROBOTS:
        assert json.loads((out / robot / "report.json").read_text())["runtime"] == "nodes"


def test_a_replay_of_several_logs_is_of_a_team(tmp_path, capsys):
    assert main(["replay", FIRST, SECOND, "--out", str(tmp_path / "out")]) == 2
    assert "replay takes one log, and 2 are given: give one, or --team" in capsys.readouterr().err
    assert main(["replay", FIRST, "--team", "--out", str(tmp_path / "out")]) == 2
    assert "--team maps several logs at once, and one is given" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((FIRST, "--team"), "--team maps several logs at once, and one is given: name another one"),
        ((FIRST, SECOND), "map takes one log, and 2 are given: give one, or --team"),
        ((FIRST, SECOND, "--team", "--mode", "lifelong"), "--team maps: leave out --mode"),
        ((FIRST, SECOND, "--team", "--from", "nowhere"), "nowhere has no results of a team, and 2 logs are given"),
        ((FIRST, FIRST, "--team", "--duration", "20"), "all scans of robot_2 are in robot_1, too: leave it out"),
    ],
)
def test_faults_are_named(arguments, complaint, tmp_path, capsys):
    assert run_map(*arguments, "--out", tmp_path / "out") == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
