"""Ensembles: which of their properties are exact, and how fast the others are approached."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.estimation import EnsembleFilter, IteratedFilter, Prediction, Reason
from tests.estimation.problems import Linear


@pytest.mark.parametrize(("members", "steps"), [(5, 1), (5, 3), (12, 1), (40, 4)])
def test_the_square_root_is_the_kalman_filter_exactly(members: int, steps: int) -> None:
    # In any number of steps: information 1/α of each adds up to one observation.
    problem = Linear()
    found = problem.by(EnsembleFilter(members, steps), plain=True)
    np.testing.assert_allclose(found.mean, problem.mean, rtol=1e-10)
    np.testing.assert_allclose(found.covariance, problem.covariance, rtol=1e-9, atol=1e-10)
    assert found.reason is Reason.COMPLETED
    assert found.converged
    assert found.forward_solves == members * steps + 1
    assert found.iterations == steps
    np.testing.assert_allclose(found.prediction.jacobian, problem.H, atol=1e-10)
    reference = problem.by(IteratedFilter())
    assert found.innovation.nis == pytest.approx(reference.innovation.nis, rel=1e-9)


def perturbed(problem, members, seed=1):
    return problem.by(EnsembleFilter(members, kind="perturbed", seed=seed), plain=True)


def test_perturbed_observations_have_the_exact_mean_and_a_seed() -> None:
    # The perturbations are centred, so that the mean is moved by K d̄ whatever they are.
    problem = Linear()
    one, same, other = (perturbed(problem, 10, seed) for seed in (1, 1, 2))
    np.testing.assert_allclose(one.mean, problem.mean, rtol=1e-10)
    np.testing.assert_array_equal(one.covariance, same.covariance)
    assert not np.allclose(one.covariance, other.covariance)


def test_perturbed_observations_approach_the_covariance_like_one_over_root_n() -> None:
    # The relative error of a variance from N draws is √(2/N). Over 40 seeds the mean square error
    # is 2/N to within 4 √(2/40) = 0.9 of itself; without the perturbations the spread would be too
    # small by the factor (I − K H), and the error would not fall with N.
    problem = Linear(p=1)
    for members in (16, 64):
        found = [perturbed(problem, members, seed).covariance[0, 0] for seed in range(40)]
        errors = np.array(found) / problem.covariance[0, 0] - 1.0
        ratio = np.mean(np.square(errors)) / (2.0 / members)
        assert 0.1 < ratio < 1.9


def with_failures(p, members, failing):
    """An ensemble of whose runs some fail."""
    problem, calls = Linear(p=p), []

    def model(m):
        calls.append(m)
        return Prediction.failed("leaks") if len(calls) in failing else problem.plain(m)

    return EnsembleFilter(members)(model, problem.prior, problem.y, problem.R)


def test_members_that_fail_are_left_out_and_counted() -> None:
    found = with_failures(1, 10, (2, 5))
    assert found.converged
    assert "8 of 10 members" in found.detail
    assert found.forward_solves == 11


def test_inadmissible_settings_are_refused() -> None:
    for settings in ({"members": 2}, {"steps": 0}, {"kind": "both"}):
        with pytest.raises(InputError):
            EnsembleFilter(**settings)
    with pytest.raises(InputError, match="at least 5 members"):
        Linear(p=3).by(EnsembleFilter(4), plain=True)
