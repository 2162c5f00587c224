"""The valves that the benchmark runs on: five sizes, two elements, closed once each."""

from __future__ import annotations

import resource
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from experiments.common.building.closure import guide_of
from mvest.closure.model import ClosureModel
from mvest.estimation.prediction import Prediction
from mvest.mechanics.forces.pair_search import ContactPairs
from mvest.mechanics.integrate import simulate
from mvest.mechanics.parameters import Parameter
from mvest.mechanics.settings import MechanicsSettings, TissueSettings
from mvest.mechanics.steps import Simulation
from mvest.mechanics.system import Loads, System
from mvest.mechanics.valve_system import boundary_loading
from mvest.typing import FloatArray
from mvest.valve.anatomy.template import Template
from mvest.valve.mesh.structured import structured_mesh

MODULI = ("E_f.anterior", "E_f.posterior")
VALUES = np.array([6.23, 2.09])
TISSUE = {"anterior": TissueSettings(6.23 / 2.35), "posterior": TissueSettings(2.09 / 1.89)}
OBSERVED, CONTACT = (112, 29), (144, 32)

CELLS = {
    ("hex18", "2k"): (40, 5),
    ("hex18", "default"): (54, 6),
    ("hex18", "3k"): (62, 6),
    ("hex18", "7k"): (84, 10),
    ("hex18", "25k"): (160, 19),
    ("tet4", "3k"): (116, 13),
    ("tet4", "7k"): (168, 20),
    ("tet4", "25k"): (320, 38),
}
"""Cells around and along the leaflets for about 3.2, 7 and 25 thousand nodes, one layer; the
coarsest mesh whose moduli are within 5 % of a fine mesh's (``mesh=quick``); and the default one."""

ALL = (
    *(Parameter(name, value) for name, value in zip(MODULI, VALUES, strict=True)),
    *(Parameter(name, 1.0) for name in ("pressure_scale", "chord_stiffness", "chord_rest_length")),
)


def farther(size: str) -> FloatArray:
    """Moduli to which a closed valve is continued: 30 % away, 10 % on the largest mesh."""
    factor = 1.1 if size == "25k" else 1.3
    return VALUES * [factor, 1 / factor]


def parameters(count: int) -> tuple[Parameter, ...]:
    """The model's parameters, repeated until there are ``count``: a repeated one costs the same."""
    return tuple(ALL[k % len(ALL)] for k in range(count))


@dataclass(frozen=True, slots=True, eq=False)
class Closed:
    """A closed valve with everything that the kernels need; ``peak_mb`` is of the process."""

    model: ClosureModel
    system: System
    x: FloatArray
    y: FloatArray
    pairs: ContactPairs
    loads: Loads
    strain: FloatArray
    peak_mb: float


@cache
def model(element: str, size: str) -> ClosureModel:
    """The default valve in one of the sizes."""
    template = Template()
    columns, rows = CELLS[element, size]
    valve = ClosureModel(
        template.valve(*OBSERVED),
        template.valve(*CONTACT),
        structured_mesh(template, element, columns, rows),
        MechanicsSettings(TISSUE),
        MODULI,
    )
    valve.guide = guide_of(valve, template, {"columns": columns, "rows": rows})
    return valve


@cache
def closed(element: str, size: str) -> Closed:
    """The valve closed by guides."""
    valve = model(element, size)
    result = valve.close(VALUES)
    assert result.simulation.converged, result.simulation.reason.value
    system, x = result.system, result.simulation.frames[-1]
    y = system.contact.points(x)
    loads = boundary_loading(system, valve.valve, valve.contact_valve, valve.settings)(1e3)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    strain = system.solid.initial_strain()
    return Closed(valve, system, x, y, system.contact.search(y), loads, strain, peak)


def loading_of(case: Closed) -> Any:
    """The loads of the valve over time."""
    valve = case.model
    return boundary_loading(case.system, valve.valve, valve.contact_valve, valve.settings)


def close(case: Closed, wanted: tuple[Parameter, ...]) -> Simulation:
    """The whole closure from the open valve, differentiated by the parameters."""
    settings = case.model.settings
    case.system.solid.reset()
    simulation = simulate(
        case.system,
        loading_of(case),
        settings.protocol.steps(),
        damping=settings.damping,
        newton=settings.newton,
        parameters=wanted,
        final_only=True,
    )
    assert simulation.converged, simulation.reason.value
    return simulation


def predictions(valve: ClosureModel, values: FloatArray) -> list[Prediction]:
    """One after another, each from where the one before ended."""
    return [valve(m) for m in values]
