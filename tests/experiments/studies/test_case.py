"""A case from the command line: its settings, its record, and what is refused."""

import re
from dataclasses import replace

import numpy as np
import pytest

from experiments.common.cases.own_case import PersonalSettings, settings_of
from experiments.common.records.record import NOT_GATED, read_record, stamp, write_record
from experiments.common.schema import build
from experiments.common.study import Job
from experiments.studies.case import STUDY, Settings
from mvest.cases.case import ErrorSamples
from mvest.cases.folder import write_case
from mvest.closure.robustness import GateReport, GateRow
from mvest.errors import InputError
from mvest.personalisation import default_settings, design
from mvest.problem.verdict import ONE_STATE
from tests.experiments.configured import composed, plain
from tests.made_up_closure import made_up_case, use

OWN = ("experiment=own_valve", "figures=false")


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


def result_of(values, folder):
    return STUDY.run(Job(values, build(Settings, values), folder))


@pytest.fixture
def unmeasured(monkeypatch):
    """Measuring a shape takes a second, and is tested elsewhere."""
    monkeypatch.setattr("mvest.personalisation.record.clinical_measurements", lambda *arguments: {})


def test_settings_are_those_of_the_configuration(config):
    settings = personalising(config)
    about = {unknown.name: unknown for unknown in settings.unknowns}
    assert list(about)[:2] == ["E_f.anterior", "E_f.posterior"]
    assert (about["E_f.anterior"].mean, about["E_f.anterior"].std) == (6.23, 3.1)
    assert not any(u.fixed for u in settings.unknowns)
    given = plain(composed(*OWN, "personal=imaged", "personal.tolerance=0.03"))
    given["personal"]["paper"] = {"P0": 1.0, "Q": 0.1, "R": 0.25, "max_iterations": 3}
    settings = personalising(given)
    fixed = {u.name for u in settings.unknowns if u.fixed}
    assert "turn.x" in fixed
    assert "E_f.posterior" not in fixed
    assert (settings.tolerance, settings.paper.R) == (0.03, 0.25)


def test_settings_without_a_configuration_are_those_of_the_commands():
    case = made_up_case(0.3, 8.0)
    assert default_settings(case) == personalising(plain(composed("experiment=own_valve")))
    samples = np.zeros((4, len(case.frames), 288, 3)), np.zeros((4, len(case.frames), 2, 3))
    imaged = replace(case, error_samples=ErrorSamples(*samples))
    values = plain(composed("experiment=volume"))
    given, expected = default_settings(imaged), personalising(values)
    # A factor on how well errors of no size are known means nothing.
    assert given == expected


def test_a_run_is_recorded_and_reported(config, monkeypatch, tmp_path, unmeasured):
    use(monkeypatch)
    result = result_of(config, tmp_path)
    assert (result.status, result.row, result.gate) == ("converged", "made_up", NOT_GATED)
    # What the case is and not what the configuration of other studies says.
    assert result.parameters == ("E_f.anterior", "E_f.posterior")
    assert (result.model.filter, result.model.noise_mm) == ("iterated", 0.3)
    record = stamp({**config, "parameters": ["E_f.somewhere"]}, "hash", result, 0.0)
    assert record.parameters == ("E_f.anterior", "E_f.posterior")
    write_record(tmp_path / "record.json", record, result.arrays)
    back = read_record(tmp_path / "record.json")
    assert back.estimates == result.estimates
    assert ONE_STATE in back.estimates[0].verdict.missing
    names = {path.name for path in STUDY.files(tmp_path, back)}
    assert {"unknowns.csv", "report.html", "figure3.png", "estimates.png"} <= names
    assert back.table_of("frames").rows[0]["frame"] == "closed"
    # The verdict comes first.
    assert STUDY.words(back).startswith("made_up: ")
    assert STUDY.words(back).index("checks passed") < STUDY.words(back).index("E_f anterior")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "case is not given; expected case=FOLDER"),
        (("case=nowhere",), "nowhere: no such folder"),
        (("case=nowhere", "personal.tolerance=0"), "tolerance"),
    ],
)
def test_a_wrong_request_is_refused(run, arguments, message):
    status, _, err = run(*OWN, *arguments)
    assert status == 2
    assert message in err
    assert err.startswith("error: ")


def test_a_check_draws_the_case_and_estimates_nothing(run, folder, tmp_path, monkeypatch):
    built = use(monkeypatch)
    monkeypatch.setattr("experiments.common.cases.own_case.build_coarse", design.build_coarse)
    monkeypatch.setattr(
        "mvest.personalisation.estimation.estimate",
        lambda *a, **k: pytest.fail("something was estimated"),
    )
    rows = (
        GateRow("reference", 0.0, 0.0, True, "converged"),
        GateRow("perturbed start", 0.2, 1.5, False, "converged"),
    )
    monkeypatch.setattr("experiments.common.cases.own_case.gate_case", lambda *_: GateReport(rows))
    status, out, err = run(*OWN, f"case={folder}", "check=true", "gate=true")
    assert status == 0, err
    assert "288 vertices" in out
    assert "leaflets anterior, posterior" in out
    assert "frame late (held_out) at 0.4 s, 70 mmHg, 288 vertices, same vertices" in out
    assert "In order" in out
    written = {path.name for path in (tmp_path / "outputs").rglob("*") if path.is_file()}
    assert {name for name in written if not name.startswith(".")} == {"case.png", "check.html"}
    # One valve is closed, at the prior's means; the values that were seen play no part.
    (model,) = built
    for at in model.calls:
        assert at == pytest.approx([6.23, 2.09, 1.0, 1.0, 1.0])
    (page,) = (tmp_path / "outputs").rglob("check.html")
    for text in (out, page.read_text()):
        assert "gate NOT passed: the closed state is not unique" in text
        assert re.search("perturbed start +0.2 +1.5 +no", text)
        assert "E_f anterior" in text
        assert "pressure measured to ±3 mmHg" in text
        assert "all that can be measured, known exactly" in text
        # The formula has no tissue, so nothing is known but the open frame.
        assert "the open frame, since no valve was closed" in text
        assert "open orifice" in text
        assert "membrane strain" not in text


def test_tissue_whose_stiffening_is_unknown_is_on_its_way_to_the_law_that_is_considered() -> None:
    settings = personalising(plain(composed(*OWN, "personal=stiffening")))
    assert settings.nuisance_law == {}
    for region, tissue in settings.mechanics.tissue.items():
        assert tissue.law == "stiffening"
        assert tissue.exponential is not None
        assert f"stiffening.{region}" in [u.name for u in settings.unknowns]
    values = plain(composed(*OWN, "personal=stiffening"))
    del values["personal"]["unknowns"]["stiffening.posterior"]
    one = personalising(values)
    assert list(one.nuisance_law) == ["posterior"]
    assert one.mechanics.tissue["posterior"].law == "biot"


def test_stiffening_of_what_cannot_stiffen_is_refused() -> None:
    values = plain(composed(*OWN, "personal=stiffening"))
    del values["personal"]["nuisance_law"]["anterior"]
    with pytest.raises(InputError, match=r"nuisance_law\.anterior is missing"):
        personalising(values)
    values = plain(composed(*OWN, "personal=stiffening"))
    values["mechanics"]["tissue"]["anterior"]["law"] = "corotational"
    with pytest.raises(InputError, match="anterior follows the corotational law"):
        personalising(values)
