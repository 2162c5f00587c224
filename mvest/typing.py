"""Array types of signatures; docstrings state shapes and units."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
"""Array of real numbers in double precision."""

IntArray: TypeAlias = NDArray[np.int64]
"""Array of indices or counts."""

BoolArray: TypeAlias = NDArray[np.bool_]
"""Array of truth values."""
