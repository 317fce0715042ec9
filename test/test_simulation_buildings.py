"""Every family of buildings has the geometry that it promises, and the robot drives through it without touching it."""

import numpy as np
import pytest

from hmt_slam_ros.configuration.metric_slam import MotionParameters
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.sensors.relative_motion import NO_MOTION, RelativeMotion, increment_covariance
from hmt_slam_ros.simulation import FAMILIES, open_simulated
from hmt_slam_ros.simulation.building import Building, furniture_walls, outline_of_rectangles
from hmt_slam_ros.simulation.laser import cast_rays, clearance, has_line_of_sight
from hmt_slam_ros.simulation.scenario import Scenario
from hmt_slam_ros.simulation.settings import Settings

SEEDS = range(5)
ALL_AROUND = np.linspace(-np.pi, np.pi, 720, endpoint=False)


def scenario_of(family, seed=0, **settings):
    words = "".join(f",{name}={value}" for name, value in settings.items())
    return open_simulated(f"sim:{family},seed={seed}{words}").scenario


def view(scenario, pose, reach):
    """What a laser that sees all round would see of the walls from a pose, shape (720,), m."""
    origins = np.tile(np.asarray(pose)[:2], (ALL_AROUND.size, 1))
    return cast_rays(scenario.walls, origins, ALL_AROUND + pose[2], reach)


def closed_corners(walls):
    """Ends of walls at which an odd number of them meets."""
    ends = np.round(walls.reshape(-1, 2), 6)
    corners, counts = np.unique(ends, axis=0, return_counts=True)
    return corners[counts % 2 == 1]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("family", FAMILIES)
def test_the_robot_keeps_its_radius_from_everything_and_never_crosses_a_wall(family, seed):
    scenario = scenario_of(family, seed)
    points = scenario.drive.poses(np.arange(0.0, scenario.drive.duration, 0.02))[:, :2].copy()
    assert clearance(scenario.building.walls, points).min() > scenario.settings.radius
    assert has_line_of_sight(scenario.walls, points[:-1], points[1:]).all()
    for stamp in scenario.scan_stamps[::50]:
        now = scenario.true_poses(np.array([stamp]))[:, :2]
        if len(scenario.building.furniture):
            assert clearance(furniture_walls(scenario.furniture(stamp)), now).min() > scenario.settings.radius


@pytest.mark.parametrize("family", FAMILIES)
def test_walls_are_closed_and_the_robot_is_inside_them(family):
    scenario = scenario_of(family, 3)
    assert closed_corners(scenario.building.walls).size == 0
    for pose in scenario.poses[::100]:
        assert np.isfinite(view(scenario, pose, 1000.0)).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_the_route_ends_where_it_began_so_that_there_is_a_loop_to_close(family):
    scenario = scenario_of(family)
    first, last = scenario.drive.poses(np.array([0.0, scenario.drive.duration]))
    assert np.hypot(*(last - first)[:2]) < 1e-6


@pytest.mark.parametrize("family", sorted(set(FAMILIES) - {"grid", "ring", "straight"}))
def test_another_seed_is_another_building(family):
    one, other = (scenario_of(family, seed).building for seed in (1, 2))
    lengths = [np.sort(np.hypot(*(b.walls[:, 2:] - b.walls[:, :2]).T)) for b in (one, other)]
    assert lengths[0].size != lengths[1].size or np.abs(lengths[0] - lengths[1]).max() > 0.01


def test_the_largest_nested_loops_requested_are_two_kilometers_long():
    assert 1900.0 < scenario_of("nested", size=4).drive.path.lengths.sum() < 2600.0


def test_nested_loops_are_loops_in_loops():
    scenario = scenario_of("nested")
    rings = [4.0 * 2.2 * 8.0 * (1 + k) for k in range(3)]
    # The robot comes back to places where it was a whole ring before, once for every ring.
    points = scenario.poses[:: 2 * scenario.settings.readings, :2]
    driven = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))))
    near = np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)) < 0.5
    gaps = np.abs(driven[:, None] - driven[None])[near]
    for ring in rings:
        assert np.abs(gaps - ring).min() < 3.0


def test_more_rings_are_more_loops():
    assert len(scenario_of("nested", count=5).building.route) > len(scenario_of("nested", count=3).building.route)


def test_the_crossings_of_the_grid_all_look_alike():
    scenario = scenario_of("grid", count=4, range=9.0)
    building = scenario.building
    along = building.route[1] - building.route[0]
    heading = np.arctan2(along[1], along[0])
    inner = [(1, 1), (2, 1), (1, 2), (2, 2), (3, 3)]
    corner = se2_frame(building.route[0], heading, scenario)
    views = [view(scenario, se2.compose(corner, [9.0 * i, 9.0 * j, 0.0]), 7.9) for i, j in inner]
    for other in views[1:]:
        np.testing.assert_allclose(views[0], other, atol=1e-9)


def se2_frame(origin, heading, scenario):
    """The frame at the first crossing whose axes go along the corridors that leave it, both into the grid."""
    for turn in (0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi):
        frame = np.array([*origin, heading + turn])
        ahead = se2.transform(frame, np.array([[4.0, 0.0], [0.0, 4.0]]))
        if has_line_of_sight(scenario.walls, np.tile(origin, (2, 1)), ahead).all():
            return frame
    raise AssertionError("no crossing there")


def test_a_quarter_turn_of_the_ring_changes_nothing():
    scenario = scenario_of("ring", 5)
    places = scenario.building.twin_frames
    middle = [0.0, -7.0, 0.0]
    views = [view(scenario, se2.compose(places[f"side {k}"], middle), 30.0) for k in range(4)]
    for other in views[1:]:
        np.testing.assert_allclose(views[0], other, atol=1e-9)


def test_nothing_is_to_be_seen_along_the_long_halls():
    scenario = scenario_of("straight", 1)
    assert scenario.settings.range == 10.0
    seen = [np.sort(scenario.scan(k).ranges) for k in range(scenario.scan_stamps.size)]
    reach = np.array([np.isinf(ranges).sum() for ranges in seen])
    # For more than half of the way the hall is longer than the laser's reach: some beams meet nothing.
    assert (reach > 10).mean() > 0.5
    assert scenario.drive.path.lengths.max() > 4.0 * scenario.settings.range


def test_in_the_middle_of_the_hall_the_laser_sees_nothing_and_in_its_corners_it_does():
    scenario = scenario_of("hall", 1, dropout=0)
    seen = np.array([scenario.scan(k).valid.sum() for k in range(scenario.scan_stamps.size)])
    assert (seen == 0).mean() > 0.3
    assert seen[0] > 50
    assert (seen[-10:] > 50).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_the_twins_are_alike_as_far_as_the_laser_sees_and_the_passage_behind_them_is_not(seed):
    scenario = scenario_of("twins", seed)
    first, second = scenario.building.twin_frames["first"], scenario.building.twin_frames["second"]
    reach = scenario.settings.range
    # All that is seen from the hall, and from inside up to where the passage behind the door comes into reach.
    for pose in ([-3.5, 0.5, 0.3], [-2.0, -1.0, -0.3], [-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.2, 0.5, 2.0]):
        one, other = (view(scenario, se2.compose(place, pose), reach) for place in (first, second))
        np.testing.assert_allclose(one, other, atol=1e-9)
        assert np.isfinite(one).any()
    one, other = (view(scenario, se2.compose(place, [5.4, 0.0, 0.0]), reach) for place in (first, second))
    assert np.abs(np.minimum(one, reach) - np.minimum(other, reach)).sum() > 5.0


@pytest.mark.parametrize("seed", SEEDS)
def test_after_the_tour_of_the_hall_odometry_cannot_separate_the_twins(seed):
    """From the last wall that is seen to the next, the deviation across is more than from room to room."""
    scenario = scenario_of("twins", seed, dropout=0)
    first, second = scenario.building.twin_frames["first"], scenario.building.twin_frames["second"]
    blind = np.array([not scenario.scan(k).valid.any() for k in range(scenario.scan_stamps.size)])
    edges = np.flatnonzero(np.diff(np.pad(blind.astype(int), 1)))
    begin, end = max(edges.reshape(-1, 2).tolist(), key=lambda stretch: stretch[1] - stretch[0])
    odometry = scenario.odometry[:: scenario.settings.readings][begin - 1 : end + 1]
    total = NO_MOTION
    for motion in se2.between(odometry[:-1], odometry[1:]):
        total = total.compose(RelativeMotion(motion, increment_covariance(motion, MotionParameters())))
    pose = scenario.true_poses(scenario.scan_stamps[end : end + 1])[0]
    apart = se2.transform(se2.inverse([0.0, 0.0, pose[2]]), (second - first)[None, :2])[0]
    assert np.hypot(*apart) == pytest.approx(9.0)
    across = apart / 9.0
    assert np.sqrt(across @ total.covariance[:2, :2] @ across) > 9.0
    # It comes back to one of the two, and looks straight at its door.
    ahead = [se2.between(pose, place) for place in (first, second)]
    assert min(abs(place[1]) + abs(place[2]) for place in ahead) < 1e-6


def test_chance_decides_which_of_the_twins_is_entered_again():
    again = set()
    for seed in range(10):
        building = scenario_of("twins", seed).building
        entered = building.route[10]
        distances = [np.hypot(*(entered - building.twin_frames[name][:2])) for name in ("first", "second")]
        again.add(int(np.argmin(distances)))
    assert again == {0, 1}


def test_the_outline_of_rectangles_is_that_of_their_union():
    walls = outline_of_rectangles(np.array([[0, 0, 4, 2], [3, 1, 5, 6], [3.1, 1.5, 4.9, 5.0004]]))
    lengths = np.hypot(*(walls[:, 2:] - walls[:, :2]).T)
    assert lengths.sum() == pytest.approx(2 * (5 + 6))
    assert closed_corners(walls).size == 0


def test_a_route_too_close_to_a_wall_is_refused_with_the_place():
    building = Building(np.array([[2.0, 0.0, 2.0, 0.9]]), np.array([[0.0, 1.0], [4.0, 1.0]]))
    with pytest.raises(HmtSlamError, match=r"0\.10 m from a wall at \(2\.0, 1\.0\).*radius is 0\.25"):
        Scenario(building, Settings())
    Scenario(building, Settings(radius=0.05))


def test_a_later_visit_finds_furniture_moved_and_doors_closed_and_the_same_walls():
    first, later, other, same = (
        scenario_of("office", 3, laps=1, visit=visit, changed=changed)
        for visit, changed in ((0, 0.5), (1, 0.5), (2, 0.5), (1, 0.0))
    )
    walls = len(first.walls.walls)
    assert len(later.walls.walls) > walls == len(same.walls.walls)
    np.testing.assert_array_equal(later.walls.walls[:walls], first.walls.walls)
    closed = later.walls.walls[walls:]
    lengths = np.hypot(*(closed[:, 2:] - closed[:, :2]).T)
    assert ((lengths >= 0.9) & (lengths <= 1.1)).all()
    moved = (later.building.furniture != first.building.furniture).any(axis=1)
    assert 0.2 < moved.mean() < 0.8
    assert (other.building.furniture != later.building.furniture).any()
    np.testing.assert_array_equal(same.building.furniture, first.building.furniture)
    np.testing.assert_array_equal(later.poses, first.poses)
    assert (same.odometry != first.odometry).any()
    assert (same.scan(5).ranges != first.scan(5).ranges).any()
