"""The study of all filters, on models that are computed in no time."""

import sys

import numpy as np
import pytest

from experiments.common.building.filters import build_filter
from experiments.common.config import plain
from experiments.common.records.record import Mesh, read_record
from experiments.run import main
from experiments.studies.filters import (
    Problem,
    SurrogateDesign,
    figure,
    fit_to_prior,
    summarised,
)
from mvest.errors import ConfigurationError
from mvest.estimation import (
    EnsembleFilter,
    ExtendedFilter,
    Gaussian,
    MonteCarloFilter,
    Prediction,
    UnscentedFilter,
)
from mvest.reporting.style import BAD, GOOD
from mvest.reporting.tables import table
from tests.experiments.configured import composed
from tests.experiments.studies.test_gate import SMALL

SHORT = "{chains: 2, walkers: 8, steps: 60}"
NAMES = ("E_f.anterior", "E_f.posterior")


@pytest.mark.parametrize(
    ("name", "overrides", "expected"),
    [
        ("extended", [], ExtendedFilter()),
        ("unscented", ["filter.method.max_iterations=1"], UnscentedFilter(1e-3, 1)),
        ("unscented", ["filter.method.spread=0.5"], UnscentedFilter(1e-3, 15, 0.5)),
        ("ensemble", ["+filter.method.seed=5"], EnsembleFilter(24, 1, "square_root", 5)),
        ("ensemble_smoother", [], EnsembleFilter(24, 4)),
        ("monte_carlo", ["+filter.method.runs=20"], MonteCarloFilter(runs=20)),
    ],
)
def test_a_configured_filter_is_the_filter(name, overrides, expected) -> None:
    settings = plain(composed(f"filter={name}", *overrides))["filter"]
    found, transform, prior = build_filter(settings, NAMES)
    assert found == expected
    # Prior and coordinates are those of the iterated filter, so that results compare.
    assert prior.covariance[0, 0] == 9.0
    assert transform.forward(np.ones(2)).tolist() == [0.0, 0.0]


def made_up(model) -> Problem:
    prior = Gaussian.from_variance(np.array([2.0, 3.0]), np.array([1.0, 0.81]))
    mesh = Mesh(sha256="none", nodes=1)
    return Problem("made_up", NAMES, None, model, prior, prior.mean, 0.1, mesh)


def quadratic(m):
    """A polynomial of degree 2 of the logarithms of m."""
    a, b = np.log(m)
    jacobian = np.array([[b / m[0], a / m[1]], [2 * a / m[0], 0.0], [0.0, 1 / m[1]]])
    return Prediction(np.array([a * b, a**2, b]), jacobian)


DESIGN = SurrogateDesign(surrogate_runs=8, held_out=3, reach=3.0, degree=3, surrogate_seed=1)


def test_a_surrogate_over_the_prior_is_a_model_of_the_parameters() -> None:
    fitted = fit_to_prior(made_up(quadratic), DESIGN)
    assert (fitted.about["runs"], fitted.about["held out"]) == (8, 3)
    assert fitted.about["largest"] < 1e-10
    m = np.array([2.5, 2.0])
    found, expected = fitted(m), quadratic(m)
    np.testing.assert_allclose(found.y, expected.y, atol=1e-10)
    np.testing.assert_allclose(found.jacobian, expected.jacobian, atol=1e-9)
    # The standard deviation of the logarithms is 1/2 and 0.3; three of them are a factor 4.48.
    assert fitted(np.array([8.9, 3.0])).converged
    assert not fitted(np.array([9.0, 3.0])).converged


def test_an_error_of_the_surrogate_is_told() -> None:
    # A cubic of the logarithms cannot follow |a|; held-out runs must say so.
    def kinked(m):
        a = np.log(m[0]) - np.log(2.0)
        return Prediction(np.abs([a, a]), np.array([[np.sign(a) / m[0], 0.0]] * 2))

    assert fit_to_prior(made_up(kinked), DESIGN).about["rms"] > 0.02


def test_a_model_that_fails_too_often_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="fails at too many of 11 points"):
        fit_to_prior(made_up(lambda m: Prediction.failed("leaks")), DESIGN)


def test_coverage_counts_failures_as_misses() -> None:
    one = np.ones(1)
    held = (0.5 * one, 0 * one, one, 0.7 * one)
    missed = (0.5 * one, 0 * one, one, 1.5 * one)
    wide = (0.5 * one, -one, one, 0.7 * one)
    found = summarised([held, missed, None, held], [wide] * 4, 2.0 * one)
    # Two of four hold; errors 0.2, 1, 0.2 times 2; half as wide as the reference.
    assert found["coverage"] == 0.5
    assert (found["repeats"], found["failed"]) == (4, 1)
    assert found["rms error"][0] == pytest.approx(200.0 * np.sqrt((0.04 + 1 + 0.04) / 3))
    assert found["repeats width ratio"] == 0.5
    lost = summarised([None] * 2, [wide] * 2, one)
    assert (lost["failed"], lost["coverage"]) == (2, None)


class MadeUpResults:
    """A reference of a logarithm 1.386 ± 0.1, and a filter beside it."""

    def __init__(self, width: float) -> None:
        same = {"problem": "p", "parameter": "E_f.anterior", "truth": 5.0}
        low, high = (4.0 * np.exp(sign * width / 2) for sign in (-1, 1))
        row = {**same, "filter": "iterated", "low": low, "high": high, "width ratio": width / 0.4}
        by = {**same, "filter": "monte_carlo", "log mean": np.log(4.0), "log std": 0.1}
        by |= {"low": 4.0 * np.exp(-0.2), "high": 4.0 * np.exp(0.2)}
        self.tables = {"": table([row]), "reference": table([by])}

    def table(self, name: str = ""):
        return self.tables[name]


@pytest.mark.parametrize(("width", "colour", "words"), [(0.42, GOOD, []), (0.48, BAD, ["+20 %"])])
def test_every_filter_has_an_interval_on_that_of_the_draws(width, colour, words) -> None:
    (axes,) = figure(MadeUpResults(width)).axes
    # The truth, and the filter's interval and middle.
    truth, interval, middle = axes.lines
    assert truth.get_xdata()[0] == pytest.approx(np.log(5.0 / 4.0) / 0.1)
    assert list(interval.get_xdata()) == pytest.approx([-width / 0.2, width / 0.2])
    assert middle.get_xdata()[0] == pytest.approx(0.0, abs=1e-12)
    assert {interval.get_color(), middle.get_color()} == {colour}
    assert [text.get_text() for text in axes.texts] == words
    (band,) = axes.patches
    assert band.get_x() == pytest.approx(-2.0)
    assert band.get_width() == pytest.approx(4.0)


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
        "~filters.methods.perturbed",
        "~filters.methods.smoother",
        "~filters.methods.importance",
        "filters.problems.moduli.noise_mm=0.05",
        "filters.methods.ensemble.members=6",
        "filters.methods.paper.max_iterations=3",
        "+filters.methods.monte_carlo.sampler._target_="
        "mvest.estimation.filters.sampler.SamplerSettings",
        "+filters.methods.monte_carlo.sampler.steps=60",
        "+filters.methods.monte_carlo.sampler.walkers=8",
        "+filters.methods.monte_carlo.sampler.chains=2",
        "filters.design.surrogate_runs=7",
        "filters.design.held_out=2",
        "filters.repeats=3",
        f"filters.sampler={SHORT}",
        "hydra.run.dir=here",
    ]
    monkeypatch.setattr(sys, "argv", arguments)
    assert main() == 0
    record = read_record(tmp_path / "here" / "result.json")
    assert record.mesh is not None
    assert record.provenance.mesh_hash == record.mesh.sha256
    found = {row["filter"]: row for row in record.table_of().rows if row["parameter"] == NAMES[0]}
    assert list(found) == ["paper", "extended", "iterated", "unscented", "ensemble"]
    # What each costs is what the model was run: 2; 6 members and the estimate.
    assert found["extended"]["runs"] == 2
    assert found["iterated"]["check"] <= found["iterated"]["check limit"]
    assert found["ensemble"]["runs"] == 7
    # Little is asked of so few draws: it is recorded that they are not enough.
    by = record.table_of("reference").rows[0]
    assert not by["ended"].startswith("converged")
    assert (by["width ratio"], by["lower end off"]) == (1.0, 0.0)
    assert found["iterated"]["repeats"] == 3
    # The unscented and the extended filter agree where the data are strong.
    shift = found["unscented"]["log mean"] - found["iterated"]["log mean"]
    assert shift == pytest.approx(0.0, abs=0.01)
    (surrogate,) = record.table_of("surrogate").rows
    assert (surrogate["runs"], surrogate["held out"]) == (7, 2)
    names = {path.name for path in (tmp_path / "here").iterdir()}
    assert {"filters.csv", "filters.md", "filters.png", "filters_reference.csv"} <= names
    assert "unscented" in capsys.readouterr().out
