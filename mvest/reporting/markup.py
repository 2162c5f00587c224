"""Text of tables for readers: Markdown, with every character shown as itself.

Names of runs and reasons of failures are whatever a user typed or a library said, so nothing of
them may act as markup.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

MISSING = "–"

ACTING = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff"
    "\ufff9-\ufffb\ud800-\udfff\U000e0000-\U000e007f]"
)
"""Characters that turn others round, hide or cannot be written; no tab and no end of a line."""


def ended(text: str) -> str:
    """Text as a sentence: with its own mark at the end, or a full stop."""
    return text if text.endswith((".", "?", "!")) else f"{text}."


def shown_text(text: str, longest: int | None = None) -> str:
    """Text whose characters that act are named, ``[U+202E]``; what is cut off is said.

    Parameters
    ----------
    text : str
    longest : int, optional
        Characters that are shown of it.
    """
    if longest is not None and len(text) > longest:
        text = f"{text[:longest]}… ({len(text)} characters)"
    return ACTING.sub(lambda found: f"[U+{ord(found[0]):04X}]", text.replace("\r", " "))


def markdown_text(text: str) -> str:
    """Text in a cell of a Markdown table: no cell ends early, no tag, link or emphasis begins."""
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
    """Significant digits, but never fewer than the whole part has; a dash for what is missing."""
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return MISSING
    if value != 0 and not 1e-3 <= abs(value) < 1e4:
        return f"{value:.1e}"
    return f"{value:.{digits}g}" if abs(value) < 100 else f"{value:.0f}"


def listed(words: Sequence[str]) -> str:
    """One or more words as a sentence lists them: with commas, and "and" before the last."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
