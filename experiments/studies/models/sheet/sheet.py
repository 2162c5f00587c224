"""A thin sheet, clamped at three of its sides and pressed from below: what both codes are given.

The sheet occupies ``[0, length] x [0, width] x [0, thickness]``. The sides x = 0, y = 0 and
y = width are clamped, the side x = length is free, as a leaflet hangs on its annulus and ends in a
free edge. Two regions, before and behind the middle of the length, have a Young's modulus each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.estimation.prediction import Prediction
from mvest.typing import FloatArray
from mvest.units import mmhg_to_mpa

__all__ = ["PARAMETERS", "Sheet", "inadmissible"]

PARAMETERS = ("E.annulus", "E.edge")
"""Young's moduli in MPa of the half beside the clamped side and of the half with the free edge."""


@dataclass(frozen=True, slots=True)
class Sheet:
    """The sheet, its load, its mesh and where it is looked at.

    Attributes
    ----------
    length, width, thickness : float
        mm.
    poisson : float
        Of both regions.
    pressure_mmHg : float
        On the lower face, following it as it turns.
    cells : (int, int)
        Along length and width. The first is even, so that the regions meet between cells.
    layers : int
        Cells through the thickness.
    observed : (int, int)
        Observed points of the midsurface along length and width.
    load_steps : int
        Equal steps in which the pressure rises.
    """

    length: float = 24.0
    width: float = 16.0
    thickness: float = 1.0
    poisson: float = 0.45
    pressure_mmHg: float = 120.0
    cells: tuple[int, int] = (8, 6)
    layers: int = 1
    observed: tuple[int, int] = (8, 7)
    load_steps: int = 4

    def __post_init__(self) -> None:
        for name in ("length", "width", "thickness"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"sheet {name} = {value} mm, expected > 0")
        if not -1 < self.poisson < 0.5:
            raise InputError(f"sheet poisson = {self.poisson}, expected -1 < poisson < 0.5")
        if not np.isfinite(self.pressure_mmHg):
            raise InputError(f"sheet pressure_mmHg = {self.pressure_mmHg}, expected a number")
        if len(self.cells) != 2 or min(self.cells) < 1 or self.cells[0] % 2:
            raise InputError(f"sheet cells = {self.cells}, expected two > 0, the first even")
        if len(self.observed) != 2 or min(self.observed) < 1:
            raise InputError(f"sheet observed = {self.observed}, expected two > 0")
        for name in ("layers", "load_steps"):
            if getattr(self, name) < 1:
                raise InputError(f"sheet {name} = {getattr(self, name)}, expected at least 1")

    @property
    def pressure(self) -> float:
        """MPa."""
        return mmhg_to_mpa(self.pressure_mmHg)

    @property
    def points(self) -> FloatArray:
        """Observed points of the midsurface ``(n, 3)`` mm, none of them on a clamped side."""
        x = np.linspace(0.0, self.length, self.observed[0] + 1)[1:]
        y = np.linspace(0.0, self.width, self.observed[1] + 2)[1:-1]
        grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        return np.column_stack([grid, np.full(len(grid), 0.5 * self.thickness)])


def inadmissible(moduli: FloatArray) -> Prediction | None:
    """The failed prediction for moduli that belong to no elastic solid; None where they may."""
    if moduli.shape != (2,):
        raise InputError(f"{moduli.size} moduli of the sheet, expected 2")
    if np.all(np.isfinite(moduli)) and np.all(moduli > 0):
        return None
    return Prediction.failed(
        ", ".join(f"{n} = {v:g} MPa" for n, v in zip(PARAMETERS, moduli, strict=True))
        + ": expected positive moduli"
    )
