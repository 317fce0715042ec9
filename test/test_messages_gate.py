"""What passes from strangers to a process: messages that make sense, and folders that slam made."""

import numpy as np
import pytest

from hmt_slam_ros.errors import HmtSlamError
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.ambiguity import Ambiguity, Look
from hmt_slam_ros.messages.documents import SaveRequest, SaveResponse, encode
from hmt_slam_ros.messages.gate import ChainGate, check_message, check_save_folder, decode_checked
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Hypothesis, LocalEstimate
from hmt_slam_ros.messages.system_name import ForeignDocumentError, SystemName
from hmt_slam_ros.messages.team import Repetition, TeamGoal, TeamPlace, TeamStatus
from hmt_slam_ros.saved_map.folder import FileRecord


def estimate(covariance, x=0.0):
    return LocalEstimate(1, 0, 0, PoseGaussian(np.array([x, 0.0, 0.0]), np.array(covariance)), np.zeros(3), 0)


@pytest.mark.parametrize(
    "message",
    [
        Hypotheses(0, ()),
        Hypotheses(0, (Hypothesis(1, 0, 0.5, 0), Hypothesis(1, 0, 0.5, 0))),
        Hypotheses(0, (Hypothesis(0, 0, 1.5, 0),)),
        Hypotheses(-1, (Hypothesis(0, 0, 1.0, 0),)),
        estimate(-np.eye(3)),
        estimate([[1.0, 0.5, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
        estimate(1e300 * np.eye(3)),
        estimate(np.eye(3), x=1e308),
        Ambiguity(0, 0.5, (Look(0, np.zeros(3), 0.1, 1.0, 0),), ""),
        Ambiguity(0, 0.5, (Look(0, np.zeros(3), 0.1, 1.0, -2),), ""),
        Ambiguity(0, 0.5, (Look(0, np.zeros(3), 0.1, -3.0, -1),), ""),
        SaveRequest(2**62, 0, "", False),
        SaveRequest(1, -1, "", False),
        SaveResponse(1, "stranger", ()),
        SaveResponse(1, "aam", (FileRecord("../aam.json", 1, ""),)),
        TeamStatus("ann", "1", 1, "0", Repetition(1000.0, 1.0)),
        TeamStatus("ann", "1", 1, "0", Repetition(0.0, 0.0)),
        TeamStatus("ann", "1", 1, "0", Repetition(0.0, 1.5)),
        TeamGoal("ann", 9, False, False, TeamPlace("bob", 7, np.zeros(3)), False, -1.0),
        TeamGoal("ann", 9, False, False, TeamPlace("bob", 7, np.full(3, 1e8)), False, 5.0),
        TeamGoal("ann", 9, False, False, TeamPlace("bob", -7, np.zeros(3)), False, 5.0),
        TeamGoal("ann", 9, False, False, TeamPlace("a b", 7, np.zeros(3)), False, 5.0),
        TeamGoal("", 9, False, False, None, False, 0.0),
        TeamGoal("ann", -9, False, False, None, False, 0.0),
    ],
)
def test_a_message_that_makes_no_sense_is_refused(message):
    with pytest.raises(HmtSlamError, match=r" = .* is not .*: look for"):
        check_message(message)
    with pytest.raises(HmtSlamError):
        decode_checked(encode(message), type(message), SystemName())


def test_a_belief_without_uncertainty_passes():
    check_message(estimate(np.zeros((3, 3))))


def test_only_hypotheses_that_are_alive_go_on():
    gate = ChainGate((0,))
    with pytest.raises(HmtSlamError, match="parent = 7 is not a hypothesis that is alive"):
        gate.check(Hypotheses(0, (Hypothesis(8, 7, 1.0, 0),)))
    gate.note(Hypotheses(0, (Hypothesis(1, 0, 0.5, 0), Hypothesis(2, 0, 0.5, 0))))
    with pytest.raises(HmtSlamError, match="hypothesis = 0 is not a hypothesis that is alive"):
        gate.check(ClosureDecision(0, 0))
    gate.note(ClosureDecision(0, 2))
    assert gate.alive == {2}


def test_a_save_goes_only_into_a_folder_that_slam_made(tmp_path):
    made = tmp_path / ".map.partial-x" / "new"
    made.mkdir(parents=True)
    (made / "slam.json").write_text("{}")
    check_save_folder(made, "aam")
    for folder in (tmp_path, made.parent):
        with pytest.raises(HmtSlamError, match="is not a folder that slam made"):
            check_save_folder(folder, "aam")
    (made / "notes.txt").write_text("of somebody")
    with pytest.raises(HmtSlamError, match="holds a save's files alone"):
        check_save_folder(made, "aam")


def test_documents_of_another_system_are_left_out_and_remembered():
    system, message = SystemName("robot-1"), ClosureDecision(0)
    assert decode_checked(encode(message, 5, "robot-1"), ClosureDecision, system)[1] == 5
    for other in ("robot-2", ""):
        with pytest.raises(ForeignDocumentError, match="'robot-1' as this node: give each") as refused:
            decode_checked(encode(message, 0, other), ClosureDecision, system)
        assert refused.value.system == other
    assert system.other == ""
    system.note_other("robot-2")
    assert system.other == "robot-2"


def test_a_node_without_a_system_joins_the_first_that_it_receives():
    system = SystemName()
    decode_checked(encode(ClosureDecision(0)), ClosureDecision, system)
    assert system.name == ""
    decode_checked(encode(ClosureDecision(0), 0, "robot-1"), ClosureDecision, system)
    assert system.name == "robot-1"
    with pytest.raises(ForeignDocumentError):
        decode_checked(encode(ClosureDecision(0), 0, "robot-2"), ClosureDecision, system)


@pytest.mark.parametrize("name", ["a b", "x" * 101, "robot/1", "a\nb"])
def test_a_name_that_is_none_is_refused(name):
    with pytest.raises(HmtSlamError, match="is no name: use letters"):
        SystemName(name)
    with pytest.raises(HmtSlamError, match="is no name: give each system"):
        SystemName().admit(name)


def test_a_message_that_is_withdrawn_leaves_the_hypotheses_that_were_alive():
    gate = ChainGate((0,))
    gate.note(Hypotheses(0, (Hypothesis(7, 0, 1.0, 0),)))
    gate.withdraw()
    gate.check(Hypotheses(0, (Hypothesis(1, 0, 1.0, 0),)))
    gate.note(ClosureDecision(0))
    gate.withdraw()
    assert gate.alive == {0}
