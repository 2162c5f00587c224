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
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
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


APPROXIMATION = 2.0
"""Times the limit of a check of the filter (`mvest.estimation.check`) beyond which it is doubtful.
The check is of the worst direction among all unknowns: moduli lay inside their intervals where it
failed by less."""
MOVED = 0.5
"""Standard deviations of a modulus by which an estimate may be away from where the geometry was
linearised last: twice what is taken for the end of such steps."""
LAW = (0.2, 0.3)
"""Share of the way to an exponential law beyond which moduli of the linear one are doubtful, and
beyond which there are none: moduli make up for much of a law that is not theirs."""
FAR = 2.0
"""Standard deviations of the prior beyond which the data alone contradict it."""
STRETCH = (2.5, 3.5)
"""Standard deviations by which a prior may be moved: beyond the first it is doubtful (1 % of right
ones are), beyond the second it is contradicted (1 in 2000)."""
NIS_FACTOR = 1.5
"""Beyond its band by this factor the normalised innovation contradicts what is believed of errors:
after they were learned, nothing but a model that cannot do what was seen takes it there."""
ALIKE = 0.25
"""Correlation of whitened residuals at neighbouring points above which there is structure."""
LEAK = (10.0, 30.0)
"""mm² by which the fitted valve may be more open than the observed one: about the error of such an
area from a jagged edge, and what no closed valve has."""
WORSE = 1.05
"""Distance of a held-out frame, fitted over generic, that counts as farther."""


ONE_STATE = "one closed state"
"""The check of the gate. It is not asked of a valve that is met for the first time, since it costs
minutes; that it was not is no ground against an estimate, and is said."""

Found: TypeAlias = Iterable[tuple[float, Mapping[str, object]]]
"""Values that a check compares with its limits, each with words for its text."""
ALWAYS: tuple[float, float] = (0.0, math.inf)
"""Limits of a check of which every finding is doubtful."""
GRAVE: tuple[float, float] = (0.0, 0.0)
"""Limits of a check of which every finding leaves no estimate."""


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
    limits : (float, float)
        Beyond the first a value is doubtful, beyond the second it leaves no estimate.
    text, advice : str
        Of a `Ground`. ``{value}`` and ``{limit}`` (the first) stand in it beside the words.
    """

    name: str
    limits: tuple[float, float]
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
    "failed": Check(
        "iterations",
        GRAVE,
        "there is no estimate: {what}",
        "close the valve with the generic moduli first (check=true); if that fails, look at "
        "chordae and annulus; if only a trial fails, narrow the priors",
    ),
    "unfinished": Check(
        "iterations",
        GRAVE,
        "the iterations did not come to their end: {what}",
        "let it iterate longer (personal.max_iterations), or start nearer",
    ),
    "approximation": Check(
        "approximation",
        ALWAYS,
        "the interval is not that of the posterior: {what}",
        "sample the posterior",
    ),
    "moved": Check(
        "geometry",
        (MOVED, math.inf),
        "a modulus is {value:.2f} of its standard deviations from where the geometry was "
        "linearised last, expected at most {limit:g}",
        "allow more such steps (personal.considered_geometry.renewals), or see the open shape, "
        "annulus and tips better",
    ),
    "law": Check(
        "law",
        LAW,
        "what was seen puts the tissue at {value:.2f} of the way from the linear law to an "
        "exponential one, expected at most {limit:g}: it probably stiffens",
        "estimate how far each leaflet stiffens (personal=stiffening); moduli of the linear law "
        "are those of its stretch alone",
    ),
    "mistakes": Check("case", GRAVE, "{what}", "mend the case and run it again"),
    "unlike": Check(
        "case",
        GRAVE,
        "{what}",
        "record another volume, or segment it by other means",
    ),
    "doubts": Check("case", ALWAYS, "{what}", "look at this part of the case"),
    "unaccounted": Check(
        "errors left out",
        ALWAYS,
        "what is not known of geometry or law is not in the intervals: {what}",
        "close the valve with a finer mesh, or state these errors smaller",
    ),
    "innovation": Check(
        "size of what is left over",
        (1.0, NIS_FACTOR),
        "what the fit leaves over is {root:.2f} times what its errors explain, expected {low:.2f} "
        "to {high:.2f}",
        "state larger errors, or look where the model cannot follow (map of the innovation)",
    ),
    "alike": Check(
        "pattern of what is left over",
        (ALIKE, math.inf),
        "what the fit leaves over is alike at neighbouring points (correlation {alike:.2f}, "
        "expected below {limit:g})",
        "errors are smoother than believed, or the model has another shape: see their map",
    ),
    "stretch": Check(
        "what was known beforehand",
        STRETCH,
        "{what} was moved by {value:.1f} of its standard deviations, expected at most {limit:g}",
        "check what the case says of it; if it is right, {what} makes up for something else that "
        "is wrong",
    ),
    "data_alone": Check(
        "data against prior",
        (FAR, math.inf),
        "the data alone have {what} {value:.1f} of its prior's standard deviations from the "
        "prior's mean, expected at most {limit:g}: the estimate lies between the two",
        "see the estimate by the data alone; widen the prior if such a modulus may be",
    ),
    "held_out": Check(
        "frames held out",
        ALWAYS,
        "frame {frame}, which was not fitted, is {fitted:.2f} mm from the fitted valve and "
        "{generic:.2f} mm from the generic one",
        "the moduli do not predict; check that frame's pressure and annulus",
    ),
    "closure": Check(
        "closure",
        LEAK,
        "the fitted valve leaves {fitted:.0f} mm² free, the observed one {observed:.0f} mm²",
        "chordae too short, leaflets too small, or tips too far: check them",
    ),
    "again": Check(
        "closed anew",
        ALWAYS,
        "the fitted valve, closed anew from the open one, ends in another closed state",
        "ask the gate of this valve (check=true gate=true)",
    ),
    "gate": Check(
        ONE_STATE,
        ALWAYS,
        "the valve did not pass the gate: its closed state is not the only one, or jumps while "
        "moduli change",
        "the gate says by what (experiment=gate, check=true gate=true); a finer mesh or denser "
        "contact samples may mend it",
    ),
}
"""What is looked at, by key.

failed, unfinished, approximation
    Why there is no estimate, why the iterations did not end, what is wrong with the filter's
    approximation of the posterior.
moved
    Standard deviations of a modulus by which the estimate is away from the last linearisation point
    of the geometry.
law
    Share of the way from the linear law to an exponential one at which the tissue is expected.
mistakes, doubts, unlike
    Of the case (`mvest.cases.plausibility`); how its volume is unlike those of the detectors.
unaccounted
    Why some errors of geometry or law are not in the intervals.
innovation
    Normalised innovation squared over the upper end of its 95 % band.
alike
    Size of the correlation of whitened residuals at neighbouring points (Moran's I).
stretch, data_alone
    Standard deviations by which something known beforehand was moved, and by which the data alone
    have a modulus away from its prior's mean.
held_out, closure
    mm by which a frame that was not fitted is farther from the fitted valve than it may be; mm² by
    which the fitted valve is more open than the observed one.
again, gate
    1 where the fitted valve did not close to the same state again, or the gate was not passed.
"""

NEEDED = ("innovation", "stretch")
"""Checks without which no estimate is trustworthy."""
