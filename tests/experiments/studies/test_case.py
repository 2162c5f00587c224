"""A case from the command line: its settings, its record, and what is refused."""

import json
from typing import Any

import numpy as np
import pytest

from experiments.common.cases.findings import fields_of, outcome_of_case
from experiments.common.cases.own_case import read_configured, settings_of
from experiments.common.cases.report import write_case_run
from experiments.common.cases.settings import PersonalSettings
from experiments.common.config import hash_of
from experiments.common.records.record import NOT_GATED, read_record, stamp, write_record
from experiments.common.schema import build
from experiments.common.study import Job
from experiments.studies.case.settings import Settings
from experiments.studies.case.study import STUDY, run_own_case
from mvest.cases.writer import write_case
from mvest.errors import ConfigurationError, InputError
from mvest.personalisation import Treatment, personalise_case
from mvest.problem.verdict import ONE_STATE
from mvest.reporting.case.fields import read_case_fields
from tests.experiments.configured import composed, plain
from tests.made_up_closure import made_up_case, use

OWN = ("experiment=own_valve", "personal.mesh.source=structured", "figures=false")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("given") / "case"
    write_case(place, made_up_case(0.3, 8.0, np.random.default_rng(1)))
    return place


@pytest.fixture
def config(folder, tmp_path):
    return plain(composed(*OWN, f"case={folder}", f"paths.outputs={tmp_path}"))


def personalising(values):
    return settings_of(values, build(PersonalSettings, values["personal"]))


def outcome_of(values, folder):
    return run_own_case(Job(values, build(Settings, values), folder))


@pytest.fixture(scope="module")
def made(folder):
    """An outcome with all that belongs to it, and what it was made from."""
    with pytest.MonkeyPatch.context() as patch:
        use(patch)
        config = plain(composed(*OWN, f"case={folder}"))
        fit = personalise_case(read_configured(config["case"]), personalising(config))
        return outcome_of_case(fit, {"personal": config["personal"]}), fit


@pytest.fixture
def unmeasured(monkeypatch):
    """Measuring a shape takes a second, and is tested elsewhere."""
    monkeypatch.setattr(
        "experiments.common.cases.findings.clinical_measurements", lambda *arguments: {}
    )


def test_settings_are_those_of_the_configuration(config):
    settings = personalising(config)
    about = {unknown.name: unknown for unknown in settings.unknowns}
    assert list(about)[:2] == ["E_f.anterior", "E_f.posterior"]
    assert (about["E_f.anterior"].mean, about["E_f.anterior"].std) == (6.23, 3.1)
    assert {u.treatment for u in settings.unknowns} == {Treatment.ESTIMATED}
    assert (settings.moduli_only, settings.confirm, settings.paper) == (True, True, None)
    assert settings.mesh.source == "structured"
    assert settings.correspondence
    given = plain(
        composed(
            *OWN, "personal=considered", "personal.tolerance=0.03", "personal.max_iterations=4",
            "personal.largest_change=0.3", "personal.correspondence=false",
            "personal.confirm=false",
            "personal.moduli_only=false",
        )
    )  # fmt: skip
    given["personal"]["paper"] = {"P0": 1.0, "Q": 0.1, "R": 0.25, "max_iterations": 3}
    settings = personalising(given)
    treated = {u.name: u.treatment for u in settings.unknowns}
    assert treated["E_f.posterior"] is Treatment.ESTIMATED
    assert treated["turn.x"] is Treatment.CONSIDERED
    assert (settings.tolerance, settings.max_iterations, settings.largest_change) == (0.03, 4, 0.3)
    assert (settings.correspondence, settings.confirm, settings.moduli_only) == (False,) * 3
    assert settings.paper.R == 0.25


def test_an_anatomy_that_did_not_pass_the_gate_speaks_against_an_estimate(made, config):
    outcome, fit = made
    shown = {"personal": config["personal"]}
    failed, passed = (
        outcome_of_case(fit, shown, gate=gate) for gate in ("NOT passed on a", "passed on a")
    )
    assert failed.gate == "NOT passed on a"
    (ground,) = [g for g in failed.findings.case.verdict.grounds if g.check == ONE_STATE]
    assert "did not pass the gate" in ground.text
    assert ONE_STATE in passed.findings.case.verdict.passed
    assert passed.findings.case.verdict.grounds == outcome.findings.case.verdict.grounds


def test_a_record_is_plain_and_knows_no_truth(made, config, tmp_path):
    outcome, fit = made
    path = tmp_path / "record.json"
    write_record(path, stamp(config, "hash", outcome, 0.0))
    back = read_record(path, STUDY.findings)
    assert back.findings == outcome.findings
    assert back.status == "converged"
    assert back.row == "made_up"
    # What the case is and not what the configuration of other studies says.
    assert (back.model.filter, back.model.noise_mm) == ("iterated", 0.3)
    case, (run,) = back.findings.case, back.findings.repeats
    assert back.gate == NOT_GATED
    assert ONE_STATE in case.verdict.missing
    assert case.about.simulated is True
    assert len(case.about.sha256) == 64
    assert run.relative_error is None
    for row in (*case.unknowns, *case.moduli, *case.without_nuisances.parameters):
        assert row.truth is None
    assert all(row.inside is None for row in case.unknowns)
    assert all(row.to_truth is None for row in case.distances)
    # Runs are compared by their moduli; the findings of the case are of all unknowns.
    assert back.parameters == ("E_f.anterior", "E_f.posterior")
    assert run.estimate == tuple(fit.result.estimate[:2].tolist())
    assert run.std == tuple(fit.result.std[:2].tolist())
    assert [row.prior_mean for row in case.unknowns[:2]] == [6.23, 2.09]
    assert [len(row) for row in run.iterates] == [2] * len(case.iterates)
    assert len(run.bound) == 2
    assert [row.name for row in case.unknowns] == list(fit.names)
    assert [len(row) for row in case.iterates] == [11] * len(run.iterates)
    assert len(case.identifiability.cramer_rao_std) == 11


def test_a_record_of_an_older_layout_is_one_clear_line(made, config, tmp_path):
    path = tmp_path / "result.json"
    write_record(path, stamp(config, "hash", made[0], 0.0))
    data = json.loads(path.read_text())
    data["findings"] = {"unknowns": [], "estimate": [6.0, 2.0]}
    path.write_text(json.dumps(data))
    with pytest.raises(
        InputError, match=r"result\.json is no record of a run: findings\."
    ) as raised:
        read_record(path, STUDY.findings)
    assert "\n" not in str(raised.value)


def test_a_case_of_other_leaflets_names_its_own_parameters(made, config):
    outcome, _ = made
    record = stamp({**config, "parameters": ["E_f.somewhere"]}, "hash", outcome, 0.0)
    assert record.parameters == ("E_f.anterior", "E_f.posterior")


def test_moduli_follow_by_their_ratios(made, config):
    case = made[0].findings.case
    rows = {(row.region, row.name): row for row in case.moduli}
    unknowns = {row.name: row for row in case.unknowns}
    assert len(rows) == 6
    # E_f over E_perp is 2.35/6.23 of the anterior and 1.89/2.09 of the posterior leaflet's inverse.
    ratios = {region: tissue["ratio"] for region, tissue in config["mechanics"]["tissue"].items()}
    for region, ratio in ratios.items():
        own = unknowns[f"E_f.{region}"]
        for key in ("estimate", "std", "low", "high"):
            value = getattr(own, key)
            assert getattr(rows[region, "E_f"], key) == pytest.approx(value)
            assert getattr(rows[region, "E_perp"], key) == pytest.approx(value / ratio)
            share = getattr(rows[region, "G"], key) / value
            assert share == pytest.approx(rows[region, "G"].estimate / own.estimate)
        assert own.low < own.estimate < own.high


def test_intervals_of_what_is_positive_are_those_of_its_logarithm(made):
    outcome, fit = made
    for k, row in enumerate(outcome.findings.case.unknowns):
        std = fit.result.filtered.transformed.std[k]
        if row.name.startswith(("shift", "turn")):
            assert row.high - row.estimate == pytest.approx(1.959964 * std)
        else:
            assert np.log(row.high / row.estimate) == pytest.approx(1.959964 * std)
            assert row.low * row.high == pytest.approx(row.estimate**2)


def test_every_frame_is_measured_as_it_was_seen_and_as_it_is_predicted(made):
    measured = made[0].findings.case.measurements
    assert {frame: list(which) for frame, which in measured.items()} == {
        "open": ["observed"],
        "closed": ["observed", "generic", "personalised"],
        "late": ["observed", "generic", "personalised"],
    }
    # The template's annulus is 36 mm wide, and contracts by a few per cent at most.
    for which in measured["closed"].values():
        assert which["commissural_diameter_mm"] == pytest.approx(36, rel=0.05)
    assert measured["open"]["observed"]["orifice_mm2"] > 100


def test_what_would_narrow_is_said_of_each_modulus(made):
    outcome, fit = made
    narrow = outcome.findings.case.narrow
    # The prior's 15 % of 100 mmHg, five times as well.
    measured = "pressure measured to ±3 mmHg"
    rows = [row for row in narrow if row.what.endswith(measured)]
    assert [row.parameter for row in rows] == ["E_f.anterior", "E_f.posterior"]
    assert rows[0].what == f"E_f anterior, {measured}"
    for k, row in enumerate(rows):
        assert row.std_if_known == fit.narrower[measured][k]
        assert row.std_now == fit.narrower["now"][k] > row.std_if_known
    assert not [row for row in narrow if row.what.endswith("now")]


def test_a_failed_estimation_has_a_record_too(config, monkeypatch, tmp_path, unmeasured):
    use(monkeypatch, fails_above=4.0)
    (tmp_path / "fields.npz").write_bytes(b"of an earlier run")
    outcome = outcome_of(config, tmp_path)
    record = stamp(config, "hash", outcome, 0.0)
    write_record(tmp_path / "record.json", record)
    findings = read_record(tmp_path / "record.json", STUDY.findings).findings
    assert outcome.status == "failed"
    assert findings.repeats[0].estimate is None
    case = findings.case
    assert case.moduli == case.distances == case.narrow == ()
    assert all(row.estimate is row.low is None for row in case.unknowns)
    assert not case.without_nuisances.converged
    # Nothing of an earlier run is left where nothing is estimated, and nothing is drawn of it.
    assert not (tmp_path / "fields.npz").exists()
    assert write_case_run(tmp_path, record) == [tmp_path / "unknowns.csv"]


@pytest.mark.parametrize("overrides", [(), ("personal=considered",)])
def test_files_of_a_case_are_written_and_read(config, monkeypatch, tmp_path, unmeasured, overrides):
    use(monkeypatch)
    config = plain(
        composed(*OWN, *overrides, f"case={config['case']}", f"paths.outputs={tmp_path}")
    )
    (tmp_path / "fields.npz").write_bytes(b"of an earlier run")
    outcome = outcome_of(config, tmp_path)
    assert outcome.status == "converged"
    fields = read_case_fields(tmp_path / "fields.npz")
    assert fields.frames == ("closed", "late")
    assert fields.seen.tolist() == [True, False]
    assert fields.truth is None
    assert fields.sensitivity.shape == (288, 3, 11)
    distance = np.linalg.norm(fields.fitted - fields.observed, axis=2)
    np.testing.assert_allclose(distance, fields.distance_fitted, atol=1e-4)
    assert np.mean(distance[0]) == pytest.approx(
        outcome.findings.case.distances[0].personalised.mean, abs=1e-4
    )


def test_fields_without_correspondence_have_points(config, monkeypatch, tmp_path):
    use(monkeypatch)
    case = made_up_case(0.05, corresponds=False, displaced=False)
    config["personal"]["unknowns"] = {
        name: about
        for name, about in config["personal"]["unknowns"].items()
        if name.startswith(("E_f", "shift"))
    }
    np.savez(tmp_path / "fields.npz", **fields_of(personalise_case(case, personalising(config))))
    fields = read_case_fields(tmp_path / "fields.npz")
    assert fields.observed is None
    assert fields.distance_fitted is None
    assert set(fields.observed_points) == {"closed", "late"}


def test_a_case_must_be_given(run):
    status, _, err = run("experiment=own_valve")
    assert status == 2
    assert "case is not given; expected case=FOLDER" in err
    status, _, err = run("experiment=own_valve", "case=nowhere")
    assert status == 2
    assert "nowhere: no such folder" in err


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("personal.mesh.source=voxels", "mesh source 'voxels'"),
        ("personal.tolerance=0", "tolerance"),
    ],
)
def test_settings_that_are_none_are_refused(run, folder, override, message):
    status, _, err = run(*OWN, f"case={folder}", override)
    assert status == 2
    assert message in err
    assert err.startswith("error: ")


def test_an_unknown_treatment_names_the_known_ones(config):
    config["personal"]["unknowns"]["shift.x"]["treatment"] = "guessed"
    with pytest.raises(
        ConfigurationError,
        match=r"shift\.x\.treatment = 'guessed', expected one of estimated, considered, fixed",
    ):
        personalising(config)


def test_a_check_draws_the_case_and_estimates_nothing(run, folder, tmp_path, monkeypatch):
    (built,) = [use(monkeypatch)]
    monkeypatch.setattr(
        "mvest.personalisation.estimation.estimate",
        lambda *a, **k: pytest.fail("something was estimated"),
    )
    status, out, err = run(*OWN, f"case={folder}", "check=true")
    assert status == 0, err
    assert "made_up: 288 vertices" in out
    assert "leaflets anterior, posterior" in out
    assert "frame late (held_out) at 0.4 s, 70 mmHg, 288 vertices, same vertices" in out
    assert "In order; drawn in" in out
    written = {path.name for path in (tmp_path / "outputs").rglob("*") if path.is_file()}
    assert {name for name in written if not name.startswith(".")} == {"case.png", "case.pdf"}
    # One valve is closed, at the prior's means; the values that were seen play no part.
    (model,) = built
    for at in model.calls:
        assert at == pytest.approx([6.23, 2.09, 1.0, 1.0, 1.0])
    assert "864 numbers of closed; 0.3 mm of noise stated, correlated over 8 mm" in out
    assert "No estimation was run." in out
    # The same valve goes on to further pressures, for what several frames would tell.
    assert [s.pressure_mmHg for s in model.states] == pytest.approx([87.5, 75.0, 62.5, 50.0])
    assert "closed frames like this one under 100, 87.5, 75, 62.5, 50 mmHg" in out
    # The formula's belly is pressure over stiffness, and its other parts tell the pressure.
    rows = {line.split()[0]: line.split() for line in out.splitlines() if line.strip()}
    for name in model.names:
        assert rows[name][0] == name


def test_a_study_without_data_cannot_be_checked(run):
    status, _, err = run("experiment=closure", "check=true")
    assert status == 2
    assert "experiment closure: check=true has nothing to say of a study of the kind closure" in err
    expected = "case, chord, cycle, external, joint, patch, patient, twin, volume"
    assert f"expected one of {expected}" in err


def test_a_check_is_no_part_of_the_result(folder):
    plainly = composed(*OWN, f"case={folder}")
    checked = composed(*OWN, f"case={folder}", "check=true")
    assert hash_of(plainly) == hash_of(checked)
    other = composed(*OWN, f"case={folder}", "personal.confirm=false")
    assert hash_of(plainly) != hash_of(other)


def stiffening() -> dict[str, Any]:
    """The configuration of tissue that stiffens."""
    return plain(composed(*OWN, "personal=stiffening"))


def test_tissue_whose_stiffening_is_unknown_is_on_its_way_to_the_law_that_is_considered() -> None:
    settings = personalising(stiffening())
    assert settings.considered_law == {}
    for region, tissue in settings.mechanics.tissue.items():
        assert tissue.law == "stiffening"
        assert tissue.exponential is not None
        assert f"stiffening.{region}" in [u.name for u in settings.unknowns]
    known = personalising(plain(composed(*OWN, "personal=renewed")))
    assert {tissue.law for tissue in known.mechanics.tissue.values()} == {"biot"}
    assert known.considered_law == {
        region: tissue.exponential for region, tissue in settings.mechanics.tissue.items()
    }
    values = stiffening()
    del values["personal"]["unknowns"]["stiffening.posterior"]
    one = personalising(values)
    assert list(one.considered_law) == ["posterior"]
    assert one.mechanics.tissue["posterior"].law == "biot"


def test_stiffening_of_what_cannot_stiffen_is_refused() -> None:
    values = stiffening()
    del values["personal"]["considered_law"]["anterior"]
    with pytest.raises(ConfigurationError, match=r"considered_law\.anterior is missing"):
        personalising(values)
    values = stiffening()
    unknowns = values["personal"]["unknowns"]
    unknowns["stiffening.septal"] = unknowns["stiffening.anterior"]
    with pytest.raises(ConfigurationError, match="septal has no tissue"):
        personalising(values)
    values = stiffening()
    values["mechanics"]["tissue"]["anterior"]["law"] = "corotational"
    with pytest.raises(ConfigurationError, match="anterior follows the corotational law"):
        personalising(values)
