"""How the valve closes: one closure, every stored step measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from experiments.common.building.anatomy import anatomy_of
from experiments.common.building.closure import closure_model
from experiments.common.building.gate import gate_of
from experiments.common.progress import SolveBar
from experiments.common.records.forward import outcome_of
from experiments.common.records.record import Outcome
from experiments.common.records.report import answer_of_main
from experiments.common.study import Job, Section, Study
from experiments.studies.closure.report import (
    Findings,
    closure_answer,
    closure_words,
    write_closure,
)
from experiments.studies.closure.settings import Settings
from mvest.closure.measures import measure_steps
from mvest.closure.model import ClosureModel, ClosureResult
from mvest.mechanics.valve_system import boundary_loading
from mvest.scenarios.measures import contact_reach
from mvest.scenarios.stress import contact_pressure, nodal_stress
from mvest.typing import FloatArray
from mvest.valve.geometry.thickening import thicken
from mvest.valve.mesh.embedding import embed

__all__ = ["STUDY", "run_closure"]


def run_closure(job: Job[Settings]) -> Outcome[Findings]:
    """Close the valve once and measure every stored step."""
    values = job.values
    model = closure_model(values)
    truth = np.array(values["truth"]["values"], dtype=float)
    with SolveBar("closure", len(model.settings.protocol.steps()), 1) as bar:
        model.on_step = bar.step
        result = model.close(truth, sensitivities=False, every_frame=True)
    contact = model.settings.contact
    thickness = float(model.valve.surface.thickness.mean())
    distance = 0.5 * thickness * (contact.reference_distance + contact.activation_distance)
    observed = values["observation"]
    normals = anatomy_of(values).normals(observed["columns"], observed["rows"])
    simulation = result.simulation
    findings = Findings(
        rows=measure_steps(model, result, distance, normals),
        contact_distance_mm=distance,
        equilibrium=model.settings.protocol.equilibrium and simulation.converged,
    )
    _write_fields(job.folder / "fields.npz", model, result, normals)
    failed = () if simulation.converged else (simulation.reason.value,)
    return outcome_of(findings, model.mesh, 1, failed, gate_of(values))


def _write_fields(
    path: Path, model: ClosureModel, result: ClosureResult, normals: FloatArray
) -> None:
    """Each stored step: thick leaflets with stress and contact pressure (MPa), chordae, tips."""
    valve, simulation = model.valve, result.simulation
    surface = thicken(valve.surface, normals)
    faces = embed(model.mesh, surface.vertices)
    loading = boundary_loading(result.system, valve, model.contact_valve, model.settings)
    cables = result.system.cables
    assert cables is not None
    system = result.system
    pressed = [contact_pressure(system, x) for x in simulation.frames]
    # The samples are finer than the surface, whose two faces lie over the same ones.
    at_face = np.tile(cKDTree(pressed[0][0]).query(valve.surface.vertices)[1], 2)
    np.savez_compressed(
        path,
        stress=np.stack([faces(nodal_stress(system, x)) for x in simulation.frames]).astype(
            np.float32
        ),
        contact_pressure=np.stack([values[at_face] for _, values in pressed]).astype(np.float32),
        frames=np.stack([faces(x) for x in simulation.frames]).astype(np.float32),
        times=simulation.times,
        triangles=surface.triangles.astype(np.int32),
        region=surface.region.astype(np.int8),
        # Along the atrial faces.
        annulus=valve.annulus + len(valve.surface.vertices),
        tips=np.stack([loading(float(t)).tips for t in simulation.times]).astype(np.float32),
        chord_end=np.stack([cables.patches(x) for x in simulation.frames]).astype(np.float32),
        chord_tip=cables.tip,
        # Of faces, which are half a thickness nearer than midsurfaces on both sides.
        reach_mm=contact_reach(model) - valve.surface.thickness[valve.free_edge].mean(),
    )


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_closure,
    words=closure_words,
    write=write_closure,
    sections=(
        Section(
            "closure",
            {"closure": "A valve closing. Simulated."},
            validation=True,
            answer=answer_of_main(closure_answer),
        ),
    ),
)
