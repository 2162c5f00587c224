"""The closure of a case as a function of its unknowns, and the gate: whether it is one state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mvest.cases.case import Frame, Role, ValveCase
from mvest.closure.frames import FramesModel, is_frame_pressure
from mvest.closure.model import ClosureModel
from mvest.closure.rest_geometry import RestGeometry
from mvest.closure.robustness import GATE_CASES, GateReport, run_gate, vary
from mvest.errors import InputError
from mvest.estimation.prediction import SharedStart
from mvest.mechanics.valve_system import HeldState, check_parameters
from mvest.personalisation.settings import CaseMesh, PersonaliseSettings, Prior
from mvest.problem.registration import REGISTRATION, RegisteredModel
from mvest.typing import FloatArray
from mvest.valve.anatomy.band import Band
from mvest.valve.mesh.given import GivenValve, tetrahedral_leaflets
from mvest.valve.mesh.solid_mesh import SolidMesh


def with_pressures(case: ValveCase, settings: PersonaliseSettings) -> PersonaliseSettings:
    """The settings with the pressures' errors among the unknowns, where a case has several frames.

    With one closed frame the factor on the pressure stands for all of them.
    """
    if settings.pressures is None or not case.fitted:
        return settings
    frames = (case.frame(Role.CLOSED).name, *(frame.name for frame in case.fitted))
    own = [u for u in settings.unknowns if not is_frame_pressure(u.name)]
    return replace(settings, unknowns=(*own, *settings.pressures.unknowns(frames)))


def frames_model(
    case: ValveCase, settings: PersonaliseSettings, model: ClosureModel
) -> FramesModel | None:
    """All closed frames that are fitted, if they are several; nearest in pressure go first.

    Parameters
    ----------
    case : ValveCase
    settings : PersonaliseSettings
        From `with_pressures`.
    model : ClosureModel
        Of the case.

    Raises
    ------
    InputError
        If errors of pressures are unknown and the factor on all of them is not.
    """
    if not case.fitted:
        return None
    closed = case.frame(Role.CLOSED)
    ordered = sorted(case.fitted, key=lambda f: abs(f.pressure_mmHg - closed.pressure_mmHg))
    states = {frame.name: held_state(model, frame) for frame in ordered}
    errors = tuple(u.name for u in settings.unknowns if is_frame_pressure(u.name))
    return FramesModel(model, closed.name, states, closed.pressure_mmHg, errors)


def held_state(model: ClosureModel, frame: Frame) -> HeldState:
    """The loads of a further frame, on the contact valve's annulus."""
    contact = model.contact_valve
    annulus = frame.annulus
    if contact is not model.valve:
        phi = 360.0 * np.arange(len(contact.annulus)) / len(contact.annulus)
        annulus = Band(model.valve).annulus_positions(phi, frame.annulus)
    return HeldState(frame.pressure_mmHg, annulus, frame.papillary_tips)


def build_model(
    case: ValveCase, settings: PersonaliseSettings, store: Path | None = None
) -> ClosureModel:
    """The closure of a case as a function of its unknowns, those of the registration excluded.

    Parameters
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    store : Path, optional
        Folder in which an unstructured mesh is cached.

    Raises
    ------
    InputError
        If an unknown is not one of the case's, or a modulus is missing.
    GeometryError, MeshingError
        If the leaflets cannot be meshed.
    """
    _check_unknowns(case, settings)
    coarse = build_coarse(case, settings, store)
    shape = GivenValve(case.valve)
    if shape.band is None:
        return replace(coarse, rounded_start=True)
    solid = _solid(shape, settings.mesh, store)
    return replace(coarse, mesh=solid, guide=coarse, rounded_start=True)


def build_coarse(
    case: ValveCase, settings: PersonaliseSettings, store: Path | None = None
) -> ClosureModel:
    """The same on the mesh of the guide alone, where there are two leaflets; see `build_model`."""
    _check_unknowns(case, settings)
    mechanical = _mechanical(settings)
    free = tuple(u.name for u in mechanical if not u.fixed)
    fixed = {u.name: u.mean for u in mechanical if u.fixed}
    protocol = settings.mechanics.protocol
    if case.closed is not None:
        protocol = replace(protocol, pressure_mmHg=case.closed.pressure_mmHg)
    mechanics = replace(settings.mechanics, protocol=protocol)
    shape, mesh = GivenValve(case.valve), settings.mesh
    if shape.band is not None:
        mesh = replace(mesh, source="structured", columns=mesh.guide_columns, rows=mesh.guide_rows)
    solid = _solid(shape, mesh, store)
    return ClosureModel(
        shape.given,
        shape.valve(mesh.contact_columns, mesh.contact_rows),
        solid,
        mechanics,
        free,
        fixed,
        continuation=True,
        repeat=False,
        largest_change=settings.largest_change,
    )


def _mechanical(settings: PersonaliseSettings) -> list[Prior]:
    return [
        u for u in settings.unknowns if not (u.name in REGISTRATION or is_frame_pressure(u.name))
    ]


def _check_unknowns(case: ValveCase, settings: PersonaliseSettings) -> None:
    mechanical = _mechanical(settings)
    regions = case.surface.region_names
    others = [u.name for u in mechanical if not u.is_modulus]
    try:
        check_parameters(others, case.valve, settings.mechanics)
    except InputError as error:
        raise InputError(f"unknowns: {error}; or some of {', '.join(REGISTRATION)}") from error
    needed = {f"E_f.{region}" for region in regions}
    given = {u.name for u in mechanical if u.is_modulus}
    if given != needed:
        raise InputError(
            f"unknown moduli {', '.join(sorted(given))}; case {case.name} has the leaflets "
            f"{', '.join(regions)}: expected {', '.join(sorted(needed))}, or "
            "leaflets named as the unknowns are"
        )


def _solid(shape: GivenValve, mesh: CaseMesh, store: Path | None) -> SolidMesh:
    if mesh.source == "structured" or (mesh.source == "automatic" and shape.band is not None):
        return shape.layers("hex18", mesh.columns, mesh.rows)
    return tetrahedral_leaflets(shape.given.surface, mesh.edge_length, "tet10", store)


@dataclass(frozen=True, slots=True, eq=False)
class CaseClosure:
    """The closure of a case's valve, in the forms in which the parts of an estimation take it.

    Attributes
    ----------
    model : ClosureModel
    frames : FramesModel or None
        All closed frames that are fitted, if they are several.
    registered : RegisteredModel
        The same, displaced as a whole before it is seen.
    shared : SharedStart
        The same, for many estimations.
    displacement : mapping
        Part -> by what the geometry differs from the one that was seen; see
        `RestGeometry.displaced`.
    """

    model: ClosureModel
    frames: FramesModel | None
    registered: RegisteredModel
    shared: SharedStart
    displacement: Mapping[str, FloatArray]

    @classmethod
    def of(
        cls,
        model: ClosureModel,
        frames: FramesModel | None,
        names: tuple[str, ...],
        start: FloatArray,
        displacement: Mapping[str, FloatArray] | None = None,
    ) -> CaseClosure:
        """The closure of a valve, gone on from ``start (p,)`` in the order of ``names``."""
        registered = RegisteredModel(frames or model, names)
        return cls(model, frames, registered, SharedStart(registered, start), displacement or {})

    def displaced(self, parts: Mapping[str, FloatArray], start: FloatArray) -> CaseClosure:
        """Of the valve with another geometry, see `RestGeometry.displaced`.

        All closed frames have the same errors of annulus and tips, as their derivatives say.
        """
        model, names = RestGeometry(self.model).displaced(parts), self.registered.names
        closure = self.of(model, self.frames, names, start, parts)
        if self.frames is None:
            return closure
        states = {name: closure.held(state) for name, state in self.frames.states.items()}
        frames = replace(self.frames, model=model, states=states)
        return self.of(model, frames, names, start, parts)

    def held(self, state: HeldState) -> HeldState:
        """A state as it was seen, whose annulus and tips are off as those of this valve."""
        return replace(
            state,
            annulus=state.annulus + self.displacement.get("annulus", 0.0),
            papillary_tips=state.papillary_tips + self.displacement.get("tips", 0.0),
        )


def gate_case(
    case: ValveCase,
    settings: PersonaliseSettings,
    store: Path | None = None,
) -> GateReport:
    """Ask whether the closed state of a case is one, with the prior means of its unknowns.

    Variations that need another mesh or other contact samples are left out: those of a case are as
    its surface gives them.

    Parameters
    ----------
    case : ValveCase
    settings : PersonaliseSettings
    store : Path, optional
        Where an unstructured mesh is kept.

    Raises
    ------
    MvestError
        If the case is not in order.
    """
    model = build_model(case, settings, store)
    means = {unknown.name: unknown.mean for unknown in settings.unknowns}
    kept = [
        each
        for each in GATE_CASES
        if not each.remeshed and (model.guide is not None or not each.guided)
    ]
    at = np.array([means[name] for name in model.names])
    return run_gate(lambda variation: vary(model, variation), at, kept)


def gate_lines(report: GateReport) -> list[str]:
    """What a gate's report comes to, in lines: the verdict, and what it fails by."""
    largest = np.nanmax([row.max_mm for row in report.rows])
    verdict = "passed" if report.passed else "NOT passed: the closed state is not one"
    lines = [
        f"  gate {verdict}; {len(report.rows) - 1} variations, {largest:.2g} mm at most, and "
        f"{len(report.paths)} ways along the moduli"
    ]
    for row in report.rows:
        if not row.passed:
            lines.append(f"  gate: {row.case}: {row.max_mm:.2g} mm off, {row.reason}")
    lines += [f"  gate: along {path.name}: {path.reason}" for path in report.paths if path.reason]
    return lines
