"""The study of designs as tables: what each observation would tell, and what it would need."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

import numpy as np
import pandas as pd

from experiments.common.cases.skill import GENERIC, PRIOR, PRIOR_STD
from experiments.common.records.record import Record
from experiments.common.records.report import page
from experiments.studies.identifiability.figures import identifiability_figures
from experiments.studies.identifiability.findings import Findings, Profile
from mvest.files import write_atomically
from mvest.reporting.expectation import alike_words
from mvest.reporting.figures import save_figure_with
from mvest.reporting.markup import MISSING, latex_rows, markdown_rows, number

__all__ = ["identifiability_table", "identifiability_words", "write_identifiability"]

Rows = list[dict[str, str]]

OPEN = "open"


def identifiability_table(findings: Findings) -> pd.DataFrame:
    """One row for each design, knowledge of the nuisances, and modulus."""
    settings = findings.settings
    target, typical = f"{100 * settings.target:g} %", f"{settings.typical_mm:g} mm"
    return pd.DataFrame(
        {
            "frames": design.frames,
            "number of frames": design.frame_count,
            "vertices": design.vertices_words,
            "number of vertices": design.points,
            "errors": design.errors,
            "knowledge of the nuisances": one.knowledge,
            "parameter": one.parameter,
            **{
                f"std at {noise} mm [%]": None if std is None else 100 * std
                for noise, std in one.std.items()
            },
            f"noise for {target} [mm]": one.needed_noise_mm,
            f"observations of {typical} for {target}": one.needed_repeats,
        }
        for design in findings.designs
        for one in design.moduli
    )


def _design_rows(findings: Findings) -> Rows:
    """One row for each design, one column for each knowledge: deviations and the needed noise."""
    typical = f"{findings.settings.typical_mm:g}"
    shown = []
    for design in findings.designs:
        row = {
            "vertices": f"{design.vertices_words} ({design.points})",
            "errors": design.errors,
            "frames": design.frames,
        }
        for knowledge, group in groupby(design.moduli, key=lambda one: one.knowledge):
            moduli = list(group)
            stds = " / ".join(_percent(one.std[typical]) for one in moduli)
            needed = min(_or_any(one.needed_noise_mm) for one in moduli)
            row[knowledge] = f"{stds} ({_noise(needed)})"
        shown.append(row)
    if shown:
        # Nothing is seen: what is believed of a modulus, and so how far a guess for all is off.
        names = {one.parameter for one in findings.designs[0].moduli}
        guess = " / ".join([_percent(PRIOR_STD)] * len(names))
        known = dict.fromkeys(findings.settings.knowledge, guess)
        row = dict.fromkeys(shown[0], MISSING) | {"vertices": f"none: {GENERIC}, {PRIOR}"}
        shown.append(row | known)
    return shown


def _percent(std: float | None) -> str:
    return MISSING if std is None else number(100 * std, 2)


def _or_any(noise: float | None) -> float:
    return np.inf if noise is None else noise


def _noise(value: float) -> str:
    if np.isinf(value):
        return "any"
    return "no noise" if value == 0.0 else number(value, 2)


def _profile_rows(findings: Findings) -> Rows:
    return [
        {
            "observed": one.label,
            "parameter": one.parameter,
            "95 % interval": f"{_end(one.low)} to {_end(one.high)}",
            "followed from": f"{number(one.path[0][one.at], 4)} to "
            f"{number(one.path[-1][one.at], 4)}",
            "identifiable": "yes" if None not in (one.low, one.high) else "NO: " + _why_open(one),
        }
        for one in findings.profiles
    ]


def _end(value: float | None) -> str:
    return OPEN if value is None else number(value, 4)


def _why_open(one: Profile) -> str:
    ends = zip((one.low, one.high), ("below", "above"), one.ends, strict=True)
    return "; ".join(f"{side}, {end}" for value, side, end in ends if value is None)


def _pressure_rows(findings: Findings) -> Rows:
    """How well the pressure must be known, with all vertices."""
    return [
        {"frames": design.frames, "errors": design.errors}
        | {name: _knowledge(needed) for name, needed in design.pressure.items()}
        for design in findings.designs
        if design.vertices == "all" and design.pressure
    ]


def _knowledge(needed: float | None) -> str:
    if needed is None:
        return "need not be known"
    return "not even if known exactly" if needed == 0.0 else f"to {100 * needed:.2g} %"


def _alike(findings: Findings) -> list[str]:
    """Sentences on what all vertices, with independent errors, hardly tell apart."""
    lines = []
    for design in findings.designs:
        if design.joint is None or design.errors != "independent":
            continue
        words = " ".join(alike_words(group) for group in design.joint.confounded)
        frames = f"{design.frames[0].upper()}{design.frames[1:]}"
        lines.append(f"* {frames}: {words or 'The data tell all parameters apart.'}")
    return lines


def _readable(record: Record[Findings]) -> list[str]:
    findings = record.findings
    settings = findings.settings
    target, typical = f"{100 * settings.target:g} %", f"{settings.typical_mm:g} mm"
    moduli = [name for name in record.parameters if name.startswith("E_f.")]
    assumed = ", ".join(
        f"{name} {number(value)}"
        for name, value in zip(record.parameters, findings.assumed, strict=True)
    )
    lines = [
        f"Cramér-Rao bounds at the assumed values ({assumed}), from one run of the model "
        f"for each set of frames. Each cell: relative standard deviation of "
        f"{' / '.join(moduli)} [%] at {typical} of noise in each coordinate, and in parentheses "
        f"the noise [mm] at which the worse of them would be known to {target} (“no noise”: not "
        f"even without noise). {_known_words(settings.knowledge)} The open frame is the model's "
        f"shape at rest, which no parameter changes, so it adds nothing. N independent "
        f"observations averaged have the noise divided by √N. Simulated.",
        "",
        markdown_rows(_design_rows(findings)),
        "",
        "## What makes up for what",
        "",
        f"All vertices, independent errors of {typical}, "
        f"{_listed_known(settings.known)}, nothing known of the other nuisances:",
        "",
        *_alike(findings),
        "",
    ]
    pressures = _pressure_rows(findings)
    if pressures:
        lines += [
            "## How well the pressure must be known",
            "",
            f"Relative standard deviation of the pressure beforehand with which a modulus is known "
            f"to {target} ({typical}, all vertices; rest length and chordal stiffness as in “"
            f"{settings.believed}”):",
            "",
            markdown_rows(pressures),
            "",
        ]
    profiles = _profile_rows(findings)
    if profiles:
        lines += [
            "## How far the valleys go",
            "",
            f"Profile likelihoods of the noise-free observation, weighed as if with independent "
            f"errors of {typical}, {_listed_known(settings.known)}. An interval is open where the "
            f"profile does not reach the threshold as far as it was followed.",
            "",
            markdown_rows(profiles),
        ]
    return lines


def _known_words(knowledge: Mapping[str, Mapping[str, float]]) -> str:
    half = {
        words: [f"{name} to {100 * std:g} %" for name, std in stds.items() if std > 0]
        for words, stds in knowledge.items()
    }
    said = [f"“{words}”: {', '.join(known)}" for words, known in half.items() if known]
    return "; ".join(said) + "." if said else ""


def _listed_known(known: Sequence[str]) -> str:
    return f"{', '.join(known)} known" if known else "nothing known beforehand"


def identifiability_words(record: Record[Findings]) -> str:
    """The tables for the terminal."""
    if not record.findings.designs:
        return f"{record.title}: {record.reason}"
    rows = _design_rows(record.findings), _profile_rows(record.findings)
    return "\n\n".join(pd.DataFrame(some).to_string(index=False) for some in rows)


def write_identifiability(
    folder: Path, records: Mapping[str, Record[Findings]], _arrays: Mapping[str, Path]
) -> list[Path]:
    """Tables and figures of each record; none of a failed run.

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    written = []
    for record in records.values():
        if not record.findings.designs:
            continue
        base, line = folder / record.experiment, record.line
        words = "\n".join(_readable(record))
        csv = identifiability_table(record.findings).to_csv(index=False)
        tex = latex_rows(_design_rows(record.findings))
        written += [
            write_atomically(base.with_suffix(".csv"), f"# {line}\n{csv}"),
            write_atomically(base.with_suffix(".md"), page(record, words)),
            write_atomically(base.with_suffix(".tex"), f"% {line}\n{tex}"),
        ]
        for name, figure in identifiability_figures(record).items():
            written += save_figure_with(base.with_name(f"{base.name}_{name}"), figure, line)
    return written
