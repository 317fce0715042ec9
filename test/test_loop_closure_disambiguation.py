"""Where a look would decide between two hypotheses, and how much it would tell."""

import math

import numpy as np
import pytest
import worlds

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.loop_closure import disambiguation
from hmt_slam_ros.loop_closure.disambiguation import MAX_LOOKS, Disambiguation
from hmt_slam_ros.messages.ambiguity import NOT_DRIVEN, Ambiguity
from hmt_slam_ros.messages.documents import encode
from hmt_slam_ros.messages.replica import Replica

PLAIN = worlds.box(-6.0, -1.0, 20.0, 1.0)
"""A hallway of 26 m along x; the robot is at the origin."""

LEFT = np.array([[-6, -1, 20, -1], [20, -1, 20, 1], [20, 1, 10, 1], [10, 1, 10, 4], [10, 4, 8, 4], [8, 4, 8, 1]])
LEFT = np.concatenate((LEFT, [[8, 1, -6, 1], [-6, 1, -6, -1]])).astype(float)
"""The same with a niche on the left from x = 8 to 10 m."""

RIGHT = LEFT * (1.0, -1.0, 1.0, -1.0)
"""The same with the niche on the right."""

PATH = [(x, 0.0, 0.0) for x in np.arange(-5.0, 19.0, 1.0)]


def replica_of(*hypotheses, probabilities=None, scan_at=worlds.scan_at):
    """The hypotheses have the robot in areas of their own: each is (walls, keyframe poses in the area)."""
    scans, maps, number = {}, {}, 0
    for h, (walls, poses) in enumerate(hypotheses):
        maps[h] = HybridMap()
        for pose in poses:
            maps[h].set_keyframe(number, h, np.array(pose))
            scans[number] = scan_at(walls, pose)
            number += 1
    probabilities = probabilities or [1.0 / len(hypotheses)] * len(hypotheses)
    return Replica(scans, maps, dict(enumerate(probabilities)), {h: h for h in maps})


def ambiguity_of(replica, pose=(0.0, 0.0, 0.0)):
    return Disambiguation(Configuration()).ambiguity(7, replica, {h: np.array(pose) for h in replica.maps})


def test_where_the_maps_differ_at_one_place_a_look_there_decides():
    found = ambiguity_of(replica_of((LEFT, PATH), (RIGHT, PATH)))
    assert found.sequence == 7
    assert found.entropy == pytest.approx(math.log(2.0))
    best = found.looks[found.best_look()]
    assert 6.0 <= best.pose[0] <= 11.0
    assert best.area == 0
    assert best.path_length == pytest.approx(best.pose[0], abs=0.3)
    assert 0.9 * found.entropy < best.information <= found.entropy
    # Behind the robot nothing differs.
    assert all(look.information < 0.02 for look in found.looks if look.pose[0] < 0.0)
    assert found.text.startswith("2 hypotheses are probable (0.50 in area 0, 0.50 in area 1): ")
    assert " m ahead, in area 0, a look would decide, by 9" in found.text
    assert found.text.endswith(" % of what is open")


def test_one_scan_of_two_may_contradict_the_other_map():
    """A wall instead of the niche contradicts the map with it; a niche behind a known wall does not."""
    found = ambiguity_of(replica_of((LEFT, PATH), (PLAIN, PATH)))
    assert max(look.information for look in found.looks) == pytest.approx(0.5 * math.log(2.0), rel=0.02)


def test_the_looks_of_a_path_are_those_on_the_way():
    found = ambiguity_of(replica_of((LEFT, PATH), (RIGHT, PATH)))
    best = found.best_look()
    path = [found.looks[n] for n in found.path(best)]
    assert path[0].previous == NOT_DRIVEN
    assert path[-1] is found.looks[best]
    assert np.all(np.diff([look.pose[0] for look in path]) > 0.9)
    assert all(look.previous < n for n, look in enumerate(found.looks))
    lengths = [look.path_length for look in found.looks]
    assert lengths == sorted(lengths)


def test_equal_maps_tell_nothing():
    found = ambiguity_of(replica_of((LEFT, PATH), (LEFT, PATH)))
    assert found.looks
    assert max(look.information for look in found.looks) < 1e-9
    assert found.best_look() is None
    assert found.text.endswith("no look within 40 m of path would decide")


def test_keyframes_elsewhere_in_equal_places_tell_hardly_anything():
    shifted = [(x + 0.4, 0.1, 0.3) for x, _, _ in PATH]
    found = ambiguity_of(replica_of((LEFT, PATH), (LEFT, shifted)))
    assert found.best_look() is None


def test_a_laser_that_sees_half_a_circle_tells_what_is_ahead_of_the_robot_there():
    """All keyframes look along +x. On the way back a robot knows what it would see only where they were behind it."""

    def information_at(x, scan_at, pose):
        found = ambiguity_of(replica_of((LEFT, PATH), (RIGHT, PATH), scan_at=scan_at), pose)
        return next(look.information for look in found.looks if abs(look.pose[0] - x) < 0.1)

    there, back = (0.0, 0.0, 0.0), (18.0, 0.0, math.pi)
    for scan_at in (worlds.scan_at, worlds.scan_in):
        assert information_at(6.0, scan_at, there) > 0.5
    assert information_at(12.0, worlds.scan_at, back) > 0.5
    assert information_at(12.0, worlds.scan_in, back) < 1e-9
    assert information_at(9.0, worlds.scan_in, back) > 0.5


def test_where_the_robot_looked_since_nothing_new_is_to_be_seen():
    """The first hypothesis expected a niche at x = 9 m. The robot was there, and it did not decide."""
    replica = replica_of((LEFT, PATH), (PLAIN, PATH))
    before = ambiguity_of(replica)
    seen = max(replica.scans) + 1
    replica.scans[seen] = worlds.scan_at(PLAIN, (9.0, 0.0, 0.0))
    for h, hybrid_map in replica.maps.items():
        hybrid_map.set_keyframe(seen, h, np.array((9.0, 0.1 * h, 0.0)))
    after = ambiguity_of(replica)

    def near(found, x):
        return next(n for n, look in enumerate(found.looks) if abs(look.pose[0] - x) < 0.3)

    assert before.looks[near(before, 9.0)].information > before.looks[near(before, 7.0)].information + 0.01
    assert after.looks[near(after, 10.0)].information == after.looks[near(after, 7.0)].information


def test_a_look_heads_along_its_path():
    found = ambiguity_of(replica_of((LEFT, PATH), (RIGHT, PATH)), (10.0, 0.0, 0.0))
    for look in found.looks:
        expected = 0.0 if look.pose[0] > 10.0 else math.pi
        assert math.cos(look.pose[2] - expected) > 0.9


def test_known_ground_tells_against_new_ground_the_more_of_it_is_passed():
    found = ambiguity_of(replica_of((LEFT, [(0.0, 0.0, 0.0)]), (LEFT, PATH)))
    ahead = [look.information for look in found.looks if look.pose[0] > 0.0]
    assert len(ahead) > 10
    assert np.all(np.diff(ahead) > 0.0)
    assert ahead[0] < 0.1
    assert ahead[-1] > 0.3
    # On new ground of the most probable hypothesis, a look has the frame of the robot's area.
    assert {look.area for look in found.looks} == {0}


def test_one_hypothesis_has_no_looks():
    for probabilities in ([1.0, 0.0], [0.99, 0.01]):
        found = ambiguity_of(replica_of((LEFT, PATH), (RIGHT, PATH), probabilities=probabilities))
        assert (found.entropy, found.looks, found.text) == (0.0, (), "")
        assert not found.is_open


def test_improbable_hypotheses_tell_less():
    def best(*probabilities):
        found = ambiguity_of(replica_of((LEFT, PATH), (RIGHT, PATH), probabilities=probabilities))
        return max(look.information for look in found.looks)

    assert best(0.5, 0.5) > best(0.8, 0.2) > best(0.95, 0.05) > 0.0


def test_the_result_is_the_same_to_the_bit():
    one, other = (ambiguity_of(replica_of((LEFT, PATH), (RIGHT, PATH))) for _ in range(2))
    assert encode(one) == encode(other)


def test_the_work_is_bounded(monkeypatch):
    """A floor of 900 keyframes under six hypotheses."""
    counts = []
    classify = disambiguation.classify_points

    def count(*arguments):
        counts.append(1)
        return classify(*arguments)

    monkeypatch.setattr(disambiguation, "classify_points", count)
    floor = [(x, y, 0.0) for x in np.arange(-15.0, 15.0) for y in np.arange(-15.0, 15.0)]
    scan = worlds.scan_at(worlds.box(-16.0, -16.0, 16.0, 16.0), (0.0, 0.0, 0.0))
    maps = {h: HybridMap() for h in range(6)}
    for h, hybrid_map in maps.items():
        for k, pose in enumerate(floor):
            hybrid_map.set_keyframe(k, h, np.array(pose) + 0.1 * h)
    replica = Replica(
        dict.fromkeys(range(len(floor)), scan), maps, dict.fromkeys(maps, 1.0 / 6.0), {h: h for h in maps}
    )
    found = ambiguity_of(replica)
    assert found.text.startswith("4 hypotheses")
    assert len(found.looks) == MAX_LOOKS
    assert len(counts) <= MAX_LOOKS * 4 * 3 * 4


def test_a_wall_between_the_keyframes_of_two_hallways_is_not_passed():
    """Two hallways side by side, which a robot drove one after the other; their ends are joined far ahead."""
    there = [(x, 0.0, 0.0) for x in np.arange(0.0, 15.0)]
    back = [(x, 1.5, math.pi) for x in np.arange(14.0, -1.0, -1.0)]
    found = ambiguity_of(replica_of((PLAIN, there + back), (PLAIN, [(0.0, 0.0, 0.0)])))
    beside = [look for look in found.looks if look.pose[1] > 1.0]
    assert beside
    assert all(look.path_length == pytest.approx(14.0 + 1.5 + 14.0 - look.pose[0], abs=0.1) for look in beside)


def test_best_look_goes_by_information_per_meter_and_may_leave_looks_out():
    found = ambiguity_of(replica_of((LEFT, PATH), (RIGHT, PATH)))
    best = found.best_look()
    rates = [look.rate for look in found.looks]
    assert rates[best] == max(rates)
    second = found.best_look(excluded=[best])
    assert second != best
    assert found.best_look(excluded=range(len(found.looks))) is None
    assert Ambiguity(0, 0.0, (), "").best_look() is None
