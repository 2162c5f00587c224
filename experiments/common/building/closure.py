"""The configured model of the closure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from experiments.common.building.anatomy import anatomy_of, build_mesh, guide_of
from experiments.common.schema import build
from mvest.closure.model import ClosureModel
from mvest.closure.robustness import REFERENCE, GateCase, vary
from mvest.mechanics.settings import MechanicsSettings

Values = Mapping[str, Any]


def closure_model(config: Values, variation: GateCase = REFERENCE) -> ClosureModel:
    """The configured model of the closure, with one variation.

    It closes the open valve each time; whoever continues from closed states says so.

    Raises
    ------
    MvestError
        If a setting is inadmissible; the message names it.
    """
    anatomy, settings = anatomy_of(config), mechanics_of(config)
    observed, points = config["observation"], config["mechanics"]["contact_points"]
    mesh = dict(config["mesh"]) | _varied(config["mesh"], variation.mesh)
    model = ClosureModel(
        anatomy.valve(observed["columns"], observed["rows"]),
        anatomy.valve(**_varied(points, variation.sampling)),
        build_mesh(anatomy, mesh, config["mechanics"]["element"], mesh_store(config)),
        settings,
        tuple(config["parameters"]),
        dict(config["fixed"]),
    )
    if variation is REFERENCE:
        return model
    model.guide = guide_of(model, anatomy, mesh) if variation.guided else None
    return vary(model, replace(variation, mesh=1.0, sampling=1.0))


def mechanics_of(config: Values) -> MechanicsSettings:
    """The configured mechanics."""
    return build(MechanicsSettings, config["mechanics"])


def _varied(grid: Values, factor: float) -> dict[str, int]:
    """Columns, an even number, and rows multiplied by a factor."""
    columns, rows = grid["columns"], grid["rows"]
    if factor == 1.0:
        return {"columns": columns, "rows": rows}
    return {"columns": 2 * round(0.5 * columns * factor), "rows": round(rows * factor)}


def mesh_store(config: Values) -> Path:
    """Where unstructured meshes are kept."""
    return Path(config["paths"]["outputs"]) / "meshes"
