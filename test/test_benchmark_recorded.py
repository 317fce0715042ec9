"""Reliability on recorded logs: what judges closures, where robots are put down, and the measurement on a small log."""

import json
import math
from itertools import pairwise

import numpy as np
import pytest

import benchmark.recorded_outcomes
from benchmark.__main__ import main
from benchmark.accepted_closures import NOTHING, RELATIONS, TRAJECTORY, DefiniteClosure, judge_closure
from benchmark.awakening import MappedLog, scan_records
from benchmark.displacement import (
    KINDS,
    Displacement,
    Splice,
    WrongAnswer,
    displace,
    draw_splice,
    find_places,
    joined_records,
    worst_answer,
)
from benchmark.kidnapped_drive import LocalizationReport, summarize_drive
from benchmark.kidnapping import SOON
from benchmark.logs import BUNDLED
from benchmark.recorded import displacement_requirements
from benchmark.recorded_drive import POINTS, MappedDrive, map_drive, odometry_at_scans
from benchmark.relation_chains import LONGEST, RelationChains
from benchmark.report import VALIDATION, document_marks
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.evaluation import Relations
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.results.hmt_map import RunState
from hmt_slam_ros.sensors import Odometry, Scan

SECOND = 10**9
OFFICE = "sim:office,seed=3,size=0.7"


def line(count, step=0.5):
    """Poses along the x axis."""
    return np.stack([step * np.arange(count), np.zeros(count), np.zeros(count)], axis=1)


def relations_between(poses, *pairs):
    """True relations of scans that are a second apart."""
    starts, ends = np.array(pairs).T
    return Relations(starts * SECOND, ends * SECOND, se2.between(poses[starts], poses[ends]))


def stamps(count):
    return SECOND * np.arange(count, dtype=np.int64)


class TestRelationChains:
    def test_a_chain_gives_the_true_pose_although_the_trajectory_is_bent(self):
        true, bent = line(30, step=0.2), line(30, step=0.2)
        bent[15:, 1] += 3.0
        chains = RelationChains(relations_between(true, *pairwise(range(0, 30, 3))), stamps(30), bent)
        found = chains.nearest_pair([0, 3], [24, 27])
        assert found.scans == (3, 24)
        np.testing.assert_allclose(found.pose, [4.2, 0.0, 0.0], atol=1e-9)

    def test_scans_between_relations_join_the_next_one_by_the_trajectory(self):
        true = line(30, step=0.2)
        chains = RelationChains(relations_between(true, (2, 8)), stamps(30), true)
        np.testing.assert_allclose(chains.nearest_pair([0], [10]).pose, [2.0, 0.0, 0.0], atol=1e-9)
        assert chains.nearest_pair([0], [20]) is None  # 2.4 m from the last relation

    def test_a_chain_ends_where_it_is_too_long_and_where_relations_are_missing(self):
        true = line(100)
        links = list(pairwise(range(0, 100, 2)))
        chains = RelationChains(relations_between(true, *links), stamps(100), true)
        assert chains.nearest_pair([0], [8]) is not None
        assert chains.nearest_pair([0], [2 * int(LONGEST) + 2]) is None
        parted = RelationChains(relations_between(true, *links[:2], *links[7:]), stamps(100), true)
        assert chains.nearest_pair([6], [14]) is not None
        assert parted.nearest_pair([6], [14]) is None

    def test_relations_without_a_scan_at_their_time_are_left_out(self):
        true = line(10)
        relations = relations_between(true, (0, 8))
        late = Relations(relations.starts + SECOND // 2, relations.ends, relations.poses)
        assert RelationChains(late, stamps(10), true).nearest_pair([0], [9]) is None


def closure_between(placement, covariance=1e-4):
    """A closure of scan 0, at the origin of the known area, and of scan 9, at the origin of the other one."""
    belief = PoseGaussian(np.array(placement), covariance * np.eye(3))
    return DefiniteClosure(7, 9 * SECOND, 0.99, (1, 2), belief, {0: np.zeros(3)}, {9 * SECOND: belief.mean})


TRUE = line(10, step=0.2)
NUMBERS = {int(stamp): n for n, stamp in enumerate(stamps(10))}


class TestClosures:
    def judge(self, placement, relations=True, trajectory=None, **options):
        chains = RelationChains(relations_between(TRUE, (0, 9)), stamps(10), TRUE) if relations else None
        trajectory = TRUE if trajectory is None else trajectory
        return judge_closure(closure_between(placement, **options), NUMBERS, chains, trajectory)

    def test_relations_judge_even_if_the_trajectory_contains_a_false_closure(self):
        bent = line(10, step=0.1)
        assert self.judge([1.8, 0.0, 0.0], trajectory=bent)["right"]
        found = self.judge([0.9, 0.0, 0.0], trajectory=bent)
        assert (found["right"], found["by"], found["scan"]) == (False, RELATIONS, 9)
        assert found["translation"] == pytest.approx(0.9)

    def test_the_trajectory_judges_where_no_chain_does(self):
        found = self.judge([1.8, 0.0, 0.0], relations=False)
        assert (found["right"], found["by"]) == (True, TRAJECTORY)

    def test_an_uncertain_closure_may_be_farther_off(self):
        assert self.judge([0.9, 0.0, 0.0], covariance=1.0)["right"]
        assert not self.judge([1.8, 0.0, math.radians(11.0)], covariance=1.0)["right"]

    def test_nothing_judges_a_closure_without_keyframes(self):
        closure = DefiniteClosure(7, 0, 0.99, (1, 2), PoseGaussian.from_pose(np.zeros(3)), {}, {0: np.zeros(3)})
        assert judge_closure(closure, NUMBERS, None, TRUE)["by"] == NOTHING


class TestPlaces:
    # 30 m out, 30 m back, and 30 m on into new ground.
    TRUTH = np.concatenate((line(60), line(60)[::-1], -line(60)))

    def test_a_displaced_robot_is_on_known_or_on_new_ground(self):
        found = find_places(self.TRUTH, 50)
        before, again, new = (np.flatnonzero(found[kind]) for kind in KINDS)
        assert before.max() == 44  # 3 m away
        assert set(again) <= set(range(75, 120))  # after it turned at 30 m, and is 3 m away from 25 m again
        assert again.max() < 106  # for 10 m of path, of which the last 2 m may be beside it
        assert new.min() == 128
        assert new.max() < 160  # 10 m before the end

    def test_near_places_are_no_displacement(self):
        found = find_places(self.TRUTH, 50)
        away = np.abs(self.TRUTH[:, 0] - self.TRUTH[50, 0])
        assert all((away[found[kind]] >= 3.0).all() for kind in KINDS)


@pytest.fixture(scope="module")
def drive():
    """The bundled log with the odometry as truth, without maps."""
    records = list(open_log(f"data/{BUNDLED}_one_loop").records())
    truth = odometry_at_scans(records)
    whole = MappedLog(Configuration(), records, RunState(), scan_records(records), truth, ())
    states = {n: RunState() for n in range(40, 200, 20)}
    return MappedDrive(whole, (RunState(), RunState()), states, (), ())


class TestJoining:
    def test_stamps_and_odometry_go_on(self, drive):
        splice = Splice(100, 30, "before")
        joined = list(joined_records(drive, splice))
        last = drive.whole.records[drive.whole.scans[100]].measurement.stamp
        steps = [later.measurement.stamp - one.measurement.stamp for one, later in pairwise(joined)]
        assert min(steps) >= 0
        assert 0 < joined[0].measurement.stamp - last < SECOND
        assert len([one for one in joined if isinstance(one.measurement, Scan)]) == len(drive.whole.scans) - 30
        first = next(one.measurement.pose for one in joined if isinstance(one.measurement, Odometry))
        np.testing.assert_allclose(first, drive.whole.truth[100])

    def test_the_motion_after_the_splice_is_that_of_the_log(self, drive):
        poses = odometry_at_scans(list(joined_records(drive, Splice(100, 30, "before"))))
        own = drive.whole.truth[30:]
        np.testing.assert_allclose(se2.between(poses[1], poses[50]), se2.between(own[1], own[50]), atol=1e-9)

    def test_splices_of_a_number_are_the_same_and_go_round_the_states(self, drive):
        splices = [draw_splice(drive, number) for number in range(16)]
        assert splices[:4] == [draw_splice(drive, number) for number in range(4)]
        assert {splice.left for splice in splices[:8]} == set(drive.states)
        assert len({splice.kind for splice in splices}) > 1
        assert all(splice.kind != "before" or splice.joined < splice.left for splice in splices)


LOST, RIGHT, WRONG = (False, False), (True, True), (True, False)


def outcome(*states):
    reports = [LocalizationReport(float(k), *one, 0.97, 10 + k, 2.0 + k) for k, one in enumerate(states)]
    scores = summarize_drive(reports, (math.nan, math.nan), float(len(states)))
    return Displacement(Splice(5, 9, "new"), scores, worst_answer(reports, scores.noticed))


class TestScores:
    def test_a_wrong_answer_counts_after_the_detection_and_at_the_end(self):
        assert outcome(WRONG, LOST, RIGHT).wrong is None
        assert outcome(WRONG, LOST, WRONG, WRONG, RIGHT).wrong == WrongAnswer(13, 3.0, 5.0, 0.97)
        assert outcome(WRONG, WRONG).wrong.event == 11

    def test_a_document_gives_the_same_outcome(self):
        one = outcome(WRONG, LOST, WRONG)
        found = Displacement.from_document(json.loads(json.dumps(one.document)))
        assert (found.splice, found.wrong) == (one.splice, one.wrong)
        assert found.scores.localizations == one.scores.localizations

    def test_one_wrong_drive_of_hundred_is_allowed_and_five_that_are_noticed_late(self):
        right, wrong, late = outcome(LOST, RIGHT), outcome(LOST, WRONG, RIGHT), outcome(*[WRONG] * 6, RIGHT)
        assert all(one.is_met for one in displacement_requirements("aces", [wrong, *[late] * 5, *[right] * 94]))
        noticed, confident = displacement_requirements("aces", [*[wrong] * 2, *[late] * 6, *[right] * 92])
        assert not noticed.is_met
        assert not confident.is_met


@pytest.fixture(scope="module")
def office():
    """A simulated office that was mapped."""
    return map_drive(OFFICE, Configuration())


class TestMappedWorld:
    def test_its_states_are_those_after_their_scans(self, office):
        assert 15 <= len(office.states) <= POINTS
        for scan, state in office.states.items():
            assert state.log.stamps.size == scan + 1
        assert office.halves[0].log.stamps.size == len(office.whole.scans) // 2

    def test_its_trajectory_and_closures_are_right(self, office):
        scans = (one for one in open_log(OFFICE).records() if isinstance(one.measurement, Scan))
        own, true = office.whole.truth, np.array([scan.true_pose for scan in scans])
        error = se2.between(se2.between(own[0], own), se2.between(true[0], true))
        assert np.hypot(*error[:, :2].T).max() < 0.3
        assert office.closures
        assert all(judge_closure(one, office.whole.numbers, None, own)["right"] for one in office.closures)

    @pytest.mark.parametrize(("number", "kind"), [(0, "before"), (1, "again")])
    def test_a_displacement_is_noticed_and_the_robot_found(self, office, number, kind):
        found = displace(office, draw_splice(office, number))
        assert found.splice.kind == kind
        assert found.scores.noticed <= SOON
        assert found.scores.again < 10.0
        assert found.wrong is None
        # Others that start from the same state have it as it was.
        assert displace(office, draw_splice(office, number)).document == found.document


@pytest.mark.long
def test_the_bundled_log_is_measured_and_goes_on_where_it_was_interrupted(tmp_path, monkeypatch):
    options = ["recorded", "--logs", BUNDLED, "--seeds", "2", "--jobs", "1", "--runs", str(tmp_path / "runs")]
    assert main([*options, "--out", str(tmp_path / "one")]) in (0, 1)
    (file,) = (tmp_path / "runs").glob(f"recorded-{BUNDLED}-*.json")
    lines = file.read_text().splitlines()
    monkeypatch.setattr(benchmark.recorded_outcomes, "map_drive", None)  # not needed again
    assert main([*options, "--out", str(tmp_path / "two")]) in (0, 1)
    assert file.read_text().splitlines() == lines
    found = json.loads((tmp_path / "two" / "recorded.json").read_text())[BUNDLED]
    assert len(found["displacements"]) == 2
    assert {closure["by"] for closure in found["closures"]} == {TRAJECTORY}
    assert all(closure["right"] for closure in found["closures"])
    assert found == json.loads((tmp_path / "one" / "recorded.json").read_text())[BUNDLED]


def test_the_document_has_a_place_for_the_measurement():
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in document_marks("recorded"))
