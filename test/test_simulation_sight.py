"""The truth about loop closures: which places are the same, and what is seen of them."""

import numpy as np
import pytest
import yaml

from hmt_slam_ros.area_abstraction.overlap import overlaps, sensed_points
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.simulation.laser import Laser, wall_index
from hmt_slam_ros.simulation.settings import Settings
from hmt_slam_ros.simulation.sight import same_place, shared_view

# Two rooms of 6 m x 6 m with a wall between them at x = 6 m that has a door of 1 m.
ROOMS = np.array(
    [[0, 0, 12, 0], [12, 0, 12, 6], [12, 6, 0, 6], [0, 6, 0, 0], [6, 0, 6, 2.5], [6, 3.5, 6, 6]], dtype=np.float64
)


def test_the_same_place_is_near_and_on_the_same_side_of_the_wall():
    poses = np.array([[5.5, 1.0, 0.0], [5.5, 3.0, 0.0]])
    others = np.array([[6.5, 1.0, 0.0], [6.5, 3.0, 2.0], [4.0, 1.0, 1.0], [2.0, 1.0, 0.0]])
    assert same_place(wall_index(ROOMS), poses, others, 2.0).tolist() == [
        [False, False, True, False],
        [False, True, False, False],
    ]


@pytest.fixture
def share_views():
    laser = Laser(Settings(range=30.0))
    return lambda one, other: shared_view(wall_index(ROOMS), laser, np.array([one]), np.array([other]))[0, 0]


def test_a_view_is_shared_with_itself_alone_in_full(share_views):
    assert share_views([3.0, 3.0, 0.3], [3.0, 3.0, 0.3]) == pytest.approx(1.0)
    assert 0.8 < share_views([3.0, 3.0, 0.3], [2.8, 3.0, 0.3]) < 1.0
    assert share_views([3.0, 3.0, 0.3], [2.0, 2.0, 0.0]) == pytest.approx(share_views([2.0, 2.0, 0.0], [3.0, 3.0, 0.3]))


def test_who_looks_the_other_way_or_is_in_the_other_room_sees_other_walls(share_views):
    assert share_views([3.0, 3.0, 0.5 * np.pi], [3.0, 3.0, -0.5 * np.pi]) < 0.02
    assert share_views([3.0, 1.0, np.pi], [9.0, 1.0, 0.0]) == 0.0
    # Through the door some of the far room is seen.
    assert 0.0 < share_views([3.0, 3.0, 0.0], [7.0, 3.0, 0.0]) < 0.6


def test_where_nothing_is_seen_nothing_is_shared():
    laser = Laser(Settings(range=0.5))
    middle = np.array([[3.0, 3.0, 0.0]])
    assert shared_view(wall_index(ROOMS), laser, middle, middle)[0, 0] == 0.0


def test_the_true_share_is_what_the_overlap_of_scans_at_their_true_poses_estimates():
    log = open_log("sim:nested,seed=2,dropout=0")
    stamps = log.scenario.scan_stamps[::97][:30]
    true = log.shared_view(stamps, stamps)
    scans = [log.scenario.scan(97 * k) for k in range(len(stamps))]
    points, poses = [sensed_points(scan, 20.0, 361) for scan in scans], log.true_poses(stamps)
    estimated = np.array([overlaps(points[k], poses[k], points, poses, 0.2) for k in range(len(scans))])
    assert np.corrcoef(true.ravel(), estimated.ravel())[0, 1] > 0.9
    assert np.abs(true - estimated).mean() < 0.05


def test_a_log_knows_on_which_side_of_a_wall_its_robot_was(tmp_path):
    walls, route = [[0, -9, 0, 3], [-9, -9, 9, -9]], [[-1, 0], [-1, 4], [1, 4], [1, 0]]
    world = {"walls": walls, "route": route, "settings": {"laps": 1}}
    (tmp_path / "wall.yaml").write_text(yaml.safe_dump(world))
    log = open_log(f"sim:{tmp_path / 'wall.yaml'}")
    ends = log.scenario.scan_stamps[[0, -1]]
    assert log.same_place(ends, ends, 3.0).tolist() == [[True, False], [False, True]]
    np.testing.assert_allclose(log.shared_view(ends, ends), np.eye(2), atol=0.3)
