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
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeAlias

import numpy as np

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


@dataclass(frozen=True, slots=True)
class Held:
    """Mean distances (mm) of a frame that was held out to the generic and the fitted valve.

    The generic valve is moved rigidly to the closed frame, as the fitted one may be.
    """

    frame: str
    generic: float
    fitted: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Indications:
    """What is seen of an estimate; None or empty where it is not known.

    Attributes
    ----------
    estimated : bool
        Whether there is an estimate with a prediction.
    ended : str
        Why the estimation ended.
    converged : bool
    approximation : str or None
        What is wrong with the filter's approximation of the posterior; empty if nothing is, or
        not enough (`APPROXIMATION`).
    nis : float or None
        Normalised innovation squared over the number of observations.
    nis_band : (float, float) or None
        Where 95 % of such numbers lie.
    stretch : mapping
        What was known beforehand -> by how many of its standard deviations it was moved.
    data_alone : mapping
        Modulus -> where the data alone have it, in the prior's standard deviations from its mean.
    alike : float or None
        Correlation of what is left over at neighbouring points, standardised (Moran's I).
    held_out : tuple of Held
    orifice_mm2, observed_orifice_mm2 : float or None
        Free in the line of sight, of the fitted valve and of the observed one.
    again : bool or None
        Whether the fitted closed state was also reached from the open valve.
    gate : bool or None
        Whether the valve has passed the gate (:mod:`mvest.closure.robustness`); None: not asked.
    moved : float or None
        Standard deviations of a modulus, at most, by which the estimate is away from where what is
        not known of the geometry was linearised last.
    law : float or None
        How far the tissue is expected to be on its way from the linear law to an exponential one.
    doubts, mistakes : tuple of str
        About the case itself, see `mvest.cases.plausibility`.
    unaccounted : tuple of str
        Why some errors of geometry or law are not in the intervals.
    unlike : str
        How the volume that the case is from is unlike those that detectors were trained on; empty
        where it is not, or where there is no volume.
    """

    estimated: bool
    ended: str = ""
    converged: bool = True
    approximation: str | None = None
    nis: float | None = None
    nis_band: tuple[float, float] | None = None
    stretch: Mapping[str, float] = field(default_factory=dict)
    data_alone: Mapping[str, float] = field(default_factory=dict)
    alike: float | None = None
    held_out: tuple[Held, ...] = ()
    orifice_mm2: float | None = None
    observed_orifice_mm2: float | None = None
    again: bool | None = None
    gate: bool | None = None
    moved: float | None = None
    law: float | None = None
    doubts: tuple[str, ...] = ()
    mistakes: tuple[str, ...] = ()
    unaccounted: tuple[str, ...] = ()
    unlike: str = ""


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

Words = Mapping[str, object]
Found = Iterable[tuple[float, Words]]
STATED: tuple[float, float] = (0.0, math.inf)
"""Limits of what is doubtful wherever it is found."""
GRAVE: tuple[float, float] = (0.0, 0.0)
"""Limits of what leaves no estimate wherever it is found."""


@dataclass(frozen=True, slots=True)
class Check:
    """One row of `CHECKS`.

    Attributes
    ----------
    name : str
        Of the check; rows of one name are one check.
    look : function
        Values that indications hold for it, each with words for the text; None if there is nothing
        to look at.
    limits : (float, float)
        Beyond the first a value is doubtful, beyond the second it leaves no estimate.
    text, advice : str
        Of a `Ground`. ``{value}`` and ``{limit}`` (the first) stand in it beside the words.
    """

    name: str
    look: Callable[[Indications], Found | None]
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


def judge(seen: Indications) -> Verdict:
    """The verdict that indications lead to: one doubtful check is doubtful, two are none."""
    grounds: list[Ground] = []
    missing: list[str] = []
    for check in CHECKS:
        found = check.look(seen)
        if found is not None:
            grounds += check.grounds(found)
            continue
        missing.append(check.name)
        if check.name in NEEDED and seen.estimated:
            unknown = f"nothing is known of {check.name}"
            grounds.append(Ground(check.name, DOUBTFUL, unknown, "record it"))
    grounds.sort(key=lambda ground: -RANK[ground.trust])
    against = {ground.check: RANK[ground.trust] for ground in reversed(grounds)}
    trust = (TRUSTWORTHY, DOUBTFUL, NONE)[min(sum(against.values()), 2)]
    names = dict.fromkeys(check.name for check in CHECKS)
    passed = tuple(name for name in names if name not in against and name not in missing)
    return Verdict(trust, tuple(grounds), passed, tuple(missing))


def _one(value: float | None) -> Found | None:
    """A value, if it is known."""
    return None if value is None else [(value, {"size": value})]


def _each(values: Mapping[str, float]) -> Found | None:
    """The size of each value with its name, if there are any."""
    return [(abs(value), {"what": what}) for what, value in values.items()] or None


def _stated(texts: Iterable[str]) -> Found:
    """Texts, each of which is a ground."""
    return [(math.inf, {"what": text}) for text in texts if text]


def _innovation(e: Indications) -> Found | None:
    """How many times beyond its band the innovation is.

    Errors smaller than assumed leave intervals wider than they need to be, and are no ground.
    """
    if e.nis is None or e.nis_band is None:
        return None
    root, low, high = np.sqrt([e.nis, *e.nis_band])
    return [(e.nis / e.nis_band[1], {"root": root, "low": low, "high": high})]


def _closure(e: Indications) -> Found | None:
    if e.orifice_mm2 is None or e.observed_orifice_mm2 is None:
        return None
    fitted, observed = e.orifice_mm2, e.observed_orifice_mm2
    return [(fitted - observed, {"fitted": fitted, "observed": observed})]


CHECKS = (
    Check(
        "iterations",
        lambda e: [] if e.estimated else _stated([e.ended or "the run gives no reason"]),
        GRAVE,
        "there is no estimate: {what}",
        "close the valve with the generic moduli first (check=true); if that fails, look at "
        "chordae and annulus; if only a trial fails, narrow the priors",
    ),
    Check(
        "iterations",
        lambda e: [(math.inf, {"what": e.ended})] if e.estimated and not e.converged else [],
        GRAVE,
        "the iterations did not come to their end: {what}",
        "let it iterate longer (personal.max_iterations), or start nearer",
    ),
    Check(
        "approximation",
        lambda e: None if e.approximation is None else _stated([e.approximation]),
        STATED,
        "the interval is not that of the posterior: {what}",
        "sample the posterior",
    ),
    Check(
        "geometry",
        lambda e: _one(e.moved),
        (MOVED, math.inf),
        "a modulus is {value:.2f} of its standard deviations from where the geometry was "
        "linearised last, expected at most {limit:g}",
        "allow more such steps (personal.considered_geometry.renewals), or see the open shape, "
        "annulus and tips better",
    ),
    Check(
        "law",
        lambda e: _one(e.law),
        LAW,
        "what was seen puts the tissue at {value:.2f} of the way from the linear law to an "
        "exponential one, expected at most {limit:g}: it probably stiffens",
        "estimate how far each leaflet stiffens (personal=stiffening); moduli of the linear law "
        "are those of its stretch alone",
    ),
    Check("case", lambda e: _stated(e.mistakes), GRAVE, "{what}", "mend the case and run it again"),
    Check(
        "case",
        lambda e: _stated([e.unlike]),
        GRAVE,
        "{what}",
        "record another volume, or segment it by other means",
    ),
    Check("case", lambda e: _stated(e.doubts), STATED, "{what}", "look at this part of the case"),
    Check(
        "errors left out",
        lambda e: _stated(e.unaccounted),
        STATED,
        "what is not known of geometry or law is not in the intervals: {what}",
        "close the valve with a finer mesh, or state these errors smaller",
    ),
    Check(
        "size of what is left over",
        _innovation,
        (1.0, NIS_FACTOR),
        "what the fit leaves over is {root:.2f} times what its errors explain, expected {low:.2f} "
        "to {high:.2f}",
        "state larger errors, or look where the model cannot follow (map of the innovation)",
    ),
    Check(
        "pattern of what is left over",
        lambda e: None if e.alike is None else [(abs(e.alike), {"alike": e.alike})],
        (ALIKE, math.inf),
        "what the fit leaves over is alike at neighbouring points (correlation {alike:.2f}, "
        "expected below {limit:g})",
        "errors are smoother than believed, or the model has another shape: see their map",
    ),
    Check(
        "what was known beforehand",
        lambda e: _each(e.stretch),
        STRETCH,
        "{what} was moved by {value:.1f} of its standard deviations, expected at most {limit:g}",
        "check what the case says of it; if it is right, {what} makes up for something else that "
        "is wrong",
    ),
    Check(
        "data against prior",
        lambda e: _each(e.data_alone),
        (FAR, math.inf),
        "the data alone have {what} {value:.1f} of its prior's standard deviations from the "
        "prior's mean, expected at most {limit:g}: the estimate lies between the two",
        "see the estimate by the data alone; widen the prior if such a modulus may be",
    ),
    Check(
        "frames held out",
        lambda e: [(x.fitted - WORSE * x.generic, {"one": x}) for x in e.held_out] or None,
        STATED,
        "frame {one.frame}, which was not fitted, is {one.fitted:.2f} mm from the fitted valve and "
        "{one.generic:.2f} mm from the generic one",
        "the moduli do not predict; check that frame's pressure and annulus",
    ),
    Check(
        "closure",
        _closure,
        LEAK,
        "the fitted valve leaves {fitted:.0f} mm² free, the observed one {observed:.0f} mm²",
        "chordae too short, leaflets too small, or tips too far: check them",
    ),
    Check(
        "closed anew",
        lambda e: None if e.again is None else _one(float(not e.again)),
        STATED,
        "the fitted valve, closed anew from the open one, ends in another closed state",
        "ask the gate of this valve (check=true gate=true)",
    ),
    Check(
        ONE_STATE,
        lambda e: None if e.gate is None else _one(float(not e.gate)),
        STATED,
        "the valve did not pass the gate: its closed state is not the only one, or jumps while "
        "moduli change",
        "the gate says by what (experiment=gate, check=true gate=true); a finer mesh or denser "
        "contact samples may mend it",
    ),
)

NEEDED = ("size of what is left over", "what was known beforehand")
"""Checks without which no estimate is trustworthy."""
