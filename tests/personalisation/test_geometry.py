"""What is not known of the geometry: modes, columns of an observation, and wider intervals."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from scipy.optimize import least_squares

from mvest.cases.case import Role
from mvest.cases.tissue import SEEN_ON_BAND, LeafletBand, lay_out_chordae
from mvest.closure.frames import FramesModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.errors import GeometryError, InputError
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import observation_noise
from mvest.estimation.prediction import Prediction
from mvest.estimation.transform import Log, to_filter
from mvest.mechanics.settings import ExponentialTissue
from mvest.mechanics.valve_system import HeldState
from mvest.observation.vertices import Observation
from mvest.personalisation import estimation, personalise
from mvest.personalisation.chain import predicted_frames
from mvest.personalisation.diagnostics import diagnostics_of
from mvest.personalisation.estimation import (
    SETTLED,
    CaseProblem,
    linearised,
)
from mvest.personalisation.geometry import (
    GeometryModes,
    NuisanceGeometry,
    displacement,
    geometry_modes,
    leaflet_scales,
    rest_lengths_by_ends,
    rest_lengths_by_tips,
    smooth_modes,
)
from mvest.personalisation.model import CaseClosure
from mvest.personalisation.sources import geometry_sources
from mvest.problem.registration import REGISTRATION, RegisteredModel
from mvest.problem.verdict import CHECKS
from tests.cases.test_uncertainty import corresponding
from tests.closure.test_model import AT, CLOSING, GENTLE, SMALL, model_of
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
NONE = NuisanceGeometry(
    shape_mm=0, annulus_mm=0, tips_mm=0, insertions_mm=0, thickness=0, fibre_degrees=0
)
MODULI = ("E_f.anterior", "E_f.posterior")
MODULUS_PRIORS = [PRIORS[name] for name in MODULI]
UP = np.array([0.0, 0.0, 1.0])


def test_smooth_modes_have_the_share_of_the_variance_that_is_asked_for():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 30, (300, 3)) * [1, 1, 0]
    few, many = (smooth_modes(points, 10.0, share) for share in (0.8, 0.99))
    assert len(few) < len(many) < 300
    for modes, share in ((few, 0.8), (many, 0.99)):
        variance = np.sum(modes**2, axis=0)
        assert share <= variance.mean() < share + 0.03
        assert variance.max() < 1 + 1e-6
    # Errors are alike over the length: 10 mm apart by (1 + sqrt 3) exp(-sqrt 3) = 0.48.
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    covariance = many.T @ many
    assert np.mean(covariance[np.abs(apart - 10.0) < 0.5]) == pytest.approx(0.48, abs=0.03)


def test_columns_are_derivatives_times_standard_deviations_turned_as_the_valve_is_seen():
    model = model_of(CLOSING, continuation=True)
    names = (*model.names, "turn.z")
    registered = RegisteredModel(model, names)
    m = np.array([*AT, 90.0])
    predicted = registered(m)
    assert predicted.converged
    n = len(model.valve.surface.vertices)
    case = SimpleNamespace(
        surface=model.valve.surface, valve=model.valve, error_samples=None, chordae_follow=False
    )
    seen = Observation(("closed",), np.zeros((1, n, 3)), np.array(1.0))

    def columns_of(std=1e-3, case=case, **changes):
        modes = geometry_modes(case, replace(NONE, **changes), model)
        noise = observation_noise(std**2, 3 * n)
        sources = geometry_sources(modes, registered, seen, noise, m, predicted.y)
        return tuple(source.columns for source in sources)

    assert columns_of() == ()
    (fibres,) = columns_of(fibre_degrees=10.0)
    assert (fibres.name, fibres.factor) == ("fibres", 1.0)
    change = RestGeometry(model).change(AT, RestGeometry(model).fibres(np.eye(2)))[1]
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    C = np.deg2rad(10.0) * np.einsum("ij,njq->niq", turn, change).reshape(3 * n, 2)
    np.testing.assert_allclose(
        fibres.columns @ fibres.columns.T, C @ C.T, atol=1e-3 * (C @ C.T).max()
    )
    # A chord by itself longer by a percent does what all do together, taken apart.
    laid_out = SimpleNamespace(**vars(case) | {"chordae_follow": True})
    (lengths,) = columns_of(case=laid_out, rest_lengths=0.01)
    assert columns_of(rest_lengths=0.01) == ()  # stated ones are as long as the case says
    geometry = RestGeometry(model)
    count = len(model.valve.chordae)
    all_longer = geometry.change(AT, geometry.rest_lengths(np.full((1, count), 0.01)))[1]
    longer = np.einsum("ij,njq->niq", turn, all_longer).ravel()
    assert lengths.columns.shape[1] <= count
    np.testing.assert_allclose(
        lengths.columns @ np.linalg.lstsq(lengths.columns, longer, rcond=None)[0],
        longer,
        atol=0.02 * np.abs(longer).max(),
    )
    both = columns_of(shape_mm=0.3, tips_mm=1.0)
    assert [(own.name, own.factor) for own in both] == [
        ("open shape", 2.0),
        ("papillary tips", 1.0),
    ]
    twice = columns_of(shape_mm=0.6)[0].columns
    assert np.linalg.norm(twice) == pytest.approx(2 * np.linalg.norm(both[0].columns), rel=1e-9)
    # In coarse noise few combinations can be told, and all of them are kept that matter.
    coarse = columns_of(std=1.0, shape_mm=0.3)[0].columns
    assert 0 < coarse.shape[1] < both[0].columns.shape[1]
    assert np.linalg.norm(coarse) > 0.9 * np.linalg.norm(both[0].columns)
    # What samples of all frames tell of is not added a second time.
    case.error_samples = ()
    assert columns_of(shape_mm=0.3, tips_mm=1.0) == ()


def test_a_scale_of_a_leaflet_makes_it_longer_and_leaves_the_other_and_the_annulus():
    case = corresponding(48, 12)
    surface = case.surface
    # Columns of the grid through the middle of either leaflet, from annulus to free edge.
    lines = [12 + 48 * np.arange(12), 36 + 48 * np.arange(12)]
    for k, moves in enumerate(leaflet_scales(case)):
        assert not moves[case.annulus].any()
        for x, line in enumerate(lines):
            before, after = (
                np.linalg.norm(np.diff(points[line], axis=0), axis=1).sum()
                for points in (surface.vertices, surface.vertices + 0.04 * moves)
            )
            assert after / before - 1.0 == pytest.approx(0.04 * (x == k), abs=0.006)


def test_scales_of_annulus_and_of_all_lengths_are_what_they_say():
    model = model_of(GENTLE, **SMALL)
    case = SimpleNamespace(
        surface=model.valve.surface, valve=model.valve, error_samples=None, chordae_follow=False
    )
    (annulus,) = geometry_modes(case, replace(NONE, annulus_scale=0.02), model)
    closed = model.contact_valve.motion.annulus[-1]
    np.testing.assert_allclose(annulus.parts["annulus"][0], 0.02 * (closed - closed.mean(axis=0)))
    (whole,) = geometry_modes(case, replace(NONE, frame_scale=0.02), model)
    # A valve that is larger, and as much thicker, has the same shape under the same pressure.
    np.testing.assert_allclose(whole.parts["thickness"], 0.02)


def laid_out(case, tips=0.0, open_move=0.0, closed_move=0.0):
    """The chordae as they are laid out if tips and leaflets are elsewhere."""
    surface, closed = case.surface, case.frame(Role.CLOSED)
    band = LeafletBand.of(
        surface.vertices + open_move,
        surface.triangles,
        surface.region,
        case.annulus,
        case.free_edge,
        surface.region_names.index("anterior"),
    )
    return lay_out_chordae(
        band,
        np.asarray(case.frame(Role.REFERENCE).papillary_tips) + tips,
        closed.vertices + closed_move,
        closed.papillary_tips + tips,
        SEEN_ON_BAND,
    )


@pytest.mark.parametrize("lift", [0.0, 8.0])
def test_rest_lengths_change_as_chordae_that_are_laid_out_on_other_frames(lift):
    plain = corresponding(40, 12)
    closed = plain.frame(Role.CLOSED)
    lifted = replace(closed, vertices=closed.vertices + lift * UP)
    plain = replace(plain, frames=tuple(lifted if f is closed else f for f in plain.frames))
    still = laid_out(plain)
    case = replace(plain, chordae_follow=True, chordae=still)
    for open_, seen in (([0.2, -0.1, 0.3], 0.0), (0.0, [0.1, 0.4, -0.2])):
        h = 1e-3
        ahead, behind = (
            laid_out(plain, open_move=s * np.array(open_), closed_move=s * np.array(seen))
            for s in (h, -h)
        )
        expected = (ahead.rest_length - behind.rest_length) / (2 * h * still.rest_length)
        ends = [np.broadcast_to(move, (1, len(still), 3)) for move in (open_, seen)]
        (found,) = rest_lengths_by_ends(case, *ends)
        np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(found).max() + 1e-6)


@pytest.mark.parametrize("lift", [0.0, 8.0])
def test_rest_lengths_that_follow_the_tips_change_as_those_of_a_case_with_other_tips(lift):
    # Of leaflets that are farther from the tips when closed the closed frame decides.
    plain = corresponding(40, 12)
    plain = replace(
        plain,
        frames=tuple(
            replace(one, vertices=one.vertices + lift * (one.role is Role.CLOSED) * UP)
            for one in plain.frames
        ),
    )
    move = np.random.default_rng(4).standard_normal((1, len(plain.valve.papillary_tips), 3))
    ahead, behind, still = (laid_out(plain, tips=h * move[0]) for h in (0.01, -0.01, 0.0))
    case = replace(plain, chordae_follow=True, chordae=still)
    expected = (ahead.rest_length - behind.rest_length) / (0.02 * still.rest_length)
    (found,) = rest_lengths_by_tips(case, move)
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())
    assert rest_lengths_by_tips(plain, move) is None
    # Of a closed frame without correspondence only the open valve is known.
    apart = [replace(frame, corresponds=False) for frame in plain.frames]
    case = replace(plain, chordae_follow=True, frames=tuple(apart))

    def distance(h):
        tips = case.frame(Role.REFERENCE).papillary_tips + h * move[0]
        chordae = case.chordae
        return np.linalg.norm(chordae.insertion - tips[chordae.tip], axis=1)

    expected = (distance(1e-4) - distance(-1e-4)) / (2e-4 * distance(0.0))
    np.testing.assert_allclose(rest_lengths_by_tips(case, move)[0], expected, atol=1e-7)


def test_a_geometry_that_is_not_known_widens_the_intervals(monkeypatch):
    use(monkeypatch)
    case = made_up_case(0.3, 8.0, np.random.default_rng(1))
    where = []

    def sources(modes, registered, observation, noise, m, predicted, seen):
        # As if the anterior belly were not known by 0.2 mm.
        where.append(m)
        belly = 0.2 * FIELDS["E_f.anterior"].reshape(-1, 1)
        return (error_source(belly, MODE),)

    monkeypatch.setattr("mvest.personalisation.errors.geometry_sources", sources)
    for errors in (None, settings().errors):
        known = personalise(case, settings(errors=errors))
        doubtful = personalise(case, settings(errors=errors, nuisance_geometry=NuisanceGeometry()))
        anterior = doubtful.result.parameters.index("E_f.anterior")
        assert doubtful.result.std[anterior] > 1.3 * known.result.std[anterior]
        shares = {row.source: row.share for row in doubtful.known.shares[::2]}
        assert shares["open shape"] > 0.3
        # Averaging leaves the errors of the geometry as they are.
        averaged = [anterior_if(one, "mean of 4 beats") for one in (known, doubtful)]
        assert averaged[1] > 1.5 * averaged[0]
    # Once for each, about an estimate without them.
    assert len(where) == 2
    np.testing.assert_allclose(where[1], known.result.estimate, rtol=0.05, atol=0.2)


def anterior_if(fit, what):
    """Standard deviation of the anterior modulus' logarithm if something were measured."""
    return next(row.std_if_known for row in fit.known.narrower if row.what == what)


BENT, CURVED = FIELDS["loose"].ravel(), FIELDS["E_f.anterior"].ravel()
"""What the one mode does to the closed valve (mm), and its square: as another modulus would."""


class BentGeometry:
    """Stands for a `RestGeometry`; ``bends`` is by what valves were displaced."""

    bends: ClassVar[list] = []
    curve: ClassVar[float] = 1.0

    def __init__(self, model):
        self.model = model

    def displaced(self, parts):
        (bend,) = parts["shape"]
        self.bends.append(bend)
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


def bent_case(monkeypatch, curve, std):
    """A case whose valve is displaced by 0.6 of the one mode, and its nuisances, all known."""
    use(monkeypatch)
    monkeypatch.setattr(BentGeometry, "curve", curve)

    def sources(modes, registered, observation, noise, m, predicted, seen):
        bend = getattr(registered.model, "bend", 0.0)
        slope = (BENT + 2.0 * curve * bend * CURVED)[:, None]
        return (error_source(slope, MODE),)

    monkeypatch.setattr("mvest.personalisation.errors.geometry_sources", sources)
    monkeypatch.setattr("mvest.personalisation.model.RestGeometry", BentGeometry)
    straight = made_up_case(std, displaced=False)
    closed = straight.frame(Role.CLOSED)
    frame = replace(closed, vertices=bent(closed.vertices.ravel(), 0.6).reshape(-1, 3))
    known = {name: value for name, value in TRUE.items() if not name.startswith("E_f.")}
    known |= dict.fromkeys(REGISTRATION, 0.0)
    return replace(
        straight, frames=tuple(frame if f is closed else f for f in straight.frames)
    ), known


@pytest.mark.parametrize("curve", [1.0, 6.0, 100.0])
def test_renewed_linearisations_end_at_the_mode_of_moduli_and_geometry_together(monkeypatch, curve):
    std = 0.5
    case, known = bent_case(monkeypatch, curve, std)
    free = unknowns(fixed=True, **known)
    seen = case.frame(Role.CLOSED).vertices.ravel()

    def objective(z):
        moduli = np.exp(z[:2])
        x = shape(known | dict(zip(MODULI, moduli, strict=True))).ravel()
        log = [to_filter(Log(), Gaussian.from_variance([m], s**2)) for m, s in MODULUS_PRIORS]
        beforehand = [(z[k] - log[k].mean[0]) / log[k].std[0] for k in range(2)]
        return np.concatenate([(bent(x, z[2]) - seen) / std, beforehand, z[2:]])

    mode = least_squares(objective, [1.5, 1.0, 0.0], xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    steps, nearer = [], estimation._nearer

    def followed(problem, result, place):
        found = nearer(problem, result, place)
        steps.append((place, found))
        return found

    def improbability(place):
        bend = place.errors.displaced_by or np.zeros((1, 1))
        return np.sum(objective([*np.log(place.m), bend[0][0]]) ** 2)

    monkeypatch.setattr(estimation, "_nearer", followed)
    errors = []
    for renewals in (0, 1, 2, 12):
        steps.clear()
        fit = personalise(
            case,
            settings(
                *free,
                nuisance_geometry=NuisanceGeometry(renewals=renewals),
                tolerance=1e-9,
                correspondence=True,
            ),
        )
        assert (len(steps) == 0) == (renewals == 0) == (fit.moved is None)
        for before, after in steps:
            assert improbability(after) < improbability(before)
        errors.append(np.abs(np.log(fit.result.estimate) - mode[:2]).max())
    assert errors[0] > 0.05
    # Steps are estimated roughly, so that where they end is not the mode to the last digit.
    assert max(errors[2:]) < max(errors[1], 1e-3) < errors[0]
    assert errors[3] < 0.1 * fit.result.filtered.transformed.std.max()
    if curve < 100.0:
        assert fit.moved < SETTLED
    else:
        # Twelve steps do not reach the end of such a valley, although the estimate is there.
        assert fit.moved > CHECKS["moved"].limits[0]


def test_a_place_that_is_the_mode_is_no_doubt(monkeypatch):
    case, known = bent_case(monkeypatch, curve=0.0, std=0.5)
    monkeypatch.setattr("mvest.personalisation.estimation.ROUGH", 0.0)
    places, nearer = [], estimation._nearer

    def followed(problem, result, place):
        found = nearer(problem, result, place)
        places.append((problem, result, place, found))
        return found

    monkeypatch.setattr(estimation, "_nearer", followed)
    fit = personalise(
        case,
        settings(
            *unknowns(fixed=True, **known),
            nuisance_geometry=NuisanceGeometry(renewals=6),
            tolerance=1e-9,
        ),
    )
    # Of a straight valley the first step is the last.
    ((problem, before, first, last),) = places
    last = linearised(last, problem)
    assert fit.moved < 1e-4
    # As if no other place were better than the last: then it is as good as promised, the first not.
    monkeypatch.setattr(estimation, "_displaced", lambda *_: last)
    assert nearer(problem, fit.result, last) is last
    monkeypatch.setattr(estimation, "_displaced", lambda *_: first)
    assert nearer(problem, before, first) == "no step to it makes what was seen more probable"
    assert fit.unaccounted == ()


def test_steps_that_are_estimated_roughly_end_where_others_do(monkeypatch):
    case, known = bent_case(monkeypatch, curve=1.0, std=0.5)
    others = [u for u in unknowns(fixed=True, **known) if u.name != "pressure_scale"]
    given = settings(
        replace(unknowns()[2], std=0.3),
        *others,
        nuisance_geometry=NuisanceGeometry(renewals=6),
        tolerance=1e-9,
    )
    rough = personalise(case, given).result.filtered.transformed
    monkeypatch.setattr("mvest.personalisation.estimation.ROUGH", 0.0)
    exact = personalise(case, given).result.filtered.transformed
    np.testing.assert_allclose(rough.mean, exact.mean, atol=0.02 * exact.std.min())
    np.testing.assert_allclose(rough.std, exact.std, rtol=0.02)


def test_all_closed_frames_are_displaced_as_their_derivatives_say():
    model = model_of(GENTLE, **SMALL)
    motion = model.contact_valve.motion
    state = HeldState(0.3, motion.annulus[-1], motion.papillary_tips[-1])
    frames = FramesModel(model, "closed", {"early": state}, 1.0)
    closure = CaseClosure.of(model, frames, model.names, AT)
    rng = np.random.default_rng(2)
    parts = {
        "annulus": np.broadcast_to(rng.normal(0.0, 0.02, 3), motion.annulus[-1].shape),
        "tips": rng.normal(0.0, 0.02, motion.papillary_tips[-1].shape),
    }
    displaced, still = closure.displaced(parts, AT).shared(AT), closure.shared(AT)
    geometry = RestGeometry(model)
    variation = geometry.variation({name: move[None] for name, move in parts.items()})
    change = geometry.change(AT, variation, [state])[..., 0]
    moved = (displaced.y - still.y).reshape(change.shape)
    assert np.abs(change[1]).max() > 0.01
    np.testing.assert_allclose(moved, change, atol=0.02 * np.abs(change).max())


def test_columns_of_a_displaced_valve_are_by_the_same_errors_as_it_was_displaced_by():
    model = model_of(GENTLE, **SMALL)
    surface = model.valve.surface
    n, count, regions = len(surface.vertices), len(model.valve.chordae), len(surface.region_names)
    smooth = smooth_modes(surface.vertices, 10.0, 0.9)[2]
    modes = [
        GeometryModes("open shape", {"shape": 0.3 * smooth[None, :, None] * UP}),
        GeometryModes("rest lengths", {"rest_lengths": np.full((1, count), 0.05)}),
        GeometryModes("thickness", {"thickness": np.full((1, n), 0.2)}),
        GeometryModes("fibres", {"fibres": np.full((1, regions), np.deg2rad(10.0))}),
    ]
    far, step = np.array([2.0, -1.0, 1.0, 1.0]), 0.02
    seen = Observation(("closed",), np.zeros((1, n, 3)), np.array(1.0))

    def closed(sizes):
        displaced = RestGeometry(model).displaced(displacement(modes, [*sizes[:, None]]))
        registered = RegisteredModel(displaced, model.names)
        return registered, registered(AT)

    registered, predicted = closed(far)
    noise = observation_noise(1e-6, 3 * n)
    sources = geometry_sources(modes, registered, seen, noise, AT, predicted.y, model)
    for row, way in zip((source.rows for source in sources), step * np.eye(4), strict=True):
        above, below = (closed(far + sign * way)[1].y.reshape(2, -1)[1] for sign in (1, -1))
        central = (above - below) / (2.0 * step)
        np.testing.assert_allclose(row[:, 0], central, atol=0.02 * np.abs(central).max())


def test_frames_that_are_not_fitted_are_held_as_the_closed_one_is(monkeypatch):
    case, known = bent_case(monkeypatch, curve=1.0, std=0.5)
    closed = case.frame(Role.CLOSED)
    later = replace(closed, name="later", time=1.0, role=Role.HELD_OUT)
    case = replace(case, frames=(*case.frames, later))
    parts = {"annulus": np.full(closed.annulus.shape, 0.3), "tips": np.full((1, 3), -0.4)}
    problem = CaseProblem.of(case, settings(*unknowns(fixed=True, **known)))
    stated = problem.generic()
    off = replace(stated, closure=replace(stated.closure, displacement=parts))
    for place, by, tips in ((stated, 0.0, 0.0), (off, 0.3, -0.4)):
        states = problem.stated.model.states
        states.clear()
        predicted_frames(problem, place, place.m, place.prediction.y)
        held = states[-1]
        np.testing.assert_allclose(held.annulus, closed.annulus + by)
        np.testing.assert_allclose(held.papillary_tips, closed.papillary_tips + tips)
        assert held.pressure_mmHg == closed.pressure_mmHg


@pytest.mark.parametrize("why", ["no equilibrium", "thickness is -0.1 mm, expected > 0"])
def test_a_displaced_valve_that_does_not_close_leaves_the_estimate_and_a_doubt(monkeypatch, why):
    use(monkeypatch)

    class Torn(BentGeometry):
        def displaced(self, parts):
            if why != "no equilibrium":
                raise GeometryError(why)
            return replace(super().displaced(parts), fails_above=0.0)

    def sources(modes, registered, observation, noise, m, predicted, seen):
        return (error_source(BENT[:, None], MODE),)

    monkeypatch.setattr("mvest.personalisation.errors.geometry_sources", sources)
    monkeypatch.setattr("mvest.personalisation.model.RestGeometry", Torn)
    case = made_up_case(0.3, 8.0, np.random.default_rng(1))
    plain, torn = (
        personalise(case, settings(nuisance_geometry=NuisanceGeometry(renewals=renewals)))
        for renewals in (0, 2)
    )
    np.testing.assert_array_equal(torn.result.estimate, plain.result.estimate)
    assert torn.moved is None
    assert torn.unaccounted == (f"about the geometry that is expected: {why}",)
    unaccounted = [words["what"] for _, words in diagnostics_of(torn)["unaccounted"]]
    assert any("about the geometry" in doubt for doubt in unaccounted)


def test_a_valve_that_closes_only_where_it_was_tried_leaves_the_estimate(
    monkeypatch,
):
    case, known = bent_case(monkeypatch, curve=1.0, std=0.5)

    class OnceClosed(BentClosure):
        def __call__(self, m):
            return Prediction.failed("stuck") if len(self.calls) > 1 else super().__call__(m)

    def displaced(self, parts):
        return OnceClosed(self.model.names, self.model.fixed, bend=parts["shape"][0])

    monkeypatch.setattr(BentGeometry, "displaced", displaced)
    plain, stuck = (
        personalise(
            case,
            settings(
                *unknowns(fixed=True, **known),
                nuisance_geometry=NuisanceGeometry(renewals=renewals),
            ),
        )
        for renewals in (0, 2)
    )
    np.testing.assert_array_equal(stuck.result.estimate, plain.result.estimate)
    (doubt,) = stuck.unaccounted
    assert doubt.startswith("about the geometry that is expected: ")
    assert "stuck" in doubt


def test_what_was_not_considered_before_stays_a_doubt(monkeypatch):
    case, known = bent_case(monkeypatch, curve=1.0, std=0.5)
    monkeypatch.setattr("mvest.personalisation.errors.law_and_mesh_sources", lambda *_: "no law")
    fit = personalise(
        case,
        settings(
            *unknowns(fixed=True, **known),
            nuisance_geometry=NuisanceGeometry(renewals=2),
            nuisance_law={"anterior": ExponentialTissue(0.06, 4.325, 1446.5)},
        ),
    )
    assert fit.unaccounted == ("no law",)
    # The geometry is renewed all the same.
    assert fit.moved < SETTLED


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("shape_mm", -0.1),
        ("shape_length_mm", 0.0),
        ("factor", 0.5),
        ("share", 1.0),
        ("renewals", -1),
    ],
)
def test_what_is_no_standard_deviation_is_refused(setting, value):
    with pytest.raises(InputError, match=f"considered geometry {setting} = "):
        NuisanceGeometry(**{setting: value})
