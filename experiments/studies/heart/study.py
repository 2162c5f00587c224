"""The mitral valve of a reference heart: measured, meshed, closed, gated, and twins on it.

Its shape is human and all that is real. Whether the chain goes through on a shape that nobody drew
for it, and how well moduli come back that were put in, is what such a valve can show.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.anatomy import anatomy_of, build_mesh, folder_hash
from experiments.common.building.closure import closure_model
from experiments.common.building.gate import anatomy_digest
from experiments.common.building.twin import build_twin
from experiments.common.progress import SolveBar
from experiments.common.records.estimates import Data
from experiments.common.records.findings import finite, vector
from experiments.common.records.forward import outcome_of
from experiments.common.records.record import FAILED_GATE, PASSED_GATE, Outcome
from experiments.common.records.report import answer_of_main
from experiments.common.study import Job, Section, Study
from experiments.studies.heart.findings import Asked, Closed, Findings, Measure, MeshRow, TwinRow
from experiments.studies.heart.report import heart_answer, heart_words, write_heart
from experiments.studies.heart.settings import HeartSettings, Settings
from mvest.cases.case import Role, ValveCase
from mvest.cases.importing.reference_heart import (
    CITATION,
    SHAPE_ALONE,
    heart_files,
    heart_parts,
    import_reference_heart,
)
from mvest.cases.plausibility import free_orifice
from mvest.cases.writer import write_case
from mvest.closure.anchors import content_digest
from mvest.closure.measures import measure_steps
from mvest.closure.model import ClosureModel, ClosureResult
from mvest.closure.robustness import GATE_CASES, GateCase, GateReport, run_gate
from mvest.errors import ConfigurationError
from mvest.estimation.wrappers import SharedStart
from mvest.files import sha256_of, write_atomically
from mvest.mechanics.valve_system import boundary_loading
from mvest.problem.estimate import estimate
from mvest.scenarios.measures import contact_reach
from mvest.scenarios.scenario import plane_of
from mvest.valve.geometry.surface_checks import enclosed_volume
from mvest.valve.geometry.triangles import areas
from mvest.valve.io.vtk_xml import SurfaceFile
from mvest.valve.measure.annulus import measure_annulus
from mvest.valve.measure.measurements import leaflet_length
from mvest.valve.mesh.solid_mesh import SolidMesh, jacobian_determinants

__all__ = ["STUDY", "measures_of", "run_heart"]

Values = Mapping[str, Any]
FIELDS = "fields.npz"
CASE = "case"


def run_heart(job: Job[Settings]) -> Outcome[Findings]:
    """Everything of one reference heart.

    Raises
    ------
    MvestError
        If the data are absent (the message says where to get them) or a setting is inadmissible.
    """
    heart = job.settings.heart
    asked = _asked(heart)
    source = None if heart.source is None else Path(heart.source)
    files = heart_files(source)
    case = import_reference_heart(source, heart.options)
    values = _on_case(job.values, case, job.folder / CASE)
    truth = np.array(values["truth"]["values"], dtype=float)
    meshes = _meshes(values)
    model, closure = _close(values, truth, "closure")
    _write_fields(job.folder / FIELDS, model, closure)
    usual = {
        "annulus_contraction": values["valve"]["annulus_contraction"],
        "closed_depth": heart.options.closed_depth,
    }
    closures = [_closed("as in gate and twins", usual, values, model, closure)]
    for number, (name, changes) in enumerate(heart.closures.items()):
        asked_for = usual | changes
        options = replace(heart.options, closed_depth=asked_for["closed_depth"])
        other = import_reference_heart(source, options)
        there = _on_case(job.values, other, job.folder / f"{CASE}_{number}")
        there["valve"]["annulus_contraction"] = asked_for["annulus_contraction"]
        closures.append(_closed(name, asked_for, there, *_close(there, truth, name)))
    gate = run_gate(
        lambda each: closure_model(values, each),
        truth,
        asked,
        on_case=lambda row: _say(f"gate, {row.case}: max {row.max_mm:.2g} mm, {row.reason}"),
        on_path=lambda path: _say(f"gate, along {path.name}: {path.reason or 'no jump'}"),
    )
    twins = tuple(_twin(values, name, changes) for name, changes in heart.twins.items())
    findings = Findings(
        data=Data(CITATION, content_digest([sha256_of(file) for file in files])),
        anatomy=anatomy_digest(values),
        passed=gate.passed,
        claim=SHAPE_ALONE,
        derived=case.derived,
        measures=(*measures_of(case), _volume(heart_parts(source)[0])),
        meshes=tuple(_mesh_row(name, mesh) for name, mesh in meshes.items()),
        closures=tuple(closures),
        gate=_answers(gate),
        left_out=tuple(each.name for each in GATE_CASES if each not in asked),
        twins=twins,
    )
    failed = [row.reason for row in twins if row.estimate is None]
    failed += [] if closure.simulation.converged else [closure.simulation.reason.value]
    solves = len(closures) + len(gate.rows) + sum(path.closures for path in gate.paths)
    verdict = PASSED_GATE if gate.passed else FAILED_GATE
    left = len(GATE_CASES) - len(asked)
    words = f"{verdict} on {values['mesh']['columns']} x {values['mesh']['rows']} hex18"
    note = f"{words}, {left} variations left out" if left else words
    return outcome_of(findings, model.mesh, solves, failed, note)


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _asked(heart: HeartSettings) -> tuple[GateCase, ...]:
    known = {each.name: each for each in GATE_CASES}
    strange = [name for name in heart.gate if name not in known]
    if strange:
        raise ConfigurationError(
            f"heart.gate has {strange[0]!r}, expected some of {', '.join(known)}"
        )
    return tuple(known[name] for name in heart.gate)


def _on_case(values: Values, case: ValveCase, place: Path) -> dict[str, Any]:
    """The configuration on the anatomy of a case, which is written to a folder of its own."""
    if place.exists():
        shutil.rmtree(place)
    write_case(place, case)
    own = {"folder": str(place), "folder_sha256": folder_hash(str(place))}
    return {**values, "valve": {**values["valve"], **own}}


def measures_of(case: ValveCase) -> tuple[Measure, ...]:
    """Sizes of the open valve."""
    valve, surface = case.valve, case.surface
    frame = case.frame(Role.REFERENCE)
    plane = plane_of(valve, frame.annulus)
    ring = measure_annulus(frame.annulus, plane)
    depth = plane.coordinates(frame.papillary_tips)[:, 2]
    edge = plane.coordinates(frame.free_edge)[:, 2]
    apart = float(np.linalg.norm(np.diff(frame.papillary_tips, axis=0)))
    span = np.linalg.norm(case.chordae.insertion - frame.papillary_tips[case.chordae.tip], axis=1)
    found = [
        ("annulus, anteroposterior diameter", ring.anteroposterior_diameter, "mm"),
        ("annulus, commissural diameter", ring.commissural_diameter, "mm"),
        ("annulus, height of the saddle", ring.height, "mm"),
        ("annulus, circumference", ring.circumference, "mm"),
        ("annulus, projected area", ring.projected_area, "mm²"),
    ]
    for k, name in enumerate(surface.region_names):
        own = surface.triangles[surface.region == k]
        area = float(areas(surface.vertices, own).sum())
        thickness = surface.thickness[np.unique(own)]
        found += [
            (f"{name} leaflet, length", leaflet_length(surface.vertices, own, plane), "mm"),
            (f"{name} leaflet, area", area, "mm²"),
            (f"{name} leaflet, median thickness", float(np.median(thickness)), "mm"),
        ]
    found += [
        ("open orifice", free_orifice(case, frame) or np.nan, "mm²"),
        ("free edge below the annulus, median", float(np.median(edge)), "mm"),
        ("distance of the papillary tips", apart, "mm"),
        ("anterolateral tip below the annulus", float(depth[0]), "mm"),
        ("posteromedial tip below the annulus", float(depth[1]), "mm"),
        ("chordae (laid out)", float(len(case.chordae)), ""),
        ("chordae, shortest distance tip to insertion", float(span.min()), "mm"),
        ("chordae, median distance tip to insertion", float(np.median(span)), "mm"),
    ]
    return tuple(Measure(*each) for each in found)


def _volume(surface: SurfaceFile) -> Measure:
    volume = abs(enclosed_volume(surface.vertices, surface.triangles))
    return Measure("tissue enclosed by the surface of the source", float(volume), "mm³")


def _meshes(values: Values) -> dict[str, SolidMesh]:
    """The mesh in layers and that of tetrahedra."""
    anatomy, store = anatomy_of(values), Path(values["paths"]["outputs"]) / "meshes"
    element = values["mechanics"]["element"]
    tetrahedra = {**values["mesh"], "source": "tetwild"}
    return {
        "layers": build_mesh(anatomy, values["mesh"], element, store),
        "pytetwild": build_mesh(anatomy, tetrahedra, "tet10", store),
    }


def _mesh_row(name: str, mesh: SolidMesh) -> MeshRow:
    points, weights = mesh.reference.points, mesh.reference.weights
    determinants = jacobian_determinants(mesh.nodes, mesh.elements, mesh.reference, points)
    volume = float((determinants @ weights).sum())
    return MeshRow(name, mesh.element_type, len(mesh.nodes), len(mesh.elements), volume)


def _close(values: Values, truth: Any, name: str) -> tuple[ClosureModel, ClosureResult]:
    """The valve closed with the true moduli from its open state."""
    model = closure_model(values)
    with SolveBar(name, len(model.settings.protocol.steps()), 1) as bar:
        model.on_step = bar.step
        return model, model.close(truth, sensitivities=False, every_frame=True)


def _closed(
    name: str,
    assumed: Mapping[str, float],
    values: Values,
    model: ClosureModel,
    result: ClosureResult,
) -> Closed:
    """The open and the closed state of a closure, measured."""
    contact = model.settings.contact
    thickness = float(model.valve.surface.thickness.mean())
    distance = 0.5 * thickness * (contact.reference_distance + contact.activation_distance)
    steps = result.simulation
    ends = replace(steps, times=steps.times[[0, -1]], frames=steps.frames[[0, -1]])
    observed = values["observation"]
    normals = anatomy_of(values).normals(observed["columns"], observed["rows"])
    first, last = measure_steps(model, replace(result, simulation=ends), distance, normals)
    return Closed(
        name,
        assumed["annulus_contraction"],
        assumed["closed_depth"],
        first,
        last,
        steps.reason.value,
    )


def _write_fields(path: Path, model: ClosureModel, result: ClosureResult) -> None:
    """The open and the closed valve, for the pictures."""
    valve = model.valve
    loading = boundary_loading(result.system, valve, model.contact_valve, model.settings)
    cables = result.system.cables
    assert cables is not None
    times, frames = result.simulation.times[[0, -1]], result.simulation.frames[[0, -1]]
    arrays: dict[str, Any] = {
        "frames": np.stack([model.observed(x) for x in frames]).astype(np.float32),
        "triangles": valve.surface.triangles.astype(np.int32),
        "region": valve.surface.region.astype(np.int8),
        "thickness": valve.surface.thickness.astype(np.float32),
        "annulus": valve.annulus.astype(np.int32),
        "free_edge": valve.free_edge.astype(np.int32),
        "tips": np.stack([loading(float(t)).tips for t in times]).astype(np.float32),
        "chord_end": np.stack([cables.patches(x) for x in frames]).astype(np.float32),
        "chord_tip": cables.tip,
        "reach_mm": contact_reach(model),
    }
    write_atomically(path, lambda place: np.savez_compressed(place, **arrays))


def _answers(gate: GateReport) -> tuple[Asked, ...]:
    rows = [
        Asked(row.case, finite(row.mean_mm), finite(row.max_mm), row.passed, row.reason)
        for row in gate.rows
    ]
    paths = [
        Asked(f"along {path.name} ± 20 %", None, None, path.passed, path.reason or "no jump")
        for path in gate.paths
    ]
    return (*rows, *paths)


def _twin(values: Values, name: str, changes: Values) -> TwinRow:
    """Moduli from one simulated observation."""
    twin = build_twin({**values, "truth": {**values["truth"], **changes}})
    true = vector(twin.truth_values)
    with SolveBar(
        f"observation, {name}", len(twin.truth_model.settings.protocol.steps()), 1
    ) as bar:
        twin.truth_model.on_step = bar.step
        seen = twin.source(twin.truth_values)
    data = twin.observe(lambda m: seen, twin.truth_values, np.random.default_rng(values["seed"]))
    if data.observation is None:
        return TwinRow(name, true, None, None, None, None, data.reason)
    problem = replace(twin.problem, model=SharedStart(twin.model, twin.problem.start))
    steps = len(twin.model.settings.protocol.steps())
    with SolveBar(f"estimation, {name}", steps, 6, problem.parameters) as bar:
        twin.model.on_step = bar.step
        result = estimate(problem, data.observation, on_iterate=bar.iterate).against(data.truth)
    if result.estimate is None:
        return TwinRow(name, true, None, None, None, None, result.reason)
    return TwinRow(
        name,
        true,
        vector(result.estimate),
        None if result.std is None else vector(result.std),
        vector(100 * (result.estimate - twin.truth_values) / twin.truth_values),
        None if result.distance is None else float(np.nanmean(result.distance)),
        result.reason,
    )


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_heart,
    words=heart_words,
    write=write_heart,
    keeps_failures=True,
    sections=(
        Section(
            "reference_heart",
            {"reference_heart": "The valve of a reference heart, open and closed by simulation."},
            answer=answer_of_main(heart_answer),
        ),
    ),
)
