"""Whatever the order in which DDS delivers the topics, a process receives the chain in one order."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from hmt_slam_ros.messages.messages import AreaEvents, ClosureDecision, Hypotheses, Keyframe
from hmt_slam_ros.ros.inbox import CHAIN, ChainOrder


def message(kind, sequence):
    return {
        Keyframe: lambda: Keyframe(sequence, None, 0.0, ()),
        AreaEvents: lambda: AreaEvents(sequence, ()),
        Hypotheses: lambda: Hypotheses(sequence, ()),
        ClosureDecision: lambda: ClosureDecision(sequence),
    }[kind]()


def name(message):
    return type(message), message.sequence


HEARD = st.lists(st.sampled_from(CHAIN), min_size=1, max_size=4, unique=True)


@given(HEARD, st.integers(1, 6), st.randoms(use_true_random=False))
def test_any_interleaving_of_the_topics_gives_one_order(received, events, random):
    topics = {kind: [message(kind, sequence) for sequence in range(events)] for kind in received}
    order, delivered = ChainOrder(received), []
    while any(topics.values()):
        kind = random.choice([kind for kind in received if topics[kind]])
        delivered += order.push(topics[kind].pop(0))
    expected = [(kind, sequence) for sequence in range(events) for kind in CHAIN if kind in received]
    assert [name(entry) for entry in delivered] == expected
    assert order.waiting_count == 0
    assert order.fault is None


def test_a_keyframe_that_overtakes_the_verdict_waits():
    order = ChainOrder((Keyframe, ClosureDecision))
    assert len(order.push(message(Keyframe, 0))) == 1
    assert order.push(message(Keyframe, 1)) == []
    assert order.waiting_count == 1
    assert [name(entry) for entry in order.push(message(ClosureDecision, 0))] == [(ClosureDecision, 0), (Keyframe, 1)]


def test_a_repeated_message_is_put_aside_and_counted():
    order = ChainOrder((Keyframe,))
    order.push(message(Keyframe, 0))
    assert order.push(message(Keyframe, 0)) == []
    assert order.repeated_count == 1
    assert order.fault is None


def test_a_gap_is_reported_and_nothing_behind_it_is_delivered():
    order = ChainOrder((Keyframe,))
    order.push(message(Keyframe, 0))
    assert order.push(message(Keyframe, 3)) == []
    assert order.push(message(Keyframe, 4)) == []
    assert "Keyframe 1 never came, 3 did" in order.fault
