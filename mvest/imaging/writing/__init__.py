"""Writing what the image step makes: sequences and segmentations for 3D Slicer."""

from mvest.imaging.writing.segmentation import write_segmentation
from mvest.imaging.writing.sequence import write_sequence_nrrd
from mvest.imaging.writing.voxels import voxelise_leaflets

__all__ = ["voxelise_leaflets", "write_segmentation", "write_sequence_nrrd"]
