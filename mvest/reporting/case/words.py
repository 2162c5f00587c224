"""Sentences and tables of one case's page, computed from its findings.

What findings do not have becomes a sentence that says so; nothing is put in its place.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mvest.problem.verdict import DOUBTFUL, NONE, ONE_STATE, TRUSTWORTHY
from mvest.reporting.case.findings import (
    CaseFindings,
    ErrorRow,
    GeometryRow,
    ModulusRow,
    Narrower,
    UnknownRow,
    WhitenessTest,
)
from mvest.reporting.case.information import columns_of
from mvest.reporting.expectation import alike_words
from mvest.reporting.findings import Innovation, Spread
from mvest.reporting.markup import MISSING, ended, number

__all__ = ["answer", "badges", "confirmation", "distance_rows", "distance_words", "error_rows",
           "frame_rows", "geometry_rows", "identifiability_words", "image_error_words",
           "innovation_words", "law_words", "leaflet_names", "measurement_rows", "moduli_rows",
           "narrow_words", "parameter_rows", "percent", "provenance_note",
           "setting_rows", "verdict_words", "whiteness_rows"]  # fmt: skip

Rows = list[dict[str, str]]

VERDICT_BADGES = {TRUSTWORTHY: "TRUSTWORTHY", DOUBTFUL: "DOUBTFUL", NONE: "NOT TO BE BELIEVED"}

UNASKED = "the gate was not asked; check=true gate=true asks it"

MODULUS_NAMES = {
    "E_f": "stiffness along the fibres, E_f",
    "E_perp": "stiffness across the fibres, E_perp",
    "G": "shear stiffness, G",
}
MODULUS_UNIT = "MPa"
HASH_DIGITS = 12
NO_BREAK = "\N{NO-BREAK SPACE}"
WHICH = ("observed", "generic", "personalised")
UNITS = {"mm": "mm", "mm2": "mm²", "mm3": "mm³", "deg": "°", "ratio": ""}

OF_FRAMES = {
    "frame": ("frame", 0),
    "time_s": ("time [s]", 3),
    "confidence": ("confidence", 2),
    "annulus_area_mm2": ("annulus area [mm²]", 0),
    "orifice_mm2": ("orifice [mm²]", 0),
    "coaptation_area_mm2": ("coaptation [mm²]", 0),
}
"""Measure -> its column and digits."""


def leaflet_names(case: CaseFindings, regions: int) -> list[str]:
    """Names of the leaflets in the order of their regions; numbers where they are not known."""
    names = list(case.about.regions)
    return names if len(names) == regions else [f"leaflet {k + 1}" for k in range(regions)]


def answer(case: CaseFindings) -> str:
    """The result in one sentence; of what is not to be believed there is no number."""
    verdict = case.verdict
    if verdict is not None and verdict.trust == NONE:
        return ended(f"No stiffness can be stated: {verdict.grounds[0].text}")
    if not case.moduli:
        return f"No stiffness was estimated: {case.reason or 'the run gives no reason'}."
    fibre = [m for m in case.moduli if m.name == "E_f"] or case.moduli
    numbers = "; ".join(f"{m.name} {m.region} {_interval(m)}" for m in fibre)
    if verdict is not None and verdict.trust == DOUBTFUL:
        return f"Doubtful, since {verdict.grounds[0].text}: {numbers}."
    return f"{numbers}."


def verdict_words(case: CaseFindings) -> tuple[str, list[str], list[str]]:
    """The verdict, what speaks against the estimate with what to do next, and what was not seen."""
    verdict = case.verdict
    if verdict is None:
        return "The run did not judge its estimate.", [], []
    count = len(verdict.passed)
    heads = {
        TRUSTWORTHY: f"Trustworthy: all {count} checks were passed.",
        DOUBTFUL: f"Doubtful: {count} checks were passed, and these were not.",
        NONE: "No stiffness is to be taken from this run.",
    }
    against = [
        ended(ground.text[:1].upper() + ground.text[1:])
        + (f" Next: {ended(ground.advice)}" if ground.advice else "")
        for ground in verdict.grounds
    ]
    unseen = [f"{name} ({UNASKED})" if name == ONE_STATE else name for name in verdict.missing]
    return heads[verdict.trust], against, unseen


def _interval(modulus: ModulusRow) -> str:
    """``5.8 MPa (95 % interval 4.1 to 8.2)``."""
    low, high = number(modulus.low, 2), number(modulus.high, 2)
    return (
        f"{number(modulus.estimate, 2)}{NO_BREAK}{MODULUS_UNIT} "
        f"(95{NO_BREAK}% interval {low} to {high})"
    )


def badges(case: CaseFindings) -> list[str]:
    """Short warnings beside the title."""
    about = case.about
    labels = ["SIMULATED"] if about.simulated else []
    stated = " ".join((about.name, about.description, about.source)).lower()
    if "tricuspid" in stated:
        labels.append("DONOR TRICUSPID" if "donor" in stated else "TRICUSPID")
    if not case.converged:
        labels.append(f"RUN {case.status.upper()}")
    if case.verdict is not None:
        labels.append(VERDICT_BADGES[case.verdict.trust])
    return [*labels, "NOT FOR DIAGNOSIS"]


def confirmation(case: CaseFindings) -> str | None:
    """Whether the closed state is also reached from the open valve; None if that was not tried."""
    if case.confirmed_mm is None:
        return None
    return f"closed anew from the open valve it differs by at most {case.confirmed_mm:.2g} mm"


def percent(share: float) -> str:
    """A share as ``38 %`` that no line breaks."""
    return f"{100 * share:.0f}{NO_BREAK}%"


def moduli_rows(case: CaseFindings) -> Rows:
    """Each modulus with its interval, and the truth if it is known."""
    known = any(m.truth is not None for m in case.moduli)
    rows = []
    for m in case.moduli:
        row = {
            "leaflet": m.region,
            "modulus": MODULUS_NAMES.get(m.name, m.name),
            f"estimate [{MODULUS_UNIT}]": number(m.estimate),
            "95 % interval": _range(m),
        }
        if known:
            row["truth"] = number(m.truth)
            row["truth within the interval"] = _holds(m)
        rows.append(row)
    return rows


def parameter_rows(case: CaseFindings) -> Rows:
    """Each unknown as it was believed beforehand and estimated, with and without nuisances."""
    alone = case.without_nuisances
    without = {} if alone is None else {p.name: p for p in alone.parameters}
    known = any(p.truth is not None for p in case.unknowns)
    rows = []
    for p in case.unknowns:
        row = {
            "parameter": p.label,
            "unit": p.unit or MISSING,
            "treated as": f"{p.kind}, {p.treatment}",
            "beforehand": _with_std(p.prior_mean, p.prior_std),
            "estimate": _with_std(p.estimate, p.std),
            "95 % interval": _range(p),
        }
        if without:
            other = without.get(p.name)
            row["nuisances taken as known"] = (
                MISSING if other is None else _with_std(other.estimate, other.std)
            )
            row["its 95 % interval"] = MISSING if other is None else _range(other)
        if known:
            row["truth"] = number(p.truth)
        rows.append(row)
    return rows


def _with_std(value: float | None, std: float | None) -> str:
    text = number(value)
    return text if value is None or std is None else f"{text} ± {number(std, 2)}"


def _range(entry: ModulusRow | UnknownRow) -> str:
    if entry.low is None or entry.high is None:
        return MISSING
    return f"{number(entry.low)} to {number(entry.high)}"


def _holds(modulus: ModulusRow) -> str:
    if modulus.truth is None:
        return MISSING
    return "yes" if modulus.low <= modulus.truth <= modulus.high else "NO"


def distance_rows(case: CaseFindings) -> Rows:
    """Mean ± SD and largest distance of each model in each frame."""
    known = any(d.to_truth for d in case.distances)
    rows = []
    for d in case.distances:
        row = {
            "frame": d.frame,
            "shown to the filter": "yes" if d.seen else "no",
            "generic [mm]": _spread(d.generic),
            "generic, moved rigidly [mm]": _spread(d.registered),
            "personalised [mm]": _spread(d.personalised),
        }
        if known:
            row["personalised to the truth [mm]"] = (
                _spread(d.to_truth.personalised) if d.to_truth else MISSING
            )
        rows.append(row)
    return rows


def _spread(entry: Spread) -> str:
    return f"{entry}, largest {entry.max:.2f}"


def distance_words(case: CaseFindings) -> str:
    """Whether personalising brought frames nearer that the filter was not shown."""
    parts = []
    for d in case.distances:
        if d.seen:
            continue
        before, after = d.generic.mean, d.personalised.mean
        verdict = "nearer than" if after < before else "NOT nearer than"
        parts.append(
            f"{d.frame}: the personalised valve is {after:.2f} mm away on average, {verdict} "
            f"the generic one ({before:.2f} mm)"
        )
    if not parts:
        return (
            "No frame was held out, so nothing here says how the personalised valve predicts a "
            "closure that it was not fitted to."
        )
    return "In frames that the filter was not shown: " + "; ".join(parts) + "."


def identifiability_words(case: CaseFindings) -> list[str]:
    """What the data alone could tell, in sentences."""
    data = case.identifiability
    if data is None:
        return []
    labels = {p.name: p.label for p in case.unknowns}
    words = []
    if data.condition_number is not None:
        words.append(
            f"Condition number of the information matrix: {number(data.condition_number)} "
            "(1: all parameters are told apart equally well)."
        )
    if data.flat:
        words.append(
            "The data alone do not determine: "
            + ", ".join(labels.get(name, name) for name in data.flat)
            + ". What is said of them rests on what was believed beforehand."
        )
    words += [alike_words(group, labels) for group in data.confounded]
    columns = columns_of(case.unknowns, len(data.cramer_rao_std))
    if columns:
        bounds = ", ".join(
            f"{p.label} {number(s, 2)} {p.unit}".rstrip()
            for p, s in zip(columns, data.cramer_rao_std, strict=True)
        )
        words.append(f"Smallest standard deviations that the data alone allow: {bounds}.")
    return words


def innovation_words(innovation: Innovation | None) -> list[str]:
    """What the innovation says, in sentences."""
    if innovation is None:
        return []
    size, nis, (low, high) = innovation.size, innovation.nis, innovation.nis_band
    # About 1 if all is as assumed.
    over_expected = number(math.sqrt(nis / size)) if size else MISSING
    return [
        f"Root mean square of the {_large(size)} innovations (observed less what the prior "
        f"predicts, linearised at the estimate): {number(innovation.rms)} mm, of the residuals "
        f"(observed less fitted) {number(innovation.residual_rms)} mm; innovations over "
        f"what is expected of each where model and noise are as assumed: {over_expected}.",
        f"Normalised innovation squared {_large(nis)}, "
        f"{'inside' if low <= nis <= high else 'OUTSIDE'} its 95 % band {_large(low)} to "
        f"{_large(high)}.",
    ]


def error_rows(errors: Sequence[ErrorRow]) -> Rows:
    """What was learned of the errors of the frame, beside what was believed."""
    return [
        {
            "errors of the closed frame": f"{row.name} [{row.unit}]" if row.unit else row.name,
            "believed": number(row.believed),
            "95 %": f"{number(row.believed_low)} to {number(row.believed_high)}",
            "learned": number(row.learned),
            "its 95 % interval": f"{number(row.low)} to {number(row.high)}",
        }
        for row in errors
    ]


def geometry_rows(geometry: Sequence[GeometryRow]) -> Rows:
    """By how much the geometry is expected to differ from what was seen."""
    return [
        {
            "geometry": row.name,
            "expected off by": f"{number(row.size)} {row.unit}",
            "most, in standard deviations": number(row.stretch),
        }
        for row in geometry
    ]


def law_words(share: float | None) -> str:
    """How far the tissue is on its way to another law; empty where that was not considered."""
    if share is None:
        return ""
    return (
        "Of the way from the linear law (0) to an exponential one (1), what was seen puts the "
        f"tissue at {share:.2f}."
    )


def iterate_rows(case: CaseFindings) -> Rows:
    """One row for each unknown, one column for each step of the filter; last its objective."""
    if not case.iterates:
        return []
    width = len(case.iterates[0])
    columns = [
        p.label + (f" [{p.unit}]" if p.unit else "") for p in columns_of(case.unknowns, width)
    ]
    labels = columns or [f"value {k + 1}" for k in range(width)]
    steps = ["start", *map(str, range(1, len(case.iterates)))]
    rows = [
        {"unknown": label} | {s: number(m[k]) for s, m in zip(steps, case.iterates, strict=True)}
        for k, label in enumerate(labels)
    ]
    objective = dict(zip(steps, map(number, case.objective), strict=False))
    return (
        [*rows, {"unknown": "misfit plus departure from the prior"} | objective]
        if objective
        else rows
    )


def iterate_words(case: CaseFindings) -> str:
    """What the steps of the filter do not show, and why."""
    if not case.iterates:
        return f"Here the run kept no iterates; it ended before a step was taken: {case.reason}."
    shown = columns_of(case.unknowns, len(case.iterates[0]))
    if not shown:
        return (
            f"The run kept {len(case.iterates[0])} values a step and has {len(case.unknowns)} "
            "unknowns; which value is whose it does not say."
        )
    names = {p.name for p in shown}
    left = [p.label for p in case.unknowns if p.name not in names and p.treatment != "fixed"]
    if not left:
        return ""
    return (
        f"Without steps: {', '.join(left)}. They widen the intervals and keep their "
        "values, so they have no steps."
        if all(p.treatment == "considered" for p in case.unknowns if p.label in left)
        else f"Without steps: {', '.join(left)}. The run kept the steps of the others alone."
    )


def whiteness_rows(tests: Sequence[WhitenessTest]) -> Rows:
    """The tests of the innovation."""
    return [
        {
            "test": test.name,
            "statistic": number(test.statistic),
            "p-value": number(test.p_value, 2),
            "verdict": test.verdict,
        }
        for test in tests
    ]


def narrow_words(narrow: Sequence[Narrower]) -> str:
    """Which knowledge would narrow an interval most."""
    best = min(narrow, key=lambda r: r.std_if_known / r.std_now)
    share = 1 - best.std_if_known / best.std_now
    if share < 0.01:
        return "Measuring any one of these would narrow the interval by less than 1 %."
    return (
        f"Most would be gained here: {best.what}. The standard deviation would fall by "
        f"{percent(share)}, from {number(best.std_now)} to {number(best.std_if_known)}."
    )


def measurement_rows(case: CaseFindings) -> Rows:
    """One row for each measurement, one column for each frame and shape."""
    columns = [
        (frame, which, values[which])
        for frame, values in case.measurements.items()
        for which in (*WHICH, *(w for w in values if w not in WHICH))
        if values.get(which)
    ]
    names = dict.fromkeys(name for _, _, values in columns for name in values)
    return [
        {"measurement": _measurement_label(name)}
        | {f"{frame}, {which}": _large(values.get(name)) for frame, which, values in columns}
        for name in names
    ]


def _large(value: float | None) -> str:
    """A number whose thousands are written out."""
    whole = value is not None and 1e4 <= abs(value) < 1e7
    return f"{value:.0f}" if whole else number(value)


def _measurement_label(name: str) -> str:
    """``annulus_area_mm2`` as ``annulus area [mm²]``."""
    words, _, unit = name.rpartition("_")
    if unit not in UNITS or not words:
        return name.replace("_", " ")
    text = re.sub(r"\bap\b", "AP", words.replace("_", " "))
    return f"{text} [{UNITS[unit]}]" if UNITS[unit] else text


def frame_rows(frames: Sequence[Mapping[str, Any]]) -> Rows:
    """Table of the frames of a sequence; a dash for what could not be measured."""
    return [
        {
            column: MISSING if row.get(name) is None else f"{row[name]:.{digits}f}"
            for name, (column, digits) in OF_FRAMES.items()
            if name in row
        }
        for row in frames
    ]


def image_error_words(case: CaseFindings) -> list[str]:
    """What errors of the frames do to the intervals; empty where nothing is known of them."""
    errors = case.image_errors
    if errors is None:
        return []
    out = [
        f"The closed valve was moved as {errors.samples} samples of the errors of its images say: "
        "of the open shape, annulus, tips and chordae as well as of the closed frame."
    ]
    labels = {row.name: row.label for row in case.unknowns}
    for name, share in (errors.share_of_variance or {}).items():
        out.append(f"Of the variance of {labels.get(name, name)} they make {percent(share)}.")
    return out


def setting_rows(settings: Mapping[str, Any]) -> Rows:
    """Nested settings as rows of dotted names; lists stay in one cell."""
    return [{"setting": name, "value": text} for name, text in _walk(settings, "")]


def _walk(value: Any, name: str) -> Iterator[tuple[str, str]]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _walk(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, Sequence) and not isinstance(value, str):
        yield name, "[" + ", ".join(text for v in value for _, text in _walk(v, "")) + "]"
    else:
        yield name, MISSING if value is None else str(value)


def provenance_note(case: CaseFindings, line: str) -> str:
    """The case, and where its findings came from, in one line for the foot of each picture."""
    about = case.about
    parts = [
        case.title,
        "simulated" if about.simulated else "",
        f"case {about.sha256[:HASH_DIGITS]}" if about.sha256 else "",
        line,
    ]
    return ", ".join(filter(None, parts))
