"""``report.html`` of one case: what was estimated, how far to trust it, and what it rests on.

The page opens from disk and loads nothing: pictures and the script of the turnable valve are in
it, and its content policy forbids every request. Text of the record is escaped by the template.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from matplotlib.figure import Figure
from matplotlib.text import Text

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
from mvest.reporting.case.image_step import frame_rows, image_error_words
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
from mvest.reporting.pictures import embedded

__all__ = ["REPORT", "write_case_report"]

REPORT = "report.html"
TEMPLATES = Path(__file__).parents[1] / "templates"
FULL_WIDTH_INCHES = 8.6
"""Of a picture as wide as the page; print is equally large in narrower ones."""
FLAT_SHARE = 0.25
"""A modulus of whose information less than this remains is said to hide behind the nuisances."""

Record = Mapping[str, Any]


def write_case_report(folder: Path, record: Record, fields: Path) -> list[Path]:
    """Write the page of a case and its pictures (PNG and PDF); returns their paths.

    Parameters
    ----------
    folder : Path
        Made if it does not exist.
    record : mapping
        The result of the run as plain data. Whatever is missing or None is left out of the page,
        with a sentence in its place.
    fields : Path
        The ``.npz`` file of `mvest.reporting.case.fields.read_case_fields`.

    Raises
    ------
    InputError
        If the fields cannot be read, do not fit the record, or a file cannot be written.
    """
    shapes = read_case_fields(fields)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    names = words.leaflet_names(record, int(shapes.region.max()) + 1)
    informations = information(shapes, record.get("parameters") or [], _observation_std(record))
    note = words.provenance_note(record)
    written: list[Path] = []
    pictures: dict[str, dict[str, Any]] = {}
    missing: dict[str, str] = {}
    for name, make, caption in _figures(record, shapes, names, informations):
        try:
            figure, text = make(), caption()
        except InputError as error:
            missing[name] = f"Not shown: {error}."
            continue
        _print_dollars(figure)
        paths = save_figure_with(folder / name, figure, note)
        share = min(float(figure.get_figwidth()) / FULL_WIDTH_INCHES, 1.0)
        pictures[name] = embedded(paths[0], text) | {"percent": round(100 * share)}
        written += paths
    step = record.get("image_step")
    for name, shown in ((step or {}).get("pictures") or {}).items():
        # Drawn with the volume at hand, and kept beside the page.
        try:
            pictures[name] = embedded(folder / shown["file"], shown["caption"]) | {"percent": 100}
        except InputError as error:
            missing[name] = f"Not shown: {error}."
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        keep_trailing_newline=True,
    )
    page = environment.get_template("case_report.html.jinja").render(
        pictures=pictures,
        missing=missing,
        view=case_view(shapes, names),
        files=[path.name for path in written],
        **_content(record, shapes, names, informations),
    )
    return [write_atomically(folder / REPORT, page), *written]


def _figures(
    record: Record, shapes: CaseFields, names: Sequence[str], informations: Sequence[Information]
) -> list[tuple[str, Callable[[], Figure], Callable[[], str]]]:
    """Name, drawing and caption of each picture; either raises where something is missing."""
    marked = " Simulated." if (record.get("case") or {}).get("simulated") else ""
    texts = {
        "shapes": "The valve open and closed, from the atrium and from the side. Colours tell the "
        "leaflets apart; thick line: annulus; thin: free edge and chordae; dots: papillary tips. "
        + MIDSURFACES,
        "estimates": "What was believed before the images (grey) and what they add (blue).",
        "identifiability": "Fisher information on the logarithm of each modulus that each observed "
        "point of the closed valve adds, seen from the atrium. Dark: how the valve closes there "
        "depends on the modulus. Both pictures of a column have one colour scale, which is finer "
        "for small values. Grey: not observed.",
        "iterations": "How the filter got there.",
        "innovation": "The innovation (observed minus predicted before the update), each over its "
        "predicted standard deviation. Left: histogram. Right: its quantiles; points on the line "
        "mean that it is distributed as the filter assumes. ",
        "innovation_map": "Where on the closed valve the innovation is large.",
        "distances": "Distance between model and observed valve in each frame.",
        "narrow": "Standard deviation of the estimate if one more thing were known exactly.",
    }

    def said(name: str) -> Callable[[], str]:
        return lambda: texts[name].strip() + marked

    return [
        ("shapes", lambda: shapes_figure(shapes, names), said("shapes")),
        ("figure3", lambda: case_figure(shapes, names), lambda: figure3_caption(shapes) + marked),
        ("estimates", lambda: estimates_figure(record), said("estimates")),
        (
            "identifiability",
            lambda: information_figure(shapes, informations),
            said("identifiability"),
        ),
        ("iterations", lambda: iterations_figure(record), said("iterations")),
        ("innovation", lambda: innovation_figure(shapes), said("innovation")),
        (
            "innovation_map",
            lambda: innovation_map_figure(shapes, names),
            said("innovation_map"),
        ),
        (
            "distances",
            lambda: distances_figure(record.get("distances") or []),
            said("distances"),
        ),
        ("narrow", lambda: narrow_figure(record.get("narrow") or []), said("narrow")),
    ]


def _content(
    record: Record, shapes: CaseFields, names: Sequence[str], informations: Sequence[Information]
) -> dict[str, Any]:
    case = record.get("case") or {}
    narrow = record.get("narrow") or []
    return {
        "title": str(record.get("title") or case.get("name") or "A valve"),
        "badges": words.badges(record),
        "answer": words.answer(record),
        "status": record.get("status"),
        "reason": record.get("reason"),
        "gate": record.get("gate"),
        "case": {
            key: case.get(key)
            for key in ("name", "description", "source", "licence", "simulated", "derived")
        },
        "moduli": words.moduli_rows(record),
        "parameters": words.parameter_rows(record),
        "has_without": bool((record.get("without_nuisances") or {}).get("parameters")),
        "has_truth": bool(case.get("simulated"))
        and any(m.get("truth") is not None for m in record.get("moduli") or []),
        "where": _where(shapes, names, informations),
        "identifiability": words.identifiability_words(record),
        "shares": words.share_rows(record),
        "innovation": words.innovation_words(record),
        "whiteness": words.whiteness_rows(record),
        "distances": words.distance_rows(record),
        "held_out": words.distance_words(record),
        "measurements": words.measurement_rows(record),
        "image_step": _image_step(record),
        "image_errors": image_error_words(record),
        "narrow": words.narrow_words(narrow) if narrow else "",
        "settings": words.setting_rows(record.get("settings") or {}),
        "provenance": words.provenance_rows(record),
    }


def _image_step(record: Record) -> dict[str, Any] | None:
    """Sentences, names of pictures and the table of the image step; None where there was none."""
    step = record.get("image_step")
    if step is None:
        return None
    return {
        "sentences": list(step.get("sentences") or []),
        "pictures": list(step.get("pictures") or {}),
        "frames": frame_rows(step.get("frames") or []),
        "files": list(step.get("files") or []),
    }


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


def _print_dollars(figure: Figure) -> None:
    """Have text of the record printed as it stands: matplotlib sets dollars as mathematics."""
    for text in figure.findobj(Text):
        if isinstance(text, Text) and "$" in text.get_text():
            text.set_parse_math(False)


def _observation_std(record: Record) -> float | None:
    value = (record.get("identifiability") or {}).get("observation_std_mm")
    return None if value is None else float(value)
