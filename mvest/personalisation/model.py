"""The closure of a case as a function of its unknowns, and the gate on its uniqueness."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mvest.cases.case import Frame, Role, ValveCase
from mvest.closure.frames import FramesModel, is_frame_pressure
from mvest.closure.model import ClosureModel
from mvest.closure.robustness import GATE_CASES, GateReport, run_gate, vary
from mvest.errors import InputError
from mvest.estimation.prediction import SharedStart
from mvest.mechanics.valve_system import HeldState, check_parameters
from mvest.personalisation.settings import CaseMesh, PersonaliseSettings
from mvest.problem.registration import REGISTRATION, RegisteredModel
from mvest.typing import FloatArray
from mvest.valve.anatomy.band import Band
from mvest.valve.mesh.given import GivenValve, tetrahedral_leaflets
from mvest.valve.mesh.solid_mesh import SolidMesh


def with_pressures(case: ValveCase, settings: PersonaliseSettings) -> PersonaliseSettings:
    """The settings with the errors of pressures among the unknowns, if several frames are fitted.

    With one closed frame the common factor on the pressure covers them.
    """
    if settings.pressures is None or not case.fitted:
        return settings
    frames = (case.frame(Role.CLOSED).name, *(frame.name for frame in case.fitted))
    own = [u for u in settings.unknowns if not is_frame_pressure(u.name)]
    return replace(settings, unknowns=(*own, *settings.pressures.unknowns(frames)))


def contact_annulus(model: ClosureModel, annulus: FloatArray) -> FloatArray:
    """Annulus of the contact valve ``(..., k, 3)`` mm from the observed one ``(..., n, 3)``."""
    contact = model.contact_valve
    if contact is model.valve:
        return annulus
    phi = 360.0 * np.arange(len(contact.annulus)) / len(contact.annulus)
    return Band(model.valve).annulus_positions(phi, annulus)


def held_state(model: ClosureModel, frame: Frame) -> HeldState:
    """The loads of a further frame."""
    annulus = contact_annulus(model, frame.annulus)
    return HeldState(frame.pressure_mmHg, annulus, frame.papillary_tips)


def build_model(
    case: ValveCase, settings: PersonaliseSettings, store: Path | None = None
) -> ClosureModel:
    """The closure of a case as a function of its unknowns except for the registration.

    InputError if an unknown is not one of the case's, or a modulus is missing. GeometryError or
    MeshingError if the leaflets cannot be meshed.

    ``store``: folder in which an unstructured mesh is cached.
    """
    coarse = build_coarse(case, settings, store)
    solid = _solid(GivenValve(case.valve), settings.mesh, store)
    return replace(coarse, mesh=solid, guide=coarse, rounded_start=True)


def build_coarse(
    case: ValveCase, settings: PersonaliseSettings, store: Path | None = None
) -> ClosureModel:
    """As `build_model`, but on the guide mesh alone."""
    mechanical = [
        u for u in settings.unknowns if not (u.name in REGISTRATION or is_frame_pressure(u.name))
    ]
    others = [u.name for u in mechanical if not u.is_modulus]
    try:
        check_parameters(others, case.valve, settings.mechanics)
    except InputError as error:
        raise InputError(f"unknowns: {error}; or some of {', '.join(REGISTRATION)}") from error
    regions, given = case.surface.region_names, {u.name for u in mechanical if u.is_modulus}
    needed = {f"E_f.{region}" for region in regions}
    if given != needed:
        raise InputError(
            f"unknown moduli {', '.join(sorted(given))}; case {case.name} has the leaflets "
            f"{', '.join(regions)}: expected {', '.join(sorted(needed))}, or "
            "leaflets named as the unknowns are"
        )
    # Led by a mesh of 24 x 3 cells, the generic valve did not close for 7 of 18 random anatomies.
    # Without it one step failed for two of three of these, four steps for none.
    protocol = settings.mechanics.protocol
    protocol = replace(protocol, dt=min(protocol.dt, protocol.ramp / 4))
    if case.closed is not None:
        protocol = replace(protocol, pressure_mmHg=case.closed.pressure_mmHg)
    shape, mesh = GivenValve(case.valve), settings.mesh
    columns, rows = mesh.guide_columns, mesh.guide_rows
    mesh = replace(mesh, source="automatic", columns=columns, rows=rows)
    return ClosureModel(
        shape.given,
        shape.valve(mesh.contact_columns, mesh.contact_rows),
        _solid(shape, mesh, store),
        replace(settings.mechanics, protocol=protocol),
        tuple(u.name for u in mechanical if not u.fixed),
        {u.name: u.mean for u in mechanical if u.fixed},
        continuation=True,
        repeat=False,
        largest_change=settings.largest_change,
    )


def _solid(shape: GivenValve, mesh: CaseMesh, store: Path | None) -> SolidMesh:
    if mesh.source != "tetwild":
        leaflets, columns = len(shape.sections), mesh.columns
        if mesh.source == "automatic":
            columns = leaflets * -(-columns // leaflets)
        return shape.layers("hex18", columns, mesh.rows)
    return tetrahedral_leaflets(shape.given.surface, mesh.edge_length, "tet10", store)


@dataclass(frozen=True, slots=True, eq=False)
class CaseClosure:
    """The closure of a case's valve in the forms that an estimation needs."""

    model: ClosureModel
    frames: FramesModel | None  #: all fitted closed frames, if there are several
    registered: RegisteredModel  #: the same, with the rigid displacement of the observed frames
    shared: SharedStart  #: the same, for many estimations

    @classmethod
    def of(
        cls,
        model: ClosureModel,
        frames: FramesModel | None,
        names: tuple[str, ...],
        start: FloatArray,
    ) -> CaseClosure:
        """The closure of a valve, starting at ``start (p,)`` in the order of ``names``."""
        registered = RegisteredModel(frames or model, names)
        return cls(model, frames, registered, SharedStart(registered, start))


def gate_case(
    case: ValveCase, settings: PersonaliseSettings, store: Path | None = None
) -> GateReport:
    """Test that the closed state of a case is unique, at the prior means of its unknowns.

    Variations with another mesh or other contact samples are skipped, because the surface of a
    case fixes both. Parameters and errors are those of `build_model`.
    """
    model = build_model(case, settings, store)
    means = {unknown.name: unknown.mean for unknown in settings.unknowns}
    possible = [
        each
        for each in GATE_CASES
        if not each.remeshed and (model.guide is not None or not each.guided)
    ]
    at = np.array([means[name] for name in model.names])
    return run_gate(lambda variation: vary(model, variation), at, possible)
