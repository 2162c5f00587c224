"""From a case to its moduli: the generic valve, the personalised one, and what is known of both.

The chain of one case. The model is built from the reference frame, its chordae and the tracked
boundary. What is not known besides the moduli (pressure, rest lengths and stiffness of the chordae,
a rigid displacement between the tracked boundary and the leaflets) is estimated with a prior, or
considered, or left fixed, as each unknown says. Frames that are held out are predicted, never
shown.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mvest.cases.case import Frame, Role, ValveCase
from mvest.errors import GeometryError, InputError
from mvest.estimation import (
    Filter,
    Gaussian,
    IteratedFilter,
    Log,
    PaperFilter,
    Prediction,
    SchmidtFilter,
    kalman_update,
    observation_noise,
)
from mvest.estimation.transform import to_filter
from mvest.mechanics.settings import MechanicsSettings
from mvest.mechanics.valve_system import HeldState
from mvest.model import ClosureModel
from mvest.observation import Observation
from mvest.observation_errors import SpatialCorrelation
from mvest.registration import REGISTRATION, RegisteredModel
from mvest.study import Case, Observed, SharedStart, StudyResult, estimate
from mvest.surface_observation import (
    UNKNOWN,
    ObservedSurface,
    PredictedSurface,
    SurfaceObservation,
    surface_distance,
)
from mvest.typing import BoolArray, FloatArray, IntArray
from mvest.valve.anatomy import Valve
from mvest.valve.band import Band
from mvest.valve.mesh import SolidMesh
from mvest.valve.structured import structured_mesh
from mvest.valve.tetrahedral_leaflets import tetrahedral_leaflets
from mvest.valve.tetrahedralize import TetwildSettings

__all__ = [
    "CaseMesh",
    "FrameDistance",
    "PaperSettings",
    "PersonaliseSettings",
    "Personalised",
    "Treatment",
    "Unknown",
    "build_model",
    "personalise",
]

FACTORS = ("pressure_scale", "chord_stiffness", "chord_rest_length")
"""Unknowns of the whole valve that act on its closure."""

BORDER = 3.0
"""Standard deviations from the border of the leaflets within which points are not compared."""

MOST_VERTICES = 2000
"""Vertices of a frame that are compared: more, nearer to each other than errors are alike, say
nothing new, and their correlation is factorised."""

OnStep = Callable[[float, int], None]


class Treatment(Enum):
    """What becomes of an unknown: estimated, considered (its doubt counts), or fixed."""

    ESTIMATED = "estimated"
    CONSIDERED = "considered"
    FIXED = "fixed"


@dataclass(frozen=True, slots=True)
class Unknown:
    """One quantity that is not known of a case.

    Attributes
    ----------
    name : str
        ``E_f.REGION`` (MPa), ``pressure_scale``, ``chord_stiffness``, ``chord_rest_length``
        (factors), ``shift.x`` ... (mm) or ``turn.x`` ... (degrees).
    mean, std : float
        Prior in the same unit.
    treatment : Treatment
    """

    name: str
    mean: float
    std: float
    treatment: Treatment = Treatment.ESTIMATED

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
        return self.name not in REGISTRATION


@dataclass(frozen=True, slots=True)
class CaseMesh:
    """What a case is computed on.

    Attributes
    ----------
    source : str
        ``structured``: layers of cells in material coordinates (two leaflets only); ``tetwild``: an
        unstructured mesh of the thickened leaflets.
    columns, rows : int
        Cells of a structured mesh.
    guide_columns, guide_rows : int
        Cells of the coarser mesh on which the first closure is followed.
    edge_length : float
        mm, of an unstructured mesh.
    contact_columns, contact_rows : int
        Samples of contact.
    """

    source: str = "structured"
    columns: int = 40
    rows: int = 5
    guide_columns: int = 24
    guide_rows: int = 3
    edge_length: float = 2.5
    contact_columns: int = 144
    contact_rows: int = 32

    def __post_init__(self) -> None:
        if self.source not in ("structured", "tetwild"):
            raise InputError(f"mesh source {self.source!r}, expected structured or tetwild")


@dataclass(frozen=True, slots=True)
class PaperSettings:
    """The paper's filter, which knows of no nuisance: all in MPa² and mm².

    Attributes
    ----------
    P0, Q, R : float
        Variances of the prior and of the process, and of a coordinate as seen.
    max_iterations : int
    """

    P0: float = 0.01
    Q: float = 0.01
    R: float = 0.01
    max_iterations: int = 12


@dataclass(frozen=True, slots=True)
class PersonaliseSettings:
    """How a case is personalised.

    Attributes
    ----------
    unknowns : tuple of Unknown
        The means of the moduli are the generic ones.
    mechanics : MechanicsSettings
        The pressure of its protocol is replaced by that of the closed frame.
    mesh : CaseMesh
    tolerance : float
        Of the filter, relative.
    max_iterations : int
    reach : float
        See :class:`mvest.model.ClosureModel`.
    paper : PaperSettings or None
        Whether the moduli are also estimated as the paper does it.
    moduli_only : bool
        Whether they are also estimated with all nuisances fixed, but otherwise as here.
    confirm : bool
        Whether the fitted valve is closed anew from the open one.
    correspondence : bool
        Whether corresponding vertices are used as such; otherwise only where the surface is.
    """

    unknowns: tuple[Unknown, ...]
    mechanics: MechanicsSettings
    mesh: CaseMesh = field(default_factory=CaseMesh)
    tolerance: float = 2e-3
    max_iterations: int = 15
    reach: float = 0.5
    paper: PaperSettings | None = None
    moduli_only: bool = False
    confirm: bool = False
    correspondence: bool = True

    def __post_init__(self) -> None:
        names = [unknown.name for unknown in self.unknowns]
        if len(set(names)) != len(names):
            raise InputError(f"unknowns {', '.join(names)} are not all different")
        for u in self.unknowns:
            if u.name in REGISTRATION and u.treatment is Treatment.FIXED and u.mean != 0:
                raise InputError(
                    f"unknown {u.name} is fixed at {u.mean}; expected 0, or a displacement that is "
                    "estimated or considered"
                )
        if not any(u.is_modulus and u.treatment is Treatment.ESTIMATED for u in self.unknowns):
            raise InputError(
                f"unknowns {', '.join(names) or '(none)'}: expected at least one modulus "
                "E_f.REGION that is estimated"
            )


@dataclass(frozen=True, slots=True, eq=False)
class FrameDistance:
    """How far a frame as seen is from the closed valve of the model.

    Attributes
    ----------
    frame : str
    seen : bool
        Whether the filter was shown it.
    generic, registered, personalised : (k,) mm
        With generic values of all unknowns; the same, displaced rigidly to lie closest to the
        closed frame (as it is where vertices do not correspond); and with the estimated unknowns.
        Of each corresponding vertex, or of each point as seen from the predicted surface.
    """

    frame: str
    seen: bool
    generic: FloatArray
    registered: FloatArray
    personalised: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Personalised:
    """All that is found out about a case.

    Attributes
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    mesh : SolidMesh
    names : tuple of str, (p,)
        Unknowns that are estimated or considered.
    prior : Gaussian
        Of these.
    result : StudyResult
    moduli_only : StudyResult or None
        With all nuisances fixed.
    paper : StudyResult or None
        As the paper does it.
    distances : tuple of FrameDistance
        Empty if there is no estimate.
    generic, registered, fitted : mapping of str to (n, 3) mm
        Frame -> predicted vertices; fitted as they are seen.
    narrower : mapping of str to (q,)
        What if something were known: standard deviation of the logarithm of each modulus, under
        ``now``, ``pressure known``, ``half the error of the image`` and so on.
    confirmed_mm : float or None
        Largest distance of the fitted closed valve from the one closed anew.
    seconds : mapping of str to float
        Wall-clock time of each part.
    """

    case: ValveCase
    settings: PersonaliseSettings
    mesh: SolidMesh
    names: tuple[str, ...]
    prior: Gaussian
    result: StudyResult
    moduli_only: StudyResult | None
    paper: StudyResult | None
    distances: tuple[FrameDistance, ...]
    generic: Mapping[str, FloatArray]
    registered: Mapping[str, FloatArray]
    fitted: Mapping[str, FloatArray]
    narrower: Mapping[str, FloatArray]
    confirmed_mm: float | None
    seconds: Mapping[str, float]


def build_model(
    case: ValveCase, settings: PersonaliseSettings, store: Path | None = None
) -> ClosureModel:
    """The closure of a case as a function of its unknowns, those of the registration excluded.

    Parameters
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    store : Path, optional
        Where an unstructured mesh is kept.

    Raises
    ------
    InputError
        If an unknown is not one of the case's, or a modulus is missing.
    GeometryError, MeshingError
        If the leaflets cannot be meshed.
    """
    mechanical = [u for u in settings.unknowns if u.name not in REGISTRATION]
    strange = [u.name for u in mechanical if not u.is_modulus and u.name not in FACTORS]
    if strange:
        raise InputError(
            f"unknowns {', '.join(strange)}; expected E_f.REGION, {', '.join(FACTORS)} or some of "
            f"{', '.join(REGISTRATION)}"
        )
    needed = {f"E_f.{region}" for region in case.surface.region_names}
    given = {u.name for u in mechanical if u.is_modulus}
    if given != needed:
        raise InputError(
            f"unknown moduli {', '.join(sorted(given))}; case {case.name} has the leaflets "
            f"{', '.join(case.surface.region_names)}: expected {', '.join(sorted(needed))}, or "
            "leaflets named as the unknowns are"
        )
    free = tuple(u.name for u in mechanical if u.treatment is not Treatment.FIXED)
    fixed = {u.name: u.mean for u in mechanical if u.treatment is Treatment.FIXED}
    protocol = replace(
        settings.mechanics.protocol, pressure_mmHg=case.frame(Role.CLOSED).pressure_mmHg
    )
    mechanics = replace(settings.mechanics, protocol=protocol)
    valve, mesh = case.valve, settings.mesh
    band = Band(valve) if len(case.surface.region_names) == 2 else None
    contact = valve if band is None else band.sampled(mesh.contact_columns, mesh.contact_rows)
    solid = _solid(valve, band, mesh, store)
    model = ClosureModel(
        valve,
        contact,
        solid,
        mechanics,
        free,
        fixed,
        continuation=True,
        reach=settings.reach,
    )
    if band is not None:
        coarse = structured_mesh(band, "hex18", mesh.guide_columns, mesh.guide_rows)
        model.guide = replace(model, mesh=coarse)
    return model


def _solid(valve: Valve, band: Band | None, mesh: CaseMesh, store: Path | None) -> SolidMesh:
    if mesh.source == "structured":
        if band is None:
            raise InputError(
                "a structured mesh needs a valve with two leaflets; expected mesh source tetwild"
            )
        try:
            return structured_mesh(band, "hex18", mesh.columns, mesh.rows)
        except GeometryError as fault:
            raise GeometryError(
                f"structured mesh of {mesh.columns} x {mesh.rows} cells: {fault}; the reference "
                "surface or the line between its leaflets is too jagged: smooth it, change the "
                "number of cells, or take mesh source tetwild"
            ) from fault
    settings = TetwildSettings(mesh.edge_length, 0.05 * mesh.edge_length)
    return tetrahedral_leaflets(valve.surface, settings, "tet10", store)


def personalise(
    case: ValveCase,
    settings: PersonaliseSettings,
    *,
    store: Path | None = None,
    on_step: OnStep | None = None,
) -> Personalised:
    """Estimate the unknowns of a case.

    Numerical failure is part of the result, with its reason; only inadmissible input raises.

    Parameters
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    store : Path, optional
        Where an unstructured mesh is kept.
    on_step : callable, optional
        Progress, see :class:`mvest.model.ClosureModel`.
    """
    chain = _Chain(case, settings, store, on_step)
    started = time.perf_counter()
    # Not the prior's mean, which may differ from where filters start by its last bit.
    generic = chain.shared(chain.shared.start)
    seconds = {"generic": time.perf_counter() - started}
    result = chain.estimate(chain.filter, chain.observation())
    seconds["estimate"] = result.seconds
    moduli_only = paper = None
    if settings.moduli_only:
        moduli_only = chain.estimate_moduli(
            IteratedFilter(settings.tolerance, max_iterations=settings.max_iterations),
            chain.observation(),
            log=True,
        )
        seconds["moduli_only"] = moduli_only.seconds
    if settings.paper is not None:
        paper = chain.estimate_as_paper(settings.paper)
        seconds["paper"] = paper.seconds
    frames = _Frames({}, {}, {}, ())
    narrower: Mapping[str, FloatArray] = {}
    confirmed = None
    if generic.converged and result.estimate is not None:
        began = time.perf_counter()
        frames = chain.frames(generic, result)
        narrower = chain.narrower(result)
        seconds["held_out"] = time.perf_counter() - began
        if settings.confirm:
            began = time.perf_counter()
            confirmed = chain.confirm(result)
            seconds["confirm"] = time.perf_counter() - began
    return Personalised(
        case,
        settings,
        chain.model.mesh,
        chain.names,
        chain.prior,
        result,
        moduli_only,
        paper,
        frames.distances,
        frames.generic,
        frames.registered,
        frames.fitted,
        narrower,
        confirmed,
        seconds,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Frames:
    generic: Mapping[str, FloatArray]
    registered: Mapping[str, FloatArray]
    fitted: Mapping[str, FloatArray]
    distances: tuple[FrameDistance, ...]


class _Chain:
    """The objects that the parts of one personalisation share."""

    def __init__(
        self,
        case: ValveCase,
        settings: PersonaliseSettings,
        store: Path | None,
        on_step: OnStep | None,
    ) -> None:
        self.case, self.settings = case, settings
        self.closed = case.frame(Role.CLOSED)
        self.model = build_model(case, settings, store)
        self.model.on_step = on_step
        free = [u for u in settings.unknowns if u.treatment is not Treatment.FIXED]
        # Those of the closure first, in its order; then the displacement.
        own = [u for u in free if u.name not in REGISTRATION]
        rigid = [u for u in free if u.name in REGISTRATION]
        self.unknowns = (*own, *rigid)
        self.names = tuple(u.name for u in self.unknowns)
        self.registered = RegisteredModel(self.model, self.names)
        self.prior = Gaussian.from_variance(
            np.array([u.mean for u in self.unknowns]),
            np.array([u.std for u in self.unknowns]) ** 2,
        )
        self.transform = Log(tuple(u.is_positive for u in self.unknowns))
        start = self.transform.inverse(self.transform.forward(self.prior.mean))
        self.shared = SharedStart(self.registered, start)
        inner = IteratedFilter(settings.tolerance, max_iterations=settings.max_iterations)
        considered = tuple(u.name for u in free if u.treatment is Treatment.CONSIDERED)
        self.filter: Filter = SchmidtFilter(inner, considered) if considered else inner

    def observation(self) -> Observed:
        """The closed frame, with the uncertainty that the case states."""
        told = self.case.uncertainty
        length, frame = told.correlation_length_mm, self.closed
        kept = _thinned(len(frame.vertices))
        if self.corresponding:
            correlation = (
                SpatialCorrelation(self.case.surface.vertices, length) if length > 0 else None
            )
            seen = np.where(kept[:, None], frame.vertices, np.nan)
            return Observation(("closed",), seen[None], np.array(told.std_mm**2), correlation)
        points = ObservedSurface(
            "closed", frame.vertices[kept], _vertex_region(frame)[kept], frame.free_edge
        )
        if length > 0:
            # Beyond a border a distance changes its sign, which correlated errors do not.
            near = replace(points, annulus=frame.annulus).inner(BORDER * told.std_mm)
            points = replace(near, annulus=None)
        surface = replace(PredictedSurface.of_valve(self.model.valve), annulus=None)
        return SurfaceObservation((points,), surface, told.std_mm, told.std_mm, length)

    @property
    def corresponding(self) -> bool:
        """Whether vertices are compared one by one."""
        return self.settings.correspondence and self.closed.corresponds

    def estimate(self, filter_: Filter, observation: Observed) -> StudyResult:
        """All unknowns."""
        case = Case(
            self.names,
            self.shared,
            self.prior,
            filter_,
            self.transform,
            self.settings.mechanics.tissue,
        )
        return estimate(case, observation)

    def estimate_moduli(
        self, filter_: Filter, observation: Observed, *, log: bool, variance: float | None = None
    ) -> StudyResult:
        """The moduli alone, everything else at its prior mean."""
        moduli = np.array([k for k, u in enumerate(self.unknowns) if u.is_modulus])
        prior = Gaussian(self.prior.mean[moduli], self.prior.covariance[np.ix_(moduli, moduli)])
        if variance is not None:
            prior = Gaussian.from_variance(prior.mean, variance)
        case = Case(
            tuple(self.names[k] for k in moduli),
            _Moduli(self.shared, self.shared.start, moduli),
            prior,
            filter_,
            Log() if log else Log((False,) * len(moduli)),
            self.settings.mechanics.tissue,
        )
        return estimate(case, observation)

    def estimate_as_paper(self, paper: PaperSettings) -> StudyResult:
        """The moduli alone, with the paper's filter and its independent R."""
        observation: Observed
        if self.corresponding:
            observation = Observation(("closed",), self.closed.vertices[None], np.array(paper.R))
        else:
            seen = self.observation()
            assert isinstance(seen, SurfaceObservation)
            std = float(np.sqrt(paper.R))
            observation = replace(seen, std_mm=std, curve_std_mm=std, correlation_length_mm=0.0)
        filter_ = PaperFilter(paper.Q, max_iterations=paper.max_iterations)
        return self.estimate_moduli(filter_, observation, log=False, variance=paper.P0)

    def frames(self, generic: Prediction, result: StudyResult) -> _Frames:
        """All frames of the closed valve as they are predicted, and how far they are."""
        assert result.estimate is not None
        m0, m = self.prior.mean, result.estimate
        closed0 = generic.y.reshape(2, -1, 3)[1]
        positions: dict[str, dict[str, FloatArray]] = {
            "generic": {},
            "registered": {},
            "fitted": {},
        }
        assert result.fitted is not None
        positions["generic"][self.closed.name] = closed0
        positions["fitted"][self.closed.name] = result.fitted[-1]
        held = [self.held_state(frame) for frame in self.case.held_out]
        for which, at in (("generic", m0), ("fitted", m)) if held else ():
            found = self.model.held(self.registered.mechanical(at), held)
            for frame, points in zip(self.case.held_out, found, strict=True):
                if points is not None:
                    positions[which][frame.name] = self.registered.seen(points, at)
        turn, origin, target = self._alignment(closed0)
        for name, points in positions["generic"].items():
            positions["registered"][name] = (points - origin) @ turn.T + target
        distances = [
            FrameDistance(
                frame.name,
                frame.role is Role.CLOSED,
                *(
                    self._distance(frame, positions[which][frame.name])
                    for which in ("generic", "registered", "fitted")
                ),
            )
            for frame in self.case.frames
            if all(frame.name in found for found in positions.values())
        ]
        return _Frames(
            positions["generic"],
            positions["registered"],
            positions["fitted"],
            tuple(distances),
        )

    def held_state(self, frame: Frame) -> HeldState:
        """The loads of a further frame, on the contact valve's annulus."""
        contact = self.model.contact_valve
        annulus = frame.annulus
        if contact is not self.model.valve:
            phi = 360.0 * np.arange(len(contact.annulus)) / len(contact.annulus)
            annulus = Band(self.model.valve).annulus_positions(phi, frame.annulus)
        return HeldState(frame.pressure_mmHg, annulus, frame.papillary_tips)

    def _alignment(self, generic: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Turn, origin and its target that lay the generic closed valve on the closed frame."""
        if not self.corresponding:
            # Without correspondence: the displacement is that of the prior, none.
            return np.eye(3), np.zeros(3), np.zeros(3)
        origin, target = generic.mean(axis=0), self.closed.vertices.mean(axis=0)
        turn, _ = Rotation.align_vectors(self.closed.vertices - target, generic - origin)
        return turn.as_matrix(), origin, target

    def _distance(self, frame: Frame, positions: FloatArray) -> FloatArray:
        if self.settings.correspondence and frame.corresponds:
            return np.asarray(np.linalg.norm(positions - frame.vertices, axis=1))
        return surface_distance(frame.vertices, positions, self.case.surface.triangles)

    def narrower(self, result: StudyResult) -> Mapping[str, FloatArray]:
        """Standard deviations of the moduli's logarithms if something more were known.

        From the linear model at the estimate, all unknowns estimated.
        """
        filtered = result.filtered
        assert filtered is not None
        assert filtered.prediction is not None
        moduli = [k for k, u in enumerate(self.unknowns) if u.is_modulus]
        prior = to_filter(self.transform, self.prior)
        z = filtered.transformed_iterates[-1]
        H = filtered.prediction.jacobian * self.transform.derivative(z)
        R = self.observation().R
        noise = observation_noise(R, len(H))
        groups = {
            "pressure known": ("pressure_scale",),
            "rest lengths known": ("chord_rest_length",),
            "chordal stiffness known": ("chord_stiffness",),
            "registration known": REGISTRATION,
            "all nuisances known": tuple(n for n in self.names if not n.startswith("E_f.")),
        }

        def std(P: FloatArray, scale: float = 1.0) -> FloatArray:
            update = kalman_update(Gaussian(z, P), np.zeros(len(H)), H * scale, noise)
            return update.posterior.std[moduli]

        found = {"now": std(prior.covariance)}
        for words, members in groups.items():
            known = np.isin(self.names, members)
            if known.any():
                P = np.array(prior.covariance)
                P[known] = 0.0
                P[:, known] = 0.0
                found[words] = std(P)
        found["half the error of the image"] = std(prior.covariance, 2.0)
        found["a frame without error"] = std(prior.covariance, 1e3)
        return found

    def confirm(self, result: StudyResult) -> float | None:
        """Largest distance (mm) of the fitted closed valve from one closed from the open state."""
        assert result.estimate is not None
        assert result.fitted is not None
        anew = replace(self.model, continuation=False, guide=None)
        found = RegisteredModel(anew, self.names)(result.estimate)
        if not found.converged:
            return None
        closed = found.y.reshape(2, -1, 3)[1]
        return float(np.linalg.norm(closed - result.fitted[-1], axis=1).max())


@dataclass(frozen=True, slots=True, eq=False)
class _Moduli:
    """A model as a function of some of its parameters, the others fixed at ``values``."""

    model: Callable[[FloatArray], Prediction]
    values: FloatArray
    kept: IntArray

    def __call__(self, m: FloatArray, /) -> Prediction:
        whole = np.array(self.values)
        # The start is met to the last bit, so that it is not computed again.
        changed = ~np.isclose(m, whole[self.kept], rtol=1e-14, atol=0.0)
        whole[self.kept[changed]] = m[changed]
        found = self.model(whole)
        if not found.converged:
            return found
        return Prediction(found.y, found.jacobian[:, self.kept], reason=found.reason)


def _thinned(n: int) -> BoolArray:
    """Which of n vertices are compared: all, or evenly spread ones if there are very many."""
    kept = np.zeros(n, dtype=np.bool_)
    kept[:: -(-n // MOST_VERTICES)] = True
    return kept


def _vertex_region(frame: Frame) -> IntArray:
    """The leaflet of each vertex of a frame ``(q,)``, ``UNKNOWN`` on the line between two."""
    n = len(frame.vertices)
    low, high = np.full(n, np.iinfo(np.int64).max), np.full(n, -1)
    np.minimum.at(low, frame.triangles.ravel(), np.repeat(frame.region, 3))
    np.maximum.at(high, frame.triangles.ravel(), np.repeat(frame.region, 3))
    return np.where(low == high, low, UNKNOWN)
