"""What an estimate knows, what its intervals rest on and what would narrow them, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.estimation.transform import to_filter
from mvest.observation.learned import ErrorBeliefs
from mvest.personalisation import personalise
from mvest.personalisation.geometry import GeometryModes, NuisanceGeometry
from mvest.personalisation.known import EXACTLY, PRESSURE_MMHG, SINGLE
from mvest.valve.measure.strain import mean_strains
from tests.made_up_closure import (
    FIELDS,
    PRESSURE,
    TRUE,
    error_source,
    made_up_case,
    settings,
    shape,
    unknowns,
    use,
)

STD = 0.3
THICKNESS = GeometryModes("thickness", {"thickness": np.ones((1, 1))})
COLUMN = 0.3 * FIELDS["E_f.anterior"].reshape(-1, 1)
"""What one standard deviation of the thickness does to the closed frame, mm."""


def fitted(monkeypatch, *given, noise=2, errors=None):
    """A case in which a thickness is not known."""
    use(monkeypatch)
    source = error_source(COLUMN, THICKNESS)
    monkeypatch.setattr("mvest.personalisation.errors.geometry_sources", lambda *_: (source,))
    return personalise(
        made_up_case(STD, noise=np.random.default_rng(noise)),
        settings(*given, nuisance_geometry=NuisanceGeometry(), errors=errors),
    )


def dense(fit):
    """Prior ``(p, p)`` of the unknowns, and their slopes ``(k, p)``."""
    filtered = fit.result.filtered
    z = filtered.transformed.mean
    H = filtered.prediction.jacobian * filtered.transform.derivative(z)
    return to_filter(filtered.transform, fit.result.filtered.prior).covariance, H


def rows_of(fit):
    """What is measured -> standard deviation of each modulus then."""
    rows = fit.known.narrower
    return {
        row.what: np.array([r.std_if_known for r in rows if r.what == row.what]) for row in rows
    }


def test_what_would_narrow_is_the_update_by_hand(monkeypatch):
    fit = fitted(monkeypatch)
    P, H = dense(fit)

    def by_hand(better=None, thickness=1.0, beats=1.0):
        share = np.array([(better or {}).get(name, 1.0) for name in fit.result.parameters])
        joint = np.concatenate([H, thickness * COLUMN], axis=1) * np.sqrt(beats) / STD
        prior = np.zeros((len(P) + 1,) * 2)
        prior[:-1, :-1], prior[-1, -1] = np.linalg.inv(P * np.outer(share, share)), 1.0
        return np.sqrt(np.diag(np.linalg.inv(prior + joint.T @ joint)))[:2]

    now = [row.std_now for row in fit.known.narrower[:2]]
    np.testing.assert_allclose(now, by_hand(), rtol=1e-6)
    np.testing.assert_allclose(now, fit.result.filtered.transformed.std[:2], rtol=1e-6)
    found = rows_of(fit)
    pressure = {"pressure_scale": PRESSURE_MMHG / (0.1 * PRESSURE)}
    expected = {
        "pressure measured to ±3 mmHg": by_hand(pressure),
        "lengths of the chordae measured to ±0.5 %": by_hand({"chord_rest_length": 0.25}),
        "thickness of the leaflets measured to a third of its error now": by_hand(None, 1 / 3),
        "mean of 4 beats": by_hand(beats=4.0),
    }
    for what, stds in expected.items():
        np.testing.assert_allclose(found[what], stds, rtol=1e-6, err_msg=what)


@pytest.mark.parametrize("errors", [None, ErrorBeliefs(resolution_mm=0.1)])
def test_no_advice_promises_more_than_exact_knowledge_of_all_that_can_be_measured(
    monkeypatch, errors
):
    fit = fitted(monkeypatch, errors=errors)
    found, now = rows_of(fit), np.array([row.std_now for row in fit.known.narrower[:2]])
    least = found.pop(EXACTLY)
    assert np.all(least > 0.0)
    for what, stds in found.items():
        assert np.all(stds >= least * (1 - 1e-9)), what
        assert np.all(stds <= now * (1 + 1e-9)), what


def test_any_number_of_beats_leaves_the_floor_and_all_that_they_have_in_common(monkeypatch):
    fit = fitted(monkeypatch, errors=ErrorBeliefs(resolution_mm=0.1))
    P, H = dense(fit)
    joint = np.concatenate([H, COLUMN], axis=1) / 0.1
    prior = np.zeros((len(P) + 1,) * 2)
    prior[:-1, :-1], prior[-1, -1] = np.linalg.inv(P), 1.0
    floor = np.sqrt(np.diag(np.linalg.inv(prior + joint.T @ joint)))[:2]
    np.testing.assert_allclose(rows_of(fit)["mean of any number of beats"], floor, rtol=1e-6)
    # Errors that are stated have no floor: nothing is promised of their end.
    assert "mean of any number of beats" not in rows_of(fitted(monkeypatch))


def test_shares_are_parts_of_the_variance(monkeypatch):
    fit = fitted(monkeypatch)
    P, H = dense(fit)
    N = STD**2 * np.eye(len(H)) + COLUMN @ COLUMN.T
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + N)
    left = np.eye(len(P)) - K @ H
    variance = np.diag(left @ P)
    shares = {(row.source, row.parameter): row.share for row in fit.known.shares}
    for k, name in enumerate(fit.result.parameters[:2]):
        expected = {
            SINGLE: STD**2 * K[k] @ K[k],
            "thickness": (K[k] @ COLUMN[:, 0]) ** 2,
            "pressure_scale": left[k, 2] ** 2 * P[2, 2],
        }
        for source, part in expected.items():
            assert shares[source, name] == pytest.approx(part / variance[k], rel=1e-6)
        assert sum(v for (_, own), v in shares.items() if own == name) == pytest.approx(1.0)


def test_a_wrong_pressure_moves_the_moduli_and_not_their_ratio(monkeypatch):
    given = unknowns()
    wide = [replace(u, std=0.4) if u.name == "pressure_scale" else u for u in given]
    fit = fitted(monkeypatch, *wide)
    known = {one.name: one for one in fit.known.quantities}
    ratio = known["ratio of E_f anterior to posterior"]
    m = fit.result.estimate
    assert ratio.estimate == pytest.approx(m[0] / m[1])
    assert ratio.generic == pytest.approx(6.23 / 2.09, rel=1e-2)
    # Along the ratio the variances of both moduli come with their covariance.
    C = fit.result.filtered.transformed.covariance
    std = np.sqrt(C[0, 0] + C[1, 1] - 2 * C[0, 1])
    assert np.log(ratio.high / ratio.low) == pytest.approx(2 * 1.959964 * std)
    per_pressure = known["E_f posterior if the stated pressure is right"]
    assert per_pressure.estimate == pytest.approx(m[1] / m[2])
    own = np.log(per_pressure.high / per_pressure.low)
    assert own < 0.7 * 2 * 1.959964 * fit.result.filtered.transformed.std[1]


def test_data_alone_are_the_estimate_without_the_prior_of_that_modulus(monkeypatch):
    fit = fitted(monkeypatch)
    given = unknowns()
    for k, alone in enumerate(fit.known.data_alone):
        wide = [replace(u, std=1e3 * u.mean) if j == k else u for j, u in enumerate(given)]
        other = fitted(monkeypatch, *wide).result
        # The formula is bent, and the prior's mean another one: to first order.
        assert np.log(alone.estimate) == pytest.approx(np.log(other.estimate[k]), abs=0.05)
        assert np.log(alone.high / alone.low) == pytest.approx(
            2 * 1.959964 * other.filtered.transformed.std[k], rel=0.1
        )


def test_strains_are_those_of_the_fitted_valve_with_the_spread_of_its_posterior(monkeypatch):
    fit = fitted(monkeypatch)
    case, rng = fit.case, np.random.default_rng(5)
    surface = case.surface
    strains = [one for one in fit.known.quantities if one.name.startswith("strain")]
    P, H = dense(fit)
    joint = np.concatenate([H, COLUMN], axis=1) / STD
    prior = np.zeros((len(P) + 1,) * 2)
    prior[:-1, :-1], prior[-1, -1] = np.linalg.inv(P), 1.0
    posterior = np.linalg.inv(prior + joint.T @ joint)
    drawn = rng.multivariate_normal(np.zeros(len(posterior)), posterior, 400)
    closed = case.frame(Role.CLOSED).vertices.shape
    at = fit.fitted["closed"]
    values = np.array(
        [mean_strains(surface.vertices, at + (joint @ d * STD).reshape(closed), surface).ravel()
         for d in drawn]
    )  # fmt: skip
    stds = [(one.high - one.low) / (2 * 1.959964) for one in strains]
    np.testing.assert_allclose(stds, 100 * values.std(axis=0), rtol=0.15)
    true = mean_strains(surface.vertices, shape(TRUE), surface).ravel()
    for one, truth in zip(strains, 100 * true, strict=True):
        assert abs(one.estimate - truth) < 3 * (one.high - one.low) / (2 * 1.959964)
