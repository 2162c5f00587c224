"""Virtual patients: simulated, estimated by a process that cannot see the truth, then revealed.

Three published tables come of this study. ``patients`` holds the paper's Tables 2 and 3 and Figure
3 for five virtual patients. ``population`` counts how often the intervals of thirty patients drawn
at random hold the truth. ``calibration`` counts the same in misspecification scenarios, each of
which breaks one assumption of the estimator: there it is seen what a verdict is worth.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, chi2, norm

from experiments.common.building.gate import gate_of
from experiments.common.building.patient_store import PatientPlace, make_patient
from experiments.common.cases.blind import estimate_blindly
from experiments.common.cases.check import check
from experiments.common.cases.own_case import case_words, write_report
from experiments.common.cases.settings import PersonalSettings
from experiments.common.records.record import NOT_GATED, Number, Record
from experiments.common.schema import Values, build
from experiments.common.study import Job, Result, Results, Study
from mvest.cases.folder import read_case
from mvest.errors import InputError
from mvest.problem.record import EstimateRecord, FrameFit, Spread, Unknown
from mvest.problem.verdict import TRUSTWORTHY
from mvest.reading.npz import read_npz
from mvest.reporting.skill import (
    GENERIC,
    VERDICTS,
    interval,
    interval_columns,
    moduli_figure,
    prior_alone,
    score,
    skill_table,
    stated,
    trust_of,
    verdict_table,
)
from mvest.reporting.tables import Column, Table, table
from mvest.simulation.drawn_patient import PatientSettings
from mvest.typing import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from mvest.problem.fields import CaseFields

MANY = POPULATION, CALIBRATION = "population", "calibration"
"""Published tables other than that of the five patients."""

ORDER = ("normal_small", "normal_large", "functional_mr", "prolapse", "fibroelastic")
"""In which the five patients are listed; others follow by name."""

REFERENCE = "reference"
"""The scenario in which everything is as the estimator assumes."""

WITH, PRIOR = "with nuisances", "prior alone"
"""The estimation of all unknowns, to which the verdict belongs, and none at all."""

ALTERNATIVES = {"moduli_only": "without nuisances", "paper": "paper's filter"}
"""Name in a record -> what tables call it."""

WHICH = ("generic", "registered", "personalised")
"""Closed valves whose distances are listed; registered: the generic one, rigidly moved."""

SHOWN = ("inside", "n", "coverage", "coverage low", "coverage high", "median error",
         GENERIC, "width over prior")  # fmt: skip
"""Columns of skill that the table of scenarios has."""

FAR = 3.0
"""Standard deviations off beyond which an estimate is wrong."""

LEVEL, TAILS = 0.95, (0.025, 0.975)
DRAWS = 4000
"""Uniform samples from which a band for a whole curve is found."""

KEPT_ARRAYS = (
    "triangles", "region", "rest", "annulus", "free_edge", "frames", "seen", "tips", "chord_tip",
    "chord_insertion", "generic", "fitted", "distance_generic", "distance_fitted", "reach_mm",
)  # fmt: skip
"""Arrays that Figure 3 needs."""

Patients = Sequence[tuple[Record, EstimateRecord]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What the study adds to the configuration."""

    patient: PatientSettings
    personal: PersonalSettings


# -- run ------------------------------------------------------------------------------------------
def run_patient(job: Job[Settings]) -> Result:
    """Simulate a patient, estimate in a process of its own, reveal the truth."""
    patient = job.settings.patient
    place = make_patient(job.values, patient)
    # A patient that is drawn has another anatomy than the one configured.
    gate = NOT_GATED if patient.variation else gate_of(job.values)
    estimated = estimate_blindly(job.values, job.folder, place.case, place.hidden, gate)
    return reveal(estimated, place, patient, job.values["seed"])


def reveal(estimated: Result, place: PatientPlace, patient: PatientSettings, seed: int) -> Result:
    """The result of an estimation with what its case had hidden.

    Raises
    ------
    InputError
        If the patient hides nothing.
    """
    hidden, positions = place.truth()
    (blind,) = estimated.estimates
    arrays, frames = dict(estimated.arrays), blind.frames
    if arrays:
        names = [str(name) for name in arrays["frames"]]
        arrays["truth"] = np.stack([positions[name] for name in names]).astype(np.float32)
        frames = _to_truth(frames, arrays)
    seen = [frame.personalised_to_truth for frame in frames if frame.seen]
    about = {"seed": seed, "frames": frames, "distance_to_truth_mm": seen[-1] if seen else None}
    estimate = blind.with_truth(hidden["values"]).model_copy(update=about)
    numbers: dict[str, Number] = {
        "anatomies_drawn": hidden["anatomies_drawn"],
        "scenario": patient.world or REFERENCE,
        "unknowns": len(estimate.parameters),
        "nees": _nees(estimate),
    }
    paper = zip(estimate.moduli, patient.paper_moduli, strict=False)
    numbers |= {f"paper_{own.region}_MPa": value for own, value in paper}
    distances = zip(("generic", "personalised"), patient.paper_distance_mm, strict=False)
    numbers |= {f"paper_{which}_mm": value for which, value in distances}
    return estimated.changed(tables={}, numbers=numbers, estimates=(estimate,), arrays=arrays)


def _to_truth(
    frames: Sequence[FrameFit], arrays: Mapping[str, NDArray[Any]]
) -> tuple[FrameFit, ...]:
    """Frames with distances to where the valve truly was."""

    def off(shape: str, k: int) -> Spread:
        return Spread.of(np.linalg.norm(arrays[shape][k] - arrays["truth"][k], axis=1))

    shapes = {"generic": "generic", "registered": "registered", "personalised": "fitted"}
    return tuple(
        frame.model_copy(
            update={f"{which}_to_truth": off(shape, k) for which, shape in shapes.items()}
        )
        for k, frame in enumerate(frames)
    )


def _nees(estimate: EstimateRecord) -> float | None:
    """Squared error in the posterior's covariance, over the number of unknowns."""
    scores = [score(unknown) for unknown in estimate.parameters]
    if not estimate.correlation or None in scores:
        return None
    z = np.array(scores, dtype=np.float64)
    return float(z @ np.linalg.solve(np.array(estimate.correlation), z)) / len(z)


def check_patient(values: Values, folder: Path) -> str:
    """What to expect of a virtual patient's case, which is simulated first unless it is there."""
    patient = values["patient"] and build(PatientSettings, values["patient"])
    return check(values, read_case(make_patient(values, patient).case), folder)


# -- tables ---------------------------------------------------------------------------------------
def summary(results: Results) -> dict[str, Table]:
    """The tables of five patients, of a population or of scenarios."""
    patients = _patients(results)
    estimates = [estimate for _, estimate in patients]
    groups = _by_estimation(estimates)
    if results.first.table == CALIBRATION:
        scenarios = _by_scenario(patients)
        grouped = {name: _moduli(own) for name, own in scenarios.items()}
        return {
            "": _scenarios(scenarios),
            "verdicts": verdict_table(estimates),
            "moduli": skill_table("scenario, modulus", _by_name(grouped)),
            "grounds": _grounds(estimates),
            "estimates": _estimates(patients),
        }
    distances = _distance_rows(patients)
    moduli = {name: [own for own in each if own.is_modulus] for name, each in groups.items()}
    if results.first.table == POPULATION:
        return {
            "": skill_table("estimation, unknown", _by_name(groups)),
            "moduli": skill_table("estimation", moduli),
            "verdicts": verdict_table(estimates),
            "distances": _distances(distances),
            "estimates": _estimates(patients),
        }
    return {
        "table_2": _table2(patients),
        "table_3": _table3(distances),
        "moduli": skill_table("estimation", moduli),
        "distances": _distances(distances),
        "narrower": _narrower(estimates),
    }


def _patients(results: Results) -> Patients:
    """Record and estimate of each patient, in the order of the tables."""

    def place(item: tuple[Record, EstimateRecord]) -> tuple[int, bool, str, str]:
        record, estimate = item
        five = ORDER.index(estimate.case) if estimate.case in ORDER else len(ORDER)
        scenario = _scenario(record)
        return five, scenario != REFERENCE, scenario, estimate.case

    found = [(one, one.estimates[0]) for one in results.records.values() if one.estimates]
    return sorted(found, key=place)


def _scenario(record: Record) -> str:
    return str(record.numbers.get("scenario", REFERENCE))


def _by_scenario(patients: Patients) -> dict[str, Patients]:
    names = dict.fromkeys(_scenario(record) for record, _ in patients)
    return {name: [one for one in patients if _scenario(one[0]) == name] for name in names}


def _by_estimation(estimates: Sequence[EstimateRecord]) -> dict[str, list[Unknown]]:
    """The unknowns of each way to estimate them, as far as the verdict lets them be stated."""
    groups: dict[str, list[Unknown]] = {}
    for estimate in estimates:
        for name, way in _ways(estimate):
            own = stated(estimate) if name == WITH else way.parameters
            groups.setdefault(name, []).extend(own)
    return groups


def _by_name(groups: Mapping[str, Sequence[Unknown]]) -> dict[str, list[Unknown]]:
    """Groups of unknowns, each divided by the names of these."""
    return {
        f"{group}, {name}": [own for own in unknowns if own.name == name]
        for group, unknowns in groups.items()
        for name in _names(unknowns)
    }


def _names(unknowns: Sequence[Unknown]) -> list[str]:
    return list(dict.fromkeys(unknown.name for unknown in unknowns))


def _moduli(patients: Patients) -> list[Unknown]:
    """The moduli of all estimates, also of those of which no number is stated."""
    return [own for _, estimate in patients for own in estimate.moduli]


def _ways(estimate: EstimateRecord) -> Iterator[tuple[str, EstimateRecord]]:
    """An estimate and its alternatives, by what tables call them."""
    yield WITH, estimate
    for name, label in ALTERNATIVES.items():
        if name in estimate.alternatives:
            yield label, estimate.alternatives[name]


def _table2(patients: Patients) -> Table:
    """A row for each patient and modulus: all estimates beside the truth."""
    rows = []
    for record, estimate in patients:
        for own in stated(estimate):
            if not own.is_modulus:
                continue
            row: dict[str, Any] = {"patient": estimate.case, "verdict": trust_of(estimate)}
            row |= {"modulus": own.name, "truth": own.truth, **interval("estimate", own)}
            for name, label in ALTERNATIVES.items():
                way = estimate.alternatives.get(name)
                row |= interval(label, None if way is None else way.unknown(own.name))
                row[f"{label} converged"] = None if way is None else way.converged
                row[f"{label} ended"] = None if way is None else way.reason
            row |= interval(PRIOR, prior_alone(own))
            rows.append(row | {"paper": record.numbers.get(f"paper_{own.region}_MPa")})
    about = {"patient": Column(label="patient (simulated)")}
    about |= {"verdict": Column(), "modulus": Column(), "truth": Column("MPa")}
    about |= interval_columns("estimate")
    for label in ALTERNATIVES.values():
        about |= interval_columns(label)
        about |= {f"{label} converged": Column(), f"{label} ended": Column(hidden=True)}
    about |= interval_columns(PRIOR, hidden=True)
    about["paper"] = Column("MPa", label="paper's estimate of its patient")
    return table(rows, **about)


def _distance_rows(patients: Patients) -> list[dict[str, Any]]:
    """A row for each patient and frame: distances of the closed valves, mm."""
    rows = []
    for record, estimate in patients:
        for fit in estimate.frames:
            row: dict[str, Any] = {"patient": estimate.case, "verdict": trust_of(estimate)}
            row |= {"frame": fit.frame, "seen": fit.seen}
            for which in WHICH:
                spread, off = getattr(fit, which), getattr(fit, f"{which}_to_truth")
                row |= {which: spread.mean, f"{which} SD": spread.std}
                row[f"{which} to truth"] = off and off.mean
            row["closer"] = 100.0 * (1.0 - fit.personalised.mean / fit.generic.mean)
            for which in ("generic", "personalised"):
                paper = record.numbers.get(f"paper_{which}_mm") if fit.seen else None
                row[f"paper {which}"] = paper
            rows.append(row)
    return rows


def _table3(rows: Sequence[Mapping[str, Any]]) -> Table:
    mm = Column("mm", ".2f")
    about = {
        "patient": Column(label="patient (simulated)"),
        "verdict": Column(),
        "frame": Column(),
        "seen": Column(label="shown to the filter"),
        **{which: replace(mm, std=f"{which} SD") for which in WHICH},
        "closer": Column("%", ".0f", label="personalised closer than generic by"),
        **dict.fromkeys((f"{which} {part}" for part in ("SD", "to truth") for which in WHICH), mm),
        **dict.fromkeys(("paper generic", "paper personalised"), mm),
    }
    return table(rows, **about)


def _distances(rows: Sequence[Mapping[str, Any]]) -> Table:
    """How often and by how much personalised valves are closer to what was observed."""
    held = [row for row in rows if not row["seen"]]
    groups = {"all": rows, "shown to the filter": [row for row in rows if row["seen"]]}
    groups["held out"] = held
    for verdict in VERDICTS:
        groups[f"held out, {verdict}"] = [row for row in held if row["verdict"] == verdict]
    means = [f"{which}{end}" for end in ("", " to truth") for which in WHICH]
    found = [
        {
            "frames": name,
            "n": len(own),
            "closer than generic": sum(row["personalised"] < row["generic"] for row in own),
            "closer than registered": sum(row["personalised"] < row["registered"] for row in own),
            "closer by": mean(row["closer"] for row in own),
            **{column: _mean([row[column] for row in own]) for column in means},
        }
        for name, own in groups.items()
        if own
    ]
    about = {"frames": Column(), "n": Column()}
    about |= {"closer than generic": Column(), "closer than registered": Column()}
    about |= {"closer by": Column("%", ".0f"), **dict.fromkeys(means, Column("mm", ".2f"))}
    return table(found, **about)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return mean(known) if len(known) == len(values) else None


def _narrower(estimates: Sequence[EstimateRecord]) -> Table:
    """By how much intervals would shrink on average if something were known, most first."""
    shares: dict[str, list[float]] = {}
    for estimate in estimates:
        for row in estimate.detail_rows("narrower"):
            what = row["what"].partition(", ")[2]
            shares.setdefault(what, []).append(1.0 - row["std_if_known"] / row["std_now"])
    ordered = sorted(shares.items(), key=lambda item: -mean(item[1]))
    rows = [{"if known": what, "narrower by": 100 * mean(each)} for what, each in ordered]
    return table(rows, **{"if known": "", "narrower by": "%:.0f"})


def _estimates(patients: Patients) -> Table:
    """A row for each patient, way to estimate and unknown: the tidy table for programs."""
    rows = []
    for record, estimate in patients:
        innovation, verdict = estimate.innovation, estimate.verdict
        grounds = () if verdict is None else verdict.grounds
        for way_name, way in _ways(estimate):
            for own in way.parameters:
                z = score(own)
                rows.append(
                    {
                        "patient": estimate.case,
                        "scenario": _scenario(record),
                        "seed": record.provenance.seed,
                        "estimation": way_name,
                        "status": way.status,
                        "verdict": trust_of(estimate),
                        "unknown": own.name,
                        "unit": own.unit,
                        "truth": own.truth,
                        "std": own.std,
                        **interval("estimate", own),
                        **interval(PRIOR, prior_alone(own)),
                        "off by SD": z,
                        "truth in posterior": None if z is None else float(norm.cdf(z)),
                        "NEES": record.numbers.get("nees"),
                        "NIS": innovation and innovation.nis / innovation.size,
                        "grounds": "; ".join(f"{one.check}: {one.text}" for one in grounds),
                        "ended": way.reason,
                    }
                )
    return table(rows)


def _scenarios(scenarios: Mapping[str, Patients]) -> Table:
    """A row for each scenario; all estimates count, also those of which no number is stated.

    NEES is the squared error in the posterior's covariance over the number of unknowns, a mean over
    valves; 95 % of such means lie between its bounds if posteriors are right.
    """
    rows = []
    for name, patients in scenarios.items():
        verdicts = [trust_of(estimate) for _, estimate in patients]
        row: dict[str, Any] = {"scenario": name, "valves": len(patients)}
        row |= {verdict: verdicts.count(verdict) for verdict in VERDICTS}
        believed = [pair for pair in patients if trust_of(pair[1]) == TRUSTWORTHY]
        for start, some in (("", patients), ("trusted ", believed)):
            (skill,) = skill_table("", {"": _moduli(some)}).rows or ({},)
            row |= {f"{start}{key}": skill.get(key) for key in SHOWN}
            scores = [score(own) for own in _moduli(some)]
            row[f"{start}far off"] = sum(z is not None and abs(z) > FAR for z in scores)
        rows.append(row | _nees_of(patients))
    about = dict.fromkeys(rows[0] if rows else (), Column())
    for start in ("", "trusted ") if rows else ():
        hidden = start != ""
        low, high = f"{start}coverage low", f"{start}coverage high"
        about[f"{start}n"] = Column(label=f"of {start}moduli")
        about[f"{start}coverage"] = Column("%", ".0f", low=low, high=high)
        about[f"{start}median error"] = Column("%", ".1f")
        about[f"{start}{GENERIC}"] = Column("%", ".1f", hidden=hidden)
        about[f"{start}width over prior"] = Column(digits=".2f", hidden=hidden)
        about[f"{start}far off"] = Column(label=f"{start}more than {FAR:g} SD off")
        about["NEES"] = Column(digits=".2f", low="NEES low", high="NEES high")
    return table(rows, **about)


def _nees_of(patients: Patients) -> dict[str, float | None]:
    known = [(one.numbers["nees"], one.numbers["unknowns"]) for one, _ in patients]
    values = [float(nees) for nees, _ in known if nees is not None]
    freedom = sum(int(size or 0) for nees, size in known if nees is not None)
    low, high = (float(chi2.ppf(q, freedom)) / freedom if freedom else None for q in TAILS)
    return {"NEES": mean(values) if values else None, "NEES low": low, "NEES high": high}


def _grounds(estimates: Sequence[EstimateRecord]) -> Table:
    """What spoke against estimates, and how often."""
    verdicts = [one.verdict for one in estimates if one.verdict is not None]
    counts = Counter(
        check for verdict in verdicts for check in {ground.check for ground in verdict.grounds}
    )
    rows = [{"against": check, "estimates": n} for check, n in counts.most_common()]
    return table(rows, against=Column(label="what spoke against estimates"), estimates="")


# -- figures --------------------------------------------------------------------------------------
def figure(results: Results) -> dict[str, Figure]:
    """Figure 3, or the figure of the population or of the scenarios."""
    patients = _patients(results)
    if results.first.table == POPULATION:
        return {"moduli": moduli_figure(_drawn(patients))}
    if results.first.table == CALIBRATION:
        return {"ranks": ranks_figure(_by_scenario(patients))}
    from mvest.problem.fields import case_fields

    names = {id(record): name for name, record in results.records.items()}
    places = {estimate.case: names[id(record)] for record, estimate in patients}
    fields = {
        case: case_fields(results.arrays[name])
        for case, name in places.items()
        if name in results.arrays
    }
    denied = [estimate.case for _, estimate in patients if not estimate.is_stated]
    return {"figure_3": figure_3(fields, denied)} if fields else {}


def _drawn(patients: Patients) -> dict[str, list[tuple[Unknown, str]]]:
    """The moduli of each way to estimate them, with the verdicts on the patients' estimates."""
    groups: dict[str, list[tuple[Unknown, str]]] = {}
    for _, estimate in patients:
        for name, way in _ways(estimate):
            groups.setdefault(name, []).extend((own, trust_of(estimate)) for own in way.moduli)
    return groups


def figure_3(fields: Mapping[str, CaseFields], denied: Sequence[str] = ()) -> Figure:
    """The closed valves from the atrium, generic above personalised, on one scale for all.

    Parameters
    ----------
    fields : mapping
        Name of each patient -> its arrays.
    denied : sequence of str
        Names of those whose verdict is that there is no estimate, which is written above them.

    Raises
    ------
    InputError
        If a patient has no distances.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    from mvest.reporting.case.drawing import (
        corner_colours,
        distance_top,
        draw_valve,
        paint_leak,
        same_scale,
    )
    from mvest.reporting.figures import ATRIUM, DISTANCE_MAP

    distances = []
    for valve in fields.values():
        if valve.distance_generic is None or valve.distance_fitted is None:
            raise InputError("Figure 3 needs the distances of the generic and personalised valves")
        distances += [valve.distance_generic[valve.closed], valve.distance_fitted[valve.closed]]
    scale = ScalarMappable(Normalize(0.0, distance_top(*distances)), DISTANCE_MAP)
    columns = len(fields)
    drawn = Figure(figsize=(2.6 * columns + 0.6, 5.4), layout="constrained")
    grid = drawn.subplots(2, columns, squeeze=False)
    for column, (name, valve) in enumerate(fields.items()):
        k, shapes = valve.closed, []
        for row, (which, positions, distance) in enumerate(
            (
                ("generic", valve.generic, valve.distance_generic),
                ("personalised", valve.fitted, valve.distance_fitted),
            )
        ):
            assert positions is not None
            assert distance is not None
            axes = grid[row, column]
            colours = corner_colours(scale, distance[k], valve.triangles)
            draw_valve(axes, valve, positions[k], colours, ATRIUM, k + 1, strength=0.3)
            paint_leak(axes, valve, positions[k], k + 1)
            above = name.replace("_", " ") if row == 0 else "NO ESTIMATE" * (name in denied)
            axes.set_title(f"{above}\n{Spread.of(distance[k])} mm".strip(), fontsize=9)
            if column == 0:
                axes.text(
                    -0.06, 0.5, which, transform=axes.transAxes, rotation=90, va="center",
                    ha="right", fontsize=11,
                )  # fmt: skip
            shapes.append(positions[k])
        same_scale(list(grid[:, column]), shapes, ATRIUM)
    bar = drawn.colorbar(scale, ax=grid, shrink=0.7, pad=0.01, extend="max")
    bar.set_label("distance from the observed closed valve [mm]")
    drawn.suptitle("Closed valves of virtual patients (simulated), seen from the atrium")
    return drawn


def ranks_figure(scenarios: Mapping[str, Patients]) -> Figure:
    """Where the truth lies in the posterior, a panel for each scenario.

    Difference of the empirical distribution function of the truth's place from that of the uniform
    distribution, with a band that 95 % of samples do not leave anywhere (Säilynoja, Bürkner and
    Vehtari 2022, Stat. Comput. 32:32). Above zero on the left: truths lie too low in the posterior.
    """
    from mvest.reporting.figures import panels

    columns = max(min(4, len(scenarios)), 1)
    lines = max(-(-len(scenarios) // columns), 1)
    drawn, grid = panels(lines, columns, 2.0 * lines + 0.6, sharex=True, sharey=True)
    for axes, (name, patients) in zip(grid.flat, scenarios.items(), strict=False):
        _draw_ranks(axes, name, [estimate for _, estimate in patients])
    for axes in grid.flat[len(scenarios) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("truth in posterior", fontsize=8)
    grid[0, 0].legend(fontsize=7, frameon=False, loc="upper right")
    drawn.supylabel("empirical minus uniform distribution", fontsize=9)
    return drawn


def _draw_ranks(axes: Axes, name: str, estimates: Sequence[EstimateRecord]) -> None:
    trusted = sum(trust_of(estimate) == TRUSTWORTHY for estimate in estimates)
    axes.set_title(f"{name}\n{trusted} of {len(estimates)} trustworthy", fontsize=8)
    axes.axhline(0.0, color="0.5", lw=0.6)
    moduli = [own for estimate in estimates for own in estimate.moduli]
    for modulus, colour in zip(_names(moduli), ("#2b6ca3", "#c8452f"), strict=False):
        scores = [score(own) for own in moduli if own.name == modulus]
        places = np.sort(norm.cdf([z for z in scores if z is not None]))
        if not (n := len(places)):
            continue
        at, low, high = ecdf_band(n)
        axes.fill_between(at, low, high, color="0.9", lw=0, step="mid", zorder=0)
        off = np.searchsorted(places, at, side="right") / n - at
        axes.step(at, off, where="mid", color=colour, lw=1.2, label=modulus.replace(".", " "))


@cache
def ecdf_band(n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where, and between which differences, 95 % of ECDFs of n uniform numbers lie throughout."""
    at = np.linspace(0.0, 1.0, 101)[1:-1]
    counts = (np.random.default_rng(0).random((DRAWS, n, 1)) <= at).sum(axis=1)
    tails = np.minimum(binom.cdf(counts, n, at), binom.sf(counts - 1, n, at))
    tail = np.quantile(tails.min(axis=1), 1 - LEVEL)
    return at, binom.ppf(tail, n, at) / n - at, binom.isf(tail, n, at) / n - at


# -- what is kept ---------------------------------------------------------------------------------
def keep(record: Record) -> Record:
    """What tables and figures need of a record; all of it stays in the folder of the run."""
    kept = []
    for estimate in record.estimates:
        short = estimate.without_details(*(() if record.table in MANY else ("narrower",)))
        few = short.moduli if record.table == CALIBRATION else short.parameters
        kept.append(short.model_copy(update={"unknowns": few}))
    return record.model_copy(update={"estimates": tuple(kept)})


def keep_arrays(record: Record, path: Path) -> dict[str, Any]:
    """Arrays that Figure 3 needs, in single precision."""
    if record.table in MANY:
        return {}
    stored = read_npz(path)
    return {
        key: stored[key].astype(np.float32) if stored[key].dtype == np.float64 else stored[key]
        for key in KEPT_ARRAYS
        if key in stored
    }


STUDY = Study(
    settings=Settings,
    run=run_patient,
    summary=summary,
    figure=figure,
    captions={
        "figure_3": "Figure 3: distance of closed valves from what was observed, with generic and "
        "with personalised stiffness. Drawn are midsurfaces: leaflets that touch lie a thickness "
        "apart. White: what opens between them; grey: known to be no leak; red: a gap. Simulated.",
        "moduli": "Estimates with their 95 % intervals over the hidden truth. Simulated.",
        "ranks": "Where the truth lies in the posterior: difference of its distribution from the "
        "uniform one. Grey: right intervals stay there in 95 of 100 samples. Simulated.",
    },
    latex=("patients_table_2", "patients_table_3", "patients_figure_3"),
    words=case_words,
    files=write_report,
    keep=keep,
    keep_arrays=keep_arrays,
    keeps_failures=True,
    checks=lambda: (check_patient,),
)
