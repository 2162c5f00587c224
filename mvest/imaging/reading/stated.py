"""What a file states of a volume over time, before any of it is believed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvest.errors import InputError
from mvest.imaging.volume import Modality
from mvest.reading.text import MAX_LINE, one_line
from mvest.typing import FloatArray

MIN_VALUE = 40
"""Characters of a value that are shown in any case."""


def fault(path: Path, field: str, value: object, expected: str) -> InputError:
    """What to raise where a file's field is not what it must be, in one line of bounded length."""
    field = one_line(field, 80)
    left = MAX_LINE - len(f"{path.name}: {field}: , expected {expected}")
    return InputError(
        f"{path}: {field}: {one_line(value, max(left, MIN_VALUE))}, expected {expected}"
    )


@dataclass(frozen=True, slots=True)
class Header:
    """The fields of a file of text before its voxels.

    Attributes
    ----------
    path : Path
    fields : dict
        Values by the format's own names.
    length : int
        Bytes up to the voxels.
    """

    path: Path
    fields: Mapping[str, Any]
    length: int

    def required(self, field: str, expected: str) -> Any:
        """Value of a field that must be there.

        Raises
        ------
        InputError
            The file does not state it.
        """
        if field not in self.fields:
            raise fault(self.path, field, "not stated", expected)
        return self.fields[field]


@dataclass(frozen=True, slots=True)
class FieldNames:
    """How the format calls what a message may be about.

    Attributes
    ----------
    size, spacing, direction, origin, values : str
    """

    size: str
    spacing: str
    direction: str
    origin: str
    values: str


@dataclass(frozen=True, slots=True, eq=False)
class StatedTimes:
    """When the frames were taken, as far as a file says.

    Attributes
    ----------
    values : (T,) or None
        In `unit`; None where the file says nothing.
    unit : str
        As the file writes it; empty where it does not.
    field : str
        Where they stand, or where they would.
    """

    values: FloatArray | None
    unit: str
    field: str


@dataclass(frozen=True, slots=True, eq=False)
class StatedVolume:
    """Frames with their place in space and time as a file states them.

    Attributes
    ----------
    frames : (T, I, J, K)
        Numbers of any type, in any order of memory.
    steps : (3, 3) mm
        Its columns lead from one voxel to the next along i, j and k, in LPS.
    origin : (3,) mm
        Centre of voxel (0, 0, 0), in LPS.
    times : StatedTimes
    modality : Modality or None
        None where the file does not say.
    names : FieldNames
    """

    frames: NDArray[np.generic]
    steps: FloatArray
    origin: FloatArray
    times: StatedTimes
    modality: Modality | None
    names: FieldNames
