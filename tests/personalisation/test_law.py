"""Another law of the tissue: its own equilibrium, columns, and wider intervals."""

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
from mvest.personalisation.errors import FrameErrors
from mvest.personalisation.settings import CaseMesh
from mvest.personalisation.sources import ClosedValve, law_and_mesh_sources, law_change
from mvest.problem.registration import RegisteredModel
from tests.closure.test_model import AT, GENTLE, SMALL, TISSUE, model_of

STIFFENING = {"anterior": ExponentialTissue(0.06, 4.325, 1446.5)}


@pytest.fixture(scope="module")
def gentle():
    # Without contact there is one equilibrium, independent of the path.
    return model_of(GENTLE, **SMALL)


def turned(model):
    """A closed valve that is rotated by 90 degrees, and its observation."""
    registered = RegisteredModel(model, (*model.names, "turn.z"))
    m, n = np.array([*AT, 90.0]), len(model.valve.surface.vertices)
    seen = Observation(("closed",), np.zeros((1, n, 3)), np.array(1.0))
    return ClosedValve(registered, m, registered(m).y), seen


def test_the_change_is_that_to_the_equilibrium_of_the_other_law(gentle):
    end = gentle.contact_valve.motion
    state = HeldState(0.3, end.annulus[-1], end.papillary_tips[-1])
    linear = gentle.rests(AT, [state])
    change = law_change(gentle, AT, [state], STIFFENING, linear)
    assert change.shape == (3, len(gentle.valve.surface.vertices), 3, 1)
    assert not change[0].any()
    # The same valve from its open state, independent of the linear law.
    own = as_stiff(STIFFENING["anterior"], TISSUE["anterior"], AT[0])
    stiffening = replace(TISSUE["anterior"], law="exponential", exponential=own)
    other = model_of(GENTLE, gentle.names[1:], **SMALL)
    other.settings = replace(other.settings, tissue={**TISSUE, "anterior": stiffening})
    for frame, before, after in zip((2, 1), linear, other.rests(AT[1:], [state]), strict=True):
        moved = gentle.observed(after.frames[-1]) - gentle.observed(before.frames[-1])
        assert np.abs(moved).max() > 0.1
        np.testing.assert_allclose(change[frame, ..., 0], moved, atol=1e-6)


def test_columns_are_turned_as_the_valve_is_seen(gentle):
    valve, seen = turned(gentle)
    (law,) = law_and_mesh_sources(STIFFENING, CaseMesh(), valve, seen)  # no guide, no mesh error
    assert (law.name, law.columns.factor) == ("law", 1.0)
    first = gentle.rests(AT, [])
    change = law_change(gentle, AT, [], STIFFENING, first)[1, ..., 0]
    expected = np.stack([-change[:, 1], change[:, 0], change[:, 2]], axis=1)
    np.testing.assert_allclose(law.columns.columns[:, 0], expected.ravel(), atol=1e-6)
    assert law_change(gentle, AT, [], {"septal": STIFFENING["anterior"]}, first).shape[-1] == 0


@pytest.mark.parametrize("source", ["structured", "tetwild"])
def test_the_mesh_error_is_extrapolated_from_the_guide(gentle, source):
    valve, seen = turned(replace(model_of(GENTLE), guide=gentle))
    # With an error e h², 48 and 24 cells around differ by three times the error of the finer ones.
    mesh = CaseMesh(source, columns=48, guide_columns=24)
    (found,) = law_and_mesh_sources({}, mesh, valve, seen)
    other = RegisteredModel(gentle, valve.registered.names)(valve.m)
    away = np.split(valve.predicted - other.y, 2)[1]
    assert 0.001 < np.abs(away).max() < 2.0
    assert found.name == "mesh"
    if source == "tetwild":  # does not refine the guide
        np.testing.assert_allclose(found.rows[:, 0], away, atol=1e-6)
        assert found.expected == 0.0
    else:
        np.testing.assert_allclose(found.expected, -away / 3.0, atol=1e-6)
        np.testing.assert_allclose(found.rows[:, 0], away / 6.0, atol=1e-6)
        errors = FrameErrors(SimpleNamespace(observation=lambda: seen), sources=(found,))
        np.testing.assert_allclose(errors.expected, -away / 3.0, atol=1e-6)


def test_a_law_without_an_equilibrium_is_reported(gentle, monkeypatch):
    failed = SimpleNamespace(converged=False, reason=StepReason.NO_CONVERGENCE)
    first = gentle.rests(AT, [])
    monkeypatch.setattr(ClosureModel, "_rest", lambda *given, **more: failed)
    reason = law_change(gentle, AT, [], STIFFENING, first)
    assert reason == f"anterior of an exponential law: {StepReason.NO_CONVERGENCE.value}"
