"""Moduli that follow from simulated volumes, beside the truth and those from known geometry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

import numpy as np
import pandas as pd
from scipy.stats import linregress, sem

from experiments.common.cases.report import interval_words
from experiments.common.cases.skill import baselines, skill_words
from experiments.common.records.tables import write_table
from experiments.studies.imaged_patient.findings import Row
from mvest.cases.chord_layout import SEEN_CLOSURE
from mvest.errors import InputError
from mvest.problem.verdict import NONE
from mvest.reporting.markup import MISSING, number

__all__ = ["chord_words", "volume_table", "volume_words", "write_volume_tables"]

TRUTH_OF_MODULI: Final = (
    "Moduli estimated from simulated transoesophageal echo (TEE) volumes of simulated valves. The "
    "truth is the modulus with which the valve was simulated; the known geometry is that valve's "
    "own midsurface in every frame, in place of what the image step detected; a perfect "
    "segmentation is that with the error of a voxel of the volume. Errors have a sign: "
    "that from known geometry and the part from the images add up to the whole. Nothing here was "
    "measured in patients."
)


ERRORS: Final = {
    "from the volume": "error [%]",
    "from a perfect segmentation": "error from a perfect segmentation [%]",
    "from the known geometry": "error from known geometry [%]",
    "part from the images": "part from the images [%]",
}
"""What sentences call the columns of errors."""

OF_VOLUMES: Final = ("error [%]", "part from the images [%]")
"""Those that do not count where the verdict is that there is no estimate."""


def volume_table(rows: Sequence[Row]) -> pd.DataFrame:
    """One row for each patient and modulus E_f estimated from a volume, MPa and %.

    Raises
    ------
    InputError
        No rows, or a truth that is not positive.
    """
    if not rows:
        raise InputError("moduli from volumes: no rows, expected at least one")
    moduli = pd.DataFrame([asdict(row.modulus) for row in rows])
    numbers = moduli[["truth", "estimate", "low", "high"]].astype(float)
    truth = numbers["truth"]
    if not (truth > 0).all():
        raise InputError(f"moduli from volumes: truth {truth.min()} MPa, expected > 0")
    error = 100.0 * (numbers["estimate"] - truth) / truth
    known, segmented = (
        100.0 * (np.array(values, dtype=float) - truth) / truth
        for values in zip(*((row.known_geometry, row.segmented) for row in rows), strict=True)
    )
    return pd.DataFrame(
        {
            "patient": [row.patient for row in rows],
            "modulus": [row.modulus.leaflet for row in rows],
            "truth [MPa]": truth,
            "estimate [MPa]": numbers["estimate"],
            "95 % low [MPa]": numbers["low"],
            "95 % high [MPa]": numbers["high"],
            "inside": pd.Series([row.modulus.inside for row in rows], dtype=object),
            "verdict": [row.verdict for row in rows],
            "error of the generic guess [%]": 100.0 * (moduli["prior_mean"] - truth) / truth,
            "error [%]": error,
            "error from a perfect segmentation [%]": segmented,
            "error from known geometry [%]": known,
            "part from the images [%]": error - known,
        }
    )


def volume_words(table: pd.DataFrame) -> list[str]:
    """What a table of `volume_table` says, in numbers; what the verdict denies does not count."""
    denied = table["verdict"] == NONE
    known = table[table["inside"].notna() & ~denied]
    inside = int(known["inside"].astype(bool).sum())
    out = [f"The 95 % interval contains the truth for {inside} of {len(known)} moduli."]
    lost = int((table["estimate [MPa]"].isna() & ~denied).sum())
    if lost:
        out.append(f"For {lost} of {len(table)} moduli there is no estimate.")
    if denied.any():
        held = table.loc[denied & table["inside"].notna(), "inside"].astype(bool)
        words = f"For {int(denied.sum())} of {len(table)} the verdict is that there is no "
        words += "estimate; they are not counted."
        if len(held):
            words += f" (Of the {len(held)} intervals that they ended with {int(held.sum())} "
            words += "contain the truth.)"
        out.append(words)
    counted = table.assign(**{column: table[column].where(~denied) for column in OF_VOLUMES})
    medians = _medians(counted)
    if medians:
        out.append(f"Median size of the error: {medians}.")
    for leaflet, own in counted.groupby("modulus", sort=False):
        stated = own[own["error [%]"].notna()]
        if stated.empty:
            continue
        guess = stated["error of the generic guess [%]"].abs().median()
        ratio = stated["error [%]"].abs().median() / guess
        out.append(
            f"{str(leaflet).capitalize()}: {_medians(own)}; {ratio:.2f} of the generic guess's "
            f"{guess:.1f} % for the same patients; {int(stated['inside'].eq(True).sum())} of "
            f"{len(stated)} inside."
        )
    out += _followed(table)
    judged = table[table["verdict"] != ""]
    if len(judged):
        trusts = ", ".join(
            f"{trust} {len(own)} ({int(own['inside'].eq(True).sum())} inside)"
            for trust, own in judged.groupby("verdict")
        )
        out.append(f"Verdicts: {trusts}.")
    width = (known["95 % high [MPa]"] - known["95 % low [MPa]"]) / known["estimate [MPa]"]
    if len(known):
        out.append(f"Width of the interval over the estimate: median {width.median():.2f}.")
    return out


def _followed(table: pd.DataFrame) -> Iterator[str]:
    """Mean error of each modulus' logarithm, and how far estimates follow the truth.

    Of all that converged, also of those that the verdict denies: it does not see the truth.
    """
    for leaflet, own in table.groupby("modulus", sort=False):
        known = own[own["error [%]"].notna()]
        truth, found = (np.log(known[name]) for name in ("truth [MPa]", "estimate [MPa]"))
        if len(known) < 3 or truth.nunique() < 2:
            continue
        logs = {
            words: np.log1p(own[column].dropna().to_numpy() / 100.0)
            for words, column in ERRORS.items()
            if column != ERRORS["part from the images"]
        }
        biases = ", ".join(
            f"{words} {each.mean():+.2f} ({sem(each):.2f})"
            for words, each in logs.items()
            if len(each) > 1
        )
        line = linregress(truth, found)
        yield (
            f"{str(leaflet).capitalize()}, all estimates, mean error of the logarithm (standard "
            f"error): {biases}. From the volume the logarithm follows {line.slope:.2f} "
            f"({line.stderr:.2f}) of the truth's."
        )


def _medians(table: pd.DataFrame) -> str:
    """Median sizes of the errors that there are, in words."""
    sizes = {words: table[column].abs().median() for words, column in ERRORS.items()}
    return ", ".join(f"{words} {v:.1f} %" for words, v in sizes.items() if np.isfinite(v))


def chord_words(ratios: Sequence[Mapping[str, Sequence[float]]]) -> str:
    """How long the chordae of all patients are, each family -> as `Findings.chord_ratios`.

    Empty where no patient has them.
    """
    known = [one for one in ratios if one]
    if not known:
        return ""
    said = []
    for family in known[0]:
        each = [np.asarray(one[family]) for one in known]
        among = f", of a patient's mean {np.std([e.mean() for e in each], ddof=1):.3f}"
        said.append(
            f"{np.mean(np.concatenate(each)):.3f} ({family}; SD "
            f"{np.std(np.concatenate(each), ddof=1):.3f}{among if len(known) > 1 else ''})"
        )
    slack = {"marginal": SEEN_CLOSURE.marginal_slack, "basal": SEEN_CLOSURE.basal_slack}
    laid_out = " and ".join(f"{slack[family]:g}" for family in known[0])
    return (
        f"Chordae of {len(known)} patients, true rest length over the distance of their ends in "
        f"the closed valve: {', '.join(said)}; laid out by {laid_out}."
    )


def write_volume_tables(
    base: Path,
    rows: Sequence[Row],
    line: str,
    chord_ratios: Sequence[Mapping[str, Sequence[float]]] = (),
) -> list[Path]:
    """The table ``base`` of rows as for `volume_table`; ``line`` says where they came from.

    Chord ratios are those of each patient, as for `chord_words`.

    Raises
    ------
    InputError
        As `volume_table`, or a file that cannot be written.
    """
    table = volume_table(rows)
    readable = [
        {
            "patient (simulated)": row.patient.replace("_", " "),
            "modulus": row.modulus.leaflet,
            "truth [MPa]": number(row.modulus.truth),
            "estimate, 95 % [MPa]": interval_words(row.as_stated),
            "verdict": row.verdict or MISSING,
            **{
                str(name): MISSING if pd.isna(value) else f"{value:+.1f}"
                for name, value in errors.items()
            },
        }
        for row, (_, errors) in zip(rows, table[table.columns[-4:]].iterrows(), strict=True)
    ]
    moduli = [row.modulus for row in rows]
    readable += [
        dict.fromkeys(readable[0], MISSING)
        | {
            "patient (simulated)": one.what,
            "modulus": one.row.leaflet,
            "estimate, 95 % [MPa]": one.words,
        }
        for one in baselines(moduli)
    ]
    stated = [row.as_stated for row in rows]
    notes = [TRUTH_OF_MODULI, skill_words(stated), *volume_words(table)]
    notes += filter(None, [chord_words(chord_ratios)])
    return write_table(base, table, readable, line, notes)
