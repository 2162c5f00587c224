"""Can an estimate be trusted? The verdict comes before every number of a case.

A converged filter only says that its iterations ended. These checks need no truth: residuals match
the stated noise, no known quantity was stretched to fit, the fitted valve closes as the observed
one does. One doubtful check makes an estimate doubtful; two doubtful checks or one grave one leave
no estimate.

The limits were set on the even seeds of fifteen misspecified simulations (300 moduli) and judged on
the odd seeds (298): intervals missed the truth in 1 of 164 (trustworthy), 2 of 70 (doubtful) and
13 of 64 (none), median errors of the logarithm were 0.11, 0.13 and 0.20, and the area under the
curve for a missed interval was 0.84. These numbers are of an earlier estimator; the study
*calibration* has those of the present one. Two checks were dropped because they predicted no miss:
the distance of the fitted valve from the closed frame, and how much the data narrow the prior.
"""

import math
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

Trust: TypeAlias = Literal["trustworthy", "doubtful", "none"]
"""Trust in an estimate; with ``none`` no number is stated."""

TRUSTWORTHY: Trust = "trustworthy"
DOUBTFUL: Trust = "doubtful"
NONE: Trust = "none"
LEVELS: tuple[Trust, ...] = (TRUSTWORTHY, DOUBTFUL, NONE)


@dataclass(frozen=True, slots=True)
class FailedCheck:
    """A failed check of an estimate."""

    check: str  #: its name
    trust: Trust  #: the best verdict that it admits
    text: str  #: what was found, with its number and the expected one
    advice: str = ""  #: what to do next


@dataclass(frozen=True, slots=True)
class Verdict:
    """The trust in an estimate and its reasons."""

    trust: Trust
    #: The gravest first; empty for a trustworthy estimate.
    failed_checks: tuple[FailedCheck, ...] = ()
    passed: tuple[str, ...] = ()  #: names of the checks that it passed
    missing: tuple[str, ...] = ()  #: names of the checks without data

    def __str__(self) -> str:
        if not self.failed_checks:
            return f"{self.trust}: {len(self.passed)} checks passed"
        return f"{self.trust}: " + "; ".join(failed.text for failed in self.failed_checks)


Found: TypeAlias = Iterable[tuple[float, Mapping[str, object]]]
"""Values that a check compares with its limits, each with words for its text."""


def texts(*found: str) -> Found:
    """Findings that are texts and always fail; empty ones are ignored."""
    return [(math.inf, {"what": text}) for text in found if text]


@dataclass(frozen=True, slots=True)
class Check:
    """One table of ``checks.toml``; see its head."""

    name: str
    value: str  #: what is compared with the limits
    limits: Sequence[float]
    text: str
    advice: str

    def failed_checks(self, found: Found) -> list[FailedCheck]:
        """The values above the limits."""
        doubtful, grave = self.limits
        return [
            FailedCheck(
                self.name,
                NONE if value > grave else DOUBTFUL,
                self.text.format(value=value, limit=doubtful, **words),
                self.advice.format(**words),
            )
            for value, words in found
            if value > doubtful
        ]


def judge(seen: Mapping[str, Found]) -> Verdict:
    """The verdict on an estimate.

    ``seen``: key of `CHECKS` -> what was found. Checks without a key count as missing.
    """
    failed_checks: list[FailedCheck] = []
    missing: list[str] = []
    for key, check in CHECKS.items():
        if key in seen:
            failed_checks += check.failed_checks(seen[key])
            continue
        missing.append(check.name)
        if key in NEEDED and not seen["failed"]:
            unknown = f"nothing is known of {check.name}"
            failed_checks.append(FailedCheck(check.name, DOUBTFUL, unknown, "record it"))
    failed_checks.sort(key=lambda failed: -LEVELS.index(failed.trust))
    against = {failed.check: LEVELS.index(failed.trust) for failed in reversed(failed_checks)}
    trust = LEVELS[min(sum(against.values()), 2)]
    names = dict.fromkeys(check.name for check in CHECKS.values())
    passed = tuple(name for name in names if name not in against and name not in missing)
    return Verdict(trust, tuple(failed_checks), passed, tuple(missing))


CHECKS: Mapping[str, Check] = {
    key: Check(**row)
    for key, row in tomllib.loads(
        Path(__file__).with_name("checks.toml").read_text(encoding="utf-8")
    ).items()
}
"""The checks of ``checks.toml`` by key."""

NEEDED = ("innovation", "stretch")
"""Checks without which no estimate is trustworthy."""

ONE_STATE = CHECKS["gate"].name
