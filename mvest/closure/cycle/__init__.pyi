from .model import CycleModel as CycleModel
from .observation import Beats as Beats
from .observation import CycleObservation as CycleObservation
from .protocol import CycleProtocol as CycleProtocol
