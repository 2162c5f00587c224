"""Virtual patients in volumes: one record of three estimations."""

import json
from types import SimpleNamespace
from typing import Any

import pytest

from experiments.common.cases import blind
from experiments.common.cases.own_case import PersonalSettings
from experiments.common.schema import build
from experiments.common.study import Job
from experiments.studies import imaged_patient
from experiments.studies.imaged_patient import HIDDEN, KNOWN, SEGMENTED, VOLUME
from experiments.studies.imaged_patient import TRUTH as TRUTH_FOLDER
from mvest.errors import InputError
from mvest.simulation.virtual_patient import PatientSettings
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


def test_a_failed_volume_keeps_estimates_from_better_geometries(estimated):
    result = estimated("no result: MemoryError", a_result(5.8, 2.1), a_result(5.4, 2.2, "failed"))
    (estimate,) = result.estimates
    assert (result.status, result.reason) == ("failed", "no result: MemoryError")
    assert [(own.truth, own.estimate) for own in estimate.moduli] == [(6.0, None), (2.0, None)]
    assert [own.estimate for own in estimate.alternatives[KNOWN].moduli] == [5.8, 2.1]
    # An estimate that did not converge has no numbers.
    assert [own.estimate for own in estimate.alternatives[SEGMENTED].moduli] == [None] * 2
