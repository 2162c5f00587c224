"""``report.html`` of one case: what was estimated, how far to trust it, and what it rests on.

The page opens from disk and loads nothing: pictures and the script of the turnable valve are in
it, and its content policy forbids every request. Text of the record is escaped by the template.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from pandas import json_normalize

from mvest.errors import InputError, cannot_write
from mvest.files import write_atomically
from mvest.personalisation.record import arrays_of_case, record_of_case
from mvest.personalisation.result import Expected, Personalised
from mvest.problem.fields import CaseFields, case_fields
from mvest.problem.record import EstimateRecord, Spread
from mvest.reporting.case.figures import case_figure, estimates_figure, shapes_figure
from mvest.reporting.case.tables import expected_tables, report_tables, unknown_table
from mvest.reporting.case.view import CAMERAS, case_view
from mvest.reporting.expectation import alike_words
from mvest.reporting.figures import save_figure_with
from mvest.reporting.markup import ended, number
from mvest.reporting.pictures import TEMPLATES, embedded, rendered

REPORT, UNKNOWNS, CHECK = "report.html", "unknowns.csv", "check.html"
SCRIPT = TEMPLATES / "case_report.js"
FULL_WIDTH_INCHES = 8.6
"""Of a picture as wide as the page; print is equally large in narrower ones."""
HASH_DIGITS = 12


def report(
    result: Personalised | EstimateRecord,
    folder: Path | str,
    *,
    arrays: Mapping[str, Any] | Path | None = None,
    line: str = "",
    provenance: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write ``unknowns.csv`` and, of an estimate, ``report.html`` with its figures.

    Parameters
    ----------
    result : Personalised or EstimateRecord
    folder : Path
        Made if it does not exist.
    arrays : mapping or Path, optional
        Of a record: those of `mvest.personalisation.record.arrays_of_case`, or the ``.npz`` file
        that holds them. Without them there is no page.
    line : str
        Where the record came from, for the foot of each picture.
    provenance : mapping, optional
        The same in full, for the end of the page.

    Returns
    -------
    list of Path
        The files, ``unknowns.csv`` first.

    Raises
    ------
    InputError
        If arrays cannot be read, do not fit the record, or a file cannot be written.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    if isinstance(result, Personalised):
        record, arrays = record_of_case(result), arrays or arrays_of_case(result)
    else:
        record = result
    written = [write_atomically(folder / UNKNOWNS, unknown_table(record.unknowns).csv())]
    if not arrays:
        return written
    return [*written, *_write_page(folder, record, case_fields(arrays), line, provenance or {})]


def check_page(
    folder: Path, title: str, lines: Sequence[str], expected: Expected, picture: Path
) -> Path:
    """Write ``check.html``: a case as it was read, and what an estimate of it could tell.

    Parameters
    ----------
    folder : Path
    title : str
    lines : sequence of str
        What was found while the case was read.
    expected : Expected
    picture : Path
        The case, drawn.
    """
    tables = {name: one.readable() for name, one in expected_tables(expected).items()}
    page = rendered(
        "check.html.jinja",
        title=title,
        lines=lines,
        reason=expected.reason,
        picture=embedded(picture),
        tables=tables,
    )
    return write_atomically(folder / CHECK, page)


def _write_page(
    folder: Path,
    record: EstimateRecord,
    shapes: CaseFields,
    line: str,
    provenance: Mapping[str, Any],
) -> list[Path]:
    """The page and its pictures."""
    about = _first(record, "about")
    regions, known = int(shapes.region.max()) + 1, about["regions"] or ()
    names = known if len(known) == regions else [f"leaflet {k + 1}" for k in range(regions)]
    sha256 = about["sha256"] or ""
    parts = (
        about["description"] or record.case,
        "simulated" if record.simulated else "",
        f"case {sha256[:HASH_DIGITS]}" if sha256 else "",
        line,
    )
    note = ", ".join(filter(None, parts))
    written: list[Path] = []
    pictures: dict[str, dict[str, Any]] = {}
    missing: dict[str, str] = {}
    drawn: dict[str, Callable[[], Figure]] = {
        "shapes": lambda: shapes_figure(shapes, names),
        "figure3": lambda: case_figure(shapes, names),
        "estimates": lambda: estimates_figure(record),
    }
    for name, draw in drawn.items():
        try:
            figure = draw()
        except InputError as error:
            missing[name] = str(error)
            continue
        written += save_figure_with(folder / name, figure, note)
        share = min(float(figure.get_figwidth()) / FULL_WIDTH_INCHES, 1.0)
        pictures[name] = embedded(written[-1]) | {"percent": round(100 * share)}
    for row in record.detail_rows("pictures"):
        # Drawn with the volume at hand, and kept beside the page.
        try:
            pictures[row["file"]] = embedded(folder / row["file"]) | {"percent": 100}
        except InputError as error:
            missing[row["file"]] = str(error)
    scene, buttons = case_view(shapes, names)
    labels = {one.name: one.label or one.name for one in record.unknowns}
    rows = json_normalize(dict(provenance)).assign(**{"case files, SHA-256": sha256})
    page = rendered(
        "case_report.html.jinja",
        scripts=_policy(scene, SCRIPT.read_text(encoding="utf-8")),
        pictures=pictures,
        missing=missing,
        scene=scene,
        buttons=buttons,
        cameras=CAMERAS,
        files=[path.name for path in written],
        record=record,
        about=about,
        shapes=shapes,
        spread=Spread.of,
        step=_first(record, "image_step"),
        tables=defaultdict(list, {k: one.readable() for k, one in report_tables(record).items()}),
        confounded=[alike_words(group, labels) for group in record.confounded],
        number=number,
        ended=ended,
        provenance=[
            {"": name, "value": str(value)}
            for row in rows.to_dict("records")
            for name, value in row.items()
            if value
        ],
    )
    return [write_atomically(folder / REPORT, page), *written]


def _first(record: EstimateRecord, name: str) -> Mapping[str, Any]:
    """The only row of a detail, in which what is missing is None."""
    rows = record.detail_rows(name)
    return defaultdict(lambda: None, rows[0] if rows else {})


def _policy(scene: str, script: str) -> str:
    """The scripts of the page by their hashes, so that a browser runs no other."""
    own = re.findall(r"<script[^>]*>(.*?)</script>", scene, re.DOTALL)
    digests = (hashlib.sha256(text.encode()).digest() for text in [*own, script])
    return " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
