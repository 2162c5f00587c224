"""An exponential tissue that is as stiff as a linear one where closed leaflets are."""

from __future__ import annotations

from dataclasses import fields, replace
from functools import lru_cache

import numpy as np

from mvest.mechanics.law.biaxial import biaxial_stress
from mvest.mechanics.law.biot import BiotLaw
from mvest.mechanics.law.exponential import ExponentialLaw
from mvest.mechanics.settings import ExponentialTissue, TissueSettings

CLOSED_STRETCHES = (1.0, 1.11)
"""Along the fibres and across them: the medians of closed leaflets (``results/law.md``)."""


def as_stiff(tissue: ExponentialTissue, linear: TissueSettings, E_f: float) -> ExponentialTissue:
    """The tissue with all stresses scaled to those of a linear one of modulus ``E_f`` MPa.

    At `CLOSED_STRETCHES` the stresses along and across the fibres then have the same mean.
    """
    factor = E_f * _scale(tissue, linear)
    exponents = {"c1", "c2"}
    return replace(
        tissue,
        **{
            each.name: factor * getattr(tissue, each.name)
            for each in fields(tissue)
            if each.name not in exponents
        },
    )


@lru_cache(maxsize=64)
def _scale(tissue: ExponentialTissue, linear: TissueSettings) -> float:
    """Factor on the tissue for a modulus of 1 MPa, to which all stresses are in proportion."""
    stretches = np.array([CLOSED_STRETCHES])
    wanted = biaxial_stress(BiotLaw.of([linear.moduli(1.0).material]), stretches).mean()
    return float(wanted / biaxial_stress(ExponentialLaw.of([tissue]), stretches).mean())
