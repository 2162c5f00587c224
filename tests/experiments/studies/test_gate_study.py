"""The studies of the forward model, in a size that takes seconds: configuration, record, tables."""

import numpy as np
import pytest

from experiments.common.building.closure import closure_model
from mvest.closure.model import ClosureModel
from mvest.closure.robustness import GATE_CASES, GateCase
from mvest.estimation import Prediction
from tests.experiments.configured import composed, plain

SMALL = (
    "mesh.columns=12",
    "mesh.rows=2",
    "observation.columns=16",
    "observation.rows=5",
    "mechanics.contact_points.columns=24",
    "mechanics.contact_points.rows=6",
    "mechanics.protocol.pressure_mmHg=5",
    "mechanics.protocol.ramp=0.1",
    "mechanics.protocol.dt=0.1",
    "mechanics.protocol.end=0.1",
    "mechanics.protocol.equilibrium=false",
    "tracking.enabled=false",
)
ONE = ("hydra.mode=RUN",)
"""One anatomy, not all."""


@pytest.fixture
def run(run_here):
    return lambda *arguments: run_here(*SMALL, *arguments)


def test_each_case_changes_its_own_setting_only():
    config = plain(composed("experiment=gate", "mesh.columns=12", "mesh.rows=2"))
    base = closure_model(config)

    def described(model: ClosureModel) -> dict:
        settings = model.settings
        return {
            "dt": settings.protocol.dt,
            "ramp": settings.protocol.ramp,
            "converged_path": settings.newton.path_tolerance,
            "activation": settings.contact.activation_distance,
            "sampling": len(model.contact_valve.surface.vertices),
            "mesh": model.mesh.sha256,
            "guided": model.guide is not None,
            "perturbed": None if model.perturbation is None else float(model.perturbation.sum()),
            "start": model.continuation,
            "rest": (settings.tissue, settings.damping, model.names, model.anchors),
            "observed": model.valve.surface.vertices.shape,
        }

    reference = described(base)
    changed = {}
    for case in GATE_CASES:
        varied = described(closure_model(config, case))
        changed[case.name] = {k for k, v in varied.items() if v != reference[k]}
    unchanged = GateCase("x")
    for case in GATE_CASES:
        asked = {k for k in unchanged.__slots__ if getattr(case, k) != getattr(unchanged, k)} - {
            "name"
        }
        # No mesh is coarser than that of 24 x 3 cells which guides are on.
        assert changed[case.name] == asked - {"guided"}
    (finer,) = (closure_model(config, c).mesh for c in GATE_CASES if c.mesh != 1)
    assert len(finer.elements) == 18 * 3
    (guided,) = (c for c in GATE_CASES if c.guided)
    usual = plain(composed("experiment=gate"))
    assert closure_model(usual).guide is None
    assert len(closure_model(usual, guided).guide.mesh.elements) < 54 * 6
    assert closure_model(config, GATE_CASES[0]).settings.protocol.dt == pytest.approx(
        0.5 * reference["dt"]
    )


def test_the_gate_study_records_every_case(run):
    status, record, folder, said = run("experiment=gate", *ONE, "valve=half_open")
    assert status == 0
    found = record["findings"]
    assert record["status"] == "converged"
    assert record["row"] == "half_open"
    assert len(found["rows"]) == 1 + len(GATE_CASES)
    assert [path["along"] for path in found["paths"]] == ["E_f", "E_f.anterior", "E_f.posterior"]
    # No contact and little load: nothing jumps, and no piece is halved.
    assert all(path["passed"] for path in found["paths"])
    assert record["forward_solves"] == 1 + len(GATE_CASES) + 4 + 2 + 2
    assert [row["case"] for row in found["rows"]] == [
        "reference",
        *(c.name for c in GATE_CASES),
    ]
    assert found["limits"] == {
        "mean_mm": 0.1, "max_mm": 0.5, "jump_mm": 0.1, "seen_mm": 0.02, "share": 0.05, "side": 0.2,
    }  # fmt: skip
    assert isinstance(found["passed"], bool)
    assert 0 < found["paths"][0]["unexplained_mm"] < 0.1
    # The valve has hardly begun to close.
    assert found["gap_mm2"] > 10
    assert found["passing_ball_mm"] > 1
    names = {path.name for path in folder.iterdir()}
    assert {"gate.csv", "gate.md", "result.json", "config.json"} <= names
    for case in GATE_CASES:
        assert case.name.replace(" %", "") in (folder / "gate.csv").read_text()
        assert f"{case.name}: mean" in said.err
    assert "reference" in said.out


def test_a_reference_that_does_not_close_is_recorded_as_a_failure(run, monkeypatch):
    monkeypatch.setattr(ClosureModel, "__call__", lambda self, m: Prediction.failed("it buckled"))
    status, record, _, said = run("experiment=gate", *ONE)
    assert status == 1
    found = record["findings"]
    assert (record["status"], record["reason"]) == ("failed", "it buckled")
    assert found["passed"] is False
    assert len(found["rows"]) == 1
    assert found["gap_mm2"] is None
    assert "it buckled" in said.err


def test_a_case_that_does_not_close_has_no_distance(run, monkeypatch):
    true = ClosureModel.__call__

    def sometimes(self, m):
        return Prediction.failed("it buckled") if len(self.mesh.elements) > 24 else true(self, m)

    monkeypatch.setattr(ClosureModel, "__call__", sometimes)
    status, record, _, _ = run("experiment=gate", *ONE)
    assert status == 0
    found = record["findings"]
    row = {row["case"]: row for row in found["rows"]}["mesh x 1.5"]
    assert row["mean_mm"] is None
    assert (row["passed"], row["reason"]) == (False, "it buckled")
    assert found["passed"] is False


def test_the_closure_study_measures_every_step(run):
    status, record, folder, _ = run(
        "experiment=closure", "mechanics.protocol.end=0.2", "mechanics.protocol.growth=1"
    )
    assert status == 0
    found = record["findings"]
    rows = found["rows"]
    assert [row["time"] for row in rows] == pytest.approx([0.0, 0.1, 0.2])
    assert [row["pressure_mmhg"] for row in rows] == pytest.approx([0.0, 5.0, 5.0])
    assert all(row["intersections"] == 0 for row in rows)
    assert rows[0]["orifice_mm2"] > rows[-1]["orifice_mm2"] > 0
    # Drawn is the thick leaflets' closed surface: both faces of 16 x 5 vertices, 2 x 128 triangles,
    # and two rims of 2 x 16.
    with np.load(folder / "fields.npz") as fields:
        assert fields["frames"].shape == (3, 160, 3)
        assert fields["triangles"].shape == (2 * 128 + 2 * 32, 3)
        assert fields["region"].shape == fields["triangles"].shape[:1]
        assert np.isfinite(fields["frames"]).all()
        # Contact acts within two thicknesses of midsurfaces, one of faces: that of the free edge.
        assert 0.5 < fields["reach_mm"] < 1.32
    names = {path.name for path in folder.iterdir()}
    assert {"closure.csv", "closure.md", "closure.png", "closure.pdf"} <= names
