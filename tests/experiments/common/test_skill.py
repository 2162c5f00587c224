from experiments.common.cases.skill import skill_words
from mvest.reporting.case.findings import UnknownRow


def answered(truth, estimate, low, high, generic) -> UnknownRow:
    return UnknownRow(
        name="E_f.anterior", label="", unit="MPa", kind="modulus", treatment="estimated",
        prior_mean=generic, prior_std=1.0, estimate=estimate, low=low, high=high, truth=truth,
    )  # fmt: skip


def test_errors_stand_beside_the_generic_guess_and_runs_lost_count_as_misses():
    # Errors 10 %, 20 % and 50 %: median 20 %. Generic guesses off by 50 %, 50 %, 0 % and 100 %.
    asked = [
        answered(10.0, 11.0, 9.0, 13.0, 5.0),
        answered(10.0, 8.0, 7.0, 9.0, 15.0),
        answered(2.0, 3.0, 1.0, 5.0, 2.0),
        answered(1.0, None, None, None, 2.0),
    ]
    assert skill_words(asked) == (
        "2 of 4 moduli lie inside their 95 % intervals; the median error is 20.0 %, that of the "
        "generic guess 50.0 %; 1 without an estimate."
    )


def test_without_an_estimate_there_is_no_error_to_compare():
    words = skill_words([answered(1.0, None, None, None, 2.0)])
    assert words == "0 of 1 moduli lie inside their 95 % intervals; 1 without an estimate."
