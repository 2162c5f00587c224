"""A body whose regions follow different laws."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mvest.errors import InputError
from mvest.mechanics.parameters import Parameter, known_names
from mvest.mechanics.solid import Law
from mvest.typing import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class RegionalLaw:
    """Each element follows the law of its region; the strain that is damped is that law's.

    Attributes
    ----------
    laws : tuple of Law
        One per region, each of a body of one region.
    region : ndarray
        ``(e,)`` of the elements, which laws do not know when they are asked for a strain.
    """

    laws: tuple[Law, ...]
    region: IntArray

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of parameters that any of the laws knows."""
        return tuple(dict.fromkeys(kind for law in self.laws for kind in law.kinds))

    def strain(self, green: FloatArray) -> FloatArray:
        """Strain measures ``(e, q, 6)``."""
        out = np.empty_like(green)
        for law, own, _ in self._parts():
            out[own] = law.strain(green[own])
        return out

    def response(
        self, green: FloatArray, region: IntArray, previous: FloatArray, rate: float
    ) -> tuple[FloatArray, FloatArray]:
        """Stress ``(e, q, 6)`` and tangent ``(e, q, 6, 6)`` MPa."""
        stress, tangent = np.empty_like(green), np.empty((*green.shape, 6))
        for law, own, first in self._parts():
            stress[own], tangent[own] = law.response(green[own], first, previous[own], rate)
        return stress, tangent

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
        """Derivative of the stress; see :meth:`mvest.mechanics.law.biot.BiotLaw.partial_stress`."""
        law = self.laws[which]
        if parameter.kind not in law.kinds:
            raise InputError(
                f"parameter {parameter.name!r}: the law of this region knows "
                f"{known_names(law.kinds)}"
            )
        out, own = np.zeros_like(green), self.region == which
        first = np.zeros(int(own.sum()), dtype=np.int64)
        out[own] = law.partial_stress(
            parameter, green[own], first, previous[own], rate, which=0, stress=stress[own]
        )
        return out

    def history_stress(
        self, green: FloatArray, region: IntArray, d_previous: FloatArray, rate: float
    ) -> FloatArray:
        """Change of the stress for a change of the previous strain measures."""
        out = np.empty_like(green)
        for law, own, first in self._parts():
            out[own] = law.history_stress(green[own], first, d_previous[own], rate)
        return out

    def strain_change(self, green: FloatArray, d_green: FloatArray) -> FloatArray:
        """Change of the strain measures for a change of the Green-Lagrange strain."""
        out = np.empty_like(green)
        for law, own, _ in self._parts():
            out[own] = law.strain_change(green[own], d_green[own])
        return out

    def _parts(self) -> Iterator[tuple[Law, IntArray, IntArray]]:
        """Each law with its elements and their region in a body of their own."""
        for k, law in enumerate(self.laws):
            own = np.flatnonzero(self.region == k)
            yield law, own, np.zeros_like(own)
