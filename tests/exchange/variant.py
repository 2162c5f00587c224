"""A file that another program could have written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Variant:
    """One way of writing the test's content; ``given`` is what the user states in addition.

    ``labels`` says whether the file states which leaflet is which.
    """

    format: str
    options: tuple[str, ...]
    file: str
    write: Callable[[Path], object]
    labels: bool = True
    given: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.format}: {', '.join(self.options)}"


def each_option(*columns: tuple[str, ...]) -> list[tuple[str, ...]]:
    """Rows with every option of every column, as many as the longest column has."""
    return [tuple(c[k % len(c)] for c in columns) for k in range(max(map(len, columns)))]
