"""Of two systems on the same topics exactly one precedes, by the word of each of its nodes, and whatever is killed."""

from itertools import product

import pytest

from hmt_slam_ros.messages.precedence import Announcement, Precedence
from hmt_slam_ros.messages.system_name import SystemName

NODES = ("/slam", "/aam", "/rtl")


def stamp(seconds):
    return f"2026-11-29T17:{int(seconds) // 60:02}:{int(seconds) % 60:02}.{round(1e6 * (seconds % 1)):06}+00:00"


class Member:
    """A node that announces itself, and listens to all others."""

    def __init__(self, node, system, seconds):
        self.node, self.system, self.started = node, SystemName(system), stamp(seconds)
        self.precedence = Precedence(node, self.system, self.started)

    @property
    def announcement(self):
        return Announcement(self.node, self.system.name, self.started, self.precedence.system_started)

    def gives_way(self, now):
        return self.precedence.preceding(now) is not None


def announce(members, now):
    for sender, receiver in product(members, repeat=2):
        receiver.precedence.note(sender.announcement, now)


def verdicts(system, now):
    return {member.gives_way(now) for member in system}


@pytest.mark.parametrize(("one", "two"), [("one", "two"), ("two", "one"), ("", ""), ("same", "same"), ("", "two")])
def test_the_set_that_was_started_later_gives_way_with_all_of_its_nodes(one, two):
    first = [Member(node, one, k) for k, node in enumerate(NODES)]
    second = [Member(node, two, 10 + k) for k, node in enumerate(NODES)]
    announce([*first, *second], now=0.0)
    assert (verdicts(first, 1.0), verdicts(second, 1.0)) == ({False}, {True})
    assert verdicts(second, 5.1) == {False}  # the first has ended
    announce(second, now=5.1)
    assert verdicts(second, 5.2) == {False}


def test_sets_that_start_together_agree_and_those_of_one_time_go_by_name():
    first = [Member(node, "one", k) for k, node in enumerate(NODES)]
    second = [Member(node, "two", 0.5 * k) for k, node in enumerate(NODES)]
    for now in (0.0, 1.0):
        announce([*first, *second], now)
    assert (verdicts(first, 1.0), verdicts(second, 1.0)) == ({False}, {True})


def test_a_node_that_is_killed_and_started_again_is_as_old_as_its_system():
    first = [Member(node, "one", k) for k, node in enumerate(NODES)]
    second = [Member(node, "two", 10 + k) for k, node in enumerate(NODES)]
    announce([*first, *second], now=0.0)
    first[0] = Member("/slam", "one", 20)
    announce([*first, *second], now=1.0)
    assert first[0].announcement.system_started == stamp(0)
    assert (verdicts(first, 1.1), verdicts(second, 1.1)) == ({False}, {True})
    assert not Member("/slam", "one", 30).gives_way(1.1)  # nothing comes from the killed one


def test_a_node_of_another_name_counts_where_both_systems_have_a_name():
    robot = Member("/robot", "two", 10)
    for slam in (Member("/slam", "two", 5), Member("/slam", "", 5)):
        robot.precedence.note(slam.announcement, 0.0)
        assert not robot.gives_way(0.0)
    robot.precedence.note(Member("/slam", "one", 5).announcement, 0.0)
    assert robot.gives_way(0.0)


def test_nonsense_from_strangers_is_ignored_and_fills_no_memory():
    own = Member("/slam", "two", 10)
    for text in ("", "0", "2026", "2026-11-29 17:00:00", stamp(1).replace("+00:00", "+01:00"), "\x00" * 1000):
        assert not own.precedence.note(Announcement("/slam", "one", text, stamp(1)), 0.0)
        assert not own.precedence.note(Announcement("/slam", "one", stamp(1), text), 0.0)
    assert not own.gives_way(0.0)
    for number in range(1000):
        own.precedence.note(Announcement("/slam", f"stranger{number}", stamp(20), stamp(20)), 0.0)
    own.precedence.note(Announcement("/slam", "one", stamp(1), stamp(1)), 10.0)
    assert own.gives_way(10.0)
