"""Linear solvers: the same result whichever is installed, for one and for many right-hand sides."""

import builtins

import numpy as np
import pytest
from scipy import sparse

from mvest.errors import InputError
from mvest.mechanics import BiotLaw, Loads, System, TransverselyIsotropic, box, outer_faces
from mvest.mechanics.solid import Solid
from mvest.mechanics.solver import LinearSolver, SuperLUSolver, linear_solver
from mvest.valve.mesh.solid_mesh import SolidMesh
from tests.mechanics.bodies import block_matrix, sandwich


def available():
    try:
        return [linear_solver("pardiso").name, "superlu"]
    except InputError:
        return ["superlu"]


@pytest.fixture(scope="module")
def tangent():
    """Tangent of two sheets under follower pressure (not symmetric) and a right-hand side."""
    system, loading = sandwich(cells=2, contact=False)
    x = system.solid.mesh.nodes + 0.01 * np.sin(np.arange(3 * system.n)).reshape(-1, 3)
    strain = system.solid.initial_strain()
    blocks = system.evaluate(x, loading(0.06), None, strain, 0.0, tangent=True).blocks
    matrix = system.matrix(blocks, 0.0)
    whole = matrix.tobsr()
    assert abs(whole - whole.T).max() > 1e-6
    return matrix, np.random.default_rng(0).normal(size=(matrix.shape[0], 4))


@pytest.mark.parametrize("name", available())
@pytest.mark.parametrize("columns", [None, 4])
def test_solutions_solve(tangent, name, columns):
    matrix, right = tangent
    right = right[:, 0] if columns is None else right[:, :columns]
    before = right.copy()
    solver: LinearSolver = linear_solver(name)
    solver.factorize(matrix)
    for _ in range(2):  # the factor serves again, and the right-hand side is left alone
        solution = solver.solve(right)
        assert solution.shape == right.shape
        np.testing.assert_allclose(matrix @ solution, right, atol=1e-9)
    np.testing.assert_array_equal(right, before)


@pytest.mark.parametrize("name", available())
def test_a_factor_is_renewed_with_the_matrix(tangent, name):
    matrix, right = tangent
    solver = linear_solver(name)
    solver.factorize(matrix)
    solver.factorize(matrix.pattern.matrix(2 * matrix.blocks))
    np.testing.assert_allclose(matrix @ solver.solve(right), 0.5 * right, atol=1e-9)
    other = sparse.diags_array(np.arange(1.0, 7.0)).tobsr((3, 3))  # another pattern and size
    solver.factorize(block_matrix(other))
    np.testing.assert_allclose(solver.solve(np.ones(6)), 1 / np.arange(1.0, 7.0), rtol=1e-12)


@pytest.mark.parametrize("name", available())
@pytest.mark.parametrize("change", [1e-3, 1e6])
def test_a_matrix_that_is_called_near_is_solved_with_whether_it_is_or_not(tangent, name, change):
    matrix, right = tangent
    blocks, own = matrix.blocks.copy(), np.arange(3)
    rows = np.arange(0, matrix.shape[0] // 3, 2)
    blocks[matrix.pattern.pointer[rows, None], own, own] *= 1 + change
    changed = matrix.pattern.matrix(blocks)
    solver = linear_solver(name)
    solver.factorize(matrix)
    factors = []
    if name == "pardiso":
        renew = solver._pardiso.factorize
        solver._pardiso.factorize = lambda: factors.append(renew())
    solver.factorize(changed, near=True)
    np.testing.assert_allclose(changed @ solver.solve(right), right, atol=1e-9)
    assert len(factors) == (name == "pardiso" and change > 1)


@pytest.mark.parametrize("name", available())
@pytest.mark.parametrize("share", [3e-6, 3e-3])
def test_weak_couplings_count_whether_or_not_they_are_in_the_factor(name, share):
    """Many of them together are strong; a factor without them is only half the answer."""
    n, rng = 400, np.random.default_rng(1)
    weak = share * rng.normal(size=(n, n, 3, 3))
    dense = (weak + weak.transpose(1, 0, 3, 2)).transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)
    dense += np.diag(rng.uniform(1.0, 2.0, 3 * n))
    right = rng.normal(size=(3 * n, 2))
    solver = linear_solver(name)
    solver.factorize(block_matrix(sparse.csr_matrix(dense)))
    expected = np.linalg.solve(dense, right)
    without = right / np.diag(dense)[:, None]
    assert np.abs(without - expected).max() > 1e-5
    np.testing.assert_allclose(solver.solve(right), expected, rtol=0, atol=1e-10)


@pytest.fixture(scope="module", params=["hex18", "tet10"])
def thin(request):
    """Tangent of a clamped sheet 2000 times as long as thick, and a load across it."""
    nodes, elements = box(request.param, (40, 2, 1), (60.0, 2.0, 0.03))
    fibre = np.broadcast_to([1.0, 0.0, 0.0], nodes.shape)
    region = np.zeros(len(elements), dtype=int)
    faces = outer_faces(elements, request.param)[:0]
    mesh = SolidMesh(nodes, elements, request.param, region, ("sheet",), fibre, faces)
    solid = Solid(mesh, BiotLaw.of((TransverselyIsotropic.isotropic(2e7, 0.0),)))
    system = System(solid, fixed_nodes=np.flatnonzero(nodes[:, 0] == 0))
    blocks = system.evaluate(
        nodes, Loads(fixed=nodes[system.fixed_nodes]), None, solid.initial_strain(), 0.0,
        tangent=True,
    ).blocks  # fmt: skip
    right = np.zeros_like(nodes)
    right[nodes[:, 0] == 60.0, 2] = 0.01
    return system.matrix(blocks, 0.0), right.ravel()


@pytest.mark.parametrize("name", available())
@pytest.mark.parametrize("tolerance", [1e-3, 1e-9, 1e-13])
def test_a_thin_sheet_is_solved_as_well_as_its_condition_allows(thin, name, tolerance):
    """Round-off over a condition beyond 1e13 leaves no residual below 1e-6 of the load."""
    matrix, right = thin
    exact = sparse.linalg.splu(matrix.tobsr().tocsc())
    inverse = sparse.linalg.LinearOperator(
        matrix.shape, matvec=exact.solve, rmatvec=lambda v: exact.solve(v, "T")
    )
    condition = sparse.linalg.onenormest(inverse) * abs(matrix.tobsr()).sum(axis=0).max()
    assert condition > 1e13
    solver = linear_solver(name)
    solver.factorize(matrix)
    solution = solver.solve(right, tolerance)
    assert solver.name == name  # nothing else had to take its place
    residual = np.abs(matrix @ solution - right).max()
    assert residual < 1e-14 * np.abs(matrix.blocks).max() * np.abs(solution).max()
    # The beam's answer, P L^3 / (3 E I), which nothing but a good solution comes near.
    assert solution[2::3].max() == pytest.approx(
        right.sum() * 60.0**3 / (3 * 2e7 * 2.0 * 0.03**3 / 12), rel=0.01
    )


def test_superlu_takes_the_place_of_pardiso_where_the_symmetric_part_says_nothing(tangent):
    if "pardiso" not in available():
        pytest.skip("PARDISO is not installed")
    matrix, right = tangent
    noise = np.random.default_rng(2).normal(size=(300, 300))
    other = block_matrix(sparse.csr_matrix(noise - noise.T + 1e-6 * np.eye(300)))
    solver = linear_solver("pardiso")
    solver.factorize(other)
    one = np.ones((300, 2))
    np.testing.assert_allclose(other @ solver.solve(one), one, atol=1e-9)
    assert solver.name == "pardiso, superlu for 1 matrix"
    solver.factorize(matrix)  # for which PARDISO is good again
    np.testing.assert_allclose(matrix @ solver.solve(right), right, atol=1e-9)
    assert solver.name == "pardiso, superlu for 1 matrix"


def test_without_pardiso_auto_falls_back_and_asking_for_it_says_what_is_missing(monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "pypardiso":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    assert isinstance(linear_solver("auto"), SuperLUSolver)
    with pytest.raises(InputError, match="needs the package pypardiso"):
        linear_solver("pardiso")
