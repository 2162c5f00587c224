"""Findings of the sheet in two finite-element codes, with p moduli in MPa."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from experiments.common.records.findings import Rows, Vector
from experiments.studies.models.sheet.sheet import Sheet

__all__ = ["Apart", "Difference", "Findings", "Row"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What one model estimates, ``(p,)`` and its iterates ``(i, p)``, from the data of one code.

    The residual is the root mean square; ``program_runs`` is None unless the model is a program.
    """

    data: str
    model: str
    converged: bool
    reason: str
    estimate: Vector
    std: Vector
    relative_error: Vector
    residual_mm: float | None
    iterations: int
    forward_solves: int
    program_runs: int | None
    seconds: float
    iterates: Rows


@dataclass(frozen=True, slots=True)
class Apart:
    """How far apart two predictions are: points in mm, derivatives relative to their size."""

    rms_mm: float
    max_mm: float
    derivatives: float


@dataclass(frozen=True, slots=True)
class Difference:
    """How far others are from scikit-fem with the Biot law on one mesh; None where one failed.

    Cells ``(3,)`` are along, across and through the thickness; ``hex18`` and ``hex27`` this
    project's solid-shells and triquadratic bricks, the last scikit-fem with another law.
    """

    cells: tuple[int, ...]
    hex18: Apart | None
    hex27: Apart | None
    st_venant_kirchhoff: Apart | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Findings:
    """What the codes differ by, and what each estimates.

    Attributes
    ----------
    truth : (p,)
    noise_mm : float
        Standard deviation of an observed coordinate.
    rows, differences : tuple
        Empty if a code gave no data, as the shapes.
    shapes : mapping
        Code -> observed points ``(n, 3)`` mm.
    sheet : Sheet
    library : mapping
        Package -> version.
    seconds : float
        Of all estimates.
    """

    truth: Vector
    noise_mm: float
    rows: tuple[Row, ...]
    differences: tuple[Difference, ...]
    shapes: Mapping[str, Rows]
    sheet: Sheet
    library: Mapping[str, str | None]
    seconds: float
