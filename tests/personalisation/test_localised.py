"""Error samples that are alike at near places only: their covariance, and the estimate."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from mvest.cases.case import Role
from mvest.errors import GeometryError
from mvest.personalisation import observation_errors, personalise
from mvest.personalisation.estimation import CaseEstimation
from mvest.personalisation.geometry_errors import localised_samples
from tests.made_up_closure import made_up_case, settings
from tests.personalisation.test_considered_geometry import NONE
from tests.personalisation.test_personalise import right_nuisances, seen_in_error, use_geometry

LENGTH = 12.0
LOCALISED = replace(NONE, samples_mm=LENGTH)


def test_their_covariance_is_that_of_the_samples_times_a_correlation():
    case = seen_in_error(made_up_case(0.3, 8.0, displaced=False), count=5)
    vertices, tips = localised_samples(case, LENGTH)
    whole, parts = (
        # (f, d, places, ...): of each coordinate in each frame.
        np.moveaxis(np.concatenate(both, axis=-2), (-3, -1), (0, 1))
        for both in (
            (case.error_samples.vertices, case.error_samples.tips),
            (vertices, tips),
        )
    )
    found = np.einsum("fdkjp,gekjq->fdgepq", parts, parts)
    plain = np.einsum("fdkp,gekq->fdgepq", whole, whole)
    rho = found / np.where(np.abs(plain) > 1e-3, plain, np.nan)
    each = np.nanmean(rho, axis=(0, 1, 2, 3))
    # One correlation for all frames and coordinates, and one of each place with itself.
    assert np.nanmax(np.abs(rho - each)) < 1e-9
    np.testing.assert_allclose(np.diag(each), 1.0, rtol=1e-12)
    open_ = case.frame(Role.REFERENCE)
    apart = cdist(*2 * [np.concatenate([open_.vertices, open_.papillary_tips])])
    # Matérn of order 3/2, but for a twentieth of the variance, which is that of the finest modes.
    n, r = len(open_.vertices), np.sqrt(3.0) * apart / LENGTH
    off = (each - (1.0 + r) * np.exp(-r))[:n, :n]
    assert np.sqrt(np.mean(off**2)) < 0.03
    assert np.max(np.abs(off)) < 0.15


def test_they_are_weighed_with_and_the_samples_stay_what_they_are(monkeypatch):
    use_geometry(monkeypatch)
    case = seen_in_error(made_up_case(0.3, 8.0, displaced=False))
    errors = {}
    for name, geometry in (("whole", NONE), ("localised", LOCALISED)):
        estimation = CaseEstimation(
            case, settings(*right_nuisances(), considered_geometry=geometry), None, None
        )
        start = estimation.shared.start
        estimation.errors.sample_geometry(start, estimation.shared(start).y)
        errors[name] = estimation.errors.samples
    whole, found = errors["whole"], errors["localised"]
    assert whole.localised is None
    np.testing.assert_allclose(found.samples, whole.samples)
    # The formula is moved as far as the frame is: parts of a sample are what they do.
    vertices, _ = localised_samples(case, LENGTH)
    moved = vertices[:, :, 1].reshape(*vertices.shape[:2], -1)
    np.testing.assert_allclose(found.localised, np.moveaxis(moved, -1, 0), atol=1e-9)


def test_over_the_whole_valve_the_estimate_is_that_of_the_samples_as_they_are(monkeypatch):
    use_geometry(monkeypatch)
    case = seen_in_error(made_up_case(0.3, 8.0, np.random.default_rng(1), displaced=False))

    def estimated(length):
        geometry = replace(NONE, samples_mm=length)
        return personalise(case, settings(*right_nuisances(), considered_geometry=geometry)).result

    plain, everywhere, near = (estimated(length) for length in (0.0, 1e6, LENGTH))
    np.testing.assert_allclose(everywhere.estimate, plain.estimate, rtol=1e-6)
    np.testing.assert_allclose(everywhere.std, plain.std, rtol=1e-6)
    assert np.max(np.abs(near.estimate / plain.estimate - 1)) > 1e-3


def test_localised_samples_that_cannot_be_told_are_an_error(monkeypatch):
    use_geometry(monkeypatch)
    sampled = observation_errors.sample_geometry

    def fails(case, registered, m, vertices=None, tips=None):
        if vertices is not None and len(vertices) > len(case.error_samples):
            return "no equilibrium"
        return sampled(case, registered, m, vertices, tips)

    monkeypatch.setattr(observation_errors, "sample_geometry", fails)
    case = seen_in_error(made_up_case(0.3, 8.0, displaced=False))
    with pytest.raises(GeometryError, match="localised samples do: no equilibrium"):
        personalise(case, settings(*right_nuisances(), considered_geometry=LOCALISED))
