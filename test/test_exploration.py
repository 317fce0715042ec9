"""Exploration of a small building with the package's own SLAM in the loop, and missions in it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from explored_floor import LASER, ROOMS, Explored, completed_task, explore, path_of, scan_at, small_floor, view_of

from benchmark.driven_run import DrivenRun, true_place
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.exploration.laser_views import ObstacleView
from hmt_slam_ros.exploration.local_motion import MotionCommand, MotionLimits, command_towards
from hmt_slam_ros.exploration.look_planner import LookPlanner
from hmt_slam_ros.exploration.path_follower import PathFollower
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.ambiguity import NOT_DRIVEN, Ambiguity, Look
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    Hypotheses,
    Hypothesis,
    HypothesisEstimate,
    Keyframe,
)
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.tasks import EXPLORER_TASKS, GoalPose, Task, VelocityCommand, parse_task
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.laser import Laser, wall_index
from hmt_slam_ros.simulation.scenario import Scenario
from hmt_slam_ros.simulation.settings import Settings


def test_explores_all_of_a_floor_hallways_first() -> None:
    own = explore()
    path = path_of(own)[:, :2]
    assert completed_task(own.outcome).succeeded
    assert own.robot.contacts == 0
    entered = [int(np.argmax(np.hypot(*(path - room).T) < 1.9)) for room in ROOMS]
    arm, end = (int(np.argmax(np.hypot(*(path - place).T) < 3.5)) for place in ((6.0, 8.0), (11.0, 0.0)))
    assert min(entered) > max(arm, end) > 0


def test_rooms_have_names_and_the_robot_goes_there() -> None:
    own = explore()
    names = [name for name in own.run.driver.exploration_map.named_places() if name.startswith("room")]
    assert names == ["room 1", "room 2"]
    for name in names:
        assert completed_task(own.run.run_task(Task("go", name), 120.0)).succeeded
        place = true_place(own.run, name)
        assert np.hypot(*(own.robot.pose - place)[:2]) < 0.3
        assert np.abs(ROOMS - place[:2]).max(axis=1).min() < 2.0
    assert own.robot.contacts == 0


@pytest.mark.long
def test_backtracking_goes_along_its_own_path_until_stopped() -> None:
    own = explore(1)
    at = len(path_of(own))
    assert own.run.run_task(Task("backtrack"), 12.0) is None
    back = path_of(own)[at:, :2]
    assert np.hypot(*(back[-1] - back[0])) > 1.0
    before = path_of(own)[:at, :2]
    assert max(np.hypot(*(before - place).T).min() for place in back) < 0.6
    assert own.run.run_task(Task("stop"), 3.0) is None
    assert own.robot.velocity == (0.0, 0.0)


def goes(own: Explored, *probabilities: float) -> GoalPose | None:
    """Where the explorer goes from now on, where so many topological paths are as probable as this; None for as before.

    They are all the same map.
    """
    explorer, atlas = own.run.driver, own.run.driver.exploration_map
    best, area, sequence = atlas.replica.best_hypothesis, atlas.pose.area, max(atlas.replica.scans)
    hypotheses = tuple(Hypothesis(best + k, best, share, area) for k, share in enumerate(probabilities))
    explorer.handle(Hypotheses(sequence, hypotheses, 0.0))
    explorer.handle(ClosureDecision(sequence, None, (), ()))
    messages = explorer.handle(replace(scan_at((1.0, 0.0, 0.0)), stamp=atlas.pose.stamp))
    return next((word for word in messages if isinstance(word, GoalPose)), None)


def test_it_turns_back_while_several_topological_paths_are_probable() -> None:
    own = Explored(explore=False, changes={"explorer.backtracks": True})
    assert own.run.run_task(Task("explore"), 25.0) is None
    back = goes(own, 0.6, 0.4)
    assert back is not None
    # It began there, in the frame of the first area.
    assert back.area == 0
    np.testing.assert_allclose(back.pose[:2], (0.0, 0.0), atol=0.01)
    assert goes(own, 0.7, 0.3) is None
    on = goes(own, 0.99, 0.01)
    assert on is not None
    assert np.hypot(*on.pose[:2]) > 1.0


def test_it_explores_on_where_nobody_requests_it_to_turn_back() -> None:
    own = Explored(explore=False)
    assert own.run.run_task(Task("explore"), 25.0) is None
    assert own.run.driver.exploration_map.entropy == 0.0
    on = goes(own, 0.6, 0.4)
    assert own.run.driver.exploration_map.entropy == pytest.approx(0.673, abs=0.001)
    assert on is None or np.hypot(*on.pose[:2]) > 1.0


def ambiguity_along(own: Explored, keyframes: list[int], entropy: float = 0.6) -> Ambiguity:
    """Looks along the keyframes, of which the last one decides; for the map as it is."""
    atlas = own.run.driver.exploration_map
    places = [atlas.keyframe_locator.area_and_pose(keyframe) for keyframe in keyframes]
    looks = [Look(area, pose, 0.0, 1.0 + n, n - 1) for n, (area, pose) in enumerate(places)]
    looks[-1] = replace(looks[-1], information=0.9 * entropy)
    return Ambiguity(atlas.event, entropy, tuple(looks) if entropy else (), "")


def way_to(own: Explored, place: str) -> list[int]:
    """The keyframes on the way from the robot to a place."""
    atlas = own.run.driver.exploration_map
    here = atlas.update_roadmap()
    assert here is not None
    return atlas.roadmap.shortest_path(here.keyframe, atlas.named_places()[place])


@pytest.mark.long
def test_it_drives_to_where_a_look_decides_until_the_place_is_sure() -> None:
    own = explore(2)
    assert completed_task(own.run.run_task(Task("disambiguate"), 5.0)).text == "disambiguate: the place is sure"
    assert completed_task(own.run.run_task(Task("go", "room 1"), 120.0)).succeeded
    own.run.driver.handle(ambiguity_along(own, way_to(own, "room 2")))
    outcome = completed_task(own.run.run_task(Task("disambiguate"), 120.0))
    assert not outcome.succeeded
    assert outcome.text == "disambiguate: no look within reach would decide: drive on"
    assert np.hypot(*(own.robot.pose - true_place(own.run, "room 2"))[:2]) < 0.8
    own.run.driver.handle(ambiguity_along(own, way_to(own, "room 2"), entropy=0.0))
    assert completed_task(own.run.run_task(Task("disambiguate"), 5.0)).succeeded
    assert own.robot.contacts == 0


def test_looks_that_came_before_their_map_wait() -> None:
    own = explore(2)
    ahead = replace(ambiguity_along(own, way_to(own, "room 1")), sequence=own.run.driver.exploration_map.event + 2)
    own.run.driver.handle(ahead)
    assert completed_task(own.run.run_task(Task("disambiguate"), 0.4)).text == "disambiguate: the place is sure"


def test_a_goal_is_kept_while_a_look_there_tells_half_as_much_per_meter() -> None:
    """Else a robot between two looks that tell the same drives to and fro, as the rates change with its place."""
    own = explore(2)
    atlas = own.run.driver.exploration_map
    here, locator, robot = atlas.update_roadmap(), atlas.keyframe_locator, atlas.pose.pose_in_area.mean
    assert here is not None
    keyframes = [
        max(way_to(own, place), key=lambda k: np.hypot(*(locator.keyframe_pose(k) - robot)[:2]))
        for place in ("room 1", "room 2")
    ]
    (area, first), (other, second) = (locator.area_and_pose(keyframe) for keyframe in keyframes)
    event = atlas.event

    def keeps(information: float, *, remains: bool = True) -> bool:
        """Whether a robot on its way to the first look keeps it for a second one of this information."""
        planner = LookPlanner()
        look = Look(area, first, 0.3, 10.0, NOT_DRIVEN)
        planner.add(Ambiguity(event, 0.6, (look,), ""))
        planner.update(event)
        assert planner.plan(locator, here.keyframe, robot) is not None
        looks = (look, Look(other, second, information, 10.0, NOT_DRIVEN))[not remains :]
        planner.add(Ambiguity(event, 0.6, looks, ""))
        planner.update(event)
        return planner.keeps_target(locator, robot[:2])

    assert keeps(0.4)
    assert keeps(0.59)
    assert not keeps(0.61)
    assert not keeps(0.2, remains=False)


def test_an_exploration_is_interrupted_for_looks_where_that_is_wanted() -> None:
    for wanted in (True, False):
        own = Explored(explore=False, changes={"explorer.disambiguates": wanted})
        assert own.run.run_task(Task("explore"), 25.0) is None
        explorer = own.run.driver
        explorer.handle(ambiguity_along(own, way_to(own, "area 0")))
        scan = replace(scan_at((1.0, 0.0, 0.0)), stamp=explorer.exploration_map.pose.stamp)
        explorer.handle(Task("explore"))
        goals = [message for message in explorer.handle(scan) if isinstance(message, GoalPose)]
        area, pose = explorer.exploration_map.keyframe_locator.area_and_pose(way_to(own, "area 0")[-1])
        is_look = goals[0].area == area and bool(np.hypot(*(goals[0].pose - pose)[:2]) < 0.01)
        assert is_look == wanted


def test_scans_may_come_after_any_message_of_the_chain() -> None:
    own = Explored(explore=False)
    assert own.run.run_task(Task("explore"), 25.0) is None
    explorer, atlas = own.run.driver, own.run.driver.exploration_map
    replica, pose = atlas.replica, atlas.pose
    new = max(replica.scans) + 1
    scan = replace(scan_at((1.0, 0.0, 0.0)), stamp=pose.stamp)
    hypothesis = HypothesisEstimate(
        replica.best_hypothesis, pose.area, pose.pose_in_area, True, 0.0, 0.0, Clutter(), 12.0
    )
    explorer.handle(scan)
    explorer.handle(Keyframe(new, scan, 0.0, (hypothesis,)))
    explorer.handle(Task("explore"))
    assert explorer.handle(scan)
    assert new in atlas.roadmap.graph
    assert new in atlas.keyframe_locator


def test_unknown_places_are_reported() -> None:
    outcome = completed_task(explore().run.run_task(Task("go", "cellar"), 5.0))
    assert not outcome.succeeded
    assert "choose from room 1, room 2, area 0" in outcome.text


def test_a_known_map_is_known_from_the_start() -> None:
    known = explore(1).run.driver.exploration_map
    atlas = Explorer(Configuration(), Replica.from_state(known.replica.state)).exploration_map
    assert set(atlas.named_places()) >= set(known.named_places())
    for name in ("room 1", "room 2"):
        assert any({atlas.named_places()[name], known.named_places()[name]} <= own for own in atlas.roadmap.segments())
    first = min(atlas.roadmap.graph)
    assert set(atlas.roadmap.distances(first)) >= set(known.roadmap.distances(first))


def test_it_stands_where_nothing_tells_the_pose_any_more() -> None:
    own = Explored(explore=False)
    own.run.run_task(Task("explore"), 5.0)
    scan = own.robot.measure()[1] or scan_at((1.0, 0.0, 0.0))
    moving, lost = (
        own.run.driver.handle(replace(scan, stamp=own.robot.stamp + after))[-1] for after in (0, 2 * NANOSECONDS)
    )
    assert isinstance(moving, VelocityCommand)
    assert moving.speed > 0.0
    assert lost == VelocityCommand(own.robot.stamp + 2 * NANOSECONDS, 0.0, 0.0)


def test_two_lasers_that_see_half_each_lead_it_as_one_all_around_does() -> None:
    """They are before and behind the middle of the robot, whose ground neither sees at first."""
    settings = Settings(seed=6, laps=1, field_of_view=180.0, beams=181, lasers=2, forward=0.2)
    robot, configuration = DrivenRobot(Scenario(small_floor(), settings)), Configuration()
    run = DrivenRun(robot, configuration, Explorer(configuration))
    assert run.run_task(Task("explore"), 15.0) is None
    assert robot.contacts == 0
    assert robot.distance_traveled > 6.0


def test_same_seed_same_path_bit_for_bit() -> None:
    one, other = path_of(explore()), path_of(explore(1))
    known = min(explore(number).length for number in (0, 1))
    assert known > 100
    assert np.array_equal(one[:known], other[:known])


def test_it_does_not_aim_behind_a_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    aims: list[Float64] = []

    def drive_command(
        view: ObstacleView, goal: Float64, velocity: tuple[float, float], limits: MotionLimits
    ) -> MotionCommand:
        aims.append(goal)
        return command_towards(view, goal, velocity, limits)

    monkeypatch.setattr("hmt_slam_ros.exploration.path_follower.command_towards", drive_command)
    # From the northern arm around the eastern corner; the wall of the arm is at x = 7 up to y = 1.
    at = np.array([6.6, 1.6, 0.0])
    way = se2.transform(se2.inverse(at), np.array([(6.6, 1.6), (6.6, 0.5), (8.5, 0.5)]))
    PathFollower(MotionLimits(0.6, 0.8, 0.5, 1.5, 0.25), 0.15).steer(view_of(scan_at((6.6, 1.6, 0.0))), way, (0.0, 0.0))
    aim = se2.transform(at, aims[0])
    assert aim[0] < 7.4
    assert np.interp(7.0, (6.6, aim[0]), (1.6, aim[1])) < 1.0 or aim[0] < 7.0


def test_it_waits_for_who_stands_in_its_way_and_then_goes_around() -> None:
    pilot, way = PathFollower(MotionLimits(0.6, 0.8, 0.5, 1.5, 0.25), 0.15), np.array([[0.0, 0.0], [4.0, 0.0]])
    laser, walls = Laser(LASER), wall_index(small_floor().walls)
    person = np.array([[2.7, 0.0, 0.25]])

    def speed(seconds: float, people: Float64) -> float:
        scan = laser.scan(0, 0, laser.distances(np.array([(2.0, 0.0, 0.0)]), walls, people))
        command = pilot.steer(view_of(replace(scan, stamp=1 + round(seconds * NANOSECONDS))), way, (0.0, 0.0))
        return abs(command.speed) + abs(command.turn_rate)

    assert [speed(seconds, person) == 0.0 for seconds in (0.0, 2.0, 3.9)] == [True] * 3
    assert speed(5.0, person) > 0.0
    assert speed(6.0, np.empty((0, 3))) > 0.0


@pytest.mark.parametrize(("seconds", "stuck"), [(4.0, False), (20.0, True)])
def test_no_progress_for_long_is_noticed(seconds: float, stuck: bool) -> None:
    pilot = PathFollower(MotionLimits(0.6, 0.8, 0.5, 1.5, 0.25), 0.15)
    scan, way = scan_at((6.0, 0.0, 0.0)), np.array([[0.0, 0.0], [3.0, 0.0]])
    begin = Scan(1, scan.ranges, scan.angle_min, scan.angle_increment, scan.range_min, scan.range_max)
    assert pilot.steer(view_of(begin), way, (0.0, 0.0)).speed > 0.0
    assert not pilot.has_arrived
    assert pilot.is_stuck(1 + round(seconds * NANOSECONDS), 15 * NANOSECONDS) == stuck


def test_tasks_as_they_are_written() -> None:
    assert parse_task("explore", EXPLORER_TASKS) == Task("explore")
    assert parse_task(" go room 3", EXPLORER_TASKS) == Task("go", "room 3")
    for text in ("go", "dance", "explore room 3", ""):
        with pytest.raises(
            HmtSlamError, match=f"'{text}' is no task: give one of explore, backtrack, disambiguate, stop, or go"
        ):
            parse_task(text, EXPLORER_TASKS)
