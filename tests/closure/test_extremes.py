"""Whatever valve is closed, the end is an equilibrium with its derivatives, or a reason."""

from dataclasses import replace

import numpy as np
import pytest

from mvest import Gaussian, IteratedFilter, Log
from tests.closure.extremes import ENDLESS, EXTREMES, STIFF, close, look_at, model_of


@pytest.mark.parametrize("name", EXTREMES)
def test_an_extreme_closes_or_says_why_not(name):
    ended = close(EXTREMES[name])
    assert ended.sound, ended
    if EXTREMES[name].closes is not None:
        assert ended.converged == EXTREMES[name].closes, ended


@pytest.mark.slow
@pytest.mark.parametrize("name", ENDLESS)
def test_what_is_tried_for_long_ends_as_well(name):
    ended = close(ENDLESS[name])
    assert ended.sound, ended


@pytest.mark.parametrize("name", ["mesh 300 x 40", "mesh 300 x 40, thickness 4 mm"])
def test_a_mesh_too_fine_for_the_commissures_is_refused_by_its_elements(name):
    assert "inverted elements; the worst is element" in close(EXTREMES[name]).reason


def test_a_state_beside_the_equilibrium_is_not_sound():
    extreme = EXTREMES["pressure 1 mmHg"]
    model = model_of(extreme)
    simulation = model.close(np.array(extreme.moduli)).simulation
    assert look_at(model, simulation, extreme.moduli).sound
    beside = simulation.frames.copy()
    beside[-1, -1] += 1e-6
    assert not look_at(model, replace(simulation, frames=beside), extreme.moduli).sound
    no_number = np.full_like(simulation.sensitivities, np.nan)
    changed = replace(simulation, sensitivities=no_number)
    assert not look_at(model, changed, extreme.moduli).sound


@pytest.mark.parametrize("name", ["pressure 0", "pressure 1 mmHg", "thickness 4 mm"])
def test_moduli_are_estimated_from_an_extreme_or_it_is_said_why_not(name):
    extreme = EXTREMES[name]
    model = replace(model_of(extreme), continuation=True)
    observed = model(np.array(extreme.moduli)).y
    observed = observed + np.random.default_rng(1).normal(0.0, 0.3, observed.shape)
    prior = Gaussian.from_variance([5.0, 3.0], 4.0)
    estimate = IteratedFilter(max_iterations=8)(
        model, prior, observed, R=0.09, names=model.names, transform=Log()
    )
    assert estimate.reason.value
    assert np.isfinite(estimate.mean).all()
    assert np.isfinite(estimate.std).all()
    assert (estimate.mean > 0).all()
    # Next to nothing is seen of the moduli, and an estimate is not surer of them than its prior.
    if name != "thickness 4 mm":
        assert (estimate.std > 0.3 * estimate.mean).all()


def test_moduli_of_a_stiff_valve_are_sought_from_a_soft_guess():
    model = replace(model_of(EXTREMES["moduli 1e3 MPa"]), continuation=True, repeat=False)
    observed = model(np.array(STIFF)).y
    prior = Gaussian.from_variance([5.0, 3.0], 4.0)
    estimate = IteratedFilter(max_iterations=8)(
        model, prior, observed, R=0.01, names=model.names, transform=Log()
    )
    assert estimate.reason.value
    assert np.isfinite(estimate.mean).all()
    assert (estimate.mean > prior.mean).all()
