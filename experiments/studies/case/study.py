"""One's own valve: from a case folder to moduli with intervals."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.common.building.closure import mesh_store
from experiments.common.cases.findings import Findings
from experiments.common.cases.own_case import expect_own, read_configured, run_case, settings_of
from experiments.common.cases.report import case_text, write_cases
from experiments.common.cases.settings import PersonalSettings
from experiments.common.records.record import Outcome
from experiments.common.schema import build
from experiments.common.study import Job, Study
from experiments.studies.case.settings import Settings
from mvest.cases.case import Frame, Role, ValveCase
from mvest.cases.plausibility import doubts, require_plausible
from mvest.personalisation.gate import gate_case, gate_lines
from mvest.personalisation.model import build_model
from mvest.reporting.case.fields import turn_of
from mvest.scenarios.measures import contact_reach

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["STUDY", "check_case", "run_own_case"]


def run_own_case(job: Job[Settings]) -> Outcome[Findings]:
    """Read the configured case and personalise it."""
    case = _read(job.values)
    return run_case(job.values, job.settings.personal, case, job.folder)


def check_case(values: Mapping[str, Any], folder: Path) -> str:
    """Read, check and draw a case without simulating anything, and describe it.

    Raises
    ------
    MvestError
        If the case is not in order.
    """
    from mvest.reporting.figures import save_figure_with

    case = _read(values)
    settings = settings_of(values, build(PersonalSettings, values["personal"]))
    model = build_model(case, settings, mesh_store(values))
    surface = case.surface
    figure = _drawn(case, contact_reach(model))
    files = save_figure_with(folder / "case", figure, f"case {case.sha256[:12]}")
    lines = [
        f"{case.name}: {len(surface.vertices)} vertices, {len(surface.triangles)} triangles, "
        f"leaflets {', '.join(surface.region_names)}; {len(case.chordae)} chordae from "
        f"{len(case.frame(Role.REFERENCE).papillary_tips)} papillary tips",
        *(f"  {_frame_words(frame)}" for frame in case.frames),
        *(f"  derived: {sentence}" for sentence in case.derived),
        f"  mesh: {len(model.mesh.nodes)} nodes, {len(model.mesh.elements)} "
        f"{model.mesh.element_type}",
        f"  unknowns: {', '.join(u.name for u in settings.unknowns)}",
    ]
    if values["gate"]:
        lines += gate_lines(gate_case(case, settings, mesh_store(values)))
    strange = doubts(case)
    lines += [f"  {'MISTAKE?' if one.mistake else 'doubtful'}: {one}" for one in strange]
    drawn = f"drawn in {files[0]}"
    if strange:
        count = "1 thing is" if len(strange) == 1 else f"{len(strange)} things are"
        lines.append(
            f"{count} hardly so; look at them before anything is estimated (strict=true refuses "
            f"them); {drawn}"
        )
    else:
        lines.append(f"In order; {drawn}")
    return "\n".join(lines)


def _read(values: Mapping[str, Any]) -> ValveCase:
    case = read_configured(values["case"])
    if values["strict"]:
        require_plausible(case)
    return case


def _drawn(case: ValveCase, reach_mm: float) -> Figure:
    from mvest.reporting.case.frames import frame_fields, frames_figure

    surface, chordae = case.surface, case.chordae
    tips = case.frame(Role.REFERENCE).papillary_tips
    middle, axes = turn_of(surface.vertices, case.annulus, surface.triangles, surface.region, tips)
    shapes = {}
    for frame in case.frames:
        at_rest = frame.role is Role.REFERENCE
        title = f"{frame.name} ({frame.role.value})\n{frame.time:g} s, {frame.pressure_mmHg:g} mmHg"
        shapes[title] = frame_fields(
            (frame.vertices - middle) @ axes,
            frame.triangles,
            frame.region,
            (frame.annulus - middle) @ axes,
            (frame.papillary_tips - middle) @ axes,
            chordae.tip if at_rest else None,
            (chordae.insertion - middle) @ axes if at_rest else None,
            reach_mm if frame.role is Role.CLOSED else None,
        )
    return frames_figure(shapes, case.surface.region_names)


def _frame_words(frame: Frame) -> str:
    same = ", same vertices as the reference" if frame.corresponds else ", without correspondence"
    return (
        f"frame {frame.name} ({frame.role.value}) at {frame.time:g} s, "
        f"{frame.pressure_mmHg:g} mmHg, {len(frame.vertices)} vertices"
        f"{'' if frame.role is Role.REFERENCE else same}"
    )


STUDY = Study(
    settings=Settings,
    findings=Findings,
    run=run_own_case,
    words=case_text,
    write=write_cases,
    checks=lambda: (check_case, expect_own),
)
