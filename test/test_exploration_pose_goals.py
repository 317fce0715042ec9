"""Goal poses: held by a keyframe, they move with the map."""

import numpy as np
import pytest

from hmt_slam_ros.exploration.pose_goals import anchor_elsewhere, anchor_pose
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.tasks import GoalError, TaskError

AREAS = {0: (0.0, 0.0, 0.0), 1: (10.0, 2.0, 0.5)}
KEYFRAMES = {0: {0: (0.0, 0.0, 0.0), 1: (2.0, 0.0, 0.3)}, 1: {2: (0.0, 0.0, 0.0), 3: (1.0, 0.5, -1.0)}}


def two_areas():
    hybrid_map = HybridMap()
    for area, keyframes in KEYFRAMES.items():
        for keyframe, pose in keyframes.items():
            hybrid_map.set_keyframe(keyframe, area, np.array(pose))
    return hybrid_map


def poses(areas=AREAS):
    return {area: PoseGaussian.from_pose(np.array(pose)) for area, pose in areas.items()}


def in_map(anchor, areas=AREAS):
    """``map_T_goal`` of an anchored pose."""
    area = next(area for area, keyframes in KEYFRAMES.items() if anchor.keyframe in keyframes)
    keyframe = np.array(KEYFRAMES[area][anchor.keyframe])
    return se2.compose(se2.compose(np.array(areas[area]), keyframe), anchor.pose)


def test_a_goal_is_held_by_the_nearest_keyframe_and_moves_with_its_area():
    goal = np.array([11.0, 3.0, 1.2])
    anchor = anchor_pose(two_areas(), poses(), goal)
    assert anchor.keyframe == 3
    np.testing.assert_allclose(in_map(anchor), goal, atol=1e-12)
    moved = AREAS | {1: (9.0, 2.5, 0.4)}
    shift = se2.compose(np.array(moved[1]), se2.inverse(np.array(AREAS[1])))
    np.testing.assert_allclose(in_map(anchor, moved), se2.compose(shift, goal), atol=1e-12)


def test_a_goal_far_from_all_keyframes_is_refused():
    with pytest.raises(
        GoalError, match=r"the goal \(6\.50, 0\.00\) is outside the map: give one within 4 m"
    ) as refusal:
        anchor_pose(two_areas(), poses(), np.array([6.5, 0.0, 0.0]))
    assert refusal.value.error is TaskError.GOAL_OUTSIDE_MAP
    with pytest.raises(GoalError, match="is outside the map"):
        anchor_pose(two_areas(), {}, np.zeros(3))


def test_where_its_keyframe_is_pruned_another_one_of_the_area_holds_the_goal():
    hybrid_map, goal = two_areas(), np.array([11.0, 3.0, 1.2])
    anchor = anchor_pose(hybrid_map, poses(), goal)
    assert anchor_elsewhere(anchor, hybrid_map, {0, 1, 2}) is anchor
    other = anchor_elsewhere(anchor, hybrid_map, {3})
    assert other.keyframe == 2
    np.testing.assert_allclose(in_map(other), goal, atol=1e-12)
    assert anchor_elsewhere(anchor, hybrid_map, {2, 3}) is anchor
