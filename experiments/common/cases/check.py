"""What ``check=true`` says of a case: how it was read, and what an estimate of it could tell."""

from __future__ import annotations

from pathlib import Path

from experiments.common.building.closure import mesh_store
from experiments.common.cases.own_case import settings_of
from experiments.common.cases.settings import PersonalSettings
from experiments.common.progress import SolveBar
from experiments.common.schema import Values, build
from mvest.cases.case import Role, ValveCase
from mvest.cases.plausibility import doubts
from mvest.personalisation.design import expect_case
from mvest.personalisation.model import build_coarse, gate_case, gate_lines
from mvest.personalisation.result import Expected


def check(values: Values, case: ValveCase, folder: Path, *, gate: bool = False) -> str:
    """Check and draw a case, and say what an estimate of it could tell.

    ``check.html`` in the folder says the same.

    Parameters
    ----------
    values : mapping
        The configuration.
    case : ValveCase
    folder : Path
        Of the run.
    gate : bool
        Whether to test that its closed state is the only one, which takes minutes.
    """
    from mvest.reporting.case.figures import frames_figure
    from mvest.reporting.case.report import check_page
    from mvest.reporting.case.tables import expected_tables
    from mvest.reporting.figures import save_figure_with

    settings = settings_of(values, build(PersonalSettings, values["personal"]))
    coarse = build_coarse(case, settings, mesh_store(values))
    figure = frames_figure(case, coarse.contact_reach_mm)
    drawn = save_figure_with(folder / "case", figure, f"case {case.sha256[:12]}")
    lines = _described(case)
    if gate:
        lines += gate_lines(gate_case(case, settings, mesh_store(values)))
    strange = doubts(case)
    lines += [f"{'MISTAKE?' if one.mistake else 'implausible'}: {one}" for one in strange]
    lines.append(
        f"Implausible values: {len(strange)}; look at them before anything is estimated "
        "(strict=true refuses them)"
        if strange
        else "In order"
    )
    expected = Expected(reason="an open frame alone, from which nothing can be estimated")
    if case.closed is not None:
        with SolveBar(case.name, len(settings.mechanics.protocol.steps()), 1) as bar:
            coarse.on_step = bar.step
            expected = expect_case(case, settings, coarse)
    page = check_page(folder, case.name, lines, expected, drawn[-1])
    tables = expected_tables(expected) if expected.unknowns else {}
    told = [f"{name}\n{one.text()}" for name, one in tables.items()]
    lacking = [f"what an estimate could tell is not known: {expected.reason}"]
    return "\n".join([case.name, *lines, *(told or lacking), f"drawn and written: {page}"])


def _described(case: ValveCase) -> list[str]:
    """A case as it was read, in lines."""
    surface, tips = case.surface, case.frame(Role.REFERENCE).papillary_tips
    lines = [
        f"{len(surface.vertices)} vertices, {len(surface.triangles)} triangles, leaflets "
        f"{', '.join(surface.region_names)}; {len(case.chordae)} chordae from {len(tips)} "
        "papillary tips"
    ]
    for frame in case.frames:
        same = "same vertices as the reference" if frame.corresponds else "without correspondence"
        lines.append(
            f"frame {frame.name} ({frame.role.value}) at {frame.time:g} s, "
            f"{frame.pressure_mmHg:g} mmHg, {len(frame.vertices)} vertices"
            + ("" if frame.role is Role.REFERENCE else f", {same}")
        )
    return [*lines, *(f"derived: {sentence}" for sentence in case.derived)]
