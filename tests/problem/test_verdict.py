"""What each check of an estimate lets through and what it stops."""

from dataclasses import replace

import pytest

from mvest.problem.verdict import (
    ALIKE,
    DOUBTFUL,
    FAR,
    LAW,
    LEAK,
    MOVED,
    NEEDED,
    NIS_FACTOR,
    NONE,
    ONE_STATE,
    STRETCH,
    TRUSTWORTHY,
    Held,
    Indications,
    judge,
)

GOOD = Indications(
    estimated=True,
    approximation="",
    nis=1.01,
    nis_band=(0.96, 1.04),
    stretch={"pressure_scale": -1.2, "smooth part of the errors": 0.4},
    data_alone={"E_f.anterior": 1.4, "E_f.posterior": -0.3},
    alike=0.05,
    held_out=(Held("late", 1.5, 1.1),),
    orifice_mm2=3.0,
    observed_orifice_mm2=2.0,
    again=True,
    gate=True,
    moved=0.4,
    law=0.2,
)


def test_an_estimate_against_which_nothing_speaks_is_trustworthy():
    verdict = judge(GOOD)
    assert verdict.trust == TRUSTWORTHY
    assert verdict.grounds == ()
    assert len(verdict.passed) == 14
    assert verdict.missing == ()
    assert str(verdict) == "trustworthy: 14 checks passed"


CASES = {
    "no estimate": ({"estimated": False, "ended": "it did not close"}, NONE, "it did not close"),
    "not converged": ({"converged": False, "ended": "20 iterations"}, NONE, "20 iterations"),
    "approximation": ({"approximation": "bent"}, DOUBTFUL, "not that of the posterior: bent"),
    "not linear": ({"moved": 1.1 * MOVED}, DOUBTFUL, "is 0.55 of its standard deviations from"),
    "stiffening": ({"law": 1.2 * LAW[0]}, DOUBTFUL, "0.24 of the way from the linear law"),
    "another law": ({"law": 1.2 * LAW[1]}, NONE, "0.36 of the way from the linear law"),
    "left out": ({"unaccounted": ("no law",)}, DOUBTFUL, "not in the intervals: no law"),
    "a mistake": ({"mistakes": ("units: is it in cm?",)}, NONE, "is it in cm?"),
    "an unlike volume": ({"unlike": "seen with 0.7"}, NONE, "seen with 0.7"),
    "a doubt": ({"doubts": ("thickness: 4 mm",)}, DOUBTFUL, "thickness: 4 mm"),
    "innovation beyond its band": ({"nis": 1.06}, DOUBTFUL, "1.03 times"),
    "innovation far beyond": ({"nis": 1.01 * NIS_FACTOR * 1.04}, NONE, "times what its errors"),
    "structure": ({"alike": 1.1 * ALIKE}, DOUBTFUL, "alike at neighbouring points"),
    "stretched": ({"stretch": {"pressure_scale": -1.01 * STRETCH[0]}}, DOUBTFUL, "pressure_scale"),
    "contradicted": ({"stretch": {"chord_rest_length": 3.7}}, NONE, "3.7 of its standard"),
    "against the prior": (
        {"data_alone": {"E_f.anterior": -1.1 * FAR}},
        DOUBTFUL,
        "E_f.anterior 2.2",
    ),
    "held out": ({"held_out": (Held("late", 1.0, 1.06),)}, DOUBTFUL, "frame late"),
    "ajar": ({"orifice_mm2": 2.1 + LEAK[0]}, DOUBTFUL, "leaves 12 mm"),
    "open": ({"orifice_mm2": 121.0}, NONE, "leaves 121 mm² free, the observed one 2 mm²"),
    "another closed state": ({"again": False}, DOUBTFUL, "ends in another closed state"),
    "an anatomy that failed": ({"gate": False}, DOUBTFUL, "did not pass the gate"),
}


@pytest.mark.parametrize(("changes", "trust", "words"), CASES.values(), ids=CASES)
def test_each_ground_counts_and_says_its_number(changes, trust, words):
    verdict = judge(replace(GOOD, **changes))
    assert verdict.trust == trust
    (ground,) = verdict.grounds
    assert words in ground.text
    assert ground.advice
    assert ground.check not in verdict.passed


@pytest.mark.parametrize(
    "changes",
    [
        {"nis": 0.3},
        {"moved": MOVED},
        {"law": LAW[0]},
        {"law": -1.0},
        {"nis": 1.04},
        {"stretch": {"x": STRETCH[0]}},
        {"data_alone": {"x": FAR}},
        {"alike": -ALIKE},
        {"held_out": (Held("late", 1.0, 1.05),)},
        {"orifice_mm2": 2.0 + LEAK[0]},
        {"orifice_mm2": 0.0, "observed_orifice_mm2": 80.0},
    ],
)
def test_limits_themselves_are_admitted(changes):
    assert judge(replace(GOOD, **changes)).trust == TRUSTWORTHY


def test_the_worst_ground_decides_and_stands_first():
    verdict = judge(replace(GOOD, alike=0.5, gate=False, orifice_mm2=121.0))
    assert verdict.trust == NONE
    assert [ground.trust for ground in verdict.grounds] == [NONE, DOUBTFUL, DOUBTFUL]
    assert str(verdict).startswith("none: the fitted valve leaves 121 mm²")


def test_what_there_was_nothing_to_look_at_for_is_named_and_not_counted_as_passed():
    verdict = judge(Indications(estimated=True))
    assert len(verdict.missing) == 11
    # Two of these are needed, and two grounds are one too many.
    assert verdict.trust == NONE
    assert [ground.check for ground in verdict.grounds] == list(NEEDED)
    assert judge(replace(GOOD, alike=None, gate=None, held_out=())).trust == TRUSTWORTHY
    assert judge(replace(GOOD, gate=None)).missing == (ONE_STATE,)
    assert set(verdict.missing).isdisjoint(verdict.passed)
    assert "data against prior" in verdict.missing


def test_two_doubtful_checks_are_none_and_two_grounds_of_one_are_doubtful():
    assert judge(replace(GOOD, alike=0.5)).trust == DOUBTFUL
    assert judge(replace(GOOD, alike=0.5, moved=1.0)).trust == NONE
    assert judge(replace(GOOD, doubts=("thick", "wide"))).trust == DOUBTFUL
