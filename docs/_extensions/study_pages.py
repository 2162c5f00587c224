"""One page for each study, written from ``conf``, ``results/`` and the notes.

A page belongs to a table of ``results/``. Its title and commands come from the experiments that
name that table, its numbers and figures from the files of that name. Notes in
``docs/study_notes/NAME.md`` are optional; their header gives ``title``, ``group`` and ``order``.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import yaml

from experiments.results.renewal import Configured, configured, status_of, without_records

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ELSEWHERE = ("dashboard",)
"""Pictures shown on other pages."""

LAST = "Further studies"
"""The group of pages without notes."""


@dataclass
class Page:
    """Content of one page."""

    name: str
    title: str = ""
    group: str = LAST
    order: int = 1000
    notes: str = ""
    experiments: list[Configured] = field(default_factory=list)
    tables: list[str] = field(default_factory=list)
    pictures: list[str] = field(default_factory=list)
    stale: str = ""

    def owns(self, stem: str) -> bool:
        """Whether a file of ``results/`` belongs to this page."""
        return stem == self.name or stem.startswith(f"{self.name}_")


def read_notes(folder: Path) -> list[Page]:
    """Pages from notes."""
    pages = []
    for path in sorted(folder.glob("*.md")):
        head, _, body = path.read_text(encoding="utf-8").removeprefix("---\n").partition("\n---\n")
        data = yaml.safe_load(head)
        pages.append(
            Page(
                path.stem,
                data["title"],
                data["group"],
                data["order"],
                body.strip(),
            )
        )
    return pages


def all_pages(root: Path) -> list[Page]:
    """All pages with their experiments, tables and pictures."""
    results = root / "results"
    tables = sorted(path.stem for path in results.glob("*.md"))
    pictures = sorted(path.stem for path in results.glob("*.png") if path.stem not in ELSEWHERE)
    pages = read_notes(root / "docs" / "study_notes")
    experiments: dict[str, list[Configured]] = {}
    for group in ("experiment", "sweep"):
        known = set(experiments)
        for one in configured(root / "conf" / group):
            if one.table not in known:
                experiments.setdefault(one.table, []).append(one)

    def page_of(stem: str) -> Page | None:
        owners = [page for page in pages if page.owns(stem)]
        return max(owners, key=lambda page: page.name == stem, default=None)

    for table in [*experiments, *sorted(tables, key=len)]:
        has_results = any(t == table or t.startswith(f"{table}_") for t in tables)
        if page_of(table) is None and has_results:
            pages.append(Page(table))
    for table, members in experiments.items():
        if (page := page_of(table)) is not None:
            page.experiments += members
    for stem in tables:
        if (page := page_of(stem)) is not None:
            page.tables.append(stem)
    for stem in pictures:
        if (page := page_of(stem)) is not None:
            page.pictures.append(stem)
    for page in pages:
        first = page.experiments[0].values.get("title") if page.experiments else None
        page.title = page.title or str(first or page.name)
        page.stale = stale_text(page, results)
    return sorted(pages, key=lambda page: (page.order, page.title))


PICTURE = re.compile(r"^!\[(.*)\]\((\w+)\.png\)$", re.MULTILINE)
"""How a page of ``results/`` shows a figure."""


def table_text(path: Path) -> str:
    """A page of ``results/``: headings two levels deeper, figures in full size."""
    text = path.read_text(encoding="utf-8").strip()
    text = PICTURE.sub(lambda found: picture_text(found[2], found[1]), text)
    return re.sub(r"^(#+) ", r"##\1 ", text, flags=re.MULTILINE)


def text_of(page: Page, results: Path) -> str:
    """The page in Markdown."""
    parts = [f"# {page.title}"]
    if page.notes:
        parts.append(page.notes)
    else:
        parts += [experiment.about for experiment in page.experiments[:1]]
    if page.experiments:
        rows = [f"    {experiment.command}" for experiment in page.experiments]
        parts += ["## Run it", "\n".join(rows)]
    parts.append("## Results")
    parts += [page.stale] if page.stale else []
    tables = [(results / f"{stem}.md") for stem in page.tables]
    shown = {found[2] for path in tables for found in PICTURE.finditer(path.read_text("utf-8"))}
    parts += [picture_text(stem) for stem in page.pictures if stem not in shown]
    parts += [table_text(path) for path in tables]
    return "\n\n".join(parts) + "\n"


def stale_text(page: Page, results: Path) -> str:
    """What a page says if its results are not of today's code and configuration."""
    if without_records(results).get(page.name):
        return "**Stale**: the golden numbers that these results follow have changed since."
    published = [one for one in page.experiments if one.values.get("publish")]
    found = [one for one in (status_of(each, results) for each in published) if one.text]
    if not found:
        return ""
    command = f"mvest results {' '.join(one.of.name for one in found)} --run"
    word = "Stale" if any(one.stale for one in found) else "Incomplete"
    return f"**{word}**: {', '.join(one.text for one in found)}. Renew with `{command}`."


def picture_text(stem: str, caption: str = "") -> str:
    """A figure of ``results/``, linked to its full size."""
    options = f":alt: {stem}\n:target: ../_images/{stem}.png"
    return f"```{{figure}} ../../results/{stem}.png\n{options}\n\n{caption}\n```"


def question_of(page: Page) -> str:
    """The first question of the notes, or else their first sentence."""
    text = " ".join((page.notes or "".join(one.about for one in page.experiments)).split())
    sentences = re.findall(r"[^.?]+(?:[.?](?!\s))*[^.?]*[.?](?=\s|$)", text)
    asked = [sentence for sentence in sentences[:4] if sentence.endswith("?")]
    return (asked or sentences or [""])[0].strip()


def index_of(pages: list[Page]) -> str:
    """The index of all pages, by group."""
    parts = [
        "# Studies",
        "Each page has the question of a study, the command that repeats it, and its tables and "
        "figures from `results/`, with commit and configuration. Everything is simulated, except "
        "the donor valve and the shape of the reference heart.",
    ]
    if stale := sum(bool(page.stale) for page in pages):
        parts.append(
            f"Results of {stale} of {len(pages)} pages are stale or incomplete, by the code and "
            "configuration of today; these are marked."
        )
    for group in dict.fromkeys(page.group for page in pages):
        members = [page for page in pages if page.group == group]
        names = "\n".join(f"{page.title} <{page.name}>" for page in members)
        lines = [
            f"* [{page.title}]({page.name}.md). {question_of(page)}"
            + (" *Stale.*" if page.stale else "")
            for page in members
        ]
        parts.append(f"## {group}\n\n" + "\n".join(lines))
        parts.append(f"```{{toctree}}\n:hidden:\n:caption: {group}\n\n{names}\n```")
    return "\n\n".join(parts) + "\n"


def write_study_pages(root: Path, folder: Path) -> None:
    """Write all pages into a folder and remove others; unchanged files are not touched."""
    folder.mkdir(exist_ok=True)
    pages = all_pages(root)
    texts = {f"{page.name}.md": text_of(page, root / "results") for page in pages}
    texts["index.md"] = index_of(pages)
    for path in folder.glob("*.md"):
        if path.name not in texts:
            path.unlink()
    for name, text in texts.items():
        path = folder / name
        if not path.is_file() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages before Sphinx reads its sources."""
    docs = Path(app.srcdir)
    write_study_pages(docs.parent, docs / "studies")
    return {"parallel_read_safe": True, "parallel_write_safe": True}
