"""Sentences and tables of one case's page, computed from its record.

What a record does not have becomes a sentence that says so; nothing is put in its place.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mvest.reporting.case.information import columns_of
from mvest.reporting.expectation import alike_words
from mvest.reporting.markup import MISSING, number

__all__ = [
    "answer",
    "badges",
    "distance_rows",
    "distance_words",
    "identifiability_words",
    "innovation_words",
    "interval",
    "leaflet_names",
    "measurement_rows",
    "moduli_rows",
    "narrow_words",
    "parameter_rows",
    "percent",
    "provenance_note",
    "provenance_rows",
    "setting_rows",
    "share_rows",
    "whiteness_rows",
]

Record = Mapping[str, Any]
Rows = list[dict[str, str]]

MODULUS_NAMES = {
    "E_f": "stiffness along the fibres, E_f",
    "E_perp": "stiffness across the fibres, E_perp",
    "G": "shear stiffness, G",
}
CONVERGED = "converged"
MODULUS_UNIT = "MPa"
HASH_DIGITS = 12
NO_BREAK = "\N{NO-BREAK SPACE}"
DISTANCES = ("generic", "registered", "personalised", "to_truth")
WHICH = ("observed", "generic", "personalised")
UNITS = {"mm": "mm", "mm2": "mm²", "mm3": "mm³", "deg": "°", "ratio": ""}


def leaflet_names(record: Record, regions: int) -> list[str]:
    """Names of the leaflets in the order of their regions; numbers where they are not known."""
    names = list(record.get("region_names") or [])
    if not names:
        names = list(dict.fromkeys(str(m["region"]) for m in record.get("moduli") or []))
    if len(names) != regions:
        return [f"leaflet {k + 1}" for k in range(regions)]
    return [str(name) for name in names]


def interval(entry: Record, unit: str) -> str:
    """``5.8 MPa (95 % interval 4.1 to 8.2)``, without what is missing."""
    if entry.get("estimate") is None:
        return "no estimate"
    text = f"{number(entry['estimate'], 2)}{NO_BREAK}{unit}".rstrip()
    if entry.get("low") is None or entry.get("high") is None:
        return text
    low, high = number(entry["low"], 2), number(entry["high"], 2)
    return f"{text} (95{NO_BREAK}% interval {low} to {high})"


def answer(record: Record) -> str:
    """The result in one sentence."""
    moduli = [m for m in record.get("moduli") or [] if m.get("estimate") is not None]
    if not moduli:
        reason = record.get("reason") or "the run gives no reason"
        return f"No stiffness was estimated: {reason}."
    fibre = [m for m in moduli if m["name"] == "E_f"] or moduli
    parts = [f"{m['name']} {m['region']} {interval(m, MODULUS_UNIT)}" for m in fibre]
    return "; ".join(parts) + "."


def badges(record: Record) -> list[str]:
    """Short warnings beside the title."""
    case = record.get("case") or {}
    labels = [str(text) for text in record.get("badges") or []]
    if case.get("simulated"):
        labels.append("SIMULATED")
    stated = " ".join(str(case.get(key) or "") for key in ("name", "description", "source")).lower()
    if "tricuspid" in stated and not any("TRICUSPID" in text.upper() for text in labels):
        labels.append("DONOR TRICUSPID" if "donor" in stated else "TRICUSPID")
    status = record.get("status")
    if status and status != CONVERGED:
        labels.append(f"RUN {str(status).upper()}")
    return [*labels, "NOT FOR DIAGNOSIS"]


def percent(share: float) -> str:
    """A share as ``38 %`` that no line breaks."""
    return f"{100 * share:.0f}{NO_BREAK}%"


def moduli_rows(record: Record) -> Rows:
    """Each modulus with its interval, and the truth if it is known."""
    moduli = record.get("moduli") or []
    known = any(m.get("truth") is not None for m in moduli)
    rows = []
    for m in moduli:
        row = {
            "leaflet": str(m["region"]),
            "modulus": MODULUS_NAMES.get(str(m["name"]), str(m["name"])),
            f"estimate [{MODULUS_UNIT}]": number(m.get("estimate")),
            "95 % interval": _range(m),
        }
        if known:
            row["truth"] = number(m.get("truth"))
            row["truth within the interval"] = _holds(m)
        rows.append(row)
    return rows


def parameter_rows(record: Record) -> Rows:
    """Each parameter as it was believed beforehand and estimated, with and without nuisances."""
    without = {
        p["name"]: p for p in (record.get("without_nuisances") or {}).get("parameters") or []
    }
    parameters = record.get("parameters") or []
    known = any(p.get("truth") is not None for p in parameters)
    rows = []
    for p in parameters:
        row = {
            "parameter": str(p["label"]),
            "unit": str(p.get("unit") or "") or MISSING,
            "treated as": f"{p['kind']}, {p['treatment']}",
            "beforehand": _with_std(p.get("prior_mean"), p.get("prior_std")),
            "estimate": _with_std(p.get("estimate"), p.get("std")),
            "95 % interval": _range(p),
        }
        if without:
            alone = without.get(p["name"]) or {}
            row["nuisances taken as known"] = _with_std(alone.get("estimate"), alone.get("std"))
            row["its 95 % interval"] = _range(alone)
        if known:
            row["truth"] = number(p.get("truth"))
        rows.append(row)
    return rows


def _with_std(value: Any, std: Any) -> str:
    text = number(value)
    return text if text == MISSING or std is None else f"{text} ± {number(std, 2)}"


def _range(entry: Record) -> str:
    if entry.get("low") is None or entry.get("high") is None:
        return MISSING
    return f"{number(entry['low'])} to {number(entry['high'])}"


def _holds(entry: Record) -> str:
    if any(entry.get(key) is None for key in ("low", "high", "truth")):
        return MISSING
    return "yes" if entry["low"] <= entry["truth"] <= entry["high"] else "NO"


def distance_rows(record: Record) -> Rows:
    """Mean ± SD and largest distance of each model in each frame."""
    rows = []
    distances = record.get("distances") or []
    shown = [name for name in DISTANCES if any(d.get(name) for d in distances)]
    titles = {"registered": "generic, moved rigidly", "to_truth": "personalised to the truth"}
    for d in distances:
        row = {"frame": str(d["frame"]), "shown to the filter": "yes" if d.get("seen") else "no"}
        for name in shown:
            row[f"{titles.get(name, name)} [mm]"] = _spread(d.get(name))
        rows.append(row)
    return rows


def _spread(entry: Record | None) -> str:
    if not entry:
        return MISSING
    text = f"{entry['mean']:.2f} ± {entry['std']:.2f}"
    return text if entry.get("max") is None else f"{text}, largest {entry['max']:.2f}"


def distance_words(record: Record) -> str:
    """Whether personalising brought frames nearer that the filter was not shown."""
    held_out = [
        d
        for d in record.get("distances") or []
        if not d.get("seen") and d.get("generic") and d.get("personalised")
    ]
    if not held_out:
        return (
            "No frame was held out, so nothing here says how the personalised valve predicts a "
            "closure that it was not fitted to."
        )
    parts = []
    for d in held_out:
        before, after = d["generic"]["mean"], d["personalised"]["mean"]
        verdict = "nearer than" if after < before else "NOT nearer than"
        parts.append(
            f"{d['frame']}: the personalised valve is {after:.2f} mm away on average, {verdict} "
            f"the generic one ({before:.2f} mm)"
        )
    return "In frames that the filter was not shown: " + "; ".join(parts) + "."


def identifiability_words(record: Record) -> list[str]:
    """What the data alone could tell, in sentences."""
    data = record.get("identifiability") or {}
    moduli = {str(p["name"]): str(p["label"]) for p in record.get("parameters") or []}
    words = []
    if data.get("condition_number") is not None:
        words.append(
            f"Condition number of the information matrix: {number(data['condition_number'])} "
            "(1: all parameters are told apart equally well)."
        )
    flat = [moduli.get(str(name), str(name)) for name in data.get("flat") or []]
    if flat:
        words.append(
            "The data alone do not determine: " + ", ".join(flat) + ". What is said of them rests "
            "on what was believed beforehand."
        )
    words += [alike_words(group, moduli) for group in data.get("confounded") or []]
    bound = data.get("cramer_rao_std")
    columns = columns_of(record.get("parameters") or [], len(bound or []))
    if bound and columns:
        bounds = ", ".join(
            f"{p['label']} {number(s, 2)} {p.get('unit') or ''}".rstrip()
            for p, s in zip(columns, bound, strict=True)
        )
        words.append(f"Smallest standard deviations that the data alone allow: {bounds}.")
    return words


def share_rows(record: Record) -> Rows:
    """From which nuisance the uncertainty of each parameter comes, in per cent."""
    shares = (record.get("identifiability") or {}).get("shares") or []
    labels = {str(p["name"]): str(p["label"]) for p in record.get("parameters") or []}
    names = dict.fromkeys(name for row in shares for name in row.get("from") or {})
    return [
        {"uncertainty of": labels.get(str(row["parameter"]), str(row["parameter"]))}
        | {
            f"from {labels.get(str(name), str(name))} [%]": MISSING
            if (row.get("from") or {}).get(name) is None
            else f"{100 * row['from'][name]:.0f}"
            for name in names
        }
        for row in shares
    ]


def _over_expected(innovation: Mapping[str, Any]) -> str:
    """Root mean square of the standardised innovation, about 1 if all is as assumed."""
    size, nis = innovation.get("size"), innovation.get("nis")
    return number(math.sqrt(nis / size)) if size and nis is not None else MISSING


def innovation_words(record: Record) -> list[str]:
    """What the innovation says, in sentences."""
    innovation = record.get("innovation") or {}
    words = []
    if innovation.get("rms") is not None:
        words.append(
            f"Root mean square of the {_large(innovation.get('size'))} innovations: "
            f"{number(innovation['rms'])} mm; over what is expected of each where model and noise "
            f"are as assumed: {_over_expected(innovation)}."
        )
    band = innovation.get("nis_band")
    if innovation.get("nis") is not None and band:
        inside = band[0] <= innovation["nis"] <= band[1]
        words.append(
            f"Normalised innovation squared {_large(innovation['nis'])}, "
            + ("inside" if inside else "OUTSIDE")
            + f" its 95 % band {_large(band[0])} to {_large(band[1])}."
        )
    return words


def whiteness_rows(record: Record) -> Rows:
    """The tests of the innovation."""
    return [
        {
            "test": str(t["name"]),
            "statistic": number(t.get("statistic")),
            "p-value": number(t.get("p_value"), 2),
            "verdict": str(t.get("verdict") or MISSING),
        }
        for t in (record.get("innovation") or {}).get("tests") or []
    ]


def narrow_words(narrow: Sequence[Record]) -> str:
    """Which knowledge would narrow an interval most."""
    best = min(narrow, key=lambda r: r["std_if_known"] / r["std_now"])
    share = 1 - best["std_if_known"] / best["std_now"]
    if share < 0.01:
        return "Knowing any one of these exactly would narrow the interval by less than 1 %."
    return (
        f"Most would be gained here: {best['what']}. The standard deviation would fall by "
        f"{percent(share)}, from {number(best['std_now'])} to {number(best['std_if_known'])}."
    )


def measurement_rows(record: Record) -> Rows:
    """One row for each measurement, one column for each frame and shape."""
    frames = record.get("measurements") or {}
    columns = [
        (frame, which, values[which])
        for frame, values in frames.items()
        for which in (*WHICH, *(w for w in values if w not in WHICH))
        if values.get(which)
    ]
    names = dict.fromkeys(name for _, _, values in columns for name in values)
    return [
        {"measurement": _measurement_label(name)}
        | {f"{frame}, {which}": _large(values.get(name)) for frame, which, values in columns}
        for name in names
    ]


def _large(value: Any) -> str:
    """A number whose thousands are written out."""
    whole = isinstance(value, int | float) and 1e4 <= abs(value) < 1e7
    return f"{value:.0f}" if whole else number(value)


def _measurement_label(name: str) -> str:
    """``annulus_area_mm2`` as ``annulus area [mm²]``."""
    words, _, unit = str(name).rpartition("_")
    if unit not in UNITS or not words:
        return str(name).replace("_", " ")
    text = re.sub(r"\bap\b", "AP", words.replace("_", " "))
    return f"{text} [{UNITS[unit]}]" if UNITS[unit] else text


def setting_rows(settings: Any) -> Rows:
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


def provenance_rows(record: Record) -> Rows:
    """Where the result came from."""
    rows = setting_rows(record.get("provenance") or {})
    case = record.get("case") or {}
    if case.get("sha256"):
        rows.append({"setting": "case files, SHA-256", "value": str(case["sha256"])})
    return rows


def provenance_note(record: Record) -> str:
    """Commit, version, configuration and mesh in one line, for the foot of each picture."""
    source = record.get("provenance") or {}
    git = source.get("git") or source.get("git_sha") or source.get("sha")
    sha, dirty = (git.get("sha"), git.get("dirty")) if isinstance(git, Mapping) else (git, False)
    parts = [str(record.get("title") or "a case")]
    if (case := record.get("case") or {}).get("simulated"):
        parts.append("simulated")
    if case.get("sha256"):
        parts.append(f"case {str(case['sha256'])[:HASH_DIGITS]}")
    if version := (source.get("versions") or {}).get("mvest"):
        parts.append(f"mvest {version}")
    if sha:
        parts.append(f"commit {str(sha)[:HASH_DIGITS]}{'+changes' if dirty else ''}")
    for key in ("config_hash", "mesh_hash"):
        if source.get(key):
            parts.append(f"{key.removesuffix('_hash')} {str(source[key])[:HASH_DIGITS]}")
    # matplotlib reads what stands between dollars as mathematics.
    return ", ".join(parts).replace("$", r"\$")
