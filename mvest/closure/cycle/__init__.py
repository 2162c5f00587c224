"""The whole cycle of a simulated valve: any number of frames, open to closed and back."""

from mvest.closure.cycle.model import CycleModel
from mvest.closure.cycle.observation import Beats, CycleObservation, SeenFrames
from mvest.closure.cycle.protocol import CycleProtocol

__all__ = ["Beats", "CycleModel", "CycleObservation", "CycleProtocol", "SeenFrames"]
