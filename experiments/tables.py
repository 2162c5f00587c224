"""Everything in ``results/`` from its records: ``mvest tables [FOLDER]``.

``report.html`` shows all results on one page that needs no other file. Each ``NAME.md`` of the
results is a section, with the pictures ``NAME.png`` and ``NAME_PART.png`` and their captions in it.
Pictures are embedded and there is no script. Text is escaped by the template, and Markdown is
rendered without raw HTML and pictures from elsewhere.
"""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path
from typing import Any

from markdown_it import MarkdownIt
from markupsafe import Markup

from experiments.results.published import RECORDS, regenerate
from experiments.sweeps.collected import read_sweeps
from experiments.sweeps.report import write_sweep
from mvest.files import write_atomically
from mvest.reporting.markup import shown_text
from mvest.reporting.pictures import embedded, rendered

REPORT = "report.html"

PICTURE = re.compile(r"^!\[(.*)\]\(([\w-]+)\.png\)$", re.MULTILINE)
"""How a page of the results shows a picture."""


def write_report(results: Path) -> Path:
    """Write ``report.html`` from what a folder of results holds; returns its path.

    Equal files give an equal page.

    Raises
    ------
    InputError
        If a picture cannot be read or the page cannot be written.
    """
    pages = sorted(results.glob("*.md"))
    names = [path.stem for path in pages]
    pictures: dict[str, list[Path]] = {name: [] for name in names}
    for path in sorted(results.glob("*.png")):
        owners = [name for name in names if f"{path.stem}_".startswith(f"{name}_")]
        if owners:
            pictures[max(owners, key=len)].append(path)
    sections = [_section(path, pictures[path.stem]) for path in pages]
    return write_atomically(
        results / REPORT,
        rendered("page.html.jinja", Path(__file__).parent / "results", sections=sections),
    )


def _section(path: Path, pictures: list[Path]) -> dict[str, Any]:
    title, body = path.stem, path.read_text(encoding="utf-8")
    heading, _, rest = body.partition("\n")
    if heading.startswith("# "):
        title, body = heading.removeprefix("# "), rest
    captions = {name: _plain(caption) for caption, name in PICTURE.findall(body)}
    # The one tag that these files use; any other is shown as text.
    body = re.sub(r"</?sub>", "", PICTURE.sub("", body))
    # Below the section's own heading.
    body = re.sub(r"^(#+ )", r"#\1", body, flags=re.MULTILINE)
    markdown = MarkdownIt("commonmark", {"html": False}).enable("table").disable("image")
    html = markdown.render(shown_text(body))
    html = html.replace("<table>", '<div class="scroll tall"><table>')
    html = html.replace("</table>", "</table></div>")
    return {
        "anchor": path.stem,
        "title": title,
        "body": Markup(html),
        "pictures": [
            embedded(one) | {"caption": captions.get(one.stem, one.stem)} for one in pictures
        ],
    }


def _plain(markdown: str) -> str:
    """Text that was escaped for Markdown."""
    return unescape(re.sub(r"\\(\W)", r"\1", markdown))


def write_everything(results: Path) -> list[Path]:
    """Regenerate the tables, figures and page of a folder of results; returns their paths."""
    sweeps = read_sweeps(results)
    # A folder that holds sweeps alone is complete; an empty one says what to run.
    single = (results / RECORDS).is_dir() or not sweeps
    written = regenerate(results) if single else []
    for sweep in sweeps:
        written += write_sweep(results, sweep)
    return [*written, write_report(results)]
