"""Rules of the search in the whole map and of TSBI around it, with matches that are given."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from ring_for_tsbi import RING, Run, ring_drive

from hmt_slam_ros.configuration import Configuration
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.messages.messages import TrackingReset
from hmt_slam_ros.messages.replica import Replica
from hmt_slam_ros.registration.area_to_area import MatchMode, MatchSettings
from hmt_slam_ros.registration.branch_and_bound import SearchCells
from hmt_slam_ros.registration.consistency import Agreement
from hmt_slam_ros.registration.search_bounds import LogRatioGrid
from hmt_slam_ros.topological_inference import global_scan_matching as module
from hmt_slam_ros.topological_inference.branches import Parent
from hmt_slam_ros.topological_inference.branching import Branching
from hmt_slam_ros.topological_inference.global_scan_matching import FreeSpaceCheck, GlobalScanMatcher, query_bounds
from hmt_slam_ros.topological_inference.hypothesis_tree import HypothesisState, Lost
from hmt_slam_ros.topological_inference.pose_distribution import UNMAPPED_PRIOR


def test_walls_are_tested_between_keyframes_within_twelve_meters_of_each_other(monkeypatch):
    """Keyframes 1 and 2 are as far from the nearest of the query's as the limit, and a little farther."""
    query = {8: np.array([20.0, -3.0, 0.4]), 9: np.array([22.0, -4.0, 0.9]), 10: np.array([20.4, -3.2, 0.1])}
    away = np.array([0.6, 0.8])
    known = {
        0: np.array([21.0, -5.0, 2.0]),
        1: np.array([*(query[9][:2] + 11.99 * away), 0.1]),
        2: np.array([*(query[9][:2] + 12.01 * away), 0.2]),
        3: np.array([-20.0, 3.0, 0.0]),
    }
    counted = []

    def count(_mapping, map_scans, map_poses, scans, poses):
        counted.append((map_scans, np.array(map_poses), scans, np.array(poses)))
        return np.array([7, 2]) if len(counted) == 1 else np.array([30, 1])

    monkeypatch.setattr(module, "_count_in_map", count)
    scans_by_keyframe = {k: SimpleNamespace(points=np.zeros((10 + k, 2))) for k in (*known, *query)}
    check = FreeSpaceCheck(scans_by_keyframe, Configuration())
    beams = sum(10 + k for k in (0, 1, *query))
    assert check.compare(known, query) == (Agreement(40, 37, 3), module._BEAM_WORK * beams)
    (map_scans, map_poses, scans, poses), (*_, back_scans, back_poses) = counted
    assert map_scans == back_scans == [scans_by_keyframe[k] for k in (0, 1)]
    assert scans == [scans_by_keyframe[k] for k in (8, 9, 10)]
    middle = np.array([20.8, -3.4, 0.0])
    np.testing.assert_allclose(map_poses, [known[k] - middle for k in (0, 1)])
    np.testing.assert_allclose(poses, [query[k] - middle for k in (8, 9, 10)])
    np.testing.assert_array_equal(back_poses, map_poses)
    assert check.compare({}, query) == check.compare(known, {}) == (Agreement(0, 0, 0), 0)


def test_the_middle_of_the_query_is_bounded_by_the_radius_and_its_farthest_keyframe():
    points = np.array([[1.0, 2.0], [3.0, 0.0], [2.0, 4.0]])
    poses = {5: np.array([2.0, 2.0, 1.0]), 6: np.array([-1.0, -2.0, 0.3])}
    positions = np.array([[0.0, 5.0], [7.0, -1.0]])
    reach = 1.5 + 5.0
    found = query_bounds(positions, SimpleNamespace(points=points), poses, 1.5)
    np.testing.assert_allclose(found, [[-reach, -1.0 - reach], [7.0 + reach, 5.0 + reach]])
    empty = query_bounds(positions, SimpleNamespace(points=points[:0]), poses, 1.5)
    np.testing.assert_allclose(empty[1] - positions.max(axis=0), 1.5 + np.hypot(2.0, 2.0))


def test_matches_count_in_the_areas_that_are_searched_alone(monkeypatch):
    """Modes in the places of areas 2 and 3, and in none; only area 2 is searched."""
    rng = np.random.default_rng(4)
    modes = [
        MatchMode(
            PoseGaussian(np.array([x, 1.0, 0.5]), np.eye(3)), PoseGaussian(np.array([x, 1.0, 0.5]), np.eye(3)), 0.0
        )
        for x in (2.0, 3.0, -1.0, 2.5)
    ]
    searched, matched = [], []
    cells = SearchCells(np.zeros((1, 3), np.int64), np.ones(1), np.zeros(1), 7)
    monkeypatch.setattr(module, "find_cells", lambda *given: searched.append(given) or cells)
    monkeypatch.setattr(
        module, "match_areas", lambda *given: matched.append(given) or SimpleNamespace(modes=modes, work=9)
    )
    places = {2.0: 2, 3.0: 3, -1.0: None, 2.5: 2}
    monkeypatch.setattr(module, "containing_area", lambda _place, poses, _radius: places[float(poses[0, 0])])
    grid = module.AreaGrid(
        np.zeros(2), 0.1, np.zeros((9, 9)), np.zeros((18, 18), np.float32), np.zeros((9, 9), bool), rng.random((70, 2))
    )
    surface = LogRatioGrid(grid.log_ratio, grid.origin, grid.cell)
    cache = SimpleNamespace(
        coarse_grid=lambda _known: surface, grid=lambda _known: grid, holds_grid=lambda _known: True
    )
    known = {1: np.array([0.0, 0.0, 0.3]), 2: np.array([5.0, 1.0, 0.2]), 3: np.array([9.0, 3.0, 0.1])}
    positions = np.array([[0.0, 0.0], [5.0, 1.0], [9.0, 3.0]])
    matcher = GlobalScanMatcher(cache, None, MatchSettings(temper=0.1, margin=2.0), 1.5, 6.0)
    search = (known, np.array([2, 3, 2]), grid, {7: np.zeros(3)}, {2}, 0.8)
    found, work = matcher._match_keyframes(*search)
    assert work == 9 + len(modes) * module._MODE_WORK
    assert [(each.area, each.mode) for each in found] == [(2, modes[0]), (2, modes[3])]
    sparse_query, given_surface, back, prior, settings, bounds, constraint = searched[0]
    assert matched[0][1] is grid
    assert matched[0][5] is cells
    assert given_surface is surface
    assert back.shape == (0, 2)
    np.testing.assert_array_equal(sparse_query.points, grid.points[::3])
    assert settings.temper == pytest.approx(0.3)
    assert settings.margin == pytest.approx(max(2.0, 0.15 * np.log(3.0) * 0.3 * 24))
    assert (settings.min_log_ratio, settings.max_modes, settings.check_reverse) == (0.8, 40, False)
    np.testing.assert_allclose(np.sqrt(np.diag(prior.covariance)), [100.0, 100.0, 20.0])
    # Keyframes of area 3 bound nothing.
    np.testing.assert_allclose(bounds, query_bounds(positions[[0, 2]], grid, {7: np.zeros(3)}, 1.5))
    is_searched = np.array([True, False, True])
    expected = module.constrain_around(positions, is_searched, np.zeros((1, 2)), 1.5, 0.1)
    np.testing.assert_array_equal(constraint.allowed.log_ratio, expected.allowed.log_ratio)
    # Of many samples 160 are matched at most.
    many = replace(grid, points=rng.random((1000, 2)))
    matcher._match_keyframes(*search[:2], many, *search[3:])
    np.testing.assert_array_equal(searched[1][0].points, many.points[::7])
    assert searched[1][4].temper == pytest.approx(0.7)
    cache.holds_grid = lambda _: False
    assert matcher._match_keyframes(*search) == (None, 7)
    # Where nothing fits, no map is built.
    cache.grid = None
    monkeypatch.setattr(module, "find_cells", lambda *_: SearchCells(np.zeros((0, 3), np.int64), *np.zeros((2, 0)), 9))
    assert matcher._match_keyframes(*search) == ([], 9)


@pytest.mark.parametrize("lost", [(), (1,), (0, 1)])
def test_between_searches_the_heaviest_map_and_the_places_of_lost_hypotheses_are_prepared(lost):
    maps, looked, prepared = (HybridMap(), HybridMap()), [], []
    branching = Branching(Configuration(), Replica())
    branching.search = SimpleNamespace(look_ahead=looked.append)
    parents = [
        Parent(n, 0, maps[n], HypothesisState(localization=Lost(30 + n)) if n in lost else HypothesisState(), -1.0 + n)
        for n in range(2)
    ]
    branching.look_ahead(parents)
    branching.landmarks = SimpleNamespace(prepare_places=prepared.append)
    branching.look_ahead(parents)
    assert [each is maps[1] for each in looked] == [True, True]
    assert len(prepared) == bool(lost)
    for given in prepared:
        assert [(each is maps[n], since) for (each, since), n in zip(given, lost, strict=True)] == [
            (True, 30 + n) for n in lost
        ]


def test_a_robot_is_localized_until_it_is_lost_or_tracking_is_reset():
    run = Run(RING)
    for pose in ring_drive(3):
        run.keyframe(pose)
    assert run.tsbi.localization == (True, 0.0)
    states = run.tsbi._state.hypothesis_states
    states[0] = HypothesisState(localization=Lost(2))
    entropy = -(UNMAPPED_PRIOR * np.log(UNMAPPED_PRIOR) + (1.0 - UNMAPPED_PRIOR) * np.log(1.0 - UNMAPPED_PRIOR))
    assert run.tsbi.localization == (False, pytest.approx(entropy))
    # No keyframe is from before the first.
    states[0] = HypothesisState(localization=Lost(0))
    assert run.tsbi.localization == (False, 0.0)
    states[0] = HypothesisState()
    run.tsbi.handle(TrackingReset(2, 9))
    assert run.tsbi.localization == (True, 0.0)
    run.tsbi.handle(TrackingReset(3, 9))
    assert run.tsbi.localization == (False, pytest.approx(entropy))


def test_keyframes_without_a_surface_that_stayed_fit_nowhere():
    """Beside a robot that people follow, all end points may be on people."""
    grid = module.AreaGrid(
        np.zeros(2), 0.1, np.zeros((9, 9)), np.zeros((18, 18), np.float32), np.zeros((9, 9), bool), np.zeros((0, 2))
    )
    surface = LogRatioGrid(np.zeros((9, 9), np.float32), np.zeros(2), 0.1)
    cache = SimpleNamespace(coarse_grid=lambda _known: surface)
    matcher = GlobalScanMatcher(cache, None, MatchSettings(), 1.5, 6.0)
    known = {1: np.array([0.0, 0.0, 0.3])}
    assert matcher._match_keyframes(known, np.array([2]), grid, {7: np.zeros(3)}, {2}, 0.8) == ([], 0)
