"""The measurement of loops that only the belief proposes."""

import pytest

from benchmark.report import VALIDATION, document_marks
from benchmark.threeloops import AcceptedClosure, LoopDrive, Proposal, elsewhere_requirements, requirements

RIGHT, WRONG = Proposal(220.0, (0.1, 1.0)), Proposal(50.0, (6.0, 1.0))


def test_a_proposal_is_right_where_the_areas_lie_so():
    assert RIGHT.is_right
    assert not WRONG.is_right
    assert not Proposal(220.0, (0.1, 90.0)).is_right
    assert not Proposal(220.0, None).is_right


def test_a_loop_is_closed_at_the_first_right_closure_behind_its_begin():
    closures = [
        AcceptedClosure(100.0, is_right=True),
        AcceptedClosure(210.0, is_right=False),
        AcceptedClosure(240.0, is_right=True),
    ]
    assert LoopDrive(400.0, [200.0], [], closures).closing_distances == [40.0]
    assert LoopDrive(400.0, [200.0], [], closures[:2]).closing_distances == []


def test_what_is_required():
    nothing = [Proposal(float(at), None) for at in (30, 60, 250)]
    good = LoopDrive(400.0, [200.0], [*nothing, RIGHT], [AcceptedClosure(240.0, is_right=True)])
    control = LoopDrive(400.0, [200.0], [], [])
    assert all(one.is_met for one in requirements([good], [control]))
    false = {one.name: one.is_met for one in requirements([good._replace(proposals=[WRONG])], [control])}
    assert [name for name, met in false.items() if not met] == ["proposals that are false"]
    assert not all(one.is_met for one in requirements([control], [control]))
    assert not all(one.is_met for one in requirements([good], [good]))
    values = {one.name: one.value for one in requirements([good, control], [control, control])}
    assert values["loops closed, share"] == pytest.approx(0.5)


def test_elsewhere_nothing_false_is_proposed_or_closed():
    good = LoopDrive(400.0, [], [RIGHT, Proposal(60.0, None)], [AcceptedClosure(240.0, is_right=True)])
    assert all(one.is_met for one in elsewhere_requirements([good, good]))
    proposed, closed = elsewhere_requirements([good, good._replace(proposals=[WRONG])])
    assert (proposed.is_met, closed.is_met) == (False, True)
    proposed, closed = elsewhere_requirements([good._replace(accepted=[AcceptedClosure(90.0, is_right=False)]), good])
    assert (proposed.is_met, closed.is_met) == (True, False)


def test_the_document_has_a_place_for_it():
    text = VALIDATION.read_text()
    assert all(text.count(mark) == 1 for mark in document_marks("threeloops"))
