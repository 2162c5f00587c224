"""Simulated transoesophageal echo volumes of a moving valve, for training and testing detectors."""

from mvest.imaging.simulator.acquisition import SMALL, Acquisition
from mvest.imaging.simulator.probe import Probe, draw_probe
from mvest.imaging.simulator.simulate import simulate_volume, true_sequence
from mvest.imaging.simulator.spread import Spread, draw_acquisition

__all__ = [
    "SMALL",
    "Acquisition",
    "Probe",
    "Spread",
    "draw_acquisition",
    "draw_probe",
    "simulate_volume",
    "true_sequence",
]
