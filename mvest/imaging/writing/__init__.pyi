from .segmentation import write_segmentation as write_segmentation
from .sequence import write_sequence_nrrd as write_sequence_nrrd
from .voxels import voxelise_leaflets as voxelise_leaflets
