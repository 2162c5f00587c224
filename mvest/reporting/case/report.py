"""``report.html`` of one case: what was estimated, how far to trust it, and what it rests on.

The page opens from disk and loads nothing: pictures and the script of the turnable valve are in
it, and its content policy forbids every request. Text of the findings is escaped by the template.
"""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from mvest.errors import InputError, cannot_write
from mvest.files import write_atomically
from mvest.reporting.case import words
from mvest.reporting.case.fields import CaseFields, read_case_fields
from mvest.reporting.case.figures import (
    MIDSURFACES,
    case_figure,
    figure3_caption,
    information_figure,
    innovation_map_figure,
    shapes_figure,
)
from mvest.reporting.case.findings import CaseFindings
from mvest.reporting.case.information import Information, information, where_words
from mvest.reporting.case.plots import (
    distances_figure,
    estimates_figure,
    innovation_figure,
    iterations_figure,
    narrow_figure,
)
from mvest.reporting.case.view import case_view
from mvest.reporting.figures import save_figure_with
from mvest.reporting.page import TEMPLATES, rendered
from mvest.reporting.pictures import embedded

__all__ = ["REPORT", "write_case_report"]

REPORT = "report.html"
SCRIPT = TEMPLATES / "case_report.js"
FULL_WIDTH_INCHES = 8.6
"""Of a picture as wide as the page; print is equally large in narrower ones."""
FLAT_SHARE = 0.25
"""A modulus of whose information less than this remains is said to hide behind the nuisances."""


def write_case_report(
    folder: Path,
    case: CaseFindings,
    fields: Path,
    line: str = "",
    provenance: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write the page of a case and its pictures (PNG and PDF); returns their paths.

    Parameters
    ----------
    folder : Path
        Made if it does not exist.
    case : CaseFindings
        Whatever is missing is left out of the page, with a sentence in its place.
    fields : Path
        The ``.npz`` file of `mvest.reporting.case.fields.read_case_fields`.
    line : str
        Where the findings came from, for the foot of each picture.
    provenance : mapping, optional
        The same in full, for the end of the page.

    Raises
    ------
    InputError
        If the fields cannot be read, do not fit the findings, or a file cannot be written.
    """
    shapes = read_case_fields(fields)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    names = words.leaflet_names(case, int(shapes.region.max()) + 1)
    informations = information(shapes, case.unknowns, case.observation_std_mm)
    note = words.provenance_note(case, line)
    marked = " Simulated." if case.about.simulated else ""
    written: list[Path] = []
    pictures: dict[str, dict[str, Any]] = {}
    missing: dict[str, str] = {}
    for name, make, caption in _figures(case, shapes, names, informations):
        try:
            figure = make()
        except InputError as error:
            missing[name] = f"Not shown: {error}."
            continue
        paths = save_figure_with(folder / name, figure, note)
        share = min(float(figure.get_figwidth()) / FULL_WIDTH_INCHES, 1.0)
        pictures[name] = embedded(paths[0], (caption or figure3_caption(shapes)) + marked) | {
            "percent": round(100 * share)
        }
        written += paths
    for name, shown in (case.image_step.pictures if case.image_step else {}).items():
        # Drawn with the volume at hand, and kept beside the page.
        try:
            pictures[name] = embedded(folder / shown.file, shown.caption) | {"percent": 100}
        except InputError as error:
            missing[name] = f"Not shown: {error}."
    view = case_view(shapes, names)
    page = rendered(
        "case_report.html.jinja",
        scripts=_policy(view.markup, SCRIPT.read_text(encoding="utf-8")),
        pictures=pictures,
        missing=missing,
        view=view,
        files=[path.name for path in written],
        case=case,
        words=words,
        where=_where(shapes, names, informations),
        provenance=words.setting_rows(
            {
                **(provenance or {}),
                **({"case files, SHA-256": case.about.sha256} if case.about.sha256 else {}),
            }
        ),
    )
    return [write_atomically(folder / REPORT, page), *written]


def _policy(scene: str, script: str) -> str:
    """The scripts of the page by their hashes, so that a browser runs no other."""
    own = re.findall(r"<script[^>]*>(.*?)</script>", scene, re.DOTALL)
    digests = (hashlib.sha256(text.encode()).digest() for text in [*own, script])
    return " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)


def _figures(
    case: CaseFindings,
    shapes: CaseFields,
    names: Sequence[str],
    informations: Sequence[Information],
) -> list[tuple[str, Callable[[], Figure], str]]:
    """Name, drawing and caption of each picture; a drawing raises where something is missing."""
    return [
        (
            "shapes",
            lambda: shapes_figure(shapes, names),
            "The valve open and closed, from the atrium and from the side. Colours tell the "
            "leaflets apart; thick line: annulus; thin: free edge and chordae; dots: papillary "
            "tips. " + MIDSURFACES,
        ),
        ("figure3", lambda: case_figure(shapes, names), ""),
        (
            "estimates",
            lambda: estimates_figure(case),
            "What was believed before the images (grey) and what they add (blue).",
        ),
        (
            "identifiability",
            lambda: information_figure(shapes, informations),
            "Fisher information on the logarithm of each modulus that each observed point of the "
            "closed valve adds, seen from the atrium. Dark: how the valve closes there depends on "
            "the modulus. Both pictures of a column have one colour scale, which is finer for "
            "small values. Grey: not observed.",
        ),
        ("iterations", lambda: iterations_figure(case), "How the filter got there."),
        (
            "innovation",
            lambda: innovation_figure(shapes),
            "The innovation (observed minus predicted before the update), each over its predicted "
            "standard deviation. Left: histogram. Right: its quantiles; points on the line mean "
            "that it is distributed as the filter assumes.",
        ),
        (
            "innovation_map",
            lambda: innovation_map_figure(shapes, names),
            "Where on the closed valve the innovation is large.",
        ),
        (
            "distances",
            lambda: distances_figure(case.distances),
            "Distance between model and observed valve in each frame.",
        ),
        (
            "narrow",
            lambda: narrow_figure(case.narrow),
            "Standard deviation of the estimate if one more thing were measured.",
        ),
    ]


def _where(
    shapes: CaseFields, names: Sequence[str], informations: Sequence[Information]
) -> list[dict[str, str]]:
    """A sentence for each modulus: which part of the valve informs it, and what remains of that."""
    rows = []
    for one in informations:
        parts = where_words(shapes, one.raw, names)
        if not parts:
            text = "the closed valve does not depend on it at all."
        else:
            places = ", ".join(f"{place} ({words.percent(share)})" for place, share in parts)
            text = f"learnt mostly from the {places}. "
            text += f"{words.percent(one.kept)} of the information remains beyond the nuisances"
            if one.kept < FLAT_SHARE:
                text += ": what the images show of it could as well be their doing"
            elif beyond := where_words(shapes, one.beyond, names, 1):
                place, share = beyond[0]
                text += f", the largest part of it in the {place} ({words.percent(share)})"
            text += "."
        rows.append({"label": one.label, "text": text})
    return rows
