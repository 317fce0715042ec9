"""The search of a component in another one while both grow."""

import pytest
from laps import CONFIGURATION, map_lap

from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.team import Verdict
from hmt_slam_ros.team.components import Component, Shift, combine
from hmt_slam_ros.team.join import judge
from hmt_slam_ros.team.placement_search import PlacementSearch
from hmt_slam_ros.topological_inference.map_search import MapSearch

WORLD = "sim:office,size=0.7,seed=51"
SHIFT = Shift(1000, 10_000)


def lap(number):
    """The map of a lap."""
    return map_lap(WORLD, number)


def part(component, share, first=0.0):
    """The areas with a part of the keyframes."""
    keyframes = sorted(component.scans)
    kept = set(keyframes[int(first * len(keyframes)) : int(share * len(keyframes))])
    hybrid_map = HybridMap()
    for area in component.hybrid_map.area_ids():
        own = {k: pose for k, pose in component.hybrid_map.keyframes(area).items() if k in kept}
        if own:
            hybrid_map.changed_areas[area] = own
    for a, b, arc in component.hybrid_map.all_arcs():
        if hybrid_map.has_area(a) and hybrid_map.has_area(b):
            hybrid_map.changed_arcs[a, b] = arc
    hybrid_map.commit()
    return Component.of_map(hybrid_map, component.scans)


def finish(search):
    """Take all steps; their number."""
    count = 0
    while (work := search.step()) is not None:
        assert work > 0
        count += 1
    return count


def search_parts(*shares):
    """The search of the second lap in the first while both grow, and the steps that each growth took."""
    search, steps = PlacementSearch(CONFIGURATION), []
    for first, second in shares:
        search.update(combine(part(lap(0), first), part(lap(1), second), SHIFT))
        steps.append(finish(search))
    return search, steps


@pytest.mark.long
def test_maps_that_grow_end_as_if_they_had_been_compared_whole():
    grown, _ = search_parts((0.3, 0.2), (0.3, 0.6), (1.0, 0.8), (1.0, 1.0))
    whole, _ = search_parts((1.0, 1.0))
    one, other = judge(grown, CONFIGURATION), judge(whole, CONFIGURATION)
    assert one.verdict is other.verdict is Verdict.JOINED
    assert one.distribution.apart == pytest.approx(other.distribution.apart, rel=1e-6)
    assert one.distribution.best.probability == pytest.approx(other.distribution.best.probability, rel=1e-9)


def test_a_window_is_searched_in_a_bounded_number_of_areas(monkeypatch):
    """Those that look most like it; the others count as not searched, and come when the maps have grown."""
    whole, (all_steps,) = search_parts((1.0, 1.0))
    monkeypatch.setattr("hmt_slam_ros.team.placement_search._FIRST_REGIONS", 1)
    monkeypatch.setattr("hmt_slam_ros.team.placement_search._REGIONS", 1)
    search, (first_steps, *_) = search_parts((1.0, 1.0))
    assert first_steps < all_steps
    assert not any(each.search.unexamined for each in whole._searches.values())
    assert any(each.search.unexamined for each in search._searches.values())
    # Each growth goes on with the next one.
    for share in (0.9, 1.0, 0.9, 1.0):
        search.update(combine(part(lap(0), share), lap(1), SHIFT))
        finish(search)
    assert not any(each.search.unexamined for each in search._searches.values())


def test_the_newest_windows_may_be_left_out():
    search, _ = search_parts((1.0, 1.0))
    assert search.comparison_work == 0
    whole = search.distribution()
    compared = search.comparison_work
    before = search.distribution(left_out=1)
    assert 0 < compared < search.comparison_work < 2 * compared
    assert before.best.probability < whole.best.probability
    assert max(before.best.matches) == len(search.windows) - 2


def test_what_was_searched_is_not_searched_twice():
    _, whole = search_parts((1.0, 1.0))
    _, twice = search_parts((1.0, 1.0), (1.0, 1.0))
    _, grown = search_parts((1.0, 0.5), (1.0, 1.0))
    assert twice == [whole[0], 0]
    assert sum(grown) <= 1.4 * whole[0]


def test_areas_that_are_new_are_searched_alone(monkeypatch):
    searched, continue_search = [], MapSearch.continue_search

    def count(map_search, hybrid_map, search):
        found = continue_search(map_search, hybrid_map, search)
        searched[-1] += len(search.unexamined) - len(found.unexamined)
        return found

    monkeypatch.setattr(MapSearch, "continue_search", count)
    search = PlacementSearch(CONFIGURATION)
    for first in (0.5, 1.0):
        searched.append(0)
        search.update(combine(part(lap(0), first), part(lap(1), 1.0), SHIFT))
        finish(search)
    windows, known = len(search.windows), part(lap(0), 0.5).hybrid_map
    # The area in which the first half ends has new keyframes.
    new = len(lap(0).hybrid_map.area_ids()) - len(known.area_ids()) + 1
    assert searched == [windows * len(known.area_ids()), windows * new]


def test_maps_are_not_joined_before_they_meet():
    search, _ = search_parts((0.4, 0.2))
    search.update(combine(part(lap(0), 0.4), part(lap(1), 1.0, first=0.6), SHIFT))
    finish(search)
    assert judge(search, CONFIGURATION).verdict is Verdict.APART


def test_a_step_that_is_open_leaves_its_share_to_what_was_not_searched():
    search = PlacementSearch(CONFIGURATION)
    search.update(combine(lap(0), lap(1), SHIFT))
    assert judge(search, CONFIGURATION).verdict is Verdict.APART
    assert search.step() is not None


def test_pruned_keyframes_end_their_window_alone():
    search = PlacementSearch(CONFIGURATION)
    search.update(combine(lap(0), lap(1), SHIFT))
    before = search.windows
    pruned = Component.of_map(lap(1).hybrid_map.subgraph(lap(1).hybrid_map.area_ids()), lap(1).scans)
    area = pruned.hybrid_map.area_ids()[0]
    pruned.hybrid_map.remove_keyframe(max(pruned.hybrid_map.keyframes(area)), area)
    search.update(combine(lap(0), pruned, SHIFT))
    kept = {tuple(window.poses) for window in search.windows} & {tuple(window.poses) for window in before}
    assert len(kept) >= len(before) - 2
