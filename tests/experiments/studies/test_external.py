"""One's own program from configuration to an estimate, and what is said where it cannot be."""

import sys

import numpy as np
import pytest

from experiments.common.records.record import read_record
from experiments.studies.external.findings import Findings
from mvest.external import write_points
from tests.external.programs import SPRINGS, springs

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
        "external.folder": "kept",
        "tracking.enabled": "false",
        "hydra.run.dir": "here",
    }

    def call(*without: str, **changed: str):
        given = {key: value for key, value in settings.items() if key not in without} | changed
        words = [f"{key}={value}" for key, value in given.items()]
        return run(*words) if "command" in without else run(command, *words)

    return call


def test_a_program_s_parameters_are_estimated_from_a_file(run, tmp_path):
    status, out, err = run()
    assert status == 0, err
    record = read_record(tmp_path / "here" / "result.json", Findings)
    # Data without noise; the prior's weight is that of 0.01 mm against 3 N/mm, about 1e-3.
    np.testing.assert_allclose(record.findings.estimate, M, rtol=2e-3)
    # The covariance of least squares, from the derivatives by hand.
    _, H = springs(*M)
    np.testing.assert_allclose(
        record.findings.std, NOISE * np.sqrt(np.diagonal(np.linalg.inv(H.T @ H))), rtol=0.02
    )
    program = record.findings.program
    assert program.runs == 5 * record.forward_solves
    assert not program.own_jacobian
    names = {path.name for path in (tmp_path / "here").iterdir()}
    assert {"external.csv", "external.md", "external_iterates.png", "fitted.csv", "done"} <= names
    assert "N/mm" in out
    assert "differences of its predictions" in out
    # The runs are kept: the same study again starts no program.
    status, out, err = run()
    record = read_record(tmp_path / "here" / "result.json", Findings)
    assert (status, record.findings.program.runs) == (0, 0)
    assert record.findings.program.reused == program.runs


def test_a_program_that_was_edited_is_run_again(run, tmp_path):
    run()
    first = read_record(tmp_path / "here" / "result.json", Findings)
    # Twice as stiff springs: half the moduli explain what is observed.
    source = (tmp_path / "solve.py").read_text().replace("(p[", "(2 * p[")
    (tmp_path / "solve.py").write_text(source)
    assert run()[0] == 0
    second = read_record(tmp_path / "here" / "result.json", Findings)
    np.testing.assert_allclose(second.findings.estimate, M / 2, rtol=2e-3)
    assert second.findings.program.reused == 0
    assert second.provenance.config_hash != first.provenance.config_hash


def test_check_runs_the_program_once_and_compares_its_derivatives(run, tmp_path):
    status, out, err = run(check="true")
    assert status == 0, err
    assert "2 points" in out
    assert "derivatives: by differences" in out
    source = (tmp_path / "solve.py").read_text().replace('how == ["exact"]', "True")
    (tmp_path / "solve.py").write_text(source)
    status, out, _ = run(check="true", **{"external.reuse": "false"})
    assert "apart from differences by k1 " in out
    # A wrong sign in the program is told: 200 %.
    (tmp_path / "solve.py").write_text(source.replace("-2 / k1**2", "2 / k1**2"))
    status, out, _ = run(check="true", **{"external.reuse": "false"})
    assert "k1 2e+02 %, k2" in out


def test_a_program_that_fails_is_recorded_with_its_words(run, tmp_path):
    (tmp_path / "solve.py").write_text("import sys; sys.exit('out of licences')")
    status, _, err = run()
    assert status == 1
    record = read_record(tmp_path / "here" / "result.json", Findings)
    assert record.status == "failed"
    assert "out of licences" in record.detail
    assert record.findings.estimate is None
    assert "out of licences" in err
    status, _, err = run(check="true")
    assert status == 2
    assert "at the initial values: run-" in err


@pytest.mark.parametrize(
    ("without", "changed", "message"),
    [
        (["command"], {}, "external.command is not given"),
        (["external.observation"], {}, "external.observation is not given"),
        ([], {"external.observation": "absent.csv"}, "absent.csv is missing"),
        (["external.prior_std"], {}, "external.prior_std = []"),
        ([], {"external.prior_std": "[1.0,-1.0]"}, "one standard deviation > 0"),
        (["external.noise_mm"], {}, "external.noise_mm = None"),
        ([], {"external.noise_mm": "0"}, "expected a number > 0 (mm)"),
        ([], {"filter.R": "0.1"}, "filter.R is given; expected external.noise_mm"),
        ([], {"filter.initial": "[1.0]"}, "filter.initial has 1 values"),
        ([], {"filter.initial": "[-1.0,1.0]"}, "must be positive"),
        ([], {"external.units": "[N/mm]"}, "external.units"),
        ([], {"external.differences": "exact"}, "central, forward"),
        ([], {"external.comand": "[a]"}, "did you mean command?"),
        ([], {"external.inputs": "[mesh.vtk]"}, "cannot read mesh.vtk"),
    ],
)
def test_a_wrong_request_is_told_in_one_line(run, without, changed, message):
    status, _, err = run(*without, **changed)
    assert status == 2
    assert message in err
    assert len(err.strip().splitlines()) == 1
