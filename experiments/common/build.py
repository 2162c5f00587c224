"""From a resolved configuration (plain data) to the objects of the library."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.anatomy import Anatomy, anatomy_of, build_mesh, guide_of
from experiments.common.extrapolated import Extrapolated
from experiments.common.schema import build
from experiments.common.store import Store, StoredModel
from mvest.closure.anchors import Anchors
from mvest.closure.model import ClosureModel
from mvest.closure.robustness import REFERENCE, GateCase, vary
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.estimate import Filter
from mvest.estimation.filters.ensemble import EnsembleFilter
from mvest.estimation.filters.extended import ExtendedFilter
from mvest.estimation.filters.importance import ImportanceFilter
from mvest.estimation.filters.iterated import IteratedFilter
from mvest.estimation.filters.monte_carlo import MonteCarloFilter
from mvest.estimation.filters.paper import PaperFilter
from mvest.estimation.filters.unscented import UnscentedFilter
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import observation_noise
from mvest.estimation.transform import Identity, Log, Transform
from mvest.mechanics.parameters import is_positive, kind_of
from mvest.mechanics.settings import MechanicsSettings
from mvest.mechanics.solver import linear_solver
from mvest.mechanics.valve_system import check_parameters
from mvest.observation.errors import (
    AnnulusOffset,
    CoaptationDropout,
    CorrelatedNoise,
    ObservationError,
    SpatialCorrelation,
    WhiteNoise,
)
from mvest.observation.vertices import require_frames
from mvest.problem.problem import Problem
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import LeafletSurface, Valve

__all__ = [
    "Twin",
    "build_twin",
    "closure_model",
    "filter_of",
    "mechanics_of",
]

Values = Mapping[str, Any]

MODES = ("paper", "extended", "iterated", "unscented", "ensemble", "monte_carlo", "importance")
"""Filters that a configuration can name."""


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
        build_mesh(anatomy, mesh, config["mechanics"]["element"], _meshes(config)),
        settings,
        tuple(config["parameters"]),
        dict(config["fixed"]),
    )
    if variation is REFERENCE:
        return model
    model.guide = guide_of(model, anatomy, mesh) if variation.guided else None
    return vary(model, replace(variation, mesh=1.0, sampling=1.0))


def _varied(grid: Values, factor: float) -> dict[str, int]:
    """Columns, an even number, and rows multiplied by a factor."""
    columns, rows = grid["columns"], grid["rows"]
    if factor == 1.0:
        return {"columns": columns, "rows": rows}
    return {"columns": 2 * round(0.5 * columns * factor), "rows": round(rows * factor)}


def _meshes(config: Values) -> Path:
    """Where unstructured meshes are kept."""
    return Path(config["paths"]["outputs"]) / "meshes"


@dataclass(frozen=True, slots=True, eq=False)
class Twin:
    """A synthetic study: the estimator's case, and apart from it what makes its observation.

    Attributes
    ----------
    problem : Problem
    model : ClosureModel
        The estimator's.
    truth_model : ClosureModel
        The observation's; an object of its own.
    source : StoredModel or Extrapolated
        ``truth_model`` behind its store on disk, carried on to cells of no size where that is asked
        for.
    truth_values : (p,)
    valve : Valve
        The observed surface.
    variance : float or (f,) mm²
    correlation : SpatialCorrelation or None
    frames : tuple of str
    errors : tuple of ObservationError
    """

    problem: Problem
    model: ClosureModel
    truth_model: ClosureModel
    source: StoredModel | Extrapolated
    truth_values: FloatArray
    valve: Valve
    variance: float | FloatArray
    correlation: SpatialCorrelation | None
    frames: tuple[str, ...]
    errors: tuple[ObservationError, ...]


def build_twin(config: Values) -> Twin:
    """Everything of a synthetic study.

    Raises
    ------
    MvestError
        If a setting is inadmissible; the message names it.
    """
    parameters = tuple(config["parameters"])
    truth = config["truth"]
    settings = mechanics_of(config)
    # What is cheap to refuse is refused before anything is meshed.
    filter_, transform, prior = build_filter(config["filter"], parameters)
    variance = _numbers("filter.R", config["filter"]["R"])
    try:
        observation_noise(np.atleast_1d(variance), np.size(variance))
    except InputError as error:
        raise ConfigurationError(f"filter.R = {config['filter']['R']}: {error}") from error
    frames = tuple(config["observation"]["frames"])
    require_frames(frames)
    if np.size(variance) not in (1, len(frames)):
        raise ConfigurationError(
            f"filter.R = {config['filter']['R']}: R has shape ({np.size(variance)},); expected one "
            f"variance, or one for each of the {len(frames)} observed frames"
        )
    values = np.array(truth["values"], dtype=float)
    _one_each("truth.values", values, parameters)
    _require_tissue(settings, parameters, values, prior.mean)
    linear_solver(settings.solver)
    if not truth["dt_factor"] > 0:
        raise ConfigurationError(f"truth.dt_factor = {truth['dt_factor']}, expected > 0")
    if config["repeats"] < 1:
        raise ConfigurationError(f"repeats = {config['repeats']}, expected at least 1")
    true_settings = truth_mechanics(settings, truth)
    _require_tissue(true_settings, parameters, values)

    anatomy = anatomy_of(config)
    observation = config["observation"]
    valve = anatomy.valve(observation["columns"], observation["rows"])
    check_parameters([*parameters, *config["fixed"], *truth["fixed"]], valve, settings)
    correlations = Correlations(valve.surface)
    errors = observation_errors(observation, correlations)
    told_length = config["filter"]["R_correlation_mm"]
    correlation = correlations(told_length) if told_length else None
    plain = closure_model(config)
    model = replace(
        plain,
        continuation=config["continuation"],
        reach=np.inf if config["continuation_reach"] is None else config["continuation_reach"],
    )
    if config["guided"]:
        model.guide = guide_of(model, anatomy, config["mesh"])
        model.anchors = Anchors(Path(config["paths"]["outputs"]) / "anchors")

    truth_model, source = _truth(config, plain, true_settings, anatomy)
    problem = Problem(parameters, model, prior, filter_, transform, settings.tissue)
    return Twin(
        problem,
        model,
        truth_model,
        source,
        values,
        valve,
        variance,
        correlation,
        frames,
        errors,
    )


def _truth(
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
            mesh=plain.mesh if same else build_mesh(anatomy, mesh, other, _meshes(config)),
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


class Correlations:
    """Correlations between the vertices of a surface, each length factorised once."""

    def __init__(self, surface: LeafletSurface) -> None:
        self.surface = surface
        self._made: dict[float, SpatialCorrelation] = {}

    def __call__(self, length: float) -> SpatialCorrelation:
        """The correlation of one length, mm."""
        if length not in self._made:
            self._made[length] = SpatialCorrelation(self.surface.vertices, length)
        return self._made[length]


def observation_errors(
    settings: Values, correlations: Correlations
) -> tuple[ObservationError, ...]:
    """The configured errors that are not zero, in the order in which they arise."""
    offset = settings["annulus_offset_mm"]
    made: list[ObservationError] = [AnnulusOffset(tuple(offset))] if np.any(offset) else []
    made.append(WhiteNoise(settings["noise_mm"]))
    if settings["correlated_mm"]:
        correlation = correlations(settings["correlation_length_mm"])
        made.append(CorrelatedNoise(settings["correlated_mm"], correlation))
    if settings["dropout_mm"]:
        made.append(CoaptationDropout(settings["dropout_mm"], correlations.surface))
    return tuple(made)


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


def mechanics_of(config: Values) -> MechanicsSettings:
    """The configured mechanics."""
    return build(MechanicsSettings, config["mechanics"])


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


def build_filter(
    settings: Values, parameters: tuple[str, ...], *, positive: bool = False
) -> tuple[Filter, Transform, Gaussian]:
    """The filter, its coordinates, and the prior of the parameters.

    Those of our mechanics are known to be positive or not; those of another model are ``positive``.
    """
    mean = np.array(settings["initial"], dtype=float)
    _one_each("filter.initial", mean, parameters)
    prior = _gaussian("filter.P0", mean, settings["P0"])
    transforms: dict[str, Transform] = {
        "identity": Identity(),
        "log": Log(None if positive else tuple(map(is_positive, parameters))),
    }
    if settings["transform"] not in transforms:
        raise ConfigurationError(
            f"filter.transform = {settings['transform']!r}, expected identity or log"
        )
    transform = transforms[settings["transform"]]
    transform.forward(mean)
    return filter_of(settings, mean), transform, prior


def filter_of(settings: Values, mean: FloatArray) -> Filter:
    """The filter of the configured mode, for parameters with a prior mean ``(p,)``."""
    tolerance, most = settings["tolerance"], settings["max_iterations"]
    check = settings.get("check_runs", 0)
    Q = _gaussian("filter.Q", mean, settings["Q"]).covariance
    match settings["mode"]:
        case "paper":
            return PaperFilter(Q, tolerance, most, check_runs=check)
        case "extended":
            return ExtendedFilter(check_runs=check)
        case "iterated":
            return IteratedFilter(tolerance, max_iterations=most, check_runs=check)
        case "unscented":
            return UnscentedFilter(tolerance, most, settings["spread"], check_runs=check)
        case "ensemble":
            return build(EnsembleFilter, settings["ensemble"])
        case "monte_carlo":
            return build(MonteCarloFilter, settings["monte_carlo"])
        case "importance":
            return ImportanceFilter()
    raise ConfigurationError(
        f"filter.mode = {settings['mode']!r}, expected one of {', '.join(MODES)}"
    )


def _one_each(name: str, values: FloatArray, parameters: tuple[str, ...]) -> None:
    if values.shape != (len(parameters),):
        raise ConfigurationError(
            f"{name} has {values.size} values; expected one for each of {', '.join(parameters)}"
        )


def _gaussian(name: str, mean: FloatArray, variance: Any) -> Gaussian:
    """Prior with one variance, one for each parameter, or a full covariance."""
    numbers = _numbers(name, variance)
    try:
        return Gaussian.from_variance(mean, numbers)
    except InputError as error:
        raise ConfigurationError(f"{name} = {variance}: {error}") from error


def _require_tissue(
    settings: MechanicsSettings, parameters: tuple[str, ...], *points: FloatArray
) -> None:
    """Refuse moduli of a region without tissue, and values that no tissue can have."""
    for parameter in parameters:
        kind_of(parameter)
        kind, _, region = parameter.partition(".")
        if kind == "E_f" and region not in settings.tissue:
            raise ConfigurationError(
                f"parameter {parameter!r}: no tissue is given for the region {region!r}; known: "
                f"{', '.join(settings.tissue)}"
            )
    for point in points:
        values = dict(zip(parameters, map(float, point), strict=True))
        for region, tissue in settings.tissue.items():
            if tissue.law == "exponential":
                given = {k: f"{k}.{region}" for k in tissue.kinds if f"{k}.{region}" in values}
                tissue.coefficients({k: values[name] for k, name in given.items()})
            elif f"E_f.{region}" in values:
                own = [values.get(f"{kind}.{region}") for kind in ("ratio", "G")]
                _ = tissue.moduli(values[f"E_f.{region}"], *own).material  # refuses what is none


def _numbers(name: str, value: Any) -> float | FloatArray:
    try:
        numbers = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ConfigurationError(f"{name} = {value!r}, expected a number or numbers") from None
    return float(numbers) if numbers.ndim == 0 else numbers


MADE_BY = (closure_model, truth_mechanics, truth_mesh)
"""What makes the closures of a configured valve."""
