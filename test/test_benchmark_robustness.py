"""Verdicts on maps of stretches with faults, the choice of stretches, and what the report says of all cases."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds import box, scan_in

from benchmark.logs import MeasuredLog
from benchmark.odometry import ClosureError
from benchmark.real_faults import faulty_run
from benchmark.real_faults.kinds import BY_NAME, KINDS
from benchmark.real_faults.stream import ListedLog
from benchmark.real_faults.stretches import RECORDED, _draw_window, draw_stretch
from benchmark.real_faults.verdict import MapVerdict, StretchTruth, judge, near_scans
from benchmark.robustness import Attempt, FaultCase, _choose, is_named, outcome_table, requirements
from benchmark.runs import Run
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.evaluation import Relations, StampedPoses, read_tum
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import uninformative_belief
from hmt_slam_ros.logs.records import LogRecord
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.trajectories import RelativeTrajectory

SOUND = MapVerdict(0.99, 1, 0.03, 0.2, 12, 0, (ClosureError((0, 1), 0.1, 1.0),))
FALSE = ClosureError((0, 2), 0.6, 1.0)
TURNED = ClosureError((0, 2), 0.1, 11.0)


@pytest.mark.parametrize(
    ("changes", "outcome"),
    [
        ({}, "right"),
        ({"closures": None}, "right"),
        ({"probability": 0.4}, "right"),
        ({"pieces": 2}, "open"),
        ({"long_error": 1.1}, "wrong"),
        ({"long_error": 1.1, "probability": 0.95}, "open"),
        ({"long_error": 1.1, "pieces": 2}, "wrong"),
        ({"closures": (FALSE,)}, "wrong"),
        ({"closures": (TURNED,)}, "wrong"),
    ],
)
def test_outcomes(changes, outcome):
    assert replace(SOUND, **changes).outcome == outcome


def three_areas():
    """Three areas, each with one keyframe: 0 and 1 are 5 m apart, nothing is known about 2."""
    hybrid_map = HybridMap()
    for area in range(3):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    hybrid_map.set_arc(0, 1, PoseGaussian(np.array([5.0, 0.0, 0.0]), 1e-4 * np.eye(3)), closure=False)
    hybrid_map.set_arc(1, 2, uninformative_belief(np.array([9.0, 0.0, 0.0])), closure=False)
    return hybrid_map


class ThreeScans:
    """The recording of three scans, one of each area, 100 s apart."""

    def __init__(self):
        scans = {k: scan_in(box(-3, -3, 8, 3), [0.0, 0.0, 0.0], stamp=k * 10**11, beams=11) for k in range(3)}
        self.records = [LogRecord(scan.stamp, scan) for scan in scans.values()]
        self.hybrid_map = three_areas()
        self.replica = Replica(scans, {0: self.hybrid_map}, {0: 0.99}, {0: 2})
        self.relative_trajectory = RelativeTrajectory(np.arange(3), np.zeros((3, 3)))
        stamps = np.array([scan.stamp for scan in scans.values()])
        self.trajectory = StampedPoses(stamps, np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [40.0, 0.0, 0.0]]))
        self.odometry = StampedPoses(stamps, np.zeros((3, 3)))

    def verdict(self, *ends, poses=None):
        """The verdict by true relations of 5.2 m between scans."""
        starts, stops = (self.trajectory.stamps[list(own)] for own in zip(*ends, strict=True))
        relations = Relations(starts, stops, np.tile([5.2, 0.0, 0.0], (len(ends), 1)))
        return judge(self, self.trajectory, self.records, StretchTruth(relations, self.odometry, poses))


def test_errors_across_two_pieces_do_not_count():
    found = ThreeScans().verdict((0, 1), (1, 2))
    assert (found.pieces, found.long_count, found.split_count) == (2, 1, 1)
    assert found.long_error == pytest.approx(0.2)
    assert found.error == pytest.approx(0.2)
    assert found.outcome == "open"


def test_a_closure_is_compared_with_the_true_poses():
    scans = ThreeScans()
    scans.hybrid_map.set_arc(1, 2, PoseGaussian(np.array([4.0, 0.0, 0.0]), 1e-4 * np.eye(3)), closure=True)
    truth = {k * 10**11: np.array([x, 0.0, 0.0]) for k, x in enumerate((0.0, 5.0, 12.0))}
    found = scans.verdict((0, 1), poses=truth)
    assert found.pieces == 1
    assert found.closures[0].areas == (1, 2)
    assert found.closures[0].translation == pytest.approx(3.0)
    assert found.outcome == "wrong"
    assert scans.verdict((0, 1)).outcome == "right"


def test_relations_need_a_scan_within_a_second_at_both_ends():
    trajectory = StampedPoses(np.array([0, 10]) * 10**9, np.zeros((2, 3)))
    starts, ends = (np.array(own) * 10**8 for own in ([0, 9, 11, 0], [100, 100, 100, 50]))
    assert near_scans(Relations(starts, ends, np.zeros((4, 3))), trajectory).tolist() == [True, True, False, False]


def test_stretches_have_loops_and_differ():
    loops = np.column_stack((np.full(20, 400.0), np.full(20, 650.0)))
    windows = {_draw_window(1300.0, loops, np.random.default_rng(seed)) for seed in range(20)}
    assert len(windows) == 20
    assert all(300.0 <= duration <= 900.0 for _, duration in windows)
    assert all(start <= 400.0 and start + duration >= 650.0 for start, duration in windows)
    assert _draw_window(280.0, loops - 400.0, np.random.default_rng(0)) == (0.0, 280.0)
    with pytest.raises(HmtSlamError, match="none has 10 true relations"):
        _draw_window(1300.0, loops[:9], np.random.default_rng(0))


def test_simulated_stretches_are_other_worlds():
    names = [str(draw_stretch("simulated", number, {}).log.path) for number in range(4)]
    assert len(set(names)) == 4
    assert "field_of_view=360" in str(draw_stretch("full-turn", 0, {}).log.path)


def test_kinds_and_stretches_are_chosen_by_name():
    kinds, sources = _choose([])
    assert (len(kinds), set(RECORDED) < set(sources)) == (17, True)
    kinds, sources = _choose(["csail", "jumps"])
    assert ([kind.name for kind in kinds], sources) == (["jumps"], ("csail",))
    kinds, _ = _choose(["aces"])
    assert not {"one-degree", "narrow-view"} & {kind.name for kind in kinds}
    with pytest.raises(HmtSlamError, match="there is no stretch or fault 'rust'"):
        _choose(["rust"])
    with pytest.raises(HmtSlamError, match="can be planted there"):
        _choose(["aces", "one-degree"])


def test_a_case_has_a_command_and_a_folder_of_its_own():
    log = MeasuredLog("csail", Path("csail.clf"), Path("csail.relations"))
    case = FaultCase(log, 3, "jumps", duration=350.0, start=50.0, reference=Path("alone"))
    words = " ".join(case.command(Path("out"))[2:])
    assert words == (
        "benchmark.real_faults.faulty_run map jumps csail.clf --out out --seed 3 --start 50.0 --duration 350.0 "
        "--relations csail.relations --reference alone"
    )
    others = [
        replace(case, task="doctor"),
        replace(case, kind="none"),
        replace(case, seed=4),
        replace(case, start=51.0),
    ]
    assert len({other.name for other in (case, *others)}) == 5


def test_the_doctor_names_what_it_does_not_say_without_the_fault():
    def finding(severity, text):
        return {"severity": severity, "subject": "odometry jumps", "text": text}

    assert is_named(("odometry jumps",), [], [finding("wrong", "once")])
    assert is_named(("odometry jumps",), [finding("wrong", "once")], [finding("wrong", "twice")])
    assert not is_named(("odometry jumps",), [finding("wrong", "once")], [finding("wrong", "once")])
    assert not is_named(("odometry jumps",), [], [finding("fine", "once")])
    assert not is_named(("clock offset",), [], [finding("wrong", "once")])


def attempts(tmp_path, *outcomes):
    """Attempts of one kind with given outcomes, of stretches that are right alone."""
    log = MeasuredLog("csail", Path("csail.clf"))
    runs = []
    for number, outcome in enumerate(("right", *outcomes)):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "verdict.json").write_text(json.dumps({"outcome": outcome, "error": 0.01 * (1 + number)}))
        runs.append(Run(FaultCase(log, number), folder, 7.0, 8.0, 9, "broken" if outcome == "failed" else ""))
    return [Attempt(KINDS[0], "csail-0", run, runs[0], number == 0) for number, run in enumerate(runs[1:])]


def test_shares_are_required_of_all_cases(tmp_path):
    right, wrong = requirements(attempts(tmp_path, *["right"] * 98, "open", "wrong"))
    assert (right.value, wrong.value) == (0.98, 0.01)
    assert right.is_met
    assert wrong.is_met


def test_a_failed_run_is_no_right_one_and_does_not_hide(tmp_path):
    right, wrong = requirements(attempts(tmp_path, "right", "failed"))
    assert (right.value, wrong.value) == (0.5, 0.0)
    assert not right.is_met


def test_the_table_counts_every_outcome_once(tmp_path):
    found = attempts(tmp_path, "right", "wrong", "open", "open", "failed")
    text = outcome_table([KINDS[0]], [replace(found[0], kind=None, run=found[0].alone, is_named=None)], found)
    rows = [[cell.strip() for cell in line.strip("| ").split("|")] for line in text.splitlines()]
    assert rows[2] == ["none", "1", "1", "1", "0", "0", "0", "0.010", "0.010", "-", "7"]
    assert rows[3] == ["frozen-in-turns", "5", "1", "5", "1", "2", "1", "0.035", "0.010", "1 of 5", "35"]
    assert rows[4][0] == "**all**"


def test_a_stretch_is_mapped_judged_and_examined(tmp_path):
    """Real runs of 40 s of a simulated drive."""
    world = ["sim:office,seed=1,size=0.7,beams=181", "--duration", "40", "--seed", "1"]
    for task, kind in (("map", "none"), ("map", "jumps"), ("doctor", "jumps")):
        assert faulty_run.main([task, kind, *world, "--out", str(tmp_path / f"{task}-{kind}")]) == 0
    alone, jumps = (json.loads((tmp_path / f"map-{kind}" / "verdict.json").read_text()) for kind in ("none", "jumps"))
    assert (alone["outcome"], alone["places"], alone["pieces"]) == ("right", [], 1)
    assert 0.0 < alone["error"] < 0.1
    assert len(jumps["places"]) >= 1
    assert len(read_tum(tmp_path / "map-jumps" / "trajectory.tum").stamps) == 201
    assert (tmp_path / "map-jumps" / "pmf.csv").is_file()
    assert json.loads((tmp_path / "map-jumps" / "report.json").read_text())["seed"] == 1
    findings = json.loads((tmp_path / "doctor-jumps" / "findings.json").read_text())
    assert any(one["subject"] in BY_NAME["jumps"].subjects for one in findings["findings"])
    assert findings["places"] == jumps["places"]


def test_a_bag_of_a_stretch_has_the_fault_in_its_stamps(tmp_path):
    world = ["sim:office,seed=1,size=0.7,beams=31,rate=2", "--duration", "60", "--seed", "1"]
    assert faulty_run.main(["bag", "gap-at-rest", *world, "--out", str(tmp_path)]) == 0
    stamps = [record.measurement.stamp for record in open_log(tmp_path / "bag").records()]
    (gap,) = faulty_run.plant("gap-at-rest", make_listed_log(world[0]), 1).places
    assert (stamps[-1] - stamps[0]) * 1e-9 == pytest.approx(60.0 + gap.seconds, abs=0.3)


def make_listed_log(name):
    log = open_log(name, duration=60.0)
    return ListedLog(log.name, list(log.records()))


def test_a_stretch_that_cannot_be_read_is_refused(tmp_path, capsys):
    assert faulty_run.main(["map", "jumps", str(tmp_path / "none.clf"), "--out", str(tmp_path)]) == 2
    assert "none.clf" in capsys.readouterr().err
