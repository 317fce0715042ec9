"""Exploration of a small building with the package's own SLAM in the loop, and missions in it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmark.driven_run import DrivenRun, true_place
from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.configuration.flat import with_changes
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.exploration.frontier_choice import Choice
from hmt_slam_ros.exploration.laser_views import LaserViews, ObstacleView
from hmt_slam_ros.exploration.local_motion import MotionCommand, MotionLimits, command_towards
from hmt_slam_ros.exploration.look_planner import LookPlanner
from hmt_slam_ros.exploration.path_follower import PathFollower
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.ambiguity import NOT_DRIVEN, Ambiguity, Look
from hmt_slam_ros.messages.map_changes import ForeignGround, ForeignKeyframe
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    Hypotheses,
    Hypothesis,
    HypothesisEstimate,
    Keyframe,
    Message,
)
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.tasks import EXPLORER_TASKS, GoalPose, Task, TaskResult, VelocityCommand, parse_task
from hmt_slam_ros.messages.team import TeamGoal, TeamPlace
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.sensors import Scan
from hmt_slam_ros.simulation.building import Building, FloorPlan
from hmt_slam_ros.simulation.driven_robot import DrivenRobot
from hmt_slam_ros.simulation.laser import Laser, wall_index
from hmt_slam_ros.simulation.scenario import START, Scenario
from hmt_slam_ros.simulation.settings import Settings

ROOMS = np.array([[3.0, -3.2], [9.0, -3.2]])
"""Middles of the rooms, m."""

ORIGIN = np.array([1.0, 0.0, 0.0])
"""Where the robot begins, m and rad."""

LASER = Settings(field_of_view=360.0, beams=720)


def small_floor() -> Building:
    """A hallway along x with an arm to the north, and two rooms to the south; the robot begins at its western end."""
    plan = FloorPlan()
    plan.cut_rectangle(0.0, -1.0, 12.0, 1.0)
    plan.cut_rectangle(5.0, 1.0, 7.0, 9.0)
    for x, y in ROOMS:
        plan.cut_rectangle(x - 1.5, y - 2.0, x + 1.5, y + 2.0)
        plan.cut_rectangle(x - 0.5, y + 1.9, x + 0.5, -0.9)
    return Building(plan.walls(), np.array([[1.0, 0.0], [11.0, 0.0]]))


def scan_at(pose: tuple[float, float, float]) -> Scan:
    """What a laser all around sees of that floor."""
    laser = Laser(LASER)
    return laser.scan(0, 0, laser.distances(np.array([pose]), wall_index(small_floor().walls), np.empty((0, 3))))


def view_of(scan: Scan) -> ObstacleView:
    """What a robot with one laser sees."""
    return LaserViews().add(scan)


def with_keyframes(poses: dict[int, tuple[float, float, float]]) -> HybridMap:
    """A map of one area that has these keyframes."""
    hybrid_map = HybridMap()
    for keyframe, pose in poses.items():
        hybrid_map.set_keyframe(keyframe, 0, np.array(pose))
    return hybrid_map


class _Explored:
    """The floor after a robot explored it."""

    def __init__(self, *, explore: bool = True, changes: Mapping[str, bool] | None = None, robot: str = "") -> None:
        scenario = Scenario(small_floor(), Settings(seed=5, laps=1, field_of_view=360.0, beams=720))
        self.robot = DrivenRobot(scenario)
        configuration = with_changes(Configuration(), changes or {})
        self.run = DrivenRun(self.robot, configuration, Explorer(configuration, robot=robot))
        self.outcome = self.run.run_task(Task("explore"), 400.0) if explore else None
        self.length = len(path_of(self))


@cache
def explore(number: int = 0) -> _Explored:
    """One and the same exploration for all tests that request this number."""
    del number
    return _Explored()


def path_of(own: _Explored) -> Float64:
    """True poses of the robot up to now, (n, 3), five a second."""
    return own.robot.true_poses(np.arange(START, own.robot.stamp, NANOSECONDS // 5))


def completed_task(outcome: TaskResult | None) -> TaskResult:
    """An outcome that is there."""
    assert outcome is not None
    return outcome


def test_explores_all_of_a_floor_hallways_first() -> None:
    own = explore()
    path = path_of(own)[:, :2]
    assert completed_task(own.outcome).succeeded
    assert own.robot.contacts == 0
    entered = [int(np.argmax(np.hypot(*(path - room).T) < 1.9)) for room in ROOMS]
    arm, end = (int(np.argmax(np.hypot(*(path - place).T) < 3.5)) for place in ((6.0, 8.0), (11.0, 0.0)))
    assert min(entered) > max(arm, end) > 0


def test_ground_of_another_robot_is_known_and_what_is_nearer_to_it_is_left_to_it() -> None:
    own = _Explored(explore=False)
    own.run.run_task(Task("explore"), 16.0)
    explorer = own.run.driver
    known = explorer.exploration_map
    # To the end of the arm, where another robot has been; that is in the door of the left room now.
    assert target_in_building(explorer) == pytest.approx((6.0, 8.0), abs=1.0)
    share_ground(own, PLACES_OF_BOB)
    own.run.run_task(Task("explore"), 2.0)
    assert known.teammates.positions(known.roadmap.graph) == {"bob": -6} and not known.teammates.new_keyframes
    # Not the left room: the eastern half.
    x, y = target_in_building(explorer)
    assert x > 7.0 and y < 1.0


PLACES_OF_BOB = [(6.0, 2.0, 1.6), (6.0, 5.0, 1.6), (6.0, 8.0, 1.6), (6.0, 5.0, -1.6), (3.0, -1.0, -1.6)]
"""Where another robot has been: in the arm, and in the door of the left room."""


@pytest.mark.parametrize("has_finished", [False, True])
def test_goals_of_other_robots_are_left_to_them_and_nothing_is_left_of_one_that_has_finished(
    *, has_finished: bool
) -> None:
    own = _Explored(explore=False, robot="ann")
    own.run.run_task(Task("explore"), 16.0)
    explorer, scans = own.run.driver, own.run.drive(Task("explore"), 100.0)
    share_ground(own, PLACES_OF_BOB)
    for _ in range(10):
        next(scans)
    hallway = target_in_building(explorer)
    assert hallway[0] > 7.0
    # Cid drives there, which is known by the first keyframe of Bob.
    place = se2.between(np.array(PLACES_OF_BOB[0]), np.array([*hallway, 0.0]))
    explorer.handle(TeamGoal("cid", 0, False, False, TeamPlace("bob", 0, place), True, 1.0))
    explorer.handle(TeamGoal("bob", 4, False, has_finished, None, False, 0.0))
    for _ in range(10):
        next(scans)
    if has_finished:
        assert explorer._frontiers.target is None
        assert_it_looks_for_a_goal_once_a_second(explorer, scans)
    else:
        assert target_in_building(explorer) == pytest.approx((3.0, -4.8), abs=0.5)


def assert_it_looks_for_a_goal_once_a_second(explorer: Explorer, scans: Iterator[object]) -> None:
    """Each time it updates its roadmap, which takes longer than all else that a scan causes."""
    choose, chosen = explorer._frontiers.choose, list[int]()

    def count(here: int, *, is_on_way: bool) -> Choice:
        chosen.append(here)
        return choose(here, is_on_way=is_on_way)

    explorer._frontiers.choose = count  # type: ignore[method-assign]
    for _ in range(20):
        next(scans)
    assert 3 <= len(chosen) <= 6


def test_an_explorer_sends_its_goal_when_it_is_another_one_and_every_ten_seconds() -> None:
    own = _Explored(explore=False, robot="ann")
    explorer, sent = own.run.driver, list[tuple[int, TeamGoal]]()
    handle = explorer.handle

    def note(message: Message) -> list[Message]:
        outputs = handle(message)
        sent.extend((own.robot.stamp, each) for each in outputs if isinstance(each, TeamGoal))
        return outputs

    explorer.handle = note  # type: ignore[method-assign]
    own.run.run_task(Task("explore"), 40.0)
    own.run.run_task(Task("stop"), 3.0)
    goals = [goal for _, goal in sent]
    stamps = {scan.stamp for scan in explorer.exploration_map.replica.scans.values()}
    assert all(goal.robot == "ann" and goal.newest_stamp in stamps for goal in goals)
    assert [goal.place is None for goal in goals] == [False] * (len(goals) - 1) + [True]
    assert any(goal.reached_last for goal in goals)
    gaps = np.diff([stamp for stamp, _ in sent]) / NANOSECONDS
    assert len(gaps) > 3 and gaps.max() < 10.5


def test_ground_that_changes_no_choice_keeps_the_route_and_the_time_since_the_last_progress() -> None:
    own = _Explored(explore=False)
    own.run.run_task(Task("explore"), 16.0)
    explorer, scans = own.run.driver, own.run.drive(Task("explore"), 2.0)
    next(scans)
    route, follower = explorer._route, explorer._path_follower
    share_ground(own, [(3.0, -1.0, -1.6)])
    next(scans)
    assert not explorer.exploration_map.teammates.new_keyframes
    assert explorer._route is route and explorer._path_follower is follower


def test_an_exploration_ends_where_only_a_room_is_left_to_another_robot() -> None:
    own = _Explored(explore=False)
    explorer = own.run.driver
    for _ in own.run.drive(Task("explore"), 200.0):
        if explorer.named_rooms():
            break
    robot = own.robot.pose[:2]
    x, _ = max(ROOMS, key=lambda room: float(np.hypot(*(room - robot))))
    share_ground(own, [(x, -1.0, -1.6)])
    outcome = completed_task(own.run.run_task(Task("explore"), 10.0))
    assert (
        outcome.succeeded
        and outcome.reason == "all is known that can be reached, or left to bob; 0 places were given up"
    )
    assert len(explorer.named_rooms()) == 1


def test_an_exploration_names_no_other_robot_where_nothing_is_left() -> None:
    own = _Explored(explore=False)
    own.run.run_task(Task("explore"), 16.0)
    share_ground(own, PLACES_OF_BOB)
    own.run.run_task(Task("explore"), 2.0)
    known, choice = own.run.driver.exploration_map, own.run.driver._frontiers
    here = known.update_roadmap()
    assert here is not None
    choice._reached += [(frontier.keyframe, frontier.path[-1]) for frontier in known.roadmap.frontiers]
    assert choice.choose(here.keyframe, is_on_way=False) == Choice(is_over=True)


def share_ground(own: _Explored, places: list[tuple[float, float, float]]) -> None:
    """Send an explorer ground of another robot, with a keyframe at each place of the floor."""
    known = own.run.driver.exploration_map
    keyframes = [
        ForeignKeyframe(-2 - n, 0, np.array(place) - ORIGIN, replace(scan_at(place), stamp=n))
        for n, place in enumerate(places)
    ]
    ground, best = ForeignGround("bob", tuple(keyframes)), known.replica.best_hypothesis
    own.run.driver.handle(ClosureDecision(known.event, best, (), (), foreign_ground=ground))


def target_in_building(explorer: Explorer) -> Float64:
    """The frontier to which an explorer drives, (2,), m."""
    target, locator = explorer._frontiers.target, explorer.exploration_map.keyframe_locator
    assert target is not None
    return se2.transform(locator.keyframe_pose(target.keyframe), target.path[-1]) + ORIGIN[:2]


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


def goes(own: _Explored, *probabilities: float) -> GoalPose | None:
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
    own = _Explored(explore=False, changes={"explorer.backtracks": True})
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
    own = _Explored(explore=False)
    assert own.run.run_task(Task("explore"), 25.0) is None
    assert own.run.driver.exploration_map.entropy == 0.0
    on = goes(own, 0.6, 0.4)
    assert own.run.driver.exploration_map.entropy == pytest.approx(0.673, abs=0.001)
    assert on is None or np.hypot(*on.pose[:2]) > 1.0


def ambiguity_along(own: _Explored, keyframes: list[int], entropy: float = 0.6) -> Ambiguity:
    """Looks along the keyframes, of which the last one decides; for the map as it is."""
    atlas = own.run.driver.exploration_map
    places = [atlas.keyframe_locator.area_and_pose(keyframe) for keyframe in keyframes]
    looks = [Look(area, pose, 0.0, 1.0 + n, n - 1) for n, (area, pose) in enumerate(places)]
    looks[-1] = replace(looks[-1], information=0.9 * entropy)
    return Ambiguity(atlas.event, entropy, tuple(looks) if entropy else (), "")


def way_to(own: _Explored, place: str) -> list[int]:
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
        own = _Explored(explore=False, changes={"explorer.disambiguates": wanted})
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
    own = _Explored(explore=False)
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
    own = _Explored(explore=False)
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
