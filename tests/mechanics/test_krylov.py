"""GMRES: the answer of the given system, however rough the preconditioner, and its error known."""

import numpy as np
import pytest

from mvest.mechanics.krylov import gmres

N = 80


def a_system(noise):
    """An unsymmetric matrix of condition 1e6, and its inverse but for some noise."""
    random = np.random.default_rng(4)
    left, right = (np.linalg.qr(random.normal(size=(N, N)))[0] for _ in range(2))
    matrix = left * np.logspace(0, 6, N) @ right
    # Relative to the size of what it acts on, as the rounding of a factor is.
    rough = right.T / np.logspace(0, 6, N) @ (np.eye(N) + noise * random.normal(size=(N, N)))
    return matrix, rough @ left.T


@pytest.fixture(scope="module")
def system():
    return a_system(1e-3)


def solve(system, right, tolerance, exact=lambda x, r, b: False, **options):
    matrix, rough = system
    calls = []

    def precondition(v):
        calls.append(len(v))
        return v @ rough.T

    solution, good = gmres(
        lambda v: matrix @ v, precondition, right, tolerance, exact=exact, **options
    )
    return solution, good, calls


@pytest.mark.parametrize("tolerance", [1e-2, 1e-5, 1e-9])
def test_the_error_of_a_solution_is_what_was_asked_for(system, tolerance):
    right = 1e4 * np.random.default_rng(0).normal(size=(1, N))
    solution, good, calls = solve(system, right, tolerance)
    expected = np.linalg.solve(system[0], right[0])
    error = np.linalg.norm(solution[0] - expected) / np.linalg.norm(expected)
    assert good.all()
    # The residual, which soft directions hardly enter, would stop far too early; and what is known
    # of the error has been taken away.
    assert error < 0.1 * tolerance
    # A digit and a half in each iteration: stopping too late shows as well.
    assert len(calls) <= 1 - np.log10(tolerance)


def test_columns_are_solved_as_if_each_were_alone(system):
    random = np.random.default_rng(1)
    right = random.normal(size=(3, N))
    right[1] = system[0] @ (system[1] @ right[0])  # sooner done than the others
    right[2] = 0.0
    together, good, calls = solve(system, right, 1e-9)
    assert good.all()
    assert len(calls) > 3
    assert calls[0] == 2  # nothing is to be solved for the third
    for k in range(3):
        alone, _, _ = solve(system, right[k : k + 1], 1e-9)
        np.testing.assert_allclose(together[k], alone[0], atol=1e-12 * np.abs(together).max())
    assert np.all(together[2] == 0)


def test_a_space_that_is_full_is_begun_anew(system):
    right = np.random.default_rng(2).normal(size=(2, N))
    solution, good, calls = solve(system, right, 1e-10, restart=2, cycles=12)
    assert good.all()
    assert len(calls) > 4
    expected = np.linalg.solve(system[0], right.T).T
    np.testing.assert_allclose(solution, expected, atol=1e-8 * np.abs(expected).max())


def test_what_is_not_solved_is_not_called_good(system):
    right = np.random.default_rng(3).normal(size=(2, N))
    matrix, _ = system
    solution, good, _ = solve((matrix, np.eye(N)), right, 1e-10, restart=5, cycles=2)
    assert not good.any()
    # ... unless the residual is no more than round-off may be.
    _, good, _ = solve(
        (matrix, np.eye(N)), right, 1e-10, exact=lambda x, r, b: True, restart=5, cycles=2
    )
    assert good.all()
    residual = right - solution @ matrix.T
    assert np.all(np.linalg.norm(residual, axis=1) < np.linalg.norm(right, axis=1))
    assert not gmres(
        lambda v: v, lambda v: v, np.full((1, 3), np.nan), 1e-3, exact=lambda x, r, b: False
    )[1].any()
