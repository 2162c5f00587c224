"""Virtual patients: blind estimates, compared with the truth afterwards."""

import json

import numpy as np
import pytest

from experiments.common.building import patient_store
from experiments.common.cases.blind import SECRET, read_estimate, write_estimate
from experiments.common.cases.own_case import PersonalSettings, read_configured, run_case
from experiments.common.schema import build
from experiments.common.study import Job
from experiments.studies.patient import study as patient
from experiments.studies.patient.study import Settings, run_patient
from mvest.cases.folder import read_case
from mvest.errors import GeometryError
from mvest.problem.verdict import ONE_STATE
from mvest.simulation.virtual_patient import PatientSettings, VirtualPatient
from tests.experiments.configured import composed, plain
from tests.made_up_closure import TRUE, made_up_case, use


def config_of(folder, *overrides):
    return plain(
        composed(
            "experiment=patients", "patient=normal_small", "figures=false",
            f"paths.outputs={folder}", *overrides,
        )
    )  # fmt: skip


def settings_in(values):
    return build(PatientSettings, values["patient"])


def make_patient(values):
    return patient_store.make_patient(values, settings_in(values))


def run(values, folder):
    return run_patient(Job(values, build(Settings, values), folder))


def made_up_patient(name, description, template, values, simulation, mechanics, rng):
    """Stands for a simulation: the case of the formula, whatever was drawn."""
    case = made_up_case(0.3, 8.0, rng)
    exact = made_up_case()
    positions = {frame.name: frame.vertices for frame in exact.frames}
    return VirtualPatient(case, dict(TRUE), positions)


@pytest.fixture
def simulated(monkeypatch):
    """How often a patient was simulated, and with what."""
    calls = []

    def simulate(*arguments):
        calls.append(arguments)
        return made_up_patient(*arguments)

    monkeypatch.setattr(patient_store, "simulate_patient", simulate)
    return calls


@pytest.fixture
def in_process(monkeypatch):
    """Let the estimating process be this one, and the closure a formula."""
    use(monkeypatch)
    monkeypatch.setattr("mvest.personalisation.record.clinical_measurements", lambda *arguments: {})

    def blindly(values, folder, case, sealed, gate):
        given = {k: v for k, v in values.items() if k not in SECRET}
        personal = build(PersonalSettings, given["personal"])
        result = run_case(given, personal, read_configured(str(case)), gate=gate)
        write_estimate(folder, result)
        return read_estimate(folder)

    monkeypatch.setattr(patient, "estimate_blindly", blindly)


@pytest.fixture
def out(tmp_path):
    """Folder of a job."""
    folder = tmp_path / "job"
    folder.mkdir()
    return folder


def test_a_patient_is_simulated_once(tmp_path, simulated):
    place = make_patient(config_of(tmp_path))
    again = make_patient(config_of(tmp_path, "personal=carried"))
    assert place == again
    assert len(simulated) == 1
    other = make_patient(config_of(tmp_path, "seed=2"))
    assert other.case != place.case
    assert read_case(place.case).simulated
    # What was interrupted before the truth was written is simulated again, and whole.
    (place.hidden / "hidden.json").unlink()
    (place.case / "rest.txt").write_text("left")
    make_patient(config_of(tmp_path))
    assert len(simulated) == 3
    assert not (place.case / "rest.txt").exists()


def test_a_case_does_not_contain_its_truth(tmp_path, simulated):
    place = make_patient(config_of(tmp_path))
    hidden = json.loads((place.hidden / "hidden.json").read_text())
    assert hidden["values"] == TRUE
    text = b"".join(p.read_bytes() for p in place.case.rglob("*") if p.is_file()).decode("latin-1")
    assert not [name for name in TRUE if name in text]
    assert "normal_small" not in {p.name for p in place.case.rglob("*")}


def test_moduli_are_those_of_the_configuration_or_drawn_about_them(tmp_path, simulated):
    make_patient(config_of(tmp_path))
    values = simulated[0][3]
    assert (values["E_f.anterior"], values["E_f.posterior"]) == (6.28, 2.61)
    draws = []
    config = config_of(tmp_path, "patient=drawn", "patient.variation=0")
    for seed in range(1, 21):
        make_patient(config | {"seed": seed})
        draws.append([simulated[-1][3][f"E_f.{r}"] for r in ("anterior", "posterior")])
    logs = np.log(np.array(draws) / [6.23, 2.09])
    # Twenty draws of 0.4: a standard error of 0.089 of the mean and 0.063 of the spread.
    assert np.abs(logs.mean(axis=0)).max() < 4 * 0.089
    assert np.abs(logs.std(axis=0) - 0.4).max() < 4 * 0.063
    assert abs(np.corrcoef(logs.T)[0, 1]) < 0.8


def test_anatomies_are_drawn_until_one_closes(tmp_path, monkeypatch):
    shapes = []

    def simulate(name, description, template, *rest):
        shapes.append(template.parameters)
        if len(shapes) < 3:
            raise GeometryError("does not close")
        return made_up_patient(name, description, template, *rest)

    monkeypatch.setattr(patient_store, "simulate_patient", simulate)
    place = make_patient(config_of(tmp_path, "patient=drawn", "seed=7"))
    assert len(set(map(repr, shapes))) == 3
    assert json.loads((place.hidden / "hidden.json").read_text())["anatomies_drawn"] == 3
    # A given anatomy is not replaced.
    shapes.clear()
    with pytest.raises(GeometryError, match="does not close"):
        make_patient(config_of(tmp_path, "patient=prolapse", "seed=8"))
    assert len(shapes) == 1


def test_nothing_is_revealed_before_the_estimation_has_ended(
    tmp_path, out, simulated, in_process, monkeypatch
):
    files = {}
    true_reveal = patient.reveal

    def watch(estimated, *rest):
        files.update({p.name: p.read_bytes() for p in out.iterdir()})
        (estimate,) = estimated.estimates
        for one in (estimate, *estimate.alternatives.values()):
            assert all(row.truth is None for row in one.unknowns)
        return true_reveal(estimated, *rest)

    monkeypatch.setattr(patient, "reveal", watch)
    values = config_of(tmp_path)
    result = run(values, out)
    assert set(files) == {"estimate.json", "estimate.npz"}
    hidden = json.loads(files["estimate.json"])
    (before,) = hidden["estimates"]
    # The priors and the settings of the mechanics are given to everyone.
    del before["details"]["settings"]
    for value in (6.28, 2.61, *TRUE.values()):
        assert value not in leaves(hidden)
    # What was estimated did not change when the truth came.
    (estimate,) = result.estimates
    assert [row.estimate for row in estimate.unknowns] == [
        row["estimate"] for row in before["unknowns"]
    ]


def leaves(value):
    if isinstance(value, dict):
        return {v for item in value.values() for v in leaves(item)}
    if isinstance(value, list):
        return {v for item in value for v in leaves(item)}
    return {value}


def test_what_is_revealed_is_right(tmp_path, out, simulated, in_process, monkeypatch):
    monkeypatch.setattr(patient, "gate_of", lambda values: "NOT passed on 54 x 6 hex18")
    result = run(config_of(tmp_path), out)
    (estimate,) = result.estimates
    assert result.gate == "NOT passed on 54 x 6 hex18"
    assert ONE_STATE in [failed.check for failed in estimate.verdict.failed_checks]
    assert (result.status, estimate.seed) == ("converged", 1)
    for row in estimate.parameters:
        assert row.truth == TRUE[row.name]
        assert row.inside is (row.low <= row.truth <= row.high)
    for region, true in (("anterior", 5.1), ("posterior", 2.6)):
        own = estimate.unknown(f"E_f.{region}")
        assert own.truth == pytest.approx(true)
        for name in ("E_perp", "G"):
            row = estimate.unknown(f"{name}.{region}")
            assert row.truth / own.truth == pytest.approx(row.estimate / own.estimate)
    truth, arrays = made_up_case().frames, result.arrays
    for k, fit in enumerate(estimate.frames):
        gap = np.linalg.norm(arrays["fitted"][k] - arrays["truth"][k], axis=1)
        assert fit.personalised_to_truth.mean == pytest.approx(gap.mean(), abs=1e-4)
        # The truth is where it would have been seen without errors, of this frame and no other.
        same = np.linalg.norm(truth[k + 1].vertices - truth[2 - k].vertices, axis=1)
        assert same.max() > 0.5
        np.testing.assert_allclose(arrays["truth"][k], truth[k + 1].vertices, atol=1e-4)
    # Scores in the posterior's covariance, over the number of unknowns.
    assert 0.0 < result.numbers["nees"] < 100.0
