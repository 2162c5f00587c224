"""Tables of one estimate: unknowns, frames, and what its report lists besides."""

import re
from collections.abc import Iterable, Sequence
from typing import Any

from mvest.personalisation.result import Expected
from mvest.problem.record import UNCALIBRATED, EstimateRecord, FrameFit, Row, Unknown
from mvest.problem.registration import label_of
from mvest.problem.verdict import NONE
from mvest.reporting.expectation import expected_table
from mvest.reporting.markup import ended, number
from mvest.reporting.tables import Column, Table, table

HIDDEN = Column(hidden=True)

UNITS = {"mm": "mm", "mm2": "mm²", "mm3": "mm³", "deg": "°", "s": "s", "ratio": ""}
"""End of the name of a measure -> its unit."""

FRAME_MEASURES = {
    "frame": ".0f",
    "time_s": ".3f",
    "confidence": ".2f",
    "annulus_area_mm2": ".0f",
    "orifice_mm2": ".0f",
    "coaptation_area_mm2": ".0f",
}
"""Measures of the frames of a volume that a report shows, and their digits."""


def unknown_table(unknowns: Iterable[Unknown]) -> Table:
    """A row for each unknown: prior, estimate with its 95 % interval, and truth if it is known."""
    rows = [unknown.model_dump() for unknown in unknowns]
    known = any(row["truth"] is not None for row in rows)
    return table(
        rows,
        name=HIDDEN,
        label="::unknown",
        unit="",
        kind="",
        treatment="",
        prior_mean=Column(std="prior_std", label="prior"),
        estimate=Column(
            std="std", low="low", high="high", truth="truth", label="estimate (95 % interval)"
        ),
        truth=Column(label="true value", hidden=not known),
        bound=HIDDEN,
    )


def frame_table(frames: Sequence[FrameFit]) -> Table:
    """Distances of the models from each observed frame, and from a simulated valve's true one."""
    rows, columns = [], {}
    for frame in frames:
        row: dict[str, Any] = {"frame": frame.frame, "seen": frame.seen}
        for model in ("generic", "registered", "personalised"):
            for what in (model, f"{model}_to_truth"):
                if (spread := getattr(frame, what)) is not None:
                    row |= {what: spread.mean, f"{what}_std": spread.std, f"{what}_max": spread.max}
                    columns[what] = Column("mm", ".2f", std=f"{what}_std")
                    columns[f"{what}_max"] = Column("mm", ".2f", hidden=True)
        rows.append(row)
    return table(rows, frame="", seen="::shown to the filter", **columns)


def physiology_table(rows: Iterable[Row]) -> Table:
    """Quantities of a valve beside published ranges; rows as of `mvest.closure.physiology.Row`."""

    def shown(row: Row) -> Row:
        low, high = row["low"], row["high"]
        ends = [number(end) for end in (low, high) if end is not None]
        words = "at most " if low is None else "at least " if high is None else ""
        return {**row, "published": words + " to ".join(ends) if ends else ""}

    return table(
        map(shown, rows),
        quantity="",
        part="",
        value=Column(low="p5", high="p95", label="value (5 to 95 % of the area)"),
        unit="",
        published="::published range",
        mark="",
        source="",
        low=HIDDEN,
        high=HIDDEN,
    )


def resistance_table(rows: Iterable[Row]) -> Table:
    """By which tissue the leaflets resist; rows of `mvest.closure.physiology.resistance_rows`."""
    given = list(rows)
    ways = [name for name in (given[0] if given else {}) if name not in ("part", "of")]
    return table(given, part="::leaflet", of="::share of", **dict.fromkeys(ways, "%:.0f"))


def report_tables(record: EstimateRecord) -> dict[str, Table]:
    """What a report of the estimate lists, by name; a name without rows is missing."""
    rows = record.detail_rows
    alone = record.alternatives.get("moduli_only")
    moduli = [one for one in record.unknowns if one.kind != "nuisance"]
    free = [one for one in record.unknowns if one.kind != "derived"]
    tables = {
        "moduli": unknown_table(moduli if record.is_stated else ()),
        "unknowns": unknown_table(free),
        "moduli_only": unknown_table(() if alone is None else alone.moduli),
        "frames": frame_table(record.frames),
        "measurements": _measurements(rows("measurements")),
        "narrower": _narrower(rows("narrower")),
        "errors": table(
            rows("errors"),
            name="::errors of the closed frame",
            unit="",
            believed=Column(low="believed_low", high="believed_high"),
            learned=Column(low="low", high="high"),
            stretch="::moved by [SD]",
        ),
        "geometry": table(
            rows("geometry"),
            name="::geometry",
            size="::expected error",
            unit="",
            stretch="::largest [SD]",
        ),
        "known": table(
            rows("known"),
            name="::quantity",
            unit="",
            estimate=Column(low="low", high="high", label="estimate (95 % interval)"),
            generic="::generic valve",
        ),
        "data_alone": table(
            ({**row, "parameter": label_of(row["parameter"])} for row in rows("data_alone")),
            parameter="::modulus",
            estimate=Column("MPa", low="low", high="high", label="by the data alone"),
            prior_stds=":.1f:from its prior [SD]",
        ),
        "shares": _shares(rows("shares")),
        "physiology": physiology_table(rows("physiology")),
        "resistance": resistance_table(rows("resistance")),
        "image_frames": _chosen(rows("image_frames")),
        "settings": table(rows("settings")),
    }
    return {name: one for name, one in tables.items() if len(one)}


def expected_tables(expected: Expected) -> dict[str, Table]:
    """What an estimate could tell, and what the valve is like; names without rows are missing."""
    tables = {
        "unknowns": expected_table(expected.unknowns),
        "shares": _shares(expected.shares),
        "narrower": _narrower(expected.narrower),
        "physiology": physiology_table(expected.physiology),
        "resistance": resistance_table(expected.resistance),
    }
    return {name: one for name, one in tables.items() if len(one)}


def calibration_text(record: EstimateRecord) -> str:
    """A sentence on the calibration of the moduli, and what they are without it; may be empty."""
    (row,) = record.detail_rows("calibration") or ({"why": "", "patients": 0},)
    before = record.alternatives.get(UNCALIBRATED)
    if before is None:
        why = row["why"]
        return f"The moduli are not calibrated with simulated patients: {ended(why)}" if why else ""
    moduli = ", ".join(
        f"{own.label} {number(own.estimate, 2)} ({number(own.low, 2)} to {number(own.high, 2)}) "
        f"{own.unit}"
        for own in before.moduli
    )
    return f"Calibrated with {row['patients']} simulated patients; uncalibrated: {moduli}."


def estimate_text(record: EstimateRecord) -> str:
    """What a terminal says of an estimate: verdict, unknowns, frames."""
    name, verdict = record.case or "estimate", record.verdict
    lines = [f"{name}: {record.reason}"]
    if verdict is not None:
        lines = [f"{name}: {verdict.trust.upper()} ({len(verdict.passed)} checks passed)"]
        lines += [f"  {ended(one.text)} Next: {ended(one.advice)}" for one in verdict.failed_checks]
        no_number = "No modulus is stated; the run ended" if verdict.trust == NONE else "The run"
        lines.append(f"{no_number}: {record.reason}")
    if record.is_stated:
        lines.append(unknown_table(record.unknowns).text())
        lines += filter(None, [calibration_text(record)])
    if record.frames:
        lines.append(frame_table(record.frames).text())
    return "\n".join(lines)


def _narrower(rows: Sequence[Row]) -> Table:
    """A row for each measurement: how wide each modulus' interval would be, in % of now."""
    shares: dict[str, dict[str, float]] = {}
    columns: dict[str, Column | str] = {"what": "::if this were known"}
    for row in rows:
        label = label_of(row["parameter"])
        what = str(row["what"]).removeprefix(f"{label}, ")
        columns[label] = "%:.0f"
        share = 100.0 * row["std_if_known"] / row["std_now"]
        shares.setdefault(what, {})[label] = share
    ordered = sorted(shares.items(), key=lambda one: min(one[1].values()))
    return table(({"what": what, **share} for what, share in ordered), **columns)


def _shares(rows: Sequence[Row]) -> Table:
    """A row for each source of variance of the moduli, the largest first; none below 1 %."""
    sources: dict[str, dict[str, float]] = {}
    for row in rows:
        own = sources.setdefault(row["source"], {})
        own[label_of(row["parameter"])] = 100.0 * row["share"]
    ordered = sorted(sources.items(), key=lambda one: -max(one[1].values()))
    shown = [{"source": name, **own} for name, own in ordered if max(own.values()) >= 1.0]
    columns = dict.fromkeys((label for own in sources.values() for label in own), "%:.0f")
    return table(shown, source="::share of the variance", **columns)


def _measurements(rows: Sequence[Row]) -> Table:
    """A row for each measurement, a column for each frame and shape."""
    names = dict.fromkeys(name for row in rows for name in row if name not in ("frame", "shape"))
    return table(
        {"measurement": _measured(name)}
        | {f"{row['frame']}, {row['shape']}": row.get(name) for row in rows}
        for name in names
    )


def _chosen(rows: Sequence[Row]) -> Table:
    """The measures of frames that a report shows, as far as there are any."""
    names = [name for name in FRAME_MEASURES if any(name in row for row in rows)]
    columns = {name: f":{FRAME_MEASURES[name]}:{_measured(name)}" for name in names}
    return table(({name: row.get(name) for name in names} for row in rows), **columns)


def unit_of_measure(name: str) -> str:
    """``mm²`` for ``annulus_area_mm2``; empty for what has no unit."""
    return UNITS.get(name.rpartition("_")[2], "")


def _measured(name: str) -> str:
    """``annulus_area_mm2`` as ``annulus area [mm²]``."""
    words, _, unit = name.rpartition("_")
    if unit not in UNITS or not words:
        return name.replace("_", " ")
    text = re.sub(r"\bap\b", "AP", words.replace("_", " "))
    return f"{text} [{UNITS[unit]}]" if UNITS[unit] else text
