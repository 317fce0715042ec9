"""External programs beside ``benchmark merge``: their protocol, and joins by one pose, right or wrong."""

import math
import os
import sys

import numpy as np
import pytest

from benchmark import grid_programs
from benchmark.grid_programs import FAILED, VARIABLE, GridAnswer, chosen_programs, judge_answer, place_grids
from benchmark.merging import Merged, merge_table, program_table
from benchmark.placement_truth import KeyframePoses, are_right, on_common_ground, rigid_errors
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2

FIRST_T_SECOND = np.array([3.0, -2.0, 1.0])


@pytest.fixture
def program(tmp_path):
    """Makes a program of a few lines of Python, with the paths of both maps in ``maps``."""

    def make(lines, name="stand_in"):
        path = tmp_path / name
        path.write_text(f"#!{sys.executable}\nimport sys, time\nmaps = sys.argv[1:]\n{lines}\n")
        path.chmod(0o755)
        return path

    return make


def place(path, tmp_path):
    return place_grids(path, tmp_path / "one", tmp_path / "two")


def drive(start, end, map_T_truth):
    """Keyframes along a straight line, 0.5 m apart, in a map whose frame is somewhere."""
    along = np.arange(start, end, 0.5)
    true = np.stack([along, np.zeros(len(along)), np.zeros(len(along))], axis=1)
    return KeyframePoses(se2.compose(np.array(map_T_truth), true), true)


class TestProtocol:
    def test_a_pose_is_read_and_the_program_gets_both_maps(self, program, tmp_path):
        lines = "assert [m.split('/')[-2:] for m in maps] == [['one', 'map.yaml'], ['two', 'map.yaml']]"
        answer = place(program(f"{lines}\nprint('1.5 -2 0.25 1.7')"), tmp_path)
        assert answer == GridAnswer((1.5, -2.0, 0.25), 1.7)

    def test_none_is_an_answer(self, program, tmp_path):
        answer = place(program("print('none')"), tmp_path)
        assert answer.pose is None and not answer.fault

    @pytest.mark.parametrize(
        ("lines", "message"),
        [
            ("sys.exit('no features in two')", "stand_in ended with 1, and its errors with: no features in two"),
            ("print('1.5 -2 here 1.7')", "instead of 'x y yaw confidence' or 'none'"),
            ("print('1.5 -2')", "stand_in printed '1.5 -2"),
            ("print('nan nan nan 1')", "stand_in printed 'nan nan nan 1"),
            ("", "stand_in printed ''"),
            ("sys.stdout.buffer.write(bytes(range(256)))", "stand_in printed"),
        ],
    )
    def test_a_failure_and_nonsense_are_no_answer(self, program, tmp_path, lines, message):
        answer = place(program(lines), tmp_path)
        assert message in answer.fault
        assert judge_answer("stand_in", answer, None).outcome == FAILED

    def test_a_program_that_hangs_is_ended(self, program, tmp_path, monkeypatch):
        monkeypatch.setattr(grid_programs, "TIMEOUT", 0.2)
        assert place(program("time.sleep(60)"), tmp_path).fault == "stand_in took more than 0.2 s"

    def test_what_is_no_program_does_not_start(self, tmp_path):
        path = tmp_path / "text"
        path.write_text("1 2 3 4")
        path.chmod(0o755)
        assert "text did not start" in place(path, tmp_path).fault


class TestVariable:
    def test_without_it_there_is_no_program(self, monkeypatch):
        monkeypatch.delenv(VARIABLE, raising=False)
        assert not chosen_programs()

    def test_it_names_programs_as_path_does(self, program, monkeypatch):
        paths = program("", "one"), program("", "other")
        monkeypatch.setenv(VARIABLE, os.pathsep.join(map(str, paths)))
        assert chosen_programs() == {"one": paths[0], "other": paths[1]}

    def test_what_cannot_be_run_is_refused_before_any_map_is_made(self, program, monkeypatch, tmp_path):
        (tmp_path / "plain").write_text("none")
        for path in (tmp_path / "plain", tmp_path / "absent", tmp_path):
            monkeypatch.setenv(VARIABLE, str(path))
            with pytest.raises(HmtSlamError, match=f"names {path}, which cannot be run: build it, or unset"):
                chosen_programs()
        (tmp_path / "more").mkdir()
        monkeypatch.setenv(VARIABLE, f"{program('')}:{program('', 'more/stand_in')}")
        with pytest.raises(HmtSlamError, match="two programs with the same file name: rename one"):
            chosen_programs()


class TestJudgement:
    first = drive(0.0, 20.0, (5.0, 1.0, 0.5))
    second = drive(10.0, 60.0, se2.compose(se2.inverse(FIRST_T_SECOND), np.array([5.0, 1.0, 0.5])))

    def judge(self, *error, poses=None):
        """The outcome of the true pose, turned and moved about the place where the robot was first in both maps."""
        seen = self.first.in_map[20]
        moved = se2.compose(se2.compose(seen, np.array(error)), se2.inverse(seen))
        pose = se2.compose(moved, FIRST_T_SECOND)
        return judge_answer("any", GridAnswer(tuple(pose), 1.2), poses or (self.first, self.second)).outcome

    def test_the_true_pose_has_no_error(self):
        errors = rigid_errors(FIRST_T_SECOND, self.first, self.second)
        # From 10 m to 21.5 m: what is 2 m behind the end of the first is common ground.
        assert errors.shape == (24, 2)
        assert errors[:20] == pytest.approx(0.0)

    @pytest.mark.parametrize(
        ("error", "outcome"),
        [
            ((0.0, 0.0, 0.0), "right"),
            ((0.9, 0.0, 0.0), "right"),
            ((0.0, -1.1, 0.0), "wrong"),
            ((0.0, 0.0, math.radians(4.0)), "right"),
            ((0.0, 0.0, math.radians(16.0)), "wrong"),
            ((0.0, 0.0, math.pi), "wrong"),
        ],
    )
    def test_a_meter_and_fifteen_degrees_are_right(self, error, outcome):
        assert self.judge(*error) == outcome

    def test_drift_off_the_common_ground_does_not_count(self):
        bent = self.second.in_map.copy()
        bent[30:, 1] += 9.0
        assert self.judge(0.0, 0.0, 0.0, poses=(self.first, KeyframePoses(bent, self.second.true))) == "right"

    def test_without_common_ground_the_nearest_keyframes_count(self):
        away = drive(30.0, 60.0, se2.compose(se2.inverse(FIRST_T_SECOND), np.array([5.0, 1.0, 0.5])))
        assert not on_common_ground(self.first.true, away.true).any()
        assert len(rigid_errors(FIRST_T_SECOND, self.first, away)) == 1
        assert are_right(rigid_errors(FIRST_T_SECOND, self.first, away))

    def test_any_join_of_two_buildings_is_wrong(self):
        assert judge_answer("any", GridAnswer((0.0, 0.0, 0.0), 9.0), None).outcome == "wrong"
        assert judge_answer("any", GridAnswer(), None).outcome == "none"


def make_merged(family, verdict, *outcomes, is_foreign=False, is_right=True, overlap=20.0):
    answers = {"failed": GridAnswer(fault="it failed"), "none": GridAnswer()}
    programs = tuple(
        grid_programs.ProgramOutcome(f"program {n}", outcome, answers.get(outcome, GridAnswer((0.0, 0.0, 0.0), 1.0)))
        for n, outcome in enumerate(outcomes)
    )
    return Merged(
        family, "pair", is_foreign, 0.5, overlap, verdict, 0.9, 0.1, is_right and not is_foreign, 9, 7, 0.1, programs
    )


def test_the_tables():
    found = [
        make_merged("office", "joined", "right", "none"),
        make_merged("office", "joined", "wrong", "right", is_right=False, overlap=9.0),
        make_merged("office", "open", "none", "failed"),
        make_merged("hall", "apart", "right", "right"),
        make_merged("office", "joined", "wrong", "none", is_foreign=True, overlap=0.0),
    ]
    table = program_table(found, ["akaze", "orb"])
    assert "akaze: right, wrong, none, failed | orb: right, wrong, none, failed |" in table
    assert "| office | 3 | 2 | 1, 1, 1 | 1, 1, 1, 0 | 1, 0, 1, 1 |" in table
    assert "| hall | 1 | 1 | 0, 0, 1 | 1, 0, 0, 0 | 1, 0, 0, 0 |" in table
    assert "| foreign | 1 | 0 | 0, 1, 0 | 0, 1, 0, 0 | 0, 0, 1, 0 |" in table
    assert "| office | 3 | 50 % | 1 | 1 | 1 | 0 | 0 | 2 |" in merge_table(found)
