"""The elastic moduli of a leaflet, and the paper's one-parameter family."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from mvest.errors import MaterialError
from mvest.typing import FloatArray


class PoissonReading(Enum):
    """Interpretation of the paper's single Poisson ratio.

    LITERAL: the same ratio along and across the fibre. NEARLY_INCOMPRESSIBLE: uniaxial tension
    along and across the fibre changes the volume equally, ``nu_pp = 2 nu (1 - E_p / (2 E_f))``.
    """

    LITERAL = "A"
    NEARLY_INCOMPRESSIBLE = "C"


@dataclass(frozen=True, slots=True)
class TransverselyIsotropic:
    """Moduli of one region.

    Attributes
    ----------
    E_f, E_p : float
        Young's moduli along and across the fibre, MPa.
    G : float
        Shear modulus of planes that contain the fibre, MPa.
    nu_fp, nu_pp : float
        Poisson ratios: contraction across the fibre under tension along it, and within the plane
        across the fibre.
    compression : float
        Modulus along the fibre in compression over that in tension; 1 is the linear law. Below 1
        fibres carry tension only, and the rest is that of the matrix
        (:mod:`mvest.mechanics.law.biot`).
    toe : float
        Strain of the fibre at which it has its full modulus, if ``compression`` is below 1.

    Raises
    ------
    MaterialError
        ``compression`` is not in (0, 1], ``toe`` is not positive, or the elastic energy is not
        positive definite (Jones 1975, Mechanics of Composite Materials, section 2.4), which needs
        positive moduli, ``|nu_pp| < 1`` and ``1 - nu_pp - 2 nu_fp^2 E_p / E_f > 0``.
    """

    E_f: float
    E_p: float
    G: float
    nu_fp: float
    nu_pp: float
    compression: float = 1.0
    toe: float = 0.02

    def __post_init__(self) -> None:
        for name in ("E_f", "E_p", "G"):
            value = float(getattr(self, name))
            if not np.isfinite(value) or value <= 0:
                raise MaterialError(f"{name} = {value} MPa, expected > 0")
        if not (0 < self.compression <= 1 and 0 < self.toe < np.inf):
            raise MaterialError(
                f"compression = {self.compression} and toe = {self.toe} of the fibres, expected "
                "a share in (0, 1] and a strain > 0"
            )
        if not abs(self.nu_pp) < 1:
            raise MaterialError(f"nu_pp = {self.nu_pp}, expected -1 < nu_pp < 1")
        margin = 1 - self.nu_pp - 2 * self.nu_fp**2 * self.E_p / self.E_f
        if not margin > 0:
            raise MaterialError(
                f"not positive definite: 1 - nu_pp - 2 nu_fp^2 E_p/E_f = {margin:.4g}, "
                f"expected > 0 (E_f = {self.E_f}, E_p = {self.E_p} MPa, "
                f"nu_fp = {self.nu_fp}, nu_pp = {self.nu_pp})"
            )

    @classmethod
    def isotropic(cls, E: float, nu: float) -> TransverselyIsotropic:
        """Isotropic material with Young's modulus ``E`` (MPa) and Poisson ratio ``nu``."""
        if not -1 < nu < 0.5:
            raise MaterialError(f"nu = {nu}, expected -1 < nu < 0.5")
        return cls(E, E, E / (2 * (1 + nu)), nu, nu)

    @classmethod
    def from_ratio(
        cls, E_f: float, ratio: float, nu: float, reading: PoissonReading
    ) -> TransverselyIsotropic:
        """The paper's one-parameter family: ``E_p = E_f / ratio``, ``G = E_f / (2 (1 + nu))``."""
        if not np.isfinite(ratio) or ratio <= 0:
            raise MaterialError(f"E_f/E_p ratio = {ratio}, expected > 0")
        e_p = E_f / ratio
        literal = reading is PoissonReading.LITERAL
        nu_pp = nu if literal else 2 * nu * (1 - e_p / (2 * E_f))
        return cls(E_f, e_p, E_f / (2 * (1 + nu)), nu, nu_pp)

    @property
    def compliance(self) -> FloatArray:
        """``(6, 6)`` compliance in 1/MPa (engineering shear), axis 1 along the fibre."""
        s = np.zeros((6, 6))
        s[0, 0] = 1 / self.E_f
        s[1, 1] = s[2, 2] = 1 / self.E_p
        s[0, 1] = s[1, 0] = s[0, 2] = s[2, 0] = -self.nu_fp / self.E_f
        s[1, 2] = s[2, 1] = -self.nu_pp / self.E_p
        s[3, 3] = 2 * (1 + self.nu_pp) / self.E_p
        s[4, 4] = s[5, 5] = 1 / self.G
        return s

    @property
    def stiffness(self) -> FloatArray:
        """``(6, 6)`` stiffness C in MPa, the inverse of the compliance, symmetrised."""
        c = np.linalg.inv(self.compliance)
        return 0.5 * (c + c.T)

    @property
    def tension_only(self) -> float:
        """The part of ``E_f`` (MPa) that the fibres have in tension only."""
        return (1 - self.compression) * self.E_f
