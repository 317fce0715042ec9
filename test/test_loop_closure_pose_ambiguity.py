"""Where several hypotheses live, the robot's pose in the map is as uncertain as they are apart."""

import numpy as np
import pytest
from play_for_tlca import Play, belief

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.map_changes import Arc
from hmt_slam_ros.messages.messages import Hypothesis, RealTimePose

THERE = np.array([4.0, 1.0, 0.5])
ELSEWHERE = np.array([4.5, 4.0, 0.7])


def verdict_of(probability, there=THERE, elsewhere=ELSEWHERE):
    """The robot is in area 2, at the end of one of two arcs."""
    play = Play()
    play.start()
    hypotheses = [
        Hypothesis(h, 0, p, 2, belief(se2.inverse(THERE)), (), (Arc(0, 2, belief(arc)),))
        for h, p, arc in ((1, probability, there), (2, 1.0 - probability, elsewhere))
    ]
    return play.step(*hypotheses)


def test_one_hypothesis_is_not_ambiguous():
    play = Play()
    verdict = play.start()
    np.testing.assert_array_equal(verdict.ambiguity, np.zeros((3, 3)))


@pytest.mark.parametrize("probability", [0.7, 0.9])
def test_it_is_the_squared_distance_of_the_others_by_their_probability(probability):
    away = se2.compose(ELSEWHERE, se2.inverse(THERE))
    np.testing.assert_allclose(verdict_of(probability).ambiguity, (1.0 - probability) * np.outer(away, away))


@pytest.mark.parametrize(("heading", "turn"), [(0.0, 3.0), (2.5, 2.0), (-2.5, -2.0), (3.1, 0.1)])
def test_headings_are_apart_by_half_a_turn_at_most(heading, turn):
    """At the origin under both hypotheses, but turned by ``turn`` under the second."""
    there, elsewhere = (se2.compose(np.array([0.0, 0.0, angle]), THERE) for angle in (heading, heading + turn))
    for probability in (0.6, 0.9):
        expected = (1.0 - probability) * np.diag([0.0, 0.0, turn**2])
        np.testing.assert_allclose(verdict_of(probability, there, elsewhere).ambiguity, expected, atol=1e-9)


def test_poses_in_the_map_and_in_the_area_are_as_uncertain_as_the_hypotheses_are_apart_whatever_the_heading():
    exact = PoseGaussian.from_pose
    apart = np.diag([4.0, 0.0, 0.0])
    estimates = [
        RealTimePose(
            0, 0, exact(np.zeros(3)), exact(np.array([1.0, 2.0, turn])), exact(np.zeros(3)), np.zeros(3), apart
        )
        for turn in (0.0, 0.5 * np.pi)
    ]
    for number, expected in enumerate((apart, np.diag([0.0, 4.0, 0.0]))):
        for pose in (estimates[number].map_pose, estimates[number].pose_in_area):
            np.testing.assert_allclose(pose.covariance, expected, atol=1e-12)


def test_in_the_frame_of_a_turned_area_hypotheses_are_apart_along_its_own_axes():
    turned, exact = PoseGaussian.from_pose(np.array([0.0, 0.0, 0.5 * np.pi])), PoseGaussian.from_pose(np.zeros(3))
    pose = RealTimePose(0, 0, turned, exact, exact, np.zeros(3), np.diag([4.0, 0.0, 0.0])).pose_in_area
    np.testing.assert_allclose(pose.covariance, np.diag([0.0, 4.0, 0.0]), atol=1e-12)
