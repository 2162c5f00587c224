"""One estimation problem on which all filters are compared, and a surrogate of its model.

The surrogate serves where hundreds of estimations are needed: for the share of intervals that hold
the truth. What filters cost, and what they say of one observation, comes from the model itself.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from experiments.common.building.twin import build_twin
from experiments.common.records.record import Mesh
from experiments.studies.filters.settings import FilterProblem, SurrogateDesign
from mvest.errors import ConfigurationError
from mvest.estimation.filters.surrogate import Region, Surrogate, affordable_degree, fit_surrogate
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import ObservationModel, Prediction, predict
from mvest.estimation.transform import Log, to_filter
from mvest.kept import Entry
from mvest.observation.vertices import observed_frames
from mvest.reading.npz import read_npz
from mvest.typing import FloatArray

__all__ = ["ComparedProblem", "SurrogateModel", "TimedModel", "build_problem", "fit_to_prior"]

Values = Mapping[str, Any]

TRANSFORM = Log()
"""All unknowns are positive."""

SPARE = 2.0
"""Numbers to which a surrogate is fitted for each of its terms."""


@dataclass(frozen=True, eq=False)
class ComparedProblem:
    """What is estimated from what, for every filter.

    Attributes
    ----------
    name : str
    parameters : tuple of str, (p,)
    model : TimedModel
        Predicts the observation ``y (n,)`` mm.
    prior : Gaussian
        Of the parameters; normal in their logarithms.
    truth : (p,)
        Of the one observation that every filter is given. No filter is.
    noise : float
        Standard deviation of each coordinate, mm.
    observations : int
        n.
    mesh : Mesh
    """

    name: str
    parameters: tuple[str, ...]
    model: TimedModel
    prior: Gaussian
    truth: FloatArray
    noise: float
    observations: int
    mesh: Mesh

    @cached_property
    def exact(self) -> FloatArray:
        """The observation ``y (n,)`` mm of the truth without errors.

        Raises
        ------
        ConfigurationError
            If the true valve does not close.
        """
        self.model.restart()
        prediction = self.model(self.truth)
        if not prediction.converged:
            raise ConfigurationError(f"{self.name}: the true valve fails: {prediction.reason}")
        return prediction.y

    @property
    def log_prior(self) -> Gaussian:
        """The prior of the logarithms."""
        return to_filter(TRANSFORM, self.prior)


class TimedModel:
    """A model, the CPU seconds that it took and how often it was run.

    Every estimation begins from the same closed state (``restart``), so that no filter gains from
    what another has computed before it.
    """

    def __init__(self, model: ObservationModel, restart: Any) -> None:
        self._model, self._restart = model, restart
        self.seconds, self.runs = 0.0, 0

    def restart(self) -> None:
        """Forget all closed states, so that the next run begins with the open valve."""
        self._restart()

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict, as an ``ObservationModel`` does."""
        began = time.process_time()
        prediction = predict(self._model, m)
        self.seconds += time.process_time() - began
        self.runs += 1
        return prediction


@dataclass(frozen=True, slots=True, eq=False)
class SurrogateModel:
    """A surrogate of the logarithms' prior, N(0, I), as a model of the parameters themselves.

    Beyond its region it fails, as a valve does that does not close.
    """

    surrogate: Surrogate
    prior: Gaussian

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict, as an ``ObservationModel`` does."""
        x = (np.log(m) - self.prior.mean) / self.prior.std
        if not self.surrogate.region.holds(x[None])[0]:
            return Prediction.failed("beyond the region of the surrogate")
        jacobian = self.surrogate.jacobian(x) / (self.prior.std * m)
        return Prediction(self.surrogate(x[None])[0], jacobian)


def build_problem(config: Values, name: str, settings: FilterProblem) -> ComparedProblem:
    """One of the configured problems.

    Raises
    ------
    MvestError
        If a setting is inadmissible.
    """
    parameters = settings.parameters
    mean = np.array(settings.initial, dtype=float)
    spread = np.array(settings.log_std, dtype=float)
    if mean.shape != (len(parameters),) or spread.shape != mean.shape:
        raise ConfigurationError(
            f"filters.problems.{name}: expected one initial and one log_std for each of "
            f"{', '.join(parameters)}"
        )
    prior = Gaussian.from_variance(mean, (spread * mean) ** 2)
    values = {
        **config,
        "parameters": list(parameters),
        "fixed": {**config["fixed"], **settings.fixed},
        "truth": {**config["truth"], "values": list(settings.truth)},
        "filter": {**config["filter"], "initial": mean.tolist(), "P0": np.diag(prior.covariance)},
        "observation": {
            **config["observation"],
            "frames": ["closed"],
            "columns": settings.columns,
            "rows": settings.rows,
        },
        "guided": False,
    }
    twin = build_twin(values)
    model = twin.model
    seen = np.zeros((1, len(twin.valve.surface.vertices)), dtype=np.bool_)
    seen[:, :: settings.every] = True
    return ComparedProblem(
        name,
        parameters,
        TimedModel(observed_frames(model, ("closed",), seen), lambda: model.restart(None)),
        prior,
        twin.truth_values,
        float(settings.noise_mm),
        3 * int(seen.sum()),
        Mesh(model.mesh.sha256, len(model.mesh.nodes)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class FittedSurrogate:
    """A surrogate over the prior, and how far it is from the model.

    Attributes
    ----------
    model : SurrogateModel
    runs : int
        To which it was fitted.
    held_out : int
        Further runs.
    rms_mm, largest_mm : float
        Error of a coordinate over the held-out runs.
    """

    model: SurrogateModel
    runs: int
    held_out: int
    rms_mm: float
    largest_mm: float


_Run = tuple[FloatArray, FloatArray]
"""Prediction and its derivatives by the logarithms' N(0, I); empty if it failed."""


def fit_to_prior(
    problem: ComparedProblem, settings: SurrogateDesign, store: Path
) -> FittedSurrogate:
    """A polynomial over the prior out to ``reach`` standard deviations.

    Each run of the model is kept in the folder ``store`` and read from there if it is there.
    """
    p, count = len(problem.parameters), settings.surrogate_runs
    wanted = count + settings.held_out
    region = Region(np.zeros(p), settings.reach * np.eye(p))
    sobol = scipy.stats.qmc.Sobol(p, rng=np.random.default_rng(settings.surrogate_seed))
    # The first of Sobol's points are a design by themselves; the further ones lie between them.
    points = region.points(2.0 * sobol.random_base2((wanted - 1).bit_length())[:wanted] - 1.0)
    runs = enumerate(_run_all(problem, points, store))
    kept = {k: run for k, run in runs if run[0].size}
    number = np.array(sorted(kept), dtype=np.int64)
    at, fitted = points[number], int(np.sum(number < count))
    if fitted < 3 * p or len(number) == fitted:
        raise ConfigurationError(
            f"{problem.name}: the model fails at too many of {wanted} points of the prior"
        )
    y, by_x = (np.array([kept[k][part] for k in number]) for part in (0, 1))
    degree = affordable_degree(fitted * (1 + p), p, settings.degree, SPARE)
    surrogate = fit_surrogate(at[:fitted], y[:fitted], by_x[:fitted], region, degree)
    error = surrogate(at[fitted:]) - y[fitted:]
    return FittedSurrogate(
        SurrogateModel(surrogate, problem.log_prior),
        fitted,
        len(number) - fitted,
        float(np.sqrt(np.mean(error**2))),
        float(np.abs(error).max()),
    )


def _run_all(problem: ComparedProblem, points: FloatArray, store: Path) -> list[_Run]:
    """Runs of the model at points of the logarithms' prior, N(0, I); those of the store are read.

    They are run from neighbour to neighbour, since a closure goes on from the one before.
    """
    log_prior = problem.log_prior
    entries = [Entry(store / f"{k}.npz", _read) for k in range(len(points))]
    runs = [entry.found() for entry in entries]
    left = {k for k, run in enumerate(runs) if run is None}
    at = np.zeros(points.shape[1])

    def compute() -> _Run:
        m = np.exp(log_prior.mean + log_prior.std * at)
        prediction = problem.model(m)
        scale = m * log_prior.std if prediction.converged else 1.0
        return prediction.y, prediction.jacobian * scale

    def write(path: Path, run: _Run) -> None:
        np.savez(path, y=run[0], by_x=run[1])

    while left:
        k = min(left, key=lambda i: float(np.linalg.norm(points[i] - at)))
        left.remove(k)
        at = points[k]
        runs[k] = entries[k].get_or_make(compute, write)
    return [run for run in runs if run is not None]


def _read(path: Path) -> _Run:
    y, by_x = read_npz(path, ["y", "by_x"]).values()
    return y, by_x
