import numpy as np
import pytest
import yaml

from mvest.problem.record import Unknown
from mvest.problem.skill import (
    PRIOR_STD,
    baselines,
    generic_guess,
    log_width,
    prior_alone,
    score,
    share_bounds,
    skill,
)
from tests.places import CONF


def answered(truth, estimate, low, high, generic) -> Unknown:
    # Believed within a factor of 1.48.
    return Unknown(
        name="E_f.anterior", label="", unit="MPa", kind="modulus", treatment="estimated",
        prior_mean=generic, prior_std=0.2 * generic, estimate=estimate, low=low, high=high,
        truth=truth,
    )  # fmt: skip


def test_errors_stand_beside_the_generic_guess_and_runs_lost_count_as_misses():
    # Errors 10 %, 20 % and 50 %: median 20 %. Generic guesses off by 50 %, 50 %, 0 % and 100 %.
    asked = [
        answered(10.0, 11.0, 9.0, 13.0, 5.0),
        answered(10.0, 8.0, 7.0, 9.0, 15.0),
        answered(2.0, 3.0, 1.0, 5.0, 2.0),
        answered(1.0, None, None, None, 2.0),
    ]
    assert skill(asked) == {
        "n": 4,
        "without_estimate": 1,
        "inside": 2,
        "inside_prior_alone": 1,
        "median_error": pytest.approx(0.2),
        "median_error_generic_guess": pytest.approx(0.5),
    }


def test_without_an_estimate_there_is_no_error_to_compare():
    found = skill([answered(1.0, None, None, None, 2.0)])
    assert (found["n"], found["inside"], found["without_estimate"]) == (1, 0, 1)
    assert found["median_error"] is found["median_error_generic_guess"] is None


def test_what_anyone_could_say():
    row = answered(10.0, 11.0, 9.0, 13.0, 5.0)
    guess, before = generic_guess(row), prior_alone(row)
    assert (guess.estimate, guess.low, guess.inside) == (5.0, None, None)
    # A relative SD of 0.2 becomes one of the logarithm.
    assert before.low == pytest.approx(5.0 * np.exp(-1.95996 * 0.2), rel=1e-5)
    assert log_width(before) == pytest.approx(2 * 1.95996 * 0.2, rel=1e-5)
    assert before.inside is False
    shift = Unknown(
        name="shift.x", label="", unit="mm", kind="nuisance", treatment="estimated",
        prior_mean=0.0, prior_std=1.0, truth=-1.0,
    )  # fmt: skip
    assert (prior_alone(shift).low, prior_alone(shift).high) == pytest.approx((-1.959964, 1.959964))
    assert score(prior_alone(shift)) == pytest.approx(-1.0)
    assert score(shift) is None


def test_scores_are_of_the_logarithm():
    middle, sd = 4.0, 0.1
    row = answered(float(4.0 * np.exp(0.2)), middle, middle * np.exp(-1.959964 * sd),
                   middle * np.exp(1.959964 * sd), 5.0)  # fmt: skip
    assert score(row) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("inside", "n", "low", "high"),
    [
        # Clopper and Pearson's intervals as R's binom.test prints them: 7 of 20, 18 of 20.
        (7, 20, 0.1539092, 0.5921885),
        (18, 20, 0.6830173, 0.9876515),
        # None and all of n: the root of 0.025, 0.025^(1/20) = 0.8315665.
        (0, 20, 0.0, 0.1684335),
        (20, 20, 0.8315665, 1.0),
        (0, 0, 0.0, 1.0),
    ],
)
def test_bounds_of_a_share(inside, n, low, high):
    assert share_bounds(inside, n) == pytest.approx((low, high), abs=1e-7)


def test_what_stands_below_a_table_of_estimates():
    rows = [
        answered(10.0, 11.0, 9.0, 13.0, 5.0),
        answered(4.0, 8.0, 7.0, 9.0, 5.0),
        answered(8.0, None, None, None, 5.0),
    ]
    guess, before = baselines(rows)
    # 5 for 10, 4 and 8: 50 %, 25 % and 37.5 %, runs without an estimate included.
    assert (guess["what"], guess["low"], guess["n"]) == ("generic guess", None, 0)
    assert guess["median_error"] == pytest.approx(0.375)
    # 5 within a factor of exp(1.96 x 0.2) = 1.48 of 4, and neither of 10 nor of 8.
    assert (before["what"], before["inside"], before["n"]) == ("prior alone", 1, 3)
    assert (before["low"], before["high"]) == pytest.approx((3.38, 7.40), abs=0.01)


def test_the_prior_of_tables_is_that_of_the_configuration():
    text = (CONF / "personal" / "nuisances.yaml").read_text()
    for name, about in yaml.safe_load(text)["unknowns"].items():
        if name.startswith("E_f."):
            assert about["std"] / about["mean"] == pytest.approx(PRIOR_STD, abs=0.005)
