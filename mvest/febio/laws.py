r"""The law of a region as a material of FEBio.

The linear law of this project is :math:`\tfrac12 \epsilon : C : \epsilon` of the Biot strain
(:mod:`mvest.mechanics.law.biot`). FEBio has no such law; two of its materials are offered.
Both have the same stiffness at rest.

``orthotropic``
    ``orthotropic elastic``: the same C, of the Green-Lagrange strain
    (:class:`mvest.mechanics.law.linear.LinearLaw`).
``neo-hookean``
    ``neo-Hookean transiso``: the same moduli in a neo-Hookean form.

The energy of the Biot strain itself cannot be written as one of FEBio's expressions: they end after
512 characters, and the trace of the stretch is a root of a quartic.

The exponential law (:mod:`mvest.mechanics.law.exponential`) becomes ``uncoupled trans-iso
hyperelastic`` with the same exponential; the stretch of its fibres is then the isochoric one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from mvest.errors import InputError
from mvest.mechanics.law.moduli import TransverselyIsotropic
from mvest.mechanics.settings import ExponentialTissue

LAWS = ("orthotropic", "neo-hookean")


@dataclass(frozen=True, slots=True)
class FebLaw:
    """A material of FEBio.

    Attributes
    ----------
    name : str
        Of its type.
    parameters : mapping
        Tag -> value.
    directed : str
        What carries the direction of the fibre: ``mat_axis`` or ``fiber``.
    """

    name: str
    parameters: Mapping[str, float | str]
    directed: str


def febio_law(
    tissue: TransverselyIsotropic | ExponentialTissue, kind: str = "orthotropic"
) -> FebLaw:
    """The material of FEBio for the tissue of one region.

    Parameters
    ----------
    tissue : TransverselyIsotropic or ExponentialTissue
    kind : str
        One of `LAWS`, for the linear law.

    Raises
    ------
    InputError
        For an unknown kind.
    """
    if kind not in LAWS:
        raise InputError(f"law {kind!r}, expected one of {', '.join(LAWS)}")
    if isinstance(tissue, ExponentialTissue):
        fibre = f"{tissue.c2!r}*H(sqrt(I4)-1)*(sqrt(I4)-1)^4"
        exponent = f"{tissue.c1!r}*(I1-3)^2+{fibre}"
        energy = f"{tissue.c0!r}*(exp({exponent})-1)+{tissue.mu / 2!r}*(I1-3)"
        # Pressure model 3 is kappa / 4 (J^2 - 1 - 2 ln J), as here.
        parameters: dict[str, float | str] = {"k": tissue.kappa, "pressure_model": 3, "W": energy}
        return FebLaw("uncoupled trans-iso hyperelastic", parameters, "fiber")
    if kind == "neo-hookean":
        names = {"Ep": tissue.E_p, "Ez": tissue.E_f, "vz": tissue.nu_fp, "vp": tissue.nu_pp,
                 "gz": tissue.G}  # fmt: skip
        return FebLaw("neo-Hookean transiso", names, "mat_axis")
    across = tissue.E_p / (2 * (1 + tissue.nu_pp))
    # v31 / E3 is the compliance that v13 / E1 is.
    names = {
        "E1": tissue.E_f, "E2": tissue.E_p, "E3": tissue.E_p,
        "G12": tissue.G, "G23": across, "G31": tissue.G,
        "v12": tissue.nu_fp, "v23": tissue.nu_pp, "v31": tissue.nu_fp * tissue.E_p / tissue.E_f,
    }  # fmt: skip
    return FebLaw("orthotropic elastic", names, "mat_axis")
