"""From a case to its moduli, with a formula for a closure."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import ErrorSamples, Role, Uncertainty
from mvest.errors import GeometryError, InputError
from mvest.estimation import Prediction, observation_noise
from mvest.observation.errors import SpatialCorrelation
from mvest.observation.learned import ErrorBeliefs
from mvest.observation.surfaces import UNKNOWN
from mvest.personalisation import (
    CaseMesh,
    PaperSettings,
    PersonaliseSettings,
    Prior,
    build_model,
    personalise,
)
from mvest.personalisation.estimation import CaseProblem
from mvest.personalisation.known import IMAGES
from mvest.personalisation.model import held_state
from mvest.personalisation.sources import FrameSamples
from tests.made_up_closure import (
    CLOSED_ANNULUS,
    MECHANICS,
    PRIORS,
    TRUE,
    MadeUpClosure,
    made_up_case,
    settings,
    unknowns,
    use,
)

MODULI = ("E_f.anterior", "E_f.posterior")
PAPER = PaperSettings(P0=1.0, Q=0.01, R=1e-4, max_iterations=30)


@pytest.fixture(autouse=True)
def formula(monkeypatch):
    """Closures are the formula; the models that were built."""
    return use(monkeypatch)


def true_of(found):
    return np.array([TRUE[name] for name in found.result.parameters])


def right_nuisances():
    """The moduli unknown, other parameters of the closure fixed at their true values."""
    given = unknowns(fixed=True)
    return (*given[:2], *(replace(u, mean=TRUE[u.name]) for u in given[2:5]))


def test_a_twin_without_noise_gives_back_its_parameters():
    found = personalise(made_up_case(std_mm=1e-4), settings(tolerance=1e-6))
    assert found.result.converged
    assert found.result.parameters == tuple(PRIORS)
    np.testing.assert_allclose(found.result.estimate, true_of(found), rtol=1e-4, atol=1e-4)
    assert [(f.frame.name, f.seen) for f in found.frames] == [("closed", True), ("late", False)]
    for distances in (f.distances for f in found.frames):
        # The held-out frame fits too: its loads and its displacement are those of the case.
        assert distances["personalised"].max() < 1e-3
        assert 0.1 < distances["registered"].mean() < distances["generic"].mean()
    late = found.frames[1].distances["generic"].mean()
    expected = f"late: {late:.2f} mm generic, 0.00 mm personalised (held out)"
    assert str(found).splitlines()[-1] == expected


def test_moduli_alone_are_the_estimate_without_nuisances(formula):
    case = made_up_case(0.3, 8.0, np.random.default_rng(1))
    whole = personalise(case, settings(moduli_only=True))
    # The generic valve, the longest closure, is closed once for both estimates.
    start = [6.23, 2.09, 1.0, 1.0, 1.0]
    assert np.all(np.isclose(formula[0].calls, start, rtol=1e-12), axis=1).sum() == 1
    fixed = personalise(case, settings(*unknowns(fixed=True)))
    alone = whole.alternatives["moduli_only"]
    assert fixed.result.parameters == alone.parameters == MODULI
    np.testing.assert_array_equal(fixed.result.estimate, alone.estimate)
    np.testing.assert_array_equal(fixed.result.std, alone.std)


def covariance(R, size):
    noise = observation_noise(R, size)
    white = noise.whiten(np.eye(size))
    return np.linalg.inv(white.T @ white)


@pytest.mark.parametrize("length", [0.0, 8.0])
def test_the_noise_is_as_the_case_states_it(length):
    case = made_up_case(0.3, length)
    n = len(case.surface.vertices)
    std = np.random.default_rng(3).uniform(0.2, 0.5, n)
    other = replace(case, uncertainty=Uncertainty(std, length))
    one, own = (CaseProblem.of(c, settings()).fitted.observation() for c in (case, other))
    np.testing.assert_array_equal(one.positions[0], case.frame(Role.CLOSED).vertices)
    R = [covariance(o.R, 3 * n) for o in (one, own)]
    assert R[0][0, 0] == pytest.approx(0.09, rel=1e-6)
    assert R[0][0, 1] == pytest.approx(0.0, abs=1e-9)
    assert (0.5 * 0.09 < R[0][0, 3] < 0.09) == (length > 0)
    scale = np.repeat(std / 0.3, 3)
    np.testing.assert_allclose(R[1], scale[:, None] * R[0] * scale, atol=1e-7)


def test_the_registered_valve_is_the_rigid_motion_of_least_squares():
    case = made_up_case(0.3, noise=np.random.default_rng(2))
    closed, late = (one.positions for one in personalise(case, settings()).frames)
    seen = case.frame(Role.CLOSED).vertices
    generic, registered = closed["generic"], closed["registered"]
    gaps = [np.linalg.norm(x[:, None] - x[None], axis=2) for x in (generic, registered)]
    np.testing.assert_allclose(gaps[0], gaps[1], atol=1e-9)
    # Least squares: no mean error and no mean moment is left.
    error, arm = seen - registered, registered - registered.mean(axis=0)
    np.testing.assert_allclose(error.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(np.cross(arm, error).mean(axis=0), 0, atol=1e-9)
    # The held-out frame has the displacement of the closed one.
    arms = [x - x.mean(axis=0) for x in (generic, registered)]
    turn = np.linalg.lstsq(arms[0], arms[1], rcond=None)[0]
    expected = (late["generic"] - generic.mean(axis=0)) @ turn + registered.mean(axis=0)
    np.testing.assert_allclose(late["registered"], expected, atol=1e-8)


def test_a_frame_without_an_equilibrium_is_left_out(monkeypatch):
    monkeypatch.setattr(MadeUpClosure, "held", lambda *arguments: [None])
    found = personalise(made_up_case(0.3), settings())
    assert [one.frame.name for one in found.frames] == ["closed"]


def test_the_paper_s_filter_estimates_moduli_with_independent_errors():
    case = made_up_case(0.3, 8.0, displaced=False)
    found = personalise(case, settings(*right_nuisances(), paper=PAPER)).alternatives["paper"]
    assert found.parameters == MODULI
    assert found.observation.correlation is None
    assert found.observation.variance == pytest.approx(1e-4)
    np.testing.assert_allclose(found.estimate, [TRUE[name] for name in MODULI], rtol=1e-3)


def test_surfaces_are_compared_without_correspondence():
    case = made_up_case(0.02, 8.0, corresponds=False, displaced=False)
    given = [*right_nuisances(), Prior("shift.z", 0.0, 1.0)]
    paper = PaperSettings(P0=1.0, R=1e-3, max_iterations=2)
    found = personalise(case, settings(*given, paper=paper, tolerance=1e-5))
    assert found.result.converged
    # Errors of 0.02 mm that are correlated over 8 mm leave 1.1 % (one standard deviation) of the
    # anterior modulus; smoothing this coarse surface adds half a per cent.
    np.testing.assert_allclose(found.result.estimate[:2], true_of(found)[:2], rtol=0.03)
    assert abs(found.result.estimate[2]) < 0.02
    # Three per cent of the posterior modulus move its belly, of 12 mm over the modulus, by 0.14 mm.
    for one in found.frames:
        assert len(one.distances["personalised"]) == 288
        assert one.distances["personalised"].max() < 0.14 < one.distances["generic"].max()
    assert found.alternatives["paper"].observation.correlation_length_mm == 0.0
    positions = found.frames[0].positions
    np.testing.assert_array_equal(positions["registered"], positions["generic"])


def test_points_between_leaflets_belong_to_either():
    case = made_up_case(2.0, corresponds=False)
    (seen,) = CaseProblem.of(case, settings()).fitted.observation().seen
    column = np.arange(len(seen.region)) % 32
    np.testing.assert_array_equal(seen.region == UNKNOWN, (column == 0) | (column == 16))
    assert set(seen.region[(column > 0) & (column < 16)]) == {0}
    assert set(seen.region[column > 16]) == {1}
    # The free edge has no leaflet within three standard deviations of that line.
    line = case.frame(Role.CLOSED).vertices[seen.region == UNKNOWN]
    near = np.linalg.norm(seen.free_edge[:, None] - line, axis=2).min(axis=1) < 6.0
    assert 2 < near.sum() < 16
    edge = np.where(near, UNKNOWN, (np.arange(32) > 16).astype(int))
    np.testing.assert_array_equal(seen.free_edge_region, edge)


def test_a_valve_that_does_not_close_is_a_result_with_its_reason(monkeypatch):
    use(monkeypatch, fails_above=4.0)
    wanted = settings(moduli_only=True, paper=PaperSettings(), confirm=True)
    found = personalise(made_up_case(0.3), wanted)
    assert "no equilibrium" in found.result.detail
    assert not found.frames
    assert not found.details
    assert found.confirmed_mm is None
    for one in (found.result, *found.alternatives.values()):
        assert not one.converged
    assert set(found.alternatives) == {"moduli_only", "paper"}


def test_the_fitted_valve_is_closed_anew(monkeypatch):
    assert personalise(made_up_case(0.3), settings(confirm=True)).confirmed_mm == 0.0
    first = MadeUpClosure.__call__

    def other(self, m):
        found = first(self, m)
        if self.continuation:
            return found
        y = found.y.copy()
        y[-1] += 0.25
        return Prediction(y, found.jacobian)

    monkeypatch.setattr(MadeUpClosure, "__call__", other)
    again = personalise(made_up_case(0.3), settings(confirm=True))
    assert again.confirmed_mm == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ((Prior("E_f.anterior", 6.0, 3.0, fixed=True),), "at least one modulus"),
        ((Prior("E_f.anterior", 6.0, 3.0),) * 2, "not all different"),
        ((*unknowns()[:2], Prior("turn.z", 1.0, 0.5, fixed=True)), "turn.z is fixed at 1.0"),
    ],
)
def test_inadmissible_unknowns_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        PersonaliseSettings(tuple(given), MECHANICS)


def test_inadmissible_priors_are_refused():
    for prior in (("E_f.anterior", 0.0, 1.0), ("shift.x", 0.0, 0.0), ("shift.w", 1.0, 0.5)):
        with pytest.raises(InputError, match=prior[0]):
            Prior(*prior)


def test_unknowns_must_be_those_of_the_case():
    with pytest.raises(InputError, match="has the leaflets anterior, posterior"):
        build_model(made_up_case(), settings(*unknowns()[:1]))
    with pytest.raises(InputError, match="tip9"):
        build_model(made_up_case(), settings(*unknowns()[:2], Prior("chord_stiffness.tip9", 1, 1)))


SMALL = CaseMesh(
    columns=16, rows=2, guide_columns=10, guide_rows=2, contact_columns=60, contact_rows=16
)


def test_the_model_has_the_pressure_and_the_boundary_of_the_case():
    case = made_up_case()
    given = (*unknowns()[:2], Prior("pressure_scale", 1.3, 0.1, fixed=True), *unknowns()[4:])
    model = build_model(case, replace(settings(*given), mesh=SMALL))
    assert model.settings.protocol.pressure_mmHg == 100.0
    for one in (model, model.guide):
        assert one.names == ("E_f.anterior", "E_f.posterior", "chord_rest_length")
        assert one.fixed == {"pressure_scale": 1.3}
    assert len(model.guide.mesh.nodes) < len(model.mesh.nodes)
    np.testing.assert_array_equal(model.valve.motion.annulus[-1], CLOSED_ANNULUS)
    # The annulus of further frames is interpolated at the samples of contact.
    contact = model.contact_valve
    assert len(contact.annulus) == 60
    closed, late = (held_state(model, f) for f in (case.frame(Role.CLOSED), case.held_out[0]))
    np.testing.assert_allclose(closed.annulus, contact.motion.annulus[-1], atol=1e-9)
    np.testing.assert_allclose(late.annulus - closed.annulus, [[0.1, -0.2, 0.5]] * 60, atol=1e-9)
    assert late.pressure_mmHg == 70.0


# --- error samples ------------------------------------------------------------------------------


def with_samples(case, count=12, std=0.4, seed=3):
    """The case with samples of smooth errors, the same in both frames and in the tips."""
    rng = np.random.default_rng(seed)
    n, f = len(case.surface.vertices), len(case.frames)
    L = SpatialCorrelation(case.surface.vertices, 12.0).factor
    each = std * np.einsum("nk,skd->snd", L, rng.standard_normal((count, n, 3)))
    tips = std * rng.standard_normal((count, 1, 2, 3))
    samples = ErrorSamples(np.repeat(each[:, None], f, axis=1), np.repeat(tips, f, axis=1))
    return replace(case, error_samples=samples)


@pytest.fixture
def geometry(monkeypatch):
    """The formula moves twice as far as the open shape."""

    def sample(case, valve):
        vertices = case.error_samples.vertices
        return FrameSamples(2.0 * vertices[:, 0], vertices[:, 1], vertices[:, 0])

    monkeypatch.setattr("mvest.personalisation.errors.sample_frames", sample)


def share_of(fit, source):
    """Share of the variance of each modulus that a source accounts for."""
    return np.array([row["share"] for row in fit.details["shares"] if row["source"] == source])


def test_error_samples_widen_the_intervals(geometry):
    case = made_up_case(0.3, 8.0, np.random.default_rng(1), displaced=False)
    wanted = settings(*right_nuisances())
    plain = personalise(case, wanted)
    wider = personalise(with_samples(case, std=1.2), replace(wanted, moduli_only=True))
    assert not share_of(plain, IMAGES).size
    assert (plain.error_samples, wider.error_samples) == (0, 12)
    assert wider.result.converged
    assert np.all(wider.result.std > 1.5 * plain.result.std)
    images = share_of(wider, IMAGES)
    assert np.all((images > 0.5) & (images <= 1.0))
    # The same unknowns: moduli alone have the errors of the frames too.
    alone = wider.alternatives["moduli_only"]
    np.testing.assert_allclose(alone.estimate, wider.result.estimate, rtol=1e-6)
    np.testing.assert_allclose(alone.std, wider.result.std, rtol=1e-6)


def test_a_sample_is_the_change_of_the_prediction_minus_that_of_the_frame(geometry):
    case = with_samples(made_up_case(0.3, 8.0, displaced=False))
    errors = CaseProblem.of(case, settings(*right_nuisances())).generic().sampled().errors
    each = case.error_samples.vertices[:, 1]
    np.testing.assert_allclose(errors.samples.samples.T, each.reshape(len(each), -1), atol=1e-9)


def test_error_samples_without_an_effect_are_an_error(monkeypatch):
    monkeypatch.setattr("mvest.personalisation.errors.sample_frames", lambda *_: "no equilibrium")
    case = with_samples(made_up_case(0.3, 8.0, displaced=False))
    with pytest.raises(GeometryError, match="error samples: no equilibrium"):
        personalise(case, settings(*right_nuisances()))


# --- errors that are learned --------------------------------------------------------------------


def rougher(case, std, seed=9):
    """The case with unstated white noise on its closed frame."""
    rng = np.random.default_rng(seed)
    frames = tuple(
        replace(f, vertices=f.vertices + std * rng.standard_normal(f.vertices.shape))
        if f.role is Role.CLOSED
        else f
        for f in case.frames
    )
    return replace(case, frames=frames)


def test_errors_rougher_than_stated_are_learned():
    case = made_up_case(0.3, 8.0, np.random.default_rng(5))
    found = personalise(rougher(case, 0.2), settings(errors=ErrorBeliefs()))
    learned = found.result.filtered
    low, high = learned.innovation.nis_band
    assert low < learned.innovation.nis < high
    # The case states that its 0.3 mm are correlated over 8 mm; they are independent, plus 0.2 mm.
    rough = next(q for q in learned.learned.quantities if q.name == "rough part")
    low, high = rough.learned.interval()
    assert low < np.hypot(0.3, 0.2) < high < 1.3 * low
    assert rough.stretch > 1.0
    z = (learned.mean - true_of(found)) / learned.std
    assert np.sqrt(np.mean(z**2)) < 1.6
    moduli = [found.result.parameters.index(name) for name in MODULI]
    now = [row["std_now"] for row in found.details["narrower"][:2]]
    np.testing.assert_allclose(now, learned.transformed.std[moduli], rtol=1e-6)


def test_learned_errors_and_error_samples_widen_together(geometry):
    case = rougher(made_up_case(0.3, 0.0, np.random.default_rng(1), displaced=False), 0.3)
    wanted = settings(*right_nuisances(), errors=ErrorBeliefs())
    plain = personalise(case, wanted)
    wider = personalise(with_samples(case, std=1.2), wanted)
    assert wider.result.filtered.learned.quantities[-1].name == "error samples"
    assert np.all(wider.result.std > 1.5 * plain.result.std)
    now = [row["std_now"] for row in wider.details["narrower"][:2]]
    np.testing.assert_allclose(now, wider.result.filtered.transformed.std, rtol=1e-6)
    rough = [r.result.filtered.learned.quantities[2].learned.median for r in (plain, wider)]
    np.testing.assert_allclose(rough, np.hypot(0.3, 0.3), rtol=0.1)
