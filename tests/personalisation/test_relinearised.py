"""Errors of the geometry whose effects depend on the moduli are linearised at the estimate."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from mvest.cases.case import Role
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.transform import Log, to_filter
from mvest.mechanics.settings import ExponentialTissue
from mvest.personalisation import personalise
from mvest.personalisation.estimation import SETTLED
from mvest.personalisation.geometry import GeometryModes, NuisanceGeometry
from mvest.problem.registration import REGISTRATION
from tests.made_up_closure import (
    FIELDS,
    PRIORS,
    TRUE,
    error_source,
    made_up_case,
    settings,
    shape,
    unknowns,
    use,
)

MODE = GeometryModes("open shape", {"shape": np.ones((1, 1))})
MODULI = ("E_f.anterior", "E_f.posterior")
BENT, STD = 1.0 * FIELDS["E_f.anterior"].ravel() + 0.1 * FIELDS["loose"].ravel(), 0.5
"""Effect (mm) of the one mode on the closed valve at the true modulus, mostly like a modulus."""


def rows(m, power):
    """Effect ``(3 n, 1)`` of the mode, of a power of the anterior modulus."""
    return BENT[:, None] * (m[0] / TRUE["E_f.anterior"]) ** power


def bent_case(monkeypatch, power):
    """A case whose valve is displaced by the one mode, and its nuisances, all known."""
    use(monkeypatch)
    computed = []

    def sources(modes, valve, observation, noise):
        computed.append(valve.m)
        return (error_source(rows(valve.m, power), MODE),)

    monkeypatch.setattr("mvest.personalisation.errors.geometry_sources", sources)
    straight = made_up_case(STD, displaced=False)
    closed = straight.frame(Role.CLOSED)
    frame = replace(closed, vertices=closed.vertices + BENT.reshape(-1, 3))
    known = {name: value for name, value in TRUE.items() if not name.startswith("E_f.")}
    known |= dict.fromkeys(REGISTRATION, 0.0)
    frames = tuple(frame if f is closed else f for f in straight.frames)
    return replace(straight, frames=frames), known, computed


def renewed(case, known, renewals, **changes):
    geometry = NuisanceGeometry(renewals=renewals)
    given = unknowns(fixed=True, **known)
    return personalise(case, settings(*given, nuisance_geometry=geometry, **changes))


def estimate_about(case, known, m, power):
    """Logarithms ``(2,)`` of the moduli with the mode's effect at ``m``, by least squares.

    Also their standard deviations.
    """
    seen, column = case.frame(Role.CLOSED).vertices.ravel(), rows(m, power)[:, 0]
    log = [to_filter(Log(), Gaussian.from_variance([mean], std**2))
           for mean, std in (PRIORS[name] for name in MODULI)]  # fmt: skip

    def objective(z):
        x = shape(known | dict(zip(MODULI, np.exp(z[:2]), strict=True))).ravel()
        prior = [(z[k] - log[k].mean[0]) / log[k].std[0] for k in range(2)]
        return np.concatenate([(x + column * z[2] - seen) / STD, prior, z[2:]])

    found = least_squares(objective, [1.5, 1.0, 0.0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return found.x[:2], np.sqrt(np.diag(np.linalg.inv(found.jac.T @ found.jac)))[:2]


@pytest.mark.parametrize(("power", "settles"), [(-2.0, True), (-8.0, False)])
def test_the_effect_of_the_geometry_is_that_at_the_estimate(monkeypatch, power, settles):
    case, known, computed = bent_case(monkeypatch, power)
    first, fit = (renewed(case, known, renewals, tolerance=1e-9) for renewals in (0, 8))
    assert first.moved is None
    np.testing.assert_allclose(computed[0], computed[1])
    about = [estimate_about(case, known, m, power) for m in computed[1:]]
    distances = [np.abs((np.log(m) - z) / std).max()
                 for m, (z, std) in zip(computed[1:], about, strict=True)]  # fmt: skip
    # Linearised once, the estimate is about a point that is far away.
    np.testing.assert_allclose(np.log(first.result.estimate), about[0][0], atol=1e-3)
    assert distances[0] > SETTLED
    # The point is the last one that was nearer to its estimate than the one before.
    assert np.all(np.diff(distances[:-1]) < 0.0)
    nearest = int(np.argmin(distances))
    assert nearest == len(distances) - (1 if settles else 2)
    np.testing.assert_allclose(np.log(fit.result.estimate), about[nearest][0], atol=1e-3)
    assert fit.moved == pytest.approx(distances[nearest], rel=0.05)
    assert (fit.moved < SETTLED) == settles


def test_an_effect_that_cannot_be_computed_anew_leaves_the_last_and_its_reason(monkeypatch):
    case, known, computed = bent_case(monkeypatch, -2.0)
    plain = renewed(case, known, 0)
    name = "mvest.personalisation.errors.geometry_sources"
    found = iter([(error_source(rows(computed[0], -2.0), MODE),), "torn"])
    monkeypatch.setattr(name, lambda *_: next(found))
    failed = renewed(case, known, 2)
    np.testing.assert_allclose(failed.result.estimate, plain.result.estimate, rtol=1e-3)
    assert failed.unaccounted == ("torn",)


@pytest.mark.parametrize("renewals", [0, 2])
def test_an_exact_valve_is_compared_with_a_model_of_known_error(monkeypatch, renewals):
    case, known, _ = bent_case(monkeypatch, 0.0)
    closed, error = case.frame(Role.CLOSED), 0.4 * FIELDS["E_f.posterior"]
    exact = replace(closed, vertices=closed.vertices - error)
    exact = replace(case, frames=tuple(exact if f is closed else f for f in case.frames))

    def estimated(case, expected):
        source = replace(error_source(1e-6 * BENT[:, None]), expected=expected)
        name = "mvest.personalisation.errors.law_and_mesh_sources"
        monkeypatch.setattr(name, lambda *_: (source,))
        return renewed(case, known, renewals, tolerance=1e-9).result.estimate

    without = estimated(case, 0.0)
    np.testing.assert_allclose(estimated(exact, error.ravel()), without, rtol=1e-6)
    assert np.abs(estimated(exact, 0.0) / without - 1.0).max() > 0.05


def test_other_unaccounted_errors_do_not_stop_relinearisation(monkeypatch):
    case, known, _ = bent_case(monkeypatch, -2.0)
    monkeypatch.setattr("mvest.personalisation.errors.law_and_mesh_sources", lambda *_: "no law")
    law = {"anterior": ExponentialTissue(0.06, 4.325, 1446.5)}
    fit = renewed(case, known, 4, nuisance_law=law)
    assert fit.unaccounted == ("no law",)
    assert fit.moved < SETTLED
