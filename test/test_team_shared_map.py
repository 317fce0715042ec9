"""A map that is shared with other robots, as updates that may be lost, come twice, late or in parts."""

from dataclasses import replace

import numpy as np
import worlds

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import uninformative_belief
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.team import shared_map
from hmt_slam_ros.team.shared_map import NEW_KEYFRAMES, ForeignMap, ForeignMapState, SharedMap

ROOM = worlds.box(-5.0, -5.0, 5.0, 5.0)
STEP = PoseGaussian(np.array([4.0, 0.0, 0.0]), np.diag([0.01, 0.01, 0.001]))


class Robot:
    """A robot that maps areas in a row, and shares its map."""

    def __init__(self):
        self.map, self.scans, self.shared = HybridMap(), {}, SharedMap("one", "a")
        self.area = 0

    def map_keyframes(self, area, count):
        """Drive in an area, and share."""
        for _ in range(count):
            k = max(self.scans, default=-1) + 1
            self.map.set_keyframe(k, area, np.array([0.3 * k, 0.0, 0.0]))
            self.scans[k] = worlds.scan_in(ROOM, (0.1 * k, 0.0, 0.0), stamp=k)
        self.area = area
        return self.share()

    def join(self, a, b, pose=STEP):
        self.map.set_arc(a, b, pose, closure=False)
        return self.share()

    def share(self):
        self.map.commit()
        return self.shared.take_over(Replica(self.scans, {0: self.map}, {0: 1.0}, {0: self.area}))


def with_three_areas():
    robot = Robot()
    for area in range(3):
        robot.map_keyframes(area, 6)
        if area:
            robot.join(area - 1, area)
    robot.map_keyframes(3, 1)
    return robot


def receive(foreign, robot):
    """Request and apply updates until nothing is new; their number."""
    count = 0
    while foreign.apply(robot.shared.update_after(foreign.version)):
        count += 1
    return count


def assert_same(foreign, robot, areas):
    """The foreign map has these areas of the robot, with scans and arcs."""
    found = foreign.component()
    assert found.hybrid_map.area_ids() == areas
    for area in areas:
        own, other = robot.map.keyframes(area), found.hybrid_map.keyframes(area)
        assert list(own) == list(other)
        assert all(np.array_equal(own[k], other[k]) for k in own)
        assert all(found.scans[k] is robot.scans[k] for k in own)
    arcs = {(a, b): arc for a, b, arc in robot.map.all_arcs() if {a, b} <= set(areas)}
    assert {(a, b): arc.pose.mean.tolist() for a, b, arc in found.hybrid_map.all_arcs()} == {
        ends: arc.pose.mean.tolist() for ends, arc in arcs.items()
    }
    assert found.scans.keys() == {k for area in areas for k in robot.map.keyframes(area)}


def test_another_robot_gets_areas_scans_and_arcs():
    robot, foreign = with_three_areas(), ForeignMap(ForeignMapState("a"))
    assert receive(foreign, robot) == 1
    assert_same(foreign, robot, [0, 1, 2])


def test_nothing_new_is_an_update_without_items():
    robot, foreign = with_three_areas(), ForeignMap(ForeignMapState("a"))
    receive(foreign, robot)
    assert not robot.share()
    update = robot.shared.update_after(foreign.version)
    assert (update.scans, update.areas, update.until) == ((), (), foreign.version)
    assert not foreign.apply(update)


def test_only_what_changed_comes_again():
    robot, foreign = with_three_areas(), ForeignMap(ForeignMapState("a"))
    receive(foreign, robot)
    assert robot.join(0, 2)
    update = robot.shared.update_after(foreign.version)
    assert [area.area for area in update.areas] == [2]
    assert update.scans == ()
    assert foreign.apply(update)
    assert_same(foreign, robot, [0, 1, 2])


def test_the_robots_own_area_is_shared_in_steps():
    robot, foreign = Robot(), ForeignMap(ForeignMapState("a"))
    assert not robot.map_keyframes(0, NEW_KEYFRAMES - 1)
    assert robot.map_keyframes(0, 1)
    receive(foreign, robot)
    assert_same(foreign, robot, [0])
    assert not robot.map_keyframes(0, 2)
    # It is left, and whole.
    assert robot.map_keyframes(1, 1)
    receive(foreign, robot)
    assert_same(foreign, robot, [0])


def test_all_of_the_own_area_is_shared_where_the_robot_stands():
    robot, foreign = Robot(), ForeignMap(ForeignMapState("a"))
    robot.map_keyframes(0, NEW_KEYFRAMES)
    assert not robot.map_keyframes(0, 2)
    replica = Replica(robot.scans, {0: robot.map}, {0: 1.0}, {0: 0})
    assert robot.shared.take_over(replica, is_standing=True)
    assert not robot.shared.take_over(replica, is_standing=True)
    receive(foreign, robot)
    assert_same(foreign, robot, [0])


def test_what_is_not_committed_yet_is_shared_in_steps():
    """Keyframes become definite with the next accepted hypothesis, which may take a whole area."""
    robot, foreign = Robot(), ForeignMap(ForeignMapState("a"))
    replica = Replica(robot.scans, {0: robot.map}, {0: 1.0}, {0: 0})
    for n in range(2 * NEW_KEYFRAMES):
        robot.map.set_keyframe(n, 0, np.array([0.3 * n, 0.0, 0.0]))
        robot.scans[n] = worlds.scan_in(ROOM, (0.1 * n, 0.0, 0.0), stamp=n)
        assert robot.shared.take_over(replica) == (n in (NEW_KEYFRAMES - 1, 2 * NEW_KEYFRAMES - 1))
    receive(foreign, robot)
    assert_same(foreign, robot, [0])


def test_what_hypotheses_have_in_different_ways_stays_as_it_was_shared():
    robot, foreign = Robot(), ForeignMap(ForeignMapState("a"))
    robot.map_keyframes(0, NEW_KEYFRAMES)
    for n in range(NEW_KEYFRAMES, 2 * NEW_KEYFRAMES):
        robot.map.set_keyframe(n, 0, np.array([0.3 * n, 0.0, 0.0]))
        robot.scans[n] = worlds.scan_in(ROOM, (0.1 * n, 0.0, 0.0), stamp=n)
    assert robot.shared.take_over(Replica(robot.scans, {0: robot.map}, {0: 1.0}, {0: 0}))
    maps = {0: robot.map, 1: robot.map.branch()}
    maps[1].remove_keyframe(1, 0)
    assert not robot.shared.take_over(Replica(robot.scans, maps, {0: 0.5, 1: 0.5}, {0: 1, 1: 1}))
    receive(foreign, robot)
    assert_same(foreign, robot, [0])


def test_a_keyframe_that_moved_is_in_one_area():
    """The robot's area is divided, and the part that it is in comes later."""
    robot, foreign = Robot(), ForeignMap(ForeignMapState("a"))
    robot.map_keyframes(0, 2 * NEW_KEYFRAMES)
    receive(foreign, robot)
    moved = range(NEW_KEYFRAMES)
    for k in moved:
        robot.map.set_keyframe(k, 1, robot.map.keyframes(0)[k])
        robot.map.remove_keyframe(k, 0)
    robot.join(0, 1)
    update = robot.shared.update_after(foreign.version)
    areas = tuple(area for area in update.areas if area.area == 1)
    assert foreign.apply(replace(update, areas=areas))
    found = foreign.component().hybrid_map
    assert {area: list(found.keyframes(area)) for area in found.area_ids()} == {
        0: list(range(NEW_KEYFRAMES, 2 * NEW_KEYFRAMES)),
        1: list(moved),
    }
    # Without a loss both come at once.
    other = ForeignMap(ForeignMapState("a"))
    receive(other, robot)
    assert_same(other, robot, [0, 1])


def test_of_a_map_in_pieces_the_largest_is_the_component():
    """A robot is kidnapped: what it maps then is a piece of its own until its place is found."""
    robot, foreign, lost = with_three_areas(), ForeignMap(ForeignMapState("a")), np.array([10.0, 5.0, 1.0])
    robot.join(2, 3, uninformative_belief(lost))
    robot.map_keyframes(3, 17)
    robot.map_keyframes(4, 1)
    receive(foreign, robot)
    # As many keyframes as the older piece.
    assert_same(foreign, robot, [0, 1, 2])
    np.testing.assert_array_equal(foreign.component().pose, np.zeros(3))
    robot.join(3, 4)
    robot.map_keyframes(4, NEW_KEYFRAMES)
    receive(foreign, robot)
    assert_same(foreign, robot, [3, 4])
    np.testing.assert_allclose(foreign.component().pose, se2.compose([8.0, 0.0, 0.0], lost), atol=1e-6)
    robot.join(2, 3)
    receive(foreign, robot)
    assert_same(foreign, robot, [0, 1, 2, 3, 4])
    np.testing.assert_array_equal(foreign.component().pose, np.zeros(3))


def test_a_large_map_comes_in_parts(monkeypatch):
    monkeypatch.setattr(shared_map, "UPDATE_BYTES", 5_000)
    robot, foreign = with_three_areas(), ForeignMap(ForeignMapState("a"))
    assert receive(foreign, robot) > 3
    assert_same(foreign, robot, [0, 1, 2])


def test_parts_hold_their_limit_and_one_item_at_least(monkeypatch):
    monkeypatch.setattr(shared_map, "UPDATE_BYTES", 1)
    robot, foreign = with_three_areas(), ForeignMap(ForeignMapState("a"))
    assert receive(foreign, robot) == 3 * 7
    assert_same(foreign, robot, [0, 1, 2])


def test_areas_that_change_between_two_parts_lose_no_scan(monkeypatch):
    """The scans of area 0 come first, but the area itself comes last, since it changed meanwhile."""
    monkeypatch.setattr(shared_map, "UPDATE_BYTES", 5_000)
    robot, foreign = with_three_areas(), ForeignMap(ForeignMapState("a"))
    foreign.apply(robot.shared.update_after(0))
    robot.map.set_keyframe(0, 0, np.array([9.0, 0.0, 0.0]))
    robot.share()
    receive(foreign, robot)
    assert_same(foreign, robot, [0, 1, 2])


def test_lost_repeated_and_late_updates_do_no_harm(monkeypatch):
    monkeypatch.setattr(shared_map, "UPDATE_BYTES", 5_000)
    random, robot, foreign = np.random.default_rng(3), Robot(), ForeignMap(ForeignMapState("a"))
    underway = []
    for event in range(300):
        if event < 100:
            robot.map_keyframes(event // 12, 1)
            if event % 12 == 0 and event:
                robot.join(event // 12 - 1, event // 12)
        underway += [robot.shared.update_after(foreign.version)] * int(random.integers(1, 3))
        if random.random() < 0.7:
            foreign.apply(underway[random.integers(len(underway))])
    receive(foreign, robot)
    assert_same(foreign, robot, list(range(8)))


def test_an_update_behind_a_gap_or_of_another_session_brings_nothing():
    robot, foreign = with_three_areas(), ForeignMap(ForeignMapState("a"))
    assert not foreign.apply(robot.shared.update_after(2))
    other = ForeignMap(ForeignMapState("b"))
    assert not other.apply(robot.shared.update_after(0))
    assert foreign.version == other.version == 0


def test_areas_that_are_gone_are_gone_everywhere():
    robot, foreign = with_three_areas(), ForeignMap(ForeignMapState("a"))
    receive(foreign, robot)
    robot.map.merge(2, 1, STEP)
    robot.share()
    receive(foreign, robot)
    assert_same(foreign, robot, [0, 1])


def test_pruned_keyframes_are_gone_everywhere():
    robot, foreign = with_three_areas(), ForeignMap(ForeignMapState("a"))
    receive(foreign, robot)
    robot.map.remove_keyframe(3, 0)
    del robot.scans[3]
    robot.share()
    receive(foreign, robot)
    assert_same(foreign, robot, [0, 1, 2])
    late = ForeignMap(ForeignMapState("a"))
    receive(late, robot)
    assert_same(late, robot, [0, 1, 2])


def test_a_scan_that_changed_comes_again():
    robot, foreign = with_three_areas(), ForeignMap(ForeignMapState("a"))
    receive(foreign, robot)
    robot.scans[3] = worlds.scan_in(ROOM, (0.0, 1.0, 0.0), stamp=3)
    robot.map.set_keyframe(3, 0, robot.map.keyframes(0)[3])
    assert robot.share()
    update = robot.shared.update_after(foreign.version)
    assert [scan.keyframe for scan in update.scans] == [3]
    foreign.apply(update)
    assert_same(foreign, robot, [0, 1, 2])


def test_what_only_a_hypothesis_has_is_not_shared():
    robot = with_three_areas()
    version = robot.shared.version
    maps = {0: robot.map, 1: robot.map.branch()}
    maps[1].set_arc(0, 2, STEP, closure=True)
    assert not robot.shared.take_over(Replica(robot.scans, maps, {0: 0.5, 1: 0.5}, {0: 3, 1: 3}))
    assert robot.shared.version == version
