"""Runs all filters on the same problems and compares them with draws from the posterior."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from experiments.common.building.filters import filter_of
from experiments.common.building.twin import build_twin
from experiments.common.progress import SolveBar, say
from experiments.common.records.record import Mesh
from experiments.common.schema import BY_PARAMETER, Values
from experiments.common.study import Figures, Job, Result, Results, Study
from mvest.closure.model import ClosureModel
from mvest.errors import ConfigurationError
from mvest.estimation.estimate import Estimate
from mvest.estimation.gaussian import Gaussian
from mvest.estimation.prediction import ObservationModel, predict
from mvest.estimation.run import Filter
from mvest.estimation.transform import Log
from mvest.observation.vertices import observed_frames
from mvest.quantities import AxisCount, Length, Logarithm, PointsAlong, PointsAround, Value
from mvest.reporting.tables import Column, table

TRANSFORM = Log()
"""All unknowns are positive."""

TARGET = 0.1
"""Largest relative difference between an interval's width and the reference's."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterProblem:
    """One problem on which filters are compared; the unknowns' logarithms are normal."""

    parameters: tuple[str, ...]
    truth: tuple[Value, ...]
    initial: tuple[Value, ...]  # prior median
    log_std: tuple[Logarithm, ...]  # prior standard deviation of the logarithms
    fixed: Annotated[dict[str, float], BY_PARAMETER] = field(default_factory=dict)  # known
    columns: PointsAround = 28
    rows: PointsAlong = 8
    every: AxisCount = 1  # every n-th vertex is observed
    noise_mm: Length  # of each coordinate of the closed frame


@dataclass(frozen=True, slots=True, kw_only=True)
class FilterStudySettings:
    """All filters on the same problems."""

    problems: dict[str, FilterProblem] = field(default_factory=dict)
    # _target_ and settings of each filter; Q `prior` means the prior's covariance.
    methods: dict[str, dict[str, Any]] = field(default_factory=dict)
    # The filter that draws from the posterior; the others are compared with it.
    reference: dict[str, Any] = field(default_factory=dict)


def run(job: Job[FilterStudySettings]) -> Result:
    """Run every filter on every problem.

    MvestError if a setting is inadmissible, or the reference gives no draws.
    """
    settings, seed = job.settings, job.values["seed"]
    rows: list[dict[str, Any]] = []
    references: list[dict[str, Any]] = []
    mesh, solves = None, 0
    for name, about in settings.problems.items():
        problem = build_problem(job.values, name, about)
        mesh = mesh or Mesh.of(problem.closure.mesh)
        # All are built before any runs, so that a wrong setting raises an error at once.
        filters = {method: problem.filter(values) for method, values in settings.methods.items()}
        reference = problem.estimate(filter_of(settings.reference), seed)
        if reference.transformed_samples is None:
            raise ConfigurationError(
                f"filters.reference: no draws from the posterior of {name} ({reference.why}), "
                "expected a filter that draws, such as ImportanceFilter"
            )
        references += problem.rows("reference", reference, reference)
        solves += reference.forward_solves
        for method, one in filters.items():
            found = problem.estimate(one, seed)
            rows += problem.rows(method, found, reference)
            solves += found.forward_solves
            say(f"{name}, {method}: {found.forward_solves} runs")
    return Result(
        tables={"": table(rows, **COLUMNS), "reference": table(references, **COLUMNS)},
        mesh=mesh,
        forward_solves=solves,
    )


COLUMNS: dict[str, Column | str] = {
    **dict.fromkeys(("problem", "filter", "parameter"), ""),
    **dict.fromkeys(("truth", "estimate", "low", "high"), Column(hidden=True)),
    "error": "%:+.1f",
    "width ratio": ":.2f",
    "lower end off": "%:+.0f",
    "upper end off": "%:+.0f",
    **dict.fromkeys(("log mean", "log std"), Column(hidden=True)),
    "runs": "",
    "check": ":.2g",
    "check limit": "",
    "ended": Column(hidden=True),
}
"""Widths and ends of 95 % intervals of logarithms, relative to the reference's width."""


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Parameters to estimate from one observation of the closed frame."""

    name: str
    about: FilterProblem
    closure: ClosureModel
    model: ObservationModel
    prior: Gaussian

    def filter(self, method: Values) -> Filter:
        """A configured filter; Q ``prior`` means the prior's covariance."""
        own = {"Q": self.prior.covariance.tolist()} if method.get("Q") == "prior" else {}
        return filter_of({**method, **own})

    def estimate(self, filter_: Filter, seed: int) -> Estimate:
        """One estimate from the open valve; ConfigurationError if the true valve does not close."""
        about = self.about
        self.closure.restart(None)
        exact = predict(self.model, np.array(about.truth))
        if not exact.converged:
            raise ConfigurationError(f"{self.name}: the true valve fails: {exact.reason}")
        errors = np.random.default_rng(seed).standard_normal(exact.y.shape)
        self.closure.restart(None)
        with SolveBar(self.name, 0, about.parameters) as bar:
            y, R = exact.y + about.noise_mm * errors, about.noise_mm**2
            how: dict[str, Any] = {
                "names": about.parameters,
                "transform": TRANSFORM,
                "on_iterate": bar.iterate,
            }
            return filter_(self.model, self.prior, y, R, **how)

    def rows(self, method: str, found: Estimate, reference: Estimate) -> list[dict[str, Any]]:
        """A row for each unknown, with its interval relative to the reference's."""
        ends, own = np.log(reference.interval()), np.log(found.interval())
        off, check = (own - ends) / (ends[1] - ends[0]), found.check
        whole = {"problem": self.name, "filter": method, "runs": found.forward_solves}
        whole |= {"check": check and check.value, "check limit": check and check.limit}
        truths = zip(self.about.parameters, self.about.truth, strict=True)
        return [
            {
                **whole,
                "parameter": name,
                "truth": truth,
                "estimate": found.mean[k],
                "low": np.exp(own[0, k]),
                "high": np.exp(own[1, k]),
                "error": 100 * (found.mean[k] / truth - 1),
                "width ratio": 1 + off[1, k] - off[0, k],
                "lower end off": 100 * off[0, k],
                "upper end off": 100 * off[1, k],
                "log mean": found.transformed.mean[k],
                "log std": found.transformed.std[k],
                "ended": found.why,
            }
            for k, (name, truth) in enumerate(truths)
        ]


def build_problem(config: Values, name: str, about: FilterProblem) -> Problem:
    """A configured problem; raises a MvestError if a setting is inadmissible."""
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
    seen = np.zeros((1, len(twin.model.valve.surface.vertices)), dtype=np.bool_)
    seen[:, :: about.every] = True
    model = observed_frames(twin.model, ("closed",), seen)
    return Problem(name, about, twin.model, model, prior)


def figure(results: Results) -> Figures:
    """The 95 % intervals of each filter relative to those of the reference."""
    from textwrap import fill

    from mvest.reporting.figures import BAD, GOOD, SMALL, headline, panels

    rows, references = results.table().rows, results.table("reference").rows
    methods = list(dict.fromkeys(row["filter"] for row in rows))
    drawn, grid = panels(1, len(references), 0.32 * len(methods) + 2.7, sharey=True)
    for axes, by in zip(grid[0], references, strict=True):

        def in_std(row: Values, *names: str, by: Values = by) -> list[float]:
            """Logarithms as deviations from the reference's mean, in its standard deviations."""
            return [(np.log(row[name]) - by["log mean"]) / by["log std"] for name in names]

        axes.axvspan(*in_std(by, "low", "high"), color="0.88")
        (truth,) = in_std(by, "truth")
        axes.axvline(truth, color="black", linewidth=1.0)
        for row in (r for r in rows if all(r[k] == by[k] for k in ("problem", "parameter"))):
            ends, off = in_std(row, "low", "high"), row["width ratio"] - 1
            good, at = abs(off) <= TARGET, methods.index(row["filter"])
            colour = GOOD if good else BAD
            axes.plot(ends, [at, at], color=colour, linewidth=2.2)
            axes.plot(sum(ends) / 2, at, marker="o", markersize=4, color=colour)
            if not good:
                axes.annotate(
                    f"{100 * off:+.0f} %", (sum(ends) / 2, at), (0, 4), ha="center",
                    color=colour, textcoords="offset points", fontsize=SMALL - 1.5,
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
        f"Standard deviations from the mean of the draws (grey: their interval). Blue: width "
        f"within {TARGET:.0%};\norange: not, with the difference. Black: truth. Simulated."
    )
    headline(drawn, "95 % intervals of each filter on those of the posterior", note)
    return drawn


STUDY = Study(
    settings=FilterStudySettings,
    part="filters",
    run=run,
    figure=figure,
    captions={
        "": "95 % interval that each filter gives each unknown, on that of draws from the "
        "posterior: blue where it is as wide to 10 %. Simulated."
    },
    golden=("twin",),
)
