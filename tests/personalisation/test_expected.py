"""What is expected of geometry and law beside an estimate, against dense least squares."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import Role
from mvest.estimation.transform import to_filter
from mvest.mechanics.settings import ExponentialTissue
from mvest.personalisation import personalise
from mvest.personalisation.diagnostics import diagnostics_of
from mvest.personalisation.geometry import GeometryModes, NuisanceGeometry
from mvest.problem.verdict import NONE, judge
from tests.made_up_closure import BASE, FIELDS, error_source, made_up_case, settings, use

STD = 0.3
CURVES = dict.fromkeys(("anterior", "posterior"), ExponentialTissue(0.06, 4.325, 1446.5))
WAVE = np.sin(BASE[:, :1]) * np.array([0.0, 0.0, 1.0])
"""mm, no modulus does the like."""
OTHER = np.column_stack(
    [
        (1.2 * FIELDS["E_f.anterior"] + 0.5 * WAVE).ravel(),
        (0.8 * FIELDS["E_f.posterior"] - 0.4 * WAVE).ravel(),
    ]
)
"""What another law of either leaflet does to the closed frame."""


def seen_with(noise, *moves):
    """The made-up case, its closed frame moved by ``(n, 3)`` mm."""
    case = made_up_case(STD, noise=np.random.default_rng(noise))
    frames = tuple(
        replace(f, vertices=f.vertices + sum(moves)) if f.role is Role.CLOSED else f
        for f in case.frames
    )
    return replace(case, frames=frames)


def dense(result):
    """Innovation ``(k,)`` and its covariance without what is considered, both to first order."""
    filtered = result.filtered
    z = filtered.transformed.mean
    H = filtered.prediction.jacobian * filtered.transform.derivative(z)
    prior = to_filter(filtered.transform, filtered.prior)
    e = result.observation.y - filtered.prediction.y + H @ (z - prior.mean)
    return e, STD**2 * np.eye(len(e)) + H @ prior.covariance @ H.T


@pytest.fixture
def stiffening(monkeypatch):
    use(monkeypatch)
    monkeypatch.setattr(
        "mvest.personalisation.errors.law_and_mesh_sources",
        lambda *_: (error_source(OTHER),),
    )

    def run(share):
        moved = share * OTHER.sum(axis=1).reshape(-1, 3)
        return personalise(seen_with(2, moved), settings(nuisance_law=CURVES))

    return run


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_the_law_is_told_from_what_was_seen(stiffening, share):
    fit, way = stiffening(share), OTHER.sum(axis=1)
    # Generalised least squares of the whole way's size.
    e, S = dense(fit.result)
    information = way @ np.linalg.solve(S, way)
    expected = way @ np.linalg.solve(S, e) / information
    assert fit.known.law_share == pytest.approx(expected, abs=1e-6)
    assert fit.known.law_share == pytest.approx(share, abs=2.5 / np.sqrt(information))
    failed_checks = {g.check: g.trust for g in judge(diagnostics_of(fit)).failed_checks}
    assert failed_checks.get("law") == (NONE if share else None)


def test_nothing_is_told_of_a_law_that_is_not_considered(monkeypatch):
    use(monkeypatch)
    fit = personalise(made_up_case(STD), settings())
    assert fit.known.law_share is None
    assert fit.known.geometry == ()
    assert "law" in judge(diagnostics_of(fit)).missing


def test_a_geometry_that_is_off_is_told_by_kind(monkeypatch):
    use(monkeypatch)
    points = 0.4 * np.array([[[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]])
    kinds = (
        GeometryModes("open shape", {"shape": points}),
        GeometryModes("thickness", {"thickness": np.array([[0.1, 0.1], [0.1, -0.1]])}),
        GeometryModes("fibres", {"fibres": np.deg2rad([[10.0, 0.0], [0.0, 10.0]])}),
    )
    flat = [WAVE, np.roll(WAVE, 1, axis=1), WAVE**2, np.roll(WAVE**2, 1, axis=1), WAVE**3]
    rows = [0.5 * each.reshape(-1, 1) for each in flat]
    rows = (rows[0], np.hstack(rows[1:3]), np.hstack(rows[3:5]))

    sources = tuple(error_source(own, kind) for kind, own in zip(kinds, rows, strict=True))
    monkeypatch.setattr("mvest.personalisation.errors.geometry_sources", lambda *_: sources)
    sizes = (2.0, -1.0, 0.5, 0.0, -2.8)
    moved = sum(q * r for q, r in zip(sizes, np.hstack(rows).T, strict=True)).reshape(-1, 3)
    fit = personalise(seen_with(2, moved), settings(nuisance_geometry=NuisanceGeometry(renewals=0)))
    e, S = dense(fit.result)
    G = np.hstack(rows)
    modes = G.T @ np.linalg.solve(S + G @ G.T, e)
    assert modes == pytest.approx(sizes, abs=0.6)
    shape, thickness, fibres = fit.known.geometry
    assert (shape.name, shape.unit) == ("open shape", "mm")
    assert shape.stretch == pytest.approx(modes[0], abs=0.01)
    assert shape.size == pytest.approx(modes[0] * 0.4 * np.sqrt(2.5), rel=0.01)
    assert (thickness.name, thickness.unit) == ("thickness", "%")
    assert thickness.stretch == pytest.approx(np.abs(modes[1:3]).max(), abs=0.01)
    one, other = modes[1] + modes[2], modes[1] - modes[2]
    assert thickness.size == pytest.approx(10 * np.sqrt((one**2 + other**2) / 2), abs=0.1)
    assert (fibres.name, fibres.unit) == ("fibres", "degrees")
    assert fibres.stretch == pytest.approx(np.abs(modes[3:]).max(), abs=0.01)
    assert fibres.size == pytest.approx(10 * np.linalg.norm(modes[3:]) / np.sqrt(2), abs=0.1)
    (failed,) = [
        g
        for g in judge(diagnostics_of(fit)).failed_checks
        if g.check == "what was known beforehand"
    ]
    assert failed.text.startswith(f"fibres of the valve was moved by {fibres.stretch:.1f} of its")


def test_a_geometry_of_which_nothing_is_in_doubt_is_not_told(monkeypatch):
    use(monkeypatch)
    fit = personalise(made_up_case(STD), settings(nuisance_geometry=NuisanceGeometry(renewals=1)))
    assert fit.known.geometry == ()
