"""The joint posterior of parameters and errors of the geometry, and the steps to its mode."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from scipy.optimize import least_squares

from mvest.cases.case import Role
from mvest.errors import GeometryError
from mvest.estimation.estimate import Reason
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import low_rank_noise, observation_noise
from mvest.estimation.prediction import Prediction
from mvest.estimation.transform import Identity, Log, to_filter
from mvest.mechanics.settings import ExponentialTissue
from mvest.personalisation import estimation, personalise
from mvest.personalisation.chain import predicted_frames
from mvest.personalisation.estimation import SETTLED, CaseProblem
from mvest.personalisation.geometry import GeometryModes, NuisanceGeometry
from mvest.personalisation.joint import JointPosterior, damped_step
from mvest.problem.registration import REGISTRATION
from mvest.problem.verdict import CHECKS
from tests.made_up_closure import (
    FIELDS,
    PRIORS,
    TRUE,
    MadeUpClosure,
    error_source,
    made_up_case,
    settings,
    shape,
    unknowns,
    use,
)

MODE = GeometryModes("open shape", {"shape": np.ones((1, 1))})
MODULI = ("E_f.anterior", "E_f.posterior")
K, Q, SIZE = 40, 6, 4.0
"""Observations, modes of the geometry, and the learned factor on their size."""
STD = 0.5


@pytest.fixture
def problem():
    """A posterior, its rows of the geometry, derivatives, and another error column."""
    rng = np.random.default_rng(3)
    rows, H = rng.normal(0.0, 0.1, (K, Q)), rng.normal(0.0, 1.0, (K, 3))
    beside = rng.normal(0.0, 0.3, (K, 1))
    base = observation_noise(STD**2, K)
    errors = SimpleNamespace(
        geometry=(SimpleNamespace(name="open shape", rows=rows),),
        geometry_sizes=lambda learned: (SIZE,),
        noise=lambda learned, *, without: low_rank_noise(base, beside),
    )
    prior = Gaussian.from_variance(np.array([0.1, -0.2, 0.3]), np.array([0.2, 0.5, 0.4]) ** 2)
    observation = SimpleNamespace(y=rng.normal(0.0, 1.0, K), of=lambda model: model)
    return JointPosterior(prior, Identity(), observation, errors, None), rows, H, beside


def test_a_step_of_parameters_and_modes_is_that_of_least_squares(problem):
    posterior, rows, H, beside = problem
    prior, residual = posterior.prior, posterior.observation.y
    z = prior.mean + np.array([0.3, -0.1, 0.2])

    def best(*columns, sizes):
        A = np.concatenate([H, *columns], axis=1) / STD
        own = np.diag(np.concatenate([1.0 / prior.std, sizes]))
        away = np.concatenate([(prior.mean - z) / prior.std, np.zeros(len(sizes))])
        right = np.concatenate([residual / STD, away])
        return np.linalg.lstsq(np.concatenate([A, own]), right, rcond=None)[0]

    end = posterior.step(z, residual, H)
    left = residual - H @ (end - z)
    found = posterior.expected(left)
    whole = best(rows, beside, sizes=np.array([1.0 / SIZE] * Q + [1.0]))
    np.testing.assert_allclose(end, z + whole[:3], atol=1e-9)
    np.testing.assert_allclose(found[0], whole[3 : 3 + Q], atol=1e-9)
    lowest = posterior.misfit(end, left - rows @ found[0], found)
    for change in 1e-3 * np.eye(Q):
        moved = (found[0] + change,)
        assert posterior.misfit(end, left - rows @ moved[0], moved) > lowest
    # With a known geometry only parameters and the other column are left.
    fitted = posterior.refitted(z, Prediction(np.zeros(K), H))
    np.testing.assert_allclose(fitted, z + best(beside, sizes=np.ones(1))[:3], atol=1e-9)


def test_a_step_is_damped_by_a_parabola_through_its_trials():
    tried = []

    def curved(curvature):
        def trial(share):
            tried.append(share)
            return 10.0 - 2.0 * 3.0 * share + curvature * share**2, share

        return trial

    # To first order the full step gains 3: as predicted, or four times as curved.
    assert damped_step(curved(3.0), 10.0, 3.0) == 1.0
    assert tried == [1.0]
    assert damped_step(curved(12.0), 10.0, 3.0) == 0.25
    # The second trial gains what the parabola through the first predicts.
    assert tried == [1.0, 1.0, 0.25]
    # So curved that a fifth of the step, the shortest second trial, is worse than the start.
    assert damped_step(curved(120.0), 10.0, 3.0) == pytest.approx(0.04)
    # A valve that does not close halves the step; nothing is better, and nothing closes.
    assert damped_step(lambda s: "torn" if s > 0.6 else (5.0, s), 10.0, 3.0) == 0.5
    assert damped_step(lambda share: (11.0, share), 10.0, -1.0) == ""
    assert damped_step(lambda share: "torn", 10.0, 3.0) == "torn"


BENT, CURVED = FIELDS["loose"].ravel(), FIELDS["E_f.anterior"].ravel()
"""Effect of the one mode on the closed valve (mm), and of its square: like another modulus."""


class BentGeometry:
    """Stands for a `RestGeometry`."""

    curve: ClassVar[float] = 1.0

    def __init__(self, model):
        self.model = model

    def displaced(self, parts):
        (bend,) = parts["shape"]
        return BentClosure(self.model.names, self.model.fixed, bend=bend)


def bent(x, bend):
    """A closed valve ``(3 n,)`` that is displaced by the one mode."""
    return x + BENT * bend + BentGeometry.curve * CURVED * bend**2


@dataclass(eq=False)
class BentClosure(MadeUpClosure):
    """The formula for a valve that is displaced by one mode."""

    bend: float = 0.0

    def __call__(self, m):
        plain = super().__call__(m)
        if not plain.converged:
            return plain
        rest, closed = np.split(plain.y, 2)
        return replace(plain, y=np.concatenate([rest, bent(closed, self.bend)]))


def bent_case(monkeypatch, curve, std=0.5):
    """A case whose valve is displaced by 0.6 of the one mode, and its nuisances, all known."""
    use(monkeypatch)
    monkeypatch.setattr(BentGeometry, "curve", curve)

    def sources(modes, valve, observation, noise, seen):
        bend = getattr(valve.registered.model, "bend", 0.0)
        slope = (BENT + 2.0 * curve * bend * CURVED)[:, None]
        return (error_source(slope, MODE),)

    monkeypatch.setattr("mvest.personalisation.errors.geometry_sources", sources)
    monkeypatch.setattr("mvest.personalisation.model.RestGeometry", BentGeometry)
    straight = made_up_case(std, displaced=False)
    closed = straight.frame(Role.CLOSED)
    frame = replace(closed, vertices=bent(closed.vertices.ravel(), 0.6).reshape(-1, 3))
    known = {name: value for name, value in TRUE.items() if not name.startswith("E_f.")}
    known |= dict.fromkeys(REGISTRATION, 0.0)
    frames = tuple(frame if f is closed else f for f in straight.frames)
    return replace(straight, frames=frames), known


def renewed(case, known, renewals, **changes):
    geometry = NuisanceGeometry(renewals=renewals)
    given = unknowns(fixed=True, **known)
    return personalise(case, settings(*given, nuisance_geometry=geometry, **changes))


@pytest.fixture
def steps(monkeypatch):
    """The steps of relinearisation: problem, estimate, point and what was found."""
    taken, nearer = [], estimation._nearer

    def followed(problem, result, point):
        taken.append((problem, result, point, nearer(problem, result, point)))
        return taken[-1][-1]

    monkeypatch.setattr(estimation, "_nearer", followed)
    return taken


@pytest.mark.parametrize("curve", [1.0, 100.0])
def test_relinearisation_ends_at_the_joint_mode_of_moduli_and_geometry(monkeypatch, steps, curve):
    case, known = bent_case(monkeypatch, curve)
    seen = case.frame(Role.CLOSED).vertices.ravel()
    log = [to_filter(Log(), Gaussian.from_variance([m], s**2))
           for m, s in (PRIORS[name] for name in MODULI)]  # fmt: skip

    def objective(z):
        x = shape(known | dict(zip(MODULI, np.exp(z[:2]), strict=True))).ravel()
        prior = [(z[k] - log[k].mean[0]) / log[k].std[0] for k in range(2)]
        return np.concatenate([(bent(x, z[2]) - seen) / 0.5, prior, z[2:]])

    mode = least_squares(objective, [1.5, 1.0, 0.0], xtol=1e-14, ftol=1e-14, gtol=1e-14).x

    def misfit(point):
        bend = point.errors.displaced_by or np.zeros((1, 1))
        return np.sum(objective([*np.log(point.m), bend[0][0]]) ** 2)

    errors = []
    for renewals in (0, 1, 2, 12):
        steps.clear()
        fit = renewed(case, known, renewals, tolerance=1e-9)
        assert (len(steps) == 0) == (renewals == 0) == (fit.moved is None)
        for _, _, before, after in steps:
            assert misfit(after) < misfit(before)
        errors.append(np.abs(np.log(fit.result.estimate) - mode[:2]).max())
    assert errors[0] > 0.05
    # Estimates of the steps are rough, so the end is not the mode to the last digit.
    assert max(errors[2:]) < max(errors[1], 1e-3) < errors[0]
    assert errors[3] < 0.1 * fit.result.filtered.transformed.std.max()
    if curve < 100.0:
        assert fit.moved < SETTLED
    else:
        # Twelve steps do not reach the end of such a valley, although the estimate is there.
        assert fit.moved > CHECKS["moved"].limits[0]


@pytest.mark.parametrize("renewals", [0, 2])
def test_an_exact_valve_is_compared_with_a_model_of_known_error(monkeypatch, renewals):
    case, known = bent_case(monkeypatch, curve=1.0)
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


def test_held_out_frames_have_the_displaced_boundary(monkeypatch):
    case, known = bent_case(monkeypatch, curve=1.0)
    closed = case.frame(Role.CLOSED)
    later = replace(closed, name="later", time=1.0, role=Role.HELD_OUT)
    case = replace(case, frames=(*case.frames, later))
    parts = {"annulus": np.full(closed.annulus.shape, 0.3), "tips": np.full((1, 3), -0.4)}
    problem = CaseProblem.of(case, settings(*unknowns(fixed=True, **known)))
    stated = problem.generic()
    off = replace(stated, closure=replace(stated.closure, displacement=parts))
    predicted_frames(problem, off, off.m, off.prediction.y)
    held = problem.stated.model.states[-1]
    np.testing.assert_allclose(held.annulus, closed.annulus + 0.3)
    np.testing.assert_allclose(held.papillary_tips, closed.papillary_tips - 0.4)
    assert held.pressure_mmHg == closed.pressure_mmHg


@pytest.mark.parametrize("why", ["no equilibrium", "thickness is -0.1 mm, expected > 0"])
def test_a_displaced_valve_that_does_not_close_leaves_the_estimate_and_its_reason(monkeypatch, why):
    case, known = bent_case(monkeypatch, curve=1.0)

    def displaced(self, parts):
        if why.startswith("thickness"):
            raise GeometryError(why)
        (bend,) = parts["shape"]
        return BentClosure(self.model.names, self.model.fixed, bend=bend, fails_above=0.0)

    monkeypatch.setattr(BentGeometry, "displaced", displaced)
    plain, failed = (renewed(case, known, renewals) for renewals in (0, 2))
    np.testing.assert_array_equal(failed.result.estimate, plain.result.estimate)
    assert failed.moved is None
    (reason,) = failed.unaccounted
    assert reason.startswith("about the expected geometry: ")
    assert why in reason


def test_relinearisation_goes_on_from_estimates_that_are_out_of_iterations(monkeypatch):
    case, known = bent_case(monkeypatch, curve=1.0)
    finished, about = renewed(case, known, 2), estimation._estimate_about

    def out_of_iterations(problem, point, *, final=True):
        found = about(problem, point, final=final)
        if final:
            return found
        filtered = replace(found.filtered, reason=Reason.MAX_ITERATIONS)
        return replace(found, filtered=filtered, converged=False)

    monkeypatch.setattr(estimation, "_estimate_about", out_of_iterations)
    fit = renewed(case, known, 2)
    np.testing.assert_array_equal(fit.result.estimate, finished.result.estimate)
    assert fit.unaccounted == ()
    assert fit.moved == finished.moved is not None


def test_other_unaccounted_errors_do_not_stop_relinearisation(monkeypatch):
    case, known = bent_case(monkeypatch, curve=1.0)
    monkeypatch.setattr("mvest.personalisation.errors.law_and_mesh_sources", lambda *_: "no law")
    law = {"anterior": ExponentialTissue(0.06, 4.325, 1446.5)}
    fit = renewed(case, known, 2, nuisance_law=law)
    assert fit.unaccounted == ("no law",)
    assert fit.moved < SETTLED
