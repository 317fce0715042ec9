"""The work of a robot's search in the maps of others: a share of a core, and all maps in turn."""

from collections import Counter
from dataclasses import replace

from test_team_run import office_run

from benchmark.lattice import Lattice
from benchmark.team_load import measure_load
from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.logs.stamps import NANOSECONDS
from hmt_slam_ros.messages.team import Repetition
from hmt_slam_ros.team import search_budget
from hmt_slam_ros.team import team as team_module
from hmt_slam_ros.team.search_budget import SearchBudget
from hmt_slam_ros.team.team import Team, TeamState

RATE = search_budget._WORK_PER_SECOND


def work_of(budget):
    """The work that is left, in seconds, by steps that begin in as many events as it takes."""
    count = 0
    while True:
        budget.begin_event()
        if not budget.is_left:
            return count / 100
        while budget.is_left:
            budget.spend(RATE // 100)
            count += 1


def test_work_grows_with_the_stamps_of_keyframes():
    budget = SearchBudget()
    assert not budget.is_left
    for stamp in (7.0, 7.5, 8.5):
        budget.note_stamp(round(stamp * NANOSECONDS))
    assert work_of(budget) == 1.5
    budget.add_time(0.25)
    assert work_of(budget) == 0.25


def test_work_that_was_too_much_is_paid_by_the_next_events():
    budget = SearchBudget()
    budget.spend(RATE)
    for stamp in (0.0, 0.5, 0.99):
        budget.note_stamp(round(stamp * NANOSECONDS))
        budget.begin_event()
        assert not budget.is_left
    budget.note_stamp(2 * NANOSECONDS)
    assert work_of(budget) == 1.0


def test_stamps_that_jump_back_add_no_work_and_those_that_jump_ahead_that_of_a_minute():
    budget = SearchBudget()
    for stamp in (100.0, 2.0):
        budget.note_stamp(round(stamp * NANOSECONDS))
    budget.begin_event()
    assert not budget.is_left
    budget.note_stamp(10**6 * NANOSECONDS)
    assert work_of(budget) == 60.0


def test_saved_work_is_not_done_at_one_event():
    budget = SearchBudget()
    budget.add_time(60.0)
    for _ in range(2):
        budget.begin_event()
        budget.spend(search_budget._EVENT_WORK - 1)
        assert budget.is_left
        budget.spend(1)
        assert not budget.is_left


def test_robots_that_drive_on_in_large_maps_do_no_more_work_than_their_share(monkeypatch):
    spent, steps, spend_in = Counter(), Counter(), SearchBudget.spend

    def spend(budget, work):
        spent[id(budget)] += work
        steps[id(budget)] = max(steps[id(budget)], work)
        spend_in(budget, work)

    monkeypatch.setattr(SearchBudget, "spend", spend)
    events = 12
    assert measure_load(Lattice(3, 3), Configuration(), events).share > 0.0
    assert len(spent) == 4
    for budget, work in spent.items():
        assert 0 < work <= RATE * events + steps[budget]


def test_maps_are_compared_in_turn_where_each_comparison_takes_several_events(monkeypatch):
    """All are outdated again at each event."""
    left, judged = Counter(), Counter()
    update, judge = team_module.PlacementSearch.update, team_module.judge

    def begin(search, *arguments):
        left[id(search)] = 3
        update(search, *arguments)

    def step(search):
        left[id(search)] -= 1
        return 10 if left[id(search)] >= 0 else None

    def count(search, configuration):
        judged[id(search)] += 1
        return judge(search, configuration)

    ann = office_run()[0].teams["ann"]
    eve = Team(Configuration(), TeamState("eve", "s", ann.state.replica))
    eve.handle(eve.status)
    names = ("abe", "bob", "zoe")
    for name in names:
        waiting = eve.handle(replace(ann.status, robot=name))
        while waiting:
            updates = ann.handle(replace(waiting.pop(), owner="ann", robot="dan"))
            waiting = [each for update in updates for each in eve.handle(replace(update, robot=name))]
    monkeypatch.setattr(team_module.PlacementSearch, "update", begin)
    monkeypatch.setattr(team_module.PlacementSearch, "step", step)
    monkeypatch.setattr(team_module, "judge", count)
    for event in range(60):
        for name in names:
            eve.handle(replace(ann.status, robot=name, repetition=Repetition(0.01 * (1 + event), 1.0)))
        eve.search(10, may_wait=False)
    assert len(judged) == len(names)
    assert max(judged.values()) - min(judged.values()) <= 1
