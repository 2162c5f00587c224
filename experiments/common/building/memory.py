"""Memory that the closure of a configured valve needs, which is known before its mesh is built."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from experiments.common.building.twin import truth_mesh
from mvest.elements import ELEMENTS
from mvest.errors import ConfigurationError

BASE_GB = 0.4
"""Of a job on the smallest mesh, its libraries included."""

GB_A_NODE = 40e-6
"""Most of it the factor of the tangent of a closed valve. Closures on hex18 had peaks of 0.37, 0.55
and 0.99 GB at 4896, 10 000 and 24 600 nodes: 0.2 GB and 33 kB a node."""


def require_room(values: Mapping[str, Any], limit_gb: float) -> None:
    """Refuse structured meshes whose closure needs more memory than a job may have.

    Raises
    ------
    ConfigurationError
        If one does; the message names it.
    """
    element, truth = values["mechanics"]["element"], values["truth"]
    meshes = {
        "mesh": (element, values["mesh"]),
        "truth": (truth["element"] or element, truth_mesh(values["mesh"], truth)),
    }
    if "personal" in values:
        meshes["personal.mesh"] = element, {"layers": 1, **values["personal"]["mesh"]}
    for name, (kind, mesh) in meshes.items():
        if mesh["source"] != "structured" or kind not in ELEMENTS:
            continue
        cells = mesh["columns"], mesh["rows"], mesh["layers"]
        needed = expected_memory_gb(kind, *cells)
        if needed > limit_gb:
            raise ConfigurationError(
                f"{name}: {' x '.join(map(str, cells))} cells of {kind} need about {needed:.3g} GB,"
                f" more than the {limit_gb:.3g} GB that a job may have (memory_limit_gb)"
            )


def expected_memory_gb(element: str, columns: int, rows: int, layers: int = 1) -> float:
    """Peak of a job that closes a valve on a structured mesh, which grows with its nodes."""
    nodes = ELEMENTS[element].node_coordinates.T
    around, along, through = (np.unique(coordinate).size - 1 for coordinate in nodes)
    count = around * columns * (along * rows + 1) * (through * layers + 1)
    return BASE_GB + GB_A_NODE * float(count)
