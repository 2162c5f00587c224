"""What another law of the tissue would do: its own equilibrium, columns, and wider intervals."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mvest.closure.model import ClosureModel
from mvest.mechanics.law.exponential import as_stiff
from mvest.mechanics.settings import ExponentialTissue
from mvest.mechanics.steps import StepReason
from mvest.mechanics.valve_system import HeldState
from mvest.observation.vertices import Observation
from mvest.personalisation import personalise
from mvest.personalisation.diagnostics import diagnostics_of
from mvest.personalisation.sources import law_and_mesh_sources, law_change
from mvest.problem.registration import RegisteredModel
from mvest.problem.verdict import judge
from tests.closure.test_model import AT, CLOSING, GENTLE, SMALL, TISSUE, model_of
from tests.made_up_closure import FIELDS, error_source, made_up_case, settings, use

STIFFENING = {"anterior": ExponentialTissue(0.06, 4.325, 1446.5)}


@pytest.fixture(scope="module")
def model():
    model = model_of(CLOSING, continuation=True)
    assert model.close(AT).simulation.converged
    return model


def test_the_change_is_that_to_the_equilibrium_of_the_other_law():
    # Without contact there is one equilibrium, whatever it is reached from.
    gentle = model_of(GENTLE, **SMALL)
    end = gentle.contact_valve.motion
    state = HeldState(0.3, end.annulus[-1], end.papillary_tips[-1])
    change = law_change(gentle, AT, [state], STIFFENING, gentle.rests(AT, [state]))
    assert change.shape == (3, len(gentle.valve.surface.vertices), 3, 1)
    assert not change[0].any()
    # The same valve from its open state, which knows nothing of the linear one.
    own = as_stiff(STIFFENING["anterior"], TISSUE["anterior"], AT[0])
    stiffening = replace(TISSUE["anterior"], law="exponential", exponential=own)
    other = model_of(GENTLE, gentle.names[1:], **SMALL)
    other.settings = replace(other.settings, tissue={**TISSUE, "anterior": stiffening})
    linear, anew = gentle.rests(AT, [state]), other.rests(AT[1:], [state])
    for frame, before, after in zip((2, 1), linear, anew, strict=True):
        assert before.converged
        assert after.converged
        moved = gentle.observed(after.frames[-1]) - gentle.observed(before.frames[-1])
        assert np.abs(moved).max() > 0.1
        np.testing.assert_allclose(change[frame, ..., 0], moved, atol=1e-6)


def test_a_leaflet_without_another_law_has_no_column(model):
    first = model.rests(AT, [])
    for tissue in ({}, {"septal": STIFFENING["anterior"]}):
        assert law_change(model, AT, [], tissue, first).shape[-1] == 0


def test_columns_are_turned_as_the_valve_is_seen(model):
    registered = RegisteredModel(model, (*model.names, "turn.z"))
    m = np.array([*AT, 90.0])
    n = len(model.valve.surface.vertices)
    seen = Observation(("closed",), np.zeros((1, n, 3)), np.array(1.0))
    (law,) = law_and_mesh_sources(
        STIFFENING, 0.5, registered, seen, m, registered(m).y
    )  # no coarser mesh, no error of the mesh
    assert (law.name, law.columns.factor) == ("law", 1.0)
    change = law_change(model, AT, [], STIFFENING, model.rests(AT, []))[1, ..., 0]
    turned = np.stack([-change[:, 1], change[:, 0], change[:, 2]], axis=1)
    np.testing.assert_allclose(law.columns.columns[:, 0], turned.ravel(), atol=1e-6)


def test_the_mesh_is_off_by_a_share_of_its_difference_from_the_coarser_one():
    coarse = model_of(GENTLE, **SMALL)
    fine = replace(model_of(GENTLE), guide=coarse)
    registered = RegisteredModel(fine, (*fine.names, "turn.z"))
    m = np.array([*AT, 90.0])
    n = len(fine.valve.surface.vertices)
    seen = Observation(("closed",), np.zeros((1, n, 3)), np.array(1.0))
    predicted = registered(m)
    (mesh,) = law_and_mesh_sources({}, 0.4, registered, seen, m, predicted.y)
    other = RegisteredModel(coarse, registered.names)(m)
    expected = 0.4 * np.split(predicted.y - other.y, 2)[1]
    assert mesh.name == "mesh"
    np.testing.assert_allclose(mesh.rows[:, 0], expected, atol=1e-6)
    assert 0.001 < np.abs(expected).max() < 2.0


def test_a_law_without_an_equilibrium_is_said(model, monkeypatch):
    failed = SimpleNamespace(converged=False, reason=StepReason.NO_CONVERGENCE)
    first = model.rests(AT, [])
    monkeypatch.setattr(ClosureModel, "_rest", lambda *given, **more: failed)
    reason = law_change(model, AT, [], STIFFENING, first)
    assert reason == f"anterior of an exponential law: {StepReason.NO_CONVERGENCE.value}"


def test_a_law_that_is_not_known_widens_the_intervals_but_not_those_of_moduli_alone(monkeypatch):
    use(monkeypatch)
    case = made_up_case(0.3, 8.0, np.random.default_rng(1))
    column = 0.2 * FIELDS["E_f.anterior"].reshape(-1, 1)
    monkeypatch.setattr(
        "mvest.personalisation.errors.law_and_mesh_sources",
        lambda *_: (error_source(column),),
    )
    known = personalise(case, settings(moduli_only=True))
    doubtful = personalise(case, settings(moduli_only=True, nuisance_law=STIFFENING))
    anterior = doubtful.result.parameters.index("E_f.anterior")
    assert doubtful.result.std[anterior] > 1.3 * known.result.std[anterior]
    shares = {row.source: row.share for row in doubtful.known.shares[::2]}
    assert shares["law"] > 0.3
    assert sum(shares.values()) == pytest.approx(1.0)
    np.testing.assert_allclose(doubtful.moduli_only.std, known.moduli_only.std, rtol=1e-6)
    assert doubtful.unaccounted == ()


def test_what_could_not_be_considered_makes_the_estimate_doubtful(monkeypatch):
    use(monkeypatch)
    case = made_up_case(0.3, 8.0, np.random.default_rng(1))
    monkeypatch.setattr(
        "mvest.personalisation.errors.law_and_mesh_sources", lambda *_: "it did not close"
    )
    fit = personalise(case, settings(nuisance_law=STIFFENING))
    assert fit.unaccounted == ("it did not close",)
    failed_checks = [
        g.text for g in judge(diagnostics_of(fit)).failed_checks if g.check == "errors left out"
    ]
    assert any(text.endswith("is not in the intervals: it did not close") for text in failed_checks)
