"""``report.html``: all published sweeps and the other results on one page that needs nothing else.

Pictures are embedded, there is no script, and nothing is loaded from anywhere. Text that came from
runs is escaped by the template; Markdown is rendered with raw HTML switched off.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markdown_it import MarkdownIt
from markupsafe import Markup

import mvest
from experiments.sweeps.conclusions import conclusions, question
from experiments.sweeps.report import COST, pictures_of, read_sweeps
from experiments.sweeps.rows import (
    Sweep,
    factor_label,
    factor_names,
    factor_text,
    runs_of,
    sweep_line,
)
from experiments.sweeps.tables import failure_rows, summary, table_note
from mvest.files import write_atomically
from mvest.reporting.pictures import embedded

__all__ = ["REPORT", "write_report"]

REPORT = "report.html"
TEMPLATES = (Path(__file__).parent, Path(mvest.__file__).parent / "reporting" / "templates")

MOST_FAILURES = 200
"""Listed one by one on the page; the tidy table has all."""

ORDER = ("initial_guess", "noise", "covariance", "filter", "discrepancy")
"""Sweeps of these kinds come first, in this order."""

NOT_SETTINGS = ("paths", "hydra", "sweep", "title", "paper", "parameters", "name", "row", "table",
                "publish", "force", "dry_run", "time_limit_s", "factors")  # fmt: skip
"""Parts of a configuration that say where and how it runs or what it is called."""

OTHERS = (
    ("table1", "Table 1", ("table1", "table1_valve")),
    ("mesh_independence", "Independence of the mesh", ()),
    ("strip", "Clamped strips", ()),
    ("gate", "One closed state", ()),
    ("closure", "A closing valve", ("closure",)),
    ("law", "Two material laws on the same valve (simulated)", ("law", "law_biaxial")),
    (
        "identifiability",
        "What data can tell, before any are taken",
        ("identifiability_designs", "identifiability_profiles", "identifiability_valley"),
    ),
    ("filters", "Filters and the posterior itself (simulated)", ("filters",)),
    ("table2", "Table 2: moduli of five virtual patients (simulated)", ()),
    ("table3", "Table 3: distances of their closed valves (simulated)", ("figure3",)),
    ("population", "Virtual patients drawn at random (simulated)", ("population",)),
    (
        "imaging",
        "Leaflets found in simulated echo volumes",
        ("imaging_distance", "imaging_training", "imaging_confidence", "imaging_std"),
    ),
    ("joint", "Chordal length and moduli from a whole cycle (simulated)", ("joint",)),
    (
        "joint_open",
        "The same of a valve that opens fully (simulated)",
        ("joint_open",),
    ),
    ("cycle", "What the frames of a cycle tell (simulated)", ("cycle",)),
    ("prediction", "What an estimated valve would do (simulated)", ("prediction",)),
    ("chord", "Chordae by family", ("chord",)),
    ("patch", "A stiff patch of a leaflet", ("patch",)),
    ("donor", "A recorded donor valve", ("donor",)),
    ("models", "Other biomechanical models (simulated)", ("models",)),
    ("benchmark", "How fast", ("benchmark",)),
)
"""Other results: Markdown file, title where it has none, and the pictures beside it."""
CAPTIONS = {
    "table1": "Estimates after each iteration, ± 2 standard deviations, and the truth. Simulated.",
    "table1_valve": "The fitted valve, open and closed. Simulated.",
    "closure": "A valve closing. Simulated.",
    "law": "Stress of each leaflet under equibiaxial stretch: true, as estimated with the "
    "exponential law, and with the linear law from the same data. Simulated.",
    "law_biaxial": "The exponential law with the coefficients of excised leaflets.",
    "identifiability_designs": "Expected standard deviation of a modulus with each design: which "
    "vertices are seen, with which errors, in which frames, and what is known of the nuisances. "
    "Simulated.",
    "identifiability_profiles": "Profile likelihoods: the least misfit with one parameter held, "
    "and how the others then make up for it. Simulated.",
    "identifiability_valley": "95 % regions of a modulus with a nuisance, for different frames; "
    "the floor of the valley that the profile followed. Simulated.",
    "filters": "Posterior of each unknown by Monte Carlo, and what each filter takes it for. "
    "Simulated.",
    "figure3": "Figure 3: closed valves coloured by their distance from what was observed, with "
    "generic and with personalised stiffness, on one scale. Drawn are midsurfaces: leaflets that "
    "touch lie a thickness apart, so that a white slit is not yet a leak. Simulated.",
    "population": "Estimates with their 95 % intervals against the hidden truth. Simulated.",
    "imaging_distance": "Distance of found leaflets from true ones, volume by volume. Simulated.",
    "imaging_training": "Errors of each stage against the number of training volumes. Simulated.",
    "imaging_confidence": "Confidence in volumes with and without a valve. Simulated.",
    "imaging_std": "Standard deviation that the image step tells of each point. Simulated.",
    "joint": "Estimates as frames come in, errors over seeds, and what two frames and a whole "
    "cycle could tell. Simulated.",
    "joint_open": "As the figure before, of a valve that opens fully. Simulated.",
    "cycle": "The cycle and its frames, what they tell of each parameter, and a modulus that "
    "drifts over beats, filtered and smoothed. Simulated.",
    "prediction": "A leaking valve closed as observed and under changed conditions, seen from the "
    "atrium, and measures of it with their 95 % intervals. Simulated.",
    "chord": "What is known of chordae and leaflets before and after the data. Simulated.",
    "patch": "True and found modulus of the unrolled anterior leaflet, and how sure. Simulated.",
    "donor": "A recorded donor valve and closures of its model.",
    "models": "A pressed sheet in two finite-element codes: deformed, its moduli iterate by "
    "iterate under each model, and how the codes differ on finer meshes. Simulated.",
    "benchmark": "Where the time goes.",
}


def write_report(results: Path) -> Path:
    """Write ``report.html`` from what ``results`` holds; returns its path.

    Pictures are those that `experiments.sweeps.report.write_sweep` and the other studies left
    there; one that does not exist is left out. Equal files give an equal page.

    Raises
    ------
    InputError
        If a published sweep is damaged, a picture cannot be read or the page cannot be written.
    """
    sweeps = sorted(read_sweeps(results), key=_place)
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        keep_trailing_newline=True,
    )
    page = environment.get_template("page.html.jinja").render(
        sweeps=[_sweep_section(results, sweep) for sweep in sweeps],
        others=[
            _other_section(results, name, title, pictures)
            for name, title, pictures in OTHERS
            if (results / f"{name}.md").is_file()
        ],
    )
    return write_atomically(results / REPORT, page)


def _place(sweep: Sweep) -> tuple[int, str]:
    kind = sweep["sweep"]["kind"]
    return (ORDER.index(kind) if kind in ORDER else len(ORDER)), str(sweep["sweep"]["name"])


def _sweep_section(results: Path, sweep: Sweep) -> dict[str, Any]:
    base = f"sweep_{sweep['sweep']['name']}"
    found = [
        (picture, embedded(path, picture.caption))
        for picture in pictures_of(sweep)
        if (path := results / f"{base}{picture.ending}.png").is_file()
    ]
    failures = failure_rows(sweep)
    endings = (".csv", "_table.csv", "_table.md", "_table.tex", "_cost.csv")
    return {
        "anchor": base,
        "title": str(sweep["title"]),
        "question": question(sweep),
        "conclusions": conclusions(sweep),
        "pictures": [shown for picture, shown in found if picture is not COST],
        "cost": [shown for picture, shown in found if picture is COST],
        "table": summary(sweep)[1],
        "has_paper": bool(sweep.get("paper")),
        "note": table_note(sweep),
        "failures": failures[:MOST_FAILURES],
        "more_failures": max(len(failures) - MOST_FAILURES, 0),
        "failed": sum(not run.converged for run in runs_of(sweep)),
        "runs": len(runs_of(sweep)),
        "factors": _factors(sweep),
        "settings": _settings(sweep.get("settings") or {}),
        "provenance": sweep_line(sweep),
        "cache": _cache(sweep),
        "files": [
            f"{base}{ending}" for ending in endings if (results / f"{base}{ending}").is_file()
        ],
    }


def _factors(sweep: Sweep) -> list[dict[str, str]]:
    rows = []
    for name in factor_names(sweep):
        values = dict.fromkeys(factor_text(job["factors"].get(name)) for job in sweep["jobs"])
        rows.append({"factor": factor_label(name), "values": ", ".join(values)})
    seeds = {run.seed for run in runs_of(sweep) if run.seed is not None}
    if len(seeds) > 1:
        rows.append({"factor": "seed", "values": f"{min(seeds)} to {max(seeds)}"})
    return rows


def _settings(settings: Mapping[str, Any]) -> list[dict[str, str]]:
    """Nested settings as rows of dotted names; lists stay in one cell."""
    rows: list[dict[str, str]] = []

    def walk(value: Any, name: str) -> None:
        if isinstance(value, Mapping):
            for key, inner in value.items():
                walk(inner, f"{name}.{key}" if name else str(key))
        else:
            rows.append({"setting": name, "value": _setting_text(value)})

    walk({key: value for key, value in settings.items() if key not in NOT_SETTINGS}, "")
    return rows


def _setting_text(value: Any) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(_setting_text(item) for item in value) + "]"
    return factor_text(value)


def _cache(sweep: Sweep) -> str:
    """How often a simulated truth was taken from the store."""
    hits, misses = sweep.get("truth_hits"), sweep.get("truth_misses")
    if hits is None or misses is None or not hits + misses:
        return ""
    return f"Of {hits + misses} requests for a simulated truth, {hits} were served from the store."


def _other_section(results: Path, name: str, title: str, pictures: Sequence[str]) -> dict[str, Any]:
    body = (results / f"{name}.md").read_text(encoding="utf-8")
    heading, _, rest = body.partition("\n")
    if heading.startswith("# "):
        title, body = heading.removeprefix("# "), rest
    # The one tag that these files use for their last lines; any other is shown as text.
    body = re.sub(r"</?sub>", "", body)
    # Below the section's own heading.
    body = re.sub(r"^(#+ )", r"#\1", body, flags=re.MULTILINE)
    html = MarkdownIt("commonmark", {"html": False}).enable("table").render(body)
    html = html.replace("<table>", '<div class="scroll tall"><table>')
    html = html.replace("</table>", "</table></div>")
    found = [(results / f"{picture}.png", CAPTIONS[picture]) for picture in pictures]
    return {
        "anchor": name,
        "title": title,
        "body": Markup(html),
        "pictures": [embedded(path, caption) for path, caption in found if path.is_file()],
    }
