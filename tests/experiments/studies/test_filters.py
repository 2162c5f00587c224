"""The study of all filters, on a valve that is computed in no time, and how a filter is named."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.common.building.filters import build_filter
from experiments.common.config import plain
from experiments.common.records.record import read_record
from experiments.run import main
from experiments.studies.filters.findings import Findings
from experiments.studies.filters.problem import (
    ComparedProblem,
    SurrogateModel,
    TimedModel,
    fit_to_prior,
)
from experiments.studies.filters.settings import SurrogateDesign
from experiments.studies.filters.study import _summary
from mvest.errors import ConfigurationError
from mvest.estimation import (
    EnsembleFilter,
    ExtendedFilter,
    Gaussian,
    MonteCarloFilter,
    Prediction,
    SamplerSettings,
    UnscentedFilter,
)
from mvest.kept import Entry
from tests.experiments.configured import composed
from tests.experiments.studies.test_gate_study import SMALL

SHORT = "{chains: 2, walkers: 8, steps: 60}"
NAMES = ("E_f.anterior", "E_f.posterior")


def filter_settings(name: str, *overrides: str) -> dict:
    return plain(composed(f"filter={name}", *overrides))["filter"]


@pytest.mark.parametrize(
    ("name", "overrides", "expected"),
    [
        ("extended", [], ExtendedFilter()),
        ("unscented", ["filter.max_iterations=1"], UnscentedFilter(1e-3, 1)),
        ("unscented", ["filter.spread=0.5"], UnscentedFilter(1e-3, 15, 0.5)),
        ("ensemble", ["filter.ensemble.seed=5"], EnsembleFilter(24, 1, "square_root", 5)),
        ("ensemble_smoother", [], EnsembleFilter(24, 4)),
        (
            "monte_carlo",
            ["filter.monte_carlo.sampler.steps=99"],
            MonteCarloFilter(sampler=SamplerSettings(steps=99)),
        ),
    ],
)
def test_a_configured_filter_is_the_filter(name, overrides, expected) -> None:
    found, transform, prior = build_filter(filter_settings(name, *overrides), NAMES)
    assert found == expected
    # Prior and coordinates are those of the iterated filter, so that results compare.
    assert prior.covariance[0, 0] == 9.0
    assert transform.forward(np.ones(2)).tolist() == [0.0, 0.0]


def test_a_filter_that_does_not_exist_is_refused_with_those_that_do() -> None:
    with pytest.raises(ConfigurationError, match="unscented, ensemble, monte_carlo"):
        build_filter({**filter_settings("iterated"), "mode": "particle"}, NAMES)


def made_up(model) -> ComparedProblem:
    prior = Gaussian.from_variance(np.array([2.0, 3.0]), np.array([1.0, 0.81]))
    return ComparedProblem(
        "made_up", NAMES, TimedModel(model, list), prior, prior.mean, 0.1, 3, "none"
    )


def quadratic(m):
    """A polynomial of degree 2 of the logarithms of m."""
    a, b = np.log(m)
    jacobian = np.array([[b / m[0], a / m[1]], [2 * a / m[0], 0.0], [0.0, 1 / m[1]]])
    return Prediction(np.array([a * b, a**2, b]), jacobian)


DESIGN = SurrogateDesign(surrogate_runs=8, held_out=3, reach=3.0, degree=3, surrogate_seed=1)


def test_a_surrogate_over_the_prior_is_a_model_of_the_parameters(tmp_path: Path) -> None:
    problem = made_up(quadratic)
    fitted = fit_to_prior(problem, DESIGN, tmp_path / "runs")
    assert (fitted.runs, fitted.held_out, problem.model.runs) == (8, 3, 11)
    assert fitted.largest_mm < 1e-10
    m = np.array([2.5, 2.0])
    found, expected = fitted.model(m), quadratic(m)
    np.testing.assert_allclose(found.y, expected.y, atol=1e-10)
    np.testing.assert_allclose(found.jacobian, expected.jacobian, atol=1e-9)
    # The standard deviation of the logarithms is 1/2 and 0.3; three of them are a factor 4.48.
    assert fitted.model(np.array([8.9, 3.0])).converged
    assert not fitted.model(np.array([9.0, 3.0])).converged


def test_runs_of_the_model_are_read_where_they_are(tmp_path: Path) -> None:
    fit_to_prior(made_up(quadratic), DESIGN, tmp_path / "runs")
    again = made_up(quadratic)
    fitted = fit_to_prior(again, DESIGN, tmp_path / "runs")
    assert again.model.runs == 0
    assert isinstance(fitted.model, SurrogateModel)


def test_an_error_of_the_surrogate_is_told(tmp_path: Path) -> None:
    # A cubic of the logarithms cannot follow |a|; held-out runs must say so.
    def kinked(m):
        a = np.log(m[0]) - np.log(2.0)
        return Prediction(np.abs([a, a]), np.array([[np.sign(a) / m[0], 0.0]] * 2))

    fitted = fit_to_prior(made_up(kinked), DESIGN, tmp_path / "runs")
    assert fitted.rms_mm > 0.02


def test_a_model_that_fails_too_often_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="fails at too many of 11 points"):
        fit_to_prior(made_up(lambda m: Prediction.failed("leaks")), DESIGN, tmp_path / "runs")


def test_coverage_counts_failures_as_misses() -> None:
    one = np.ones(1)
    held = (0.5 * one, 0 * one, one, 0.7 * one)
    missed = (0.5 * one, 0 * one, one, 1.5 * one)
    wide = (0.5 * one, -one, one, 0.7 * one)
    repeats = _summary([held, missed, None, held], [wide] * 4, 2.0 * one)
    # Two of four hold; errors 0.2, 1, 0.2 times 2; half as wide as the reference.
    assert repeats.coverage == (0.5,)
    assert repeats.failed == 1
    assert repeats.log_rms_error[0] == pytest.approx(2.0 * np.sqrt((0.04 + 1 + 0.04) / 3))
    assert repeats.width_ratio == (0.5,)


def test_the_study_runs_and_its_tables_follow_from_the_record(
    tmp_path, monkeypatch, capsys
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [
        "experiments.run",
        "experiment=filters",
        *SMALL,
        "~filters.problems.chordae",
        "~filters.problems.rest_length",
        "~filters.methods.paper",
        "~filters.methods.perturbed",
        "~filters.methods.smoother",
        "~filters.methods.importance",
        "filters.problems.moduli.noise_mm=0.05",
        "filters.methods.ensemble.ensemble.members=6",
        f"filters.methods.monte_carlo.monte_carlo.sampler={SHORT}",
        "filters.design.surrogate_runs=7",
        "filters.design.held_out=2",
        "filters.repeats=3",
        f"filters.sampler={SHORT}",
        "hydra.run.dir=here",
    ]
    monkeypatch.setattr(sys, "argv", arguments)
    assert main() == 0
    record = read_record(tmp_path / "here" / "result.json", Findings)
    (problem,) = record.findings.problems
    found = problem.filters
    assert record.mesh is not None
    assert record.provenance.mesh_hash == record.mesh.sha256
    assert list(found) == ["extended", "iterated", "unscented", "ensemble", "monte_carlo"]
    # What each costs is what the model was run: 2; 6 members and the estimate.
    assert found["extended"].forward_solves == 2
    check = found["iterated"].check
    assert check is not None
    assert check.holds
    assert found["ensemble"].forward_solves == 7
    assert all(0 < row.model_seconds <= row.seconds for row in found.values())
    # Little is asked of so few draws: it is recorded that they are not enough.
    assert not found["monte_carlo"].converged
    assert problem.repeats["iterated"].runs == 3
    # The unscented and the extended filter agree where the data are strong.
    np.testing.assert_allclose(found["unscented"].log_mean, found["iterated"].log_mean, atol=0.01)
    folder = tmp_path / "here"
    assert {"filters.csv", "filters.md", "filters.png", "filters.pdf"} <= {
        path.name for path in folder.iterdir()
    }
    said = capsys.readouterr().out
    assert "iterated extended" in said
    # The second run of the same reads what the first computed.
    store = next((tmp_path / "outputs" / "filter_store").glob("moduli_iterated_*.json"))
    changed = json.loads(store.read_text())
    changed["detail"] = "from the store"
    entry = Entry(store, lambda path: json.loads(path.read_text()))
    entry.keep(changed, lambda path, value: path.write_text(json.dumps(value)))
    monkeypatch.setattr(sys, "argv", [*arguments, "force=true"])
    assert main() == 0
    again = read_record(folder / "result.json", Findings).findings
    assert again.problems[0].filters["iterated"].detail == "from the store"
