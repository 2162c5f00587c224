"""``report.html``: all published sweeps and the other results on one page that needs nothing else.

Pictures are embedded, there is no script, and nothing is loaded from anywhere. Text that came from
runs is escaped by the template; Markdown is rendered with raw HTML switched off.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt
from markupsafe import Markup

from experiments.common.study import Section, Study, load_study, study_names
from experiments.results.keep import records_of
from experiments.sweeps.collected import Sweep
from experiments.sweeps.conclusions import conclusions, question
from experiments.sweeps.report import COST, pictures_of, read_sweeps
from experiments.sweeps.rows import (
    factor_label,
    factor_names,
    factor_text,
    runs_of,
    sweep_line,
)
from experiments.sweeps.tables import failure_rows, summary, table_note
from mvest.files import write_atomically
from mvest.reporting.markup import shown_text
from mvest.reporting.page import rendered
from mvest.reporting.pictures import embedded

__all__ = ["REPORT", "write_report"]

REPORT = "report.html"

MAX_FAILURES = 200
"""Listed one by one on the page; the tidy table has all."""

ORDER = ("initial_guess", "noise", "covariance", "filter", "discrepancy")
"""Sweeps of these kinds come first, in this order."""

NOT_SETTINGS = ("paths", "hydra", "sweep", "title", "paper", "parameters", "name", "row", "table",
                "publish", "force", "dry_run", "detach", "time_limit_s", "memory_limit_gb",
                "factors")  # fmt: skip
"""Parts of a configuration that say where and how it runs or what it is called."""

OTHERS = (
    Section("strip", title="Clamped strips", validation=True),
    Section(
        "shells",
        {"shells": "Thin shells under their largest load, and published deflections (points)."},
        "Thin shells",
        validation=True,
    ),
    Section("febio", title="The same in FEBio", validation=True),
    Section("benchmark", {"benchmark": "Where the time goes."}, "How fast", validation=True),
)
"""What no study made."""


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
    others = [
        _other_section(results, section, study)
        for section, study in _sections()
        if (results / f"{section.name}.md").is_file()
    ]
    page = rendered(
        "page.html.jinja",
        Path(__file__).parent,
        sweeps=[_sweep_section(results, sweep) for sweep in sweeps],
        parts=[
            ("Validation", [section for section in others if section["validation"]]),
            ("Studies", [section for section in others if not section["validation"]]),
        ],
        # What failed stands beside what did not, also where it has no picture.
        opening=sorted(
            (section for section in others if section["headline"] and section["answer"]),
            key=lambda section: not section["validation"],
        ),
    )
    return write_atomically(results / REPORT, page)


def _place(sweep: Sweep) -> tuple[int, str]:
    return (ORDER.index(sweep.kind) if sweep.kind in ORDER else len(ORDER)), sweep.name


def _sweep_section(results: Path, sweep: Sweep) -> dict[str, Any]:
    base = f"sweep_{sweep.name}"
    found = [
        (picture, embedded(path, picture.caption))
        for picture in pictures_of(sweep)
        if (path := results / f"{base}{picture.ending}.png").is_file()
    ]
    failures = failure_rows(sweep)
    endings = (".csv", "_table.csv", "_table.md", "_table.tex", "_cost.csv")
    return {
        "anchor": base,
        "title": sweep.title,
        "question": question(sweep),
        "conclusions": conclusions(sweep),
        "pictures": [shown for picture, shown in found if picture is not COST],
        "cost": [shown for picture, shown in found if picture is COST],
        "table": summary(sweep)[1],
        "has_paper": sweep.paper is not None,
        "note": table_note(sweep),
        "failures": failures[:MAX_FAILURES],
        "more_failures": max(len(failures) - MAX_FAILURES, 0),
        "failed": sum(not run.converged for run in runs_of(sweep)),
        "runs": len(runs_of(sweep)),
        "factors": _factors(sweep),
        "settings": _settings(sweep.settings),
        "provenance": sweep_line(sweep),
        "cache": _cache(sweep),
        "files": [
            f"{base}{ending}" for ending in endings if (results / f"{base}{ending}").is_file()
        ],
    }


def _factors(sweep: Sweep) -> list[dict[str, str]]:
    rows = []
    for name in factor_names(sweep):
        values = dict.fromkeys(factor_text(job.factors.get(name)) for job in sweep.jobs)
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
    hits, misses = sweep.truth_hits, sweep.truth_misses
    if not hits + misses:
        return ""
    return f"Of {hits + misses} requests for a simulated truth, {hits} were served from the store."


def _sections() -> list[tuple[Section, Study[Any, Any] | None]]:
    """Sections of all studies, each with its study, and those that no study made."""
    found: list[tuple[Section, Study[Any, Any] | None]] = []
    for name in study_names():
        study = load_study(name)
        found += [(section, study) for section in study.sections]
    return [*found, *((section, None) for section in OTHERS)]


def _other_section(
    results: Path, section: Section, study: Study[Any, Any] | None
) -> dict[str, Any]:
    title = section.title
    body = (results / f"{section.name}.md").read_text(encoding="utf-8")
    heading, _, rest = body.partition("\n")
    if heading.startswith("# "):
        title, body = heading.removeprefix("# "), rest
    # The one tag that these files use for their last lines; any other is shown as text.
    body = re.sub(r"</?sub>", "", body)
    # Below the section's own heading.
    body = re.sub(r"^(#+ )", r"#\1", body, flags=re.MULTILINE)
    html = MarkdownIt("commonmark", {"html": False}).enable("table").render(shown_text(body))
    html = html.replace("<table>", '<div class="scroll tall"><table>')
    html = html.replace("</table>", "</table></div>")
    found = [(results / f"{picture}.png", caption) for picture, caption in section.pictures.items()]
    return {
        "anchor": section.name,
        "title": title,
        "body": Markup(html),
        "pictures": [
            embedded(path, caption)
            for path, caption in found
            if path.is_file() and path.stem != section.opens
        ],
        "validation": section.validation,
        "answer": _answer(results, section, study),
        "headline": section.headline,
        "opens": _opening(results, section),
    }


def _answer(results: Path, section: Section, study: Study[Any, Any] | None) -> str:
    """What follows from the kept records of a section's table, in one line."""
    if section.answer is None or study is None:
        return ""
    records = records_of(results, section.table or section.name, study.findings)
    return section.answer(records) if records else ""


def _opening(results: Path, section: Section) -> Any:
    """The picture of a section with which the page begins, if there is one."""
    path = results / f"{section.opens}.png"
    if not section.opens or not path.is_file():
        return None
    return embedded(path, section.pictures[section.opens])
