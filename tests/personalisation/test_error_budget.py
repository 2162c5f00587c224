"""What each part of what is not known costs: parts of samples, rows, and what moves a model."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from mvest.cases.case import ErrorSamples, Role
from mvest.closure.rest_geometry import RestGeometry
from mvest.estimation.noise import observation_noise
from mvest.personalisation.error_budget import EVERYTHING, IMAGES, MOTION, budget_rows, sample_parts
from mvest.personalisation.geometry_errors import frame_errors
from tests.cases.test_uncertainty import corresponding
from tests.closure.test_model import AT, CLOSING, model_of


def with_samples(moves, tips):
    case = corresponding(24, 7)
    n = len(case.surface.vertices)
    frames = [case.frame(Role.REFERENCE), case.frame(Role.CLOSED)]
    case = replace(case, frames=tuple(frames))
    vertices = np.zeros((len(moves), 2, n, 3)) + moves
    return replace(
        case, error_samples=ErrorSamples(vertices, np.zeros((len(tips), 2, 2, 3)) + tips)
    )


def size(moves):
    return max(np.abs(moves[0]).max(), np.abs(moves[1]).max())


def test_parts_of_samples_add_up_to_them():
    rng = np.random.default_rng(0)
    n = len(corresponding(24, 7).surface.vertices)
    case = with_samples(rng.standard_normal((4, 2, n, 3)), rng.standard_normal((4, 2, 2, 3)))
    parts, motion = sample_parts(case)
    for k, whole in enumerate((case.error_samples.vertices, case.error_samples.tips)):
        np.testing.assert_allclose(sum(own[k] for own in parts.values()), whole, atol=1e-12)
        alike = whole - motion[k]
        np.testing.assert_allclose(alike[:, 0], alike[:, 1], atol=1e-12)
        np.testing.assert_allclose(alike[:, 0], whole.mean(axis=1), atol=1e-12)


def test_a_displacement_of_the_closed_frame_is_no_change_of_its_shape():
    shift = np.array([0.4, -0.2, 0.7])
    moves = np.repeat(np.stack([np.zeros(3), shift])[None, :, None], 4, axis=0)
    parts, _ = sample_parts(with_samples(moves, moves))
    both = parts["both frames displaced as one"][0]
    np.testing.assert_allclose(both, np.broadcast_to(0.5 * shift, both.shape), atol=1e-9)
    assert size(parts["closed frame displaced"]) == pytest.approx(0.35)
    others = set(parts) - {"both frames displaced as one", "closed frame displaced"}
    assert all(size(parts[words]) < 1e-9 for words in others)


def test_rows_are_those_of_a_linear_model_whose_gains_have_not_seen_the_sample():
    rng = np.random.default_rng(1)
    H, C = (rng.standard_normal((30, k)) for k in (3, 1))
    D, E, F = (rng.standard_normal((30, 6)) for _ in range(3))
    names, prior = ("E_f.a", "pressure_scale", "E_f.b"), np.diag([0.16, 0.01, 0.16])
    source = np.array([0, 1, 2, 0, 1, 2])
    wider = (stats.t.ppf(0.975, 3) / stats.norm.ppf(0.975)) ** 2

    def gain(R, own, P):
        return P @ own.T @ np.linalg.inv(own @ P @ own.T + R)

    def std(samples, beside, unknown):
        own, P = H[:, unknown], prior[np.ix_(unknown, unknown)]
        R = 0.25 * np.eye(30) + beside @ beside.T
        if samples is None:
            return np.sqrt(np.diag(P - gain(R, own, P) @ own @ P))[:2]
        K = gain(R + samples @ samples.T / 6, own, P)
        rest = np.eye(len(P)) - K @ own
        found = rest @ P @ rest.T + K @ beside @ beside.T @ K.T
        for one in range(3):
            others = samples[:, source != one]
            moved = gain(R + others @ others.T / 4, own, P) @ samples[:, source == one]
            found = found + wider / 6 * moved @ moved.T
        return np.sqrt(np.diag(found))[:2]

    rows = budget_rows(
        names, H, prior, observation_noise(0.25, 30), {"x": D, "y": E}, F, source, {"z": C}
    )
    found = {}
    for row in rows:
        found.setdefault(row.part, []).append((row.without, row.alone))
    all_, moduli, whole, none = [0, 2, 1], [0, 2], D + E, np.zeros((30, 0))
    for part, without, alone in (
        (EVERYTHING, std(whole, C, all_), std(None, none, moduli)),
        (IMAGES, std(None, C, all_), std(whole, none, moduli)),
        (MOTION, std(whole - F, C, all_), std(F, none, moduli)),
        ("x", std(E, C, all_), std(D, none, moduli)),
        ("z", std(whole, none, all_), std(None, C, moduli)),
        ("pressure_scale", std(whole, C, moduli), std(None, none, all_)),
    ):
        np.testing.assert_allclose(found[part], np.stack([without, alone], axis=1), rtol=1e-6)


def test_all_that_a_sample_moves_is_moved_at_once():
    model = model_of(CLOSING, continuation=True)
    assert model(AT).converged
    n = len(model.valve.surface.vertices)
    rng = np.random.default_rng(2)
    vertices = 0.1 * rng.standard_normal((2, 2, n, 3))
    tips = 0.1 * rng.standard_normal((2, 2, 2, 3))
    case = _case_of(model)
    geometry = RestGeometry(model)

    def change(moves, by):
        return geometry.change(AT, frame_errors(case, geometry, moves, by))[1]

    whole = change(vertices, tips)
    apart = change(vertices, 0 * tips) + change(0 * vertices, tips)
    np.testing.assert_allclose(whole, apart, atol=1e-3 * np.abs(whole).max())
    # Of the closed frame its annulus and its tips alone are what a model is built from.
    inner = np.ones(n, dtype=bool)
    inner[model.valve.annulus] = False
    moved = vertices.copy()
    moved[:, 1, inner] = 0.0
    np.testing.assert_allclose(change(moved, tips), whole, atol=1e-9)


def _case_of(model):
    valve = model.valve
    frames = [SimpleNamespace(role=role) for role in (Role.REFERENCE, Role.CLOSED)]
    return SimpleNamespace(
        frames=frames,
        surface=valve.surface,
        annulus=valve.annulus,
        chordae=valve.chordae,
        chordae_follow=False,
    )
