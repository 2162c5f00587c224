"""Refuses what can be seen to be wrong in a configuration before anything is built or launched."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.common.building.closure import mechanics_of
from experiments.common.building.twin import truth_mesh
from experiments.common.study import Check, Study, load_study, study_names
from experiments.runner.tracking.store import require_no_password
from mvest.errors import ConfigurationError

BASE_GB = 0.4
"""Of a job on the smallest mesh, its libraries included."""

GB_A_NODE = 40e-6
"""Most of it the factor of the tangent of a closed valve. Closures on hex18 had peaks of 0.37, 0.55
and 0.99 GB at 4896, 10 000 and 24 600 nodes: 0.2 GB and 33 kB a node."""

NODES_ACROSS = {
    "hex18": (2, 1),
    "hex18_thin": (2, 1),
    "hex27": (2, 2),
    "tet10": (2, 2),
    "tet4": (1, 1),
}
"""Element -> nodes per cell along the leaflets, and through the thickness."""


def require_admissible(values: Mapping[str, Any]) -> None:
    """Refuse settings that no job could run with.

    Raises
    ------
    MvestError
        If a setting is inadmissible; the message names it.
    """
    study = load_study(values["study"])
    require_no_password(values["tracking"]["uri"])
    mechanics_of(values)
    study.require(values)


def require_checks(study: Study[Any], values: Mapping[str, Any]) -> tuple[Check, ...]:
    """What ``check=true`` says of a study.

    Raises
    ------
    ConfigurationError
        If it has nothing to say of studies of this kind.
    """
    checks = study.checks()
    if not checks:
        kinds = ", ".join(name for name in study_names() if load_study(name).checks())
        raise ConfigurationError(
            f"experiment {values['name']}: check=true has nothing to say of a study of the kind "
            f"{values['study']}; expected one of {kinds}"
        )
    return checks


def require_room(values: Mapping[str, Any], limit_gb: float) -> None:
    """Refuse meshes whose closure needs more memory than a job may have, before they are built.

    Raises
    ------
    ConfigurationError
        If one does; the message names it.
    """
    element = values["mechanics"]["element"]
    meshes = {"mesh": (element, values["mesh"])}
    truth = values["truth"]
    meshes["truth"] = truth["element"] or element, truth_mesh(values["mesh"], truth)
    if "personal" in values:
        meshes["personal.mesh"] = element, {"layers": 1, **values["personal"]["mesh"]}
    for name, (kind, mesh) in meshes.items():
        if mesh["source"] != "structured" or kind not in NODES_ACROSS:
            continue
        cells = mesh["columns"], mesh["rows"], mesh["layers"]
        needed = expected_memory_gb(kind, *cells)
        if needed > limit_gb:
            raise ConfigurationError(
                f"{name}: {' x '.join(map(str, cells))} cells of {kind} need about {needed:.3g} GB,"
                f" more than the {limit_gb:.3g} GB that a job may have (memory_limit_gb)"
            )


def expected_memory_gb(element: str, columns: int, rows: int, layers: int = 1) -> float:
    """Peak of a job that closes a valve on a structured mesh: so much a node, beside its base."""
    along, through = NODES_ACROSS[element]
    nodes = along * columns * (along * rows + 1) * (through * layers + 1)
    return BASE_GB + GB_A_NODE * nodes
