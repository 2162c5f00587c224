"""All filters on the same problems, compared with draws from the posterior itself.

What filters cost, and what they say of one observation, comes from the model. The share of
intervals that hold the truth needs hundreds of estimations, which a surrogate of the model serves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import scipy
from pydantic import Field

from experiments.common.building.filters import filter_of
from experiments.common.building.twin import build_twin
from experiments.common.progress import SolveBar, say
from experiments.common.records.record import Mesh
from experiments.common.schema import BY_PARAMETER
from experiments.common.study import Job, Result, Results, Study
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.estimation.estimate import Estimate, Filter
from mvest.estimation.filters.ensemble import EnsembleFilter
from mvest.estimation.filters.monte_carlo import log_posterior
from mvest.estimation.filters.sampler import SamplerSettings, draw
from mvest.estimation.filters.surrogate import Region, Surrogate, affordable_degree, fit_surrogate
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.noise import observation_noise
from mvest.estimation.prediction import ObservationModel, Prediction, predict
from mvest.estimation.transform import Log, to_filter
from mvest.observation.vertices import observed_frames
from mvest.quantities import Degree, Length, Logarithm, PointsAlong, PointsAround, Seed, Value
from mvest.reporting.tables import Column, table
from mvest.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Values = Mapping[str, Any]

REFERENCE = "monte_carlo"
"""The filter with which all others are compared."""

TRANSFORM = Log()
"""All unknowns are positive."""

SPARE = 2.0
"""Numbers to which a surrogate is fitted for each of its terms."""

INSIDE = 0.9
"""Part of the surrogate's region from which the truths of repeats are drawn, so that their
posteriors lie within it."""

TARGET = 0.1
"""Largest relative difference of an interval's width from that of the reference."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterProblem:
    """One problem on which filters are compared; unknowns are normal in their logarithms."""

    title: str
    parameters: tuple[str, ...]
    truth: tuple[Value, ...]
    initial: tuple[Value, ...]  # prior median
    # Prior standard deviation of the logarithms.
    log_std: tuple[Logarithm, ...]
    fixed: Annotated[dict[str, float], BY_PARAMETER] = field(default_factory=dict)  # known
    columns: PointsAround = 28
    rows: PointsAlong = 8
    every: Annotated[int, Field(ge=1, le=100_000)] = 1  # of so many vertices one is seen
    noise_mm: Length  # of each coordinate of the closed frame


@dataclass(frozen=True, slots=True, kw_only=True)
class SurrogateDesign:
    """Runs of the model to which the surrogate for repeats is fitted."""

    surrogate_runs: Annotated[int, Field(ge=1, le=100_000)] = 32
    held_out: Annotated[int, Field(ge=1, le=100_000)] = 8
    reach: Logarithm = 3.2  # standard deviations of the prior
    degree: Degree = 5  # at most
    surrogate_seed: Seed = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterStudySettings:
    """All filters on the same problems."""

    problems: dict[str, FilterProblem] = field(default_factory=dict)
    # _target_ and settings of each filter; a Q of `prior` is the prior's covariance.
    methods: dict[str, dict[str, Any]] = field(default_factory=dict)
    design: SurrogateDesign = field(default_factory=SurrogateDesign)
    # Observations, each of a truth drawn from the prior.
    repeats: Annotated[int, Field(ge=1, le=100_000)] = 100
    sampler: SamplerSettings = field(default_factory=SamplerSettings)  # of repeats


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    filters: FilterStudySettings


def run(job: Job[Settings]) -> Result:
    """Every filter on every problem.

    Raises
    ------
    MvestError
        If a setting is inadmissible, or the reference is not among the filters.
    """
    settings, seed = job.settings.filters, job.values["seed"]
    if REFERENCE not in settings.methods:
        raise ConfigurationError(f"filters.methods needs {REFERENCE}, to compare the others with")
    rows: dict[bool, list[dict[str, Any]]] = {True: [], False: []}
    surrogates, meshes, solves = [], [], 0
    for name, about in settings.problems.items():
        problem = build_problem(job.values, name, about)
        meshes.append(problem.mesh)
        filters = {method: problem.filter(values) for method, values in settings.methods.items()}
        found = {}
        for method, one in filters.items():
            found[method] = problem.estimate(one, seed)
            solves += found[method].forward_solves
            say(f"{name}, {method}: {found[method].forward_solves} runs")
        fitted = fit_to_prior(problem, settings.design)
        surrogates.append({"problem": name} | fitted.about)
        repeats = _repeats(problem, fitted, filters, settings, seed)
        for method, estimate in found.items():
            for row in problem.rows(estimate, found[REFERENCE], repeats[method]):
                rows[method == REFERENCE].append({"problem": name, "filter": method} | row)
    return Result(
        tables={
            "": table(rows[False], **COLUMNS),
            "reference": table(rows[True], **COLUMNS),
            "surrogate": table(surrogates, **{"rms": "mm:.2g", "largest": "mm:.2g"}),
        },
        mesh=meshes[0],
        forward_solves=solves,
    )


COLUMNS: dict[str, Column | str] = {
    **dict.fromkeys(("problem", "filter", "parameter"), ""),
    **dict.fromkeys(("truth", "estimate", "low", "high"), Column(hidden=True)),
    "error": "%:+.1f",
    "width ratio": ":.2f",
    "lower end off": "%:+.0f",
    "upper end off": "%:+.0f",
    **dict.fromkeys(("log mean", "log std", "shift"), Column(hidden=True)),
    "skewness": ":.2f",
    "coverage": ":.0%",
    "repeats": Column(hidden=True),
    "failed": "",
    "rms error": "%:.1f",
    "repeats width ratio": Column(hidden=True),
    "runs": "",
    "check": ":.2g",
    "check limit": "",
    "check runs": Column(hidden=True),
    "ended": Column(hidden=True),
    "detail": Column(hidden=True),
}
"""Widths and ends of 95 % intervals are of logarithms, relative to the width of the reference; the
shift of the mean is relative to its standard deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """What is estimated from what, for every filter.

    Attributes
    ----------
    name : str
    parameters : tuple of str, (p,)
    closure : ClosureModel
    model : ObservationModel
        Predicts the observation ``y (n,)`` mm.
    prior : Gaussian
        Of the parameters; normal in their logarithms.
    truth : (p,)
        Of the one observation that every filter is given. No filter is.
    noise : float
        Standard deviation of each coordinate, mm.
    mesh : Mesh
    """

    name: str
    parameters: tuple[str, ...]
    closure: ClosureModel
    model: ObservationModel
    prior: Gaussian
    truth: FloatArray
    noise: float
    mesh: Mesh

    @property
    def log_prior(self) -> Gaussian:
        """The prior of the logarithms."""
        return to_filter(TRANSFORM, self.prior)

    def filter(self, method: Values) -> Filter:
        """A configured filter; the paper's has process noise as large as the prior."""
        own = {"Q": self.prior.covariance.tolist()} if method.get("Q") == "prior" else {}
        return filter_of({**method, **own})

    def estimate(self, filter_: Filter, seed: int) -> Estimate:
        """One estimate with the model itself, from the open valve on: nobody gains from others.

        Raises
        ------
        ConfigurationError
            If the true valve does not close.
        """
        self.closure.restart(None)
        exact = predict(self.model, self.truth)
        if not exact.converged:
            raise ConfigurationError(f"{self.name}: the true valve fails: {exact.reason}")
        y = exact.y + self.noise * np.random.default_rng(seed).standard_normal(exact.y.shape)
        self.closure.restart(None)
        with SolveBar(self.name, 0, 0, self.parameters) as bar:
            return filter_(
                self.model,
                self.prior,
                y,
                self.noise**2,
                names=self.parameters,
                transform=TRANSFORM,
                on_iterate=bar.iterate,
            )

    def rows(self, found: Estimate, reference: Estimate, repeats: Values) -> list[dict[str, Any]]:
        """A row for each unknown, its interval relative to that of the reference."""
        low, high = found.interval()
        ends, own = (np.log(one.interval()) for one in (reference, found))
        width = ends[1] - ends[0]
        draws = reference.transformed_samples
        assert draws is not None
        check, by = found.check, reference.transformed
        return [
            {
                "parameter": name,
                "truth": self.truth[k],
                "estimate": found.mean[k],
                "low": low[k],
                "high": high[k],
                "error": 100 * (found.mean[k] / self.truth[k] - 1),
                "width ratio": (own[1, k] - own[0, k]) / width[k],
                "lower end off": 100 * (own[0, k] - ends[0, k]) / width[k],
                "upper end off": 100 * (own[1, k] - ends[1, k]) / width[k],
                "log mean": found.transformed.mean[k],
                "log std": found.transformed.std[k],
                "shift": (found.transformed.mean[k] - by.mean[k]) / by.std[k],
                "skewness": scipy.stats.skew(draws[:, k]),
                **{key: v[k] if isinstance(v, np.ndarray) else v for key, v in repeats.items()},
                "runs": found.forward_solves,
                "check": check and check.value,
                "check limit": check and check.limit,
                "check runs": check and check.extra_runs,
                "ended": found.why,
                "detail": found.detail,
            }
            for k, name in enumerate(self.parameters)
        ]


def build_problem(config: Values, name: str, about: FilterProblem) -> Problem:
    """One of the configured problems.

    Raises
    ------
    MvestError
        If a setting is inadmissible.
    """
    mean, spread = np.array(about.initial), np.array(about.log_std)
    if mean.shape != (len(about.parameters),) or spread.shape != mean.shape:
        raise ConfigurationError(
            f"filters.problems.{name}: expected one initial and one log_std for each of "
            f"{', '.join(about.parameters)}"
        )
    prior = Gaussian.from_variance(mean, (spread * mean) ** 2)
    seen_as = {"frames": ["closed"], "columns": about.columns, "rows": about.rows}
    variance = np.diag(prior.covariance)
    twin = build_twin(
        {
            **config,
            "parameters": list(about.parameters),
            "fixed": {**config["fixed"], **about.fixed},
            "truth": {**config["truth"], "values": list(about.truth)},
            "filter": {**config["filter"], "initial": mean.tolist(), "P0": variance},
            "observation": {**config["observation"], **seen_as},
            "guided": False,
        }
    )
    seen = np.zeros((1, len(twin.valve.surface.vertices)), dtype=np.bool_)
    seen[:, :: about.every] = True
    return Problem(
        name,
        about.parameters,
        twin.model,
        observed_frames(twin.model, ("closed",), seen),
        prior,
        twin.truth_values,
        about.noise_mm,
        Mesh.of(twin.model.mesh),
    )


@dataclass(frozen=True, slots=True, eq=False)
class FittedSurrogate:
    """A surrogate over the logarithms' prior, N(0, I), as a model of the parameters themselves.

    Beyond its region it fails, as a valve does that does not close. ``about`` says how far it is
    from the model: errors of a coordinate (mm) over the runs that were held out.
    """

    surrogate: Surrogate
    prior: Gaussian
    about: dict[str, Any]

    def __call__(self, m: FloatArray, /) -> Prediction:
        """Predict, as an ``ObservationModel`` does."""
        x = (np.log(m) - self.prior.mean) / self.prior.std
        if not self.surrogate.region.holds(x[None])[0]:
            return Prediction.failed("beyond the region of the surrogate")
        jacobian = self.surrogate.jacobian(x) / (self.prior.std * m)
        return Prediction(self.surrogate(x[None])[0], jacobian)


def fit_to_prior(problem: Problem, settings: SurrogateDesign) -> FittedSurrogate:
    """A polynomial over the prior out to ``reach`` standard deviations.

    Raises
    ------
    ConfigurationError
        If the model fails at too many points of the prior.
    """
    p, count = len(problem.parameters), settings.surrogate_runs
    wanted = count + settings.held_out
    region = Region(np.zeros(p), settings.reach * np.eye(p))
    sobol = scipy.stats.qmc.Sobol(p, rng=np.random.default_rng(settings.surrogate_seed))
    # The first of Sobol's points are a design by themselves; the further ones lie between them.
    points = region.points(2.0 * sobol.random_base2((wanted - 1).bit_length())[:wanted] - 1.0)
    prior, at = problem.log_prior, np.zeros(p)
    runs: dict[int, tuple[FloatArray, FloatArray]] = {}
    left = set(range(wanted))
    while left:
        # From neighbour to neighbour, since a closure goes on from the one before.
        k = min(left, key=lambda i: float(np.linalg.norm(points[i] - at)))
        left.remove(k)
        at = points[k]
        m = np.exp(prior.mean + prior.std * at)
        prediction = predict(problem.model, m)
        if prediction.converged:
            runs[k] = prediction.y, prediction.jacobian * (m * prior.std)
    number = np.array(sorted(runs), dtype=np.int64)
    fitted = int(np.sum(number < count))
    if fitted < 3 * p or len(number) == fitted:
        raise ConfigurationError(
            f"{problem.name}: the model fails at too many of {wanted} points of the prior"
        )
    x, (y, by_x) = points[number], (np.array([runs[k][part] for k in number]) for part in (0, 1))
    degree = affordable_degree(fitted * (1 + p), p, settings.degree, SPARE)
    surrogate = fit_surrogate(x[:fitted], y[:fitted], by_x[:fitted], region, degree)
    error = surrogate(x[fitted:]) - y[fitted:]
    about = {
        "degree": int(surrogate.powers.sum(axis=1).max()),
        "runs": fitted,
        "held out": len(number) - fitted,
        "rms": float(np.sqrt(np.mean(error**2))),
        "largest": float(np.abs(error).max()),
    }
    return FittedSurrogate(surrogate, prior, about)


Interval = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Mean, lower and upper end of an estimate and the truth, ``(p,)`` each, where the prior is
N(0, I)."""


def _repeats(
    problem: Problem,
    fitted: FittedSurrogate,
    filters: Mapping[str, Filter],
    settings: FilterStudySettings,
    seed: int,
) -> dict[str, dict[str, Any]]:
    """What each filter says of many observations, each of a truth of its own."""
    every: dict[str, list[Interval | None]] = {method: [] for method in filters}
    prior, draws = problem.log_prior, np.random.default_rng([seed, 1])
    for k in range(settings.repeats):
        rng = np.random.default_rng([seed, 2, k])
        truth = draws.standard_normal(prior.size)
        while np.any(np.abs(truth) > INSIDE * settings.design.reach):
            truth = draws.standard_normal(prior.size)
        y = fitted.surrogate(truth[None])[0]
        y = y + problem.noise * rng.standard_normal(y.shape)
        for method, filter_ in filters.items():
            if method == REFERENCE:
                drawn = _drawn(problem, fitted.surrogate, y, settings.sampler, rng)
                every[method].append((*drawn, truth))
                continue
            if isinstance(filter_, EnsembleFilter):
                filter_ = replace(filter_, seed=k)
            found = filter_(fitted, problem.prior, y, problem.noise**2, transform=TRANSFORM)
            if found.prediction is None:
                every[method].append(None)
                continue
            ends = (found.transformed.mean, *np.log(found.interval()))
            mean, low, high = ((z - prior.mean) / prior.std for z in ends)
            every[method].append((mean, low, high, truth))
    return {method: summarised(own, every[REFERENCE], prior.std) for method, own in every.items()}


def _drawn(
    problem: Problem,
    surrogate: Surrogate,
    y: FloatArray,
    sampler: SamplerSettings,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The reference: mean and ends of draws from the posterior of the surrogate itself."""
    noise = observation_noise(problem.noise**2, y.size)
    unit = replace(problem.log_prior, mean=np.zeros(len(problem.parameters)))
    start = replace(unit, covariance=np.eye(unit.size))
    points = draw(log_posterior(surrogate.misfit(y, noise)), start, sampler, rng).points
    low, high = np.quantile(points, (0.025, 0.975), axis=0)
    return points.mean(axis=0), low, high


def summarised(
    intervals: list[Interval | None], reference: list[Interval | None], std: FloatArray
) -> dict[str, Any]:
    """Coverage, error (%) and median width ``(p,)`` over repeats; a failed one covers nothing."""
    kept = [(f, r) for f, r in zip(intervals, reference, strict=True) if f is not None]
    about: dict[str, Any] = {"repeats": len(intervals), "failed": len(intervals) - len(kept)}
    if not kept:
        return about | dict.fromkeys(("coverage", "rms error", "repeats width ratio"))
    held = np.array([(f[1] <= f[3]) & (f[3] <= f[2]) for f, _ in kept])
    error = np.array([f[0] - f[3] for f, _ in kept]) * std
    width = np.array([(f[2] - f[1]) / (r[2] - r[1]) for f, r in kept if r is not None])
    return about | {
        "coverage": held.sum(axis=0) / len(intervals),
        "rms error": 100 * np.sqrt((error**2).mean(axis=0)),
        "repeats width ratio": np.median(width, axis=0),
    }


def figure(results: Results) -> Figure:
    """95 % interval that each filter gives each unknown, on that of the reference."""
    from textwrap import fill

    from mvest.reporting.style import BAD, GOOD, SMALL, headline, panels

    rows, references = results.table().rows, results.table("reference").rows
    methods = list(dict.fromkeys(row["filter"] for row in rows))
    drawn, grid = panels(1, len(references), 0.32 * len(methods) + 2.7, sharey=True)
    for axes, by in zip(grid[0], references, strict=True):

        def in_std(row: Values, *names: str, by: Values = by) -> list[float]:
            """Logarithms in deviations of the reference from its mean."""
            return [(np.log(row[name]) - by["log mean"]) / by["log std"] for name in names]

        axes.axvspan(*in_std(by, "low", "high"), color="0.88")
        (truth,) = in_std(by, "truth")
        axes.axvline(truth, color="black", linewidth=1.0)
        mine = (r for r in rows if all(r[k] == by[k] for k in ("problem", "parameter")))
        for row in mine:
            ends, off, at = in_std(row, "low", "high"), row["width ratio"] - 1, row["filter"]
            colour = GOOD if abs(off) <= TARGET else BAD
            middle = sum(ends) / 2, methods.index(at)
            axes.plot(ends, [middle[1]] * 2, color=colour, linewidth=2.2)
            axes.plot(*middle, marker="o", markersize=4, color=colour)
            if colour == BAD:
                axes.annotate(
                    f"{100 * off:+.0f} %", middle, (0, 4), ha="center", color=colour,
                    textcoords="offset points", fontsize=SMALL - 1.5,
                )  # fmt: skip
        axes.set_xlim(min(-4.2, truth - 0.5), max(4.2, truth + 0.5))
        axes.set_xticks([-2, 0, 2])
        axes.grid(visible=False, axis="y")
        name = by["parameter"]
        name = name if name.startswith("E_f") else name.replace("_", " ")
        axes.set_title(fill(name, 14), fontsize=SMALL)
        axes.set_xlabel(fill(by["problem"].replace("_", " "), 14), fontsize=SMALL - 0.5)
    grid[0, 0].set_yticks(range(len(methods)), methods)
    grid[0, 0].set_ylim(len(methods) - 0.4, -0.7)
    note = (
        f"Standard deviations from the mean of Monte Carlo (grey: its own interval). Blue: width "
        f"within {TARGET:.0%};\norange: not, with the difference. Black: truth. Simulated."
    )
    headline(drawn, "95 % intervals of each filter on those of Monte Carlo", note)
    return drawn


STUDY = Study(
    settings=Settings,
    run=run,
    figure=figure,
    captions={
        "": "95 % interval that each filter gives each unknown, on that of Monte Carlo: blue where "
        "it is as wide to 10 %. Simulated."
    },
)
