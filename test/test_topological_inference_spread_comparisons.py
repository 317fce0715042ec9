"""A drive whose comparisons with known areas take several events each: its closures, and a map saved amid one."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.messages import AreaEvent
from hmt_slam_ros.offline.lock_step import LockStepRun
from hmt_slam_ros.open_log import open_log
from hmt_slam_ros.saved_map.folder import FolderReader, FolderWriter
from hmt_slam_ros.topological_inference import event_work
from hmt_slam_ros.topological_inference import tsbi as module
from hmt_slam_ros.topological_inference.branches import Branches, Parent
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState, Lost, Tracking
from hmt_slam_ros.topological_inference.tsbi import Tsbi, TsbiState

WORLD = "sim:ring,seed=1,size=0.7"


@pytest.fixture(autouse=True)
def _small_budget(monkeypatch):
    """Let an event make the map of one area at most, or compare keyframes with it."""
    monkeypatch.setattr(event_work, "_MAX_COMPARISON_WORK", 1)


def newest_hypotheses(run):
    newest = run.recorder.hypotheses[max(run.recorder.hypotheses)].hypotheses
    return [(h.id, h.probability, h.area, tuple((arc.source, arc.target) for arc in h.arcs)) for h in newest]


def comparisons(run):
    states = run.state.processes["tsbi"].hypothesis_states.values()
    return [state.comparison for state in states if state.comparison is not None]


def test_the_loop_closes_and_a_saved_comparison_goes_on_as_it_would_have(tmp_path):
    records = iter(open_log(WORLD).records())
    run = LockStepRun(Configuration())
    for record in records:
        run.process_record(record)
        if any(ongoing.prepared is not None for ongoing in comparisons(run)):
            break
    assert comparisons(run)
    writer = FolderWriter(tmp_path)
    writer.write("tsbi", run.state.processes["tsbi"])
    writer.finish("state", 1)
    saved = FolderReader(tmp_path, "state", 1).read("tsbi", TsbiState)
    other = LockStepRun(Configuration(), state=replace(run.state, processes={**run.state.processes, "tsbi": saved}))
    for record in itertools.islice(records, 60):
        run.process_record(record)
        other.process_record(record)
    assert newest_hypotheses(run) == newest_hypotheses(other)
    for record in records:
        run.process_record(record)
    replica = run.state.processes["tsbi"].replica
    best = max(replica.probabilities, key=replica.probabilities.__getitem__)
    assert replica.probabilities[best] > 0.9


def make_parent(hypothesis=0, **state):
    hybrid_map = HybridMap()
    hybrid_map.set_keyframe(0, 5, np.zeros(3))
    return Parent(hypothesis, 5, hybrid_map, HypothesisState(**state), 0.0)


def make_tsbi():
    """TSBI whose branching answers by its calls."""
    tsbi = Tsbi(Configuration())
    tsbi._branching = SimpleNamespace(
        continue_comparison=lambda _parent, comparison: ("compared", comparison),
        entry=SimpleNamespace(move=lambda _parent, area: ("moved", area)),
        recheck=lambda _parent, *areas: ("rechecked", *areas),
        find_unlinked_overlap=lambda *_: None,
        leads_elsewhere=lambda _parent: False,
        statements=SimpleNamespace(due_pair=lambda _parent: None),
        options=tsbi._options,
        is_marked=lambda _keyframes, _before: False,
    )
    return tsbi


def test_while_a_comparison_goes_on_each_hypothesis_is_first_in_turn():
    idle, busy = [make_parent(n) for n in range(3)], [make_parent(n, comparison=object()) for n in range(3)]
    assert module._in_turn(idle, 7) is idle
    order = [[parent.hypothesis for parent in module._in_turn(busy, sequence)] for sequence in (6, 7, 8)]
    assert order == [[0, 1, 2], [1, 2, 0], [2, 0, 1]]


def test_a_lost_robot_is_searched_under_the_most_probable_hypothesis_first():
    parents = [replace(make_parent(n, localization=Lost(3)), log_weight=w) for n, w in enumerate((-3.0, -0.1, -2.0))]
    assert [parent.hypothesis for parent in module._in_turn(parents, 7)] == [1, 2, 0]


def test_a_move_waits_for_the_end_of_a_comparison():
    tsbi, ongoing, event = make_tsbi(), object(), AreaEvent(0, "moved", (), 3, 0.5)
    assert tsbi._branch_on_area_event(make_parent(comparison=ongoing), event) == ("compared", ongoing)
    assert tsbi._branch_on_area_event(make_parent(), event) == ("moved", 3)


@pytest.mark.parametrize("mapping", [True, False])
def test_a_search_and_a_comparison_of_a_lost_hypothesis_take_turns(monkeypatch, mapping):
    """A comparison alone goes on at every event, and no other one begins meanwhile."""
    tsbi, ongoing = make_tsbi(), object()
    monkeypatch.setattr(module, "update_relocalization", lambda *_: Branches(["searched"]))
    monkeypatch.setattr(module, "accept_relocalization", lambda branches: branches)
    estimate = SimpleNamespace(pose=SimpleNamespace(mean=np.zeros(3)))
    answers = []
    for localization in (Lost(3, search=object()), Lost(3), Tracking()):
        parent = make_parent(comparison=ongoing, localization=localization, unmatched_keyframes=tuple(range(9)))
        for sequence in (20, 21):
            keyframe = SimpleNamespace(sequence=sequence, mapping=mapping)
            answers.append(tsbi._branch_without_area_event(parent, estimate, keyframe)[0])
    assert answers == ["compared", ["searched"], *["compared"] * 4]
    unmatched = make_parent(unmatched_keyframes=tuple(range(9)))
    assert tsbi._branch_without_area_event(unmatched, estimate, keyframe) == ("rechecked", ())


def test_keyframes_that_fitted_beside_an_area_are_compared_with_it_once():
    """At an event without a new keyframe, as in a hall, a comparison would have the same result."""
    tsbi, keyframe = make_tsbi(), SimpleNamespace(sequence=20, mapping=True)
    parent = make_parent(unmatched_keyframes=(4, 5, 6), pending_candidates=(2,))
    stored, unstored = (
        SimpleNamespace(pose=SimpleNamespace(mean=np.zeros(3)), stored=is_stored) for is_stored in (True, False)
    )
    assert tsbi._branch_without_area_event(parent, stored, keyframe) == ("rechecked", (2,))
    (stay,) = tsbi._branch_without_area_event(parent, unstored, keyframe).children
    assert stay.state.pending_candidates == (2,)
