"""Virtual patients in volumes: what is put together of three estimations, and what is kept."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.common.cases import blind
from experiments.common.cases.own_case import PersonalSettings
from experiments.common.records.record import Record
from experiments.common.schema import build
from experiments.common.study import Job, Results
from experiments.studies import imaged_patient
from experiments.studies.imaged_patient import HIDDEN, KNOWN, SEGMENTED, VOLUME, summary
from experiments.studies.imaged_patient import TRUTH as TRUTH_FOLDER
from mvest.errors import InputError
from mvest.problem.record import EstimateRecord, Unknown
from mvest.problem.verdict import DOUBTFUL, NONE, Verdict
from mvest.simulation.virtual_patient import PatientSettings
from tests.experiments.studies.made_up import made_up
from tests.experiments.studies.made_up_patients import a_result

TRUTH = {"E_f.posterior": 2.0, "E_f.anterior": 6.0, "pressure_scale": 1.05}
RATIOS = {"marginal": [1.01, 0.99], "basal": [0.96]}


@pytest.fixture
def place(tmp_path):
    """A patient who was simulated and imaged."""
    place = tmp_path / "patient"
    (place / TRUTH_FOLDER).mkdir(parents=True)
    hidden = {"stated": {}, "values": TRUTH, "anatomies_drawn": 2, "chord_ratios": RATIOS}
    (place / TRUTH_FOLDER / "hidden.json").write_text(json.dumps(hidden))
    return place


@pytest.fixture
def estimated(tmp_path, place, monkeypatch):
    """Runs the study with what each estimation leaves: a result, or an error's text."""
    given = []

    def run(volume: Any, known: Any, segmented: Any) -> Any:
        left = {
            place / VOLUME: (volume, place / HIDDEN),
            place / HIDDEN / KNOWN: (known, place / TRUTH_FOLDER),
            place / HIDDEN / SEGMENTED: (segmented, place / TRUTH_FOLDER),
        }

        def blindly(values, folder, case, sealed):
            given.append(case)
            found, hidden = left[case]
            # What an estimation starts from is open to it, and the truth is not.
            assert hidden not in case.parents
            assert (place / TRUTH_FOLDER).is_relative_to(hidden)
            assert sealed == hidden
            if isinstance(found, str):
                raise InputError(found)
            return found

        monkeypatch.setattr(imaged_patient, "make_imaged_patient", lambda *asked: place)
        monkeypatch.setattr(blind, "estimate_blindly", blindly)
        one = PatientSettings(name="one", description="")
        priors = {key: {"mean": 1.0, "std": 1.0} for key in ("E_f.anterior", "E_f.posterior")}
        personal = build(PersonalSettings, {"unknowns": priors})
        settings = SimpleNamespace(patient=one, echo=None, personal=personal)
        job = Job({"imaged": {}, "seed": 7}, settings, tmp_path)
        return imaged_patient.run_imaged_patient(job)

    return run


def test_estimates_from_the_volume_and_from_better_geometries_stand_together(estimated):
    result = estimated(a_result(5.0, 2.5), a_result(5.8, 2.1), a_result(5.4, 2.2))
    assert result.status == "converged"
    (estimate,) = result.estimates
    assert (estimate.case, estimate.seed) == ("one", 7)
    assert [(own.truth, own.estimate) for own in estimate.moduli] == [(6.0, 5.0), (2.0, 2.5)]
    better = estimate.alternatives
    assert [own.estimate for own in better[KNOWN].moduli] == [5.8, 2.1]
    assert [own.estimate for own in better[SEGMENTED].moduli] == [5.4, 2.2]
    assert all(own.truth == TRUTH[own.name] for one in better.values() for own in one.unknowns)
    assert result.numbers == {"anatomies_drawn": 2}
    assert result.table_of("chordae").values["ratio"] == [1.01, 0.99, 0.96]


def test_a_volume_that_is_lost_keeps_what_is_known_of_the_geometry(estimated):
    result = estimated("no result: MemoryError", a_result(5.8, 2.1), a_result(5.4, 2.2, "failed"))
    (estimate,) = result.estimates
    assert (result.status, result.reason) == ("failed", "no result: MemoryError")
    assert [(own.truth, own.estimate) for own in estimate.moduli] == [(6.0, None), (2.0, None)]
    assert [own.estimate for own in estimate.alternatives[KNOWN].moduli] == [5.8, 2.1]
    # An estimate that did not converge has no numbers.
    assert [own.estimate for own in estimate.alternatives[SEGMENTED].moduli] == [None] * 2


# -- tables ---------------------------------------------------------------------------------------
def modulus(
    leaflet: str,
    truth: float,
    estimate: float | None = None,
    low: float | None = None,
    high: float | None = None,
) -> Unknown:
    return Unknown(
        name=f"E_f.{leaflet}", unit="MPa", prior_mean=1.0, prior_std=1.0, estimate=estimate,
        low=low, high=high, truth=truth,
    )  # fmt: skip


def record(name: str, moduli: Any, known: Any, segmented: Any, **changes: Any) -> Record:
    """A patient with moduli, and estimates of these from better geometries."""

    def better(values: Any) -> EstimateRecord:
        rows = [
            own.model_copy(update={"estimate": value, "low": None, "high": None})
            for own, value in zip(moduli, values, strict=True)
        ]
        return EstimateRecord(status="converged", reason="converged", unknowns=tuple(rows))

    whole = {
        "case": name,
        "status": "converged",
        "reason": "converged",
        "verdict": Verdict(DOUBTFUL),
        "unknowns": tuple(moduli),
        "alternatives": {KNOWN: better(known), SEGMENTED: better(segmented)},
    }
    tables = changes.pop("tables", {})
    estimate = EstimateRecord(**{**whole, **changes})
    return made_up(
        study="imaged_patient", table="volume", row=name, estimates=(estimate,), tables=tables
    )


MODULI = (modulus("anterior", 5.0, 6.0, 4.5, 7.5), modulus("posterior", 2.0, 1.5, 1.2, 1.8))
FIRST = record("one", MODULI, (5.2, 2.1), (5.5, None))
LOST = record("two", (modulus("anterior", 4.0),), (4.0,), (None,), status="failed", verdict=None)


def rows(records: Any, name: str = "") -> list[dict[str, Any]]:
    return summary(Results({one.row: one for one in records}))[name].rows


def test_errors_of_moduli_from_all_sources():
    first, second, lost = rows([FIRST, LOST])
    assert [row["estimate inside"] for row in (first, second, lost)] == [True, False, None]
    assert first["error"] == pytest.approx(20.0)
    assert first["error, known"] == pytest.approx(4.0)
    assert first["error, segmented"] == pytest.approx(10.0)
    assert (lost["error"], lost["verdict"]) == (None, NONE)
    found = {row["estimated from"]: row for row in rows([FIRST, LOST], "skill")}
    volume = found["the volume"]
    assert (volume["n"], volume["estimated"], volume["inside"]) == (3, 2, 1)
    # Errors of 20 and 25 %; the generic guess, 1 MPa, is off by 80 and 50 %.
    assert volume["median error"] == pytest.approx(22.5)
    assert volume["generic guess"] == pytest.approx(65.0)
    assert found["the known geometry, E_f.anterior"]["median error"] == pytest.approx(2.0)


def test_bias_and_how_far_estimates_follow_the_truth():
    # Half of the truth's logarithm, and 0.1 too much of each; also where the verdict denies.
    truth = np.array([1.0, 2.0, 4.0, 8.0])
    log = 0.5 * (np.log(truth) + np.log(truth).mean()) + 0.1
    records = [
        record(
            f"p{k}", (modulus("anterior", t, e, 0.5, 20.0),), (1.2 * t,), (None,),
            verdict=Verdict(verdict),
        )
        for k, (t, e, verdict) in enumerate(
            zip(truth, np.exp(log), (NONE, DOUBTFUL, DOUBTFUL, DOUBTFUL), strict=True)
        )
    ]  # fmt: skip
    found = {row["estimated from"]: row for row in rows(records, "bias")}
    volume, known = found["the volume, E_f.anterior"], found["the known geometry, E_f.anterior"]
    assert (volume["n"], volume["bias"]) == (4, pytest.approx(0.1))
    assert volume["bias SE"] == pytest.approx(np.std(log - np.log(truth), ddof=1) / 2)
    assert volume["slope"] == pytest.approx(0.5)
    assert (known["bias"], known["slope"]) == pytest.approx((np.log(1.2), 1.0))
