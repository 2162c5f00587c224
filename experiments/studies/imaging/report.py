"""The study of the image step in tables, figures and words."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.common.records.record import Record
from experiments.common.records.tables import write_table
from experiments.studies.imaging.findings import Accuracy, Confidences, Evaluation, Findings
from experiments.studies.imaging.tables import imaging_table, imaging_words, write_imaging_table
from mvest.imaging.layout import ValveLayout
from mvest.imaging.learning.accuracy import unlike_share
from mvest.reporting.figures import save_figure_with
from mvest.reporting.images.figures import (
    LIMITS_MM,
    SETTINGS,
    distance_figure,
    std_figure,
    training_figure,
)
from mvest.reporting.markup import MISSING, number
from mvest.reporting.style import COLOURS, GREY, MARKERS, SMALL, headline, panels

__all__ = [
    "confidence_figure",
    "correlation_figure",
    "imaging_answer",
    "imaging_text",
    "study_words",
    "write_imaging",
]

CALLED: Final = {
    "called_percent": "called a valve [%]",
    "wrongly_percent": "wrongly called so [%]",
}
"""Columns of the table of confidences."""

_PARTS: Final = {
    "valves": "for valves",
    "volumes": "for volumes and their samples",
    "draft": "for the draft whose mistakes are learned",
    "trees": "for trees",
}

NO_VALVE: Final = ("walls only", "no tissue", "white noise")
"""Kinds of volumes in which there is no valve."""

SEQUENCES: Final = {
    "calibration": "over time, in distribution, other valves",
    "sequence": "over time, in distribution",
    "shifted sequence": "over time, shifted",
    "wide calibration": "over time, in part shifted, other valves",
}
"""What volumes over time are called here."""

OVER_TIME: Final = (
    "Simulated transoesophageal echo (TEE) volumes over time, of simulated valves that no training "
    "saw, as the image step hands them on (joined and smoothed in time). Means over the frames of "
    "each volume; errors without sign. Nothing here was measured in patients."
)
WITHOUT: Final = (
    "How sure the detectors are of a valve in simulated volumes, with and without one. Walls only: "
    "leaflets, annulus and chordae send no echo; no tissue: nothing does; a volume over time "
    "counts with its best frame. Wrongly: there is none, or what was detected is not it. Nothing "
    "here was measured in patients."
)


def study_words(findings: Findings) -> list[str]:
    """What the study says in numbers, sentence by sentence."""
    spent, tested = findings.spent, findings.tested
    parts = [
        f"{cpu_s:.0f} s {words}"
        for part, words in _PARTS.items()
        if (cpu_s := spent[part].cpu_s) is not None
    ]
    total = spent["training"].cpu_s
    said = [
        f"Trained on {findings.training_volumes} volumes of "
        f"{findings.valves['train'].count} simulated valves"
        + ("; CPU time " + ", ".join(parts) if parts else "")
        + (f"; {total / 60.0:.1f} minutes in all." if total is not None else ".")
    ]
    if tested is None:
        return [*said, "Not tested."]
    known = [row.state_right for row in tested.rows if row.state_right is not None]
    if known:
        said.append(
            f"Whether the orifice is open is right in {sum(known)} of {len(known)} volumes."
        )
    accuracy, confidence = tested.accuracy, tested.confidence
    said.append(
        f"Errors that the detectors state, from {accuracy.sequences} volumes over time of other "
        f"valves: median standard deviation of a coordinate {accuracy.median_std_mm:.2f} mm, "
        f"alike over {accuracy.correlation_length_mm:.1f} mm, mean error "
        f"{accuracy.mean_error_mm:.2f} mm. Left out, as the valve was not detected or something "
        f"else was taken for it: {accuracy.left_out}."
    )
    start, slope = accuracy.widening
    said.append(
        f"In a volume they are stated {start:.2f} exp({slope:.2f} (1 - c)) times as large, c being "
        f"its confidence. Below a confidence of {accuracy.like_from:.2f} a volume is said to be "
        f"unlike those of training, and no moduli are stated; "
        f"{100 * unlike_share(accuracy.sequences):.2g} % of those drawn like them are expected "
        "there."
    )
    said += [
        f"Over time, {setting}: {count} of {among} volumes are unlike."
        for setting, (count, among) in accuracy.unlike.items()
    ]
    said += [*_trusted(tested, accuracy.like_from), *_lost(confidence)]
    said += [
        f"{row.setting.capitalize()}, {row.frame} frame: {100 * row.share:.0f} % of "
        f"coordinates lie within 1.96 of the standard deviations stated, of {row.sequences} "
        f"volumes; root mean square {row.rms_mm:.2f} mm, {row.stated_rms_mm:.2f} mm stated. "
        f"Handed on with a case, less the error expected of such a shape: "
        f"{100 * row.share_handed_on:.0f} %, {row.rms_handed_on_mm:.2f} mm, "
        f"{row.stated_handed_on_mm:.2f} mm stated."
        for row in accuracy.within_95
    ]
    said.append(
        f"Confidence without a valve: at most {confidence.highest_without_valve:.2f}; a valve is "
        f"called one from {confidence.min_confidence:g} on."
    )
    if confidence.lowest_right is not None:
        said.append(
            f"Where the valve was detected (points on average within {confidence.wrong_mm:g} mm): "
            f"at least {confidence.lowest_right:.2f}; where it was not, or where there is none: at "
            f"most {confidence.highest_wrong:.2f}; {confidence.best_threshold:.2f} would part "
            "these best."
        )
    return said


def _trusted(tested: Evaluation, like_from: float) -> Iterator[str]:
    """By setting: how many volumes of one frame are wrong, and how many of these are believed."""
    for setting in SETTINGS:
        own = [row for row in tested.rows if row.setting == setting]
        wrong = [row for row in own if (row.surface_mm or 0.0) >= LIMITS_MM[-1]]
        believed = [row for row in wrong if row.confidence >= like_from]
        if own:
            yield (
                f"{setting.capitalize()}, one frame: of {len(own)} volumes "
                f"{100 * (1 - len(wrong) / len(own)):.0f} % lie below {LIMITS_MM[-1]:g} mm or are "
                f"called none; {sum(row.confidence < like_from for row in own)} are unlike those "
                f"of training, and of the wrong ones {len(believed)} "
                f"({100 * len(believed) / len(own):.1f} %) are not said to be."
            )


def _lost(confidence: Confidences) -> Iterator[str]:
    """How many volumes over time are lost: not called a valve, or something else is."""
    for kind in SEQUENCES:
        values, off = confidence.values.get(kind, ()), confidence.off_mm.get(kind, ())
        lost = [
            value < confidence.min_confidence or far is None or far >= confidence.wrong_mm
            for value, far in zip(values, off, strict=True)
        ]
        if lost:
            yield f"Lost {_called(kind)}: {sum(lost)} of {len(lost)}."


def imaging_text(record: Record[Findings]) -> str:
    """What a finished study says on the terminal."""
    findings = record.findings
    lines = [f"{record.row}: {record.reason}"]
    if findings.tested is not None:
        table = imaging_table(findings.tested.rows)
        for _, row in table.iterrows():
            share = (
                f"valve detected in {row['valve detected [%]']:.0f} % of {row['volumes']} volumes"
            )
            if not row["valve detected [%]"] > 0:
                lines.append(f"  {row['setting']}: {share}")
                continue
            lines.append(
                f"  {row['setting']}: surface {row['surface mean [mm]']:.2f} mm on average, "
                f"{row['surface median [mm]']:.2f} median, {row['surface 90 % [mm]']:.2f} at 90 %; "
                f"{share}; {row['time per volume [s]']:.1f} s each"
            )
        lines += [f"  {line}" for line in imaging_words(table, findings.targets)]
    return "\n".join([*lines, *(f"  {line}" for line in study_words(findings))])


def imaging_answer(record: Record[Findings]) -> str:
    """How near detected leaflets are to true ones."""
    tested = record.findings.tested
    if tested is None:
        return "Trained, not tested."
    rows = [
        f"{row['surface median [mm]']:.2f} mm ({row['setting']}, "
        f"{row['valve detected [%]']:.0f} % detected)"
        for _, row in imaging_table(tested.rows).iterrows()
    ]
    return f"Median distance of leaflets detected in simulated volumes: {' and '.join(rows)}."


def write_imaging(
    folder: Path, records: Mapping[str, Record[Findings]], _arrays: Mapping[str, Path]
) -> list[Path]:
    """All tables and figures of each study; nothing for one that only trained.

    ``imaging.*``, ``imaging_sequences.*`` and ``imaging_confidence.*`` (tables as CSV, Markdown and
    LaTeX), and ``imaging_distance``, ``imaging_training``, ``imaging_confidence``, ``imaging_std``
    and ``imaging_correlation`` (figures).

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    written = []
    for record in records.values():
        findings, tested, line = record.findings, record.findings.tested, record.line
        if tested is None:
            continue
        words = study_words(findings)
        written += write_imaging_table(folder / "imaging", tested, findings.targets, words, line)
        sequences = pd.DataFrame(map(asdict, tested.sequences))
        written += write_table(
            folder / "imaging_sequences", sequences, _over_time(sequences), line, [OVER_TIME]
        )
        kinds = pd.DataFrame(map(asdict, tested.confidence.rows)).rename(columns=CALLED)
        readable = [_rounded(row) for row in kinds.to_dict("records")]
        written += write_table(folder / "imaging_confidence", kinds, readable, line, [WITHOUT])
        for name, figure in _figures(findings.layout, tested).items():
            written += save_figure_with(folder / f"imaging_{name}", figure, line)
    return written


def _figures(layout: ValveLayout, tested: Evaluation) -> dict[str, Figure]:
    accuracy = tested.accuracy
    figures = {"distance": distance_figure([asdict(row) for row in tested.rows])}
    if len({row.training_volumes for row in tested.training}) > 1:
        figures["training"] = training_figure(pd.DataFrame(map(asdict, tested.training)))
    return figures | {
        "confidence": confidence_figure(tested.confidence),
        "std": std_figure(layout, np.array(accuracy.std_mm)),
        "correlation": correlation_figure(accuracy),
    }


def _over_time(table: pd.DataFrame) -> list[dict[str, str]]:
    """One readable row for each setting."""
    columns = {
        "surface_mm": "surface [mm]",
        "surface_open_mm": "surface, open [mm]",
        "surface_closed_mm": "surface, closed [mm]",
        "points_mm": "point to point [mm]",
        "tips_mm": "papillary tips [mm]",
        "annulus_area_error_percent": "annulus area [%]",
        "ap_error_mm": "AP diameter [mm]",
        "state_right_percent": "orifice open or closed, right [%]",
    }
    rows = []
    for setting in SETTINGS:
        own = table[table["setting"] == setting]
        if own.empty:
            continue
        row = {
            "setting": setting,
            "volumes": str(len(own)),
            "called a valve [%]": f"{100.0 * own['detected'].mean():.0f}",
            "wrongly called so [%]": f"{100.0 * own['wrong'].mean():.0f}",
        }
        for name, words in columns.items():
            values = own.loc[own["detected"], name].dropna().astype(float)
            row[words] = f"{values.mean():.2f}" if len(values) else MISSING
        frames = int(own["frames"].iloc[0])
        row["time [s]"] = f"{own['seconds'].median():.1f} ({frames} frames)"
        rows.append(row)
    return rows


def _called(kind: str) -> str:
    return f"no valve: {kind}" if kind in NO_VALVE else SEQUENCES.get(kind, kind)


def _rounded(row: Mapping[Hashable, Any]) -> dict[str, str]:
    return {
        str(key): _called(value) if isinstance(value, str) else number(value)
        for key, value in row.items()
    }


def confidence_figure(confidence: Confidences) -> Figure:
    """Confidence of every volume, by kind, with the threshold."""
    values = {kind: own for kind, own in confidence.values.items() if own}
    figure, grid = panels(1, 1, 0.42 * len(values) + 1.6)
    axes = grid[0, 0]
    random = np.random.default_rng(0)
    labels = []
    for k, (kind, own) in enumerate(values.items()):
        look = 1 if kind in NO_VALVE else 0
        places = k + random.uniform(-0.2, 0.2, len(own))
        off = np.array([np.nan if v is None else v for v in confidence.off_mm[kind]])
        wrong = off >= confidence.wrong_mm
        for which, face in ((~wrong, COLOURS[look]), (wrong, "white")):
            axes.plot(
                np.array(own)[which], places[which], ls="none", marker=MARKERS[look], ms=4.2,
                mec=COLOURS[look], mfc=face, alpha=0.8,
            )  # fmt: skip
        labels.append(f"{_called(kind)} ({len(own)})")
    axes.axvline(confidence.min_confidence, color="0.25", lw=1.0, ls="--", zorder=0)
    axes.annotate(
        "called a valve from here", (confidence.min_confidence, 1.0),
        xycoords=("data", "axes fraction"), xytext=(3, 2), textcoords="offset points",
        fontsize=SMALL, color="0.25", va="bottom",
    )  # fmt: skip
    axes.set_yticks(range(len(labels)), labels, fontsize=SMALL)
    axes.set_ylim(len(labels) - 0.5, -0.5)
    axes.set_xlim(0.0, max(1.0, *(max(own) for own in values.values())))
    axes.set_xlabel("confidence")
    axes.grid(visible=False, axis="y")
    headline(
        figure, "How sure the detectors are that there is a valve",
        "Simulated volumes. Hollow: what was detected is not the valve, its points are on average "
        f"{confidence.wrong_mm:g} mm off or more.",
    )  # fmt: skip
    return figure


def correlation_figure(accuracy: Accuracy) -> Figure:
    """How alike errors are at two vertices, against their distance, and the fitted correlation."""
    measured, length = accuracy.correlogram, accuracy.correlation_length_mm
    figure, grid = panels(1, 1, 3.2)
    axes = grid[0, 0]
    axes.plot(measured.distance, measured.correlation, ls="none", marker=MARKERS[0], ms=4,
              color=COLOURS[0], label="measured errors")  # fmt: skip
    d = np.linspace(0.0, max(measured.distance), 200)
    scaled = np.sqrt(3.0) * d / length
    axes.plot(d, (1.0 + scaled) * np.exp(-scaled), color=COLOURS[1], lw=1.3,
              label=f"Matérn 3/2, {length:.1f} mm")  # fmt: skip
    axes.axhline(0.0, color=GREY, lw=0.8)
    axes.set_xlabel("distance between two vertices at rest [mm]")
    axes.set_ylabel("correlation of their errors")
    axes.legend(fontsize=SMALL, frameon=False)
    headline(
        figure, "How far errors of the image step are alike",
        f"Of {accuracy.sequences} simulated volumes over time, open and closed frame.",
    )  # fmt: skip
    return figure
