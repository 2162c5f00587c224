"""From a case to its moduli: with a formula for a closure, and once with the smallest valve."""

from dataclasses import replace

import numpy as np
import pytest

from mvest.cases.case import ErrorSamples, Role, Uncertainty
from mvest.errors import GeometryError, InputError
from mvest.estimation import Prediction, observation_noise
from mvest.mechanics.settings import ClosureProtocol, ExponentialTissue
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
from mvest.personalisation.estimation import CaseProblem, sampled
from mvest.personalisation.fitted_frames import _thinned
from mvest.personalisation.known import IMAGES
from mvest.personalisation.model import held_state
from mvest.personalisation.samples import FrameSamples
from mvest.problem.registration import REGISTRATION, RegisteredModel
from mvest.valve.anatomy.valve import LeafletSurface
from tests.made_up_closure import (
    CLOSED_ANNULUS,
    FIELDS,
    HELD_ANNULUS,
    MECHANICS,
    PRIORS,
    TRUE,
    MadeUpClosure,
    error_source,
    made_up_case,
    settings,
    unknowns,
    use,
)

MODULI = ("E_f.anterior", "E_f.posterior")
NUISANCES = tuple(name for name in PRIORS if name not in MODULI)


def true_of(found):
    return np.array([TRUE[name] for name in found.result.parameters])


def right_nuisances():
    """The moduli unknown, what acts on the closure fixed where it truly is."""
    given = unknowns(fixed=True)
    return (*given[:2], *(replace(u, mean=TRUE[u.name]) for u in given[2:5]))


def std_of(found, name):
    return float(found.result.std[found.result.parameters.index(name)])


def test_a_twin_without_noise_gives_back_the_moduli_and_what_was_hidden(monkeypatch):
    use(monkeypatch)
    found = personalise(made_up_case(std_mm=1e-4), settings(tolerance=1e-6))
    assert found.result.converged
    assert found.result.parameters == tuple(PRIORS)
    np.testing.assert_allclose(found.result.estimate, true_of(found), rtol=1e-4, atol=1e-4)
    assert [(d.frame, d.seen) for d in found.distances] == [("closed", True), ("late", False)]
    for distance in found.distances:
        # The held-out frame is met as well: its loads and the displacement are those of the case.
        assert distance.personalised.max() < 1e-3
        assert distance.generic.mean() > 1.0
        assert distance.registered.mean() < distance.generic.mean()
    lines = str(found).splitlines()
    assert lines[0] == f"case {found.case.name}"
    assert lines[1].startswith("E_f.anterior")
    assert lines[1].endswith("MPa")
    closed, late = (d.generic.mean() for d in found.distances)
    assert lines[-2:] == [
        f"closed: {closed:.2f} mm generic, 0.00 mm personalised",
        f"late: {late:.2f} mm generic, 0.00 mm personalised (held out)",
    ]


def test_noise_is_covered_by_the_intervals(monkeypatch):
    # 12 cases: errors over standard deviations have a mean square of one, 0.45 to 1.8 is 99.9 %
    # of chi-square with 24 degrees of freedom over 24.
    use(monkeypatch)
    rng = np.random.default_rng(7)
    squares = []
    for _ in range(12):
        case = made_up_case(std_mm=0.3, noise=rng, displaced=False)
        found = personalise(case, settings(*right_nuisances()))
        error = np.log(found.result.estimate / true_of(found))
        squares.append((error / found.result.filtered.transformed.std) ** 2)
    assert 0.38 < np.mean(squares) < 1.95


def test_without_nuisances_it_is_the_estimation_of_the_moduli_alone(monkeypatch):
    use(monkeypatch)
    case = made_up_case(0.3, 8.0, np.random.default_rng(1))
    whole = personalise(case, settings(moduli_only=True))
    fixed = personalise(case, settings(*unknowns(fixed=True)))
    assert fixed.result.parameters == MODULI
    assert whole.moduli_only.parameters == MODULI
    np.testing.assert_array_equal(fixed.result.estimate, whole.moduli_only.estimate)
    np.testing.assert_array_equal(fixed.result.std, whole.moduli_only.std)


def test_the_generic_valve_is_closed_once(monkeypatch):
    # The estimation begins where the generic valve was closed, and that is the longest closure.
    built = use(monkeypatch)
    personalise(made_up_case(0.3), settings(moduli_only=True))
    calls = np.array(built[0].calls)
    start = [6.23, 2.09, 1.0, 1.0, 1.0]
    assert np.all(np.isclose(calls, start, rtol=1e-12), axis=1).sum() == 1


def test_unknowns_may_come_in_any_order(monkeypatch):
    use(monkeypatch)
    case = made_up_case(0.3)
    one = personalise(case, settings())
    order = [*unknowns()[::-1]]
    other = personalise(case, settings(*order))
    assert set(other.result.parameters[-6:]) == set(REGISTRATION)
    at = [other.result.parameters.index(name) for name in one.result.parameters]
    np.testing.assert_allclose(other.result.estimate[at], one.result.estimate, rtol=1e-6, atol=1e-9)


def test_a_closed_frame_is_observed_as_the_case_says(monkeypatch):
    use(monkeypatch)
    case = made_up_case(0.3, 8.0)
    estimation = CaseProblem.of(case, settings())
    R = estimation.generic().errors.observation().R
    # Whitening white noise of the told covariance: R = 0.09 mm² and 8 mm along the leaflets.
    points = case.surface.vertices
    gap = np.linalg.norm(points[0] - points[1])
    whole = np.linalg.inv(R.whiten(np.eye(R.size)).T @ R.whiten(np.eye(R.size)))
    assert whole[0, 0] == pytest.approx(0.09, rel=1e-6)
    assert whole[0, 1] == pytest.approx(0.0, abs=1e-9)
    assert 0.5 * 0.09 < whole[0, 3] < 0.09
    assert gap < 8.0
    np.testing.assert_array_equal(
        estimation.generic().errors.observation().positions[0], case.frame(Role.CLOSED).vertices
    )


def covariance(R):
    white = R.whiten(np.eye(R.size))
    return np.linalg.inv(white.T @ white)


@pytest.mark.parametrize("correspondence", [True, False])
@pytest.mark.parametrize("length", [0.0, 8.0])
def test_a_deviation_of_each_vertex_is_that_of_its_coordinates(monkeypatch, correspondence, length):
    use(monkeypatch)
    case = made_up_case(0.3, length)
    n = len(case.surface.vertices)
    std = np.random.default_rng(3).uniform(0.2, 0.5, n)
    told = replace(case, uncertainty=Uncertainty(std, length))
    wanted = settings(correspondence=correspondence)
    one = CaseProblem.of(case, wanted).generic().errors.observation()
    own = CaseProblem.of(told, wanted).generic().errors.observation()
    if not correspondence:
        # Points that noise may put beyond the border are left out where it is large.
        assert all(len(o.seen[0].points) > 100 for o in (one, own))
        (seen,) = own.seen
        at = [
            int(np.argmin(np.linalg.norm(case.frame(Role.CLOSED).vertices - x, axis=1)))
            for x in seen.points
        ]
        expected = std[at]
        R = observation_noise(own.R, len(own.y))
        np.testing.assert_allclose(np.sqrt(np.diag(covariance(R)))[: len(at)], expected, rtol=1e-6)
        return
    R = [covariance(observation_noise(o.R, 3 * n)) for o in (one, own)]
    scale = np.repeat(std / 0.3, 3)
    np.testing.assert_allclose(R[1], scale[:, None] * R[0] * scale, atol=1e-7)
    # The same for all is the one number, whatever it is called.
    alike = replace(case, uncertainty=Uncertainty(np.full(n, 0.3), length))
    same = observation_noise(CaseProblem.of(alike, wanted).generic().errors.observation().R, 3 * n)
    np.testing.assert_allclose(covariance(same), R[0], rtol=1e-9, atol=1e-12)


def test_the_registered_valve_is_the_rigid_motion_of_least_squares(monkeypatch):
    use(monkeypatch)
    case = made_up_case(0.3, noise=np.random.default_rng(2))
    found = personalise(case, settings())
    seen = case.frame(Role.CLOSED).vertices
    generic, registered = found.generic["closed"], found.registered["closed"]
    # Rigid: distances among vertices are kept, and so is the side.
    gaps = [np.linalg.norm(x[:, None] - x[None], axis=2) for x in (generic, registered)]
    np.testing.assert_allclose(gaps[0], gaps[1], atol=1e-9)
    edges = [np.diff(x[[0, 1, 40, 90]], axis=0) for x in (generic, registered)]
    assert np.linalg.det(edges[0]) == pytest.approx(np.linalg.det(edges[1]))
    # Least squares: no mean error and no mean moment is left.
    error, arm = seen - registered, registered - registered.mean(axis=0)
    np.testing.assert_allclose(error.mean(axis=0), 0, atol=1e-9)
    np.testing.assert_allclose(np.cross(arm, error).mean(axis=0), 0, atol=1e-9)
    # The held-out frame is displaced as the closed one was, not fitted anew.
    arms = [x - x.mean(axis=0) for x in (generic, registered)]
    turn = np.linalg.lstsq(arms[0], arms[1], rcond=None)[0]
    expected = (found.generic["late"] - generic.mean(axis=0)) @ turn + registered.mean(axis=0)
    np.testing.assert_allclose(found.registered["late"], expected, atol=1e-8)


def test_held_out_frames_have_the_loads_of_the_case(monkeypatch):
    built = use(monkeypatch)
    case = made_up_case(0.3)
    late = case.held_out[0]
    later = replace(late, name="later", time=0.5)
    personalise(replace(case, frames=(*case.frames, later)), settings())
    states = built[0].states
    assert len(states) == 4
    # All of one valve and then all of the other: changing between them is to close anew.
    assert [at[0] for at in built[0].held_at] == pytest.approx([6.23, 6.23, 5.1, 5.1], rel=0.1)
    for state in states:
        assert state.pressure_mmHg == 70.0
        np.testing.assert_array_equal(state.annulus, HELD_ANNULUS)
        np.testing.assert_array_equal(state.papillary_tips, case.frame(Role.CLOSED).papillary_tips)


def test_a_frame_without_an_equilibrium_is_left_out(monkeypatch):
    built = use(monkeypatch)
    monkeypatch.setattr("tests.made_up_closure.MadeUpClosure.held", lambda *arguments: [None])
    found = personalise(made_up_case(0.3), settings())
    assert built
    assert [d.frame for d in found.distances] == ["closed"]
    assert "late" not in found.fitted


def test_the_paper_s_filter_sees_the_moduli_and_independent_errors(monkeypatch):
    use(monkeypatch)
    paper = PaperSettings(P0=1.0, Q=0.01, R=1e-4, max_iterations=30)
    case = made_up_case(0.3, 8.0, displaced=False)
    found = personalise(case, settings(*right_nuisances(), paper=paper))
    assert found.paper.parameters == MODULI
    assert found.paper.observation.correlation is None
    assert found.paper.observation.variance == pytest.approx(1e-4)
    # Nothing but the moduli is wrong here, so that it finds them.
    np.testing.assert_allclose(found.paper.estimate, [TRUE[name] for name in MODULI], rtol=1e-3)


@pytest.mark.parametrize("length", [0.0, 8.0])
@pytest.mark.parametrize("corresponds", [True, False])
def test_surfaces_are_compared_where_vertices_are_not_known_again(monkeypatch, length, corresponds):
    use(monkeypatch)
    case = made_up_case(0.02, length, corresponds=corresponds, displaced=False)
    given = [*right_nuisances(), Prior("shift.z", 0.0, 1.0)]
    found = personalise(
        case,
        settings(
            *given,
            correspondence=not corresponds,
            moduli_only=True,
            paper=PaperSettings(P0=1.0, R=1e-3, max_iterations=30),
            tolerance=1e-5,
        ),
    )
    assert found.result.converged
    # Errors of 0.02 mm that are correlated over 8 mm leave 1.1 % (one standard deviation) of the
    # anterior modulus; smoothing this coarse surface adds half a per cent.
    np.testing.assert_allclose(found.result.estimate[:2], true_of(found)[:2], rtol=0.03)
    # Correlated errors move the whole valve by up to their own size.
    assert abs(found.result.estimate[2]) < 0.02
    assert [len(d.personalised) for d in found.distances] == [288, 288]
    assert all(d.personalised.max() < 0.05 < d.generic.max() for d in found.distances)
    assert {row.parameter for row in found.known.narrower} == set(MODULI)
    assert found.moduli_only.estimate is not None
    assert found.paper.observation.correlation_length_mm == 0.0
    np.testing.assert_array_equal(found.registered["closed"], found.generic["closed"])


def test_points_on_the_line_between_leaflets_are_of_either(monkeypatch):
    use(monkeypatch)
    estimation = CaseProblem.of(made_up_case(0.3), settings(correspondence=False))
    (seen,) = estimation.generic().errors.observation().seen
    column = np.arange(len(seen.region)) % 32
    np.testing.assert_array_equal(seen.region == UNKNOWN, (column == 0) | (column == 16))
    assert set(seen.region[(column > 0) & (column < 16)]) == {0}
    assert set(seen.region[column > 16]) == {1}


def test_very_many_vertices_are_thinned_evenly():
    assert _thinned(2000).all()
    kept = _thinned(2001)
    assert kept.sum() == 1001
    assert set(np.diff(np.flatnonzero(kept))) == {2}
    assert _thinned(9000).sum() <= 2000


def test_a_valve_that_does_not_close_is_a_result_with_its_reason(monkeypatch):
    use(monkeypatch, fails_above=4.0)
    found = personalise(
        made_up_case(0.3),
        settings(moduli_only=True, paper=PaperSettings(), confirm=True),
    )
    assert not found.result.converged
    assert "no equilibrium" in found.result.detail
    assert found.distances == ()
    assert found.known.quantities == found.known.narrower == ()
    assert found.confirmed_mm is None
    assert found.moduli_only is not None
    assert not found.moduli_only.converged
    assert not found.paper.converged


def test_the_fitted_valve_is_closed_anew(monkeypatch):
    use(monkeypatch)
    found = personalise(made_up_case(0.3), settings(confirm=True))
    assert found.confirmed_mm == 0.0
    # One that closes otherwise from the open valve is told.
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


BAD = [
    ((), "at least one modulus"),
    ((Prior("E_f.anterior", 6.0, 3.0, fixed=True),), "at least one modulus"),
    ((Prior("E_f.anterior", 6.0, 3.0),) * 2, "not all different"),
]


@pytest.mark.parametrize(("given", "message"), BAD)
def test_settings_that_estimate_nothing_are_refused(given, message):
    with pytest.raises(InputError, match=message):
        PersonaliseSettings(tuple(given), MECHANICS)


@pytest.mark.parametrize(
    ("name", "mean", "std"),
    [
        ("E_f.anterior", 0.0, 1.0),
        ("pressure_scale", -1.0, 1.0),
        ("shift.x", 0.0, 0.0),
        ("shift.x", np.nan, 1.0),
        ("E_f.anterior", 6.0, np.inf),
    ],
)
def test_priors_that_are_none_are_refused(name, mean, std):
    with pytest.raises(InputError, match=f"prior of {name}"):
        Prior(name, mean, std)


def test_the_moduli_must_be_those_of_the_case():
    case = made_up_case()
    for given in (
        unknowns()[:1],
        (*unknowns()[:2], Prior("E_f.septal", 1.0, 0.5)),
    ):
        with pytest.raises(InputError, match=r"has the leaflets anterior, posterior"):
            build_model(case, settings(*given))


@pytest.mark.parametrize("name", ["luck", "shift.w", "chord_slack", "E_perp.anterior"])
def test_unknown_unknowns_are_refused_before_anything_is_closed(name):
    # Once a closure is under way a misspelt name has cost minutes.
    with pytest.raises(InputError, match=name):
        build_model(made_up_case(), settings(*unknowns()[:2], Prior(name, 1.0, 0.5)))


@pytest.mark.parametrize("name", ["shift.x", "turn.z"])
def test_a_displacement_that_is_fixed_elsewhere_is_not_passed_over(name):
    with pytest.raises(InputError, match=f"{name} is fixed at 1.0"):
        settings(*unknowns()[:2], Prior(name, 1.0, 0.5, fixed=True))


def test_a_structured_mesh_is_of_two_leaflets():
    case = made_up_case()
    s = case.surface
    region = np.where(np.arange(len(s.region)) % 32 < 8, 2, s.region)
    three = LeafletSurface(
        s.vertices, s.triangles, region, (*s.region_names, "septal"), s.fibre, s.thickness
    )
    given = (*unknowns()[:2], Prior("E_f.septal", 2.0, 1.0))
    with pytest.raises(InputError, match="two leaflets; expected mesh source tetwild"):
        build_model(
            replace(case, surface=three),
            replace(settings(*given), mesh=CaseMesh(source="structured")),
        )
    with pytest.raises(InputError, match="mesh source 'voxels'"):
        CaseMesh(source="voxels")


SMALL = CaseMesh(
    columns=16, rows=2, guide_columns=10, guide_rows=2, contact_columns=60, contact_rows=16
)


def test_the_model_has_the_pressure_and_the_boundary_of_the_case():
    case = made_up_case()
    given = (*unknowns()[:2], Prior("pressure_scale", 1.3, 0.1, fixed=True), *unknowns()[4:])
    wanted = replace(settings(*given), mesh=SMALL)
    model = build_model(case, wanted)
    assert model.settings.protocol.pressure_mmHg == 100.0
    assert wanted.mechanics.protocol.pressure_mmHg == 120.0
    assert model.names == ("E_f.anterior", "E_f.posterior", "chord_rest_length")
    assert model.fixed == {"pressure_scale": 1.3}
    assert model.guide.names == model.names
    assert model.guide.fixed == model.fixed
    assert len(model.guide.mesh.nodes) < len(model.mesh.nodes)
    np.testing.assert_array_equal(model.valve.motion.annulus[-1], CLOSED_ANNULUS)


def test_a_further_frame_s_annulus_is_laid_on_the_samples_of_contact():
    case = made_up_case()
    estimation = CaseProblem.of(case, replace(settings(), mesh=SMALL))
    contact = estimation.stated.model.contact_valve
    assert len(contact.annulus) == 60
    # The closed frame held is the closed frame.
    closed = held_state(estimation.stated.model, case.frame(Role.CLOSED))
    np.testing.assert_allclose(closed.annulus, contact.motion.annulus[-1], atol=1e-9)
    late = held_state(estimation.stated.model, case.held_out[0])
    np.testing.assert_allclose(late.annulus - closed.annulus, [[0.1, -0.2, 0.5]] * 60, atol=1e-9)
    assert late.pressure_mmHg == 70.0


def test_uncertainty_without_a_size_is_refused():
    with pytest.raises(InputError, match="expected > 0"):
        Uncertainty(0.0)


# Coarser than that, and vertices of the surface would lie outside of the mesh.
TWIN = replace(SMALL, guide_columns=16)


@pytest.mark.slow
def test_a_real_twin_on_the_smallest_mesh_gives_back_its_moduli():
    # The same mesh and no noise: what is left is the filter's tolerance and the prior's pull.
    names = (*MODULI, "shift.z")
    true = np.array([5.4, 3.8, 0.5])
    given = [
        Prior("E_f.anterior", 6.0, 3.0),
        Prior("E_f.posterior", 4.2, 2.0),
        Prior("shift.z", 0.0, 1.0),
    ]
    protocol = ClosureProtocol(ramp=0.2, dt=0.04, growth=2.0, end=0.4)
    wanted = PersonaliseSettings(
        tuple(given), replace(MECHANICS, protocol=protocol), mesh=TWIN, tolerance=1e-5
    )
    case = made_up_case(std_mm=1e-3)
    model = build_model(case, wanted)
    twin = RegisteredModel(model, names)
    found = twin(true)
    assert found.converged
    late = case.held_out[0]
    held = held_state(model, replace(late, pressure_mmHg=95.0))
    seen = {
        "closed": found.y.reshape(2, -1, 3)[1],
        "late": twin.seen(model.held(true[:2], [held])[0], true),
    }
    frames = [replace(f, vertices=seen.get(f.name, f.vertices)) for f in case.frames]
    frames[2] = replace(frames[2], pressure_mmHg=95.0)
    result = personalise(replace(case, frames=tuple(frames)), wanted)
    assert result.result.converged
    np.testing.assert_allclose(result.result.estimate, true, rtol=1e-4)
    assert [d.frame for d in result.distances] == ["closed", "late"]
    for distance in result.distances:
        assert distance.personalised.max() < 1e-3
        assert distance.generic.mean() > 0.1


# --- errors of the geometry ---------------------------------------------------------------------


def seen_in_error(case, count=12, std=0.4, seed=3):
    """The case with samples of smooth errors, the same in both frames and in the tips."""
    rng = np.random.default_rng(seed)
    n, f = len(case.surface.vertices), len(case.frames)
    L = SpatialCorrelation(case.surface.vertices, 12.0).factor
    each = std * np.einsum("nk,skd->snd", L, rng.standard_normal((count, n, 3)))
    tips = std * rng.standard_normal((count, 1, 2, 3))
    return replace(
        case,
        error_samples=ErrorSamples(np.repeat(each[:, None], f, axis=1), np.repeat(tips, f, axis=1)),
    )


def use_geometry(monkeypatch):
    """The formula, moved along with the open shape twice as far as this is moved."""
    use(monkeypatch)

    def sample(case, model, m, states, vertices, tips):
        return FrameSamples(2.0 * vertices[:, 0], vertices[:, 1], vertices[:, 0])

    monkeypatch.setattr("mvest.personalisation.errors.sample_frames", sample)


def share_of(fit, source):
    """Share of the variance of each modulus that a source accounts for."""
    return np.array([row.share for row in fit.known.shares if row.source == source])


@pytest.mark.parametrize(("correspondence", "std"), [(True, 0.3), (False, 0.02)])
def test_errors_of_the_geometry_widen_the_intervals(monkeypatch, correspondence, std):
    use_geometry(monkeypatch)
    case = made_up_case(std, 8.0, np.random.default_rng(1), displaced=False)
    wanted = settings(*right_nuisances(), correspondence=correspondence)
    plain = personalise(case, wanted)
    told = personalise(seen_in_error(case, std=4 * std), wanted)
    assert not share_of(plain, IMAGES).size
    assert (plain.error_samples, told.error_samples) == (0, 12)
    assert told.result.converged
    assert np.all(told.result.std > 1.5 * plain.result.std)
    images = share_of(told, IMAGES)
    assert np.all((images > 0.5) & (images <= 1.0))


def test_without_nuisances_moduli_alone_have_the_errors_of_the_frames_too(monkeypatch):
    use_geometry(monkeypatch)
    case = seen_in_error(made_up_case(0.3, 8.0, np.random.default_rng(1)))
    found = personalise(case, settings(*right_nuisances(), moduli_only=True))
    np.testing.assert_allclose(found.moduli_only.estimate, found.result.estimate, rtol=1e-6)
    np.testing.assert_allclose(found.moduli_only.std, found.result.std, rtol=1e-6)


def test_a_law_that_is_not_known_is_not_averaged_away_beside_error_samples(monkeypatch):
    use_geometry(monkeypatch)
    column = 0.2 * FIELDS["E_f.anterior"].reshape(-1, 1)
    monkeypatch.setattr(
        "mvest.personalisation.errors.law_and_mesh_sources", lambda *_: (error_source(column),)
    )
    case = seen_in_error(made_up_case(0.3, 8.0, np.random.default_rng(1)))
    law = {"anterior": ExponentialTissue(0.06, 4.325, 1446.5)}
    given = settings(*right_nuisances(), nuisance_law=law)
    told = personalise(case, given)
    known = personalise(case, settings(*right_nuisances()))
    assert told.result.std[0] > 1.05 * known.result.std[0]
    assert share_of(told, "law")[0] > 0.05


def test_a_sample_is_what_moves_the_prediction_against_the_frame(monkeypatch):
    # Prediction and frame move as one: nothing is learnt or lost by it.
    use_geometry(monkeypatch)
    case = seen_in_error(made_up_case(0.3, 8.0, displaced=False))
    estimation = CaseProblem.of(case, settings(*right_nuisances()))
    errors = sampled(estimation.generic()).errors
    each = case.error_samples.vertices[:, 1]
    np.testing.assert_allclose(errors.frame_samples.predicted, 2.0 * each, atol=1e-9)
    np.testing.assert_allclose(errors.samples.samples.T, each.reshape(len(each), -1), atol=1e-9)


def test_errors_of_frames_that_cannot_be_told_are_an_error(monkeypatch):
    use_geometry(monkeypatch)
    monkeypatch.setattr("mvest.personalisation.errors.sample_frames", lambda *_: "no equilibrium")
    case = seen_in_error(made_up_case(0.3, 8.0, displaced=False))
    with pytest.raises(GeometryError, match="error samples do: no equilibrium"):
        personalise(case, settings(*right_nuisances()))


# --- errors that are learned --------------------------------------------------------------------


def rougher(case, std, seed=9):
    """The case with white noise on its closed frame, of which it states nothing."""
    rng = np.random.default_rng(seed)
    frames = tuple(
        replace(f, vertices=f.vertices + std * rng.standard_normal(f.vertices.shape))
        if f.role is Role.CLOSED
        else f
        for f in case.frames
    )
    return replace(case, frames=frames)


@pytest.mark.parametrize("correspondence", [True, False])
def test_errors_rougher_than_stated_are_learned(monkeypatch, correspondence):
    use(monkeypatch)
    case = rougher(made_up_case(0.3, 8.0, np.random.default_rng(5)), 0.2)
    wanted = settings(correspondence=correspondence)
    as_stated = personalise(case, wanted).result.filtered
    found = personalise(case, replace(wanted, errors=ErrorBeliefs()))
    learned = found.result.filtered
    assert as_stated.learned is None
    assert as_stated.innovation.nis > 5.0 * as_stated.innovation.size
    low, high = learned.innovation.nis_band
    assert low < learned.innovation.nis < high
    # The case states that its 0.3 mm are alike over 8 mm; they are independent, and 0.2 mm more.
    rough = next(q for q in learned.learned.quantities if q.name == "rough part")
    low, high = rough.learned.interval()
    assert low < np.hypot(0.3, 0.2) < high < 1.3 * low
    assert rough.stretch > 1.0
    z = (learned.mean - true_of(found)) / learned.std
    assert np.sqrt(np.mean(z**2)) < 1.6
    # What would be known if more were known starts from what is.
    moduli = [found.result.parameters.index(name) for name in MODULI]
    now = [row.std_now for row in found.known.narrower[:2]]
    np.testing.assert_allclose(now, learned.transformed.std[moduli], rtol=1e-6)


def test_learned_errors_and_error_samples_widen_together(monkeypatch):
    use_geometry(monkeypatch)
    case = rougher(made_up_case(0.3, 0.0, np.random.default_rng(1), displaced=False), 0.3)
    wanted = settings(*right_nuisances(), errors=ErrorBeliefs())
    plain = personalise(case, wanted)
    told = personalise(seen_in_error(case, std=1.2), wanted)
    assert told.result.filtered.learned.quantities[-1].name == "error samples"
    assert np.all(told.result.std > 1.5 * plain.result.std)
    rough = [r.result.filtered.learned.quantities[2].learned.median for r in (plain, told)]
    np.testing.assert_allclose(rough, np.hypot(0.3, 0.3), rtol=0.1)
