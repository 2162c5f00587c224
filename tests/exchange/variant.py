"""A file that another program could have written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

__all__ = ["Variant"]


@dataclass(frozen=True)
class Variant:
    """One way of writing what a test knows.

    Attributes
    ----------
    format : str
        Its row in the table of the documentation.
    options : tuple of str
        What sets it apart from others of the format.
    file : str
        Name of the file; its suffix is the format's.
    write : callable
        Writes it to a path.
    labels : bool
        Whether the file says which leaflet is which.
    given : dict
        What a user states beside the file, as the format has no place for it.
    """

    format: str
    options: tuple[str, ...]
    file: str
    write: Callable[[Path], object]
    labels: bool = True
    given: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.format}: {', '.join(self.options)}"
