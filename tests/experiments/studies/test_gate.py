"""The gate and closure studies, and the verdicts that other studies look up."""

import json

import numpy as np
import pytest

from experiments.common.building.closure import closure_model
from experiments.common.building.gate import anatomy_digest, gate_of
from experiments.common.places import GATE_RECORDS
from experiments.common.records.record import NOT_GATED, Record, read_record, stamp
from experiments.common.study import Result, Results
from experiments.results.published import records_of, write_records
from experiments.studies.gate import STUDY
from mvest.closure.model import ClosureModel
from mvest.closure.robustness import GATE_CASES, MAX_LIMIT, MEAN_LIMIT, GateCase
from mvest.closure.smoothness import JUMP_LIMIT
from mvest.reporting.tables import table
from tests.experiments.configured import composed, plain
from tests.places import ANATOMIES

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


def settings(name, *more):
    return plain(composed("experiment=gate", f"valve={name}", *more)) | {"row": name}


def record_of(name, passed, *variations):
    """A record of the gate that says this of an anatomy."""
    values = settings(name)
    rows = [{"variation": "reference", "mean": 0.0, "max": 0.0, "passed": True}]
    rows += [{"variation": v, "mean": x, "max": x, "passed": x is not None} for v, x in variations]
    verdict = {"passed": passed, "closures": 1}
    result = Result(
        tables={"": table([verdict]), "variations": table(rows)},
        numbers={"anatomy": anatomy_digest(values), "passed": passed},
    )
    return stamp(values, "b" * 64, result, 0.0)


@pytest.fixture
def run(run_here):
    def call(*arguments):
        status, _, folder, said = run_here(*SMALL, *arguments)
        return status, read_record(folder / "result.json"), folder, said

    return call


def test_a_verdict_is_looked_up_by_the_anatomy_and_not_by_its_name(tmp_path):
    records = {"one": record_of("template", True), "two": record_of("prolapse", False)}
    (tmp_path / "records").mkdir()
    path = write_records(tmp_path, "gate", records)
    damaged = ["{", json.dumps({"record": []}), json.dumps([])]
    path.write_text("\n".join([*damaged, path.read_text()]), encoding="utf-8")
    assert gate_of(settings("template"), path) == "passed on 54 x 6 hex18"
    assert gate_of(settings("prolapse"), path) == "NOT passed on 54 x 6 hex18"
    # Whatever else is configured, the anatomy is the same; a millimetre is another one.
    assert gate_of(settings("template", "mesh.columns=40"), path).startswith("passed")
    wider = settings("template", "valve.annulus.anteroposterior_diameter=29.5")
    assert gate_of(wider, path) == NOT_GATED
    assert gate_of(settings("template"), tmp_path / "none") == NOT_GATED


def test_published_verdicts_are_of_the_anatomies_that_ship():
    results = records_of(GATE_RECORDS.parent.parent, "gate")
    assert {record.row for record in results.records.values()} == set(ANATOMIES)
    for record in results.records.values():
        assert record.numbers["anatomy"] == anatomy_digest(settings(record.row))
        rows = record.table_of("variations").rows
        assert record.numbers["passed"] == all(row["passed"] for row in rows)
        for row in rows:
            along = row["variation"].startswith("along")
            assert row["max"] <= (JUMP_LIMIT if along else MAX_LIMIT)
            assert along or row["mean"] <= MEAN_LIMIT
        # All valves close, as predictions see them; dilated and tethered leaflets do not coapt.
        measured = {row["quantity"]: row["value"] for row in record.table_of("physiology").rows}
        assert measured["closed gap"] == 0.0
        coapts = measured["coaptation height, middle section"] > 1.0
        assert coapts == (record.row != "functional_mr")


def test_each_case_changes_its_own_setting_only():
    config = plain(composed("experiment=gate", "mesh.columns=12", "mesh.rows=2"))

    def described(model: ClosureModel) -> dict:
        settings = model.settings
        return {
            "dt": settings.protocol.dt,
            "ramp": settings.protocol.ramp,
            "converged_path": settings.newton.path_tolerance,
            "activation": settings.contact.activation_distance,
            "sampling": len(model.contact_valve.surface.vertices),
            "mesh": model.mesh.sha256,
            "perturbed": None if model.perturbation is None else float(model.perturbation.sum()),
            "start": model.continuation,
            "rest": (settings.tissue, settings.damping, model.names),
        }

    reference, usual = described(closure_model(config)), GateCase("x")
    for case in GATE_CASES:
        varied = described(closure_model(config, case))
        changed = {key for key, value in varied.items() if value != reference[key]}
        slots = {k for k in usual.__slots__ if getattr(case, k) != getattr(usual, k)}
        # No mesh is coarser than that of 24 x 3 cells which guides are on.
        assert changed == slots - {"name", "guided"}


def test_the_gate_study_records_every_case(run):
    status, record, folder, said = run("experiment=gate", *ONE, "valve=normal_small")
    assert status == 0
    assert (record.status, record.row) == ("converged", "normal_small")
    rows = record.table_of("variations").rows
    names = ["reference", *(c.name for c in GATE_CASES)]
    paths = [f"along {name}" for name in ("E_f", "E_f.anterior", "E_f.posterior")]
    assert [row["variation"] for row in rows] == names + paths
    # No contact and little load: nothing jumps, and no piece is halved.
    assert all(row["passed"] for row in rows[len(names) :])
    assert record.forward_solves == 1 + len(GATE_CASES) + 4 + 2 + 2
    assert 0 < rows[len(names)]["max"] < 0.1
    (verdict,) = record.table_of().rows
    assert verdict["passed"] is record.numbers["passed"]
    assert {"gate.csv", "gate.md"} <= {path.name for path in folder.iterdir()}
    for case in GATE_CASES:
        assert f"{case.name}: max" in said.err


def test_the_closure_study_measures_every_step(run):
    status, record, folder, _ = run(
        "experiment=closure", "mechanics.protocol.end=0.2", "mechanics.protocol.growth=1"
    )
    assert status == 0
    assert isinstance(record, Record)
    rows = record.table_of().rows
    assert [row["time"] for row in rows] == pytest.approx([0.0, 0.1, 0.2])
    assert [row["pressure"] for row in rows] == pytest.approx([0.0, 5.0, 5.0])
    assert all(row["intersections"] == 0 for row in rows)
    assert rows[0]["orifice"] > rows[-1]["orifice"] > 0
    # Drawn is the thick leaflets' closed surface: both faces of 16 x 5 vertices, 2 x 128 triangles,
    # and two rims of 2 x 16.
    with np.load(folder / "fields.npz") as fields:
        assert fields["frames"].shape == (3, 160, 3)
        assert fields["triangles"].shape == (2 * 128 + 2 * 32, 3)
        assert np.isfinite(fields["frames"]).all()
        # Contact acts within two thicknesses of midsurfaces, one of faces: that of the free edge.
        assert 0.5 < fields["reach_mm"] < 1.32
    names = {path.name for path in folder.iterdir()}
    assert {"closure.csv", "closure.md", "closure.png"} <= names
    assert not names & {"closure_physiology.csv", "closure_resistance.csv"}  # not at rest


def test_a_closed_valve_stands_beside_published_ranges(run):
    status, record, folder, _ = run(
        "experiment=closure", "mechanics.protocol.equilibrium=true", "mechanics.protocol.dt=0.05"
    )
    assert status == 0
    rows = {(row["quantity"], row["part"]): row for row in record.table_of("physiology").rows}
    pull = rows["force on a papillary tip", "tip 1"]
    # At 5 mmHg the chordae bear next to nothing.
    assert 0 <= pull["value"] < 1
    assert pull["mark"] == "outside"
    shares = record.table_of("resistance").rows
    assert {row["part"] for row in shares} == {"anterior", "posterior"}
    ways = set(record.tables["resistance"]["values"]) - {"part", "of"}
    assert [sum(row[way] for way in ways) for row in shares] == pytest.approx([100.0] * 4)
    page = (folder / "closure.md").read_text(encoding="utf-8")
    assert "## physiology" in page
    assert "outside" in page


def test_published_physiology_names_the_anatomy():
    closed = {"physiology": table([{"quantity": "tenting height", "value": 5.0}])}
    records = {}
    for name in ("one", "two"):
        record = record_of("template", True)
        records[name] = record.changed(row=name, tables={**record.tables, **closed})
    shown = STUDY.summary(Results(records))
    assert [row["anatomy"] for row in shown["physiology"].rows] == ["one", "two"]
    assert "resistance" not in shown
