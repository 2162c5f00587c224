"""Volumes over time and label maps, from every format that is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvest.exchange.volumes.nrrd_file import Segment, segment_names
from mvest.exchange.volumes.reader import read_volume
from mvest.imaging.volume import Modality
from mvest.typing import FloatArray

__all__ = ["LabelMap", "Segment", "read_labels", "read_volume"]


@dataclass(frozen=True, slots=True, eq=False)
class LabelMap:
    """Labelled voxels of one region. World coordinates are LPS, in mm.

    Attributes
    ----------
    frames : (F, I, J, K) integers
        Frames over time, or the layers of a segmentation.
    is_layers : bool
        Whether they are layers, which show one instant.
    spacing : (3,) mm
    direction : (3, 3)
        Its columns are the unit vectors of i, j and k; orthonormal, perhaps left-handed.
    origin : (3,) mm
        Centre of voxel (0, 0, 0).
    times : (F,) s or None
        None where the file states none in a unit of time.
    segments : tuple of Segment
        Those that a ``.seg.nrrd`` names; empty for other files.
    sha256 : str
        Of the file, with its data file if that is another one.
    """

    frames: NDArray[np.integer]
    is_layers: bool
    spacing: FloatArray
    direction: FloatArray
    origin: FloatArray
    times: FloatArray | None
    segments: tuple[Segment, ...]
    sha256: str


def read_labels(path: Path | str) -> LabelMap:
    """Read a label map or segmentation: NRRD, MetaImage or NIfTI of three or four axes.

    Raises
    ------
    InputError
        In one line the file, the field, what was found and what was expected.
    """
    volume = read_volume(path, modality=Modality.CT, labels=True)
    segments = segment_names(Path(path))
    return LabelMap(
        volume.frames.astype(np.int64),
        bool(segments) and len(volume.frames) > 1,
        volume.spacing,
        volume.direction,
        volume.origin,
        None,
        segments,
        volume.sha256,
    )
