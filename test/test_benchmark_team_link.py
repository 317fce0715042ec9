"""The link between hosts with its faults, and how answers of teams are compared. No host is made, which needs root."""

import math
import socket
import time

import pytest

from benchmark.lossy_link import FrameCounts, LinkFaults, LossyLink
from benchmark.team_link import TeamOutcome, largest_difference, outcome_table, requirements

FRAMES = 200


@pytest.fixture
def hosts():
    """A switch and the ends of its links at three hosts: pairs of sockets, which are read and written as TAP is."""
    pairs = [socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM) for _ in range(3)]
    link = LossyLink([switch.fileno() for _, switch in pairs], seed=1)
    yield link, [host for host, _ in pairs]
    link.stop()
    for pair in pairs:
        for end in pair:
            end.close()


def frames_at(host, seconds=0.5):
    """What a host receives in some time."""
    frames, deadline = [], time.monotonic() + seconds
    while (left := deadline - time.monotonic()) > 0.0:
        host.settimeout(left)
        try:
            frames.append(host.recv(100))
        except TimeoutError:
            break
    return frames


def send(host, count=FRAMES):
    for number in range(count):
        host.send(f"{number}".encode())
        time.sleep(0.001)


def test_frames_reach_all_other_hosts_in_their_order(hosts):
    link, (one, *others) = hosts
    send(one, 20)
    for other in others:
        assert frames_at(other) == [f"{n}".encode() for n in range(20)]
    assert frames_at(one) == []
    assert link.counts == FrameCounts(40, 0)


def test_frames_are_lost_repeated_and_late(hosts):
    link, (one, other, _) = hosts
    link.faults = LinkFaults(lost=0.3, repeated=0.2, late=0.2, delay=0.02)
    send(one)
    frames = [int(frame) for frame in frames_at(other)]
    assert 0.2 < 1.0 - len(set(frames)) / FRAMES < 0.4
    assert 0.1 < len(frames) / len(set(frames)) - 1.0 < 0.3
    assert frames != sorted(frames)


def test_nothing_reaches_a_host_that_is_cut_off(hosts):
    link, (one, other, third) = hosts
    link.cut_off = frozenset([1])
    send(one, 5)
    send(other, 5)
    assert frames_at(other) == []
    assert len(frames_at(third)) == 5


def outcome(verdict="joined", x=1.0, missing=0, seconds=3.0):
    answers = {"ann, bob": (verdict, 0.99, (x, 0.0, 0.0))}
    return TeamOutcome(seconds, missing, answers, FrameCounts(10, 3), {"ann": "5 kB"})


@pytest.mark.parametrize(
    ("other", "difference"), [(outcome(), 0.0), (outcome(x=1.5), 0.5), (outcome(verdict="open"), math.inf)]
)
def test_answers_differ_by_the_distance_of_joins(other, difference):
    assert largest_difference(outcome(), other) == pytest.approx(difference)


def test_an_answer_that_is_missing_is_another_one():
    assert largest_difference(outcome(), TeamOutcome(0.0, 0, {}, FrameCounts(0, 0), {})) == math.inf


def test_maps_that_are_not_whole_fail():
    assert [each.is_met for each in requirements(outcome(), outcome())] == [True] * 4
    late = outcome(missing=1, seconds=500.0)
    assert [each.is_met for each in requirements(outcome(), late)] == [True, False, True, False]
    assert "30.0 % of 10" in outcome_table({"disturbed": outcome()})
