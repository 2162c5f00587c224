"""How the valve closes: one closure, every stored step measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.build import closure_model, template_of
from experiments.common.forward import forward_record, without_nan
from experiments.common.plain import Plain, flat, plain_run
from experiments.common.progress import SolveBar
from experiments.common.study import Section, Study
from experiments.studies.closure.report import closure_text, write_closure
from experiments.studies.closure.settings import Settings
from mvest.closure.measures import measure_steps
from mvest.typing import FloatArray
from mvest.valve.geometry.thickening import thicken
from mvest.valve.mesh.embedding import embed

__all__ = ["STUDY", "run_closure_study"]

Values = Mapping[str, Any]
Outcome = tuple[dict[str, Any], list[Path]]


def run_closure_study(config: Values, config_hash: str, folder: Path, started: float) -> Outcome:
    """Close the valve once and measure every stored step."""
    values = np.array(config["truth"]["values"], dtype=float)
    model = closure_model(config)
    with SolveBar("closure", len(model.settings.protocol.steps()), 1) as bar:
        model.on_step = bar.step
        result = model.close(values, sensitivities=False, every_frame=True)
    thickness = float(model.valve.surface.thickness.mean())
    distance = (
        0.5
        * thickness
        * (model.settings.contact.reference_distance + model.settings.contact.activation_distance)
    )
    observed = config["observation"]
    normals = _normals(config, observed["columns"], observed["rows"])
    steps = measure_steps(model, result, distance, normals)
    record = forward_record(config, config_hash, model, values, started, 1)
    record |= {"rows": [without_nan(asdict(s)) for s in steps], "contact_distance_mm": distance}
    if not result.simulation.converged:
        record |= {"status": "failed", "reason": result.simulation.reason.value}
    surface = thicken(model.valve.surface, normals)
    faces = embed(model.mesh, surface.vertices)
    frames = np.stack([faces(x) for x in result.simulation.frames])
    fields = folder / "fields.npz"
    np.savez_compressed(
        fields,
        frames=frames.astype(np.float32),
        times=result.simulation.times,
        triangles=surface.triangles.astype(np.int32),
        region=surface.region.astype(np.int8),
    )
    return record, []


def _normals(config: Values, columns: int, rows: int) -> FloatArray:
    j, i = (v.ravel() for v in np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"))
    return template_of(config).normal(360.0 * i / columns, j / (rows - 1))


STUDY = Study(
    settings=Settings,
    findings=Plain,
    run=plain_run(run_closure_study),
    words=lambda record: closure_text(flat(record)),
    write=write_closure,
    sections=(Section("closure", {"closure": "A valve closing. Simulated."}, validation=True),),
)
