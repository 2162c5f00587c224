"""Table and figure of the filters from a made-up record."""

import math

import pandas as pd
import pytest

from experiments.studies.filters.report import filters_figure, filters_text, write_filter_study
from mvest.reporting.style import BAD, GOOD
from tests.reporting.records import record


def told(width: float, **changes) -> dict:
    """A filter's word of one modulus, 4 MPa ± half a ``width`` of the logarithm."""
    return {
        "converged": True,
        "reason": "converged: as it should",
        "detail": "",
        "forward_solves": 7,
        "seconds": 3.0,
        "model_seconds": 2.9,
        "estimate": [4.0],
        "log_mean": [1.386],
        "log_std": [width / 3.92],
        "low": [4.0 * 2.718281828 ** (-width / 2)],
        "high": [4.0 * 2.718281828 ** (width / 2)],
        **changes,
    }


def study(skewness: float, width: float, **repeats) -> dict:
    seen = {"runs": 50, "failed": 0, "coverage": [0.94], "log_rms_error": [0.1],
            "width_ratio": [1.0], **repeats}  # fmt: skip
    histogram = {"edges": [1.1, 1.3, 1.5, 1.7], "density": [1.0, 3.0, 1.0]}
    reference = told(0.4, histogram=[histogram], skewness=[skewness])
    problem = {
        "name": "made_up",
        "title": "One modulus",
        "about": "",
        "parameters": ["E_f.anterior"],
        "truth": [5.0],
        "initial": [4.5],
        "noise_mm": 0.5,
        "log_prior": {"mean": [1.5], "std": [0.3]},
        "observations": 672,
        "surrogate": {"runs": 9, "held_out": 2, "degree": 3, "rms_mm": 0.01, "largest_mm": 0.1},
        "filters": {"iterated": told(width), "monte_carlo": reference},
        "repeats": {"iterated": seen, "monte_carlo": seen},
    }
    return {
        **record(),
        "title": "Filters",
        "problems": [problem],
        "model": {"element": "hex18", "cells": [24, 3, 1]},
    }


def row(text: str, start: str) -> str:
    return next(line for line in text.splitlines() if line.startswith(start))


def test_error_width_coverage_and_cost_of_a_filter() -> None:
    text = filters_text(study(0.0, 0.44))
    # 4 of 5 MPa: -20 %; 0.44/0.4 = 1.10; each end 0.02 farther out, 5 % of 0.4.
    expected = "| iterated extended | -20.0 | 1.10 | -5 / +5 | 94 % | 10.0 | 7 | 3 | converged |"
    assert row(text, "| iterated extended | -20") == expected


@pytest.mark.parametrize(
    ("skewness", "width", "expected"),
    [
        (0.1, 0.42, "| iterated extended | 1 of 1 | 5 % | – | – |"),
        (0.1, 0.48, "| iterated extended | 0 of 1 | 20 % | – | – |"),
        (-0.9, 0.48, "| iterated extended | – | – | 0 of 1 | 20 % |"),
    ],
)
def test_the_target_holds_where_the_posterior_is_near_normal(skewness, width, expected) -> None:
    text = filters_text(study(skewness, width)).partition("Gaussian intervals against")[2]
    assert row(text, "| iterated extended") == expected


def test_failed_repeats_are_told() -> None:
    text = filters_text(study(0.0, 0.4, failed=3))
    assert "3 of 50 repeats failed" in row(text, "| iterated extended")


def test_a_filter_that_always_failed_has_dashes() -> None:
    text = filters_text(
        study(0.0, 0.4, failed=50, coverage=None, log_rms_error=None, width_ratio=None)
    )
    assert "| – % | – |" in row(text, "| iterated extended")


def test_files_are_written_and_hold_all_numbers(tmp_path) -> None:
    written = write_filter_study(tmp_path, study(0.0, 0.4))
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
    figure = filters_figure(study(0.0, width))
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
