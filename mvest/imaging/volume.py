"""A volume over time."""

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.typing import FloatArray


class Modality(Enum):
    """What the voxels are: ultrasound echo (log-compressed), CT in HU, or MR signal."""

    ULTRASOUND = "ultrasound"
    CT = "ct"
    MR = "mr"


@dataclass(frozen=True, slots=True, eq=False)
class VolumeSequence:
    """Frames of one region. World coordinates are LPS: x to the left, y to the back, z up."""

    frames: NDArray[np.generic]  #: (T, I, J, K) uint8, int16 or float32
    spacing: FloatArray  #: (3,) mm between voxels along i, j and k
    direction: FloatArray  #: (3, 3), its columns are the unit vectors of i, j and k; orthonormal
    origin: FloatArray  #: (3,) mm, world position of the centre of voxel (0, 0, 0)
    times: FloatArray  #: (T,) s, increasing
    modality: Modality = Modality.ULTRASOUND
    source: str = ""  #: name of the file, or of the simulation
    sha256: str = ""  #: of the file; empty if there is none

    def __post_init__(self) -> None:
        if self.frames.ndim != 4:
            raise InputError(f"frames: shape {self.frames.shape}, expected (T, I, J, K)")
        if np.shape(self.times) != (len(self.frames),):
            raise InputError(
                f"times: shape {np.shape(self.times)}, expected one for each of "
                f"{len(self.frames)} frames"
            )

    def world(self, index: FloatArray) -> FloatArray:
        """World positions ``(..., 3)`` mm of (fractional) voxel indices ``(..., 3)``."""
        return np.asarray(self.origin + (index * self.spacing) @ self.direction.T)

    def index(self, world: FloatArray) -> FloatArray:
        """Fractional voxel indices ``(..., 3)`` of world positions ``(..., 3)`` mm."""
        return np.asarray((world - self.origin) @ self.direction / self.spacing)
