"""Pose graphs as sparse least-squares problems (Lu and Milios 1997), and the global map of the areas.

    chi2 = sum over edges of e^T C^-1 e,    e = log(z^-1 * (x_i^-1 * x_j))

with z the measured pose of j seen from i and C its covariance in the right tangent space, as in
:class:`~hmt_slam_ros.geometry.gaussian.PoseGaussian`. Jacobians are in the right tangent spaces of x_i and x_j. The
solver takes Gauss-Newton steps on the manifold, with the damping of Levenberg and Marquardt after a step that fails.
One node is fixed; the marginal covariances are relative to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import scipy

from hmt_slam_ros.arrays import Float64, Int32, Int64
from hmt_slam_ros.compilation import njit
from hmt_slam_ros.geometry import se2
from hmt_slam_ros.geometry.gaussian import PoseGaussian
from hmt_slam_ros.hybrid_map.hybrid_map import HybridMap
from hmt_slam_ros.hybrid_map.shortest_path import shortest_path_beliefs
from hmt_slam_ros.hybrid_map.sparse_inverse import inverse_blocks

_SMALL_ANGLE = 1e-4
"""Angle below which the logarithm takes its series, rad."""

_SERIES_ANGLE = 1e-2
"""Angle below which the Jacobian takes its series, rad."""

_MAX_STEPS = 100
"""Most steps of the solver."""

_MIN_STEP = 1e-10
"""Steps that move no pose farther than this are the last, m or rad."""

_MIN_GAIN = 1e-12
"""Steps that lower the cost by a smaller share of it are the last."""

_MIN_DAMPING = 1e-6
"""Damping after the first step that fails, as a share of the diagonal."""

_MAX_DAMPING = 1e8
"""Damping above which the solver gives up."""

_REFERENCE_COVARIANCE = np.diag([1e-8, 1e-8, 1e-8])
"""Covariance of the reference area, which defines the frame, so that it is regular: 0.1 mm and 0.006 degrees."""


@njit(cache=True)
def linearize(poses: Float64, sources: Int64, targets: Int64, measured: Float64) -> tuple[Float64, Float64, Float64]:
    """Residuals (m, 3) of the edges and their Jacobians (m, 3, 3) with respect to source and target.

    :param poses: shape (n, 3), of the nodes.
    :param measured: shape (m, 3), ``i_T_j``.
    """
    m = len(sources)
    residuals, of_source, of_target = np.empty((m, 3)), np.empty((m, 3, 3)), np.empty((m, 3, 3))
    adjoint = np.zeros((3, 3))  # of the inverse of the relative pose
    for e in range(m):
        i, j = sources[e], targets[e]
        x, y, angle = _relative_pose(poses[i], poses[j])
        relative = np.array((x, y, angle))
        x, y, angle = _relative_pose(measured[e], relative)
        _log(x, y, angle, residuals[e])
        _right_jacobian_inverse(residuals[e], of_target[e])
        cos, sin = np.cos(relative[2]), np.sin(relative[2])
        adjoint[0, 0], adjoint[0, 1], adjoint[0, 2] = cos, sin, sin * relative[0] - cos * relative[1]
        adjoint[1, 0], adjoint[1, 1], adjoint[1, 2] = -sin, cos, cos * relative[0] + sin * relative[1]
        adjoint[2, 2] = 1.0
        for r in range(3):
            for c in range(3):
                value = 0.0
                for k in range(3):
                    value -= of_target[e, r, k] * adjoint[k, c]
                of_source[e, r, c] = value
    return residuals, of_source, of_target


@njit(cache=True)
def _relative_pose(a: Float64, b: Float64) -> tuple[float, float, float]:
    cos, sin = np.cos(a[2]), np.sin(a[2])
    x, y = se2.rotate_back(cos, sin, b[0] - a[0], b[1] - a[1])
    return x, y, se2.wrap_by_turns(b[2] - a[2])


@njit(cache=True)
def _log(x: float, y: float, angle: float, twist: Float64) -> None:
    half = 0.5 * angle
    half_cot = 1.0 - angle**2 / 12.0 if abs(angle) < _SMALL_ANGLE else half / np.tan(half)
    twist[0], twist[1], twist[2] = half_cot * x + half * y, half_cot * y - half * x, angle


@njit(cache=True)
def _right_jacobian_inverse(xi: Float64, result: Float64) -> None:
    """As :func:`~hmt_slam_ros.geometry.se2.right_jacobian_inverse`, into (3, 3): 1 + ad / 2 + q ad^2."""
    x, y, omega = xi[0], xi[1], xi[2]
    if abs(omega) < _SERIES_ANGLE:
        q = 1.0 / 12.0 + omega**2 / 720.0 + omega**4 / 30240.0
    else:
        q = (1.0 - 0.5 * omega / np.tan(0.5 * omega)) / omega**2
    result[0, 0] = result[1, 1] = 1.0 - q * omega * omega
    result[0, 1], result[1, 0] = -0.5 * omega, 0.5 * omega
    result[0, 2], result[1, 2] = 0.5 * y + q * omega * x, -0.5 * x + q * omega * y
    result[2, 0] = result[2, 1] = 0.0
    result[2, 2] = 1.0


class SparsityPattern(NamedTuple):
    """The blocks of every edge in the normal matrix, in compressed columns.

    :ivar indices: rows of the entries; ``starts``, shape (columns + 1,), where each column begins among them.
    :ivar first: shape (m, 4), the first entry of the blocks (source, source), (source, target), (target, source),
        (target, target); -1 where one of the two nodes is fixed.
    :ivar stride: shape (m, 4), entries from one column of the block to the next.
    """

    indices: Int32
    starts: Int32
    first: Int64
    stride: Int64


def sparsity_pattern(rows: Int64, columns: Int64, nodes: int) -> SparsityPattern:
    """The pattern of the blocks of edges.

    :param rows: shape (m, 4), node of each block's rows, -1 where it is fixed; ``columns`` likewise.
    :param nodes: number of free nodes.
    """
    is_free = (rows >= 0) & (columns >= 0)
    blocks, block_of = np.unique(columns[is_free] * max(1, nodes) + rows[is_free], return_inverse=True)
    column, row = np.divmod(blocks, max(1, nodes))
    in_column = np.bincount(column, minlength=nodes)
    before = np.concatenate(([0], np.cumsum(in_column)))
    first, stride = np.full(rows.shape, -1, np.int64), np.zeros(rows.shape, np.int64)
    # A node has three columns of numbers in a row; each holds three numbers of each of its blocks.
    first_entry = 9 * before[column] + 3 * (np.arange(len(blocks)) - before[column])
    first[is_free], stride[is_free] = first_entry[block_of], 3 * in_column[column][block_of]
    starts = np.concatenate(([0], np.cumsum(np.repeat(3 * in_column, 3)))).astype(np.int32)
    indices = np.empty(9 * len(blocks), np.int32)
    entry = first_entry[:, None, None] + 3 * in_column[column][:, None, None] * np.arange(3)[:, None] + np.arange(3)
    indices[entry] = 3 * row[:, None, None] + np.arange(3)
    return SparsityPattern(indices, starts, first, stride)


def normal_matrix(pattern: SparsityPattern, of_source: Float64, of_target: Float64, information: Float64) -> Any:  # noqa: ANN401  csc_matrix
    """The sum of J^T Omega J over all edges.

    :param information: shape (m, 3, 3), of the edges.
    """
    size = len(pattern.starts) - 1
    entries = _entries(pattern.first, pattern.stride, len(pattern.indices), of_source, of_target, information)
    return scipy.sparse.csc_matrix((entries, pattern.indices, pattern.starts), shape=(size, size))


@njit(cache=True)
def _entries(
    first: Int64, stride: Int64, count: int, of_source: Float64, of_target: Float64, information: Float64
) -> Float64:
    entries, left = np.zeros(count), np.empty((3, 3))
    for e in range(len(first)):
        for side in range(2):
            one = of_target[e] if side else of_source[e]
            for r in range(3):
                for c in range(3):
                    left[r, c] = (
                        one[0, r] * information[e, 0, c]
                        + one[1, r] * information[e, 1, c]
                        + one[2, r] * information[e, 2, c]
                    )
            for other_side in range(2):
                at, step = first[e, 2 * side + other_side], stride[e, 2 * side + other_side]
                if at < 0:
                    continue
                other = of_target[e] if other_side else of_source[e]
                for r in range(3):
                    for c in range(3):
                        entries[at + c * step + r] += (
                            left[r, 0] * other[0, c] + left[r, 1] * other[1, c] + left[r, 2] * other[2, c]
                        )
    return entries


@dataclass(frozen=True, eq=False)
class Edges:
    """Measured relative poses.

    :ivar sources: shape (m,), int64, node i of each edge.
    :ivar targets: shape (m,), int64, node j.
    :ivar poses: shape (m, 3), measured ``i_T_j``, m and rad.
    :ivar covariances: shape (m, 3, 3), right tangent frame, regular.
    """

    sources: Int64
    targets: Int64
    poses: Float64
    covariances: Float64


def edge_chi2(edges: Edges, poses: Float64) -> Float64:
    """Chi-square of each edge at given poses (n, 3), 3 degrees of freedom, shape (m,)."""
    residuals = se2.log(se2.between(edges.poses, se2.between(poses[edges.sources], poses[edges.targets])))
    return np.asarray(np.einsum("mi,mij,mj->m", residuals, np.linalg.inv(edges.covariances), residuals))


@dataclass(frozen=True, eq=False)
class Solution:
    """The most likely poses.

    :ivar poses: shape (n, 3), m and rad.
    :ivar covariances: shape (n, 3, 3), marginals in the right tangent frame, relative to the fixed node, whose own is
        zero; None if they were not computed.
    :ivar chi2: sum of ``edge_chi2``; 3 (m - n + 1) degrees of freedom.
    :ivar edge_chi2: shape (m,).
    :ivar steps: steps taken.
    """

    poses: Float64
    covariances: Float64 | None
    chi2: float
    edge_chi2: Float64
    steps: int


def optimize(
    initial: Float64, edges: Edges, fixed: int = 0, *, marginals: bool = True, tolerance: float = _MIN_GAIN
) -> Solution:
    """The most likely poses of a pose graph.

    A step costs one sparse factorization, and so do the marginals.

    :param initial: shape (n, 3), poses to start from; that of ``fixed`` stays.
    :param edges: at least enough to join every node with the fixed one.
    :param fixed: the node that defines the frame.
    :param marginals: whether to compute the covariances.
    :param tolerance: a step that lowers the cost by no more than this share of it is the last.
    :raises ValueError: if a node is not joined with the fixed one, so that its pose is not determined.
    """
    system = _System(len(initial), edges, fixed)
    poses, state = initial.copy(), system.evaluate(initial)
    damping, steps = 0.0, 0
    while steps < _MAX_STEPS and damping <= _MAX_DAMPING:
        step = system.step(state, damping)
        if np.abs(step).max(initial=0.0) < _MIN_STEP:
            break
        next_poses = se2.compose(poses, se2.exp(step))
        next_state = system.evaluate(next_poses)
        if not next_state.cost <= state.cost:
            damping = max(_MIN_DAMPING, 10.0 * damping)
            continue
        gain = state.cost - next_state.cost
        poses, state, steps = next_poses, next_state, steps + 1
        damping = 0.1 * damping if damping > _MIN_DAMPING else 0.0
        if gain <= tolerance * state.cost:
            break
    covariances = system.marginals(state) if marginals else None
    return Solution(poses, covariances, state.cost, state.chi2, steps)


def relative_covariances(poses: Float64, edges: Edges, between: Int64) -> Float64:
    """Covariances of the poses of nodes j seen from nodes i, right tangent frame, shape (k, 3, 3).

    :param poses: shape (n, 3), that agree best with the edges.
    :param between: shape (k, 2), i and j.
    :raises ValueError: if a node is not joined with all others.
    """
    system = _System(len(poses), edges, fixed=0)
    nodes, row = np.unique(between, return_inverse=True)
    joint = system.joint_covariance(system.evaluate(poses), nodes)
    covariances = np.empty((len(between), 3, 3))
    for k, (i, j) in enumerate(row.reshape(-1, 2)):
        ad = se2.adjoint(se2.between(poses[nodes[j]], poses[nodes[i]]))
        jacobian = np.concatenate((-ad, np.eye(3)), axis=1)
        blocks = [joint[3 * m : 3 * m + 3, 3 * n : 3 * n + 3] for m in (i, j) for n in (i, j)]
        covariances[k] = jacobian @ np.block([blocks[:2], blocks[2:]]) @ jacobian.T
    return covariances


@dataclass(frozen=True, eq=False)
class _State:
    """The problem at given poses: residuals (m, 3), Jacobians (m, 3, 3), chi2 (m,), and the cost, which is its sum."""

    residuals: Float64
    of_source: Float64
    of_target: Float64
    chi2: Float64
    cost: float


class _System:
    """The normal equations of one graph, without the fixed node."""

    def __init__(self, nodes: int, edges: Edges, fixed: int) -> None:
        self._edges = edges
        self._information = np.linalg.inv(edges.covariances).astype(np.float64, copy=False)
        self._free = np.delete(np.arange(nodes), fixed)
        self._nodes = nodes
        self._require_connected(fixed)
        row = np.full(nodes, -1)
        row[self._free] = np.arange(nodes - 1)
        i, j = row[edges.sources], row[edges.targets]
        self._pattern = sparsity_pattern(np.stack((i, i, j, j), 1), np.stack((i, j, i, j), 1), nodes - 1)

    def _require_connected(self, fixed: int) -> None:
        ones = np.ones(len(self._edges.sources))
        ends, shape = (self._edges.sources, self._edges.targets), (self._nodes, self._nodes)
        graph = scipy.sparse.csc_matrix((ones, ends), shape=shape)
        labels = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
        isolated = np.flatnonzero(labels != labels[fixed])
        if isolated.size:
            raise ValueError(
                f"no edges join node {isolated[0]} with the fixed node {fixed}, so it has no definite pose"
            )

    def evaluate(self, poses: Float64) -> _State:
        """Residuals, Jacobians and cost at given poses, shape (n, 3)."""
        residuals, of_source, of_target = linearize(poses, self._edges.sources, self._edges.targets, self._edges.poses)
        chi2 = np.einsum("mi,mij,mj->m", residuals, self._information, residuals)
        return _State(residuals, of_source, of_target, chi2, float(chi2.sum()))

    def step(self, state: _State, damping: float) -> Float64:
        """The step of every pose in its right tangent space, shape (n, 3)."""
        weighted = np.einsum("mij,mj->mi", self._information, state.residuals)
        gradient = np.zeros((self._nodes, 3))
        np.add.at(gradient, self._edges.sources, np.einsum("mij,mi->mj", state.of_source, weighted))
        np.add.at(gradient, self._edges.targets, np.einsum("mij,mi->mj", state.of_target, weighted))
        step = np.zeros((self._nodes, 3))
        if self._free.size:
            step[self._free] = -self._factor(state, damping).solve(gradient[self._free].ravel()).reshape(-1, 3)
        return step

    def _factor(self, state: _State, damping: float) -> Any:  # noqa: ANN401  SuperLU, of scipy, which has no types
        hessian = normal_matrix(self._pattern, state.of_source, state.of_target, self._information)
        if damping > 0.0:
            hessian = (hessian + scipy.sparse.diags(damping * hessian.diagonal())).tocsc()
        # Symmetric and positive definite: no pivoting, so that the fill follows the graph.
        options = {"SymmetricMode": True}
        return scipy.sparse.linalg.splu(hessian, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)

    def marginals(self, state: _State) -> Float64:
        """The diagonal blocks of the inverse of the normal matrix, shape (n, 3, 3); zero for the fixed node."""
        covariances = np.zeros((self._nodes, 3, 3))
        if not self._free.size:
            return covariances
        factor = self._factor(state, 0.0)
        covariances[self._free] = inverse_blocks(self._pattern.indices, self._pattern.starts, factor, 3)
        return covariances

    def joint_covariance(self, state: _State, nodes: Int64) -> Float64:
        """The joint covariance of some nodes, ascending, shape (3 k, 3 k); zero for the fixed node."""
        row = np.full(self._nodes, -1)
        row[self._free] = np.arange(self._free.size)
        rows = (3 * row[nodes][:, None] + np.arange(3)).ravel()
        is_free = np.repeat(row[nodes] >= 0, 3)
        unit = np.zeros((3 * self._free.size, rows.size))
        unit[rows[is_free], np.flatnonzero(is_free)] = 1.0
        solved = self._factor(state, 0.0).solve(unit)
        covariance = np.where(np.outer(is_free, is_free), solved[np.where(is_free, rows, 0)], 0.0)
        return 0.5 * (covariance + covariance.T)


class GlobalMap(NamedTuple):
    """Areas in the frame of the reference area.

    :ivar poses: {area: belief over ``map_T_area``}, ascending; the reference is the smallest area.
    :ivar arc_chi2: {(a, b): chi-square of the arc against these poses, 3 degrees of freedom}, a < b, ascending; empty
        for :func:`shortest_path_map`.
    """

    poses: dict[int, PoseGaussian]
    arc_chi2: dict[tuple[int, int], float]


def shortest_path_map(hybrid_map: HybridMap) -> GlobalMap:
    """Areas composed along the tree of least uncertain paths from the reference, Eq. (15).

    Other arcs are ignored, so that a loop keeps its error as a gap.
    """
    poses = shortest_path_beliefs(hybrid_map, _reference_area(hybrid_map))
    return GlobalMap({area: _regularize(poses[area]) for area in sorted(poses)}, {})


def consistent_map(hybrid_map: HybridMap) -> GlobalMap:
    """Areas at the poses that agree best with all arcs, with their marginal covariances.

    Areas that no arcs join with the reference are left out.
    """
    areas, arcs, solution = _solve_areas(hybrid_map, marginals=True)
    assert solution.covariances is not None
    beliefs = map(PoseGaussian, solution.poses, solution.covariances)
    poses = {area: _regularize(belief) for area, belief in zip(areas, beliefs, strict=True)}
    chi2 = {(a, b): float(value) for (a, b, _), value in zip(arcs, solution.edge_chi2, strict=True)}
    return GlobalMap(poses, chi2)


def consistent_poses(hybrid_map: HybridMap) -> dict[int, Float64]:
    """{area: ``map_T_area``, shape (3,)} of :func:`consistent_map`, without covariances."""
    areas, _, solution = _solve_areas(hybrid_map, marginals=False)
    return dict(zip(areas, solution.poses, strict=True))


def total_arc_chi2(hybrid_map: HybridMap) -> float:
    """The chi-square of all arcs against the poses that agree best with them; 3 degrees of freedom a cycle."""
    return _solve_areas(hybrid_map, marginals=False)[2].chi2


def _solve_areas(
    hybrid_map: HybridMap, *, marginals: bool
) -> tuple[list[int], list[tuple[int, int, PoseGaussian]], Solution]:
    """Areas, arcs between them, and the most likely poses."""
    tree = shortest_path_beliefs(hybrid_map, _reference_area(hybrid_map))
    areas = sorted(tree)
    arcs = [(a, b, value.pose) for a, b, value in hybrid_map.all_arcs() if a in tree]
    row = {area: i for i, area in enumerate(areas)}
    edges = Edges(
        np.array([row[a] for a, _, _ in arcs], np.int64),
        np.array([row[b] for _, b, _ in arcs], np.int64),
        np.array([pose.mean for _, _, pose in arcs]).reshape(-1, 3),
        np.array([pose.covariance for _, _, pose in arcs]).reshape(-1, 3, 3),
    )
    return areas, arcs, optimize(np.array([tree[area].mean for area in areas]), edges, marginals=marginals)


def _reference_area(hybrid_map: HybridMap) -> int:
    return min(hybrid_map.area_ids(), default=0)


def _regularize(belief: PoseGaussian) -> PoseGaussian:
    return belief if belief.covariance.any() else PoseGaussian(belief.mean, _REFERENCE_COVARIANCE)
