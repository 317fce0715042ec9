"""The measurement of ways that are closed and opened again."""

import numpy as np
import pytest
from small_floor import AREAS, CONFIGURATION, charted, mapped

from benchmark.documents import VALIDATION, marks
from benchmark.institute_maps import InstituteMap
from benchmark.ways import Building, Drive, closing_of, requirements
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.places.chart import Chart
from hmt_slam_ros.places.observation_graph import no_landmarks
from hmt_slam_ros.places.place_graph import Edge


def building(arrived=True, closed=True, back=True, wrong=0):
    drives = [Drive(arrived, 30.0, 60.0, shut, 0) for shut in (False, closed, True)]
    return Building((20.0, 30.0), 10, (*drives, Drive(True, 20.0, 40.0, not back, wrong)))


def test_what_is_required():
    assert all(one.met for one in requirements([building()] * 2))
    bad = building(arrived=False, closed=False, back=False, wrong=4)
    assert [one.value for one in requirements([building(), bad])] == [0.5, 0.5, 0.5, 0.5, 4 / 80]
    assert not any(one.met for one in requirements([bad]))


def floor(joined):
    """The small floor, with a way that joins its ends on paper."""
    chart, hybrid_map, views = charted()
    nodes = np.array([node.pose for node in chart.nodes])
    ends = [k for k in range(len(nodes)) if sum(edge.start == k for edge in chart.edges) == 1]
    first, last = ends[0], ends[-1]
    taken = {(edge.start, edge.leaving) for edge in chart.edges}
    leaving = next(d for d in range(4) if {(first, d), (last, (d + 2) % 4)}.isdisjoint(taken))
    more = Edge(first, leaving, last, leaving, (60.0, 0.1), (0.0, 0.01), no_landmarks())
    edges = (*chart.edges, more, more.back) if joined else chart.edges
    return InstituteMap(None, hybrid_map, mapped()[1], views, Chart(chart.nodes, chart.seen, edges), AREAS)


def test_a_way_is_closed_round_which_another_one_leads_to_the_door():
    institute = floor(joined=True)
    closing = closing_of(institute, CONFIGURATION, np.random.default_rng(0))
    assert closing.lengths[0] < closing.lengths[1]
    assert closing.lengths[1] > 60.0
    (wall,) = closing.wall
    assert np.hypot(*(wall[2:] - wall[:2])) == pytest.approx(3.0)
    # It stands across the hallway.
    assert abs(0.5 * (wall[1] + wall[3])) < 0.2 or abs(0.5 * (wall[0] + wall[2]) - 16.0) < 0.2


def test_where_there_is_no_other_way_none_can_be_closed():
    with pytest.raises(HmtSlamError, match="no way of the chart can be closed"):
        closing_of(floor(joined=False), CONFIGURATION, np.random.default_rng(0))


def test_the_document_has_a_place_for_it():
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in marks("ways"))
