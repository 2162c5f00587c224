"""Derived quantities, sources of variance, advice and posterior means, against dense algebra."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mvest.cases.case import ErrorSamples, Role
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import observation_noise
from mvest.estimation.sampled import SampledErrors
from mvest.estimation.transform import Identity, to_filter
from mvest.mechanics.settings import ExponentialTissue
from mvest.observation.learned import ErrorBeliefs
from mvest.personalisation import personalise
from mvest.personalisation.diagnostics import diagnostics_of
from mvest.personalisation.geometry import GeometryModes, NuisanceGeometry
from mvest.personalisation.known import (
    EXACTLY,
    PRESSURE_MMHG,
    REACH,
    SINGLE,
    LinearModel,
    data_alone,
)
from mvest.personalisation.sources import FrameSamples
from mvest.problem.verdict import NONE, judge
from mvest.valve.measure.strain import mean_strains
from tests.made_up_closure import (
    BASE,
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
    assert own == pytest.approx(2 * REACH * np.sqrt(C[1, 1] + C[2, 2] - 2 * C[1, 2]))
    assert own < 2 * REACH * np.sqrt(C[1, 1])


def test_data_alone_are_what_the_prior_was_updated_by():
    prior, data = Gaussian.from_variance([1.0], 2.0**2), Gaussian.from_variance([3.0], 1.5**2)
    precision = 1 / 2.0**2 + 1 / 1.5**2
    after = Gaussian.from_variance([(1.0 / 2.0**2 + 3.0 / 1.5**2) / precision], 1 / precision)
    filtered = SimpleNamespace(
        names=("E_f.a",), transform=Identity(), prior=prior, transformed=after
    )
    (row,) = data_alone(filtered)
    ends = data.mean + REACH * data.std * np.array([0.0, -1.0, 1.0])
    assert np.log([row["estimate"], row["low"], row["high"]]) == pytest.approx(ends)
    assert row["prior_stds"] == pytest.approx((3.0 - 1.0) / 2.0)


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


def test_an_error_that_the_moduli_undo_hardly_changes_the_strain(monkeypatch):
    # Samples move the prediction as the anterior modulus does. The estimate follows the frame.
    use(monkeypatch)
    case = made_up_case(0.05, noise=np.random.default_rng(2), displaced=False)
    # They are small against the prior, so nearly all of them is undone.
    moved = 0.05 * np.random.default_rng(4).standard_normal((12, 1, 1)) * FIELDS["E_f.anterior"]
    monkeypatch.setattr(
        "mvest.personalisation.errors.sample_frames",
        lambda *_: FrameSamples(moved, 0.0 * moved, 0.0 * moved),
    )
    n, f = len(case.surface.vertices), len(case.frames)
    samples = ErrorSamples(np.zeros((12, f, n, 3)), np.zeros((12, f, 2, 3)))
    wanted = settings(*unknowns(fixed=True))
    plain, wider = (personalise(c, wanted) for c in (case, replace(case, error_samples=samples)))
    assert wider.result.std[0] > 3.0 * plain.result.std[0]
    widths = [
        [row["high"] - row["low"] for row in fit.details["known"] if row["unit"] == "%"][:2]
        for fit in (plain, wider)
    ]
    # Without the compensation it would be sixteen times.
    assert np.all(np.array(widths[1]) < 8.0 * np.array(widths[0]))


def test_error_samples_count_once_in_the_variance_of_a_function():
    rng = np.random.default_rng(6)
    base = observation_noise(0.01**2, 20)
    samples = SampledErrors(base, rng.standard_normal((20, 400)))
    errors = SimpleNamespace(
        samples=samples, sources=(), source_sizes=lambda _: {}, single_noise=lambda *_, **__: base
    )
    model = LinearModel(("E_f.a", "E_f.b"), np.eye(2), rng.standard_normal((20, 2)), errors)
    of_unknowns = model.variance_of(np.eye(2, 2 + 400))
    np.testing.assert_allclose(of_unknowns, model.variances(), rtol=0.05)


CURVES = dict.fromkeys(("anterior", "posterior"), ExponentialTissue(0.06, 4.325, 1446.5))
WAVE = np.sin(BASE[:, :1]) * np.array([0.0, 0.0, 1.0])
"""mm, a shape that no modulus makes."""
OTHER = np.column_stack(
    [
        (1.2 * FIELDS["E_f.anterior"] + 0.5 * WAVE).ravel(),
        (0.8 * FIELDS["E_f.posterior"] - 0.4 * WAVE).ravel(),
    ]
)
"""Effect of another law of either leaflet on the closed frame."""


def moved_case(moved):
    """The made-up case, its closed frame moved by ``(n, 3)`` mm."""
    case = made_up_case(STD, noise=np.random.default_rng(2))
    frames = tuple(
        replace(f, vertices=f.vertices + moved) if f.role is Role.CLOSED else f for f in case.frames
    )
    return replace(case, frames=frames)


def innovation(fit):
    """Innovation ``(k,)`` and its covariance without marginalised errors, to first order."""
    P, H = dense(fit)
    filtered = fit.result.filtered
    prior = filtered.transform.forward(filtered.prior.mean)
    e = fit.result.observation.y - filtered.prediction.y
    return e + H @ (filtered.transformed.mean - prior), STD**2 * np.eye(len(e)) + H @ P @ H.T


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_the_law_is_estimated_from_the_data(monkeypatch, share):
    use(monkeypatch)
    way = OTHER.sum(axis=1)
    monkeypatch.setattr(
        "mvest.personalisation.errors.law_and_mesh_sources", lambda *_: (error_source(OTHER),)
    )
    fit = personalise(moved_case(share * way.reshape(-1, 3)), settings(nuisance_law=CURVES))
    # Generalised least squares of the position between the laws.
    e, S = innovation(fit)
    information = way @ np.linalg.solve(S, way)
    expected = way @ np.linalg.solve(S, e) / information
    assert fit.law_share == pytest.approx(expected, abs=1e-6)
    assert fit.law_share == pytest.approx(share, abs=2.5 / np.sqrt(information))
    failed_checks = {g.check: g.trust for g in judge(diagnostics_of(fit)).failed_checks}
    assert failed_checks.get("law") == (NONE if share else None)


def test_without_uncertainty_of_law_and_geometry_nothing_is_estimated_of_them(monkeypatch):
    use(monkeypatch)
    for geometry in (None, NuisanceGeometry(renewals=1)):
        fit = personalise(made_up_case(STD), settings(nuisance_geometry=geometry))
        assert fit.law_share is None
        assert fit.details["geometry"] == ()
        assert "law" in judge(diagnostics_of(fit)).missing


def test_errors_of_the_geometry_are_estimated_by_kind(monkeypatch):
    use(monkeypatch)
    points = 0.4 * np.array([[[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])
    kinds = (
        GeometryModes("open shape", {"shape": points}),
        GeometryModes("thickness", {"thickness": np.array([[0.1, 0.1], [0.1, -0.1]])}),
        GeometryModes("fibres", {"fibres": np.deg2rad([[10.0, 0.0], [0.0, 10.0]])}),
    )
    flat = [WAVE, np.roll(WAVE, 1, axis=1), WAVE**2, np.roll(WAVE**2, 1, axis=1), WAVE**3]
    G = np.column_stack([0.5 * each.ravel() for each in flat])
    rows = np.split(G, [1, 3], axis=1)
    sources = tuple(error_source(own, kind) for kind, own in zip(kinds, rows, strict=True))
    monkeypatch.setattr("mvest.personalisation.errors.geometry_sources", lambda *_: sources)
    sizes = (2.0, -1.0, 0.5, 0.0, -2.8)
    wanted = settings(nuisance_geometry=NuisanceGeometry())
    fit = personalise(moved_case((G @ sizes).reshape(-1, 3)), wanted)
    e, S = innovation(fit)
    modes = G.T @ np.linalg.solve(S + G @ G.T, e)
    assert modes == pytest.approx(sizes, abs=0.6)
    one, other = modes[1] + modes[2], modes[1] - modes[2]
    expected = [
        ("open shape", "mm", modes[0] * 0.4 * np.sqrt(2.5), modes[0]),
        ("thickness", "%", 10 * np.hypot(one, other) / np.sqrt(2), np.abs(modes[1:3]).max()),
        ("fibres", "degrees", 10 * np.hypot(*modes[3:]) / np.sqrt(2), np.abs(modes[3:]).max()),
    ]
    for row, (name, unit, size, stretch) in zip(fit.details["geometry"], expected, strict=True):
        assert (row["name"], row["unit"]) == (name, unit)
        assert row["size"] == pytest.approx(size, rel=0.01)
        assert row["stretch"] == pytest.approx(stretch, abs=0.01)
    check = "what was known beforehand"
    (failed,) = [g for g in judge(diagnostics_of(fit)).failed_checks if g.check == check]
    assert failed.text.startswith(f"fibres of the valve was moved by {row['stretch']:.1f} of its")
