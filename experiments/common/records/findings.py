"""Numbers as findings hold them: tuples for arrays, None for what JSON lacks."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

__all__ = ["Rows", "Vector", "finite", "rows", "vector"]

Vector = tuple[float, ...]
Rows = tuple[Vector, ...]


def vector(values: ArrayLike) -> Vector:
    """The numbers of an array ``(n,)``."""
    return tuple(np.asarray(values).tolist())


def rows(values: ArrayLike) -> Rows:
    """The rows of an array ``(m, n)``."""
    return tuple(map(tuple, np.asarray(values).tolist()))


def finite(value: float) -> float | None:
    """None for a number that is infinite or not known."""
    return float(value) if math.isfinite(value) else None
