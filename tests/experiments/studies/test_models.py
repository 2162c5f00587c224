"""The study of the sheet in two codes, in a size that takes seconds: record, tables, figure."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from experiments.common.records.record import read_record
from experiments.run import main
from experiments.studies.models.findings import Findings
from experiments.studies.models.report import models_text
from experiments.studies.models.study import OTHER_LAW, OWN, PROGRAM, PROGRAM_ALONE, SECOND, STUDY
from tests.experiments.runner.logged import logged

pytest.importorskip("skfem")

SMALL = (
    "experiment=models",
    "models.sheet.cells=[2,1]",
    "models.sheet.layers=1",
    "models.sheet.observed=[2,3]",
    "models.sheet.load_steps=1",
    "models.refinements=[[2,2,1]]",
    "observation.noise_mm=0.001",
    "filter.R=1e-6",
    "filter.initial=[3.5,2.0]",
    "tracking.enabled=false",
    "hydra.run.dir=here",
)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """The study's record and folder."""
    folder = tmp_path_factory.mktemp("models")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr("experiments.common.progress.kernels_are_compiled", lambda: True)
        patch.setattr(sys, "argv", ["experiments.run", *SMALL])
        assert main() == 0
    return read_record(folder / "here" / "result.json", Findings), folder / "here"


def test_every_model_estimates_from_the_data(done):
    record, folder = done
    assert logged(folder)["failed"] == 0
    truth = record.findings.truth
    found = {(row.data, row.model): row for row in record.findings.rows}
    assert set(found) == {
        *((OWN, model) for model in (OWN, SECOND, OTHER_LAW, PROGRAM, PROGRAM_ALONE)),
        *((SECOND, model) for model in (OWN, SECOND, OTHER_LAW)),
    }
    assert all(row.converged for row in record.findings.rows)
    # Each code finds the truth in its own data, to its standard deviations; not by hard-coding: the
    # errors of 1 micrometre are seen.
    for code in (OWN, SECOND):
        row = found[code, code]
        error = (np.array(row.estimate) - truth) / np.array(row.std)
        assert np.all(np.abs(error) < 4)
        assert np.all(error != 0)
    # A program is the library behind files, and its differences are derivatives.
    second = found[OWN, SECOND].estimate
    # Another process may add up in another order.
    np.testing.assert_allclose(found[OWN, PROGRAM].estimate, second, rtol=1e-12)
    np.testing.assert_allclose(found[OWN, PROGRAM_ALONE].estimate, second, rtol=1e-3)
    assert found[OWN, PROGRAM].program_runs == found[OWN, PROGRAM].forward_solves
    alone = found[OWN, PROGRAM_ALONE]
    assert alone.program_runs == 5 * alone.forward_solves
    # Another law is another model, and gives other moduli.
    other = np.array(found[SECOND, OTHER_LAW].estimate) / truth
    assert np.abs(other - 1).max() > 0.03


def test_the_tables_and_the_figure_follow_from_the_record(done, tmp_path):
    record, folder = done
    names = {path.name for path in STUDY.write(tmp_path, {"models": record}, {})}
    assert names == {"models.csv", "models.md", "models.png", "models.pdf"}
    assert names <= {path.name for path in folder.iterdir()}
    assert (tmp_path / "models.csv").read_text() == (folder / "models.csv").read_text()
    text = models_text(record)
    assert text.count("\n| scikit-fem | ") == 3
    assert "| 2 × 2 × 1 |" in text
    nothing = models_text(
        replace(record, findings=replace(record.findings, rows=()), reason="it buckled")
    )
    assert nothing == "No estimate: it buckled."


def test_parameters_of_another_sheet_are_refused(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["experiments.run", *SMALL, "parameters=[E.edge,E.annulus]"])
    assert main() == 2
    assert "expected ['E.annulus', 'E.edge']" in capsys.readouterr().err
