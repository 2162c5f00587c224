"""Table and figure of the filters from a made-up record."""

import math
from dataclasses import replace

import pandas as pd
import pytest

from experiments.common.records.record import Record
from experiments.studies.filters.findings import (
    Estimated,
    Findings,
    OwnCheck,
    Problem,
    Repeats,
    SurrogateFit,
)
from experiments.studies.filters.report import (
    filters_figure,
    filters_table,
    filters_words,
    write_filters,
)
from mvest.reporting.style import BAD, GOOD
from tests.experiments.studies.made_up import made_up


def estimated(width: float, skewness: float | None = None) -> Estimated:
    """What a filter says of one modulus, 4 MPa ± half a ``width`` of the logarithm."""
    return Estimated(
        converged=True,
        reason="converged: as it should",
        detail="",
        forward_solves=7,
        iterations=1,
        seconds=3.0,
        model_seconds=2.9,
        estimate=(4.0,),
        log_mean=(1.386,),
        log_std=(width / 3.92,),
        low=(4.0 * 2.718281828 ** (-width / 2),),
        high=(4.0 * 2.718281828 ** (width / 2),),
        skewness=None if skewness is None else (skewness,),
    )


SEEN = Repeats(runs=50, failed=0, coverage=(0.94,), log_rms_error=(0.1,), width_ratio=(1.0,))


def study(skewness: float, width: float, seen: Repeats = SEEN) -> Record[Findings]:
    problem = Problem(
        name="made_up",
        title="One modulus",
        about="",
        parameters=("E_f.anterior",),
        truth=(5.0,),
        initial=(4.5,),
        log_std=(0.3,),
        noise_mm=0.5,
        observations=672,
        surrogate=SurrogateFit(9, 2, 3, 0.01, 0.1),
        filters={"iterated": estimated(width), "monte_carlo": estimated(0.4, skewness)},
        repeats={"iterated": seen, "monte_carlo": seen},
    )
    return made_up(Findings((problem,), 6.0), title="Filters", experiment="filters")


def row(text: str, start: str) -> str:
    return next(line for line in text.splitlines() if line.startswith(start))


def test_error_width_coverage_and_cost_of_a_filter() -> None:
    text = filters_words(study(0.0, 0.44))
    # 4 of 5 MPa: -20 %; 0.44/0.4 = 1.10; each end 0.02 farther out, 5 % of 0.4.
    expected = "| iterated extended | -20.0 | 1.10 | -5 / +5 | 94 % | 10.0 | 7 | 3 |"
    assert row(text, "| iterated extended | -20") == f"{expected} none | converged |"


@pytest.mark.parametrize(
    ("value", "said"),
    [(0.1, "0.1 of 0.25"), (0.25, "0.25 of 0.25"), (0.3, "0.3 of 0.25: **fails**")],
)
def test_what_a_filter_says_of_itself(value, said) -> None:
    one = study(0.0, 0.44)
    (problem,) = one.findings.problems
    check = OwnCheck("a distance", value, 0.25, 2)
    filters = {**problem.filters, "iterated": replace(problem.filters["iterated"], check=check)}
    one = replace(one, findings=Findings((replace(problem, filters=filters),), 6.0))
    line = row(filters_words(one), "| iterated extended | -20")
    assert line.endswith(f"| 7 | 3 | {said} | converged |")
    assert filters_table(one.findings)["check_runs"].dropna().tolist() == [2.0]


@pytest.mark.parametrize(
    ("skewness", "width", "expected"),
    [
        (0.1, 0.42, "| iterated extended | 1 of 1 | 5 % | – | – |"),
        (0.1, 0.48, "| iterated extended | 0 of 1 | 20 % | – | – |"),
        (-0.9, 0.48, "| iterated extended | – | – | 0 of 1 | 20 % |"),
    ],
)
def test_the_target_holds_where_the_posterior_is_near_normal(skewness, width, expected) -> None:
    text = filters_words(study(skewness, width)).partition("Gaussian intervals against")[2]
    assert row(text, "| iterated extended") == expected


def test_failed_repeats_are_told() -> None:
    text = filters_words(study(0.0, 0.4, replace(SEEN, failed=3)))
    assert "3 of 50 repeats failed" in row(text, "| iterated extended")


def test_a_filter_that_always_failed_has_dashes() -> None:
    lost = Repeats(runs=50, failed=50, coverage=None, log_rms_error=None, width_ratio=None)
    text = filters_words(study(0.0, 0.4, lost))
    assert "| – % | – |" in row(text, "| iterated extended")


def test_files_are_written_and_hold_all_numbers(tmp_path) -> None:
    written = write_filters(tmp_path, {"filters": study(0.0, 0.4)}, {})
    assert {path.name for path in written} == {
        "filters.csv",
        "filters.md",
        "filters.png",
        "filters.pdf",
    }
    table = pd.read_csv(tmp_path / "filters.csv")
    assert list(table["filter"]) == ["iterated", "monte_carlo"]
    assert table["width_ratio"].tolist() == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize(("width", "colour", "words"), [(0.42, GOOD, []), (0.48, BAD, ["+20 %"])])
def test_every_filter_has_an_interval_on_that_of_the_draws(width, colour, words) -> None:
    figure = filters_figure(study(0.0, width).findings)
    (axes,) = figure.axes
    # The truth, and the filter's interval and mean.
    truth, interval, mean = axes.lines
    std = 0.4 / 3.92
    centre = (math.log(4.0) - 1.386) / std
    assert truth.get_xdata()[0] == pytest.approx((math.log(5.0) - 1.386) / std)
    half = width / 2 / std
    assert list(interval.get_xdata()) == pytest.approx([centre - half, centre + half])
    assert mean.get_xdata()[0] == pytest.approx(centre)
    assert {interval.get_color(), mean.get_color()} == {colour}
    assert [text.get_text() for text in axes.texts] == words
    (band,) = axes.patches
    assert band.get_x() == pytest.approx(centre - 1.96)
    assert band.get_width() == pytest.approx(3.92)
    assert axes.get_title() == "E_f (anterior)"
    assert axes.get_yticklabels()[0].get_text() == (
        "iterated extended, " + ("0 of 1" if words else "1 of 1")
    )
