"""External programs and functions of a file, from configuration to an estimate."""

import sys

import numpy as np
import pytest

from experiments.common.records.record import read_record
from experiments.common.study import Job
from experiments.studies.external import STUDY, ExternalSettings, ModelSettings
from mvest.exchange.external.contract import write_points
from tests.exchange.external.programs import SPRINGS, springs
from tests.experiments.configured import composed, plain

M = np.array([0.8, 2.5])
NOISE = 0.01


@pytest.fixture
def run(run, tmp_path):
    """Run the application in an empty folder with the program and its observation."""
    (tmp_path / "solve.py").write_text(SPRINGS)
    write_points(tmp_path / "observed.csv", springs(*M)[0].reshape(-1, 3))
    command = (
        f'external.command=["{sys.executable}","-S","{{here}}/solve.py","{{request}}","{{folder}}"]'
    )
    settings = {
        "experiment": "external",
        "parameters": "[k1,k2]",
        "filter.initial": "[2.0,1.0]",
        "external.prior_std": "[3.0,3.0]",
        "external.noise_mm": str(NOISE),
        "external.units": "[N/mm,N/mm]",
        "external.observation": "observed.csv",
        "external.folder": "cached",
        "tracking.enabled": "false",
        "hydra.run.dir": "here",
    }

    def call(*without: str, **changed: str):
        given = {key: value for key, value in settings.items() if key not in without} | changed
        words = [f"{key}={value}" for key, value in given.items()]
        return run(*words) if "command" in without else run(command, *words)

    return call


def test_a_program_s_parameters_are_estimated_from_a_file(run, tmp_path):
    status, _, err = run()
    assert status == 0, err
    record = read_record(tmp_path / "here" / "result.json")
    (found,) = record.estimates
    # Data without noise; the prior's weight is that of 0.01 mm against 3 N/mm, about 1e-3.
    np.testing.assert_allclose([one.estimate for one in found.unknowns], M, rtol=2e-3)
    # The covariance of least squares, from the derivatives by hand.
    _, H = springs(*M)
    expected = NOISE * np.sqrt(np.diagonal(np.linalg.inv(H.T @ H)))
    np.testing.assert_allclose([one.std for one in found.unknowns], expected, rtol=0.02)
    rows = record.table_of().rows
    assert [row["unit"] for row in rows] == ["N/mm", "N/mm"]
    assert rows[0]["runs"] == 5 * record.forward_solves
    # The same study again starts no program, until the program changes.
    assert run()[0] == 0
    assert read_record(tmp_path / "here" / "result.json").table_of().rows[0]["runs"] == 0
    with (tmp_path / "solve.py").open("a") as program:
        program.write("# changed\n")
    assert run()[0] == 0
    assert read_record(tmp_path / "here" / "result.json").table_of().rows[0]["runs"] > 0


def test_check_runs_the_program_once_and_compares_its_derivatives(run, tmp_path):
    status, out, err = run(check="true")
    assert status == 0, err
    assert "2 points" in out
    assert "derivatives: by differences" in out
    source = (tmp_path / "solve.py").read_text().replace('how == ["exact"]', "True")
    (tmp_path / "solve.py").write_text(source)
    status, out, _ = run(check="true")
    assert "differences deviate by k1 " in out
    # A wrong sign in the program: 200 %.
    (tmp_path / "solve.py").write_text(source.replace("-2 / k1**2", "2 / k1**2"))
    status, out, _ = run(check="true")
    assert "k1 2e+02 %, k2" in out


def test_a_program_that_fails_is_recorded_with_its_words(run, tmp_path):
    (tmp_path / "solve.py").write_text("import sys; sys.exit('out of licences')")
    status, _, err = run()
    assert status == 1
    record = read_record(tmp_path / "here" / "result.json")
    assert record.status == "failed"
    assert "out of licences" in record.detail
    assert [row["estimate"] for row in record.table_of().rows] == [None, None]
    assert "out of licences" in err
    status, _, err = run(check="true")
    assert status == 2
    assert "at the initial values: run-" in err


@pytest.mark.parametrize(
    ("without", "changed", "message"),
    [
        (["command"], {}, "external.command is not given"),
        ([], {"external.prior_std": "[1.0,-1.0]"}, "one standard deviation > 0"),
        ([], {"external.noise_mm": "0"}, "expected a number > 0 (mm)"),
        ([], {"filter.R": "0.1"}, "filter.R is given; expected external.noise_mm"),
        ([], {"external.differences": "exact"}, "expected central or none"),
    ],
)
def test_a_wrong_request_is_refused_in_one_line(run, without, changed, message):
    status, _, err = run(*without, **changed)
    assert status == 2
    assert message in err
    assert len(err.strip().splitlines()) == 1


MODELS = """
import numpy as np
from mvest import Prediction

t = np.arange(1.0, 7.0)


def straight(slope):
    return lambda m: Prediction(slope * t * m[0], slope * t[:, None])
"""


def test_several_models_estimate_from_what_one_of_them_predicts(tmp_path):
    (tmp_path / "models.py").write_text(MODELS)
    values = plain(composed("experiment=external", "parameters=[k]", "filter.initial=[2.0]"))
    values["truth"]["values"] = [3.0]
    straight = f"{tmp_path}/models.py:straight"
    about = ExternalSettings(
        models={
            "one": ModelSettings(python=straight),
            "other": ModelSettings(python=straight, settings={"slope": 2.0}),
        },
        settings={"slope": 1.0},
        data=("one",),
        prior_std=(3.0,),
        noise_mm=0.01,
    )
    result = STUDY.run(Job(values, about, tmp_path))
    (one,), (other,) = (record.unknowns for record in result.estimates)
    # Errors of 0.01 mm, seen.
    assert one.estimate != 3.0
    assert one.estimate == pytest.approx(3.0, abs=4 * one.std)
    assert one.truth == 3.0
    assert other.estimate == pytest.approx(one.estimate / 2, rel=1e-4)
    assert "runs" not in result.table_of().rows[1]
