"""``report.html`` of one case: its estimates, how far to trust them, and what they rest on.

The page opens from disk and loads nothing: pictures and the script of the turnable valve are
embedded, and its content policy forbids every request. The template escapes all text.
"""

import base64
import hashlib
import io
import re
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure
from pandas import json_normalize
from PIL import Image

from mvest.errors import InputError, cannot_write
from mvest.files import write_atomically
from mvest.personalisation.record import arrays_of_case, record_of_case
from mvest.personalisation.result import Expected, Personalised
from mvest.problem.fields import CaseFields, case_fields
from mvest.problem.record import EstimateRecord, Spread
from mvest.reporting.case.figures import case_figure, estimates_figure, shapes_figure
from mvest.reporting.case.tables import (
    calibration_text,
    expected_tables,
    report_tables,
    unknown_table,
)
from mvest.reporting.case.view import CAMERAS, case_view
from mvest.reporting.expectation import trade_off_text
from mvest.reporting.figures import save_figure_with
from mvest.reporting.markup import ended, number, shown_text

REPORT, UNKNOWNS, CHECK = "report.html", "unknowns.csv", "check.html"
TEMPLATES = Path(__file__).parents[1] / "templates"
FULL_WIDTH_INCHES = 8.6
"""Width of a figure that fills the page; narrower figures are scaled alike."""
HASH_DIGITS = 12
WIDEST_PIXELS = 1500
"""Two for each pixel of the page's column."""
WEBP_QUALITY = 85
"""Thin lines and small print stay clean from about 80 on."""
LONGEST = 1000
"""Characters of one text on a page."""


def report(
    result: Personalised | EstimateRecord,
    folder: Path | str,
    *,
    arrays: Mapping[str, Any] | Path | None = None,
    line: str = "",
    provenance: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write ``unknowns.csv`` and, for an estimate, ``report.html`` with its figures.

    InputError if arrays cannot be read or do not fit the record, or a file cannot be written.

    Returns the files, ``unknowns.csv`` first.

    Parameters
    ----------
    result : Personalised or EstimateRecord
    folder : Path
        Created if it does not exist.
    arrays : mapping or Path, optional
        For a record: those of `mvest.personalisation.record.arrays_of_case`, or the ``.npz`` file
        that holds them. Without them no page is written.
    line : str
        Where the record came from, for the foot of each picture.
    provenance : mapping, optional
        The same in full, for the end of the page.
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
    if arrays:
        written += _write_page(folder, record, case_fields(arrays), line, provenance or {})
    return written


def check_page(
    folder: Path, title: str, lines: Sequence[str], expected: Expected, picture: Path
) -> Path:
    """Write ``check.html``: a case as it was read, and the intervals that its data can give.

    Parameters
    ----------
    folder : Path
    title : str
    lines : sequence of str
        Results of reading and checking the case.
    expected : Expected
    picture : Path
        The case, drawn.
    """
    page = _rendered(
        "check.html.jinja",
        title=title,
        lines=lines,
        reason=expected.reason,
        picture=_embedded(picture),
        tables=defaultdict(list, {k: t.readable() for k, t in expected_tables(expected).items()}),
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
    about = _only_row(record, "about")
    regions, known = int(shapes.region.max()) + 1, about["regions"] or ()
    names = known if len(known) == regions else [f"leaflet {k + 1}" for k in range(regions)]
    sha256 = about["sha256"] or ""
    parts = (
        about["description"] or record.case,
        "simulated" if record.simulated else "",
        f"case {sha256[:HASH_DIGITS]}" if sha256 else "",
        line,
    )
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
        written += save_figure_with(folder / name, figure, ", ".join(filter(None, parts)))
        share = min(float(figure.get_figwidth()) / FULL_WIDTH_INCHES, 1.0)
        pictures[name] = _embedded(written[-1]) | {"percent": round(100 * share)}
    for row in record.detail_rows("pictures"):
        # Drawn when the volume was read, and saved next to the page.
        try:
            pictures[row["file"]] = _embedded(folder / row["file"]) | {"percent": 100}
        except InputError as error:
            missing[row["file"]] = str(error)
    scene, buttons = case_view(shapes, names)
    # A browser runs the scripts with these hashes and no others.
    scripts = re.findall(r"<script[^>]*>(.*?)</script>", scene, re.DOTALL)
    scripts.append((TEMPLATES / "case_report.js").read_text(encoding="utf-8"))
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()) for text in scripts]
    labels = {one.name: one.label or one.name for one in record.unknowns}
    (source,) = json_normalize(dict(provenance) | {"case files, SHA-256": sha256}).to_dict(
        "records"
    )
    page = _rendered(
        "case_report.html.jinja",
        scripts=" ".join(f"'sha256-{digest.decode()}'" for digest in hashes),
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
        step=_only_row(record, "image_step"),
        tables=defaultdict(list, {k: one.readable() for k, one in report_tables(record).items()}),
        confounded=[trade_off_text(group, labels) for group in record.confounded],
        calibration=calibration_text(record),
        number=number,
        ended=ended,
        provenance=[{"": key, "value": str(value)} for key, value in source.items() if value],
    )
    return [write_atomically(folder / REPORT, page), *written]


def _only_row(record: EstimateRecord, name: str) -> Mapping[str, Any]:
    """The only row of a detail; missing values are None."""
    rows = record.detail_rows(name)
    return defaultdict(lambda: None, rows[0] if rows else {})


def _embedded(path: Path) -> dict[str, Any]:
    """A picture as a data address ``source``, with ``width`` and ``height`` in pixels.

    InputError if the picture cannot be read.
    """
    try:
        with Image.open(path) as stored:
            image = Image.new("RGB", stored.size, "white")
            full = stored.convert("RGBA")
            image.paste(full, mask=full)
    except OSError as error:
        raise InputError(f"cannot read the picture {path}: {error}") from error
    image.thumbnail((WIDEST_PIXELS, image.height), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    image.save(stream, "WEBP", quality=WEBP_QUALITY, method=6)
    data = base64.b64encode(stream.getvalue()).decode("ascii")
    source = Markup(f"data:image/webp;base64,{data}")
    return {"source": source, "width": image.width, "height": image.height}


def _rendered(template: str, **values: Any) -> str:
    """A template with values; text is escaped, cut to `LONGEST`, and control characters named."""

    def shown(value: Any) -> Any:
        is_text = isinstance(value, str) and not isinstance(value, Markup)
        return shown_text(value, LONGEST) if is_text else value

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        finalize=shown,
        undefined=StrictUndefined,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(**values)
