"""The message with the whole map has all that the replica has of the most probable hypothesis, also as GraphML."""

import io

import networkx as nx
import numpy as np
import pytest
from three_areas import SECOND, START, STEP, belief, chain

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.messages.alternatives import Alternatives, alternative_hypotheses
from hmt_slam_ros.messages.documents import decode, encode
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.messages.topology import Topology
from hmt_slam_ros.results.graphml import topology_graphml

AREA_POSES = {0: belief(np.zeros(3)), 1: belief(STEP), 2: belief(se2.compose(STEP, STEP))}


def make_topology(area_poses, messages=None):
    replica = Replica()
    for message in chain() if messages is None else messages:
        replica.apply_message(message)
    return Topology.from_replica(replica, area_poses, np.zeros(3), "map", 3, START)


@pytest.fixture(scope="module")
def topology():
    return make_topology(AREA_POSES)


def test_it_has_the_hypotheses_and_the_robot(topology):
    rows = [(known.hypothesis, known.probability, known.area) for known in topology.hypotheses]
    assert rows == [(1, 0.75, 2), (2, 0.2, 2)]
    assert topology.unexamined == pytest.approx(0.05)
    assert (topology.area, topology.events, topology.stamp, topology.frame) == (2, 3, START, "map")


def test_it_has_every_keyframe_with_stamp_and_pose(topology):
    assert [known.area for known in topology.areas] == [0, 1, 2]
    for number, known in enumerate(topology.areas):
        assert (known.keyframes, known.stamps) == ((number,), (START + number * SECOND,))
        assert np.array_equal(known.poses, np.zeros((1, 3)))
        assert known.pose is AREA_POSES[number]


def test_an_arc_is_as_probable_as_the_hypotheses_that_have_it(topology):
    rows = [(arc.source, arc.target, arc.closure, pytest.approx(arc.probability)) for arc in topology.arcs]
    assert rows == [(0, 1, False, 0.95), (0, 2, True, 0.75), (1, 2, False, 0.95)]


def test_an_area_without_a_pose_is_left_out_with_its_arcs():
    part = make_topology({area: pose for area, pose in AREA_POSES.items() if area != 2})
    assert [known.area for known in part.areas] == [0, 1]
    assert [(arc.source, arc.target) for arc in part.arcs] == [(0, 1)]
    assert part.area == 2


def test_before_the_first_keyframe_there_is_nothing():
    empty = make_topology({}, messages=[])
    assert (empty.areas, empty.arcs, len(empty.hypotheses)) == ((), (), 1)


def test_it_comes_back_from_its_document(topology):
    read = decode(encode(topology, reset_number=5, system="two"), Topology)
    assert np.array_equal(read.areas[1].pose.mean, STEP)
    assert read.areas[2].stamps == topology.areas[2].stamps
    assert [arc.probability for arc in read.arcs] == [arc.probability for arc in topology.arcs]


def test_the_other_hypotheses_differ_by_arcs_and_by_where_these_put_the_areas():
    replica = Replica()
    for message in chain():
        replica.apply_message(message)
    assert alternative_hypotheses(replica) == [2]
    poses = {2: {0: np.zeros(3), 1: STEP, 2: se2.compose(STEP, STEP)}}
    alternatives = Alternatives.from_replica(replica, poses, {1: np.zeros(3), 2: STEP}, 3)
    (other,) = decode(encode(alternatives), Alternatives).hypotheses
    assert (alternatives.best, other.hypothesis, other.area, other.pose.tolist()) == (1, 2, 2, STEP.tolist())
    assert [(arc.source, arc.target) for arc in other.missing_arcs] == [(0, 2)]
    assert other.arcs == ()
    assert [(area.area, area.has_own_keyframes, area.keyframes) for area in other.areas] == [
        (0, False, ()),
        (1, False, ()),
        (2, False, ()),
    ]


def test_as_graphml_it_has_areas_and_arcs_with_their_attributes(topology):
    graph = nx.read_graphml(io.BytesIO(topology_graphml(topology).encode()), node_type=int)
    assert [(area, values["robot"]) for area, values in graph.nodes.items()] == [(0, False), (1, False), (2, True)]
    assert [graph.nodes[1][name] for name in ("x", "y", "theta")] == STEP.tolist()
    assert (graph.nodes[1]["keyframes"], graph.nodes[1]["tt"]) == (1, pytest.approx(1e-4))
    assert graph.edges[0, 2]["closure"] is True
    assert graph.edges[0, 2]["probability"] == pytest.approx(0.75)
