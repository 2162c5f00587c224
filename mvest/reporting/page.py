"""Pages from templates: whatever text a record holds is shown on them, and nothing of it acts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from mvest.reporting.markup import shown_text

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
