"""Posterior means of law and geometry, against dense least squares."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.mechanics.settings import ExponentialTissue
from mvest.personalisation import personalise
from mvest.personalisation.diagnostics import diagnostics_of
from mvest.personalisation.geometry import GeometryModes, NuisanceGeometry
from mvest.problem.verdict import NONE, judge
from tests.made_up_closure import BASE, FIELDS, error_source, made_up_case, settings, use
from tests.personalisation.test_known import dense

STD = 0.3
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
