"""What the page keeps of a run: maps of the past, walls of keyframes, events; and words about hypotheses."""

import json
from dataclasses import replace

import numpy as np
import pytest
from map_for_page import BEST, OTHER, alternatives, evidence, topology

from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.messages.documents import KeyframeHeader
from hmt_slam_ros.messages.evidence import BranchStep, Evidence, HypothesisEvidence
from hmt_slam_ros.messages.map_changes import Arc, ArcEnds
from hmt_slam_ros.messages.messages import ClosureDecision, Hypotheses, Hypothesis, HypothesisEstimate, Keyframe
from hmt_slam_ros.registration.consistency import Clutter
from hmt_slam_ros.sensors import MarkObservation, Scan
from hmt_slam_ros.view.board import Board, ClientState
from hmt_slam_ros.view.map_sections import LaserBeams, MapSections
from hmt_slam_ros.view.run_events import RunEvents
from hmt_slam_ros.view.run_ring import RunRing
from hmt_slam_ros.view.topology_section import alternatives_section, evidence_section, topology_section
from hmt_slam_ros.view.wall_points import WallPoints

BELIEF = PoseGaussian(np.zeros(3), 0.01 * np.eye(3))


def test_the_past_covers_the_whole_run_with_few_snapshots():
    ring = RunRing(max_snapshots=10)
    for event in range(1000):
        ring.add(event, 0.5 * event, {"event": event})
    events = [event for event, _ in ring.index()]
    assert events[0] == 0
    assert events[-1] > 850
    assert 5 <= len(events) <= 10
    assert max(np.diff(events)) <= 2 * min(np.diff(events))
    assert json.loads(ring.content(events[3] + 1)) == {"event": events[3]}
    assert json.loads(ring.content(10**9)) == {"event": events[-1]}


def test_the_past_has_bounded_memory_and_begins_again_with_a_new_run():
    ring, generator = RunRing(max_bytes=20_000), np.random.default_rng(1)
    for event in range(200):
        ring.add(event, 1.0 * event, {"numbers": generator.random(100).tolist()})
        assert sum(len(snapshot.content) for snapshot in ring._snapshots) <= 20_000
    assert len(ring.index()) >= 5
    ring.add(3, 5000.0, {})
    assert ring.index() == [[3, 5000.0]]
    huge = RunRing(max_bytes=10)
    huge.add(0, 0.0, {"numbers": list(range(1000))})
    assert huge.content(0) == b""


def test_walls_are_thinned_and_given_once():
    walls = WallPoints()
    for keyframe in range(700):
        walls.add(keyframe, np.full((500, 2), 0.01 * keyframe))
    first = json.loads(walls.answer(0))
    assert (len(first["keyframes"]), first["more"]) == (500, True)
    second = json.loads(walls.answer(first["next"]))
    assert [row[0] for row in second["keyframes"]] == list(range(500, 700))
    assert not second["more"]
    assert all(len(flat) == 120 for _, flat in first["keyframes"])
    assert first["keyframes"][3][1][:2] == [3, 3]
    for keyframe in range(700, 6000):
        walls.add(keyframe, np.zeros((1, 2)))
    assert json.loads(walls.answer(0))["keyframes"][0][0] == 1000


def hypothesis(number, parent, *arcs, removed=()):
    return Hypothesis(number, parent, 0.5, 0, arcs=arcs, removed_arcs=removed)


def test_closures_are_events_where_they_are_accepted_or_withdrawn():
    events, closure = RunEvents(), Arc(3, 9, BELIEF, closure=True)
    messages = [
        Hypotheses(0, (hypothesis(0, 0),)),
        ClosureDecision(0),
        Hypotheses(1, (hypothesis(1, 0, closure), hypothesis(2, 0))),
        ClosureDecision(1),
        ClosureDecision(2, hypothesis=4),  # before the answer to it
        Hypotheses(2, (hypothesis(4, 1), hypothesis(2, 2))),
        ClosureDecision(2, hypothesis=4),
        Hypotheses(3, (hypothesis(4, 4, closure),)),
        ClosureDecision(3, hypothesis=4),
        Hypotheses(4, (hypothesis(5, 4, removed=(ArcEnds(3, 9),)), hypothesis(6, 4))),
        ClosureDecision(4, hypothesis=5),
    ]
    for message in messages:
        events.add(message)
    events.add_incident("slam: is silent")
    assert [(row["event"], row["kind"], row["text"]) for row in events.rows()] == [
        (2, "accepted", "closure of 3 with 9 accepted"),
        (4, "withdrawn", "closure of 3 with 9 withdrawn"),
        (4, "incident", "slam: is silent"),
    ]
    for number in range(1000):
        events.add_incident(f"{number}")
    assert len(events.rows()) == 300
    events.clear()
    assert events.rows() == []


@pytest.mark.parametrize(
    ("step", "title", "pro", "con"),
    [
        (
            BranchStep(1, "closure", 56, 3, 0.023, 0.97, 12.44, 0.8),
            "closes 56 with 3",
            ["12.4 m of walls match", "odometry and arcs alone: 97.0 %"],
            ["0.8 m of walls are seen through"],
        ),
        (BranchStep(1, "known_area", 3, None, 0.5, 0.00001, 5.0, 0.0), "is back in area 3", ["5.0 m of walls match"],
         ["odometry and arcs alone: 0 %"]),
        (BranchStep(1, "lost", 4, None, 0.5), "may be anywhere: it was moved, or an arc is wrong", [], []),
        (BranchStep(1, "withdrawal", 4, 2, 0.5), "withdraws the closure of 4 with 2", [], []),
    ],
)  # fmt: skip
def test_a_step_is_given_in_words(step, title, pro, con):
    (row,) = evidence_section(Evidence(1, (HypothesisEvidence(7, (step,)),)))["7"]
    assert (row["title"], row["pro"], row["con"]) == (title, pro, con)


def test_the_sections_of_a_map_are_json_with_all_its_hypotheses():
    section = topology_section(topology())
    assert section["hypotheses"] == [[BEST, 0.9, 5], [OTHER, 0.1, 5]]
    assert section["statements"] == [["ann states that areas 0 and 5 are the same place", 0.97]]
    assert "±0.05 m" in section["areas"][0]["text"]
    assert section["arcs"][-1]["text"].endswith("closed a loop")
    assert json.loads(json.dumps(section, allow_nan=False)) == section
    other = alternatives_section(alternatives())["hypotheses"][str(OTHER)]
    assert (other["missing"], len(other["areas"])) == ([[0, 5]], 6)
    assert [row["title"] for row in evidence_section(evidence())[str(OTHER)]] == ["is on new ground, area 5"]


def header(sequence, marks=()):
    scan = Scan(5, np.ones(3, dtype=np.float32), -0.1, 0.1, 0.05, 30.0, np.array([0.2, 0.0, 0.0]))
    estimate = HypothesisEstimate(0, 4, BELIEF, True, 0.0, 0.0, Clutter(), 12.0)
    return KeyframeHeader.from_keyframe(Keyframe(sequence, scan, 0.0, (estimate,), marks=marks))


def test_walls_and_scan_are_in_the_frame_of_the_robot_and_marks_in_that_of_an_area():
    board = Board()
    sections = MapSections(board)
    beams = LaserBeams(np.array([1.0, 2.0, np.inf, 3.0], dtype=np.float32), 0.0, 0.5 * np.pi, 0.05, 30.0)
    sections.show_scan(beams)  # the mounting is not known yet
    sections.add_keyframe_scan(0, beams)
    mark = MarkObservation(5, "lift 2", PoseGaussian(np.array([-2.0, 0.0, 0.0]), 0.01 * np.eye(3)))
    sections.add_keyframe(header(0, (mark,)))
    (row,) = json.loads(board.walls.answer(0))["keyframes"]
    assert row == [0, [120, 0, 20, 200, 20, -300]]
    sections.show_scan(replace(beams, angle_increment=-0.5 * np.pi))  # upside down: it turns the other way
    sections.add_topology(topology())
    known = board.wait_for_changes(ClientState())
    assert known["scan"] == [1.2, 0.0, 0.2, 2.0, 0.2, -3.0]
    assert known["marks"] == {"lift 2": {"area": 4, "at": [2.0, 0.0]}}
    assert known["past"] == [[23, 1024.0]]
    for sequence in range(1, 500):
        sections.add_keyframe(header(sequence))
    assert len(sections._geometries) <= 200
