"""Text of tables for readers: Markdown, with every character shown as itself.

Names of runs and reasons of failures are text of users and libraries, which must not act as markup.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

MISSING = "–"

ACTING = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff"
    "\ufff9-\ufffb\ud800-\udfff\U000e0000-\U000e007f]"
)
"""Characters that control, reverse or hide text, or have no encoding; not tab and newline."""


def ended(text: str) -> str:
    """Text with a full stop, unless it ends in a mark already."""
    return text if text.endswith((".", "?", "!")) else f"{text}."


def shown_text(text: str, longest: int | None = None) -> str:
    """Text with the characters of `ACTING` as ``[U+202E]``, cut to ``longest`` characters."""
    if longest is not None and len(text) > longest:
        text = f"{text[:longest]}… ({len(text)} characters)"
    return ACTING.sub(lambda found: f"[U+{ord(found[0]):04X}]", text.replace("\r", " "))


def markdown_text(text: str) -> str:
    """Text escaped for a cell of a Markdown table."""
    flat = shown_text(" ".join(text.split()))
    escaped = flat.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    # Units in brackets and underscores within words mean nothing in Markdown and stay legible.
    return re.sub(r"([\\`*|~$]|(?<!\w)_|_(?!\w)|(?<=\])[(\[:])", r"\\\1", escaped)


def markdown_rows(rows: Sequence[Mapping[str, str]]) -> str:
    """A Markdown table; every row has the keys of the first, in its order."""
    header = [markdown_text(name) for name in rows[0]]
    body = [[markdown_text(text) for text in row.values()] for row in rows]
    return "\n".join(
        "| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *body)
    )


def number(value: Any, digits: int = 3) -> str:
    """A number with significant digits, but with its whole part; a dash if it is missing."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return MISSING
    if value != 0 and not 1e-3 <= abs(value) < 1e4:
        return f"{value:.1e}"
    return f"{value:.{digits}g}" if abs(value) < 100 else f"{value:.0f}"
