"""Assembly: where blocks lie, and that half of a matrix is all of it."""

import numpy as np
from scipy import sparse

from mvest.mechanics.assembly import (
    SparsityPattern,
    adjacency,
    scatter_blocks,
)
from mvest.mechanics.body import outer_faces
from mvest.mechanics.forces.pressure import PressureLoad
from tests.mechanics.bodies import block, block_matrix

NO_PAIRS = np.zeros((0, 2), dtype=int)


def test_a_matrix_by_halves_is_the_matrix():
    random = np.random.default_rng(0)
    dense = sparse.random_array((30, 30), density=0.1, rng=random).toarray() + np.eye(30)
    matrix = block_matrix(sparse.csr_matrix(dense))
    assert len(matrix.pattern.skew) > 3
    np.testing.assert_allclose(matrix.tobsr().toarray(), dense, atol=1e-15)
    x = random.normal(size=(30, 2))
    np.testing.assert_allclose(matrix @ x, dense @ x, atol=1e-14)
    np.testing.assert_allclose(matrix @ x[:, 0], dense @ x[:, 0], atol=1e-14)


def test_points_that_share_a_node_add_up():
    # The second point has node 2 twice, as a tie between neighbours does.
    nodes = np.array([[0, 3, 1], [2, 1, 2]])
    weights = np.array([[0.5, 0.3, 0.2], [0.7, -1.0, 0.4]])
    stiffness = np.random.default_rng(3).normal(size=(2, 3, 3))
    stiffness += stiffness.transpose(0, 2, 1)
    pattern = SparsityPattern.of(adjacency(4, [nodes]), NO_PAIRS)
    blocks = pattern.zeros()
    scatter_blocks(blocks, pattern.within(nodes), weights, weights, stiffness)
    expected = np.zeros((12, 12))
    for own, w, k in zip(nodes, weights, stiffness, strict=True):
        share = np.zeros((3, 12))
        for node, factor in zip(own, w, strict=True):
            share[:, 3 * node : 3 * node + 3] += factor * np.eye(3)
        expected += share.T @ k @ share
    np.testing.assert_allclose(pattern.matrix(blocks).tobsr().toarray(), expected, atol=1e-14)


def test_a_closed_surface_has_no_rim():
    mesh = block("tet4", (2, 2, 2))
    assert len(PressureLoad(outer_faces(mesh.elements, "tet4"), "tri3").rim()) == 0
