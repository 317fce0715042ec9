"""The search over relative poses against brute force."""

import itertools

import numpy as np
import pytest

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.registration.branch_and_bound import search_cells
from hmt_slam_ros.registration.search_bounds import LogRatioGrid
from hmt_slam_ros.registration.search_window import make_search_window


def brute_force(window, surface, samples, back, back_samples, temper):
    """Score of every cell within the gate, one by one: {(k, i, j): score}."""

    def reads(surface, points, only_negative):
        cells = np.floor((points - surface.origin) / surface.cell).astype(int)
        inside = np.all((cells >= 0) & (cells < surface.log_ratio.shape[::-1]), axis=1)
        values = surface.log_ratio[cells[inside, 1], cells[inside, 0]].astype(float)
        return np.minimum(values, 0.0).sum() if only_negative else values.sum()

    scores = {}
    (left, low), (right, high) = window.first, window.last
    spans = range(window.turns.size), range(left, right + 1), range(low, high + 1)
    for k, i, j in itertools.product(*spans):
        pose = window.mean + np.array([i * window.cell, j * window.cell, window.turns[k]])
        twist = se2.log(se2.between(window.mean, pose))
        exponent = float(np.sum((window.information_root @ twist) ** 2))
        if exponent <= window.gate:
            forward = reads(surface, se2.transform(pose, samples), False)
            backward = reads(back, se2.transform(se2.inverse(pose), back_samples), True)
            scores[k, i, j] = temper * (forward + backward) - 0.5 * exponent
    return scores


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_the_search_finds_exactly_the_cells_that_brute_force_finds(seed, bounded):
    rng = np.random.default_rng(seed)
    grids = [rng.normal(size=(rng.integers(8, 40), rng.integers(8, 40))).astype(np.float32) for _ in range(2)]
    surface, back = (
        LogRatioGrid(g, rng.uniform(-2.5, -1.0, 2), cell) for g, cell in zip(grids, (0.1, 0.13), strict=True)
    )
    samples, back_samples = rng.uniform(-1.5, 1.5, (25, 2)), rng.uniform(-1.5, 1.5, (20, 2))
    root = rng.normal(size=(3, 3)) * [[0.25], [0.25], [0.15]]
    mean, bounds = rng.uniform(-1.0, 1.0, 3), np.array([[-0.6, -1.2], [0.9, 0.5]])
    window = make_search_window(mean, root @ root.T + 1e-4 * np.eye(3), 0.1, 0.05, 9.0, bounds if bounded else None)
    expected = brute_force(window, surface, samples, back, back_samples, 0.5)
    best = max(expected.values())
    expected = {cell: score for cell, score in expected.items() if score >= best - 4.0}
    found = search_cells(window, surface, samples, back, back_samples, 0.5, -100.0, 4.0)
    scores = {tuple(cell): score for cell, score in zip(found.indices.tolist(), found.score, strict=True)}
    # A sample within rounding of a cell's edge may be read one cell off.
    shared = scores.keys() & expected.keys()
    assert len(shared) >= 0.97 * max(len(scores), len(expected))
    differences = np.array([abs(scores[cell] - expected[cell]) for cell in shared])
    assert np.mean(differences < 1e-5) > 0.97
