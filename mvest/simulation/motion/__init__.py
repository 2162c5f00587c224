"""Simulated valves in motion: what detectors learn from and are tested on.

Closures of :mod:`mvest.closure.model`, on anatomies around given ones, as
:class:`mvest.imaging.moving_valve.MovingValve`.
"""

from mvest.simulation.motion.closing import MotionSettings, close_in_motion
from mvest.simulation.motion.files import load_population, save_population
from mvest.simulation.motion.patient import (
    IMAGED,
    ImagedPatient,
    simulate_imaged_patient,
)
from mvest.simulation.motion.population import (
    Population,
    PopulationSettings,
    draw_population,
    draw_tip_motion,
    population_hash,
)
from mvest.simulation.motion.refusal import MotionLimits, Refusal, RefusedError

__all__ = [
    "IMAGED",
    "ImagedPatient",
    "MotionLimits",
    "MotionSettings",
    "Population",
    "PopulationSettings",
    "Refusal",
    "RefusedError",
    "close_in_motion",
    "draw_population",
    "draw_tip_motion",
    "load_population",
    "population_hash",
    "save_population",
    "simulate_imaged_patient",
]
