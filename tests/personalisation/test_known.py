"""Derived quantities, sources of variance and advice, against dense linear algebra."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.estimation.transform import to_filter
from mvest.observation.learned import ErrorBeliefs
from mvest.personalisation import personalise
from mvest.personalisation.geometry import GeometryModes, NuisanceGeometry
from mvest.personalisation.known import EXACTLY, PRESSURE_MMHG, REACH, SINGLE
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
"""Effect of one standard deviation of the thickness on the closed frame, mm."""


def fitted(monkeypatch, *given, errors=None):
    """A case with an uncertain thickness."""
    use(monkeypatch)
    source = error_source(COLUMN, THICKNESS)
    monkeypatch.setattr("mvest.personalisation.errors.geometry_sources", lambda *_: (source,))
    return personalise(
        made_up_case(STD, noise=np.random.default_rng(2)),
        settings(*given, nuisance_geometry=NuisanceGeometry(), errors=errors),
    )


def dense(fit):
    """Prior covariance ``(p, p)`` of the unknowns, and their slopes ``(k, p)``."""
    filtered = fit.result.filtered
    z = filtered.transformed.mean
    H = filtered.prediction.jacobian * filtered.transform.derivative(z)
    return to_filter(filtered.transform, fit.result.filtered.prior).covariance, H


def posterior(fit, std=STD, sizes=None, thickness=1.0):
    """Covariance ``(p + 1, p + 1)`` of unknowns and thickness, by dense linear algebra."""
    P, H = dense(fit)
    share = np.array([(sizes or {}).get(name, 1.0) for name in fit.result.parameters])
    joint = np.concatenate([H, thickness * COLUMN], axis=1) / std
    prior = np.zeros((len(P) + 1,) * 2)
    prior[:-1, :-1], prior[-1, -1] = np.linalg.inv(P * np.outer(share, share)), 1.0
    return np.linalg.inv(prior + joint.T @ joint)


def stds_of(fit):
    """Standard deviations of the moduli now, and by what is measured."""
    found = {}
    for row in fit.details["narrower"]:
        what = row["what"].partition(", ")[2]
        found.setdefault(what, []).append(row["std_if_known"])
    now = [row["std_now"] for row in fit.details["narrower"][:2]]
    return np.array(now), {what: np.array(stds) for what, stds in found.items()}


def test_advice_is_the_update_by_hand(monkeypatch):
    fit = fitted(monkeypatch)

    def by_hand(*given, **more):
        return np.sqrt(np.diag(posterior(fit, *given, **more)))[:2]

    now, found = stds_of(fit)
    np.testing.assert_allclose(now, by_hand(), rtol=1e-6)
    np.testing.assert_allclose(now, fit.result.filtered.transformed.std[:2], rtol=1e-6)
    pressure = {"pressure_scale": PRESSURE_MMHG / (0.1 * PRESSURE)}
    expected = {
        "pressure measured to ±3 mmHg": by_hand(sizes=pressure),
        "lengths of the chordae measured to ±0.5 %": by_hand(sizes={"chord_rest_length": 0.25}),
        "thickness of the leaflets measured to a third of its error now": by_hand(thickness=1 / 3),
        "mean of 4 beats": by_hand(STD / 2.0),
    }
    for what, stds in expected.items():
        np.testing.assert_allclose(found[what], stds, rtol=1e-6, err_msg=what)


@pytest.mark.parametrize("errors", [None, ErrorBeliefs(resolution_mm=0.1)])
def test_no_advice_promises_more_than_knowing_everything_measurable(monkeypatch, errors):
    fit = fitted(monkeypatch, errors=errors)
    now, found = stds_of(fit)
    # Stated errors have no floor, so nothing is promised of infinitely many beats.
    assert ("mean of any number of beats" in found) == (errors is not None)
    if errors is not None:
        floor = np.sqrt(np.diag(posterior(fit, 0.1)))[:2]
        np.testing.assert_allclose(found["mean of any number of beats"], floor, rtol=1e-6)
    least = found.pop(EXACTLY)
    assert np.all(least > 0.0)
    for what, stds in found.items():
        assert np.all(stds >= least * (1 - 1e-9)), what
        assert np.all(stds <= now * (1 + 1e-9)), what


def test_shares_are_parts_of_the_variance(monkeypatch):
    fit = fitted(monkeypatch)
    P, H = dense(fit)
    N = STD**2 * np.eye(len(H)) + COLUMN @ COLUMN.T
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + N)
    left = np.eye(len(P)) - K @ H
    variance = np.diag(left @ P)
    shares = {(r["source"], r["parameter"]): r["share"] for r in fit.details["shares"]}
    for k, name in enumerate(fit.result.parameters[:2]):
        expected = {
            SINGLE: STD**2 * K[k] @ K[k],
            "thickness": (K[k] @ COLUMN[:, 0]) ** 2,
            "pressure (factor)": left[k, 2] ** 2 * P[2, 2],
        }
        for source, part in expected.items():
            assert shares[source, name] == pytest.approx(part / variance[k], rel=1e-6)
        assert sum(v for (_, own), v in shares.items() if own == name) == pytest.approx(1.0)


def test_a_wrong_pressure_moves_the_moduli_and_not_their_ratio(monkeypatch):
    wide = [replace(u, std=0.4) if u.name == "pressure_scale" else u for u in unknowns()]
    fit = fitted(monkeypatch, *wide)
    known = {row["name"]: row for row in fit.details["known"]}
    ratio, m = known["ratio of E_f anterior to posterior"], fit.result.estimate
    assert ratio["estimate"] == pytest.approx(m[0] / m[1])
    assert ratio["generic"] == pytest.approx(6.23 / 2.09, rel=1e-2)
    C = fit.result.filtered.transformed.covariance
    std = np.sqrt(C[0, 0] + C[1, 1] - 2 * C[0, 1])
    assert np.log(ratio["high"] / ratio["low"]) == pytest.approx(2 * REACH * std)
    per_pressure = known["E_f posterior if the stated pressure is right"]
    assert per_pressure["estimate"] == pytest.approx(m[1] / m[2])
    own = np.log(per_pressure["high"] / per_pressure["low"])
    assert own < 0.7 * 2 * REACH * fit.result.filtered.transformed.std[1]


def test_data_alone_are_the_estimate_without_the_prior_of_that_modulus(monkeypatch):
    fit, given = fitted(monkeypatch), unknowns()
    assert len(fit.details["data_alone"]) == 2
    for k, alone in enumerate(fit.details["data_alone"]):
        wide = [replace(u, std=1e3 * u.mean) if j == k else u for j, u in enumerate(given)]
        other = fitted(monkeypatch, *wide).result
        # The formula is curved, and the prior's mean differs: to first order.
        assert np.log(alone["estimate"]) == pytest.approx(np.log(other.estimate[k]), abs=0.05)
        width = 2 * REACH * other.filtered.transformed.std[k]
        assert np.log(alone["high"] / alone["low"]) == pytest.approx(width, rel=0.1)


def test_strains_are_those_of_the_fitted_valve_with_the_spread_of_its_posterior(monkeypatch):
    fit = fitted(monkeypatch)
    surface, rng = fit.case.surface, np.random.default_rng(5)
    strains = [row for row in fit.details["known"] if row["name"].startswith("strain")]
    joint = np.concatenate([dense(fit)[1], COLUMN], axis=1)
    drawn = rng.multivariate_normal(np.zeros(joint.shape[1]), posterior(fit), 400)
    closed = fit.case.frame(Role.CLOSED).vertices.shape
    at = fit.frames[0].positions["personalised"]
    values = np.array(
        [mean_strains(surface.vertices, at + (joint @ d).reshape(closed), surface).ravel()
         for d in drawn]
    )  # fmt: skip
    stds = np.array([(row["high"] - row["low"]) / (2 * REACH) for row in strains])
    np.testing.assert_allclose(stds, 100 * values.std(axis=0), rtol=0.15)
    true = 100 * mean_strains(surface.vertices, shape(TRUE), surface).ravel()
    assert np.all(np.abs([row["estimate"] for row in strains] - true) < 3 * stds)
