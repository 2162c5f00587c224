"""The prediction study on a valve that stretches instead of closing: record, tables and failures.

In place of the mechanics there is a stretch that is known in closed form; that valves close under
scenarios is checked in tests/prediction.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.studies.prediction import study as prediction
from experiments.studies.prediction.figure import PANELS, prediction_figure
from experiments.studies.prediction.findings import Findings
from experiments.studies.prediction.report import (
    SHOWN,
    coverage,
    prediction_words,
    write_prediction,
)
from mvest.closure.model import ClosedState, ClosureModel
from mvest.mechanics.steps import StepReason
from mvest.mechanics.valve_system import build_system
from tests.experiments.runner.logged import logged

SMALL = (
    "experiment=prediction",
    "mesh.columns=12",
    "mesh.rows=2",
    "truth.columns=16",
    "truth.rows=2",
    "observation.columns=16",
    "observation.rows=5",
    "mechanics.contact_points.columns=24",
    "mechanics.contact_points.rows=6",
    "prediction.samples=4",
    "prediction.further_samples=2",
    "prediction.patients=2",
    "prediction.stress_meshes=[[12,2]]",
    "prediction.check_mesh=[20,3]",
    "guided=false",
    "figures=false",
    "tracking.enabled=false",
)

RATE = np.array([0.05, 0.05, 2.0])


def stretched(self, m, *, sensitivities=True, every_frame=False):
    """Stretches along x, y and z by the logarithms of the parameters, more under more pressure."""
    if self._system is None:
        moduli = {"E_f.anterior": 6.0, "E_f.posterior": 2.0}
        self._system = build_system(
            self.valve, self.contact_valve, self.mesh, self.settings, moduli, ties=self.ties
        )
    nodes = self.mesh.nodes
    load = self.settings.protocol.pressure_mmHg / 120.0
    x = nodes * (1 + load * RATE * np.log(m))
    derivative = np.zeros((3, *nodes.shape))
    for k in range(3):
        derivative[k, :, k] = nodes[:, k] * load * RATE[k] / m[k]
    self._closed = ClosedState(np.array(m), x)
    simulation = SimpleNamespace(
        converged=True, reason=StepReason.COMPLETED, frames=[x], sensitivities=[derivative]
    )
    return SimpleNamespace(system=self._system, simulation=simulation)


def buckled(self, m, *, sensitivities=True, every_frame=False):
    simulation = SimpleNamespace(converged=False, reason=StepReason.SINGULAR, times=[0.0])
    return SimpleNamespace(system=None, simulation=simulation)


@pytest.fixture
def run(run_here, monkeypatch):
    monkeypatch.setattr(prediction, "MEASURED_ON", (24, 7))
    monkeypatch.setattr(ClosureModel, "close", stretched)
    return lambda *arguments: run_here(*SMALL, *arguments, findings=Findings)


def test_the_study_predicts_every_scenario_and_compares_with_the_truth(run):
    status, record, folder, said = run()
    assert status == 0, said.err
    findings = record.findings
    assert [len(p.scenarios) for p in findings.patients] == [5, 5]
    patient = findings.patients[0]
    assert list(patient.scenarios) == ["observed", "pressure", "ring", "clip", "both"]
    for found in patient.scenarios.values():
        assert found.failure == found.truth_failure == ""
        assert len(found.sampled) == found.samples == 4
        for row in found.measures.values():
            assert row.low <= row.mean <= row.high
            inside = row.low <= row.truth_own_mesh <= row.high
            assert row.inside_own_mesh == inside
            # Nothing is narrower for knowing of the mesh.
            assert row.wide_low <= row.low <= row.high <= row.wide_high
            if row.mesh_error > 1e-3 * abs(row.estimate):
                assert row.wide_high > row.high
    # The same stretch on either mesh: the truth is one, but its stress has other sample points.
    row = patient.scenarios["observed"].measures["ap_diameter_mm"]
    assert row.truth_own_mesh == pytest.approx(row.truth_same_mesh, rel=1e-3)
    # 160 in place of 120 mmHg: a third more stretch of y and as much of its logarithm's spread.
    more = patient.scenarios["pressure"].measures["ap_diameter_mm"]
    assert more.first_order_std == pytest.approx(4 / 3 * row.first_order_std, rel=1e-3)
    assert more.estimate > row.estimate
    # The truth was drawn about the configured values, and is another for each patient.
    truths = np.array([p.truth for p in findings.patients])
    assert np.all(np.abs(np.log(truths / [6.23, 2.09, 1.0])) < [0.8, 0.8, 0.04])
    assert not np.any(truths[0] == truths[1])
    for one in findings.patients:
        off = np.abs(np.subtract(one.estimate, one.truth))
        assert np.all(off < 4 * np.array(one.std))
        assert np.all(off > 0)
    assert set(SHOWN) <= set(findings.measures)
    assert coverage(findings, "tenting_height_mm", "own")[1] == 10
    assert coverage(findings, "tenting_height_mm", "wide")[1] == 10

    assert logged(folder)["forward_solves"] == record.forward_solves
    assert not (folder / "prediction.png").exists()
    write_prediction(folder, {"prediction": record}, {})
    text = (folder / "prediction.md").read_text()
    assert "All 30 samples gave a closed valve." in text
    table = (folder / "prediction.csv").read_text().splitlines()
    assert len(table) == 1 + 10 * len(findings.measures)
    # Without a check nothing is said of the mesh's error, and with a failed one that it is missing.
    said = prediction_words(replace(record, findings=without_mesh_error(findings)))
    assert "not the error of the mesh" in said
    assert "truth inside |" not in said
    assert "]°, true" in said
    assert "]°" not in text
    figure = prediction_figure(findings, folder / "fields.npz")
    valves, dots = figure.subfigs
    assert [axes.get_title().split("\n")[0] for axes in valves.axes] == list(
        findings.scenarios.values()
    )
    assert [axes.get_ylabel() for axes in dots.axes] == [label for _, label in PANELS]


def without_mesh_error(findings):
    """The same of a run that asked for none."""
    unknown = {"wide_low": None, "wide_high": None, "inside_wide": None}

    def narrower(scenario):
        rows = {name: replace(row, **unknown) for name, row in scenario.measures.items()}
        return replace(scenario, measures=rows)

    patients = tuple(
        replace(one, scenarios={name: narrower(s) for name, s in one.scenarios.items()})
        for one in findings.patients
    )
    return replace(findings, check_mesh=(), patients=patients)


def test_samples_that_fail_are_told(run, monkeypatch):
    def sometimes(self, m, **settings):
        fails = self.ties is not None and self.mesh.elements.shape[0] == 24
        return (buckled if fails else stretched)(self, m, **settings)

    monkeypatch.setattr(ClosureModel, "close", sometimes)
    status, record, folder, _ = run("prediction.patients=1")
    assert status == 0
    clip = record.findings.patients[0].scenarios["clip"]
    assert clip.failure == StepReason.SINGULAR.value
    assert clip.failures == (StepReason.SINGULAR.value,) * 4
    assert clip.measures == {}
    text = prediction_words(record)
    assert f"clip at A2–P2: 4 of 4 samples ({StepReason.SINGULAR.value})" in text
    prediction_figure(record.findings, folder / "fields.npz")


def test_a_valve_that_cannot_be_simulated_is_recorded_as_a_failure(run, monkeypatch):
    monkeypatch.setattr(ClosureModel, "close", buckled)
    status, record, _, _ = run()
    assert status == 1
    assert record.status == "failed"
    assert StepReason.SINGULAR.value in record.reason
    assert "no prediction: " in prediction_words(record)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("prediction.samples=24", "prediction.samples = 24, expected a power of two"),
        ("prediction.spread=[0.1]", "prediction.spread has 1 values"),
        ("prediction.scenarios.both.clip.width_mm=-1", "clip.width_mm = -1, expected 0 to"),
        ("prediction.scenarios.both.annuloplasty.mm=2", "one of them > 0"),
    ],
)
def test_inadmissible_settings_are_refused(run, override, message):
    status, record, _, said = run(override)
    assert status == 2
    assert record is None
    assert message in said.err
