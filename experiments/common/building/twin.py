"""A synthetic study: the estimator's model, and apart from it the errors of its observation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.common.building.anatomy import anatomy_of, guide_of
from experiments.common.building.closure import closure_model, mechanics_of
from experiments.common.building.filters import as_numbers, build_filter, require_one_each
from experiments.common.building.truth import build_truth, truth_mechanics
from mvest.closure.anchors import Anchors
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError, InputError
from mvest.estimation.noise import observation_noise
from mvest.estimation.prediction import ObservationModel
from mvest.mechanics.parameters import kind_of
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
from mvest.problem.stored import Extrapolated, StoredModel
from mvest.problem.synthetic import TwinData, simulate_observation
from mvest.typing import FloatArray
from mvest.valve.anatomy.valve import LeafletSurface, Valve

Values = Mapping[str, Any]


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

    def observe(
        self, model: ObservationModel, values: FloatArray, rng: np.random.Generator
    ) -> TwinData:
        """An observation made from what a model predicts at parameters ``(p,)``."""
        return simulate_observation(
            model,
            self.problem.parameters,
            values,
            frames=self.frames,
            variance=self.variance,
            correlation=self.correlation,
            errors=self.errors,
            rng=rng,
        )


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
    variance = as_numbers("filter.R", config["filter"]["R"])
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
    require_one_each("truth.values", values, parameters)
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

    truth_model, source = build_truth(config, plain, true_settings, anatomy)
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
