"""Pages from templates, and pictures put into them, so that a page needs no other file."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from mvest.errors import InputError
from mvest.reporting.markup import shown_text

WIDEST_PIXELS = 1500
"""Two for each pixel of a page's column."""
WEBP_QUALITY = 85
"""Thin lines and small print stay clean from about 80 on."""


def embedded(path: Path) -> dict[str, Any]:
    """A picture within a page, no larger than it can be seen there.

    Returns
    -------
    dict
        ``source`` (a data address), ``width`` and ``height`` in pixels.

    Raises
    ------
    InputError
        If the picture cannot be read.
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


TEMPLATES = Path(__file__).parent / "templates"

LONGEST = 1000
"""Characters of one text on a page."""


def rendered(template: str, *folders: Path, **values: Any) -> str:
    """A template of `TEMPLATES`, or of other folders, with values in it.

    What is no `Markup` is escaped, cut where it is too long, and without characters that would turn
    or hide what stands beside it.
    """
    environment = Environment(
        loader=FileSystemLoader([*folders, TEMPLATES]),
        autoescape=True,
        finalize=_shown,
        undefined=StrictUndefined,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(**values)


def _shown(value: Any) -> Any:
    is_text = isinstance(value, str) and not isinstance(value, Markup)
    return shown_text(value, LONGEST) if is_text else value
