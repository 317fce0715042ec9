"""Explorers of a team: frontiers that are left to other robots, and the goals that they send."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from explored_floor import ORIGIN, ROOMS, Explored, completed_task, scan_at

from hmt_slam_ros.arrays import Float64
from hmt_slam_ros.exploration.explorer import Explorer
from hmt_slam_ros.exploration.frontier_choice import Choice
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.map_changes import ForeignGround, ForeignKeyframe
from hmt_slam_ros.messages.messages import (
    ClosureDecision,
    Message,
)
from hmt_slam_ros.messages.tasks import Task
from hmt_slam_ros.messages.team import TeamGoal, TeamPlace

PLACES_OF_BOB = [(6.0, 2.0, 1.6), (6.0, 5.0, 1.6), (6.0, 8.0, 1.6), (6.0, 5.0, -1.6), (3.0, -1.0, -1.6)]
"""Where another robot has been: in the arm, and in the door of the left room."""


def test_ground_of_another_robot_is_known_and_what_is_nearer_to_it_is_left_to_it() -> None:
    own = Explored(explore=False)
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


@pytest.mark.parametrize("has_finished", [False, True])
def test_goals_of_other_robots_are_left_to_them_and_nothing_is_left_of_one_that_has_finished(
    *, has_finished: bool
) -> None:
    own = Explored(explore=False, robot="ann")
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
    own = Explored(explore=False, robot="ann")
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
    own = Explored(explore=False)
    own.run.run_task(Task("explore"), 16.0)
    explorer, scans = own.run.driver, own.run.drive(Task("explore"), 2.0)
    next(scans)
    route, follower = explorer._route, explorer._path_follower
    share_ground(own, [(3.0, -1.0, -1.6)])
    next(scans)
    assert not explorer.exploration_map.teammates.new_keyframes
    assert explorer._route is route and explorer._path_follower is follower


def test_an_exploration_ends_where_only_a_room_is_left_to_another_robot() -> None:
    own = Explored(explore=False)
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
    own = Explored(explore=False)
    own.run.run_task(Task("explore"), 16.0)
    share_ground(own, PLACES_OF_BOB)
    own.run.run_task(Task("explore"), 2.0)
    known, choice = own.run.driver.exploration_map, own.run.driver._frontiers
    here = known.update_roadmap()
    assert here is not None
    choice._reached += [(frontier.keyframe, frontier.path[-1]) for frontier in known.roadmap.frontiers]
    assert choice.choose(here.keyframe, is_on_way=False) == Choice(is_over=True)


def share_ground(own: Explored, places: list[tuple[float, float, float]]) -> None:
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
