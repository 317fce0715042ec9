"""The pose graph against closed forms, a dense reference, and the statistics of simulated graphs."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import chi2

from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian, fuse
from hmt_slam_ros.hybrid_map import pose_graph
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.pose_graph import (
    Edges,
    consistent_map,
    optimize,
    relative_covariances,
    shortest_path_map,
    sparsity_pattern,
)

SPREAD = np.diag([0.05**2, 0.03**2, 0.01**2])


def edges(*entries):
    sources, targets, poses, covariances = zip(*entries, strict=True)
    return Edges(np.array(sources), np.array(targets), np.array(poses, float), np.array(covariances))


def chain_of(graph, n):
    """Initial poses composed along the edges i -> i + 1."""
    poses = np.zeros((n, 3))
    for i in range(1, n):
        at = np.flatnonzero((graph.sources == i - 1) & (graph.targets == i))[0]
        poses[i] = se2.compose(poses[i - 1], graph.poses[at])
    return poses


def simulate_graph(n, loops, seed, spread=SPREAD):
    """True poses on a wavy circle, and a chain with extra edges, each with noise of its own."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 2.0 * np.pi, n, endpoint=False)
    truth = np.stack((10 * np.cos(angle), 10 * np.sin(2 * angle), angle + np.pi / 2), axis=1)
    truth = se2.between(truth[0], truth)
    pairs = [(i, i + 1) for i in range(n - 1)] + [tuple(sorted(rng.choice(n, 2, replace=False))) for _ in range(loops)]
    entries = []
    for i, j in pairs:
        noise = se2.exp(rng.multivariate_normal(np.zeros(3), spread))
        entries.append((i, j, se2.compose(se2.between(truth[i], truth[j]), noise), spread))
    return truth, edges(*entries)


def dense_solution(initial, graph):
    """Gauss-Newton with numeric derivatives and dense algebra: poses and the whole covariance matrix."""
    poses = initial.copy()
    root = np.linalg.cholesky(np.linalg.inv(graph.covariances)).transpose(0, 2, 1)

    def residuals(at):
        relative = se2.between(at[graph.sources], at[graph.targets])
        return np.einsum("mij,mj->mi", root, se2.log(se2.between(graph.poses, relative))).ravel()

    def move(at, change):
        return se2.compose(at, se2.exp(np.concatenate((np.zeros(3), change)).reshape(-1, 3)))

    size = 3 * (len(poses) - 1)
    for _ in range(30):
        h = 1e-6
        jacobian = np.stack(
            [(residuals(move(poses, h * unit)) - residuals(move(poses, -h * unit))) / (2 * h) for unit in np.eye(size)],
            axis=1,
        )
        step = -np.linalg.lstsq(jacobian, residuals(poses), rcond=None)[0]
        poses = move(poses, step)
        if np.abs(step).max() < 1e-11:
            break
    return poses, np.linalg.inv(jacobian.T @ jacobian), residuals(poses) @ residuals(poses)


def test_one_edge_puts_the_second_node_where_it_was_measured():
    graph = edges((0, 1, [1.0, 2.0, 0.5], SPREAD))
    found = optimize(np.zeros((2, 3)), graph)
    np.testing.assert_allclose(found.poses, [[0, 0, 0], [1.0, 2.0, 0.5]], atol=1e-9)
    np.testing.assert_allclose(found.covariances[1], SPREAD, atol=1e-12)
    np.testing.assert_array_equal(found.covariances[0], np.zeros((3, 3)))
    assert found.chi2 == pytest.approx(0.0, abs=1e-12)


def test_an_edge_read_backwards_is_the_inverse_belief():
    measured = PoseGaussian(np.array([1.0, 2.0, 0.5]), SPREAD)
    found = optimize(np.zeros((2, 3)), edges((1, 0, measured.mean, measured.covariance)))
    np.testing.assert_allclose(found.poses[1], measured.inverse().mean, atol=1e-9)
    np.testing.assert_allclose(found.covariances[1], measured.inverse().covariance, atol=1e-12)


def test_two_edges_between_two_nodes_are_the_product_of_gaussians():
    one = PoseGaussian(np.array([1.0, 2.0, 0.5]), np.diag([0.04, 0.01, 0.001]))
    two = PoseGaussian(np.array([1.1, 1.9, 0.48]), np.diag([0.01, 0.02, 0.002]))
    found = optimize(one.mean * [[0], [1]], edges((0, 1, one.mean, one.covariance), (0, 1, two.mean, two.covariance)))
    product = fuse([one, two])
    np.testing.assert_allclose(found.poses[1], product.mean, atol=1e-8)
    np.testing.assert_allclose(found.covariances[1], product.covariance, atol=1e-8)


def test_a_chain_composes_its_beliefs():
    steps = [PoseGaussian(np.array([1.0, 0.1 * i, 0.3]), SPREAD * (1 + i)) for i in range(4)]
    graph = edges(*[(i, i + 1, step.mean, step.covariance) for i, step in enumerate(steps)])
    found = optimize(chain_of(graph, 5), graph)
    belief = steps[0].compose(steps[1]).compose(steps[2]).compose(steps[3])
    np.testing.assert_allclose(found.poses[4], belief.mean, atol=1e-9)
    np.testing.assert_allclose(found.covariances[4], belief.covariance, rtol=1e-9, atol=1e-14)


def test_the_error_of_a_ring_of_translations_is_shared_by_variance():
    # Four translations that ought to sum to nought leave 0.4 m in x; each takes its share of the variance.
    tight = np.diag([0.1**2, 0.1**2, 1e-9**2])
    loose = np.diag([0.2**2, 0.2**2, 1e-9**2])
    graph = edges(
        (0, 1, [2.0, 0.0, 0.0], tight),
        (1, 2, [0.0, 2.0, 0.0], tight),
        (2, 3, [-2.0, 0.0, 0.0], tight),
        (3, 0, [0.4, -2.0, 0.0], loose),
    )
    found = optimize(chain_of(graph, 4), graph)
    share = 0.4 / 7.0  # variances 1, 1, 1 and 4
    expected = [[0, 0, 0], [2 - share, 0, 0], [2 - 2 * share, 2, 0], [-3 * share, 2, 0]]
    np.testing.assert_allclose(found.poses, expected, atol=1e-6)
    assert found.chi2 == pytest.approx(0.4**2 / 0.07, rel=1e-6)
    np.testing.assert_allclose(found.edge_chi2, np.array([1, 1, 1, 4]) * (share / 0.1) ** 2 * [1, 1, 1, 1], rtol=1e-5)
    # Node 2 by two ways of variances 0.02 and 0.05.
    assert found.covariances[2, 0, 0] == pytest.approx(1.0 / (1.0 / 0.02 + 1.0 / 0.05), rel=1e-6)


def test_a_square_that_turns_too_little_closes():
    quarter = np.radians(88.0)
    graph = edges(*[(i, (i + 1) % 4, [2.0, 0.0, quarter], SPREAD) for i in range(4)])
    found = optimize(chain_of(graph, 4), graph)
    relative = se2.between(found.poses, np.roll(found.poses, -1, axis=0))
    np.testing.assert_allclose(np.degrees(relative[:, 2]), 90.0, atol=1e-6)
    np.testing.assert_allclose(relative, np.broadcast_to(relative[0], (4, 3)), atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_poses_marginals_and_chi2_are_those_of_a_dense_solution(seed):
    _, graph = simulate_graph(14, 12, seed)
    initial = chain_of(graph, 14)
    found = optimize(initial, graph)
    poses, covariance, cost = dense_solution(initial, graph)
    np.testing.assert_allclose(se2.log(se2.between(poses, found.poses)), 0.0, atol=1e-7)
    blocks = covariance.reshape(13, 3, 13, 3)[np.arange(13), :, np.arange(13)]
    np.testing.assert_allclose(found.covariances[1:], blocks, rtol=1e-5, atol=1e-11)
    assert found.chi2 == pytest.approx(cost, rel=1e-9)


def test_the_fixed_node_may_be_any_and_keeps_its_pose():
    _, graph = simulate_graph(8, 6, 3)
    initial = chain_of(graph, 8)
    one, other = optimize(initial, graph), optimize(initial, graph, fixed=5)
    np.testing.assert_array_equal(other.poses[5], initial[5])
    np.testing.assert_array_equal(other.covariances[5], np.zeros((3, 3)))
    np.testing.assert_allclose(se2.between(other.poses[0], other.poses), one.poses, atol=1e-7)
    assert one.chi2 == pytest.approx(other.chi2)


def test_the_frame_of_the_start_does_not_matter():
    _, graph = simulate_graph(10, 8, 4)
    initial = chain_of(graph, 10)
    there = np.array([100.0, -50.0, 2.0])
    one, other = optimize(initial, graph), optimize(se2.compose(there, initial), graph)
    np.testing.assert_allclose(se2.between(there, other.poses), one.poses, atol=1e-6)
    np.testing.assert_allclose(other.covariances, one.covariances, atol=1e-10)


def test_a_bad_start_is_damped_to_the_same_solution():
    truth, graph = simulate_graph(20, 15, 5)
    good = optimize(chain_of(graph, 20), graph)
    rng = np.random.default_rng(6)
    bad = se2.compose(truth, rng.normal(size=(20, 3)) * [1.5, 1.5, 0.5])
    bad[0] = 0.0
    np.testing.assert_allclose(optimize(bad, graph).poses, good.poses, atol=1e-6)


class GivenCosts:
    """The normal equations of a problem whose costs are given, one after the other; notes the damping of every step."""

    def __init__(self, costs):
        self.costs, self.dampings = list(costs), []

    def evaluate(self, _poses):
        return SimpleNamespace(cost=self.costs.pop(0), chi2=np.zeros(1))

    def step(self, _state, damping):
        self.dampings.append(damping)
        return np.full((2, 3), 0.1)


@pytest.mark.parametrize(
    ("costs", "dampings"),
    [
        ([9.0, 10.0, np.nan, 12.0, 8.0, 7.0, 6.0, 5.0, 4.0, 4.0], [0.0, 1e-6, 1e-5, 1e-4, 1e-5, 1e-6, 0.0, 0.0, 0.0]),
        ([9.0, 10.0, 8.0, 11.0, 11.0, 7.0, 7.0], [0.0, 1e-6, 0.0, 1e-6, 1e-5, 1e-6]),
        ([9.0, *[10.0] * 16], [0.0, *(10.0**n for n in range(-6, 9))]),
    ],
)
def test_damping_grows_tenfold_with_every_step_that_fails_and_falls_with_every_other(monkeypatch, costs, dampings):
    given = GivenCosts(costs)
    monkeypatch.setattr(pose_graph, "_System", lambda *_: given)
    found = optimize(np.zeros((2, 3)), None, marginals=False)
    assert given.dampings == pytest.approx(dampings)
    falling = [cost for n, cost in enumerate(costs) if n and cost <= min(costs[:n])]
    assert (found.steps, found.chi2) == (len(falling), min(costs))


@pytest.mark.parametrize(("last", "steps"), [(6.93, 1), (6.91, 2)])
def test_a_step_that_lowers_the_cost_by_a_share_of_what_is_left_at_most_is_the_last(monkeypatch, last, steps):
    given = GivenCosts([9.0, last, 6.0, 6.0, 6.0])
    monkeypatch.setattr(pose_graph, "_System", lambda *_: given)
    assert optimize(np.zeros((2, 3)), None, marginals=False, tolerance=0.3).steps == steps


def test_errors_of_simulated_graphs_are_as_large_as_the_marginals_say():
    # NEES of one node over independent graphs: chi-square with 3 degrees of freedom each.
    nees = []
    for seed in range(60):
        truth, graph = simulate_graph(8, 5, 100 + seed)
        found = optimize(chain_of(graph, 8), graph)
        error = se2.log(se2.between(found.poses[5], truth[5]))
        nees.append(error @ np.linalg.solve(found.covariances[5], error))
    assert chi2.ppf(0.005, 180) < np.sum(nees) < chi2.ppf(0.995, 180)


def test_chi2_of_simulated_graphs_has_the_degrees_of_freedom_of_their_loops():
    values = [
        optimize(chain_of(g, 8), g, marginals=False).chi2 for _, g in (simulate_graph(8, 5, 200 + s) for s in range(60))
    ]
    assert chi2.ppf(0.005, 15 * 60) < np.sum(values) < chi2.ppf(0.995, 15 * 60)


def test_a_node_without_edges_is_refused():
    with pytest.raises(ValueError, match="node 2"):
        optimize(np.zeros((3, 3)), edges((0, 1, [1.0, 0.0, 0.0], SPREAD)))


def test_a_graph_of_one_node_is_solved_already():
    nothing = Edges(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    found = optimize(np.array([[1.0, 2.0, 3.0]]), nothing)
    np.testing.assert_array_equal(found.poses, [[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(found.covariances, np.zeros((1, 3, 3)))


def test_a_chain_longer_than_the_columns_solved_at_once_composes_its_beliefs_too():
    step = PoseGaussian(np.array([0.5, 0.0, 0.1]), SPREAD)
    graph = edges(*[(i, i + 1, step.mean, step.covariance) for i in range(149)])
    found = optimize(chain_of(graph, 150), graph)
    belief = step
    for i in range(2, 150):
        belief = belief.compose(step)
        np.testing.assert_allclose(found.covariances[i], belief.covariance, rtol=1e-6, atol=1e-12)


def ring_of_areas():
    hybrid_map = HybridMap()
    for area in (3, 5, 8, 9):
        hybrid_map.set_keyframe(10 * area, area, np.zeros(3))
    quarter = np.radians(88.0)
    step = PoseGaussian(np.array([2.0, 0.0, quarter]), SPREAD)
    for a, b in ((3, 5), (5, 8), (8, 9), (9, 3)):
        hybrid_map.set_arc(a, b, step, closure=a > b)
    return hybrid_map


def test_the_consistent_map_closes_a_ring_that_the_shortest_paths_leave_open():
    hybrid_map = ring_of_areas()
    consistent, shortest = consistent_map(hybrid_map), shortest_path_map(hybrid_map)
    assert list(consistent.poses) == list(shortest.poses) == [3, 5, 8, 9]

    def turns(found):
        poses = np.array([found.poses[area].mean for area in (3, 5, 8, 9, 3)])
        return np.degrees(se2.between(poses[:-1], poses[1:])[:, 2])

    np.testing.assert_allclose(turns(consistent), 90.0, atol=1e-6)
    assert np.ptp(turns(shortest)) > 5.0
    assert set(consistent.arc_chi2) == {(3, 5), (5, 8), (8, 9), (3, 9)}
    assert min(consistent.arc_chi2.values()) > 1.0


def test_closing_the_ring_makes_the_areas_more_certain():
    hybrid_map = ring_of_areas()
    consistent, shortest = consistent_map(hybrid_map), shortest_path_map(hybrid_map)
    for area in (5, 8, 9):
        loose, tight = shortest.poses[area].covariance, consistent.poses[area].covariance
        assert np.linalg.det(tight) < 0.9 * np.linalg.det(loose)


def test_the_first_area_lies_at_the_origin_of_a_map_that_is_empty_yet():
    for found in (consistent_map(HybridMap()), shortest_path_map(HybridMap())):
        assert list(found.poses) == [0]


def test_one_area_without_arcs_lies_at_the_origin():
    hybrid_map = HybridMap()
    hybrid_map.set_keyframe(0, 0, np.zeros(3))
    for found in (consistent_map(hybrid_map), shortest_path_map(hybrid_map)):
        assert list(found.poses) == [0]
        np.testing.assert_array_equal(found.poses[0].mean, np.zeros(3))
        assert 0.0 < found.poses[0].covariance[0, 0] < 1e-6


def test_covariances_of_nodes_relative_to_each_other_are_those_of_the_whole_system():
    graph = simulate_graph(12, 6, seed=3)[1]
    poses = optimize(chain_of(graph, 12), graph).poses
    whole = dense_solution(poses, graph)[1]
    between = np.array([[2, 7], [7, 2], [0, 5], [9, 9]])
    found = relative_covariances(poses, graph, between)
    for (i, j), covariance in zip(between[:3], found[:3], strict=True):
        ad = se2.adjoint(se2.between(poses[j], poses[i]))
        apart = np.zeros((3, whole.shape[0] + 3))
        apart[:, 3 * i : 3 * i + 3], apart[:, 3 * j : 3 * j + 3] = -ad, np.eye(3)
        apart = apart[:, 3:]
        np.testing.assert_allclose(covariance, apart @ whole @ apart.T, rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(found[3], 0.0, atol=1e-12)
    seen_back = PoseGaussian(se2.between(poses[2], poses[7]), found[0]).inverse().covariance
    np.testing.assert_allclose(found[1], seen_back, rtol=1e-9)


def test_the_pattern_has_the_blocks_of_all_edges_and_nothing_else():
    random = np.random.default_rng(8)
    sources, targets = random.integers(-1, 6, (2, 12))
    rows = np.stack((sources, sources, targets, targets), axis=1)
    columns = np.stack((sources, targets, sources, targets), axis=1)
    pattern = sparsity_pattern(rows, columns, 6)
    dense = np.zeros((18, 18), bool)
    for row, column in zip(rows.ravel(), columns.ravel(), strict=True):
        if min(row, column) >= 0:
            dense[3 * row : 3 * row + 3, 3 * column : 3 * column + 3] = True
    assert len(pattern.indices) == pattern.starts[-1] == dense.sum()
    for column in range(18):
        found = pattern.indices[pattern.starts[column] : pattern.starts[column + 1]]
        assert found.tolist() == np.flatnonzero(dense[:, column]).tolist()
