"""Everything that is told of a study of the image step: tables, figures, words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.common.tables import write_table
from experiments.studies.imaging.tables import imaging_table, imaging_words, write_imaging_tables
from mvest.imaging.layout import ValveLayout
from mvest.reporting.figures import save_figure
from mvest.reporting.files import keep_record, provenance_line
from mvest.reporting.images.figures import SETTINGS, std_figure
from mvest.reporting.markup import MISSING, number
from mvest.reporting.style import COLOURS, GREY, MARKERS, SMALL, headline, panels

__all__ = [
    "confidence_figure",
    "correlation_figure",
    "imaging_text",
    "publish_imaging",
    "study_words",
    "write_imaging_study",
]

Record = Mapping[str, Any]

NOT_KEPT: Final = ("volumes", "sequence_frames")
"""Of a record, what no table needs."""

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
    "counts with its best frame. Wrongly: there is none, or what was found is not it. Nothing here "
    "was measured in patients."
)


def study_words(record: Record) -> list[str]:
    """What the study's record says in numbers, sentence by sentence."""
    spent, told = record["spent"], []
    parts = [
        f"{spent[part]['cpu_s']:.0f} s {words}"
        for part, words in _PARTS.items()
        if spent[part]["cpu_s"] is not None
    ]
    total = spent["training"]["cpu_s"]
    told.append(
        f"Trained on {record['training_volumes']} volumes of "
        f"{record['valves']['train']['count']} simulated valves; CPU time "
        + ", ".join(parts)
        + (f"; {total / 60.0:.1f} minutes in all." if total is not None else ".")
    )
    if "accuracy" not in record:
        return [*told, "Not tested."]
    known = [row["state_right"] for row in record["rows"] if row["state_right"] is not None]
    if known:
        told.append(
            f"Whether the orifice is open is right in {sum(known)} of {len(known)} volumes."
        )
    accuracy = record["accuracy"]
    told.append(
        f"Errors that the detectors tell, from {accuracy['sequences']} volumes over time of other "
        f"valves: median standard deviation of a coordinate {accuracy['median_std_mm']:.2f} mm, "
        f"alike over {accuracy['correlation_length_mm']:.1f} mm, mean error "
        f"{accuracy['mean_error_mm']:.2f} mm. Left out, as the valve was not found or something "
        f"else was taken for it: {accuracy['left_out']}."
    )
    for row in accuracy["within_95"]:
        told.append(
            f"{row['setting'].capitalize()}, {row['frame']} frame: {100 * row['share']:.0f} % of "
            f"coordinates lie within 1.96 of these standard deviations "
            f"({100 * row['share_about_mean']:.0f} % with the mean error taken off), of "
            f"{row['sequences']} volumes."
        )
    found = record["confidence"]
    told.append(
        f"Confidence without a valve: at most {found['highest_without_valve']:.2f}; a valve is "
        f"called one from {found['least_confidence']:g} on."
    )
    if found["lowest_right"] is not None:
        told.append(
            f"Where the valve was found (points on average within {found['wrong_mm']:g} mm): at "
            f"least {found['lowest_right']:.2f}; where it was not, or where there is none: at most "
            f"{found['highest_wrong']:.2f}; {found['best_threshold']:.2f} would tell these apart "
            "best."
        )
    return told


def imaging_text(record: Record) -> str:
    """What a finished study says on the terminal."""
    lines = [f"{record['row']}: {record['reason']}"]
    if record["rows"]:
        table = imaging_table(record["rows"])
        for _, row in table.iterrows():
            share = f"valve found in {row['valve found [%]']:.0f} % of {row['volumes']} volumes"
            if not row["valve found [%]"] > 0:
                lines.append(f"  {row['setting']}: {share}")
                continue
            lines.append(
                f"  {row['setting']}: surface {row['surface mean [mm]']:.2f} mm on average, "
                f"{row['surface median [mm]']:.2f} median, {row['surface 90 % [mm]']:.2f} at 90 %; "
                f"{share}; {row['time per volume [s]']:.1f} s each"
            )
        lines += [f"  {line}" for line in imaging_words(table, record["targets"])]
    return "\n".join([*lines, *(f"  {line}" for line in study_words(record))])


def write_imaging_study(folder: Path, record: Record) -> list[Path]:
    """All tables and figures of the study; nothing for one that only trained.

    ``imaging.*``, ``imaging_sequences.*`` and ``imaging_confidence.*`` (tables as CSV, Markdown and
    LaTeX), and ``imaging_distance``, ``imaging_training``, ``imaging_confidence``, ``imaging_std``
    and ``imaging_correlation`` (figures).

    Parameters
    ----------
    folder : Path
    record : mapping
        Of ``experiment=imaging``.

    Raises
    ------
    InputError
        If the record is damaged or a file cannot be written.
    """
    if "accuracy" not in record:
        return []
    written = write_imaging_tables(folder, {**record, "notes": study_words(record)})
    line = provenance_line(record)
    sequences = pd.DataFrame(record["sequences"])
    written += write_table(
        folder / "imaging_sequences", sequences, _over_time(sequences), line, [OVER_TIME]
    )
    confidence = record["confidence"]
    table = pd.DataFrame(confidence["rows"])
    written += write_table(
        folder / "imaging_confidence", table, _rounded(confidence["rows"]), line, [WITHOUT]
    )
    accuracy, layout = record["accuracy"], ValveLayout(**record["layout"])
    for name, figure in (
        ("confidence", confidence_figure(confidence)),
        ("std", std_figure(layout, np.array(accuracy["std_mm"]))),
        ("correlation", correlation_figure(accuracy)),
    ):
        written += save_figure(folder / f"imaging_{name}", figure, record)
    return written


def publish_imaging(results: Path, record: Record) -> list[Path]:
    """Keep the record, and write its tables and figures into the results."""
    kept = {key: value for key, value in record.items() if key not in NOT_KEPT}
    keep_record(results, kept)
    return write_imaging_study(results, kept)


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
            "called a valve [%]": f"{100.0 * own['found'].mean():.0f}",
            "wrongly called so [%]": f"{100.0 * own['wrong'].mean():.0f}",
        }
        for name, words in columns.items():
            values = own.loc[own["found"], name].dropna().astype(float)
            row[words] = f"{values.mean():.2f}" if len(values) else MISSING
        frames = int(own["frames"].iloc[0])
        row["time [s]"] = f"{own['seconds'].median():.1f} ({frames} frames)"
        rows.append(row)
    return rows


def _called(kind: str) -> str:
    return f"no valve: {kind}" if kind in NO_VALVE else SEQUENCES.get(kind, kind)


def _rounded(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    return [
        {
            key: _called(value) if isinstance(value, str) else number(value)
            for key, value in row.items()
        }
        for row in rows
    ]


def confidence_figure(confidence: Mapping[str, Any]) -> Figure:
    """Confidence of every volume, by kind, with the threshold.

    Parameters
    ----------
    confidence : mapping
        ``values`` (kind -> confidences), ``off_mm`` (kind -> distances of points, None without a
        valve), ``wrong_mm`` and ``least_confidence``.
    """
    values = {kind: own for kind, own in confidence["values"].items() if own}
    figure, grid = panels(1, 1, 0.42 * len(values) + 1.6)
    axes = grid[0, 0]
    random = np.random.default_rng(0)
    labels = []
    for k, (kind, own) in enumerate(values.items()):
        look = 1 if kind in NO_VALVE else 0
        places = k + random.uniform(-0.2, 0.2, len(own))
        off = np.array([np.nan if v is None else v for v in confidence["off_mm"][kind]])
        wrong = off >= confidence["wrong_mm"]
        for which, face in ((~wrong, COLOURS[look]), (wrong, "white")):
            axes.plot(
                np.array(own)[which], places[which], ls="none", marker=MARKERS[look], ms=4.2,
                mec=COLOURS[look], mfc=face, alpha=0.8,
            )  # fmt: skip
        labels.append(f"{_called(kind)} ({len(own)})")
    axes.axvline(confidence["least_confidence"], color="0.25", lw=1.0, ls="--", zorder=0)
    axes.annotate(
        "called a valve from here", (confidence["least_confidence"], 1.0),
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
        "Simulated volumes. Hollow: what was found is not the valve, its points are on average "
        f"{confidence['wrong_mm']:g} mm off or more.",
    )  # fmt: skip
    return figure


def correlation_figure(accuracy: Mapping[str, Any]) -> Figure:
    """How alike errors are at two vertices, against their distance, and the fitted correlation.

    Parameters
    ----------
    accuracy : mapping
        ``correlogram`` (``distance``, ``correlation``) and ``correlation_length_mm``.
    """
    found, length = accuracy["correlogram"], accuracy["correlation_length_mm"]
    figure, grid = panels(1, 1, 3.2)
    axes = grid[0, 0]
    axes.plot(found["distance"], found["correlation"], ls="none", marker=MARKERS[0], ms=4,
              color=COLOURS[0], label="errors found")  # fmt: skip
    d = np.linspace(0.0, max(found["distance"]), 200)
    scaled = np.sqrt(3.0) * d / length
    axes.plot(d, (1.0 + scaled) * np.exp(-scaled), color=COLOURS[1], lw=1.3,
              label=f"Matérn 3/2, {length:.1f} mm")  # fmt: skip
    axes.axhline(0.0, color=GREY, lw=0.8)
    axes.set_xlabel("distance between two vertices at rest [mm]")
    axes.set_ylabel("correlation of their errors")
    axes.legend(fontsize=SMALL, frameon=False)
    headline(
        figure, "How far errors of the image step are alike",
        f"Of {accuracy['sequences']} simulated volumes over time, open and closed frame.",
    )  # fmt: skip
    return figure
