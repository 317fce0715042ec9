"""Robots that map at once and share their maps: lock-step runs of simulated drives."""

from copy import deepcopy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hmt_slam_ros.configuration import Configuration, with_changes
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.pose_graph import consistent_poses
from hmt_slam_ros.hybrid_map.shortest_path import map_pieces
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.team import (
    MAX_ROBOTS,
    NO_REPETITION,
    JoinedGround,
    Repetition,
    TeamPlacement,
    TeamRequest,
    TeamStatus,
    TeamUpdate,
    Verdict,
)
from hmt_slam_ros.offline.run import run_log
from hmt_slam_ros.offline.team_run import TeamRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.registration.consistency import NO_CLUTTER
from hmt_slam_ros.team import shared_map
from hmt_slam_ros.team import team as team_module
from hmt_slam_ros.team.join_state import JoinState
from hmt_slam_ros.team.shared_map import ForeignMapState
from hmt_slam_ros.team.team import Team, TeamState

CONFIGURATION = Configuration(seed=50)
OFFICE, OTHER = "sim:office,size=0.7,seed=51", "sim:office,size=0.7,seed=50"


def halves(world, names, share=1.0):
    """{name: log} of the two laps of a drive, or of a share of each."""
    lap = 0.5 * open_log(world).duration
    return {name: open_log(world, start=lap * n, duration=share * lap) for n, name in enumerate(names)}


@cache
def office_run():
    """Two robots in one office: the run, its results and placements."""
    placements = []
    run = TeamRun(
        CONFIGURATION, halves(OFFICE, ("ann", "bob")), lambda seconds, each: placements.append((seconds, each))
    )
    return run, run.run(), placements


def test_two_robots_in_one_building_are_joined_while_they_drive():
    _, results, placements = office_run()
    duration = open_log(OFFICE).duration / 2
    for robot in ("ann", "bob"):
        own = [(seconds, each) for seconds, each in placements if each.robot == robot]
        joined = next(seconds for seconds, each in own if each.verdict is Verdict.JOINED)
        assert joined < 0.75 * duration
        assert own[-1][1].verdict is Verdict.JOINED and own[-1][1].probability > 0.99
    assert all(result.recorder.earlier_record is not None for result in results.values())


def test_both_robots_find_the_same():
    run, _, placements = office_run()
    last = {each.robot: each for _, each in placements}
    assert (last["ann"].first, last["ann"].second) == (last["bob"].first, last["bob"].second) == ("ann", "bob")
    # Updates come at other times, so that numbers differ by rounding. Answers are sent where a third digit changes.
    one, other = (run.teams[a].meetings[b].distribution for a, b in (("ann", "bob"), ("bob", "ann")))
    assert one.apart == pytest.approx(other.apart, rel=0.2)
    assert last["ann"].probability == pytest.approx(last["bob"].probability, abs=0.001)
    np.testing.assert_allclose(last["ann"].pose, last["bob"].pose, atol=1e-6)


def test_the_placement_is_that_of_the_simulation():
    _, _, placements = office_run()
    logs = halves(OFFICE, ("ann", "bob"))
    starts = [
        log.true_poses(np.array([next(r for r in log.records() if r.true_pose is not None).measurement.stamp]))[0]
        for log in logs.values()
    ]
    error = se2.between(se2.between(*starts), placements[-1][1].pose)
    # A placement is right within 1 m and 15 degrees; the arcs of both robots drift on the way to their first areas.
    assert np.hypot(*error[:2]) < 1.0
    assert abs(error[2]) < np.radians(3.0)


def test_robots_of_two_buildings_stay_apart():
    placements = []
    logs = {"ann": halves(OFFICE, ("ann", "-"))["ann"], "bob": halves(OTHER, ("-", "bob"))["bob"]}
    TeamRun(CONFIGURATION, logs, lambda _, each: placements.append(each)).run()
    assert {each.verdict for each in placements} <= {Verdict.APART, Verdict.OPEN}


def test_robots_among_people_are_joined():
    """Contradictions of people who walked past either count as usual ones: the right placement had 0.0001."""
    placements = []
    world = "sim:busy,size=0.7,seed=0"
    TeamRun(CONFIGURATION, halves(world, ("ann", "bob"), 0.6), lambda _, each: placements.append(each)).run()
    assert placements[-1].probability > 0.9


def test_a_run_in_a_team_maps_as_a_run_alone_does():
    _, results, _ = office_run()
    alone = run_log(halves(OFFICE, ("ann", "bob"))["bob"], CONFIGURATION)
    one, other = (each.recorder.finish(*_progress(each)) for each in (results["bob"], alone))
    np.testing.assert_array_equal(one.trajectory, other.trajectory)


def _progress(result):
    progress = result.log_progress
    return progress.stamps, progress.first_scans, progress.earlier_trajectory


def test_three_robots_join_in_pairs():
    placements = []
    logs = halves(OFFICE, ("ann", "bob"), 0.6) | {"cid": halves(OFFICE, ("cid", "-"), 0.6)["cid"]}
    sent = []
    run = TeamRun(CONFIGURATION, logs, lambda _, each: placements.append(each), lambda _, each: sent.append(each))
    run.run()
    # Each version goes to both others at once, and no message is lost.
    updates = [(each.robot, each.after) for each in sent if isinstance(each, TeamUpdate)]
    assert len(updates) == len(set(updates)) > 10
    for name, team in run.teams.items():
        assert {other: met.verdict for other, met in team.meetings.items()} == dict.fromkeys(
            logs.keys() - {name}, Verdict.JOINED
        )


class Network:
    """Two teams whose robots have driven; messages pass as a test has it."""

    def __init__(self):
        run, _, _ = office_run()
        self.ann = run.teams["ann"]
        self.new = Team(CONFIGURATION, TeamState("zoe", "s"))

    def pass_messages(self, lost=0.0, repeated=1, seed=0):
        """Let Ann say her status until Zoe has all, and return the number of statuses."""
        random = np.random.default_rng(seed)
        for count in range(1, 1000):
            waiting = [(self.new, self.ann.status)]
            while waiting:
                receiver, message = waiting.pop(0)
                if random.random() < lost:
                    continue
                for _ in range(repeated):
                    answers = receiver.handle(message)
                other = self.ann if receiver is self.new else self.new
                waiting += [(other, each) for each in answers if not isinstance(each, TeamPlacement)]
            if self.new._others and self.new._others["ann"].map.version == self.ann.status.map_version:
                return count
        raise AssertionError


def component(team, name):
    return team._others[name].map.component()


def test_a_robot_that_joins_late_gets_the_whole_map():
    network = Network()
    assert network.pass_messages() == 1
    assert component(network.new, "ann").clutter == network.ann.state.shared.clutter != NO_CLUTTER
    assert set(component(network.new, "ann").scans) == set(network.ann._own.component().scans)


def test_lost_and_repeated_messages_change_nothing_in_the_end(monkeypatch):
    monkeypatch.setattr(shared_map, "UPDATE_BYTES", 20_000)
    network = Network()
    assert network.pass_messages(lost=0.3, repeated=2) > 1
    assert set(component(network.new, "ann").scans) == set(network.ann._own.component().scans)


def test_another_session_of_a_robot_is_another_map():
    network = Network()
    network.pass_messages()
    assert network.new.handle(TeamStatus("ann", "later", 3, "0", NO_REPETITION)) == [
        TeamRequest("zoe", "ann", "later", 0)
    ]
    assert not component(network.new, "ann").scans


def test_a_status_with_another_repetition_does_not_show_that_an_update_was_lost():
    team, status = Team(CONFIGURATION, TeamState("zoe", "s")), TeamStatus("ann", "s", 3, "0", NO_REPETITION)
    assert team.handle(status) == [TeamRequest("zoe", "ann", "s", 0)]
    assert team.handle(replace(status, repetition=Repetition(-0.1, 1.0))) == []
    assert team.handle(replace(status, repetition=Repetition(-0.1, 1.0))) == [TeamRequest("zoe", "ann", "s", 0)]


def test_a_map_of_another_session_is_joined_with_nothing():
    team = deepcopy(office_run()[0].teams["bob"])
    assert team.map_poses.keys() == {"ann", "bob"}
    team.handle(TeamStatus("ann", "later", 0, "0", NO_REPETITION))
    assert team.map_poses.keys() == {"bob"}


def test_a_search_ends_though_keyframes_were_pruned():
    bob = Team(CONFIGURATION, office_run()[0].teams["bob"].state)
    bob._pairs["ann"].keyframes = 10**6
    for _ in range(1000):
        bob.search(100, may_wait=False)
        if not bob.is_searching:
            break
    assert not bob.is_searching


def placements_of(team):
    """The placements that a process finds until its search is at the end."""
    found = []
    while team.is_searching:
        found += [each for each in team.search(100, may_wait=False) if isinstance(each, TeamPlacement)]
    return found


def test_a_robot_whose_process_ended_stays_joined():
    bob = office_run()[0].teams["bob"]
    assert bob.state.joins["ann"].is_joined
    again = Team(CONFIGURATION, bob.state)
    np.testing.assert_array_equal(again.map_poses["ann"], bob.map_poses["ann"])
    # The search is made again, and the join does not wait for more keyframes.
    assert again.is_searching
    assert {each.verdict for each in placements_of(again)} <= {Verdict.JOINED}
    assert again.state.joins["ann"].is_joined


def test_a_placement_joins_when_it_was_sure_before_the_newest_window(monkeypatch):
    """Also where the whole map of the other robot comes late, and no keyframe is added after it."""
    team = Team(CONFIGURATION, replace(office_run()[0].teams["bob"].state, joins={}, placements=()))
    assert [each.verdict for each in placements_of(team)][-1] is Verdict.JOINED
    monkeypatch.setattr(team_module, "was_sure", lambda *_: False)
    team = Team(CONFIGURATION, replace(team.state, joins={}, placements=()))
    assert {each.verdict for each in placements_of(team)} == {Verdict.OPEN}
    assert not team.state.joins["ann"].is_joined


def test_a_request_for_another_robot_or_session_is_not_answered():
    team = Team(CONFIGURATION, TeamState("ann", "s"))
    for request in (TeamRequest("zoe", "bob", "s", 0), TeamRequest("zoe", "ann", "earlier", 0)):
        assert team.handle(request) == []
    (update,) = team.handle(TeamRequest("zoe", "ann", "s", 0))
    assert isinstance(update, TeamUpdate) and update.is_complete


def test_updates_of_unknown_robots_and_the_own_status_do_nothing():
    network, team = Network(), Team(CONFIGURATION, TeamState("bob", "s"))
    (update,) = network.ann.handle(TeamRequest("eve", "ann", network.ann.status.session, 0))
    assert team.handle(update) == []
    assert team.handle(team.status) == []
    assert not team.is_searching


def test_the_number_of_robots_is_bounded():
    team = Team(CONFIGURATION, TeamState("ann", "s"))
    answers = [team.handle(TeamStatus(f"robot {n}", "s", 1, "0", NO_REPETITION)) for n in range(MAX_ROBOTS + 5)]
    assert sum(map(bool, answers)) == MAX_ROBOTS


@pytest.mark.parametrize("limit", [1, 50_000_000])
def test_the_work_of_an_event_is_bounded(monkeypatch, limit):
    """No step, update or comparison begins after so much work."""
    run, _, _ = office_run()
    spent, spend = [], team_module.SearchBudget.spend

    def count(budget, work):
        spent.append(work)
        spend(budget, work)

    monkeypatch.setattr(team_module.SearchBudget, "spend", count)
    bob, waiting = deepcopy(run.teams["bob"]), [replace(run.teams["ann"].status, robot="abe")]
    while waiting:
        for request in bob.handle(waiting.pop()):
            update = run.teams["ann"].handle(replace(request, owner="ann", robot="eve"))[0]
            waiting.append(replace(update, robot="abe"))
    assert bob.is_searching
    spent.clear()
    bob.search(limit)
    assert sum(spent[:-1]) < limit <= sum(spent)
    while bob.is_searching:
        bob.search(2 * limit)
    assert bob.meetings["abe"].verdict is Verdict.JOINED


def test_ground_of_a_joined_robot_is_known_before_the_maps_are_compared_again():
    run, _, _ = office_run()
    ann, bob = run.teams["ann"], run.teams["bob"].state
    unknown = {"ann": ForeignMapState(ann.session)}
    ground = {}
    for is_joined in (False, True):
        join = JoinState(bob.joins["ann"].pose) if is_joined else JoinState()
        state = replace(bob, others=unknown, joins={"ann": join})
        team = Team(with_changes(CONFIGURATION, {"team.uses_ground": True}), state)
        waiting, answers = [ann.status], []
        while waiting:
            for answer in team.handle(waiting.pop()):
                answers.append(answer)
                if isinstance(answer, TeamRequest):
                    waiting += ann.handle(replace(answer, robot="eve"))
        assert team.meetings == {}
        ground[is_joined] = [each for each in answers if isinstance(each, JoinedGround)]
    assert ground[False] == []
    shared = {area.area for update in ground[True] for area in update.areas}
    assert shared == {area.area for area in ann.state.shared.areas}


def errors(recording, truth):
    """Distances of the trajectory from the truth, m, where both are aligned at the keyframes' center."""
    rotation, mean, center = _rigid_fit(recording.trajectory[:, :2], truth[:, :2])
    return np.hypot(*((recording.trajectory[:, :2] - mean) @ rotation.T + center - truth[:, :2]).T)


def _rigid_fit(points, others):
    mean, center = points.mean(axis=0), others.mean(axis=0)
    u, _, v = np.linalg.svd((points - mean).T @ (others - center))
    return v.T @ np.diag([1.0, np.linalg.det(v.T @ u.T)]) @ u.T, mean, center


@pytest.mark.long
def test_a_robot_goes_on_in_the_ground_of_another_one():
    """Each drives a good lap, from opposite sides. It stores fewer keyframes, and its map is as accurate as alone."""
    world = "sim:office,seed=51,laps=4,people=0"
    lap = 0.25 * open_log(world).duration
    begins = (("ann", 0.0), ("bob", 0.5))
    logs = {name: open_log(world, start=begin * lap, duration=1.1 * lap) for name, begin in begins}
    run = TeamRun(with_changes(CONFIGURATION, {"team.uses_ground": True}), logs)
    results = run.run()
    for name, log in logs.items():
        together, alone = (
            result.recorder.finish(*_progress(result)) for result in (results[name], run_log(log, CONFIGURATION))
        )
        own = [keyframe for keyframe in together.replica.scans if keyframe >= 0]
        assert len(own) < 0.95 * len(alone.replica.scans)
        areas, hybrid_map = together.relative_trajectory.areas(together.hybrid_map), together.hybrid_map
        assert any(min(hybrid_map.keyframes(area)) < -1 for area in set(areas.tolist()))
        assert errors(together, log.true_poses(together.stamps)).max() < 0.25
        # Foreign ground is neither merged nor pruned.
        (numbers,) = run.runs[name].state.processes["tlca"].foreign_numbers.values()
        assert set(numbers.areas.values()) <= set(hybrid_map.area_ids())
        assert set(numbers.keyframes.values()) == {k for k in together.replica.scans if k < 0}
    # What each shares is its own ground all the same.
    assert all(min(team._own.component().scans) >= 0 for team in run.teams.values())


def test_a_robot_that_was_kidnapped_is_found_by_what_it_maps_afterwards():
    """Its place in its own map is not known then, so that what it has from before is another piece."""
    laps = {"ann": open_log(f"{OFFICE},laps=1"), "bob": open_log(f"{OFFICE},laps=1,visit=1,carried=0.1,to=0.5")}
    placements = []
    run = TeamRun(CONFIGURATION, laps, lambda _, each: placements.append(each))
    run.run()
    poses, truths = [], []
    for name, log in laps.items():
        replica = Replica.from_state(run.teams[name].state.replica)
        hybrid_map = replica.maps[replica.best_hypothesis]
        area = hybrid_map.area_ids()[-1]
        keyframe, pose = next(iter(hybrid_map.keyframes(area).items()))
        poses.append(se2.compose(consistent_poses(hybrid_map)[area], pose))
        truths.append(log.true_poses(np.array([replica.scans[keyframe].stamp]))[0])
    assert len(map_pieces(hybrid_map)) == 2
    found = next(each for each in placements[::-1] if each.robot == "ann")
    assert found.probability > 0.9
    error = se2.between(se2.between(*truths), se2.between(poses[0], se2.compose(found.pose, poses[1])))
    assert np.hypot(error[0], error[1]) < 0.3 and abs(error[2]) < 0.05
