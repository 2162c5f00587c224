"""Values that records of estimates, their tables and their pages have in common."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.typing import FloatArray

__all__ = ["Alike", "Identified", "Innovation", "Spread", "Vector", "spread"]

Vector = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Spread:
    """Mean, standard deviation and largest of some values."""

    mean: float
    std: float
    max: float

    @classmethod
    def of(cls, values: FloatArray) -> Spread:
        """Of those that are finite: a vertex that is not seen has no distance.

        Raises
        ------
        InputError
            If none is.
        """
        known = values[np.isfinite(values)]
        if not known.size:
            raise InputError("a field of distances without a single value")
        return cls(float(known.mean()), float(known.std()), float(known.max()))

    def __str__(self) -> str:
        return f"{self.mean:.2f} ± {self.std:.2f}"


def spread(values: FloatArray | None) -> Spread | None:
    """The same; None where nothing is finite."""
    return None if values is None or not np.isfinite(values).any() else Spread.of(values)


@dataclass(frozen=True, slots=True)
class Innovation:
    """What of the ``size`` numbers observed the prior leaves over, in their unit.

    It is linearised at the estimate. ``nis`` is the normalised innovation squared; 95 % of such
    values lie in ``nis_band``. ``residual_rms`` is what the estimate itself leaves over.
    """

    size: int
    rms: float
    max_abs: float
    nis: float
    nis_band: tuple[float, float]
    residual_rms: float | None = None


@dataclass(frozen=True, slots=True)
class Alike:
    """Parameters ``(g,)`` that the data hardly tell apart, and changes of them that hardly show.

    Changes ``(g,)`` are in units of the parameters, and relative to their scales.
    """

    parameters: tuple[str, ...]
    changes: Vector
    relative: Vector
    correlation: float


@dataclass(frozen=True, slots=True)
class Identified:
    """What the data alone could tell at best: the Cramér-Rao bound ``(p,)``.

    None where they determine a parameter not at all; ``flat`` are combinations known badly.
    """

    cramer_rao_std: tuple[float | None, ...]
    condition_number: float | None
    flat: tuple[str, ...]
    confounded: tuple[Alike, ...] = ()
