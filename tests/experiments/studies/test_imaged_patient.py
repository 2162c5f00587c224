"""Virtual patients in volumes: what is put together of both estimations, and what is kept."""

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from experiments.common.building.virtual_patients import PatientSettings
from experiments.common.cases import blind
from experiments.common.study import Job
from experiments.results.keep import publish
from experiments.studies.imaged_patient import study as imaged_patient
from experiments.studies.imaged_patient.budget import write_budget
from experiments.studies.imaged_patient.findings import Findings, KnownGeometry, Row
from experiments.studies.imaged_patient.study import STUDY, ImagedPlace, volume_rows
from experiments.studies.imaged_patient.tables import (
    chord_words,
    volume_table,
    volume_words,
    write_volume_tables,
)
from mvest.errors import InputError
from mvest.personalisation.error_budget import EVERYTHING, IMAGES, MOTION
from mvest.reporting.case.findings import Cost, UnknownRow
from tests.experiments.studies.made_up import made_up
from tests.experiments.studies.made_up_patients import an_outcome

TRUTH = {"E_f.posterior": 2.0, "E_f.anterior": 6.0, "pressure_scale": 1.05}


def test_rows_put_volume_and_known_geometry_side_by_side():
    rows = volume_rows(
        "one", an_outcome(5.0, 2.5), an_outcome(5.8, 2.1), an_outcome(5.4, 2.2), TRUTH
    )
    assert [(row.modulus.leaflet, row.modulus.truth) for row in rows] == [
        ("anterior", 6.0),
        ("posterior", 2.0),
    ]
    first = rows[0]
    assert (first.patient, first.known_geometry, first.segmented) == ("one", 5.8, 5.4)
    assert (first.modulus.estimate, first.modulus.low, first.modulus.high) == (5.0, 4.0, 6.0)
    assert first.modulus.inside


@pytest.mark.parametrize("found", ["lost", an_outcome(5.0, 2.5, "failed")])
def test_a_volume_without_an_estimate_keeps_its_rows(found):
    rows = volume_rows("one", found, an_outcome(5.8, 2.1), "lost", TRUTH)
    assert [row.modulus.estimate for row in rows] == [None, None]
    assert [row.known_geometry for row in rows] == [5.8, 2.1]
    assert [row.segmented for row in rows] == [None, None]


def test_what_is_hidden_lies_together(tmp_path):
    place = ImagedPlace(tmp_path / "volume.seq.nrrd", tmp_path / "hidden")
    assert {place.known.parent, place.segmented.parent, place.truth.parent} == {place.hidden}
    assert place.hidden not in place.volume.parents
    assert place.truth not in place.known.parents


def test_the_table_is_that_of_all_patients(tmp_path):
    def kept(name: str, rows) -> None:
        findings = Findings(rows=rows, unknowns=(), known_geometry=KnownGeometry(False, "lost"))
        record = made_up(findings, study="imaged_patient", table="volume")
        publish(STUDY, tmp_path, {f"volumes-{name}": (record, tmp_path / "no such folder")})

    for name, found in (("a", an_outcome(5.0, 2.5)), ("b", "lost")):
        kept(name, volume_rows(name, found, an_outcome(5.8, 2.1), "lost", TRUTH))
    assert {path.stem for path in (tmp_path / "records" / "volume").iterdir()} == {
        "volumes-a", "volumes-b"
    }  # fmt: skip
    table = pd.read_csv(tmp_path / "volume.csv", comment="#")
    assert list(table["patient"]) == ["a", "a", "b", "b"]
    # Run again, a patient takes its own place.
    kept("a", volume_rows("a", an_outcome(5.5, 2.2), an_outcome(5.8, 2.1), "lost", TRUTH))
    table = pd.read_csv(tmp_path / "volume.csv", comment="#")
    assert list(table["estimate [MPa]"][:2]) == [5.5, 2.2]
    assert table["estimate [MPa]"][2:].isna().all()
    assert list(tmp_path.glob("volume.md"))


def test_an_estimation_from_the_known_geometry_that_is_lost_loses_nothing_else(
    monkeypatch, tmp_path
):
    place = ImagedPlace(tmp_path / "volume.seq.nrrd", tmp_path / "hidden")
    place.truth.mkdir(parents=True)
    hidden = {
        "stated": {},
        "values": TRUTH,
        "made_from": "x",
        "anatomies_drawn": 1,
        "chord_ratios": {"marginal": [1.01, 0.99], "basal": [0.96]},
    }
    (place.truth / "hidden.json").write_text(json.dumps(hidden))

    def blindly(values, folder, case, sealed):
        if case == place.known:
            raise InputError("the estimation left no result: MemoryError")
        return an_outcome(5.0, 2.5)

    monkeypatch.setattr(imaged_patient, "make_imaged_patient", lambda *asked: place)
    monkeypatch.setattr(blind, "estimate_blindly", blindly)
    one = PatientSettings(name="one", description="")
    settings = SimpleNamespace(patient=one, echo=None)
    outcome = imaged_patient.run_imaged_patient(Job({"imaged": {}, "seed": 1}, settings, tmp_path))

    assert outcome.status == "converged"
    findings = outcome.findings
    assert [row.modulus.estimate for row in findings.rows] == [5.0, 2.5]
    assert [row.known_geometry for row in findings.rows] == [None, None]
    assert "MemoryError" in findings.known_geometry.reason
    assert findings.repeats[0].estimate == (5.0, 2.5)
    assert findings.repeats[0].seed == 1
    assert findings.chord_ratios == {"marginal": [1.01, 0.99], "basal": [0.96]}


def test_a_volume_that_is_lost_keeps_what_is_known_of_the_geometry(monkeypatch, tmp_path):
    place = ImagedPlace(tmp_path / "volume.seq.nrrd", tmp_path / "hidden")
    place.truth.mkdir(parents=True)
    hidden = {"stated": {}, "values": TRUTH, "anatomies_drawn": 2, "chord_ratios": {}}
    (place.truth / "hidden.json").write_text(json.dumps(hidden))

    def blindly(values, folder, case, sealed):
        if case == place.volume:
            raise InputError("the estimation left no result: MemoryError")
        outcome = an_outcome(5.8, 2.1)
        (folder / "estimate.json").write_text(json.dumps(asdict(outcome)))
        return outcome

    monkeypatch.setattr(imaged_patient, "make_imaged_patient", lambda *asked: place)
    monkeypatch.setattr(blind, "estimate_blindly", blindly)
    settings = SimpleNamespace(patient=PatientSettings(name="one", description=""), echo=None)
    outcome = imaged_patient.run_imaged_patient(Job({"imaged": {}, "seed": 1}, settings, tmp_path))
    assert (outcome.status, outcome.findings.repeats) == ("failed", ())
    assert "MemoryError" in outcome.reason
    assert [row.modulus.estimate for row in outcome.findings.rows] == [None, None]
    assert [row.known_geometry for row in outcome.findings.rows] == [5.8, 2.1]
    record = made_up(outcome.findings, row="one", reason=outcome.reason)
    assert STUDY.words(record) == "one: the estimation left no result: MemoryError"
    # Only what was left is written down, in the folder of its estimation.
    assert STUDY.write_run(tmp_path, record) == [
        tmp_path / name / "unknowns.csv" for name in ("segmented", "known")
    ]


def modulus(leaflet, truth, estimate=None, low=None, high=None):
    return UnknownRow(
        name=f"E_f.{leaflet}", label="", unit="MPa", kind="modulus", treatment="estimated",
        prior_mean=1.0, prior_std=1.0, estimate=estimate, low=low, high=high, truth=truth,
    )  # fmt: skip


MODULI = [
    Row("normal_small", modulus("anterior", 5.0, 6.0, 4.5, 7.5), 5.2, 5.5, "doubtful"),
    Row("normal_small", modulus("posterior", 2.0, 1.5, 1.2, 1.8), 2.1, None, "doubtful"),
    Row("prolapse", modulus("anterior", 4.0), 4.0),
]


def test_errors_of_moduli_add_up():
    table = volume_table(MODULI)
    assert table["inside"].tolist() == [True, False, None]
    assert table["error [%]"][0] == pytest.approx(20.0)
    assert table["error from known geometry [%]"][0] == pytest.approx(4.0)
    assert table["part from the images [%]"][0] == pytest.approx(16.0)
    assert table["part from the images [%]"][1] == pytest.approx(-30.0)
    assert pd.isna(table["error [%]"][2])
    words = volume_words(table)
    assert words[0] == "The 95 % interval contains the truth for 1 of 2 moduli."
    assert words[1] == "For 1 of 3 moduli there is no estimate."
    assert "from the volume 22.5 %" in words[2]
    assert "from a perfect segmentation 10.0 %" in words[2]
    assert "from the known geometry 4.0 %" in words[2]
    # The generic guess, 1 MPa, is off by 80 % of 5 and by 50 % of 2 MPa.
    assert words[3] == (
        "Anterior: from the volume 20.0 %, from a perfect segmentation 10.0 %, from the known "
        "geometry 2.0 %, part from the images 16.0 %; 0.25 of the generic guess's 80.0 % for the "
        "same patients; 1 of 1 inside."
    )
    assert words[4].startswith("Posterior: from the volume 25.0 %, from the known geometry 5.0 %")
    assert "0.50 of the generic guess's 50.0 %" in words[4]
    assert words[5] == "Verdicts: doubtful 2 (1 inside)."


def test_words_say_how_far_estimates_follow_the_truth_and_are_biased():
    # Half of the truth's logarithm, and 0.1 too much of each: ratios in the place of logarithms,
    # a slope of the error, or estimates left out that the verdict denies.
    truth = np.array([1.0, 2.0, 4.0, 8.0])
    log = 0.5 * (np.log(truth) + np.log(truth).mean()) + 0.1
    rows = [
        Row("one", modulus("anterior", t, e, 0.5, 20.0), 1.2 * t, None, verdict)
        for t, e, verdict in zip(truth, np.exp(log), ("none", "", "doubtful", ""), strict=True)
    ]
    words = [one for one in volume_words(volume_table(rows)) if "logarithm" in one]
    error = np.std(log - np.log(truth), ddof=1) / 2
    assert words == [
        "Anterior, all estimates, mean error of the logarithm (standard error): from the volume "
        f"+0.10 ({error:.2f}), from the known geometry +0.18 (0.00). From the volume the logarithm "
        "follows 0.50 (0.00) of the truth's."
    ]


def test_what_the_verdict_denies_is_neither_stated_nor_counted(tmp_path):
    denied = replace(MODULI[1], verdict="none")
    rows = [MODULI[0], denied]
    words = volume_words(volume_table(rows))
    assert words[0] == "The 95 % interval contains the truth for 1 of 1 moduli."
    assert words[1] == (
        "For 1 of 2 the verdict is that there is no estimate; they are not counted. (Of the 1 "
        "intervals that they ended with 0 contain the truth.)"
    )
    assert words[2].startswith("Median size of the error: from the volume 20.0 %")
    assert not any(sentence.startswith("Posterior") for sentence in words)
    write_volume_tables(tmp_path / "volume", rows, "line")
    text = (tmp_path / "volume.md").read_text(encoding="utf-8")
    assert "1.5 (1.2 to 1.8)" not in text
    assert "1 of 2 moduli lie inside" in text
    assert "1 without an estimate" in text


def test_the_table_of_moduli_is_readable(tmp_path):
    written = write_volume_tables(tmp_path / "volume", MODULI, "volumes: mvest 0.1.0")
    assert [path.name for path in written] == ["volume.csv", "volume.md", "volume.tex"]
    text = written[1].read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| ")][2:]
    assert "6 (4.5 to 7.5) |" in rows[0]
    assert "✗" in rows[1]
    assert "-25.0" in rows[1]
    assert rows[2].count("–") == 5
    assert "Simulated" in text or "simulated" in text
    assert "\\" in written[2].read_text(encoding="utf-8")


def test_how_long_chordae_are_is_said_of_all_patients_that_it_is_known_of(tmp_path):
    ratios = [{"marginal": [1.0, 1.04], "basal": [0.95]}, {}, {"marginal": [0.98], "basal": [0.97]}]
    # Of three chordae 1.0067 and 0.0306, of two means 1.02 and 0.98 (their SD 0.0283).
    assert chord_words(ratios) == (
        "Chordae of 2 patients, true rest length over the distance of their ends in the closed "
        "valve: 1.007 (marginal; SD 0.031, of a patient's mean 0.028), 0.960 (basal; SD 0.014, of "
        "a patient's mean 0.014); laid out by 1.007 and 0.985."
    )
    assert chord_words([{}]) == ""
    write_volume_tables(tmp_path / "volume", MODULI, "line", ratios)
    assert "0.960 (basal" in (tmp_path / "volume.md").read_text(encoding="utf-8")


def test_what_errors_cost_is_a_median_over_patients(tmp_path):
    def costs(scale):
        return [
            Cost(part, f"E_f.{leaflet}", scale * without, scale * alone)
            for leaflet in ("anterior", "posterior")
            for part, without, alone in (
                (EVERYTHING, 0.2, 0.05),
                (IMAGES, 0.1, 0.15),
                (MOTION, 0.3, 0.25),
                ("papillary tips", 0.19, 0.06),
                ("pressure", 0.17, 0.1),
            )
        ]

    budgets = {"a": costs(1.0), "b": costs(2.0), "c": costs(1.1), "lost": ()}
    written = write_budget(tmp_path / "volume_budget", budgets, 0.5, "line")
    assert {path.suffix for path in written} >= {".csv", ".md", ".png"}
    text = (tmp_path / "volume_budget.md").read_text(encoding="utf-8")
    assert "| pressure | 0.187 | 0.110 | 0.187 | 0.110 |" in text
    assert "median over 3 simulated" in text
    assert "Alone cost most: pressure (0.11), papillary tips (0.07)." in text
    assert write_budget(tmp_path / "none", {"lost": ()}, 0.5, "line") == []


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([], "no rows"),
        ([Row("a", modulus("anterior", 0.0, 6.0), 5.2)], "truth 0.0 MPa"),
    ],
)
def test_moduli_that_are_none_are_refused(rows, message):
    with pytest.raises(InputError, match=message):
        volume_table(rows)
