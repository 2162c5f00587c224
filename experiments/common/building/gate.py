"""The gate of an anatomy (`mvest.closure.robustness`), and one closure with every step recorded."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from experiments.common.building.closure import anatomy_of, closure_model
from experiments.common.places import GATE_RECORDS
from experiments.common.progress import say, solving
from experiments.common.records.record import FAILED_GATE, NOT_GATED, PASSED_GATE
from experiments.common.schema import Values, build
from mvest.cache import content_digest
from mvest.closure.model import ClosureModel, ClosureResult
from mvest.closure.physiology import physiology, resistance_rows
from mvest.closure.robustness import GATE_CASES, GateReport, run_gate
from mvest.closure.stress import nodal_stress
from mvest.errors import InputError
from mvest.mechanics.valve_system import boundary_loading
from mvest.reading.npz import read_npz
from mvest.reporting.case.tables import physiology_table, resistance_table
from mvest.reporting.tables import Table, table
from mvest.scenarios.measures import contact_pressure, measure_steps
from mvest.typing import FloatArray
from mvest.valve.anatomy.dimensions import TemplateParameters
from mvest.valve.anatomy.valve import band_grid
from mvest.valve.geometry.proximity import plane_section
from mvest.valve.geometry.thickening import thicken
from mvest.valve.mesh.solid_mesh import embed

COLUMNS = {
    "time": "s:.2f", "pressure": "mmHg:.0f", "orifice": "mm²:.1f", "coaptation": "mm:.1f",
    "intersections": "", "chord strain": ":.3f", "chord force": "N:.2f", "smallest det F": ":.2f",
    "Newton iterations": "",
}  # fmt: skip
"""Columns of `mvest.scenarios.measures.measure_steps`, with units and digits."""


def gate_report(values: Values) -> GateReport:
    """Close the configured anatomy with its true moduli, under variations; prints each result."""
    return run_gate(
        lambda case: closure_model(values, case),
        truth_of(values),
        GATE_CASES,
        on_case=lambda row: say(f"{row.case}: max {row.max_mm:.3g} mm, {row.reason}"),
        on_path=lambda path: say(f"along {path.name}: {path.reason or 'no jump'}"),
    )


def gate_rows(report: GateReport) -> Table:
    """A row for each variation, and for each path along moduli (``along E_f``).

    ``max`` of a path is the largest motion of a vertex that the derivatives do not explain, and
    ``share`` its share of the whole motion.
    """
    rows = [
        {"variation": r.case, "mean": r.mean_mm, "max": r.max_mm, "passed": r.passed}
        | {"reason": r.reason}
        for r in report.rows
    ]
    paths = [
        {
            "variation": f"along {path.name}",
            "max": max((piece.unexplained_mm for piece in path.pieces), default=None),
            "share": path.share if path.pieces else None,
            "passed": path.passed,
            "reason": path.reason,
        }
        for path in report.paths
    ]
    return table([*rows, *paths], **{"variation": "", "mean": "mm:.2g", "max": "mm:.2g"})


def anatomy_digest(values: Mapping[str, Any]) -> str:
    """SHA-256 of the configured anatomy, independent of file names."""
    given = values["valve"]
    if given.get("folder") is not None:
        return content_digest(given["folder_sha256"] or "", given["annulus_contraction"])
    return content_digest(build(TemplateParameters, values["valve"]))


def gate_of(values: Mapping[str, Any], records: Path = GATE_RECORDS) -> str:
    """The published verdict on the configured anatomy, with its mesh, or `NOT_GATED`."""
    return _verdicts(records).get(anatomy_digest(values), NOT_GATED)


@cache
def _verdicts(records: Path) -> dict[str, str]:
    """Digest of an anatomy -> the gate's verdict; damaged records are left out."""
    found: dict[str, str] = {}
    for line in records.read_bytes().splitlines() if records.is_file() else ():
        try:
            record = json.loads(line)["record"]
            cells, element = record["model"]["cells"], record["model"]["element"]
            passed = PASSED_GATE if record["numbers"]["passed"] is True else FAILED_GATE
            verdict = f"{passed} on {cells[0]} x {cells[1]} {element}"
            found[str(record["numbers"]["anatomy"])] = verdict
        except (ValueError, KeyError, TypeError, IndexError):
            continue
    return found


@dataclass(frozen=True, slots=True, eq=False)
class Closing:
    """A closure from the open valve."""

    model: ClosureModel
    result: ClosureResult  # with a frame for each step
    normals: FloatArray  # (n, 3), directions of the thickness at the observed vertices

    @property
    def contact_distance_mm(self) -> float:
        """Largest distance of midsurfaces at which leaflets count as coapting."""
        contact, surface = self.model.settings.contact, self.model.valve.surface
        share = contact.reference_distance + contact.activation_distance
        return 0.5 * share * float(surface.thickness.mean())

    def ends(self) -> Closing:
        """The same with the open and the last state only."""
        whole = self.result.simulation
        two = replace(whole, times=whole.times[[0, -1]], frames=whole.frames[[0, -1]])
        return replace(self, result=replace(self.result, simulation=two))

    def steps(self) -> Table:
        """Measures of each step (`mvest.scenarios.measures.measure_steps`)."""
        steps = measure_steps(self.model, self.result, self.contact_distance_mm, self.normals)
        return table(steps, **COLUMNS)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Each step: thick leaflets with stress and contact pressure (MPa), chordae and tips."""
        model, system, simulation = self.model, self.result.system, self.result.simulation
        valve = model.valve
        surface = thicken(valve.surface, self.normals)
        faces = embed(model.mesh, surface.vertices)
        loading = boundary_loading(system, valve, model.contact_valve, model.settings)
        assert system.cables is not None
        loads = [loading(float(t)) for t in simulation.times]
        pressed = [contact_pressure(system, x) for x in simulation.frames]
        # Both faces of a vertex take the value of the nearest contact sample.
        at_face = np.tile(cKDTree(pressed[0][0]).query(valve.surface.vertices)[1], 2)
        moving = {
            "stress": [faces(nodal_stress(system, x)) for x in simulation.frames],
            "contact_pressure": [values[at_face] for _, values in pressed],
            "frames": [faces(x) for x in simulation.frames],
            "tips": [own.tips for own in loads],
            "chord_end": [
                system.cables.state(x, own.tips, *system.factors.chordae).end
                for x, own in zip(simulation.frames, loads, strict=True)
            ],
        }
        return {name: np.stack(states).astype(np.float32) for name, states in moving.items()} | {
            "times": simulation.times,
            "triangles": surface.triangles.astype(np.int32),
            "region": surface.region.astype(np.int8),
            "leaflets": np.array(valve.surface.region_names),
            # Along the atrial faces.
            "annulus": valve.annulus + len(valve.surface.vertices),
            "chord_tip": system.cables.tip,
            "chord_parent": valve.chordae.parent,
            # Between faces, each half a thickness nearer than its midsurface.
            "reach_mm": np.array(
                model.contact_reach_mm - valve.surface.thickness[valve.free_edge].mean()
            ),
        }


def closed_tables(model: ClosureModel, result: ClosureResult, m: FloatArray) -> dict[str, Table]:
    """The closed valve beside published ranges, and by which tissue it resists, at ``m (p,)``.

    Nothing unless the closure ends at rest.
    """
    if not (result.simulation.converged and model.settings.protocol.equilibrium):
        return {}
    x = result.simulation.frames[-1]
    return {
        "physiology": physiology_table(physiology(model, result.system, x)),
        "resistance": resistance_table(resistance_rows(model, m, x)),
    }


def truth_of(values: Mapping[str, Any]) -> FloatArray:
    """The configured true values ``(p,)``."""
    return np.array(values["truth"]["values"], dtype=float)


def close_valve(values: Mapping[str, Any]) -> Closing:
    """Close the configured valve with the true moduli."""
    model = closure_model(values)
    with solving("closure", model):
        result = model.close(truth_of(values), sensitivities=False, every_frame=True)
    grid = band_grid(values["observation"]["columns"], values["observation"]["rows"])
    return Closing(model, result, anatomy_of(values).normal(grid.phi, grid.s))


def draw_closing(part: Any, path: Path, steps: Mapping[int, str]) -> None:
    """Draw some steps of a closure from the atrium, from the posterior side and in section.

    The section is the plane x = 0 through the middles of both leaflets.

    ``part`` is a figure or part of one, ``path`` an ``.npz`` file with `Closing.arrays`. ``steps``
    maps numbers of steps to titles; the open orifice of the last one is painted.

    Raises an `InputError` if the file cannot be read.
    """
    from matplotlib.collections import LineCollection

    from mvest.problem.fields import case_fields
    from mvest.reporting.case import drawing
    from mvest.reporting.figures import ATRIUM, View

    try:
        arrays = read_npz(path)
        count, names = len(arrays["chord_tip"]), arrays["leaflets"].tolist()
        # The ends of the chordae are points of no triangle, with the junctions last.
        shapes = np.concatenate([arrays["frames"], arrays["chord_end"]], axis=1).astype(float)
        own = {
            "rest": shapes[0],
            "frames": [f"{t:g} s" for t in arrays["times"][1:]],
            "seen": np.ones(len(shapes) - 1, dtype=bool),
            "chord_insertion": shapes.shape[1] - count + np.arange(count),
        }
        valve = case_fields(arrays | own, turned=False)
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"{path}: no arrays of a closing valve ({error})") from error
    posterior = View("seen from the posterior side", 8.0, -90.0)
    panels = part.subplots(3, len(steps), height_ratios=[1.0, 1.35, 0.9], squeeze=False)
    colours, last = drawing.leaflet_colours(valve.region), len(shapes) - 1
    for column, (k, title) in zip(panels.T, steps.items(), strict=True):
        for region in range(len(names)):
            triangles = valve.triangles[valve.region == region]
            cut, _ = plane_section(shapes[k], triangles, np.zeros(3), np.array([1.0, 0.0, 0.0]))
            colour = colours[np.argmax(valve.region == region), 0]
            column[2].add_collection(
                LineCollection(list(cut[..., 1:]), colors=[colour], linewidths=2)
            )
        column[2].set_axis_off()
        for view, axes in zip((ATRIUM, posterior), column[:2], strict=True):
            shown = view is posterior
            drawing.draw_valve(axes, valve, shapes[k], colours, view, k, chords=shown)
        column[0].set_title(title, fontsize=10)
    drawing.paint_leak(panels[0, -1], valve, shapes[last], last)
    drawing.name_leaflets(panels[0, 0], valve, names)
    drawn = [shapes[k] for k in steps]
    drawing.same_scale(list(panels[0]), drawn, ATRIUM)
    drawing.same_scale(list(panels[1]), [*drawn, *(valve.tips[k] for k in steps)], posterior)
    for axes in panels[2]:
        axes.set(aspect="equal", xlim=(-16.0, 16.0), ylim=(-20.0, 8.0))
