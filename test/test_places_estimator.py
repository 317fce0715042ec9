"""The belief over places of a robot that drives through a small floor, and what the metric filter starts with."""

import math

import numpy as np
import pytest
from small_floor import AREAS, BUILDING, CONFIGURATION, make_chart, seen_at, walls
from worlds import scan_at

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.landmarks.openings import Openings, extract_openings
from hmt_slam_ros.places.chart import DOOR
from hmt_slam_ros.places.estimator import PlaceEstimator
from hmt_slam_ros.places.observation_graph import QUARTERS, reverse_direction, select_landmarks
from hmt_slam_ros.places.place_graph import heading_of, node_of, opposite_direction, state_of
from hmt_slam_ros.places.policy import metric_initial_pose
from hmt_slam_ros.places.position_belief import PositionBelief, certain_belief
from hmt_slam_ros.sensors.relative_motion import RelativeMotion, increment_covariance


@pytest.fixture(scope="module")
def chart():
    return make_chart()[0]


@pytest.fixture(scope="module")
def graph(chart):
    return chart.graph(CONFIGURATION.places)


def node_at(chart, x, y=0.0):
    places = np.array([se2.compose(AREAS[node.area], node.pose) for node in chart.nodes])
    return int(np.hypot(*(places[:, :2] - (x, y)).T).argmin())


def eastwards(chart):
    """The direction of the chart in which x grows."""
    first, second = node_at(chart, 5.0), node_at(chart, 10.0)
    return next(edge.start_direction for edge in chart.edges if (edge.start, edge.end) == (first, second))


def line(start, end, heading=None):
    """Poses from place to place, 0.12 m apart; on the spot a turn of 0.2 rad each."""
    (x0, y0), (x1, y1) = start, end
    heading = math.atan2(y1 - y0, x1 - x0) if heading is None else heading
    count = max(2, int(math.dist(start, end) / 0.12))
    return [(x, y, heading) for x, y in zip(np.linspace(x0, x1, count), np.linspace(y0, y1, count), strict=True)]


def turn(place, before, after):
    return [(*place, heading) for heading in np.linspace(before, after, 9)]


def drive(estimator, poses, seed=0):
    """What an estimator says after every scan of a way; odometry with 1 % of noise."""
    rng = np.random.default_rng(seed)
    for before, after in zip([poses[0], *poses[:-1]], poses, strict=True):
        increment = se2.between(np.array(before), np.array(after))
        noisy = increment * (1.0 + rng.normal(0.0, 0.01, 3))
        estimator.predict(RelativeMotion(noisy, increment_covariance(noisy, CONFIGURATION.motion)))
        yield estimator.observe(seen_at(np.array(after), rng))


def test_a_lost_robot_knows_its_place_after_some_nodes_and_how_far_it_is_beyond_the_last_one(chart, graph):
    estimator = PlaceEstimator(graph, CONFIGURATION)
    poses = line((2.0, 0.1), (19.0, 0.1))
    beliefs = list(drive(estimator, poses))
    assert beliefs[0] is None
    assert estimator.arrivals == 3
    assert estimator.belief.is_confident
    state = estimator.belief.most_likely_state
    assert (node_of(state), heading_of(state)) == (node_at(chart, 16.0), eastwards(chart))
    assert estimator.frame.distance_past_node == pytest.approx(3.0, abs=0.1)
    assert estimator.is_in_hallway


def test_the_wall_at_the_end_is_a_node_and_after_the_turn_the_way_leads_back(chart, graph):
    start = state_of(node_at(chart, 16.0), eastwards(chart))
    estimator = PlaceEstimator(graph, CONFIGURATION, certain_belief(graph, CONFIGURATION.places, start))
    poses = line((16.0, 0.0), (21.0, 0.0)) + turn((21.0, 0.0), 0.0, math.pi) + line((21.0, 0.0), (12.0, 0.0))
    seen = [belief.most_likely_state for belief in drive(estimator, poses)]
    end, back = node_at(chart, 21.0), opposite_direction(eastwards(chart))
    ways = [start, state_of(end, eastwards(chart)), state_of(end, back), state_of(node_at(chart, 16.0), back)]
    assert [state for k, state in enumerate(seen) if not k or state != seen[k - 1]] == ways


def test_in_a_room_the_belief_pauses_and_goes_on_at_the_door(chart, graph):
    door = node_at(chart, 5.0)
    assert chart.nodes[door].kind == DOOR
    start = state_of(node_at(chart, 1.0), eastwards(chart))
    estimator = PlaceEstimator(graph, CONFIGURATION, certain_belief(graph, CONFIGURATION.places, start))
    up = 0.5 * math.pi
    into = line((1.0, 0.0), (5.1, 0.0)) + turn((5.1, 0.0), 0.0, up) + line((5.1, 0.0), (5.1, 3.0))
    inside = list(drive(estimator, into))[-1]
    assert not estimator.is_in_hallway
    about = [(5.1, 3.0, up + 0.2 * k) for k in range(16)]
    assert list(drive(estimator, about))[-1] is inside
    out = line((5.1, 3.0), (5.1, 0.0)) + turn((5.1, 0.0), 1.5 * math.pi, 2.0 * math.pi) + line((5.1, 0.0), (12.0, 0.0))
    list(drive(estimator, [about[-1], *out]))
    assert estimator.belief.is_confident
    state = estimator.belief.most_likely_state
    assert (node_of(state), heading_of(state)) == (node_at(chart, 10.0), eastwards(chart))


def test_before_a_door_a_confident_robot_knows_its_pose_in_the_area_of_the_door(chart, graph):
    start = state_of(node_at(chart, 1.0), eastwards(chart))
    places = CONFIGURATION.places
    estimator = PlaceEstimator(graph, CONFIGURATION, certain_belief(graph, places, start))
    up = 0.5 * math.pi
    poses = line((1.0, 0.0), (4.9, 0.0)) + turn((4.9, 0.0), 0.0, up) + line((4.9, 0.0), (4.9, 0.5))
    list(drive(estimator, poses))
    found = metric_initial_pose(estimator, chart)
    assert found.node == node_at(chart, 5.0)
    true = se2.between(AREAS[found.area], np.array(poses[-1]))
    off = se2.log(se2.between(found.pose.mean, true))
    assert np.hypot(*off[:2]) < 0.1
    assert float(off @ np.linalg.solve(found.pose.covariance, off)) < 16.3
    # One that is not confident does not switch, and neither does one that looks along the hallway.
    lost = PlaceEstimator(graph, CONFIGURATION)
    list(drive(lost, poses))
    assert lost.belief is None or not lost.belief.is_confident
    assert metric_initial_pose(lost, chart) is None
    list(drive(estimator, line((4.9, 0.5), (4.9, 0.0), up) + turn((4.9, 0.0), up, 0.0)))
    assert metric_initial_pose(estimator, chart) is None


def test_a_door_of_whose_wall_too_little_is_seen_tells_no_pose(chart, graph, monkeypatch):
    estimator = PlaceEstimator(graph, CONFIGURATION, certain_belief(graph, CONFIGURATION.places, 0))
    list(drive(estimator, [(4.9, 0.3, 0.5 * math.pi)] * 2))
    assert estimator.openings.door_ahead() is not None
    hidden = estimator.openings.last_openings.covariances.copy()
    hidden[:, 2, 2] = math.radians(0.4) ** 2
    monkeypatch.setattr(
        estimator.openings, "last_openings", estimator.openings.last_openings._replace(covariances=hidden)
    )
    assert estimator.openings.door_ahead() is None


def test_a_door_that_someone_hid_is_noticed_by_the_turn_into_it(chart, graph, monkeypatch):
    start = state_of(node_at(chart, 1.0), eastwards(chart))
    estimator = PlaceEstimator(graph, CONFIGURATION, certain_belief(graph, CONFIGURATION.places, start))
    up = 0.5 * math.pi
    poses = line((1.0, 0.0), (5.0, 0.0)) + turn((5.0, 0.0), 0.0, up)
    hidden = extract_openings
    monkeypatch.setattr("hmt_slam_ros.places.estimator.extract_openings", lambda *args: without_sides(hidden(*args)))
    list(drive(estimator, poses))
    assert estimator.arrivals == 1
    assert estimator.node_and_direction == (node_at(chart, 5.0), chart.nodes[node_at(chart, 5.0)].openings[0].direction)


def without_sides(openings):
    """Those that lead ahead alone, as if people hid the others."""
    return Openings(*(field[np.abs(openings.poses[:, 2]) < 0.5] for field in openings))


def test_where_the_robot_turns_into_another_hallway_there_is_a_node_though_its_opening_looked_like_none(
    chart, graph, monkeypatch
):
    start = state_of(node_at(chart, 10.0), eastwards(chart))
    estimator = PlaceEstimator(graph, CONFIGURATION, certain_belief(graph, CONFIGURATION.places, start))
    monkeypatch.setattr(PositionBelief, "is_mapped_opening", lambda *_: False)
    up = 0.5 * math.pi
    list(drive(estimator, line((10.0, 0.0), (16.0, 0.0)) + turn((16.0, 0.0), 0.0, up) + line((16.0, 0.0), (16.0, 4.0))))
    north = (eastwards(chart) - 1) % QUARTERS
    assert estimator.node_and_direction == (node_at(chart, 16.0), north)
    assert estimator.belief.is_confident


def test_an_opening_that_is_none_of_the_map_hides_no_end_of_a_hallway(chart, graph, monkeypatch):
    start = state_of(node_at(chart, 16.0), eastwards(chart))
    estimator = PlaceEstimator(graph, CONFIGURATION, certain_belief(graph, CONFIGURATION.places, start))
    seen, ahead = extract_openings, iter(np.linspace(4.6, -0.3, 41).tolist())

    def and_a_new_one(*args):
        """Beside where the robot turns at the end."""
        found, away = seen(*args), next(ahead)
        new = Openings(
            np.array([(away, -1.0, -0.5 * math.pi)]),
            np.diag((1e-4, 1e-4, 1e-6))[None],
            np.ones(1),
            np.full(1, 0.02),
            np.full(1, 0.99),
        )
        return Openings(*(np.concatenate(fields) for fields in zip(found, new, strict=True)))

    monkeypatch.setattr("hmt_slam_ros.places.estimator.extract_openings", and_a_new_one)
    list(drive(estimator, line((16.0, 0.0), (20.9, 0.0))))
    assert estimator.node_and_direction == (node_at(chart, 21.0), eastwards(chart))


def test_who_stands_beside_the_robot_does_not_move_the_middle_of_the_hallway(graph):
    estimator = PlaceEstimator(graph, CONFIGURATION)
    rng, pose = np.random.default_rng(0), np.array((2.5, 0.1, 0.0))
    beside = np.array([(2.3, 0.5, 2.7, 0.5), (2.3, 0.5, 2.3, 0.9), (2.7, 0.5, 2.7, 0.9)])
    person = np.concatenate([se2.transform(BUILDING, beside[:, k : k + 2]) for k in (0, 2)], axis=1)
    for _ in range(2):
        estimator.observe(scan_at(np.concatenate((walls(), person)), se2.compose(BUILDING, pose), 0.01, rng, 720))
    np.testing.assert_allclose(estimator.frame.center_point_ahead_in_base(2.0), (2.0, -0.1), atol=0.05)


def test_a_robot_that_stands_learns_nothing_however_its_wheels_tremble(chart, graph):
    start = state_of(node_at(chart, 10.0), eastwards(chart))
    estimator = PlaceEstimator(graph, CONFIGURATION, certain_belief(graph, CONFIGURATION.places, start))
    rng = np.random.default_rng(0)
    (first,) = drive(estimator, [(10.0, 0.0, 0.0)])
    for _ in range(300):
        estimator.predict(RelativeMotion(np.array((rng.normal(0.0, 0.03), 0.0, 0.0)), np.diag((1e-4, 1e-4, 1e-6))))
    assert estimator.observe(seen_at(np.array((10.0, 0.0, 0.0)), rng)) is first


def test_a_robot_that_turned_back_on_its_way_sees_what_it_saw_before(chart, graph):
    ways = (
        state_of(node_at(chart, 10.0), heading) for heading in (eastwards(chart), opposite_direction(eastwards(chart)))
    )
    there, back = (
        select_landmarks(
            graph.expected_landmarks.landmarks, slice(*graph.expected_landmarks.starts[state : state + 2].tolist())
        )
        for state in ways
    )
    assert np.abs(there.positions).max() > 5.0
    for one, other in zip(there, reverse_direction(back), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)
