"""Bounds of the search over relative poses, its lattice, and constraints of positions."""

import itertools
import math

import numpy as np
import pytest
from scipy.ndimage import maximum_filter
from test_registration_branch_and_bound import brute_force

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.registration.branch_and_bound import (
    _push_quarters,
    _SearchProblem,
    gather_block_points,
    make_reverse_check,
    search_cells,
    sum_contradictions,
)
from hmt_slam_ros.registration.position_constraint import (
    build_constraint_pyramid,
    constrain_around,
    is_admissible,
    is_admissible_within,
    is_block_admissible,
)
from hmt_slam_ros.registration.search_bounds import (
    BLOCK,
    MAX_HEIGHT,
    MIN_HEIGHT,
    PAD,
    TOO_WIDE,
    WIDTHS,
    LogRatioGrid,
    SearchMemory,
    SquareRange,
    add_block,
    build_pyramid,
    count_known,
    group_turns,
    lattice_bounds,
    quarter_bounds,
    sample_cells,
    sort_by_phase,
    turns_in_group,
)
from hmt_slam_ros.registration.search_window import make_search_window, prior_bound


def values_at(level, cells, i, j):
    """The elements of a level at cells (n, 2) shifted by (i, j), 0 beyond it, shape (n,)."""
    x, y = (np.asarray(cells) + np.array([i, j])).T
    inside = (x >= 0) & (x < level.shape[1]) & (y >= 0) & (y < level.shape[0])
    return np.where(inside, level[np.where(inside, y, 0), np.where(inside, x, 0)], 0).astype(int)


def values_of(level, corners, classes, x, y):
    """What the points of a group may be at in the square that begins at tile (x, y), shape (n,), steps."""
    all_classes = np.array([values_at(each, corners, x + PAD, y + PAD) for each in level])
    values = np.take_along_axis(all_classes, np.minimum(classes, TOO_WIDE - 1)[None].astype(int), axis=0)[0]
    return np.where(classes == TOO_WIDE, 64, values)


@pytest.mark.parametrize("shape", [(40, 27), (41, 70), (30, 33)])
def test_the_bounds_of_a_lattice_are_those_of_its_squares(shape):
    rng = np.random.default_rng(shape[0])
    level = rng.integers(-128, 65, (len(WIDTHS), *shape)).astype(np.int8)
    level[rng.random(level.shape) < 0.5] = 0
    corners = rng.integers(-60, 60, (300, 2)).astype(np.int32)
    for (across, along), left, low in itertools.product(((1, 1), (5, 2), (2, 6)), (0, 3), (0, 1)):
        classes = rng.integers(0, TOO_WIDE + 1, 300).astype(np.int8)
        phased, squares = sort_by_phase(level, 8, SearchMemory()), SquareRange(left, low, across, along)
        bounds = lattice_bounds(phased, corners, classes, squares)
        for few in (classes, np.minimum(classes, TOO_WIDE - 1)):
            counts, largest = count_known(phased, corners, few, squares)
            for a, b in itertools.product(range(across), range(along)):
                values = values_of(level, corners, few, 4 * (left + a), 4 * (low + b))
                assert (counts[b, a], largest[b, a]) == ((values != 0).sum(), values.max(initial=0))
        for a, b in itertools.product(range(across), range(along)):
            assert bounds[b, a] == values_of(level, corners, classes, 4 * (left + a), 4 * (low + b)).sum()


@pytest.mark.parametrize("turns", [1, 2, 7, 16, 21])
def test_of_a_group_of_turns_a_point_has_the_smallest_square_of_tiles_that_has_all_of_its_squares(turns):
    rng = np.random.default_rng(turns)
    cells = (rng.integers(-40, 40, (1, 60, 2)) + rng.integers(0, 25, (turns, 60, 2))).astype(np.int32)
    cells[:, :30] = cells[:1, :30] + np.arange(turns)[:, None, None] // 3
    window_first, seen = np.array([-7, 5]), set()
    groups = group_turns(cells, window_first)
    assert groups.first[-1] == len(groups.corners) == len(groups.classes)
    for height in range(MIN_HEIGHT, MAX_HEIGHT + 1):
        tile, size = 2 ** (height - MIN_HEIGHT), turns_in_group(height)
        numbers = range(groups.first[height - MIN_HEIGHT], groups.first[height - MIN_HEIGHT + 1])
        assert size == 2 ** (height - 1)
        assert len(numbers) == math.ceil(turns / size)
        for n, number in enumerate(numbers):
            group = cells[n * size : (n + 1) * size] + window_first
            np.testing.assert_array_equal(groups.corners[number], np.floor(group.min(axis=0) / tile))
            end = group.max(axis=0) + 2**height
            tiles = (np.ceil(end / tile) - groups.corners[number]).max(axis=1)
            np.testing.assert_array_equal(groups.classes[number], np.searchsorted(WIDTHS, tiles))
            seen |= set(groups.classes[number].tolist())
    assert len(seen) == (1 if turns == 1 else 4)


def test_a_constraint_admits_the_cells_within_the_radius_of_a_position_anywhere_in_them():
    known = np.random.default_rng(3).uniform([-4.0, 1.0], [2.0, 4.0], (5, 2))
    is_searched = np.array([False, True, False, False, True])
    allowed = constrain_around(known, is_searched, np.zeros((1, 2)), 0.7, 0.2).allowed
    rows, columns = allowed.log_ratio.shape
    # And none beyond the grid.
    x, y = (allowed.origin[k] + 0.2 * (np.arange(-1, size + 1) + 0.5) for k, size in enumerate((columns, rows)))
    near = np.hypot(x[None, :, None] - known[:, 0], y[:, None, None] - known[:, 1]) <= 0.9
    expected = np.where(near[..., is_searched].any(axis=2), 1.0, 0.5 * near.any(axis=2))
    np.testing.assert_array_equal(np.pad(allowed.log_ratio, 1), expected)


@pytest.mark.parametrize("seed", range(4))
def test_half_of_the_keyframes_have_to_be_near_positions_and_one_near_a_searched_one(seed):
    rng = np.random.default_rng(seed)
    known, is_searched = rng.uniform(-1.0, 1.0, (4, 2)), np.array([True, False, False, False])
    keyframes = rng.uniform(-1.0, 1.0, (4 + seed % 2, 2))
    window = make_search_window(np.zeros(3), np.diag([0.4, 0.4, 0.4]) ** 2, 0.1, 0.2, 9.0)
    given = constrain_around(known, is_searched, keyframes, 0.4, 0.1)
    constraint = build_constraint_pyramid(given, window, SearchMemory())
    allowed, found = np.pad(given.allowed.log_ratio, 99), []
    for k, i, j in rng.integers([0, *window.first], [window.turns.size, *window.last + 1], (200, 3)).tolist():
        admissible = []
        for x, y in itertools.product(range(i, i + 4), range(j, j + 4)):
            column, row = (constraint.keyframes[k] + [x, y] + 99).T
            values = allowed[row, column]
            admissible.append(2 * (values > 0.0).sum() >= len(values) and values.max() == 1.0)
        assert is_admissible(constraint, k, i, j) == admissible[0]
        assert is_block_admissible(constraint, k, i, j) or not any(admissible)
        assert is_admissible_within(constraint, 2, k // 2, i - window.first[0], j - window.first[1]) or not any(
            admissible
        )
        found.append(admissible[0])
    assert {False, True} == set(found)


@pytest.mark.parametrize("mean", [(0.7, -0.4, 0.6), (-2.0, 1.0, -2.5)])
def test_the_lattice_is_the_gate_within_bounds(mean):
    covariance = np.array([[0.09, 0.02, 0.0], [0.02, 0.04, 0.0], [0.0, 0.0, 0.01]])
    bounds = np.array(mean)[:2] + np.array([[-0.33, -9.0], [9.0, 0.17]])
    with np.errstate(all="raise"):
        free, inside = (make_search_window(np.array(mean), covariance, 0.1, 0.05, 9.0, b) for b in (None, bounds))
    turn = np.array([[np.cos(mean[2]), -np.sin(mean[2])], [np.sin(mean[2]), np.cos(mean[2])]])
    half = 3.0 * np.sqrt(np.diag(turn @ covariance[:2, :2] @ turn.T)) / 0.1
    np.testing.assert_array_equal(free.last, np.ceil(half))
    np.testing.assert_array_equal(free.first, -np.ceil(half))
    assert inside.first.tolist() == [-4, free.first[1]]
    assert inside.last.tolist() == [free.last[0], 2]


@pytest.mark.parametrize("shape", [(13, 18), (4, 9), (33, 24)])
def test_a_pyramid_has_the_largest_log_ratios_of_squares_of_tiles_in_steps(shape):
    log_ratio = np.random.default_rng(4).normal(size=shape).astype(np.float32)
    pyramid = build_pyramid(log_ratio, SearchMemory())
    assert pyramid.step == pytest.approx(log_ratio.max() / 64.0)
    wide = np.pad(log_ratio, 99)
    steps = np.maximum(-128, np.ceil(wide / pyramid.step - 1e-4))
    rows, columns = pyramid.cells.shape
    np.testing.assert_array_equal(pyramid.cells, steps[99 - PAD :, 99 - PAD :][:rows, :columns])
    assert len(pyramid.levels) == MAX_HEIGHT + 1 - MIN_HEIGHT
    for tile, level in zip((1, 2, 4), pyramid.levels, strict=True):
        assert level.shape[0] == len(WIDTHS)
        assert level.shape[1:] == tuple(-(-size // 4) * 4 // tile + 2 * PAD for size in shape)
        for c, y, x in itertools.product(*map(range, level.shape)):
            left, low, side = 99 + (x - PAD) * tile, 99 + (y - PAD) * tile, WIDTHS[c] * tile
            inside = x < level.shape[2] - PAD and y < level.shape[1] - PAD
            assert level[c, y, x] == (steps[low : low + side, left : left + side].max() if inside else 0)


@pytest.mark.parametrize("seed", range(4))
def test_the_bound_of_the_prior_is_no_less_than_its_exponent_and_equal_for_a_single_cell(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * [[0.3], [0.3], [0.2]]
    covariance = root @ root.T + 1e-4 * np.eye(3)
    window = make_search_window(rng.uniform(-1.0, 1.0, 3), covariance, 0.1, 0.05, 9.0)

    def exponent(k, i, j):
        pose = window.mean + np.array([i * 0.1, j * 0.1, window.turns[k]])
        return -0.5 * float(np.sum((window.information_root @ se2.log(se2.between(window.mean, pose))) ** 2))

    information = window.information_root.T @ window.information_root
    np.testing.assert_allclose(information @ covariance, np.eye(3), atol=1e-6)
    for k, i, j in rng.integers([0, *window.first], [window.turns.size, *window.last + 1], (200, 3)):
        own = exponent(k, i, j)
        assert prior_bound(window, k, i, j, 1) == pytest.approx(own if own >= -4.5 else -np.inf)
        inside = [exponent(k, i + x, j + y) for x, y in itertools.product(range(4), repeat=2)]
        bound = prior_bound(window, k, i, j, 4)
        assert bound >= max(each if each >= -4.5 else -np.inf for each in inside) - 1e-9
        # By the triangle inequality: from the middle of the square to its corner that changes the exponent most.
        middle = window.whitening[k] @ (0.1 * (np.array([i, j]) + 1.5)) + window.offsets[k]
        corner = max(np.linalg.norm(window.whitening[k] @ (0.15 * np.array([1.0, side]))) for side in (-1.0, 1.0))
        nearest = max(0.0, np.linalg.norm(middle) - corner)
        assert bound == pytest.approx(-0.5 * nearest**2 if nearest**2 <= 9.0 else -np.inf)
    # The lattice holds the whole gate and hardly more.
    draws = np.random.default_rng(9).normal(size=(4000, 3))
    draws *= 3.0 / np.linalg.norm(draws, axis=1)[:, None]
    twists = np.linalg.solve(window.information_root, draws.T).T
    turned = np.abs(twists[:, 2]).max()
    assert turned <= window.turns[-1] < turned + 0.1
    assert window.turns[0] == -window.turns[-1]


@pytest.mark.parametrize("seed", range(4))
def test_a_block_has_all_points_that_contradict_in_one_of_its_cells_and_not_many_others(seed):
    rng = np.random.default_rng(seed)
    cell = rng.uniform(0.05, 0.2)
    log_ratio = np.where(rng.random((25, 30)) < 0.1, -1.0, 0.0).astype(np.float32)
    grid = LogRatioGrid(log_ratio, rng.uniform(-1.5, -0.5, 2), cell)
    window = make_search_window(rng.uniform(-2.0, 2.0, 3), np.diag([0.2, 0.2, 0.1]) ** 2, 0.1, 0.08, 9.0)
    check = make_reverse_check(window, grid, rng.uniform(-3.0, 3.0, (400, 2)))
    chosen = np.empty_like(check.points)
    for k, i, j in itertools.product(range(0, window.turns.size, 3), (-5, 3), (-4, 1)):
        count = gather_block_points(check, window, (k, i, j), chosen)
        contradicts = np.zeros(len(check.points), bool)
        for x, y in itertools.product(range(i, i + BLOCK), range(j, j + BLOCK)):
            pose = window.mean + np.array([x * 0.1, y * 0.1, window.turns[k]])
            at = np.floor((se2.transform(se2.inverse(pose), check.points) - grid.origin) / cell).astype(int)
            inside = np.all((at >= 0) & (at < (30, 25)), axis=1)
            contradicts[inside] |= log_ratio[at[inside, 1], at[inside, 0]] < 0.0
            whole, part = (sum_contradictions(grid, window, (k, x, y), p, -1e9) for p in (check.points, chosen[:count]))
            assert part == whole == -np.sum(log_ratio[at[inside, 1], at[inside, 0]] < 0.0)
        gathered = {tuple(point) for point in chosen[:count]}
        assert gathered >= {tuple(point) for point in check.points[contradicts]}
        # With the block's middle, a negative cell is within the reach.
        middle = window.mean + np.array([(i + 1.5) * 0.1, (j + 1.5) * 0.1, window.turns[k]])
        at = np.floor((se2.transform(se2.inverse(middle), check.points) - grid.origin) / cell)
        rows, columns = np.nonzero(log_ratio < 0.0)
        away = np.maximum(np.abs(at[:, :1] - columns), np.abs(at[:, 1:] - rows)).min(axis=1)
        assert gathered >= {tuple(point) for point in check.points[away <= check.reach]}
        assert gathered <= {tuple(point) for point in check.points[away <= check.reach + 1.0]}
    farthest = math.sqrt(0.5) * (BLOCK - 1) * 0.1 / cell
    assert farthest + 1.0 <= check.reach < farthest + 2.0


@pytest.mark.parametrize("ratio", [0.4, 1.0, 2.7])
def test_cells_near_a_contradiction_are_marked_as_far_as_points_may_lie_off_the_middle(ratio):
    log_ratio = np.where(np.random.default_rng(6).random((7, 12)) < 0.04, -0.5, 0.3).astype(np.float32)
    log_ratio[0, -1], log_ratio[-1, 0] = -1e-3, 0.0
    window = make_search_window(np.array([0.2, -0.1, 0.4]), np.diag([0.2, 0.2, 0.1]) ** 2, 0.1, 0.08, 9.0)
    check = make_reverse_check(window, LogRatioGrid(log_ratio, np.zeros(2), 0.1 / ratio), np.zeros((1, 2)))
    assert not check.negative.any()
    for _ in range(2):
        gather_block_points(check, window, (0, 0, 0), np.empty((1, 2)))
    near = maximum_filter(np.pad(log_ratio < 0.0, check.reach), 2 * check.reach + 1, mode="constant")
    np.testing.assert_array_equal(check.negative, near)


@pytest.mark.parametrize("seed", range(4))
def test_sums_over_samples_are_those_of_the_cells_where_they_lie(seed):
    rng = np.random.default_rng(seed)
    surface = LogRatioGrid(rng.normal(size=(20, 28)).astype(np.float32), rng.uniform(-1.5, -0.5, 2), 0.1)
    samples = rng.uniform(-1.0, 1.0, (6, 2))
    window = make_search_window(rng.uniform(-0.5, 0.5, 3), np.diag([0.2, 0.2, 0.1]) ** 2, 0.1, 0.08, 9.0)
    cells, pyramid = sample_cells(window, surface, samples), build_pyramid(surface.log_ratio, SearchMemory())
    groups = group_turns(cells, window.first)
    wide = np.pad(surface.log_ratio, 40)
    for k, i, j in itertools.product(range(window.turns.size), (-6, -1, 4), (-5, 0, 3)):
        pose = window.mean + np.array([i * 0.1, j * 0.1, window.turns[k]])
        at = np.floor((se2.transform(pose, samples) - surface.origin) / 0.1).astype(int)
        np.testing.assert_array_equal(cells[k] + [i, j], at)
        totals = np.zeros((BLOCK, BLOCK))
        add_block(surface.log_ratio, cells[k], i, j, totals)
        expected = sum(wide[40 + y : 40 + y + BLOCK, 40 + x : 40 + x + BLOCK].astype(float) for x, y in at)
        np.testing.assert_allclose(totals, expected, atol=1e-5)
        # One by one: interpreted, sums of int8 overflow.
        for n, height in itertools.product(range(len(at)), range(MIN_HEIGHT, MAX_HEIGHT + 1)):
            level, number = pyramid.levels[height - MIN_HEIGHT], groups.first[height - MIN_HEIGHT] + (k >> (height - 1))
            x, y = (np.array([i, j]) - window.first) >> (height - MIN_HEIGHT)
            point = groups.corners[number, n : n + 1], groups.classes[number, n : n + 1]
            four = [values_of(level, *point, x + right, y + down).sum() for down in (0, 4) for right in (0, 4)]
            assert np.ravel(quarter_bounds(level, *point, x, y)).tolist() == four


@pytest.mark.parametrize("seed", range(4))
def test_of_a_square_the_quarters_are_searched_that_may_hold_a_cell_the_best_first(seed):
    rng = np.random.default_rng(seed)
    surface = LogRatioGrid(rng.normal(size=(30, 34)).astype(np.float32), rng.uniform(-2.0, -1.5, 2), 0.1)
    samples, far = rng.uniform(-0.5, 0.5, (1, 2)), np.array([[-9.0, -0.4], [0.3, 9.0]])
    limits = far if seed % 2 else far[:, ::-1]
    window = make_search_window(rng.uniform(-0.3, 0.3, 3), np.diag([0.4, 0.4, 0.1]) ** 2, 0.1, 0.08, 9.0, limits)
    reverse = make_reverse_check(window, surface, np.zeros((0, 2)))
    constraint = build_constraint_pyramid(
        constrain_around(rng.uniform(-1.0, 1.0, (3, 2)), np.ones(3, bool), rng.uniform(-1.0, 1.0, (2, 2)), 0.3, 0.1),
        window,
        SearchMemory(),
    )
    pyramid, cells = build_pyramid(surface.log_ratio, SearchMemory()), sample_cells(window, surface, samples)
    groups = group_turns(cells, window.first)
    problem = _SearchProblem(window, surface, pyramid, cells, groups, constraint, reverse, 0.5, 2.0)
    pushed, last = [], window.turns.size - 1
    for k, a, b in rng.integers(0, [window.turns.size, 9, 9], (300, 3)).tolist():
        height = 2 + (a + b) % 2
        side, tile, g, least = 2**height, 2 ** (height - 2), k >> (height - 1), rng.uniform(-3.0, 0.0)
        number, i, j = groups.first[height - 2] + g, window.first[0] + a * side, window.first[1] + b * side
        expected = {}
        for x, y in itertools.product((i, i + side), (j, j + side)):
            tiles = (x - window.first[0]) // tile, (y - window.first[1]) // tile
            of_group = groups.corners[number], groups.classes[number]
            forward = 0.5 * pyramid.step * values_of(pyramid.levels[height - 2], *of_group, *tiles).sum()
            turns = range(g << (height - 1), min(last, ((g + 1) << (height - 1)) - 1) + 1)
            bound = forward + max(prior_bound(window, turn, x, y, side) for turn in turns)
            within = (
                x <= window.last[0] and y <= window.last[1] and is_admissible_within(constraint, height, number, *tiles)
            )
            if within and min(forward, bound) >= least:
                expected[g, x, y, height] = bound
        stack, bounds = np.full((7, 4), -9), np.full(7, 5.0)
        size = _push_quarters(problem, stack, bounds, 2, (g, i, j), height, least)
        found = dict(zip(map(tuple, stack[2:size].tolist()), bounds[2:size], strict=True))
        assert found == pytest.approx(expected)
        assert bounds[2:size].tolist() == sorted(bounds[2:size])
        assert (stack[:2] == -9).all()
        pushed.append(len(found))
    assert set(pushed) >= {0, 1, 2}


@pytest.mark.parametrize("seed", range(8))
def test_the_search_for_one_sample_finds_the_cells_that_brute_force_finds(seed):
    """A single one, since interpreted sums of int8 overflow; all of the search is the same for many."""
    rng = np.random.default_rng(seed)
    surface, back = (
        LogRatioGrid(rng.normal(size=(30, 34)).astype(np.float32), rng.uniform(-2.0, -1.5, 2), cell)
        for cell in (0.1, 0.13)
    )
    samples, back_samples = rng.uniform(-0.5, 0.5, (1, 2)), rng.uniform(-1.5, 1.5, (12, 2))
    # Wide, or high and cut off on one side.
    spread, bounds = np.diag([0.35, 0.2, 0.05]) ** 2 + 0.002, None
    if seed % 2:
        spread, bounds = np.diag([0.15, 0.4, 0.05]) ** 2 + 0.002, np.array([[-9.0, -0.4], [0.3, 9.0]])
    window = make_search_window(rng.uniform(-0.3, 0.3, 3), spread, 0.1, 0.08, 9.0, bounds)
    expected = brute_force(window, surface, samples, back, back_samples, 0.5)
    best = max(expected.values())
    expected = {cell: score for cell, score in expected.items() if score >= best - 2.0}
    found = search_cells(window, surface, samples, back, back_samples, 0.5, -100.0, 2.0)
    scores = {tuple(cell): score for cell, score in zip(found.indices.tolist(), found.score, strict=True)}
    assert len(expected) > 10
    assert scores.keys() == expected.keys()
    assert scores == pytest.approx(expected, abs=1e-5)
