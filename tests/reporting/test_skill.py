import numpy as np
import pytest

from mvest.problem.record import EstimateRecord, Unknown
from mvest.problem.verdict import DOUBTFUL, NONE, TRUSTWORTHY, Verdict
from mvest.reporting.skill import (
    log_width,
    prior_alone,
    score,
    share_bounds,
    skill,
    stated,
    trust_of,
    warning_table,
)


def answered(truth, estimate, low, high, generic) -> Unknown:
    # Believed within a factor of 1.48.
    return Unknown(
        name="E_f.anterior", label="", unit="MPa", kind="modulus", treatment="estimated",
        prior_mean=generic, prior_std=0.2 * generic, estimate=estimate, low=low, high=high,
        truth=truth,
    )  # fmt: skip


ASKED = [
    answered(10.0, 11.0, 9.0, 13.0, 5.0),
    answered(10.0, 8.0, 7.0, 9.0, 15.0),
    answered(2.0, 3.0, 1.0, 5.0, 2.0),
    answered(1.0, None, None, None, 2.0),
]


def test_errors_stand_beside_the_generic_guess_and_lost_estimates_are_counted():
    row = skill(ASKED)
    assert (row["n"], row["estimated"], row["inside"]) == (4, 3, 2)
    assert row["coverage"] == pytest.approx(200 / 3)
    # Errors of 10, -20 and 50 %; guesses are off by 50, 50 and 0 %, and by 100 % of what is lost.
    assert (row["mean error"], row["median error"]) == pytest.approx((40 / 3, 20.0))
    assert (row["generic guess"], row["generic guess, all"]) == (50.0, 50.0)
    # Of the priors only that of 2 MPa holds its truth.
    assert row["inside prior"] == 1
    # Widths of 4, 2 and 4 over estimates of 11, 8 and 3, and over truths of 10, 10 and 2.
    assert row["relative width"] == pytest.approx(4 / 11)
    assert row["mean width"] == pytest.approx((40 + 20 + 200) / 3)
    prior = 2 * 1.959964 * 0.2
    assert row["width over prior"] == pytest.approx(np.log(13 / 9) / prior, rel=1e-6)


def test_what_anyone_could_say():
    row = answered(10.0, 11.0, 9.0, 13.0, 5.0)
    before = prior_alone(row)
    assert before.estimate == 5.0
    # A relative SD of 0.2 becomes one of the logarithm.
    assert before.low == pytest.approx(5.0 * np.exp(-1.95996 * 0.2), rel=1e-5)
    assert log_width(before) == pytest.approx(2 * 1.95996 * 0.2, rel=1e-5)
    assert before.inside is False
    shift = prior_alone(Unknown(name="shift.x", prior_mean=0.0, prior_std=1.0, truth=-1.0))
    assert (shift.low, shift.high) == pytest.approx((-1.959964, 1.959964))
    assert score(shift) == pytest.approx(-1.0)


@pytest.mark.parametrize(
    ("inside", "n", "low", "high"),
    [
        # Clopper and Pearson's intervals as R's binom.test prints them: 7 of 20, 18 of 20.
        (7, 20, 0.1539092, 0.5921885),
        (18, 20, 0.6830173, 0.9876515),
        # All of n: the root of 0.025, 0.025^(1/20) = 0.8315665.
        (20, 20, 0.8315665, 1.0),
        (0, 0, 0.0, 1.0),
    ],
)
def test_bounds_of_a_share(inside, n, low, high):
    assert share_bounds(inside, n) == pytest.approx((low, high), abs=1e-7)


def test_verdicts_are_judged_by_the_intervals_that_miss():
    held, missed = ASKED[:2]

    def judged(case: str, trust: str, *unknowns: Unknown) -> EstimateRecord:
        return EstimateRecord(
            case=case, status="converged", reason="", verdict=Verdict(trust), unknowns=unknowns
        )

    some = [
        judged("a", TRUSTWORTHY, held, held),
        judged("a", DOUBTFUL, missed, held),
        judged("b", NONE, missed, ASKED[3]),
        judged("b", TRUSTWORTHY, held, missed),
    ]
    (row,) = warning_table(some).rows
    # Of the 3 x 4 pairs, the doubtful miss is worse than three and equal to one, the denied one
    # worse than all four, and the trusted one equal to three.
    assert (row["intervals"], row["missed"]) == (7, 3)
    assert row["area"] == pytest.approx((3 + 0.5 + 4 + 1.5) / 12)
    # Case a alone gives 5/6, case b alone 3/4.
    assert (row["low"], row["high"]) == pytest.approx((0.75, 5 / 6))
    (row,) = warning_table([some[0]]).rows
    assert (row["intervals"], row["missed"], row["area"]) == (2, 0, None)


def test_what_the_verdict_denies_has_no_numbers():
    whole = {"reason": "converged", "unknowns": tuple(ASKED[:1])}
    sure = EstimateRecord(status="converged", verdict=Verdict(TRUSTWORTHY), **whole)
    denied = sure.model_copy(update={"verdict": Verdict(NONE)})
    lost = EstimateRecord(status="failed", **whole)
    assert [trust_of(one) for one in (sure, denied, lost)] == [TRUSTWORTHY, NONE, NONE]
    assert [one.estimate for record in (sure, denied, lost) for one in stated(record)] == [
        11.0, None, None
    ]  # fmt: skip
    assert denied.unknowns[0].estimate == 11.0
