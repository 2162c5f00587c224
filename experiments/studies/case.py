"""One's own valve: from a case folder to moduli with intervals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.common.building.closure import mesh_store
from experiments.common.cases.own_case import (
    case_words,
    expect_own,
    read_configured,
    run_case,
    settings_of,
    write_report,
)
from experiments.common.cases.settings import CaseInput, PersonalSettings
from experiments.common.schema import build
from experiments.common.study import Job, Result, Study
from mvest.cases.case import Role, ValveCase
from mvest.cases.plausibility import doubts, require_plausible
from mvest.personalisation.model import build_model, gate_case, gate_lines


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    case: CaseInput = None  # folder of a case
    strict: bool = False  # refuse an implausible case, instead of saying so
    gate: bool = False  # with check=true: test whether the closed state is the only one, minutes
    personal: PersonalSettings


def run(job: Job[Settings]) -> Result:
    """Read the configured case and personalise it."""
    return run_case(job.values, job.settings.personal, _read(job.values))


def check_case(values: Mapping[str, Any], folder: Path) -> str:
    """Read, check and draw a case without simulating anything, and describe it."""
    from mvest.reporting.case.figures import frames_figure
    from mvest.reporting.figures import save_figure_with

    case = _read(values)
    settings = settings_of(values, build(PersonalSettings, values["personal"]))
    model = build_model(case, settings, mesh_store(values))
    figure = frames_figure(case, model.contact_reach_mm)
    drawn = save_figure_with(folder / "case", figure, f"case {case.sha256[:12]}")[0]
    surface, tips = case.surface, case.frame(Role.REFERENCE).papillary_tips
    lines = [
        f"{case.name}: {len(surface.vertices)} vertices, {len(surface.triangles)} triangles, "
        f"leaflets {', '.join(surface.region_names)}; {len(case.chordae)} chordae from "
        f"{len(tips)} papillary tips"
    ]
    for frame in case.frames:
        same = "same vertices as the reference" if frame.corresponds else "without correspondence"
        lines.append(
            f"  frame {frame.name} ({frame.role.value}) at {frame.time:g} s, "
            f"{frame.pressure_mmHg:g} mmHg, {len(frame.vertices)} vertices"
            + ("" if frame.role is Role.REFERENCE else f", {same}")
        )
    lines += [f"  derived: {sentence}" for sentence in case.derived]
    lines += [
        f"  mesh: {len(model.mesh.nodes)} nodes, {len(model.mesh.elements)} "
        f"{model.mesh.element_type}",
        f"  unknowns: {', '.join(u.name for u in settings.unknowns)}",
    ]
    if values["gate"]:
        lines += gate_lines(gate_case(case, settings, mesh_store(values)))
    strange = doubts(case)
    lines += [f"  {'MISTAKE?' if one.mistake else 'implausible'}: {one}" for one in strange]
    if strange:
        lines.append(
            f"Implausible values: {len(strange)}; look at them before anything is estimated "
            f"(strict=true refuses them); drawn in {drawn}"
        )
    else:
        lines.append(f"In order; drawn in {drawn}")
    return "\n".join(lines)


def _read(values: Mapping[str, Any]) -> ValveCase:
    case = read_configured(values["case"])
    if values["strict"]:
        require_plausible(case)
    return case


STUDY = Study(
    settings=Settings,
    run=run,
    words=case_words,
    files=write_report,
    checks=lambda: (check_case, expect_own),
)
