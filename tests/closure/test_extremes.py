"""Closures of extreme valves end in an equilibrium with finite derivatives, or with a reason."""

from dataclasses import replace

import numpy as np
import pytest

from mvest import (
    ClosureModel,
    ClosureProtocol,
    Gaussian,
    IteratedFilter,
    Log,
    MechanicsSettings,
    MvestError,
    Template,
    TemplateParameters,
    TissueSettings,
    structured_mesh,
)
from mvest.mechanics.valve_system import boundary_loading

REGIONS = ("anterior", "posterior")
EQUILIBRIUM = 1e-8
"""Largest residual of a closed state over its largest force: ten times Newton's tolerance."""


def model_of(pressure=120.0, thickness=None, element="hex18", cells=(16, 2), **fixed):
    changed = {f"leaflets.{leaflet}.thickness": thickness for leaflet in REGIONS}
    template = Template(TemplateParameters().changed(changed if thickness else {}))
    return ClosureModel(
        template.valve(16, 5),
        template.valve(60, 16),
        structured_mesh(template, element, *cells),
        MechanicsSettings(
            {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)},
            ClosureProtocol(pressure_mmHg=pressure),
        ),
        tuple(f"E_f.{leaflet}" for leaflet in REGIONS),
        fixed,
    )


def assert_sound(model, simulation, moduli):
    """The last state, judged by a system that has seen nothing else."""
    x, dx = simulation.frames[-1], simulation.sensitivities[-1]
    system, _ = model.fresh().tuned(np.array(moduli))
    loads = boundary_loading(system, model.valve, model.contact_valve, model.settings)(np.inf)
    state = system.evaluate(
        x, loads, system.search_contact(x), system.solid.initial_strain(), 0.0, tangent=False
    )
    state.residual[system.held] = 0.0
    assert np.linalg.norm(state.residual) <= EQUILIBRIUM * max(state.scale, 1e-12)
    assert not system.contact.intersects(system.contact.points(x))
    assert np.isfinite(dx).all()


@pytest.mark.parametrize(
    "extreme",
    [
        {"moduli": (1e3, 1e3)},
        {"pressure": 0.0, "moduli": (1e-3, 1e-3)},
        {"pressure": 300.0},
        {"chord_rest_length": 2.0},
        {"thickness": 4.0},
        {"element": "tet4", "cells": (36, 4), "moduli": (1e3, 1e3)},
    ],
)
def test_an_extreme_valve_closes_in_equilibrium(extreme):
    moduli = extreme.pop("moduli", (6.23, 2.09))
    model = model_of(**extreme)
    simulation = model.close(np.array(moduli)).simulation
    assert simulation.converged
    assert_sound(model, simulation, moduli)


def test_a_mesh_too_fine_for_the_commissures_is_refused_by_its_elements():
    with pytest.raises(MvestError, match="inverted elements; the worst is element"):
        model_of(cells=(300, 40)).close(np.array([6.23, 2.09]))


def test_a_valve_without_pressure_does_not_determine_its_moduli():
    model = replace(model_of(pressure=0.0), continuation=True)
    observed = model(np.array([6.23, 2.09])).y
    observed = observed + np.random.default_rng(1).normal(0.0, 0.3, observed.shape)
    prior = Gaussian.from_variance([5.0, 3.0], 4.0)
    estimate = IteratedFilter(max_iterations=8)(
        model, prior, observed, R=0.09, names=model.names, transform=Log()
    )
    assert estimate.reason.value
    assert (estimate.mean > 0).all()
    # The estimate is not much more certain than its prior.
    assert (estimate.std > 0.3 * estimate.mean).all()
