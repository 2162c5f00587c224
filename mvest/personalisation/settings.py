"""Settings of a personalisation: unknowns with priors, mesh, filter and sources of error."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from mvest.cases.case import ValveCase
from mvest.closure.frames import ERROR, OFFSET, is_frame_pressure
from mvest.errors import InputError
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
"""Prefix of unknowns that say how much the tissue of a leaflet stiffens."""


PACKAGE = "package"
"""Setting that stands for the calibrations of the package."""


@dataclass(frozen=True, slots=True)
class Prior:
    """The prior of one unknown of a case."""

    #: A parameter of the mechanics (:data:`mvest.mechanics.parameters.KINDS`) such as
    #: ``E_f.REGION`` (MPa), or ``shift.x`` ... (mm), or ``turn.x`` ... (degrees).
    name: str
    mean: float  #: in the unit of the parameter
    std: float  #: in the same unit
    fixed: bool = False  #: whether it is fixed at its mean instead of estimated

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
        """Whether it is a modulus and not a nuisance."""
        return self.name.startswith("E_f.")

    @property
    def is_positive(self) -> bool:
        """Whether its logarithm is estimated."""
        displaces = self.name in REGISTRATION or is_frame_pressure(self.name)
        return not displaces and is_positive(self.name)


@dataclass(frozen=True, slots=True)
class PressureErrors:
    """Errors of the stated pressures of several closed frames, besides a common factor.

    With one closed frame the prior of the factor (``pressure_scale``) covers them.
    """

    #: Standard deviation of a common offset, for example of the zero of the measurement from left
    #: atrial pressure; 0: none.
    offset_mmHg: PressureError = 5.0
    #: Standard deviation of the independent error of each frame, for example on a steep part of the
    #: pressure curve; 0: none.
    each_mmHg: PressureError = 5.0

    def unknowns(self, frames: Iterable[str]) -> tuple[Prior, ...]:
        """The unknown errors of the pressures of these frames."""
        stds = {OFFSET: self.offset_mmHg}
        stds |= {f"{ERROR}.{frame}": self.each_mmHg for frame in frames}
        return tuple(Prior(name, 0.0, std) for name, std in stds.items() if std)


EXTRAPOLATION_STD = 0.5
"""Of an extrapolated error of the mesh, relative. A choice: by the observed orders of 1.8 to 2.5
(``experiment=mesh_independence``) the error is up to a third larger or smaller, and the guide is
coarse."""


@dataclass(frozen=True, slots=True)
class CaseMesh:
    """Meshes of a case."""

    #: ``structured``: layers of cells in material coordinates; ``automatic``: these, with columns
    #: rounded up to as many for each leaflet; ``tetwild``: an unstructured mesh of the thickened
    #: leaflets.
    source: str = "automatic"
    columns: CellsAround = 40  #: cells of a structured mesh
    rows: CellsAlong = 5  #: cells of a structured mesh
    #: Cells of the coarser mesh on which errors of law and mesh are computed.
    guide_columns: CellsAround = 24
    guide_rows: CellsAlong = 3
    edge_length: EdgeLength = 2.5  #: mm, of an unstructured mesh
    contact_columns: PointsAround = 144  #: sample points of contact
    contact_rows: PointsAlong = 32  #: sample points of contact

    @property
    def expected_error(self) -> float:
        """Expected error of the mesh as a share of its difference from the guide mesh.

        Richardson extrapolation of second order (Phil. Trans. R. Soc. A 210:307, 1911); 0 for an
        unstructured mesh, which does not refine the guide.
        """
        finer = self.columns / self.guide_columns
        return 1.0 / (finer**2 - 1.0) if self.source != "tetwild" and finer > 1.0 else 0.0

    @property
    def error_std(self) -> float:
        """Standard deviation of the expected error; the difference for an unstructured mesh."""
        return 1.0 if self.source == "tetwild" else EXTRAPOLATION_STD * self.expected_error

    def __post_init__(self) -> None:
        if self.source not in ("automatic", "structured", "tetwild"):
            raise InputError(
                f"mesh source {self.source!r}, expected automatic, structured or tetwild"
            )


@dataclass(frozen=True, slots=True)
class PaperSettings:
    """The paper's filter for the moduli alone, without nuisances."""

    P0: Value = 0.01  #: MPa², variance of the prior
    Q: Value = 0.01  #: MPa², variance of the process
    R: Value = 0.01  #: mm², variance of an observed coordinate
    max_iterations: Count = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseChoices:
    """Settings of a personalisation other than unknowns and mechanics."""

    mesh: CaseMesh = field(default_factory=CaseMesh)
    tolerance: Tolerance = 2e-3  #: of the filter, relative
    max_iterations: Count = 15
    #: Of a parameter's logarithm between equilibria (`mvest.closure.model.ClosureModel`).
    largest_change: Logarithm = 0.2
    paper: PaperSettings | None = None  #: also estimate the moduli with the paper's filter
    moduli_only: bool = False  #: also estimate the moduli with all nuisances fixed
    confirm: bool = False  #: close the fitted valve anew from the open state, for comparison
    #: How well the stated errors are known; they are learned with the unknowns. None: exactly.
    errors: ErrorBeliefs | None = field(default_factory=ErrorBeliefs)
    #: Uncertainty of the model's geometry, which widens the intervals. None: no uncertainty.
    nuisance_geometry: NuisanceGeometry | None = None
    #: Leaflet -> another law that its tissue may follow, which widens the intervals. Empty: the
    #: linear law is right.
    nuisance_law: dict[str, ExponentialTissue] = field(default_factory=dict)
    #: The calibration of the moduli (`mvest.personalisation.calibration`): ``package``, a file, or
    #: None for none.
    calibration: str | None = None
    #: Errors of the pressures of several fitted closed frames. None: only the common factor, if
    #: that is an unknown.
    pressures: PressureErrors | None = None


@dataclass(frozen=True, slots=True)
class PersonaliseSettings(CaseChoices):
    """Settings of a personalisation."""

    unknowns: tuple[Prior, ...]  #: the means of the moduli are the generic values
    mechanics: MechanicsSettings  #: the closed frame's pressure replaces that of the protocol

    def __post_init__(self) -> None:
        IteratedFilter(self.tolerance, max_iterations=self.max_iterations)  # checks both
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
    """Replace the linear law of leaflets whose stiffening is unknown by a law in between.

    The unknown leads from the linear law to that of `PersonaliseSettings.nuisance_law`.

    InputError if there is no such leaflet or no such law, or its tissue is not linear.
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
                f"unknown {unknown.name}: nuisance_law.{region} is missing, the law of fully "
                "stiffened tissue"
            )
        tissue[region] = replace(tissue[region], law="stiffening", exponential=laws.pop(region))
    mechanics = replace(settings.mechanics, tissue=tissue)
    return replace(settings, mechanics=mechanics, nuisance_law=laws)


CUFF = 0.15
"""Relative standard deviation of a pressure from a cuff and Doppler."""

CURVES = {
    "anterior": ExponentialTissue(0.06, 4.325, 1446.5),
    "posterior": ExponentialTissue(0.04, 4.848, 305.4),
}
"""Exponents of May-Newman and Yin 1998 as usually quoted; the scale does not matter."""


def default_settings(case: ValveCase) -> PersonaliseSettings:
    """Settings that suit the source of a case: surfaces, or a volume with error samples.

    Moduli are in MPa, displacements in mm and degrees. The case must have an anterior and a
    posterior leaflet.
    """
    # Leaflets, annulus and tips of one volume are not displaced against each other, and the error
    # samples contain their errors.
    from_volume = case.error_samples is not None
    unknowns = (
        Prior("E_f.anterior", 6.23, 3.1),
        Prior("E_f.posterior", 2.09, 1.05),
        Prior("pressure_scale", 1.0, CUFF),
        Prior("chord_stiffness", 1.0, 0.2),
        Prior("chord_rest_length", 1.0, 0.02),
        *(
            Prior(name, 0.0, 1.0 if name.startswith("shift") else 2.0, from_volume)
            for name in REGISTRATION
        ),
    )
    ratios = {"anterior": 6.23 / 2.35, "posterior": 2.09 / 1.89}
    surfaces = PersonaliseSettings(
        unknowns,
        MechanicsSettings(
            {region: TissueSettings(ratio) for region, ratio in ratios.items()},
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
        calibration=PACKAGE,
    )
    if not from_volume:
        return surfaces
    return replace(
        surfaces,
        errors=ErrorBeliefs(resolution_mm=0.3),
        nuisance_geometry=NuisanceGeometry(
            shape_mm=0.0, annulus_mm=0.0, tips_mm=0.0, frame_scale=0.02, rest_lengths=0.04
        ),
        nuisance_law={},
    )
