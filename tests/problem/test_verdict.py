"""What each check of an estimate admits and what it refuses."""

import math

import pytest

from mvest.problem.verdict import (
    CHECKS,
    DOUBTFUL,
    NEEDED,
    NONE,
    ONE_STATE,
    TRUSTWORTHY,
    judge,
    texts,
)

ALWAYS = dict.fromkeys(
    ("failed", "unfinished", "mistakes", "implausible", "unlike", "unaccounted"), ()
)
"""Without a finding, of every estimate."""


def sizes(**by_name):
    return [(value, {"what": name}) for name, value in by_name.items()]


def one(value, **words):
    return [(value, words)]


def held(excess):
    return one(excess, frame="late", fitted=1.06, generic=1.0)


def innovation(value):
    return one(value, root=1.03, low=0.98, high=1.02)


def leak(fitted):
    return one(fitted - 2.0, fitted=fitted, observed=2.0)


GOOD = ALWAYS | {
    "approximation": (),
    "moved": one(0.4),
    "law": one(0.2),
    "innovation": innovation(0.97),
    "correlation": one(0.05, correlation=0.05),
    "stretch": sizes(pressure_scale=1.2, smooth=0.4),
    "data_alone": sizes(anterior=1.4, posterior=0.3),
    "held_out": held(-0.3),
    "closure": leak(3.0),
    "again": one(0.0),
    "calibration": (),
    "gate": one(0.0),
}


def test_an_estimate_that_passes_all_checks_is_trustworthy():
    verdict = judge(GOOD)
    assert verdict.trust == TRUSTWORTHY
    assert verdict.failed_checks == ()
    assert len(verdict.passed) == 15
    assert verdict.missing == ()
    assert str(verdict) == "trustworthy: 15 checks passed"


CASES = [
    ("failed", texts("it did not close"), NONE, "it did not close"),
    ("approximation", texts("bent"), DOUBTFUL, "not that of the posterior: bent"),
    ("law", one(0.24), DOUBTFUL, "0.24 of the way from the linear law"),
    ("law", one(0.36), NONE, "0.36 of the way from the linear law"),
    ("unaccounted", texts("no law"), DOUBTFUL, "not in the intervals: no law"),
    ("mistakes", texts("units: is it in cm?"), NONE, "is it in cm?"),
    ("unlike", texts("seen with 0.7"), NONE, "seen with 0.7"),
    ("implausible", texts("thickness: 4 mm"), DOUBTFUL, "thickness: 4 mm"),
    ("innovation", innovation(1.02), DOUBTFUL, "1.03 times as large"),
    ("correlation", one(0.28, correlation=-0.28), DOUBTFUL, "correlated (-0.28"),
    ("stretch", sizes(chord_rest_length=3.7), NONE, "3.7 of its standard"),
    ("data_alone", sizes(anterior=2.2), DOUBTFUL, "anterior 2.2"),
    ("held_out", held(0.01), DOUBTFUL, "frame late"),
    ("closure", leak(121.0), NONE, "leaves 121 mm² free, the observed one 2 mm²"),
    ("again", one(1.0), DOUBTFUL, "reaches another closed state"),
    ("calibration", texts("measured for other detectors"), DOUBTFUL, "was measured for other det"),
    ("gate", one(1.0), DOUBTFUL, "did not pass the gate"),
]


@pytest.mark.parametrize(("key", "found", "trust", "words"), CASES)
def test_each_check_counts_and_states_its_number(key, found, trust, words):
    verdict = judge(GOOD | {key: found})
    assert verdict.trust == trust
    (failed,) = verdict.failed_checks
    assert words in failed.text
    assert failed.advice
    assert failed.check == CHECKS[key].name
    assert failed.check not in verdict.passed


@pytest.mark.parametrize("key", [key for key, check in CHECKS.items() if check.limits[0]])
def test_limits_themselves_are_admitted(key):
    (_, words), limit = GOOD[key][0], CHECKS[key].limits[0]
    assert judge(GOOD | {key: [(limit, words)]}).trust == TRUSTWORTHY
    assert judge(GOOD | {key: [(math.nextafter(limit, 99.0), words)]}).trust == DOUBTFUL


def test_the_gravest_check_decides_and_comes_first():
    verdict = judge(
        GOOD | {"correlation": one(0.5, correlation=0.5), "gate": one(1.0), "closure": leak(121)}
    )
    assert verdict.trust == NONE
    assert [failed.trust for failed in verdict.failed_checks] == [NONE, DOUBTFUL, DOUBTFUL]
    assert str(verdict).startswith("none: the fitted valve leaves 121 mm²")


def test_checks_without_data_are_missing_and_do_not_count_as_passed():
    verdict = judge(ALWAYS)
    assert len(verdict.missing) == 12
    # Two of these are needed, and two failed_checks are one too many.
    assert verdict.trust == NONE
    assert [failed.check for failed in verdict.failed_checks] == [
        CHECKS[key].name for key in NEEDED
    ]
    assert set(verdict.missing).isdisjoint(verdict.passed)
    assert "data against prior" in verdict.missing
    known = {
        key: found for key, found in GOOD.items() if key not in ("correlation", "held_out", "gate")
    }
    assert judge(known).trust == TRUSTWORTHY
    assert judge(known).missing[-1] == ONE_STATE


def test_two_doubtful_checks_are_none_and_two_findings_of_one_are_doubtful():
    smooth = {"correlation": one(0.5, correlation=0.5)}
    assert judge(GOOD | smooth).trust == DOUBTFUL
    assert judge(GOOD | smooth | {"moved": one(1.5)}).trust == NONE
    assert judge(GOOD | {"implausible": texts("thick", "wide")}).trust == DOUBTFUL
