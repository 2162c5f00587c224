"""The model that an observation is made from, which is not the one that estimates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any

from experiments.common.building.anatomy import Anatomy, build_mesh, guide_of
from experiments.common.building.closure import closure_model, mesh_store
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError, InputError
from mvest.mechanics.parameters import kind_of
from mvest.mechanics.settings import MechanicsSettings
from mvest.problem.stored import Extrapolated, Store, StoredModel

Values = Mapping[str, Any]


def build_truth(
    config: Values, plain: ClosureModel, settings: MechanicsSettings, anatomy: Anatomy
) -> tuple[ClosureModel, StoredModel | Extrapolated]:
    """The model that the observation is made from, and the same behind its store."""
    truth, element = config["truth"], config["mechanics"]["element"]
    changed, other = truth_mesh(config["mesh"], truth), truth["element"] or element
    coarser = list(truth["extrapolated_from"])

    def on(mesh: dict[str, Any]) -> tuple[ClosureModel, StoredModel]:
        same = mesh == dict(config["mesh"]) and other == element
        model = replace(
            plain,
            mesh=plain.mesh if same else build_mesh(anatomy, mesh, other, mesh_store(config)),
            settings=settings,
            fixed={**config["fixed"], **truth["fixed"]},
        )
        if coarser:  # meshes as fine as these take minutes from the open valve
            model.guide = guide_of(model, anatomy, mesh)
        described = {
            "valve": config["valve"],
            "mechanics": {k: v for k, v in config["mechanics"].items() if k != "element"},
            "mesh": mesh if mesh["source"] == "tetwild" else _cells(mesh),
            "element": other,
            "dt_factor": truth["dt_factor"],
            "tissue": {region: asdict(tissue) for region, tissue in settings.tissue.items()},
            "fixed": model.fixed,
            "observed": [config["observation"]["columns"], config["observation"]["rows"]],
            "parameters": list(config["parameters"]),
            **({"guided": True} if coarser else {}),
        }
        store = Store(config["paths"]["outputs"])
        return model, store.model("truth", model, described, MADE_BY)

    model, fine = on(changed)
    if not coarser:
        return model, fine
    if len(coarser) != 2 or changed["source"] != "structured":
        raise ConfigurationError(
            f"truth.extrapolated_from = {coarser}, expected columns and rows of a structured mesh"
        )
    share = coarser[0] / changed["columns"]
    if not 0 < share < 1 or share * changed["rows"] != coarser[1]:
        raise ConfigurationError(
            f"truth.extrapolated_from = {coarser}, expected fewer cells than {changed['columns']} "
            f"x {changed['rows']}, by the same share in both directions"
        )
    _, coarse = on({**changed, "columns": coarser[0], "rows": coarser[1]})
    return model, Extrapolated(fine, coarse, share)


def truth_mechanics(settings: MechanicsSettings, truth: Values) -> MechanicsSettings:
    """The estimator's mechanics with the truth's changes."""
    for name in truth["fixed"]:
        try:
            kind_of(name)
        except InputError as error:
            raise ConfigurationError(f"truth.fixed: {error}") from error
    tissue = dict(settings.tissue)
    for region, ratio in truth["ratio"].items():
        if region not in tissue:
            raise ConfigurationError(
                f"truth.ratio has the region {region!r}; known: {', '.join(tissue)}"
            )
        tissue[region] = replace(tissue[region], ratio=ratio)
    if truth["reading"] is not None:
        tissue = {r: replace(old, reading=truth["reading"]) for r, old in tissue.items()}
    protocol = replace(settings.protocol, dt=settings.protocol.dt * truth["dt_factor"])
    return replace(settings, tissue=tissue, protocol=protocol)


def truth_mesh(mesh: Values, truth: Values) -> dict[str, Any]:
    """The estimator's mesh settings with the truth's changes."""
    if truth["refine"] < 1:
        raise ConfigurationError(f"truth.refine = {truth['refine']}, expected at least 1")
    changed = dict(mesh)
    changed["source"] = truth["source"] or mesh["source"]
    changed["edge_length"] = mesh["edge_length"] / truth["refine"]
    for name in ("columns", "rows"):
        given = truth[name]
        changed[name] = mesh[name] * truth["refine"] if given is None else given
    changed["layers"] = mesh["layers"] if truth["layers"] is None else truth["layers"]
    return changed


def _cells(mesh: Values) -> dict[str, Any]:
    """What decides a structured mesh besides its element."""
    return {k: mesh[k] for k in ("source", "columns", "rows", "layers")}


MADE_BY = (closure_model, truth_mechanics, truth_mesh)
"""What makes the closures of a configured valve."""
