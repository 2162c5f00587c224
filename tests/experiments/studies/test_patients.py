"""Tables 2 and 3, Figure 3, the population and the scenarios, from made-up records."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from experiments.common.records.record import Record
from experiments.common.study import Results
from experiments.results.published import publish, records_of
from experiments.studies.patient import study
from experiments.studies.patient.study import KEPT_ARRAYS, STUDY, figure, keep, summary
from mvest.cases.case import Role
from mvest.problem.record import Unknown
from mvest.problem.verdict import DOUBTFUL, NONE, TRUSTWORTHY, FailedCheck, Verdict
from tests.experiments.studies.made_up import SOURCE
from tests.experiments.studies.made_up_patients import (
    alone,
    distances,
    lost_patient,
    moduli,
    patient,
    unknown,
)
from tests.made_up_closure import made_up_case
from tests.reporting.case.made_up_case import arrays


def of(records: Sequence[Record]) -> Results:
    return Results({f"{k:02}": record for k, record in enumerate(records)})


def rows(records: Sequence[Record], name: str = "") -> list[dict[str, Any]]:
    """The rows of a table for readers."""
    return summary(of(records))[name].rows


@pytest.fixture(scope="module")
def fields_file(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("fields") / "fields.npz"
    stored = arrays(np.random.default_rng(1))
    known = {k: np.nan_to_num(v, nan=1.0) for k, v in stored.items() if k.startswith("distance")}
    np.savez(path, **stored | known)
    return path


def test_tables_2_and_3_compare_estimates_and_distances_with_the_truth():
    anterior, posterior = rows([patient()], "table_2")
    assert (anterior["modulus"], posterior["modulus"]) == ("E_f.anterior", "E_f.posterior")
    assert (anterior["truth"], anterior["estimate"]) == (6.0, 5.8)
    assert (anterior["estimate low"], anterior["estimate high"]) == pytest.approx((5.3, 6.3))
    insides = [row["without nuisances inside"] for row in (anterior, posterior)]
    assert (anterior["estimate inside"], insides) == (True, [True, False])
    assert (posterior["paper's filter"], posterior["paper's filter converged"]) == (4.0, False)
    shown = summary(of([patient()]))["table_2"].readable()[1]
    assert shown["without nuisances (MPa)"] == "3.1 (2.6 to 3.6) ✗"
    closed, late = rows([patient()], "table_3")
    # 2.0 mm to 0.5 mm is three quarters; 1.0 mm to 0.8 mm a fifth.
    assert (closed["closer"], late["closer"]) == pytest.approx((75.0, 20.0))
    assert (closed["seen"], late["seen"]) == (True, False)
    assert (closed["registered"], closed["personalised to truth"]) == (1.5, 0.25)
    # The paper's distances are of the frame that its filter was shown.
    assert (closed["paper generic"], late["paper generic"]) == (1.5, None)


def test_coverage_and_distances_are_counted():
    usual = patient().estimates[0]
    other = patient(
        "normal_large",
        unknowns=(*moduli(5.8, 4.0), *usual.unknowns[2:]),
        frames=(distances("closed", True, 1.0, 0.9, 1.2), usual.frames[1]),
    )
    found = {row["estimation"]: row for row in rows([patient(), other], "moduli")}
    assert (found["with nuisances"]["inside"], found["with nuisances"]["n"]) == (3, 4)
    # Its numbers count although it has not converged: Table 2 shows them.
    paper = found["paper's filter"]
    assert (paper["inside"], paper["estimated"]) == (0, 4)
    # Errors of 3.3, 5, 3.3 and 100 %; guessing 1 for 6 and 2 is off by 83 and 50 %.
    assert found["with nuisances"]["median error"] == pytest.approx((100 * 0.2 / 6 + 5) / 2)
    assert found["with nuisances"]["generic guess"] == pytest.approx(200 / 3)
    by_frame = {row["frames"]: row for row in rows([patient(), other], "distances")}
    # 75 % and -20 %: closer in one of two, 27.5 % on average.
    seen, held = by_frame["shown to the filter"], by_frame["held out"]
    assert (seen["closer than generic"], seen["closer by"]) == (1, pytest.approx(27.5))
    assert (seen["closer than registered"], held["closer than registered"]) == (1, 0)
    assert seen["personalised to truth"] == pytest.approx(0.425)


def test_patients_have_an_order_and_those_without_an_estimate_are_listed():
    # Both truths lie in its intervals; it is no less without an estimate.
    verdict = Verdict(NONE, (FailedCheck("gate", NONE, "open", "wait"),))
    records = [patient("zebra"), lost_patient(), patient("fibroelastic", verdict=verdict)]
    records += [patient("aardvark"), patient(alternatives={})]
    found = rows(records, "table_2")
    names = ["normal_small", "prolapse", "fibroelastic", "aardvark", "zebra"]
    assert [row["patient"] for row in found[::2]] == names
    assert [row["estimate"] for row in found[:6]] == [5.8, 2.1, None, None, None, None]
    assert found[0]["paper's filter"] is None
    assert (found[2]["verdict"], found[4]["verdict"]) == (NONE, NONE)
    with_nuisances = rows(records, "moduli")[0]
    assert (with_nuisances["n"], with_nuisances["estimated"]) == (10, 6)
    assert rows([lost_patient()], "table_3") == []


def test_publishing_keeps_a_patient_and_renews_the_tables(tmp_path, fields_file, monkeypatch):
    monkeypatch.setattr("mvest.reporting.figures.DPI", 20)
    folder = tmp_path / "run"
    folder.mkdir()
    shutil.copy(fields_file, folder / "fields.npz")

    def published(name: str, record: Record) -> list[Path]:
        return publish(STUDY, tmp_path, {name: (record, folder)})

    written = published("patients-normal-small", patient())
    parts = {"table_2", "table_3", "moduli", "distances"}
    # The paper has the first two.
    printed = {f"patients_table_{number}.tex" for number in (2, 3)}
    figures = {"patients_figure_3.png", "patients_figure_3.pdf", "patients.md"}
    expected = {f"patients_{part}.csv" for part in parts} | printed | figures
    assert {path.name for path in written} == expected
    kept = records_of(tmp_path, "patients")
    assert kept is not None
    (estimate,) = kept.first.estimates
    assert estimate.unknowns == patient().estimates[0].unknowns
    assert not estimate.details
    with np.load(tmp_path / "records" / "patients" / "patients-normal-small.npz") as stored:
        assert set(stored.files) <= set(KEPT_ARRAYS)
    published("patients-prolapse", patient("prolapse"))
    assert "prolapse" in (tmp_path / "patients_table_2.csv").read_text()


# -- the population ------------------------------------------------------------------------------
def population(n: int = 20, misses: int = 2) -> list[Record]:
    found = []
    for k in range(n):
        anterior = unknown("E_f.anterior", 7.0 if k < misses else 6.1 + 0.01 * k, 0.5)
        unknowns = (anterior, *patient().estimates[0].unknowns[1:])
        others = {"moduli_only": alone(moduli(5.7, 3.1))}
        record = patient(f"drawn_{k:02}", "population", unknowns=unknowns, alternatives=others)
        found.append(record)
    return found


def test_the_population_counts_how_often_intervals_contain_the_truth():
    found = {row["estimation, unknown"]: row for row in rows(population())}
    anterior = found["with nuisances, E_f.anterior"]
    assert (anterior["inside"], anterior["n"], anterior["coverage"]) == (18, 20, 90.0)
    both = {row["estimation"]: row for row in rows(population(), "moduli")}
    # Both moduli: 18 + 20 of 40, without nuisances 20 + 0 of 40.
    assert (both["with nuisances"]["inside"], both["without nuisances"]["inside"]) == (38, 20)
    # Errors of what may be zero are absolute: 0.1 - 0.4 mm.
    shift = found["with nuisances, shift.x"]
    assert (shift["unit"], shift["mean error"]) == ("mm", pytest.approx(-0.3))
    # (1.02 - 1.05) / 1.05 = -2.9 %, width 0.1 / 1.05 = 9.5 %.
    scale = found["with nuisances, pressure_scale"]
    assert (scale["unit"], scale["mean error"]) == ("%", pytest.approx(-3 / 1.05))
    assert scale["mean width"] == pytest.approx(10 / 1.05)
    assert len(rows(population(), "estimates")) == 20 * (4 + 2)
    # Failures are counted and not averaged.
    lost = lost_patient("drawn_98", "population")
    anterior = rows([*population(4, 1), lost])[0]
    assert (anterior["n"], anterior["estimated"], anterior["inside"]) == (5, 4, 3)
    drawn = figure(of([*population(2, 1), lost]))["moduli"]
    assert [text.get_text() for text in drawn.axes[0].texts] == ["no estimate"] * 3


RATIO, STRAIN = "ratio of E_f anterior to posterior", "strain of the {} leaflet {} its fibres"
STRAINS = [STRAIN.format(*two) for two in product(("anterior", "posterior"), ("along", "across"))]


def known(name: str, unit: str, estimate: float, half: float) -> dict[str, Any]:
    """A quantity of an estimate, with the interval estimate ± half."""
    ends = {"low": estimate - half, "high": estimate + half}
    return {"name": name, "unit": unit, "estimate": estimate, **ends, "generic": 2.5}


def test_ratio_and_strain_are_compared_with_their_values_without_an_estimate():
    def one(name: str, trust: str) -> Record:
        rows = known(RATIO, "", 3.3, 0.5), known(STRAINS[0], "%", 4.0, 0.5)
        numbers = {f"true {RATIO}": 3.0, f"else {RATIO}": 2.4}
        numbers |= {f"true {STRAINS[0]}": 5.0, f"else {STRAINS[0]}": 7.0}
        verdict = Verdict(trust, (), (), ())
        details = {"known": rows}
        return patient(name, "population", details=details, numbers=numbers, verdict=verdict)

    # A patient without a stated estimate is not counted.
    records = [one("a", TRUSTWORTHY), one("b", NONE)]
    ratio, strain = rows(records, "quantities")
    assert [(row["n"], row["inside"]) for row in (ratio, strain)] == [(1, 1), (1, 0)]
    # A ratio is off by a share of the truth, a strain by percentage points.
    assert (ratio["median error"], ratio["generic guess"]) == pytest.approx((10.0, 20.0))
    assert (strain["median error"], strain["generic guess"]) == pytest.approx((1.0, 2.0))
    assert study.keep(one("a", TRUSTWORTHY)).estimates[0].details["known"]


def test_true_strains_are_those_of_the_true_valve():
    case = made_up_case(0.02)
    rest, seen = case.surface.vertices, case.frame(Role.CLOSED)
    closed = [replace(f, vertices=1.2 * rest) if f is seen else f for f in case.frames]
    stated = tuple(known(name, "%", 9.0, 1.0) for name in STRAINS)
    estimate = patient(details={"known": (known(RATIO, "", 3.3, 0.5), *stated)}).estimates[0]
    numbers = study._true_quantities(
        estimate, replace(case, frames=tuple(closed)), {seen.name: 1.1 * rest}
    )
    assert (numbers[f"true {RATIO}"], numbers[f"else {RATIO}"]) == pytest.approx((3.0, 2.5))
    for name in STRAINS:
        assert (numbers[f"true {name}"], numbers[f"else {name}"]) == pytest.approx((10.0, 20.0))


# -- scenarios ------------------------------------------------------------------------------------
SD = 0.1


def modulus(name: str, z: float, truth: float = 5.0) -> Unknown:
    """An estimate whose logarithm is off by z of its standard deviations of 0.1."""
    estimate, reach = float(truth * np.exp(-z * SD)), float(np.exp(1.959964 * SD))
    return Unknown(
        name=name, unit="MPa", prior_mean=6.0, prior_std=3.0, estimate=estimate,
        std=SD * estimate, low=estimate / reach, high=estimate * reach, truth=truth,
    )  # fmt: skip


def run(
    scenario: str,
    seed: int,
    z: tuple[float, float],
    trust: Any = TRUSTWORTHY,
    correlation: float = 0.0,
) -> Record:
    failed_checks = () if trust == TRUSTWORTHY else (FailedCheck("distance", trust, "it is far"),)
    record = patient(
        f"drawn_{seed}",
        "calibration",
        unknowns=(modulus("E_f.anterior", z[0]), modulus("E_f.posterior", z[1])),
        correlation=((1.0, correlation), (correlation, 1.0)),
        verdict=Verdict(trust, failed_checks),
        alternatives={},
    )
    numbers = {"scenario": scenario, "nees": study._nees(record.estimates[0]), "unknowns": 2}
    source = SOURCE.model_copy(update={"seed": seed})
    return record.model_copy(
        update={"numbers": {**record.numbers, **numbers}, "provenance": source}
    )


RUNS = [
    run("open shape off", 1, (4.0, 1.0)),
    run("open shape off", 2, (-5.0, -4.0), NONE),
    run("open shape off", 3, (0.1, 0.2), DOUBTFUL),
    run("reference", 1, (0.5, -0.5)),
    run("reference", 2, (1.0, 2.5)),
]
"""A scenario without misspecification, and one with a wrong interval that is trusted."""


def test_scenarios_measure_the_value_of_verdicts():
    as_assumed, off = rows(RUNS)
    assert (as_assumed["scenario"], off["scenario"]) == ("reference", "open shape off")
    assert [off[verdict] for verdict in (TRUSTWORTHY, DOUBTFUL, NONE)] == [1, 1, 1]
    # |z| of 0.5, 1.0 and 0.5, 2.5: all inside but the last.
    assert (as_assumed["inside"], as_assumed["n"]) == (3, 4)
    trusted = [(row["inside"], row["n"]) for row in rows(RUNS, "trusted")]
    assert trusted == [(3, 4), (1, 2)]
    # (0.25 + 0.25) / 2 and (1 + 6.25) / 2, on average; chi-squared of 4 degrees over 4.
    assert as_assumed["NEES"] == pytest.approx(1.9375)
    assert (as_assumed["NEES low"], as_assumed["NEES high"]) == pytest.approx(
        (0.484419 / 4, 11.143287 / 4)
    )
    # Guessing 6 for 5 is off by 20 %; the prior's logarithm has an SD of 0.5, the estimate's 0.1.
    assert as_assumed["generic guess"] == pytest.approx(20.0)
    assert as_assumed["width over prior"] == pytest.approx(0.2)
    verdicts = {row["verdict"]: (row["inside"], row["n"]) for row in rows(RUNS, "verdicts")}
    assert verdicts == {TRUSTWORTHY: (4, 6), DOUBTFUL: (2, 2), NONE: (0, 2)}
    assert rows([run("2 % outliers", 1, (0.1, 0.1), NONE)], "trusted") == []
    drawn = figure(of(RUNS))["ranks"]
    titles = [axes.get_title() for axes in drawn.axes if axes.axison]
    assert titles == ["reference\n2 of 2 trustworthy", "open shape off\n1 of 3 trustworthy"]


def test_correlated_errors_are_judged_as_such():
    one = [run("reference", 1, (1.0, 1.0), correlation=0.5)]
    assert [row["off by SD"] for row in rows(one, "estimates")] == pytest.approx([1.0, 1.0])
    # (1, 1) C⁻¹ (1, 1)ᵀ / 2 with C⁻¹ = 4/3 (1, -1/2; -1/2, 1): 2/3.
    assert rows(one)[0]["NEES"] == pytest.approx(2 / 3)


def test_a_published_record_has_what_its_tables_need():
    kept = [keep(one) for one in RUNS]
    assert not kept[0].estimates[0].correlation
    for name, table in summary(of(RUNS)).items():
        assert summary(of(kept))[name].csv() == table.csv()
