from .slicer import write_segmentation as write_segmentation
from .slicer import write_sequence_nrrd as write_sequence_nrrd
from .voxels import voxelise_leaflets as voxelise_leaflets
