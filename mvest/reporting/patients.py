"""Tables 2 and 3 and Figure 3 of the paper for the virtual patients, and how often intervals hold.

Everything is made from the kept records of the patients (``results/patients``, simulated, each with
the truth that was revealed after its estimation) and from those of the population
(``results/population``).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from filelock import FileLock
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.stats import beta

from mvest.errors import InputError, cannot_write
from mvest.provenance import write_json
from mvest.reporting.case_drawing import ATRIUM, draw_valve, same_scale
from mvest.reporting.case_fields import CaseFields, read_case_fields
from mvest.reporting.case_figures import corner_colours, distance_top, spread
from mvest.reporting.figures import DISTANCE_MAP, save_figure
from mvest.reporting.files import provenance_line, write_text
from mvest.reporting.markup import MISSING, latex_rows, markdown_rows, number

__all__ = [
    "PATIENTS",
    "POPULATION",
    "case_text",
    "population_frame",
    "publish_patient",
    "table2",
    "table3",
    "write_case_tables",
    "write_patient_tables",
    "write_population_tables",
]

Record = Mapping[str, Any]

PATIENTS, POPULATION = "patients", "population"
"""Folders of the kept records within the results."""

ORDER = ("normal_small", "normal_large", "functional_mr", "prolapse", "fibroelastic")
"""In which the five patients are listed; others follow by name."""

KEPT_ARRAYS = (
    "triangles", "region", "rest", "annulus", "free_edge", "frames", "seen", "tips", "chord_tip",
    "chord_insertion", "generic", "fitted", "distance_generic", "distance_fitted",
)  # fmt: skip
"""Arrays that Figure 3 needs."""

WHICH = ("generic", "registered", "personalised")
"""The closed valves whose distances are told; registered is generic, laid on the frame rigidly."""

NOTE = (
    "Simulated valves; the moduli and distances in the rows of the paper belong to five patients "
    "whose images are not public, and the anatomies here have nothing to do with theirs. The truth "
    "was revealed after the estimation."
)


def case_text(record: Record) -> str:
    """What a finished case says on the terminal."""
    lines = [f"{record['case']['name']}: {record['reason']}"]
    for row in record["unknowns"]:
        lines.append(f"  {row['label']:28s} {_interval(row)} {row['unit']}".rstrip() + _truth(row))
    for row in record["distances"]:
        lines.append(
            f"  frame {row['frame']}{'' if row['seen'] else ' (not shown to the filter)'}: "
            f"{row['generic']['mean']:.2f} mm generic, {row['registered']['mean']:.2f} registered, "
            f"{row['personalised']['mean']:.2f} personalised"
        )
    return "\n".join(lines)


def _truth(row: Mapping[str, Any]) -> str:
    return "" if row["truth"] is None else f"  (hidden truth {number(row['truth'])})"


def write_case_tables(folder: Path, record: Record) -> list[Path]:
    """``unknowns.csv`` of one case."""
    rows = [{key: row.get(key) for key in UNKNOWN_COLUMNS} for row in record["unknowns"]]
    return [write_text(folder / "unknowns.csv", pd.DataFrame(rows).to_csv(index=False))]


UNKNOWN_COLUMNS = (
    "name", "unit", "treatment", "prior_mean", "prior_std", "estimate", "std", "low", "high",
    "truth",
)  # fmt: skip


def publish_patient(results: Path, name: str, record: Record, fields: Path) -> list[Path]:
    """Keep the record of a patient, and renew the tables it belongs to.

    Parameters
    ----------
    results : Path
    name : str
        Of the record.
    record : mapping
        Its ``table`` is ``patients`` or ``population``.
    fields : Path
        Arrays of the patient; what Figure 3 needs of them is kept.
    """
    folder = results / record["table"]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Jobs of one experiment end in several processes at once.
        with FileLock(results / f".{record['table']}.lock"):
            write_json(folder / f"{name}.json", _kept(record))
            if record["table"] == PATIENTS and fields.is_file():
                with np.load(fields, allow_pickle=False) as stored:
                    arrays = {key: _small(stored[key]) for key in KEPT_ARRAYS if key in stored}
                np.savez_compressed(folder / f"{name}.npz", **arrays)
            write = write_patient_tables if record["table"] == PATIENTS else write_population_tables
            return write(results)
    except OSError as error:
        raise cannot_write(folder, error) from error


def _small(array: Any) -> Any:
    return array.astype(np.float32) if array.dtype == np.float64 else array


def _kept(record: Record) -> dict[str, Any]:
    """What tables need of a record; the settings are in ``conf``."""
    dropped = ("settings", "measurements") if record["table"] == POPULATION else ()
    return {key: value for key, value in record.items() if key not in dropped}


def read_kept(results: Path, table: str) -> dict[str, Record]:
    """Name -> record of what is kept of a table, in its order.

    Raises
    ------
    InputError
        If a record cannot be read.
    """
    found = {}
    for path in sorted((results / table).glob("*.json")):
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            rank = record["case"]["name"]
        except OSError as error:
            raise InputError(f"cannot read {path}: {error.strerror}") from error
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path} is no record of a patient: {error}") from error
        found[path.stem] = (ORDER.index(rank) if rank in ORDER else len(ORDER), rank, record)
    return {name: record for name, (_, _, record) in sorted(found.items(), key=lambda i: i[1][:2])}


# -- Tables 2 and 3 -------------------------------------------------------------------------------
def table2(records: Sequence[Record]) -> pd.DataFrame:
    """One row for each patient and modulus E_f: estimates with intervals beside the truth, MPa."""
    rows = []
    for record in records:
        for k, row in enumerate(_moduli(record["unknowns"])):
            plain: dict[str, Any] = {
                "patient": record["case"]["name"],
                "modulus": row["name"],
                "hidden truth [MPa]": row["truth"],
                "estimate [MPa]": row["estimate"],
                "95 % low [MPa]": row["low"],
                "95 % high [MPa]": row["high"],
                "inside": row.get("inside"),
            }
            for key, words in (
                ("without_nuisances", "without nuisances"),
                ("as_in_the_paper", "paper's filter"),
            ):
                other = record[key]
                found = None if other is None else _moduli(other["parameters"])[k]
                plain |= {
                    f"{words} [MPa]": None if found is None else found["estimate"],
                    f"{words} 95 % low [MPa]": None if found is None else found["low"],
                    f"{words} 95 % high [MPa]": None if found is None else found["high"],
                    f"{words} inside": None if found is None else found.get("inside"),
                    f"{words} ended": None if other is None else other["reason"],
                }
            paper = record["paper_patient"]["moduli"]
            plain["paper's estimate for its patient [MPa]"] = paper[k] if paper else None
            rows.append(plain)
    return pd.DataFrame(rows)


def table3(records: Sequence[Record]) -> pd.DataFrame:
    """One row for each patient and frame: distances generic, registered, personalised, mm."""
    rows = []
    for record in records:
        for distance in record["distances"]:
            plain: dict[str, Any] = {
                "patient": record["case"]["name"],
                "frame": distance["frame"],
                "shown to the filter": distance["seen"],
            }
            for which in WHICH:
                plain[f"{which} mean [mm]"] = distance[which]["mean"]
                plain[f"{which} SD [mm]"] = distance[which]["std"]
            generic, own = distance["generic"]["mean"], distance["personalised"]["mean"]
            plain["closer [%]"] = 100.0 * (generic - own) / generic
            truth = distance["to_truth"]
            for which in WHICH:
                plain[f"{which} to the truth [mm]"] = (
                    None if truth is None else truth[which]["mean"]
                )
            paper = record["paper_patient"]["distance_mm"] if distance["seen"] else []
            plain["paper generic [mm]"] = paper[0] if paper else None
            plain["paper personalised [mm]"] = paper[1] if paper else None
            rows.append(plain)
    return pd.DataFrame(rows)


def write_patient_tables(results: Path) -> list[Path]:
    """``table2.*``, ``table3.*`` and ``figure3.*`` from the kept patients; none if there are none.

    Raises
    ------
    InputError
        If a record is damaged or a file cannot be written.
    """
    kept = read_kept(results, PATIENTS)
    records = list(kept.values())
    if not records:
        return []
    line = _provenance(records)
    second, third = table2(records), table3(records)
    written = _write_table(
        results / "table2", second, _readable2(records), line, [NOTE, *_words2(second, records)]
    )
    if not third.empty:
        written += _write_table(
            results / "table3", third, _readable3(third), line, [NOTE, *_words3(third)]
        )
    fields = {
        records[k]["case"]["name"]: read_case_fields(results / PATIENTS / f"{name}.npz")
        for k, name in enumerate(kept)
        if (results / PATIENTS / f"{name}.npz").is_file()
    }
    if fields:
        written += save_figure(results / "figure3", figure3(fields), records[0])
    return written


def _readable2(records: Sequence[Record]) -> list[dict[str, str]]:
    rows = []
    for record in records:
        row = {"patient (simulated)": _name(record)}
        others = {
            "without nuisances": record["without_nuisances"],
            "paper's filter": record["as_in_the_paper"],
        }
        for k, found in enumerate(_moduli(record["unknowns"])):
            short = "E_AL" if k == 0 else "E_PL"
            row[f"{short} truth"] = number(found["truth"])
            row[f"{short} estimate, 95 %"] = _interval(found)
            for words, other in others.items():
                row[f"{short} {words}"] = (
                    MISSING if other is None else _interval(_moduli(other["parameters"])[k])
                )
        rows.append(row)
    return rows


def _readable3(table: pd.DataFrame) -> list[dict[str, str]]:
    rows = []
    for _, row in table.iterrows():
        frame = row["frame"] + ("" if row["shown to the filter"] else " (not shown)")
        rows.append(
            {
                "patient (simulated)": _words(row["patient"]),
                "frame": frame,
                **{f"{which} [mm]": _mean_and_sd(row, which) for which in WHICH},
                "closer": f"{row['closer [%]']:.0f} %",
                "to the truth, each of these [mm]": " / ".join(
                    number(row[f"{which} to the truth [mm]"], 2) for which in WHICH
                ),
                "paper [mm]": MISSING
                if pd.isna(row["paper generic [mm]"])
                else f"{row['paper generic [mm]']:.2f} → {row['paper personalised [mm]']:.2f}",
            }
        )
    return rows


def _mean_and_sd(row: Any, which: str) -> str:
    return f"{row[f'{which} mean [mm]']:.2f} ± {row[f'{which} SD [mm]']:.2f}"


def _words2(table: pd.DataFrame, records: Sequence[Record]) -> list[str]:
    """What Table 2 says, in numbers."""
    known = table[table["inside"].notna()]
    said = [
        f"The 95 % interval contains the truth for {int(known['inside'].sum())} of {len(known)} "
        "moduli"
    ]
    for words in ("without nuisances", "paper's filter"):
        column = table[f"{words} inside"]
        if column.notna().any():
            said.append(f"{words} for {int(column.sum())} of {int(column.notna().sum())}")
    if known.empty:
        return ["No estimation of these patients found moduli."]
    relative = (known["95 % high [MPa]"] - known["95 % low [MPa]"]) / known["estimate [MPa]"]
    out = [
        "; ".join(said) + ".",
        f"Width of the interval over the estimate: {relative.min():.2f} to {relative.max():.2f}, "
        f"mean {relative.mean():.2f}.",
    ]
    narrow = _narrower(records)
    if narrow:
        out.append("What would narrow it, on average: " + "; ".join(narrow) + ".")
    return out


def _narrower(records: Sequence[Record]) -> list[str]:
    """By how much intervals would shrink if something were known, the most first."""
    ratios: dict[str, list[float]] = {}
    for record in records:
        for row in record["narrow"]:
            what = row["what"].partition(", ")[2]
            ratios.setdefault(what, []).append(1.0 - row["std_if_known"] / row["std_now"])
    ordered = sorted(ratios.items(), key=lambda item: -np.mean(item[1]))
    return [f"{what} by {100 * np.mean(values):.0f} %" for what, values in ordered]


def _words3(table: pd.DataFrame) -> list[str]:
    out: list[str] = []
    if table.empty:
        return out
    for seen, group in table.groupby("shown to the filter", sort=False):
        closer = group["closer [%]"]
        out.append(
            f"{'Frame that the filter was shown' if seen else 'Frame that it was not shown'}: "
            f"personalised closer than generic in {int((closer > 0).sum())} of {len(group)}, by "
            f"{closer.mean():.0f} % on average; "
            f"closer than the generic valve laid rigidly on the closed frame in "
            f"{int((group['personalised mean [mm]'] < group['registered mean [mm]']).sum())}."
        )
    return out


def figure3(fields: Mapping[str, CaseFields]) -> Figure:
    """The closed valves from the atrium, generic beside personalised, on one scale for all.

    Parameters
    ----------
    fields : mapping
        Name of each patient -> its arrays.
    """
    distances = []
    for found in fields.values():
        if found.distance_generic is None or found.distance_fitted is None:
            raise InputError("Figure 3 needs the distances of the generic and personalised valves")
        distances += [found.distance_generic[found.closed], found.distance_fitted[found.closed]]
    top = distance_top(*distances)
    scale = ScalarMappable(Normalize(0.0, top), DISTANCE_MAP)
    columns = len(fields)
    figure = Figure(figsize=(2.6 * columns + 0.6, 5.4), layout="constrained")
    grid = figure.subplots(2, columns, squeeze=False)
    for column, (name, found) in enumerate(fields.items()):
        k = found.closed
        shapes = (
            ("generic", found.generic, found.distance_generic),
            ("personalised", found.fitted, found.distance_fitted),
        )
        drawn = []
        for row, (words, positions, distance) in enumerate(shapes):
            assert positions is not None
            assert distance is not None
            axes = grid[row, column]
            colours = corner_colours(scale, distance[k], found.triangles)
            draw_valve(axes, found, positions[k], colours, ATRIUM, k + 1, strength=0.3)
            title = f"{_words(name)}\n" if row == 0 else ""
            axes.set_title(f"{title}{spread(distance[k])}", fontsize=9)
            if column == 0:
                axes.text(
                    -0.06, 0.5, words, transform=axes.transAxes, rotation=90, va="center",
                    ha="right", fontsize=11,
                )  # fmt: skip
            drawn.append(positions[k])
        same_scale(list(grid[:, column]), drawn, ATRIUM)
    bar = figure.colorbar(scale, ax=grid, shrink=0.7, pad=0.01, extend="max")
    bar.set_label("distance from the observed closed valve [mm]")
    figure.suptitle(
        "Closed valves of virtual patients (simulated), seen from the atrium", fontsize=11
    )
    return figure


# -- the population -------------------------------------------------------------------------------
def population_frame(records: Sequence[Record]) -> pd.DataFrame:
    """One row for each patient and unknown: truth, estimate and interval."""
    rows = []
    for record in records:
        for key, source in (
            ("with nuisances", record["unknowns"]),
            (
                "without nuisances",
                []
                if record["without_nuisances"] is None
                else record["without_nuisances"]["parameters"],
            ),
        ):
            for row in source:
                rows.append(
                    {
                        "patient": record["case"]["name"],
                        "estimation": key,
                        "status": record["status"],
                        **{k: row.get(k) for k in ("name", "unit", "truth", "estimate", "std")},
                        **{k: row.get(k) for k in ("low", "high", "inside")},
                    }
                )
    return pd.DataFrame(rows)


def write_population_tables(results: Path) -> list[Path]:
    """``population.*`` from the kept patients drawn at random; none if there are none."""
    records = list(read_kept(results, POPULATION).values())
    if not records:
        return []
    table = population_frame(records)
    readable = []
    for (estimation, name), group in table.groupby(["estimation", "name"], sort=False):
        known = group[group["inside"].notna()]
        inside, n = int(known["inside"].sum()), len(known)
        low, high = _clopper_pearson(inside, n)
        error = (known["estimate"] - known["truth"]).astype(float)
        relative = str(name).startswith("E_f.") or "_" in str(name)
        scale = known["truth"].astype(float) if relative else 1.0
        width = (known["high"] - known["low"]).astype(float) / scale
        readable.append(
            {
                "estimation": str(estimation),
                "unknown": str(name),
                "patients": f"{n} of {len(group)}",
                "95 % interval contains the truth": f"{inside} ({100 * inside / max(n, 1):.0f} %)",
                "95 % bounds of that share": f"{100 * low:.0f} to {100 * high:.0f} %",
                "mean error": _amount((error / scale).mean(), relative),
                "median size of the error": _amount((error / scale).abs().median(), relative),
                "mean width": _amount(width.mean(), relative),
            }
        )
    distances = table3(records)
    notes = [
        "Simulated valves with anatomies and moduli drawn at random; the truth was revealed after "
        "the estimation.",
        *_both_moduli(table),
        *_words3(distances),
    ]
    written = _write_table(results / "population", table, readable, _provenance(records), notes)
    return [*written, *save_figure(results / "population", population_figure(table), records[0])]


def _both_moduli(table: pd.DataFrame) -> list[str]:
    out = []
    for estimation, group in table.groupby("estimation", sort=False):
        known = group[group["name"].str.startswith("E_f.") & group["inside"].notna()]
        inside = int(known["inside"].sum())
        out.append(
            f"Both moduli, {estimation}: the 95 % interval contains the truth {inside} times of "
            f"{len(known)} ({100 * inside / max(len(known), 1):.0f} %)."
        )
    return out


def population_figure(table: pd.DataFrame) -> Figure:
    """Estimates with their intervals against the truth, with and without nuisances."""
    names = [n for n in table["name"].unique() if n.startswith("E_f.")]
    kinds = list(table["estimation"].unique())
    figure = Figure(figsize=(4.2 * len(names), 3.9 * len(kinds)), layout="constrained")
    grid = figure.subplots(len(kinds), len(names), squeeze=False)
    for i, kind in enumerate(kinds):
        for j, name in enumerate(names):
            axes = grid[i, j]
            part = table[(table["estimation"] == kind) & (table["name"] == name)]
            part = part[part["inside"].notna()]
            axes.set_title(f"{name.replace('E_f.', 'E_f ')}, {kind}", fontsize=10)
            if part.empty:
                axes.set_axis_off()
                continue
            truth, found = part["truth"].astype(float), part["estimate"].astype(float)
            inside = part["inside"].astype(bool)
            for chosen, colour, words in (
                (inside, "#2b6ca3", "contains the truth"),
                (~inside, "#c8452f", "does not"),
            ):
                reach = np.array(
                    [
                        (found - part["low"].astype(float))[chosen],
                        (part["high"].astype(float) - found)[chosen],
                    ]
                )
                axes.errorbar(
                    truth[chosen], found[chosen], yerr=reach, fmt="o", ms=3.5, lw=1.0,
                    color=colour, label=f"{words} ({int(chosen.sum())})",
                )  # fmt: skip
            ends = np.array([truth.min() * 0.8, truth.max() * 1.25])
            axes.plot(ends, ends, color="0.4", lw=0.8, zorder=0)
            axes.set_xscale("log")
            axes.set_yscale("log")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_formatter(lambda v, _: f"{v:g}")
                axis.set_minor_formatter(lambda v, _: f"{v:g}" if f"{v:e}"[0] in "2357" else "")
                axis.set_tick_params(which="minor", labelsize=8)
            axes.set_xlabel("hidden truth [MPa]")
            axes.set_ylabel("estimate, 95 % interval [MPa]")
            axes.legend(fontsize=8, loc="upper left", frameon=False)
            axes.spines[["top", "right"]].set_visible(False)
    return figure


def _clopper_pearson(inside: int, n: int, level: float = 0.95) -> tuple[float, float]:
    """Exact interval of a share (Clopper and Pearson 1934, Biometrika 26:404)."""
    tail = 0.5 * (1 - level)
    low = 0.0 if inside == 0 else float(beta.ppf(tail, inside, n - inside + 1))
    high = 1.0 if inside == n else float(beta.ppf(1 - tail, inside + 1, n - inside))
    return low, high


# -- words ----------------------------------------------------------------------------------------
def _moduli(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    return [row for row in rows if row["name"].startswith("E_f.")]


def _interval(row: Mapping[str, Any]) -> str:
    if row["estimate"] is None:
        return MISSING
    outside = " ✗" if row.get("inside") is False else ""
    return f"{number(row['estimate'])} ({number(row['low'])} to {number(row['high'])}){outside}"


def _amount(value: float, relative: bool) -> str:
    if not np.isfinite(value):
        return MISSING
    return f"{100 * value:.1f} %" if relative else f"{value:.2f}"


def _name(record: Record) -> str:
    return _words(record["case"]["name"])


def _words(name: str) -> str:
    return name.replace("_", " ")


def _provenance(records: Sequence[Record]) -> str:
    lines = sorted({provenance_line(record) for record in records})
    return lines[0] + (f" (and {len(lines) - 1} runs more)" if len(lines) > 1 else "")


def _write_table(
    base: Path,
    table: pd.DataFrame,
    readable: Sequence[Mapping[str, str]],
    line: str,
    notes: Sequence[str],
) -> list[Path]:
    words = "\n\n".join(notes)
    comment = "".join(f"% {note}\n" for note in [*notes, line])
    return [
        write_text(base.with_suffix(".csv"), f"# {line}\n" + table.to_csv(index=False)),
        write_text(base.with_suffix(".md"), f"{markdown_rows(readable)}\n\n{words}\n\n{line}\n"),
        write_text(base.with_suffix(".tex"), comment + latex_rows(readable)),
    ]
