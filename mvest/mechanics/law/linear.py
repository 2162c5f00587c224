"""The law that is linear in the strain it is given."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.law.moduli import LeafletModuli, TransverselyIsotropic
from mvest.mechanics.parameters import Parameter, known_names
from mvest.typing import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class LinearLaw:
    """Stress ``C : (e + rate (e - e_n))`` of the strain e that it is given.

    Of the Green-Lagrange strain it is St. Venant's law, FEBio's ``orthotropic elastic``. Of the
    linear strain in the turned frame of the element (`mvest.mechanics.law.corotational`) the second
    Piola-Kirchhoff stress is the stress in that frame.

    Attributes
    ----------
    stiffness : ndarray
        ``(n_regions, 6, 6)`` MPa.
    moduli : tuple of LeafletModuli
        What the stiffness was made of, one per region; empty where it is only known itself, and
        there is nothing to differentiate by.
    corotational : bool
        Whether the strain is the linear one in the turned frame.
    """

    stiffness: FloatArray
    moduli: tuple[LeafletModuli, ...] = ()
    corotational: bool = False

    @classmethod
    def of(cls, materials: Sequence[TransverselyIsotropic]) -> LinearLaw:
        """The law with one material per region."""
        return cls(np.array([m.stiffness for m in materials]))

    @classmethod
    def of_moduli(cls, moduli: Sequence[LeafletModuli], *, corotational: bool) -> LinearLaw:
        """The law with the moduli of each region; MaterialError if some are inadmissible."""
        law = cls.of([m.material for m in moduli])
        return cls(law.stiffness, tuple(moduli), corotational)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The parameters that the law knows."""
        return ("E_f", "ratio", "G") if self.moduli else ()

    def strain(self, green: FloatArray) -> FloatArray:
        """The strain itself."""
        return green

    def response(
        self, green: FloatArray, region: IntArray, previous: FloatArray, rate: float
    ) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)`` MPa."""
        tangent = np.repeat((1 + rate) * self.stiffness[region, None], green.shape[1], axis=1)
        return self._stress(self.stiffness[region], green, previous, rate), tangent

    @staticmethod
    def _stress(
        stiffness: FloatArray, strain: FloatArray, previous: FloatArray, rate: float
    ) -> FloatArray:
        return np.einsum("eij,eqj->eqi", stiffness, (1 + rate) * strain - rate * previous)

    def partial_stress(
        self,
        parameter: Parameter,
        green: FloatArray,
        region: IntArray,
        previous: FloatArray,
        rate: float,
        *,
        which: int,
        stress: FloatArray,
    ) -> FloatArray:
        """Derivative of the stress by a parameter of region ``which``; InputError if of no use."""
        if parameter.kind not in self.kinds:
            raise InputError(
                f"parameter {parameter.name!r}: the law of the leaflets knows "
                f"{known_names(self.kinds)}"
            )
        by = np.zeros_like(self.stiffness)
        by[which] = self.moduli[which].stiffness_by(parameter.kind)
        return self._stress(by[region], green, previous, rate)

    def history_stress(
        self, green: FloatArray, region: IntArray, d_previous: FloatArray, rate: float
    ) -> FloatArray:
        """Change of the stress for a change of the previous strain: ``-rate C d``."""
        return -rate * np.einsum("eij,eqj->eqi", self.stiffness[region], d_previous)

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """The change of the strain itself."""
        return d_green
