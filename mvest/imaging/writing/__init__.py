"""Writing what the image step makes: sequences, segmentations and points for 3D Slicer."""

from mvest.imaging.writing.sequence import write_sequence_nrrd

__all__ = ["write_sequence_nrrd"]
