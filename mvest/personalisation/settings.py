"""How a case is personalised: what is unknown of it, and what it is computed on."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from mvest.cases.case import ValveCase
from mvest.closure.frames import ERROR, OFFSET, is_frame_pressure
from mvest.errors import InputError, require_numbers
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.mechanics.parameters import is_positive
from mvest.mechanics.settings import ExponentialTissue, MechanicsSettings, TissueSettings
from mvest.mechanics.steps import NewtonSettings
from mvest.observation.learned import ErrorBeliefs
from mvest.personalisation.geometry import NuisanceGeometry
from mvest.problem.registration import REGISTRATION
from mvest.quantities import (
    CellsAlong,
    CellsAround,
    Count,
    EdgeLength,
    Logarithm,
    PointsAlong,
    PointsAround,
    PressureError,
    Tolerance,
    Value,
)

STIFFENS = "stiffening."
"""How the names of unknowns begin that say how far a leaflet's tissue stiffens."""


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known beforehand of one unknown of a case.

    Attributes
    ----------
    name : str
        One of the mechanics' (:data:`mvest.mechanics.parameters.KINDS`): ``E_f.REGION`` (MPa),
        ``pressure_scale`` (a factor) ..., or ``shift.x`` ... (mm) or ``turn.x`` ... (degrees).
    mean, std : float
        In the same unit.
    fixed : bool
        Whether it is fixed at its mean instead of estimated.
    """

    name: str
    mean: float
    std: float
    fixed: bool = False

    def __post_init__(self) -> None:
        if not (np.isfinite(self.mean) and np.isfinite(self.std) and self.std > 0):
            raise InputError(
                f"prior of {self.name}: mean {self.mean} and std {self.std}, expected finite "
                f"numbers and std > 0"
            )
        if self.is_positive and self.mean <= 0:
            raise InputError(f"prior of {self.name}: mean {self.mean}, expected > 0")

    @property
    def is_modulus(self) -> bool:
        """Whether it is what is asked for, and not a nuisance."""
        return self.name.startswith("E_f.")

    @property
    def is_positive(self) -> bool:
        """Whether it is estimated by its logarithm."""
        if self.name in REGISTRATION or is_frame_pressure(self.name):
            return False
        return is_positive(self.name)


@dataclass(frozen=True, slots=True)
class PressureErrors:
    """How well the stated pressures of several closed frames are known, besides a common factor.

    With one closed frame they and the factor (``pressure_scale``) are one and the same, and the
    factor's prior stands for all.

    Attributes
    ----------
    offset_mmHg : float
        Standard deviation of an offset that all of them have, as where the zero of a measurement
        is not that of the left atrium; 0: none.
    each_mmHg : float
        Of the error that each has for itself, as where a frame falls on a steep part of the curve
        that its pressure is read from; 0: none.
    """

    offset_mmHg: PressureError = 5.0
    each_mmHg: PressureError = 5.0

    def __post_init__(self) -> None:
        require_numbers(self, "pressures", "offset_mmHg", "each_mmHg", least=0)

    def unknowns(self, frames: Iterable[str]) -> tuple[Prior, ...]:
        """What is not known of the pressures of these frames."""
        stds = {OFFSET: self.offset_mmHg}
        stds |= {f"{ERROR}.{frame}": self.each_mmHg for frame in frames}
        return tuple(Prior(name, 0.0, std) for name, std in stds.items() if std)


@dataclass(frozen=True, slots=True)
class CaseMesh:
    """What a case is computed on.

    Attributes
    ----------
    source : str
        ``structured``: layers of cells in material coordinates (two leaflets only); ``tetwild``: an
        unstructured mesh of the thickened leaflets; ``automatic``: the first where there are two
        leaflets, otherwise the second.
    columns, rows : int
        Cells of a structured mesh.
    guide_columns, guide_rows : int
        Cells of the coarser mesh on which the first closure is followed.
    edge_length : float
        mm, of an unstructured mesh.
    contact_columns, contact_rows : int
        Samples of contact.
    """

    source: str = "automatic"
    columns: CellsAround = 40
    rows: CellsAlong = 5
    guide_columns: CellsAround = 24
    guide_rows: CellsAlong = 3
    edge_length: EdgeLength = 2.5
    contact_columns: PointsAround = 144
    contact_rows: PointsAlong = 32

    @property
    def error_share(self) -> float:
        """Share of its difference from the mesh of the guide by which a mesh is off.

        Of a structured one by the extrapolation of Richardson for errors of second order; of an
        unstructured one, which is no refinement of the guide, all of it.
        """
        if self.source != "tetwild":
            finer = self.columns / self.guide_columns
            return 1.0 / (finer**2 - 1.0) if finer > 1.0 else 0.0
        return 1.0

    def __post_init__(self) -> None:
        if self.source not in ("automatic", "structured", "tetwild"):
            raise InputError(
                f"mesh source {self.source!r}, expected automatic, structured or tetwild"
            )


@dataclass(frozen=True, slots=True)
class PaperSettings:
    """The paper's filter, which knows of no nuisance: all in MPa² and mm².

    Attributes
    ----------
    P0, Q, R : float
        Variances of the prior and of the process, and of a coordinate as seen.
    max_iterations : int
    """

    P0: Value = 0.01
    Q: Value = 0.01
    R: Value = 0.01
    max_iterations: Count = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseChoices:
    """How a case is personalised, but for its unknowns and its mechanics.

    Attributes
    ----------
    mesh : CaseMesh
    tolerance : float
        Of the filter, relative.
    max_iterations : int
    largest_change : float
        Of a parameter's logarithm from one equilibrium to the next, see
        :class:`mvest.closure.model.ClosureModel`.
    paper : PaperSettings or None
        Whether the moduli are also estimated as the paper does it.
    moduli_only : bool
        Whether they are also estimated with all nuisances fixed, but otherwise as here.
    confirm : bool
        Whether the fitted valve is closed anew from the open one.
    correspondence : bool
        Whether corresponding vertices are used as such; otherwise only where the surface is.
    errors : ErrorBeliefs or None
        How well the errors are known that the case states: they are learned with the unknowns;
        None takes them as they are stated.
    nuisance_geometry : NuisanceGeometry or None
        How well the geometry is known that the model is built from: what is not counts as an error
        of the observation. None takes it as it was seen.
    nuisance_law : dict of str to ExponentialTissue
        Leaflet -> another law that its tissue may follow: what it would do to the prediction counts
        as an error of the observation. Empty: the linear law is taken to be right.
    pressures : PressureErrors or None
        How well stated pressures are known where several closed frames are fitted; None: each of
        them but for the common factor, if that is an unknown.
    """

    mesh: CaseMesh = field(default_factory=CaseMesh)
    tolerance: Tolerance = 2e-3
    max_iterations: Count = 15
    largest_change: Logarithm = 0.2
    paper: PaperSettings | None = None
    moduli_only: bool = False
    confirm: bool = False
    correspondence: bool = True
    errors: ErrorBeliefs | None = field(default_factory=ErrorBeliefs)
    nuisance_geometry: NuisanceGeometry | None = None
    nuisance_law: dict[str, ExponentialTissue] = field(default_factory=dict)
    pressures: PressureErrors | None = None


@dataclass(frozen=True, slots=True)
class PersonaliseSettings(CaseChoices):
    """How a case is personalised.

    Attributes
    ----------
    unknowns : tuple of Prior
        The means of the moduli are the generic ones.
    mechanics : MechanicsSettings
        The pressure of its protocol is replaced by that of the closed frame.
    """

    unknowns: tuple[Prior, ...]
    mechanics: MechanicsSettings

    def __post_init__(self) -> None:
        IteratedFilter(self.tolerance, max_iterations=self.max_iterations)  # refuses what is none
        names = [unknown.name for unknown in self.unknowns]
        if len(set(names)) != len(names):
            raise InputError(f"unknowns {', '.join(names)} are not all different")
        for u in self.unknowns:
            if u.name in REGISTRATION and u.fixed and u.mean != 0:
                raise InputError(
                    f"unknown {u.name} is fixed at {u.mean}; expected 0, or a displacement that is "
                    "estimated"
                )
        if not any(u.is_modulus and not u.fixed for u in self.unknowns):
            raise InputError(
                f"unknowns {', '.join(names) or '(none)'}: expected at least one modulus "
                "E_f.REGION that is estimated"
            )


def with_stiffening(settings: PersonaliseSettings) -> PersonaliseSettings:
    """The settings where tissue whose stiffening is an unknown is on its way to another law.

    That law is the one that would be considered otherwise (`PersonaliseSettings.nuisance_law`).

    Raises
    ------
    InputError
        If there is no such leaflet or no such law, or its tissue is not linear.
    """
    tissue, laws = dict(settings.mechanics.tissue), dict(settings.nuisance_law)
    for unknown in settings.unknowns:
        if not unknown.name.startswith(STIFFENS):
            continue
        region = unknown.name.removeprefix(STIFFENS)
        if region not in tissue or tissue[region].law != "biot":
            own = f"follows the {tissue[region].law} law" if region in tissue else "has no tissue"
            raise InputError(
                f"unknown {unknown.name}: {region} {own}, expected the linear one (biot)"
            )
        if region not in laws:
            raise InputError(
                f"unknown {unknown.name}: nuisance_law.{region} is missing, the law that the "
                "tissue is on its way to"
            )
        tissue[region] = replace(tissue[region], law="stiffening", exponential=laws.pop(region))
    mechanics = replace(settings.mechanics, tissue=tissue)
    return replace(settings, mechanics=mechanics, nuisance_law=laws)


UNKNOWNS = (
    Prior("E_f.anterior", 6.23, 3.1),
    Prior("E_f.posterior", 2.09, 1.05),
    Prior("pressure_scale", 1.0, 0.1),
    Prior("chord_stiffness", 1.0, 0.2),
    Prior("chord_rest_length", 1.0, 0.02),
    *(Prior(name, 0.0, 1.0 if name.startswith("shift") else 2.0) for name in REGISTRATION),
)
"""Priors; moduli in MPa, displacements in mm and degrees."""

CUFF = 0.15
"""Relative standard deviation of a pressure from a cuff and Doppler."""

CURVES = {
    "anterior": ExponentialTissue(0.06, 4.325, 1446.5),
    "posterior": ExponentialTissue(0.04, 4.848, 305.4),
}
"""Exponents of May-Newman and Yin 1998 as usually quoted; the scale does not matter."""


def default_settings(case: ValveCase) -> PersonaliseSettings:
    """The settings that fit where a case is from: surfaces, or a volume with its error samples.

    Parameters
    ----------
    case : ValveCase
        With an anterior and a posterior leaflet.
    """
    surfaces = PersonaliseSettings(
        tuple(
            replace(unknown, std=CUFF) if unknown.name == "pressure_scale" else unknown
            for unknown in UNKNOWNS
        ),
        MechanicsSettings(
            {
                "anterior": TissueSettings(6.23 / 2.35),
                "posterior": TissueSettings(2.09 / 1.89),
            },
            newton=NewtonSettings(max_halvings=3),
        ),
        moduli_only=True,
        confirm=True,
        errors=ErrorBeliefs(resolution_mm=0.1),
        nuisance_geometry=NuisanceGeometry(
            leaflet_scale=0.03,
            annulus_scale=0.02,
            frame_scale=0.02,
            rest_lengths=0.06,
            thickness=0.2,
            share=0.98,
            renewals=6,
        ),
        nuisance_law=CURVES,
        pressures=PressureErrors(),
    )
    if case.error_samples is None:
        return surfaces
    # Leaflets, annulus and tips come from one volume: nothing is displaced against anything else,
    # and their errors are in the samples.
    return replace(
        surfaces,
        unknowns=tuple(
            replace(unknown, fixed=True) if unknown.name in REGISTRATION else unknown
            for unknown in UNKNOWNS
        ),
        errors=ErrorBeliefs(resolution_mm=0.3),
        nuisance_geometry=NuisanceGeometry(
            shape_mm=0.0, annulus_mm=0.0, tips_mm=0.0, frame_scale=0.02, rest_lengths=0.04
        ),
        nuisance_law={},
    )
