"""The robot's own ground in a map with that of others: what it shares with the team."""

import numpy as np
from worlds import blank_scan

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import uninformative_belief
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.team.own_ground import own_ground
from hmt_slam_ros.team.shared_map import ForeignMap, ForeignMapState, SharedMap

STEP = PoseGaussian(np.array([5.0, 0.0, 0.0]), np.diag([0.02, 0.02, 0.01]) ** 2)


def mixed_map():
    """Areas 0 and 4 of its own, 1 to 3 of others in a row between them; it added keyframe 7 to area 2."""
    hybrid_map = HybridMap()
    for area, keyframes in {0: [0, 1], 1: [-2], 2: [-3, 7], 3: [-4, -5], 4: [8]}.items():
        for keyframe in keyframes:
            hybrid_map.set_keyframe(keyframe, area, np.array([0.1 * keyframe, 0.0, 0.0]))
    for area in range(4):
        hybrid_map.set_arc(area, area + 1, STEP, closure=area == 0)
    hybrid_map.commit()
    return hybrid_map


def test_it_has_the_own_keyframes_alone():
    own = own_ground(mixed_map())
    assert {area: list(own.keyframes(area)) for area in own.area_ids()} == {0: [0, 1], 2: [7], 4: [8]}


def test_paths_through_foreign_ground_become_arcs():
    own = own_ground(mixed_map())
    assert {(a, b) for a, b, _ in own.all_arcs()} == {(0, 2), (2, 4)}
    np.testing.assert_allclose(own.arc(0, 2).mean, [10.0, 0.0, 0.0], atol=1e-9)
    assert own.arc(0, 2).covariance[0, 0] > STEP.covariance[0, 0]
    assert not own.arc_value(0, 2).closure


def test_a_map_without_foreign_ground_is_the_same():
    hybrid_map = HybridMap()
    for area in range(3):
        hybrid_map.set_keyframe(area, area, np.zeros(3))
    hybrid_map.set_arc(0, 1, STEP, closure=True)
    hybrid_map.set_arc(1, 2, uninformative_belief(np.zeros(3)), closure=False)
    hybrid_map.commit()
    own = own_ground(hybrid_map)
    assert all(own.keyframes(area) is hybrid_map.keyframes(area) for area in range(3))
    assert [(a, b) for a, b, _ in own.all_arcs()] == [(0, 1), (1, 2)]
    assert own.arc_value(0, 1) is hybrid_map.arc_value(0, 1)


def test_only_own_ground_is_shared():
    hybrid_map, shared, foreign = mixed_map(), SharedMap("bob", "1"), ForeignMap(ForeignMapState("1"))
    scans = {keyframe: blank_scan() for area in hybrid_map.area_ids() for keyframe in hybrid_map.keyframes(area)}
    replica = Replica(scans, {0: hybrid_map}, {0: 1.0}, {0: 3})
    assert shared.take_over(replica)
    foreign.apply(shared.update_after(0))
    found = foreign.component()
    assert found.hybrid_map.area_ids() == [0, 2, 4]
    assert found.scans.keys() == {0, 1, 7, 8}
    assert not shared.take_over(replica)
