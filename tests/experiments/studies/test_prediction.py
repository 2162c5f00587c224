"""The prediction study on a valve that stretches instead of closing: record, tables and failures.

A stretch known in closed form replaces the mechanics; tests/scenarios checks real closures.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from experiments.common.records.record import read_record
from experiments.common.study import Results
from experiments.studies import prediction
from experiments.studies.prediction import PREDICTED
from mvest.closure.continuation import ClosedState
from mvest.closure.model import ClosureModel
from mvest.mechanics.steps import StepReason
from mvest.mechanics.valve_system import build_system

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

    def call(*arguments):
        status, _, folder, said = run_here(*SMALL, *arguments)
        file = folder / "result.json"
        return status, read_record(file) if file.is_file() else None, folder, said

    return call


TITLES = ["as observed", "160 mmHg", "ring −20 % AP", "clip at A2–P2", "ring −10 % and clip"]


def test_the_study_predicts_every_scenario_and_compares_with_the_truth(run):
    status, record, _folder, said = run()
    assert status == 0, said.err
    rows = record.table_of().rows
    assert list(dict.fromkeys(row["scenario"] for row in rows)) == TITLES
    assert [row["samples"] for row in rows] == [4] * 70 + [2] * 70
    assert {row["measure"] for row in rows} >= PREDICTED.keys()
    for row in rows:
        assert row["low"] <= row["mean"] <= row["high"]
        assert row["inside_own_mesh"] == (row["low"] <= row["truth_own_mesh"] <= row["high"])
        # Nothing is narrower for including the mesh's error.
        assert row["wide_low"] <= row["low"] <= row["high"] <= row["wide_high"]
        if row["mesh_error"] > 1e-3 * abs(row["estimate"]):
            assert row["wide_high"] > row["high"]
    found = {(row["scenario"], row["measure"]): row for row in rows if row["patient"] == 1}
    # The same stretch on either mesh: the truth is one, but its stress has other sample points.
    own = found["as observed", "ap_diameter_mm"]
    assert own["truth_own_mesh"] == pytest.approx(own["truth_same_mesh"], rel=1e-3)
    # 160 in place of 120 mmHg: a third more stretch of y and as much of its logarithm's spread.
    more = found["160 mmHg", "ap_diameter_mm"]
    assert more["std"] == pytest.approx(4 / 3 * own["std"], rel=1e-3)
    assert more["estimate"] > own["estimate"]
    # The truth was drawn about the configured values, and is another for each patient.
    truths = np.array([[one.truth for one in e.unknowns[:3]] for e in record.estimates])
    assert np.all(np.abs(np.log(truths / [6.23, 2.09, 1.0])) < [0.8, 0.8, 0.04])
    assert not np.any(truths[0] == truths[1])
    for estimate in record.estimates:
        for one in estimate.unknowns[:3]:
            assert 0 < abs(one.estimate - one.truth) < 4 * one.std
    assert record.numbers["samples"] == 30
    assert len(record.table_of("not_closed")) == 0


def test_samples_that_fail_are_stated(run, monkeypatch):
    def sometimes(self, m, **settings):
        fails = self.ties is not None and self.mesh.elements.shape[0] == 24
        return (buckled if fails else stretched)(self, m, **settings)

    monkeypatch.setattr(ClosureModel, "close", sometimes)
    status, record, folder, _ = run("prediction.patients=1", "prediction.check_mesh=[]")
    assert status == 0
    # Without a check of the mesh the intervals are those of the samples.
    assert {row["wide_low"] for row in record.table_of().rows} == {None}
    failed = [row for row in record.table_of("not_closed").rows if row["scenario"] == TITLES[3]]
    assert [(row["valve"], row["count"]) for row in failed] == [
        ("at the estimate", 1),
        ("sample", 4),
    ]
    assert {row["reason"] for row in failed} == {StepReason.SINGULAR.value}
    assert not [row for row in record.table_of().rows if row["scenario"] == TITLES[3]]
    assert record.numbers["samples_not_closed"] == 8
    prediction.figure(Results({"prediction": record}, {"prediction": folder / "fields.npz"}))


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("prediction.samples=24", "prediction.samples = 24, expected a power of two"),
        ("prediction.scenarios.both.clip.width_mm=-1", "clip.width_mm = -1, expected 0 to"),
    ],
)
def test_inadmissible_settings_are_refused(run, override, message):
    status, record, _, said = run(override)
    assert status == 2
    assert record is None
    assert message in said.err
