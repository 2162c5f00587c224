from .acquisition import SMALL as SMALL
from .acquisition import Acquisition as Acquisition
from .acquisition_ranges import AcquisitionRanges as AcquisitionRanges
from .acquisition_ranges import draw_acquisition as draw_acquisition
from .probe import Probe as Probe
from .probe import draw_probe as draw_probe
from .simulate import simulate_volume as simulate_volume
from .simulate import true_sequence as true_sequence
