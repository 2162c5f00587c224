"""Ensembles: which of their properties are exact, and how fast the others are approached."""

import numpy as np
import pytest

from mvest.errors import InputError
from mvest.estimation import EnsembleFilter, Gaussian, IteratedFilter, Prediction, Reason
from mvest.estimation.filters.ensemble import exact_ensemble
from tests.estimation.problems import Linear, square


def test_the_drawn_ensemble_has_exactly_the_priors_mean_and_covariance() -> None:
    X = exact_ensemble(6, 4, np.random.default_rng(2))
    np.testing.assert_allclose(X.mean(axis=0), 0.0, atol=1e-14)
    np.testing.assert_allclose(X.T @ X / 5, np.eye(4), atol=1e-14)


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


def test_after_k_of_n_steps_the_ensemble_has_seen_k_nths() -> None:
    problem = Linear()
    found = problem.by(EnsembleFilter(8, 4), plain=True)
    information = problem.H.T @ np.diag(1 / problem.R) @ problem.H
    for k in range(5):
        P = np.linalg.inv(np.linalg.inv(problem.prior.covariance) + k / 4 * information)
        np.testing.assert_allclose(found.iterate_covariances[k], P, rtol=1e-9, atol=1e-10)


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
    for members in (20, 320):
        found = [perturbed(problem, members, seed).covariance[0, 0] for seed in range(40)]
        errors = np.array(found) / problem.covariance[0, 0] - 1.0
        ratio = np.mean(np.square(errors)) / (2.0 / members)
        assert 0.1 < ratio < 1.9


def test_more_steps_are_nearer_to_the_posterior_of_a_non_linear_model() -> None:
    # h = m², prior N(2, 1), y = 6, R = 0.02: mode near √6, standard deviation about 1/34 (Gauss
    # Newton: √(R)/(2 m) = 0.029). One step takes its gain from the whole prior and its residual
    # for a part of the noise; four take it from where they have come to.
    prior, y, R = Gaussian(np.array([2.0]), np.array([[1.0]])), np.array([6.0]), 0.02
    reference = IteratedFilter()(square, prior, y, R)
    one, four = (EnsembleFilter(20, steps)(square, prior, y, R) for steps in (1, 4))
    assert abs(four.mean[0] - reference.mean[0]) < 0.5 * abs(one.mean[0] - reference.mean[0])
    assert abs(four.std[0] / reference.std[0] - 1) < abs(one.std[0] / reference.std[0] - 1)


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


@pytest.mark.parametrize("survivors", [0, 2])
def test_too_few_members_left_end_the_run(survivors: int) -> None:
    found = with_failures(2, 6, range(survivors + 1, 10))
    assert found.reason is Reason.MODEL_FAILED
    assert "leaks" in found.detail
    assert found.forward_solves == 6


def test_inadmissible_settings_are_refused() -> None:
    for settings in ({"members": 2}, {"steps": 0}, {"kind": "both"}):
        with pytest.raises(InputError):
            EnsembleFilter(**settings)
    with pytest.raises(InputError, match="at least 5 members"):
        Linear(p=3).by(EnsembleFilter(4), plain=True)
