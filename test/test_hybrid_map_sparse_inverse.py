"""Entries of the inverse of a sparse matrix, against the inverse of the dense one."""

import numpy as np
import pytest
import scipy

from hmt_slam_ros.hybrid_map.sparse_inverse import inverse_blocks


def factor(matrix):
    options = {"SymmetricMode": True}
    return scipy.sparse.linalg.splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)


def blocks_of(dense, size):
    count = len(dense) // size
    return dense.reshape(count, size, count, size)[np.arange(count), :, np.arange(count)]


def make_matrix(pairs, count, size, draw):
    """A positive definite matrix whose blocks are those of the pairs, and those on the diagonal."""
    dense = np.zeros((count * size, count * size))
    for i, j in pairs:
        jacobian = np.zeros((size, count * size))
        jacobian[:, i * size : (i + 1) * size], jacobian[:, j * size : (j + 1) * size] = draw(), draw()
        dense += jacobian.T @ jacobian
    return dense + np.eye(count * size)


def compress(dense, pairs, count, size):
    """The matrix, with all entries of its blocks, also those that are zero."""
    full = np.eye(count)
    for i, j in pairs:
        full[i, j] = full[j, i] = 1.0
    pattern = scipy.sparse.csc_matrix(np.kron(full, np.ones((size, size))))
    columns = np.repeat(np.arange(count * size), np.diff(pattern.indptr))
    return scipy.sparse.csc_matrix((dense[pattern.indices, columns], pattern.indices, pattern.indptr), dense.shape)


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("seed", range(8))
def test_blocks_are_those_of_the_dense_inverse(seed, size):
    random = np.random.default_rng(seed)
    count = int(random.integers(1, 30))
    pairs = random.integers(0, count, size=(int(random.integers(0, 3 * count)), 2)).tolist()
    dense = make_matrix(pairs, count, size, lambda: random.standard_normal((size, size)))
    matrix = compress(dense, pairs, count, size)
    found = inverse_blocks(matrix.indices, matrix.indptr, factor(matrix), size)
    np.testing.assert_allclose(found, blocks_of(np.linalg.inv(dense), size), rtol=1e-9, atol=1e-12)


def test_entries_of_the_factor_that_are_zero_by_chance_are_no_gaps_in_the_inverse():
    side, size = 4, 3
    places = [(x, y) for x in range(side) for y in range(side)]
    pairs = [(i, j) for i, a in enumerate(places) for j, b in enumerate(places) if np.abs(np.subtract(a, b)).sum() == 1]
    signs = iter(np.tile([1.0, -1.0], len(pairs)))
    # Along the axes of a lattice most entries of a block are zero.
    dense = make_matrix(pairs, side**2, size, lambda: next(signs) * np.eye(size))
    matrix = compress(dense, pairs, side**2, size)
    found = inverse_blocks(matrix.indices, matrix.indptr, factor(matrix), size)
    np.testing.assert_allclose(found, blocks_of(np.linalg.inv(dense), size), rtol=1e-10, atol=1e-13)


def test_an_unjoined_node_has_its_own_inverse():
    dense = np.diag([2.0, 4.0, 5.0])
    matrix = compress(dense, [], 3, 1)
    assert inverse_blocks(matrix.indices, matrix.indptr, factor(matrix), 1).ravel().tolist() == [0.5, 0.25, 0.2]
