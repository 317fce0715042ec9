"""What people state about places is evidence: what it weighs, what it closes, what it withdraws, and its bounds."""

import math
from dataclasses import replace

import numpy as np
import pytest
from misled import OverJson, make_misled

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.same_place import are_joined, middle_keyframe, same_place_probability
from hmt_slam_ros.messages.gate import check_message
from hmt_slam_ros.messages.messages import EndOfLog, Hypotheses, Hypothesis, Notice
from hmt_slam_ros.messages.statements import PlaceStatement, StatementEvidence, WeighedStatement, parse_statement
from hmt_slam_ros.offline.lock_step import LockStep
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.process_table import PROCESSES
from hmt_slam_ros.topological_inference.branches import Parent
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState
from hmt_slam_ros.topological_inference.statements import (
    StatementQueue,
    replace_keyframes,
    reweigh_by_statements,
    weigh_statements,
)
from hmt_slam_ros.topological_inference.tsbi import Tsbi

EVIDENCE = StatementEvidence(Configuration().tsbi)
SHARP = np.diag([0.05, 0.05, 0.01]) ** 2


def line(areas=5, deviation=0.05, closure=None, offset=(0.0, 0.0, 0.0)):
    """Areas 4 m apart along x, keyframe 10 a in the middle of area a and 10 a + 1 a meter on; a closure, if given."""
    hybrid_map = HybridMap()
    for area in range(areas):
        hybrid_map.set_keyframe(10 * area, area, np.zeros(3))
        hybrid_map.set_keyframe(10 * area + 1, area, np.array([1.0, 0.0, 0.0]))
    for area in range(areas - 1):
        arc = PoseGaussian(np.array([4.0, 0.0, 0.0]), np.diag([deviation, deviation, 0.001]) ** 2)
        hybrid_map.set_arc(area, area + 1, arc, closure=False)
    if closure is not None:
        hybrid_map.set_arc(*closure, PoseGaussian(np.array(offset), SHARP), closure=True)
    return hybrid_map


def weighed_statement(kind, first=0, second=4, reliability=0.95, number=1):
    """A statement about two areas of the line."""
    statement = PlaceStatement(kind, first, second, "ann", reliability)
    return WeighedStatement(number, 7, statement, 10 * first, 10 * second)


def test_a_text_states_what_it_says():
    assert parse_statement("same 3 56") == PlaceStatement("same", 3, 56)
    assert parse_statement(" refused 3 56 by ann at 0.8 ") == PlaceStatement("refused", 3, 56, "ann", 0.8)
    assert parse_statement("different 3 56 at .99").reliability == 0.99


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "is no statement"),
        ("same 3", "is no statement"),
        ("equal 3 4", "is no statement"),
        ("same 3 -4", "is no statement"),
        ("same 3 4 at nan", "is no statement"),
        ("same 3 3", "second = 3 of a statement is not another area than the first"),
        ("same 3 4 at 1", "reliability = 1.0 of a statement is not from 0.5 to 0.999"),
        ("same 3 4 at 0.2", "reliability = 0.2"),
        ("same 3 9999999999", "area = 9999999999 of a statement is not the id of an area"),
        ("same 3 4 by a\x07", "author"),
        ("x" * 10_000, "is no statement"),
    ],
)
def test_what_is_no_statement_is_refused_with_the_remedy(text, fault):
    with pytest.raises(HmtSlamError, match=fault) as refused:
        parse_statement(text)
    assert "write same, different or refused" in str(refused.value)
    assert len(str(refused.value)) < 400


def test_only_joined_areas_that_lie_together_are_one_place():
    assert same_place_probability(line(), 0, 40, 2.0, 1.5) == 0.0  # a loop that nothing closes
    here = line(closure=(0, 4))
    assert same_place_probability(here, 0, 40, 2.0, 1.5) == 1.0
    assert same_place_probability(here, 0, 30, 2.0, 1.5) < 0.01  # 4 m away
    assert same_place_probability(line(closure=(0, 4), offset=(2.9, 0.0, 0.0)), 0, 40, 2.0, 1.5) > 0.9
    assert 0.2 < same_place_probability(line(closure=(0, 4), offset=(0.0, 2.0, 0.0)), 0, 40, 2.0, 1.5) < 0.8
    assert same_place_probability(here, 0, 1, 2.0, 1.5) == 1.0  # in the same area
    assert same_place_probability(here, 0, 99, 2.0, 1.5) == 0.0


def test_a_closure_joins_the_areas_beside_its_ends_and_a_way_around_joins_none():
    hybrid_map = line(8, closure=(1, 6))
    assert are_joined(hybrid_map, 0, 7)
    assert are_joined(hybrid_map, 7, 0)
    assert are_joined(hybrid_map, 3, 4)
    assert not are_joined(hybrid_map, 2, 4)
    assert not are_joined(hybrid_map, 3, 7)


def test_the_middle_keyframe_is_the_nearest_to_the_middle():
    hybrid_map = line(2)
    hybrid_map.set_keyframe(5, 0, np.array([0.4, 0.0, 0.0]))
    assert middle_keyframe(hybrid_map, 0) == 5
    assert middle_keyframe(hybrid_map, 1) == 10


@pytest.mark.parametrize(
    ("kind", "opened", "closed"), [("same", 0.05, 0.95), ("different", 0.95, 0.05), ("refused", 0.95, 0.05)]
)
def test_a_statement_is_as_likely_as_its_author_is_reliable(kind, opened, closed):
    for hybrid_map, expected in ((line(), opened), (line(closure=(0, 4)), closed)):
        assert EVIDENCE.log_likelihood(hybrid_map, [weighed_statement(kind)]) == pytest.approx(
            math.log(expected), abs=1e-6
        )


def test_several_statements_are_independent():
    both = [weighed_statement("same"), weighed_statement("same", reliability=0.9, number=2)]
    assert EVIDENCE.log_likelihood(line(closure=(0, 4)), both) == pytest.approx(math.log(0.95 * 0.9), abs=1e-6)


def parent_with(hybrid_map, state=None):
    return Parent(0, 0, hybrid_map, state or HypothesisState(), 0.0)


def test_the_weight_follows_the_map_and_a_statement_counts_once():
    one = reweigh_by_statements(parent_with(line()), [weighed_statement("same")], EVIDENCE)
    assert one.log_weight == pytest.approx(math.log(0.05))
    again = reweigh_by_statements(replace(one, log_weight=0.0), [weighed_statement("same")], EVIDENCE)
    assert again.log_weight == 0.0
    closed = replace(again, hybrid_map=line(closure=(0, 4)))
    gained = reweigh_by_statements(closed, [weighed_statement("same")], EVIDENCE)
    assert gained.log_weight == pytest.approx(math.log(0.95 / 0.05), abs=1e-6)
    weighed_by_tlca = parent_with(line(), HypothesisState(statement_evidence=None))
    counted = reweigh_by_statements(weighed_by_tlca, [weighed_statement("same")], EVIDENCE)
    assert counted.log_weight == 0.0
    assert counted.state.statement_evidence == pytest.approx(math.log(0.05))


def test_statements_are_named_by_keyframes_bounded_and_replaced_by_later_ones_of_the_same_person():
    queue, hybrid_map = StatementQueue(), line(30)
    for text in ("same 0 4 by ann", "different 4 0 by ann", "same 0 4 by bob", "same 0 99"):
        queue = queue.add(parse_statement(text))
    queue, statements, dropped = queue.take((), hybrid_map, 12)
    assert [(str(one), one.number, one.event) for one in statements] == [
        ("ann states that areas 4 and 0 are different places", 2, 12),
        ("bob states that areas 0 and 4 are the same place", 3, 12),
    ]
    assert (statements[1].first_keyframe, statements[1].second_keyframe) == (0, 40)
    assert [text for text in dropped if "the map has no area 99" in text] == dropped != []
    for area in range(1, 29):
        queue = queue.add(PlaceStatement("same", 0, area, "cid"))
    _, many, _ = queue.take(statements, hybrid_map, 13)
    assert len(many) == 16
    assert many[-1].number == 31
    flooded = StatementQueue()
    for _ in range(1000):
        flooded = flooded.add(PlaceStatement("same", 0, 1))
    assert len(flooded.waiting) == 64


def test_a_refused_closure_is_that_of_the_oldest_keyframes_since_a_false_one_adds_to_the_area():
    hybrid_map = line(2)
    hybrid_map.set_keyframe(50, 0, np.array([0.1, 0.0, 0.0]))
    hybrid_map.set_keyframe(51, 0, np.array([0.2, 0.0, 0.0]))
    _, (refused, same), _ = (
        StatementQueue().add(parse_statement("refused 0 1 by a")).add(parse_statement("same 0 1 by b"))
    ).take((), hybrid_map, 60)
    assert (refused.first_keyframe, same.first_keyframe) == (0, 51)


def test_probabilities_are_sums_over_hypotheses_and_reported_when_they_are_new_or_decided():
    maps = {1: line(), 2: line(closure=(0, 4))}
    (one,), texts = weigh_statements([weighed_statement("same")], maps, {1: 0.6, 2: 0.3}, EVIDENCE)
    assert (one.probability, one.outlook) == (pytest.approx(1 / 3), "open")
    assert texts == ["ann states that areas 0 and 4 are the same place: this has a probability of 0.333 now"]
    (two,), texts = weigh_statements([one], maps, {1: 0.5, 2: 0.5}, EVIDENCE)
    assert (two.outlook, texts) == ("open", [])
    (three,), texts = weigh_statements([two], maps, {1: 0.02, 2: 0.98}, EVIDENCE)
    assert (three.outlook, len(texts)) == ("true", 1)
    assert weigh_statements([three], maps, {1: 0.02, 2: 0.98}, EVIDENCE)[1] == []
    (four,), texts = weigh_statements([three], maps, {1: 1.0}, EVIDENCE)
    assert (four.outlook, len(texts)) == ("false", 1)


def test_a_pruned_keyframe_is_replaced():
    (one,) = replace_keyframes([weighed_statement("same")], {40: 41, 7: 8})
    assert (one.first_keyframe, one.second_keyframe) == (0, 41)


def test_a_message_with_an_impossible_statement_is_refused():
    good = Hypotheses(0, (Hypothesis(0, 0, 1.0, 0),), statements=(weighed_statement("same"),))
    check_message(good)
    for bad in (
        replace(weighed_statement("same"), probability=1.5),
        replace(weighed_statement("same"), first_keyframe=-1),
        replace(weighed_statement("same"), statement=PlaceStatement("same", 0, 1, "ann", 2.0)),
        replace(weighed_statement("same"), event=-4),
    ):
        with pytest.raises(HmtSlamError):
            check_message(replace(good, statements=(bad,)))


LOG = "sim:ring,seed=3,size=1.5"


class Unwilling(Branching):
    """What makes children, and compares with no known area by itself: the second lap lies beside the first."""

    def _begin_comparison(self, parent, query, excluded, kind, only=()):
        return super()._begin_comparison(parent, query, parent.hybrid_map.area_ids(), kind, only)


def drive(branching, text, event, last):
    """A drive around a ring in lock-step, with a statement after an event: TLCA's best map, notices, statements.

    :param last: the event that it ends at.
    """
    tsbi, notices = Tsbi(Configuration(), branching), []
    processes = {row.name: row.make(Configuration()) for row in PROCESSES} | {"tsbi": tsbi}

    class Noting:
        def handle(self, message):
            if isinstance(message, Notice):
                notices.append(message.text)
            return []

    lock_step = LockStep({name: OverJson(process) for name, process in processes.items()} | {"recorder": Noting()})
    texts = [text]
    for record in open_log(LOG).records():
        lock_step.feed(record.measurement)
        now = -1 if tsbi._keyframe is None else tsbi._keyframe.sequence
        if texts and now >= event:
            tsbi.handle(parse_statement(texts.pop()))
        if now >= last:
            break
    lock_step.feed(EndOfLog())
    replica = processes["tlca"]._replica
    return replica.maps[replica.best_hypothesis], notices, replica.statements


def test_a_false_closure_that_a_person_refuses_is_withdrawn_before_others_contradict_it():
    hybrid_map, notices, (statement,) = drive(make_misled(2, 0, 3.8), "refused 0 2 by ann", 75, 90)
    assert hybrid_map.arc(0, 2) is None
    assert (statement.outlook, statement.statement.author) == ("true", "ann")
    (text,) = [text for text in notices if "against accepted closures" in text]
    assert "ann refuses the closure between areas 0 and 2, with reliability 0.95" in text
    assert "of these 2-0 is taken for false with probability 0.98" in text
    assert not any("contradicts those accepted before" in text for text in notices)


def test_a_true_closure_that_a_person_refuses_stays_and_the_reason_is_given():
    hybrid_map, notices, (statement,) = drive(Branching, "refused 0 3 by ann at 0.999", 200, 206)
    assert hybrid_map.arc_value(0, 3).closure
    assert statement.outlook == "false"
    assert any("but the map stays as it is" in text for text in notices)


@pytest.mark.parametrize(("text", "closes"), [("same 0 4 by ann", True), ("same 1 4 by ann at 0.999", False)])
def test_two_areas_that_a_person_states_to_be_one_place_are_joined_where_their_surfaces_fit(text, closes):
    hybrid_map, notices, (statement,) = drive(Unwilling, text, 190, 220)
    assert any(arc.closure for _, _, arc in hybrid_map.all_arcs()) == closes
    assert statement.outlook == ("true" if closes else "false")
    assert any("states that areas" in text for text in notices)
