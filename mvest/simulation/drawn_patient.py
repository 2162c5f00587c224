"""Virtual patients: their settings, and how their moduli and anatomies are drawn.

Nothing here knows how a case is estimated, so that a stored patient depends on nothing of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

from mvest.errors import GeometryError
from mvest.quantities import Factor, Length, Modulus
from mvest.simulation.virtual_patient import Deviations, PatientSimulation, draw_hidden
from mvest.valve.anatomy.template import Template
from mvest.valve.anatomy.variation import vary

T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class PatientSettings:
    """A virtual patient. Nothing of it reaches the estimator but the case that it writes."""

    name: str
    description: str
    world: str = ""  # what else is otherwise than its case says, in words
    moduli: dict[str, Modulus] = field(default_factory=dict)  # MPa
    moduli_spread: Factor = 0.0  # SD of the logarithm by which they are drawn about these
    variation: Factor = 0.0  # size of the random variation of the anatomy; 0: as configured
    simulation: PatientSimulation = field(default_factory=PatientSimulation)
    deviations: Deviations = field(default_factory=Deviations)
    paper_distance_mm: tuple[Length, ...] = ()  # generic, personalised


@dataclass(frozen=True, slots=True, kw_only=True)
class EchoSettings:
    """How a virtual patient who is to be imaged moves, and how the volume is simulated."""

    spread: str = "training"  # of acquisitions; shifted: what no detector was trained on
    tip_motion_mm: tuple[Length, Length] = (1.0, 3.0)  # of papillary tips


def draw_patient_values(patient: PatientSettings, rng: np.random.Generator) -> dict[str, float]:
    """True value of each parameter: moduli drawn about the configured ones, and what is hidden."""
    moduli = {
        name: float(value * np.exp(patient.moduli_spread * rng.standard_normal()))
        for name, value in sorted(patient.moduli.items())
    }
    return draw_hidden(moduli, patient.deviations, rng, patient.simulation.fitted_frames)


def first_that_closes(
    template: Template,
    variation: float,
    max_draws: int,
    rng: np.random.Generator,
    simulate: Callable[[Template], T],
) -> tuple[T, int]:
    """What ``simulate`` makes of the first anatomy that closes, and how many were drawn.

    Raises
    ------
    GeometryError
        If none of ``max_draws`` does.
    """
    draws = 0
    while True:
        draws += 1
        drawn = Template(vary(template.parameters, rng, variation)) if variation else template
        try:
            return simulate(drawn), draws
        except GeometryError:
            if draws == max_draws:
                raise
