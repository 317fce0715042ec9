"""Whatever the order in which DDS delivers the topics, a process receives the chain in one order."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rclpy", reason="the nodes need ROS 2: run scripts/test.sh, which installs it")

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.messages.messages import AreaEvents, ClosureDecision, Hypotheses, Keyframe
from hmt_slam_ros.ros.chain_order import CHAIN, ChainOrder


def message(kind, sequence):
    return {
        Keyframe: lambda: Keyframe(sequence, None, 0.0, ()),
        AreaEvents: lambda: AreaEvents(sequence, ()),
        Hypotheses: lambda: Hypotheses(sequence, ()),
        ClosureDecision: lambda: ClosureDecision(sequence),
    }[kind]()


def push(order, message):
    """What is due after a message."""
    order.push(message)
    return list(order.pop_due())


def name(message):
    return type(message), message.sequence


HEARD = st.lists(st.sampled_from(CHAIN), min_size=1, max_size=4, unique=True)


@given(HEARD, st.integers(1, 6), st.randoms(use_true_random=False))
def test_any_interleaving_of_the_topics_gives_one_order(received, events, random):
    topics = {kind: [message(kind, sequence) for sequence in range(events)] for kind in received}
    order, delivered = ChainOrder(received), []
    while any(topics.values()):
        kind = random.choice([kind for kind in received if topics[kind]])
        delivered += push(order, topics[kind].pop(0))
    expected = [(kind, sequence) for sequence in range(events) for kind in CHAIN if kind in received]
    assert [name(entry) for entry in delivered] == expected
    assert order.waiting_count == 0
    assert order.fault is None


def test_a_keyframe_that_overtakes_the_verdict_waits():
    order = ChainOrder((Keyframe, ClosureDecision))
    assert len(push(order, message(Keyframe, 0))) == 1
    assert push(order, message(Keyframe, 1)) == []
    assert order.waiting_count == 1
    assert [name(entry) for entry in push(order, message(ClosureDecision, 0))] == [(ClosureDecision, 0), (Keyframe, 1)]


def test_a_repeated_message_is_put_aside_and_counted():
    order = ChainOrder((Keyframe,))
    push(order, message(Keyframe, 0))
    assert push(order, message(Keyframe, 0)) == []
    assert order.repeated_count == 1
    assert order.fault is None


def push_ahead(order, sequence):
    with pytest.raises(HmtSlamError, match=f"Keyframe {sequence} came before 1: the node started too late or lost"):
        order.push(message(Keyframe, sequence))


def test_a_gap_is_reported_and_nothing_behind_it_is_delivered():
    order = ChainOrder((Keyframe,))
    push(order, message(Keyframe, 0))
    for sequence in (3, 4):
        push_ahead(order, sequence)
        assert order.fault is None
    push_ahead(order, 5)
    assert "Keyframe 1 never came, 3 did" in order.fault


def test_messages_of_strangers_ahead_of_the_chain_change_nothing():
    order = ChainOrder((Keyframe,))
    push(order, message(Keyframe, 0))
    for sequence in (9, 20_000, 10**18, 5, 9):
        push_ahead(order, sequence)
    assert order.fault is None
    assert order.waiting_count == 0
    assert [entry.sequence for k in (1, 2, 3) for entry in push(order, message(Keyframe, k))] == [1, 2, 3]


def test_a_message_that_is_refused_in_its_turn_leaves_its_place():
    forged, true = message(Hypotheses, 1), message(Hypotheses, 1)
    order = ChainOrder((Hypotheses,), first_event=1, is_admitted=lambda entry: entry is not forged)
    assert push(order, forged) == []
    assert push(order, true) == [true]
    assert order.fault is None
    assert order.events == 2


def test_a_forged_message_that_waits_for_its_turn_gives_way_to_the_true_one():
    forged, true = message(ClosureDecision, 0), message(ClosureDecision, 0)
    order = ChainOrder((Keyframe, ClosureDecision), is_admitted=lambda entry: entry is not forged)
    for entry in (forged, true, message(ClosureDecision, 1)):
        assert push(order, entry) == []
    assert [name(entry) for entry in push(order, message(Keyframe, 0))] == [(Keyframe, 0), (ClosureDecision, 0)]
    assert [name(entry) for entry in push(order, message(Keyframe, 1))] == [(Keyframe, 1), (ClosureDecision, 1)]


def test_a_message_that_all_forged_ones_preceded_still_finds_its_place():
    forged, true = message(ClosureDecision, 0), message(ClosureDecision, 0)
    order = ChainOrder((Keyframe, ClosureDecision), is_admitted=lambda entry: entry is not forged)
    for entry in (forged, message(ClosureDecision, 1)):
        assert push(order, entry) == []
    assert [name(entry) for entry in push(order, message(Keyframe, 0))] == [(Keyframe, 0)]
    assert push(order, true) == [true]
    assert [name(entry) for entry in push(order, message(Keyframe, 1))] == [(Keyframe, 1), (ClosureDecision, 1)]
    assert [name(e) for k in (2,) for kind in (Keyframe, ClosureDecision) for e in push(order, message(kind, k))] == [
        (Keyframe, 2),
        (ClosureDecision, 2),
    ]
