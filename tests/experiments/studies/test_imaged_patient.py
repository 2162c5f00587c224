"""Virtual patients in volumes: one record of three estimations."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from experiments.cli import main
from experiments.common.cases import blind
from experiments.common.cases.own_case import PersonalSettings
from experiments.common.schema import build
from experiments.common.study import Job
from experiments.results.published import publish
from experiments.studies import imaged_patient
from experiments.studies.imaged_patient import HIDDEN, KNOWN, SEGMENTED, VOLUME
from experiments.studies.imaged_patient import TRUTH as TRUTH_FOLDER
from mvest.errors import InputError
from mvest.personalisation.calibration import MeasuredFor, calibrate, read_calibration
from mvest.problem.registration import REGISTRATION
from mvest.simulation.virtual_patient import PatientSettings, draw_patient_values
from tests.calibrated_patients import patients
from tests.experiments.configured import composed, plain
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

    def run(volume: Any, known: Any, segmented: Any, better: Any = (KNOWN, SEGMENTED)) -> Any:
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
        settings = SimpleNamespace(patient=one, personal=personal, better=better)
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


def test_a_failed_volume_keeps_estimates_from_better_geometries(estimated):
    result = estimated("no result: MemoryError", a_result(5.8, 2.1), a_result(5.4, 2.2, "failed"))
    (estimate,) = result.estimates
    assert (result.status, result.reason) == ("failed", "no result: MemoryError")
    assert [(own.truth, own.estimate) for own in estimate.moduli] == [(6.0, None), (2.0, None)]
    assert [own.estimate for own in estimate.alternatives[KNOWN].moduli] == [5.8, 2.1]
    # An estimate that did not converge has no numbers.
    assert [own.estimate for own in estimate.alternatives[SEGMENTED].moduli] == [None] * 2


def test_a_calibration_needs_the_volume_alone(estimated):
    (estimate,) = estimated(a_result(5.0, 2.5), "not asked", "not asked", ()).estimates
    assert [(own.truth, own.estimate) for own in estimate.moduli] == [(6.0, 5.0), (2.0, 2.5)]
    assert estimate.alternatives == {}


def test_an_imaged_valve_has_the_drawn_truth_and_is_nowhere_displaced(monkeypatch):
    values, closed = plain(composed("experiment=volumes", "seed=3")), []

    class EndedError(Exception):
        pass

    def close(drawn, settings):
        closed.append(drawn)
        raise EndedError

    monkeypatch.setattr(imaged_patient, "close_in_motion", close)
    settings = build(imaged_patient.Settings, values)
    with pytest.raises(EndedError):
        imaged_patient._simulate(values, settings.patient)
    drawn = draw_patient_values(settings.patient, np.random.default_rng(3))
    assert any(drawn[name] for name in REGISTRATION)
    assert closed[0].values == {k: v for k, v in drawn.items() if k not in REGISTRATION}


MEASURED_FOR = MeasuredFor(way="volume", made_by="ab" * 32, settings="cd" * 32)


def published(folder, estimates):
    """Publishes records of a calibration."""
    about = {"study": "imaged_patient", "experiment": "volumes_calibration"}
    records = {
        f"one-{k:02d}": made_up(table="volume_calibration", row=f"{k}", estimates=(one,), **about)
        for k, one in enumerate(estimates)
    }
    runs = {name: (record, folder / "none") for name, record in records.items()}
    return publish(imaged_patient.STUDY, folder, "volume_calibration", runs)


def test_a_calibration_is_published_with_each_patient_left_out(tmp_path):
    estimates = list(patients(np.random.default_rng(1), 40, MEASURED_FOR))
    written = {path.name for path in published(tmp_path, estimates)}
    assert {"volume_calibration.md", "volume_calibration.png"} <= written
    whole, skill, bias = (
        pd.read_csv(tmp_path / f"volume_calibration{part}.csv", comment="#", index_col=0)
        for part in ("", "_skill", "_bias")
    )
    expected = calibrate(estimates)
    np.testing.assert_allclose(whole["offset"], expected.offset)
    np.testing.assert_allclose(whole["spread"], np.exp(expected.log_spread))
    # The posterior modulus is put in 0.25 too low, and the ratio as much too high.
    for name, put_in in (("anterior", 0.0), ("posterior", -0.25), ("anterior / posterior", 0.25)):
        before, after = bias.loc[f"uncalibrated, {name}"], bias.loc[f"calibrated, {name}"]
        assert abs(before["bias"] - put_in) < 3 * before["bias SE"]
        assert abs(after["bias"]) < min(0.02, before["bias SE"])
        assert skill.loc[f"calibrated, {name}", "estimated"] == 40
    errors = skill["median error"]
    assert errors["calibrated, posterior"] < 0.8 * errors["uncalibrated, posterior"]
    path = tmp_path / "mine.json"
    assert main(["calibrate", str(tmp_path), "volume_calibration", str(path)]) == 0
    assert read_calibration(path) == expected


def test_a_page_says_why_there_is_no_calibration_yet(tmp_path):
    published(tmp_path, list(patients(np.random.default_rng(1), 3, MEASURED_FOR)))
    assert "3 estimates that may be stated" in (tmp_path / "volume_calibration.md").read_text()
    assert not (tmp_path / "volume_calibration.png").exists()
