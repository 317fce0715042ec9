"""The measurement of the pilot's tasks through nodes."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from benchmark.pilot import _COLUMNS, ExploredBuilding, TaskRun, _draw_start, _score_task, requirements
from benchmark.report import VALIDATION, document_marks
from hmt_slam_ros.geometry import se2

IN_MAP, IN_WORLD = np.array([1.0, 2.0, 0.3]), np.array([-4.0, 5.0, 1.0])
BUILDING = ExploredBuilding(0, Path(), {7: (IN_MAP, IN_WORLD)}, {"room 1": (7, np.array([3.0, 4.0]))})
WORLD = "sim:institute,seed=0,people=0,laps=1"


def run(end, text="go room 1: the robot is there", offset=(0.0, 0.0, 0.0), contacts=0):
    """A task that begins 10 m off, with an initial pose that is wrong by an offset."""
    place = np.array([0.5, -0.5, 0.2])
    start = se2.compose(IN_MAP, place), se2.compose(se2.compose(IN_WORLD, place), np.array(offset))
    return TaskRun(text, np.array([(3.0, 14.0), end]), 20.0, contacts, [start])


def values(*goals):
    scored = [_score_task(BUILDING, task, "room 1") for task in goals]
    return {task.name: (task.value, task.is_met) for task in requirements(scored)}


def test_a_task_reaches_its_place_if_the_pilot_reports_it_and_the_robot_is_there():
    found = values(run((3.0, 4.2)))
    assert all(met for _, met in found.values())
    assert found["mean speed"][0] == pytest.approx(0.49)
    for bad in (run((3.0, 4.4)), run((3.0, 4.0), "go room 1: given up after 300 s")):
        assert values(run((3.0, 4.0)), bad)["tasks that reach their place"] == (0.5, False)
    assert values(run((3.0, 4.0), contacts=1))["contacts"] == (1.0, False)


def test_initial_poses_are_compared_in_the_frame_of_the_area():
    scored = _score_task(BUILDING, run((3.0, 4.0), offset=(0.3, -0.4, 0.1)), "room 1")
    assert scored.starts == [(pytest.approx(0.5), pytest.approx(0.1))]
    assert [cell(scored) for _, cell in _COLUMNS[-2:]] == ["0.50", "5.7"]
    assert not values(run((3.0, 4.0), offset=(0.3, -0.4, 0.1)))["initialpose: largest error"][1]


def test_the_robot_starts_at_the_same_place_for_the_same_building():
    first, second = (_draw_start(WORLD, np.random.default_rng([0, 3])) for _ in range(2))
    assert first == second


def test_the_document_has_a_place_for_it():
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in document_marks("pilot"))
