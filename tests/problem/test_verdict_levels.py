"""Skill of the verdict's levels on published estimates of simulated valves.

`results/calibration_estimates.csv` holds 598 estimated moduli of valves with fifteen kinds of
misspecification, and the failed checks of each. Those checks had other rules; here the rules of
`mvest.problem.verdict` judge them anew. They were set on even seeds; the odd ones had been looked
at too.
"""

import re
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pytest
from scipy.stats import rankdata

from mvest.problem.verdict import CHECKS, DOUBTFUL, NONE, TRUSTWORTHY, Found, judge, texts
from tests.places import ROOT

FILE = ROOT / "results" / "calibration_estimates.csv"
LEVELS = (TRUSTWORTHY, DOUBTFUL, NONE)
OLD = ("distance", "what the data add")
"""Checks that no longer exist."""
LEFT_OUT = "is not in the intervals: "


@dataclass(frozen=True)
class Level:
    """Moduli of one level of the verdict."""

    moduli: int
    missed: int
    median_error: float


def diagnostics(failed_checks: str) -> dict[str, Found]:
    """Findings from the published failed checks of an estimate."""
    names = "|".join(map(re.escape, (*{check.name for check in CHECKS.values()}, *OLD)))
    found: dict[str, list[str]] = {}
    for part in re.split(rf"; (?=(?:{names}): )", failed_checks) if failed_checks else []:
        check, _, text = part.partition(": ")
        found.setdefault(check, []).append(text)
    case = found.get("case", [])
    seen: dict[str, Found] = {
        "failed": (),
        "unfinished": texts(*found.get("iterations", [])),
        "approximation": texts(*found.get("approximation", [])),
        "mistakes": (),
        "unlike": (),
        "implausible": texts(*(text for text in case if LEFT_OUT not in text)),
        "unaccounted": texts(*(text for text in case if LEFT_OUT in text)),
        "innovation": (),
        "stretch": [(3.0, {"what": "prior"})] if "what was known beforehand" in found else (),
    }
    for key, pattern in (
        ("law", r"at (-?[\d.]+) of the way"),
        ("moved", r"a modulus is ([\d.]+) of its"),
    ):
        if (check := CHECKS[key].name) in found:
            seen[key] = [(float(re.search(pattern, found[check][0]).group(1)), {})]
    return seen


@pytest.fixture(scope="module")
def judged():
    """Seed, verdict, error of the logarithm and whether the interval missed, of each modulus."""
    table = pd.read_csv(FILE, comment="#")
    table = table[table["estimate"].notna()]
    failed_checks = table["failed_checks"].fillna("")
    verdicts = {text: judge(diagnostics(text)).trust for text in failed_checks.unique()}
    return pd.DataFrame(
        {
            "seed": table["seed"],
            "level": failed_checks.map(verdicts).map(LEVELS.index),
            "error": np.abs(np.log(table["estimate"] / table["truth"])),
            "missed": ~table["inside"].astype(bool),
        }
    )


def levels_of(some):
    return [
        Level(len(own), int(own["missed"].sum()), round(float(own["error"].median()), 2))
        for own in (some[some["level"] == k] for k in range(3))
    ]


def test_the_levels_order_estimates_whose_seeds_chose_nothing(judged):
    odd = judged[judged["seed"] % 2 == 1]
    # As the page on one's own valve states them.
    assert levels_of(odd) == [Level(164, 1, 0.11), Level(70, 2, 0.13), Level(64, 13, 0.2)]
    rank, missed = rankdata(odd["level"]), odd["missed"].to_numpy()
    n = missed.sum()
    area = (rank[missed].sum() - n * (n + 1) / 2) / (n * (len(odd) - n))
    assert area == pytest.approx(0.844, abs=0.001)


def test_a_law_that_is_far_off_is_grave(judged):
    assert judge(diagnostics("law: at 0.31 of the way")).trust == NONE
    assert judge(diagnostics("distance: it is far")).trust == TRUSTWORTHY
