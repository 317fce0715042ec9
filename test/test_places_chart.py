"""The chart of a small floor."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from small_floor import AREAS, CONFIGURATION, make_chart
from worlds import box, scan_at

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.landmark import Existence, Landmark
from hmt_slam_ros.landmarks.landmarks import OPENING
from hmt_slam_ros.places.area_views import AreaViewCache
from hmt_slam_ros.places.chart import CROSSING, DOOR, END, _node_draft, build_chart
from hmt_slam_ros.places.floor import SideOpening, aligned_neighborhoods
from hmt_slam_ros.places.observation_graph import OPENINGS
from hmt_slam_ros.places.place_graph import EAST, WEST
from hmt_slam_ros.simulation.building import FloorPlan
from hmt_slam_ros.submap.local_mapping import LocalMapping


@pytest.fixture(scope="module")
def charts():
    return make_chart()


def true_places(chart):
    return np.array([se2.compose(AREAS[node.area], node.pose) for node in chart.nodes])


def node_near(chart, x, y=0.0):
    """The node there."""
    (found,) = np.flatnonzero(np.hypot(*(true_places(chart)[:, :2] - (x, y)).T) < 0.3)
    return int(found)


def test_doors_crossings_and_ends_are_nodes_each_once(charts):
    chart = charts[0]
    kinds = {DOOR: 2, CROSSING: 1, END: 3}
    assert {kind: sum(node.kind == kind for node in chart.nodes) for kind in kinds} == kinds
    assert [chart.nodes[node_near(chart, x)].kind for x in (1.0, 5.0, 10.0, 16.0, 21.0)] == [
        END,
        DOOR,
        DOOR,
        CROSSING,
        END,
    ]
    assert chart.nodes[node_near(chart, 16.0, 11.0)].kind == END
    # All look along one of the building's axes.
    headings = true_places(chart)[:, 2] - true_places(chart)[0, 2]
    assert np.abs(se2.wrap(headings)).max() < 0.02
    assert all(node.existence > 0.8 for node in chart.nodes)


def test_opposite_doors_are_one_node_with_an_opening_on_either_side(charts):
    chart = charts[0]
    pair, single = chart.nodes[node_near(chart, 10.0)], chart.nodes[node_near(chart, 5.0)]
    directions = sorted(one.direction for one in pair.openings)
    assert directions[1] - directions[0] == 2
    assert len(single.openings) == 1
    assert single.openings[0].landmark.width == pytest.approx(1.0, abs=0.1)
    assert not any(one.leads_to_hallway for one in (*pair.openings, *single.openings))


def test_the_mouth_of_a_hallway_leads_to_a_hallway_and_so_does_what_is_on_both_sides_of_it(charts):
    crossing = charts[0].nodes[node_near(charts[0], 16.0)]
    assert len(crossing.openings) == 3
    assert all(one.leads_to_hallway for one in crossing.openings)


def test_edges_are_as_long_as_the_ways_between_their_nodes_and_lead_both_ways(charts):
    chart = charts[0]
    places = true_places(chart)
    ways = {(edge.start, edge.end): edge for edge in chart.edges}
    wanted = [node_near(chart, x) for x in (1.0, 5.0, 10.0, 16.0, 21.0)]
    pairs = set(itertools.pairwise(wanted)) | {(node_near(chart, 16.0), node_near(chart, 16.0, 11.0))}
    assert set(ways) == pairs | {(b, a) for a, b in pairs}
    for (a, b), edge in ways.items():
        assert edge.distance[0] == pytest.approx(math.dist(places[a, :2], places[b, :2]), abs=0.05)
        assert 0.0 < edge.distance[1] < 0.3**2
        assert edge.turn[0] == 0.0
    # An arc between two areas makes the way longer known the less.
    assert ways[wanted[1], wanted[2]].distance[1] > ways[wanted[2], wanted[3]].distance[1]


def test_a_node_shows_its_openings_to_the_side_on_which_they_are(charts):
    chart = charts[0]
    node = node_near(chart, 5.0)
    seen = chart.graph_nodes[node]
    axis = seen.north if chart.nodes[node].openings[0].direction in {EAST, WEST} else seen.east
    openings = axis.tracks >= OPENINGS
    assert openings.sum() == 1
    assert axis.tracks[openings][0] in {OPENINGS + 1, OPENINGS + 3}
    np.testing.assert_allclose(axis.positions[openings], 0.0, atol=0.05)


def test_a_hallway_that_leads_on_is_an_opening_of_its_crossing_to_both_sides(charts):
    chart = charts[0]
    number = node_near(chart, 16.0)
    (mouth,) = {
        edge.start_direction for edge in chart.edges if (edge.start, edge.end) == (number, node_near(chart, 16.0, 11.0))
    }
    seen = chart.graph_nodes[number].east if mouth in {EAST, WEST} else chart.update[number].north
    for track in (OPENINGS + 1, OPENINGS + 3):
        own = (seen.tracks == track) & (np.abs(seen.positions) < 0.1)
        assert own.sum() == 1
        assert seen.probabilities[own][0] >= 0.9
        assert seen.forms[own][0] == pytest.approx(2.0, abs=0.15)


def test_landmarks_of_rooms_are_not_those_of_the_hallway(charts):
    chart, _, views = charts
    listed = sum(len(edge.landmarks.tracks) for edge in chart.edges[::2])
    assert 0 < listed < sum(len(view.landmarks) for view in views.values())
    for edge in chart.edges:
        assert np.all((edge.landmarks.positions >= -1e-9) & (edge.landmarks.positions <= edge.distance[0] + 1e-9))


def test_a_wide_opening_behind_which_one_sees_far_is_a_crossing_before_anyone_drove_there():
    chart, *_ = make_chart(crossing_driven=False)
    crossing = chart.nodes[node_near(chart, 16.0)]
    assert crossing.kind == CROSSING
    assert len(crossing.openings) == 1
    # The way into it is not known.
    leaving = {edge.start_direction for edge in chart.edges if edge.start == node_near(chart, 16.0)}
    assert len(leaving) == 2
    assert crossing.openings[0].direction not in leaving


def test_the_chart_makes_a_graph_of_places(charts):
    chart = charts[0]
    graph = chart.graph(CONFIGURATION.places)
    assert graph.state_count == 4 * len(chart.nodes)
    assert (graph.successors >= 0).sum() == len(chart.edges)


def test_areas_that_lie_anywhere_to_each_other_share_no_node(charts):
    """The same floor, but nothing is known of how the two areas lie to each other."""
    _, hybrid_map, views = charts
    parted = hybrid_map.branch()
    parted.remove_arc(0, 1)
    apart = build_chart(parted, views, CONFIGURATION.features)
    places = {0: 0, 1: 0}
    for node in apart.nodes:
        places[node.area] += node.kind != END
        assert all(one.area == node.area for one in node.openings)
    # The pair of doors is seen from both.
    assert places == {0: 2, 1: 2}
    between = {apart.nodes[edge.start].area == apart.nodes[edge.end].area for edge in apart.edges}
    assert between == {True}


def test_openings_that_are_hardly_believed_in_are_no_nodes(charts):
    chart, hybrid_map, views = charts
    doubted = {
        area: view._replace(
            landmarks=tuple(
                dataclasses.replace(one, existence=dataclasses.replace(one.existence, confidence=0.3))
                for one in view.landmarks
            )
        )
        for area, view in views.items()
    }
    assert chart.nodes
    assert build_chart(hybrid_map, doubted, CONFIGURATION.features).nodes == ()


def test_north_is_one_direction_in_all_areas(charts):
    chart = charts[0]
    assert {node.area for node in chart.nodes} == {0, 1}
    for edge in chart.edges:
        away = se2.between(true_places(chart)[edge.start], true_places(chart)[edge.end])
        # From a pose that looks north, east is to the right.
        off = math.atan2(away[1], away[0]) + 0.5 * math.pi * edge.start_direction
        assert abs(float(se2.wrap(off))) < 0.05


def turning(walls, places):
    """The floor of an area with keyframes at these poses."""
    hybrid_map, rng = HybridMap(), np.random.default_rng(3)
    for k, pose in enumerate(places):
        hybrid_map.set_keyframe(k, 0, np.array(pose))
    scans = {k: scan_at(walls, np.array(pose), 0.01, rng, 720) for k, pose in enumerate(places)}
    return aligned_neighborhoods(
        hybrid_map, AreaViewCache(LocalMapping(CONFIGURATION), scans).views_of_map(hybrid_map)
    )[0]


def test_the_end_of_a_hallway_is_in_the_hallway_where_a_room_behind_a_door_is_not():
    plan = FloorPlan()
    plan.cut_rectangle(0.0, -1.0, 12.0, 1.0)
    plan.cut_rectangle(9.5, 0.9, 10.5, 1.3)
    plan.cut_rectangle(8.0, 1.2, 12.0, 5.0)
    person = box(8.8, -0.2, 9.2, 0.2)
    along = [(x, 0.0, 0.0) for x in np.arange(5.0, 8.1, 0.5)]
    end = [(11.0, 0.0, heading) for heading in np.arange(0.0, 6.0, 0.5)]
    room = [(x, y, 0.5 * math.pi) for x in (9.0, 10.0, 11.0) for y in (2.0, 3.0, 4.0)]
    floor = turning(np.concatenate((plan.walls(), person)), along + end + room)
    lies = {bool(floor.in_hallway[k].any()) for k in range(len(along))}
    ends = {bool(floor.in_hallway[k].any()) for k in range(len(along), len(along + end))}
    rooms = {bool(floor.in_hallway[k].any()) for k in range(len(along + end), len(along + end + room))}
    assert (lies, ends, rooms) == ({True}, {True}, {False})


BARRED = [(x, 7.5) for x in (4.0, 4.5, 5.0, 5.5, 6.0)]
FREE = [(x, None) for x in (6.0, 6.5, 7.0, 7.5)]


@pytest.mark.parametrize(
    ("again", "there"),
    [(BARRED, False), (BARRED[:2], True), (BARRED + FREE, True), (BARRED + BARRED[::-1] + [(2.0, 7.5)], False)],
    ids=["closed", "for a moment", "opened again", "seen free before it"],
)
def test_a_way_that_was_closed_is_none_until_it_is_seen_free_again(charts, again, there):
    chart, *_ = make_chart(again=again)
    ways = {(edge.start, edge.end) for edge in chart.edges}
    closed = node_near(chart, 5.0), node_near(chart, 10.0)
    assert {closed, closed[::-1]} <= ways if there else not {closed, closed[::-1]} & ways
    # All others stay, and so do the nodes.
    assert len(ways) == len(charts[0].edges) - (0 if there else 2)
    assert len(chart.nodes) == len(charts[0].nodes)


def test_of_a_door_in_several_areas_that_counts_which_was_seen_most_often():
    def make_opening(area, y, confidence, seen):
        pose = PoseGaussian(np.array([0.0, y, 0.0]), np.eye(3))
        landmark = Landmark(OPENING, pose, 0.9, 0.05, Existence(confidence, detections=seen))
        return SideOpening(area, 0, landmark, pose, EAST, False, pose.mean[:2])

    often, once = make_opening(0, 0.0, 0.97, 20), make_opening(1, 0.1, 0.99, 1)
    place = _node_draft([once, often], np.zeros((2, 2)))
    assert place.openings == (often,)
    assert place.area == 0
