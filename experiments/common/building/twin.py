"""A synthetic study: the estimator's model and, separate from it, the observation's."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.closure import (
    Anatomy,
    anatomy_of,
    build_mesh,
    closure_model,
    guide_of,
    mechanics_of,
    mesh_store,
)
from experiments.common.building.filters import build_filter, observation_variance, require_one_each
from experiments.common.progress import solving
from experiments.common.schema import Values, validated
from mvest.cache import content_digest
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.estimation.prediction import SharedStart
from mvest.mechanics.settings import MechanicsSettings, Relaxation, TissueSettings
from mvest.mechanics.solver import linear_solver
from mvest.mechanics.valve_system import check_parameters, material_law
from mvest.observation.errors import (
    AnnulusOffset,
    CoaptationDropout,
    CorrelatedNoise,
    ObservationError,
    SpatialCorrelation,
    WhiteNoise,
)
from mvest.observation.vertices import require_frames
from mvest.problem.estimate import Problem, StudyResult, estimate
from mvest.problem.stored import Extrapolated, StoredModel, key_of
from mvest.problem.synthetic import TwinData, simulate_observation
from mvest.reporting.expectation import expectation_text, unknown_text
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import LeafletSurface


def build_truth(
    config: Values, plain: ClosureModel, settings: MechanicsSettings, anatomy: Anatomy
) -> tuple[ClosureModel, StoredModel | Extrapolated]:
    """The model that makes the observation, and the same model with a cache on disk."""
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
        if coarser:  # from the open valve, meshes as fine as these take minutes
            model.guide = guide_of(model, anatomy, mesh)
        decisive = model.valve, model.contact_valve, model.mesh, settings, model.names, model.fixed
        described = {"model": content_digest(*decisive), "guided": bool(coarser)}
        folder = Path(config["paths"]["outputs"]) / "truth"
        return model, StoredModel(model, folder, key_of(described, "experiments"))

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
    tissue = validated(dict[str, TissueSettings], truth["tissue"], "truth.tissue")
    if not set(tissue) <= set(settings.tissue):
        raise ConfigurationError(
            f"truth.tissue of {', '.join(tissue)}, expected of {', '.join(settings.tissue)}"
        )
    protocol = replace(settings.protocol, dt=settings.protocol.dt * truth["dt_factor"])
    relaxation = validated(Relaxation | None, truth["relaxation"], "truth.relaxation")
    return replace(
        settings,
        tissue={**settings.tissue, **tissue},
        protocol=protocol,
        relaxation=relaxation or settings.relaxation,
    )


def truth_mesh(mesh: Values, truth: Values) -> dict[str, Any]:
    """The estimator's mesh settings with the truth's changes."""
    refined = {name: mesh[name] * truth["refine"] for name in ("columns", "rows")}
    own = {name: truth[name] for name in ("columns", "rows", "layers") if truth[name] is not None}
    return {
        **mesh,
        **refined,
        **own,
        "source": truth["source"] or mesh["source"],
        "edge_length": mesh["edge_length"] / truth["refine"],
    }


def observation_errors(
    settings: Values, surface: LeafletSurface, correlated: Callable[[float], SpatialCorrelation]
) -> tuple[ObservationError, ...]:
    """The configured errors of an observation, in the order in which they arise."""
    offset = settings["annulus_offset_mm"]
    made: list[ObservationError] = [AnnulusOffset(tuple(offset))] if np.any(offset) else []
    made.append(WhiteNoise(settings["noise_mm"]))
    if settings["correlated_mm"]:
        correlation = correlated(settings["correlation_length_mm"])
        made.append(CorrelatedNoise(settings["correlated_mm"], correlation))
    if settings["dropout_mm"]:
        made.append(CoaptationDropout(settings["dropout_mm"], surface))
    return tuple(made)


@dataclass(frozen=True, slots=True, eq=False)
class Twin:
    """A synthetic study; its estimation problem knows nothing of the truth."""

    problem: Problem
    model: ClosureModel  # the estimator's
    truth_model: ClosureModel  # a separate one, which makes the observation
    source: StoredModel | Extrapolated  # ``truth_model`` with its cache, extrapolated if requested
    truth_values: FloatArray  # (p,)
    # (model, values= (p,), rng=) -> an observation of what the model predicts there
    observe: Callable[..., TwinData]


def build_twin(config: Values) -> Twin:
    """A synthetic study; raises an `MvestError` that names an inadmissible setting."""
    parameters, truth = tuple(config["parameters"]), config["truth"]
    settings, R = mechanics_of(config), config["filter"]["R"]
    # Cheap checks come before anything is meshed.
    filter_, transform, prior = build_filter(config["filter"], parameters)
    variance = observation_variance(R)
    frames = tuple(config["observation"]["frames"])
    require_frames(frames)
    if np.size(variance) not in (1, len(frames)):
        raise ConfigurationError(
            f"filter.R = {R}: R has shape ({np.size(variance)},); expected one variance, or one "
            f"for each of the {len(frames)} observed frames"
        )
    values = np.array(truth["values"], dtype=float)
    require_one_each("truth.values", values, parameters)
    linear_solver(settings.solver)
    true_settings = truth_mechanics(settings, truth)

    anatomy, observation = anatomy_of(config), config["observation"]
    valve = anatomy.valve(observation["columns"], observation["rows"])
    check_parameters([*parameters, *config["fixed"], *truth["fixed"]], valve, settings)
    # Factorised once for each length.
    correlated = cache(partial(SpatialCorrelation, valve.surface.vertices))
    errors = observation_errors(observation, valve.surface, correlated)
    assumed_length = config["filter"]["R_correlation_mm"]
    correlation = correlated(assumed_length) if assumed_length else None
    plain, reach = closure_model(config), config["continuation_reach"]
    model = replace(
        plain, continuation=config["continuation"], reach=np.inf if reach is None else reach
    )
    if config["guided"]:
        model.guide = guide_of(model, anatomy, config["mesh"])
        model.rounded_start = True

    truth_model, source = build_truth(config, plain, true_settings, anatomy)
    for own, point in ((model, prior.mean), (model, values), (truth_model, values)):
        given = dict(zip(parameters, map(float, point), strict=True))
        material_law(own.mesh, own.settings, {**own.fixed, **given})  # refuses inadmissible ones
    return Twin(
        problem=Problem(parameters, model, prior, filter_, transform, settings.tissue),
        model=model,
        truth_model=truth_model,
        source=source,
        truth_values=values,
        observe=partial(
            simulate_observation,
            parameters=parameters,
            frames=frames,
            variance=variance,
            correlation=correlation,
            errors=errors,
        ),
    )


def estimate_twin(twin: Twin, seeds: Sequence[int], name: str = "") -> list[StudyResult]:
    """One estimate for each seed; they share truth and first closure; ``name`` is displayed."""
    of_name = f", {name}" if name else ""
    with solving(f"observation{of_name}", twin.truth_model):
        truth = twin.source(twin.truth_values)
    problem = replace(twin.problem, model=SharedStart(twin.model, twin.problem.start))
    results = []
    with solving(f"estimation{of_name}", twin.model, problem.parameters) as bar:
        for seed in seeds:
            rng = np.random.default_rng(seed)
            data = twin.observe(lambda m: truth, values=twin.truth_values, rng=rng)
            if data.observation is None:
                return [StudyResult.failed(twin.problem, data.reason) for _ in seeds]
            result = estimate(problem, data.observation, on_iterate=bar.iterate)
            results.append(result.against(data.truth))
    return results


def expect_twin(config: Values, _folder: Path | None = None) -> str:
    """The expected information of a synthetic study, for ``check=true``."""
    twin = build_twin(config)
    start = twin.problem.start
    model = SharedStart(twin.model, start)
    with solving(config["name"], twin.model):
        first = model(start)
    title = f"{config['name']}, {config['row']}"
    data = twin.observe(model, values=start, rng=np.random.default_rng(0))
    if data.observation is None:
        return unknown_text(title, first.reason)
    std = np.sqrt(np.atleast_1d(np.asarray(config["filter"]["R"], dtype=float)))
    noise = noise_words(std.tolist(), config["filter"]["R_correlation_mm"])
    return expectation_text(title, replace(twin.problem, model=model), data.observation, noise)


def noise_words(std_mm: Sequence[float], length_mm: float) -> str:
    """The assumed noise of coordinates in words."""
    errors = f"correlated over {length_mm:g} mm" if length_mm else "independent"
    return f"{' and '.join(f'{s:.3g}' for s in std_mm)} mm of noise assumed, {errors}"
