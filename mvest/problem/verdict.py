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
and the area under the curve for a missed interval was 0.84. Two grounds told nothing and are gone:
how far the fitted valve is from the closed frame (36 moduli, no interval missed), and how much the
data narrow the prior (28, none).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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


def judge(seen: Indications) -> Verdict:
    """The verdict that indications lead to: one doubtful check is doubtful, two are none."""
    grounds: list[Ground] = []
    passed: list[str] = []
    missing: list[str] = []
    for check, look in CHECKS.items():
        found = list(look(seen))
        if found and found[0] is None:
            missing.append(check)
            if check in NEEDED and seen.estimated:
                grounds.append(Ground(check, DOUBTFUL, f"nothing is known of {check}", "record it"))
            continue
        against = [ground for ground in found if ground is not None]
        grounds += against
        if not against:
            passed.append(check)
    grounds.sort(key=lambda ground: -RANK[ground.trust])
    weight = sum({ground.check: RANK[ground.trust] for ground in reversed(grounds)}.values())
    trust = (TRUSTWORTHY, DOUBTFUL, NONE)[min(weight, 2)]
    return Verdict(trust, tuple(grounds), tuple(passed), tuple(missing))


Seen = Iterator[Ground | None]
"""Grounds against an estimate; None first where there was nothing to look at."""


def _ended(e: Indications) -> Seen:
    if not e.estimated:
        yield Ground(
            "iterations",
            NONE,
            f"there is no estimate: {e.ended or 'the run gives no reason'}",
            "close the valve with the generic moduli first (check=true); if that fails, look at "
            "chordae and annulus; if only a trial fails, narrow the priors",
        )
    elif not e.converged:
        yield Ground(
            "iterations",
            NONE,
            f"the iterations did not come to their end: {e.ended}",
            "let it iterate longer (personal.max_iterations), or start nearer",
        )


def _approximated(e: Indications) -> Seen:
    if e.approximation is None:
        yield None
    elif e.approximation:
        yield Ground(
            "approximation",
            DOUBTFUL,
            f"the interval is not that of the posterior: {e.approximation}",
            "sample the posterior",
        )


def _linear(e: Indications) -> Seen:
    if e.moved is None:
        yield None
    elif e.moved > MOVED:
        yield Ground(
            "geometry",
            DOUBTFUL,
            f"a modulus is {e.moved:.2f} of its standard deviations from where the geometry was "
            f"linearised last, expected at most {MOVED:g}",
            "allow more such steps (personal.considered_geometry.renewals), or see the open "
            "shape, annulus and tips better",
        )


def _stiffens(e: Indications) -> Seen:
    doubtful, grave = LAW
    if e.law is None:
        yield None
    elif e.law > doubtful:
        yield Ground(
            "law",
            NONE if e.law > grave else DOUBTFUL,
            f"what was seen puts the tissue at {e.law:.2f} of the way from the linear law to an "
            f"exponential one, expected at most {doubtful:g}: it probably stiffens",
            "estimate how far each leaflet stiffens (personal=stiffening); moduli of the linear "
            "law are those of its stretch alone",
        )


def _plausible(e: Indications) -> Seen:
    for text in e.mistakes:
        yield Ground("case", NONE, text, "mend the case and run it again")
    if e.unlike:
        yield Ground("case", NONE, e.unlike, "record another volume, or segment it by other means")
    for text in e.doubts:
        yield Ground("case", DOUBTFUL, text, "look at this part of the case")


def _accounted(e: Indications) -> Seen:
    for reason in e.unaccounted:
        yield Ground(
            "errors left out",
            DOUBTFUL,
            f"what is not known of geometry or law is not in the intervals: {reason}",
            "close the valve with a finer mesh, or state these errors smaller",
        )


def _innovation(e: Indications) -> Seen:
    if e.nis is None or e.nis_band is None:
        yield None
        return
    low, high = e.nis_band
    # Errors smaller than assumed leave intervals wider than they need to be.
    if e.nis <= high:
        return
    yield Ground(
        "size of what is left over",
        NONE if e.nis > NIS_FACTOR * high else DOUBTFUL,
        f"what the fit leaves over is {np.sqrt(e.nis):.2f} times what its errors explain, "
        f"expected {np.sqrt(low):.2f} to {np.sqrt(high):.2f}",
        "state larger errors, or look where the model cannot follow (map of the innovation)",
    )


def _structure(e: Indications) -> Seen:
    if e.alike is None:
        yield None
    elif abs(e.alike) > ALIKE:
        yield Ground(
            "pattern of what is left over",
            DOUBTFUL,
            f"what the fit leaves over is alike at neighbouring points (correlation "
            f"{e.alike:.2f}, expected below {ALIKE:g})",
            "errors are smoother than believed, or the model has another shape: see their map",
        )


def _stretched(e: Indications) -> Seen:
    if not e.stretch:
        yield None
    doubtful, contradicted = STRETCH
    for what, moved in e.stretch.items():
        if abs(moved) > doubtful:
            yield Ground(
                "what was known beforehand",
                NONE if abs(moved) > contradicted else DOUBTFUL,
                f"{what} was moved by {abs(moved):.1f} of its standard deviations, expected at "
                f"most {doubtful:g}",
                f"check what the case says of it; if it is right, {what} makes up for something "
                "else that is wrong",
            )


def _contradicts(e: Indications) -> Seen:
    if not e.data_alone:
        yield None
    for modulus, prior_stds in e.data_alone.items():
        if abs(prior_stds) > FAR:
            yield Ground(
                "data against prior",
                DOUBTFUL,
                f"the data alone have {modulus} {abs(prior_stds):.1f} of its prior's standard "
                f"deviations from the prior's mean, expected at most {FAR:g}: the estimate lies "
                "between the two",
                "see the estimate by the data alone; widen the prior if such a modulus may be",
            )


def _predicts(e: Indications) -> Seen:
    if not e.held_out:
        yield None
    for one in e.held_out:
        if one.fitted > WORSE * one.generic:
            yield Ground(
                "frames held out",
                DOUBTFUL,
                f"frame {one.frame}, which was not fitted, is {one.fitted:.2f} mm from the fitted "
                f"valve and {one.generic:.2f} mm from the generic one",
                "the moduli do not predict; check that frame's pressure and annulus",
            )


def _closes(e: Indications) -> Seen:
    if e.orifice_mm2 is None or e.observed_orifice_mm2 is None:
        yield None
        return
    more = e.orifice_mm2 - e.observed_orifice_mm2
    small, large = LEAK
    if more > small:
        yield Ground(
            "closure",
            NONE if more > large else DOUBTFUL,
            f"the fitted valve leaves {e.orifice_mm2:.0f} mm² free, the observed one "
            f"{e.observed_orifice_mm2:.0f} mm²",
            "chordae too short, leaflets too small, or tips too far: check them",
        )


def _repeated(e: Indications) -> Seen:
    if e.again is None:
        yield None
    elif not e.again:
        yield Ground(
            "closed anew",
            DOUBTFUL,
            "the fitted valve, closed anew from the open one, ends in another closed state",
            "ask the gate of this valve (check=true gate=true)",
        )


def _unique(e: Indications) -> Seen:
    if e.gate is None:
        yield None
    elif not e.gate:
        yield Ground(
            ONE_STATE,
            DOUBTFUL,
            "the valve did not pass the gate: its closed state is not the only one, or jumps while "
            "moduli change",
            "the gate says by what (experiment=gate, check=true gate=true); a finer mesh or denser "
            "contact samples may mend it",
        )


CHECKS = {
    "iterations": _ended,
    "approximation": _approximated,
    "geometry": _linear,
    "law": _stiffens,
    "case": _plausible,
    "errors left out": _accounted,
    "size of what is left over": _innovation,
    "pattern of what is left over": _structure,
    "what was known beforehand": _stretched,
    "data against prior": _contradicts,
    "frames held out": _predicts,
    "closure": _closes,
    "closed anew": _repeated,
    ONE_STATE: _unique,
}
"""Check -> what it looks at."""

NEEDED = (
    "size of what is left over",
    "what was known beforehand",
)
"""Checks without which no estimate is trustworthy."""
