from .model import CycleModel as CycleModel
from .observation import Beats as Beats
from .observation import CycleObservation as CycleObservation
from .observation import SeenFrames as SeenFrames
from .protocol import CycleProtocol as CycleProtocol
