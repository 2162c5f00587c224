"""What a page says of an estimate that is not to be believed."""

from dataclasses import replace

import pytest

from mvest.problem.verdict import DOUBTFUL, NONE, ONE_STATE, TRUSTWORTHY, Ground, Verdict
from mvest.reporting.case.words import answer, badges, verdict_words
from tests.reporting.case.made_up_case import made_up_case

LEAKS = Ground("closure", NONE, "the fitted valve leaves 121 mm² free", "check the chordae")
WIDE = Ground("what the data add", DOUBTFUL, "the data narrow it to 80 %", "add a frame")


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    return made_up_case(tmp_path_factory.mktemp("case"))[0]


def test_no_number_is_stated_of_what_is_not_to_be_believed(case):
    judged = replace(case, verdict=Verdict(NONE, (LEAKS, WIDE), ("distance",)))
    assert answer(judged) == ("No stiffness can be stated: the fitted valve leaves 121 mm² free.")
    assert "NOT TO BE BELIEVED" in badges(judged)
    head, against, missing = verdict_words(judged)
    assert head == "No stiffness is to be taken from this run."
    assert against[0] == "The fitted valve leaves 121 mm² free. Next: check the chordae."
    assert missing == []
    asked = replace(LEAKS, text="3 mm off: do its vertices correspond?")
    judged = replace(case, verdict=Verdict(NONE, (asked,), ()))
    assert answer(judged) == "No stiffness can be stated: 3 mm off: do its vertices correspond?"
    assert verdict_words(judged)[1][0].endswith("correspond? Next: check the chordae.")


def test_a_doubt_stands_before_the_numbers(case):
    judged = replace(case, verdict=Verdict(DOUBTFUL, (WIDE,), ("distance",), ("closure",)))
    assert answer(judged).startswith("Doubtful, since the data narrow it to 80 %: E_f anterior ")
    assert verdict_words(judged)[2] == ["closure"]


def test_what_is_trusted_is_answered_by_its_numbers(case):
    judged = replace(case, verdict=Verdict(TRUSTWORTHY, (), ("distance", "closure")))
    assert answer(judged) == answer(case)
    assert "TRUSTWORTHY" in badges(judged)
    assert verdict_words(judged)[0] == "Trustworthy: all 2 checks were passed."
    # Of one's own valve the gate is not asked, and how to ask it is said.
    unasked = replace(judged, verdict=Verdict(TRUSTWORTHY, (), ("distance",), (ONE_STATE,)))
    assert verdict_words(unasked)[0] == "Trustworthy: all 1 checks were passed."
    assert "check=true gate=true asks it" in verdict_words(unasked)[2][0]
    assert verdict_words(case) == ("The run did not judge its estimate.", [], [])
