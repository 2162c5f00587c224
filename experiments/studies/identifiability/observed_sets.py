"""Sets of vertices of the template's surface that an observation may consist of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mvest.errors import ConfigurationError
from mvest.typing import BoolArray, FloatArray, IntArray

__all__ = ["SETS", "vertex_set"]

LANDMARKS = 10
"""On the free edge, and as many halfway to it, evenly around the valve."""


def _landmarks(way: FloatArray, column: IntArray) -> BoolArray:
    columns = int(column.max()) + 1
    chosen = np.linspace(0.0, columns, LANDMARKS, endpoint=False).astype(np.int64)
    middle = way[np.argmin(np.abs(way - 0.5))]
    return np.isin(column, chosen) & ((way == 1.0) | (way == middle))


SETS: dict[str, tuple[str, Callable[[FloatArray, IntArray], BoolArray]]] = {
    "all": ("all vertices", lambda way, column: way >= 0.0),
    "belly": ("belly (middle third)", lambda way, column: (way >= 1 / 3) & (way <= 2 / 3)),
    "annulus and edge": ("annulus and free edge", lambda way, column: (way == 0.0) | (way == 1.0)),
    "edge": ("free edge", lambda way, column: way == 1.0),
    "landmarks": (f"{2 * LANDMARKS} landmarks", _landmarks),
}
"""Name -> words, and (way from annulus to free edge, column around the valve) -> members."""


def vertex_set(name: str, columns: int, rows: int) -> BoolArray:
    """Which of the ``columns x rows`` vertices, annulus first, belong to a set ``(n,)``.

    Raises
    ------
    ConfigurationError
        If there is no such set.
    """
    if name not in SETS:
        raise ConfigurationError(f"set of vertices {name!r}, expected one of {', '.join(SETS)}")
    vertex = np.arange(columns * rows)
    return SETS[name][1](vertex // columns / (rows - 1), vertex % columns)
