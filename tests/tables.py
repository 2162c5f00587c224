"""Tables in Markdown, for what measurements and comparisons write into ``results/``."""

from __future__ import annotations

from pathlib import Path

import pandas as pd

from mvest.files import write_atomically


def markdown(table: pd.DataFrame) -> str:
    """Cells as text; one that is not known stays empty."""
    cells = table.astype(object).where(table.notna(), "")
    rows = [table.columns, ["---"] * table.shape[1], *cells.itertuples(index=False)]
    return "\n".join(f"| {' | '.join(map(str, row))} |" for row in rows)


def write_text(path: Path, *paragraphs: str) -> None:
    """Write paragraphs, and print where they are."""
    print(write_atomically(path, "\n\n".join(paragraphs) + "\n"))
