"""May an estimate be believed? What stands before every number of a case.

That a filter has converged says that its iterations have ended. Whether moduli follow from what was
seen is another question, and none of its answers need the truth: what is left over by the fit has
the size and the looks of noise, nothing known beforehand had to be stretched, and the fitted valve
does what the observed one does. Each answer that speaks against an estimate is a `Ground` with its
number and its limit. One doubtful ground makes an estimate doubtful. Two doubtful grounds, or one
grave one, leave no estimate to believe.

Which grounds there are, and how many are too many, was set on the even seeds of fifteen simulated
ways in which a model may be wrong (300 moduli) and judged on the odd ones (298): intervals missed
the truth in 1 of 164, 2 of 70 and 13 of 64, median errors were 0.11, 0.13 and 0.20 of a logarithm,
and the area under the curve for a missed interval was 0.84. Both halves had been looked at before,
and an earlier estimator had made the estimates, so other seeds have yet to confirm it. Two
grounds told nothing and are gone: how far the fitted valve is from the closed frame (36 moduli, no
interval missed), and how much the data narrow the prior (28, none).
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

Trust: TypeAlias = Literal["trustworthy", "doubtful", "none"]
"""How far an estimate may be believed; of ``none`` no number is stated."""

TRUSTWORTHY: Trust = "trustworthy"
DOUBTFUL: Trust = "doubtful"
NONE: Trust = "none"
RANK: Mapping[Trust, int] = {TRUSTWORTHY: 0, DOUBTFUL: 1, NONE: 2}


@dataclass(frozen=True, slots=True)
class Ground:
    """One reason for a verdict.

    Attributes
    ----------
    check : str
        What was looked at.
    trust : Trust
        The best verdict that it admits.
    text : str
        What was seen, with its number and what is expected.
    advice : str
        What to do next.
    """

    check: str
    trust: Trust
    text: str
    advice: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What may be believed of an estimate, and why.

    Attributes
    ----------
    trust : Trust
    grounds : tuple of Ground
        Those that speak against it, the gravest first; empty for a trustworthy one.
    passed : tuple of str
        The checks that it passed.
    missing : tuple of str
        The checks for which there was nothing to look at.
    """

    trust: Trust
    grounds: tuple[Ground, ...] = ()
    passed: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    def __str__(self) -> str:
        if not self.grounds:
            return f"{self.trust}: {len(self.passed)} checks passed"
        return f"{self.trust}: " + "; ".join(ground.text for ground in self.grounds)


Found: TypeAlias = Iterable[tuple[float, Mapping[str, object]]]
"""Values that a check compares with its limits, each with words for its text."""


def texts(*found: str) -> Found:
    """Findings that are texts; empty ones are none."""
    return [(math.inf, {"what": text}) for text in found if text]


@dataclass(frozen=True, slots=True)
class Check:
    """One row of `CHECKS`.

    Attributes
    ----------
    name : str
        Rows of one name are one check.
    limits : two numbers
        Beyond the first a value is doubtful, beyond the second it leaves no estimate.
    text, advice : str
        Of a `Ground`. ``{value}`` and ``{limit}`` (the first) stand in it beside the words.
    """

    name: str
    limits: Sequence[float]
    text: str
    advice: str

    def grounds(self, found: Found) -> list[Ground]:
        """Those of the values that are beyond the limits."""
        doubtful, grave = self.limits
        return [
            Ground(
                self.name,
                NONE if value > grave else DOUBTFUL,
                self.text.format(value=value, limit=doubtful, **words),
                self.advice.format(**words),
            )
            for value, words in found
            if value > doubtful
        ]


def judge(seen: Mapping[str, Found]) -> Verdict:
    """The verdict on an estimate: one doubtful check is doubtful, two are none.

    Parameters
    ----------
    seen : mapping
        Key of a row of `CHECKS` -> what was found; a key is missing where nothing was looked at.
    """
    grounds: list[Ground] = []
    missing: list[str] = []
    for key, check in CHECKS.items():
        if key in seen:
            grounds += check.grounds(seen[key])
            continue
        missing.append(check.name)
        if key in NEEDED and not seen["failed"]:
            unknown = f"nothing is known of {check.name}"
            grounds.append(Ground(check.name, DOUBTFUL, unknown, "record it"))
    grounds.sort(key=lambda ground: -RANK[ground.trust])
    against = {ground.check: RANK[ground.trust] for ground in reversed(grounds)}
    trust = (TRUSTWORTHY, DOUBTFUL, NONE)[min(sum(against.values()), 2)]
    names = dict.fromkeys(check.name for check in CHECKS.values())
    passed = tuple(name for name in names if name not in against and name not in missing)
    return Verdict(trust, tuple(grounds), passed, tuple(missing))


CHECKS: Mapping[str, Check] = {
    key: Check(**row)
    for key, row in tomllib.loads(
        Path(__file__).with_name("checks.toml").read_text(encoding="utf-8")
    ).items()
}
"""What is looked at, by key: ``checks.toml``."""

NEEDED = ("innovation", "stretch")
"""Checks without which no estimate is trustworthy."""

ONE_STATE = CHECKS["gate"].name
