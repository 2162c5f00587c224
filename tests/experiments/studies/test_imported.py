"""Valves from outside, on a small made-up recording and a made-up heart, and without any."""

import sys
from pathlib import Path

import numpy as np
import pytest

from experiments.common.records.record import read_record
from experiments.common.schema import build
from experiments.run import main
from experiments.studies.imported import DonorSettings, recorded_valve
from mvest.closure.robustness import GateReport, GateRow
from mvest.problem.record import EstimateRecord, Unknown
from mvest.valve.mesh.solid_mesh import embed
from tests.exchange.importing.made_up_heart import heart
from tests.exchange.surfaces.recorded import CASE, NAMES, skirt, write
from tests.experiments.configured import composed, plain

TRUTH = np.array([2.0, 1.0, 3.0])
SMALL = [
    "experiment=donor",
    f"donor.case={CASE}",
    f"donor.annulus={NAMES['annulus']}",
    f"donor.free_edge={NAMES['free_edge']}",
    *(f"donor.leaflets.{region}={name}" for region, name in NAMES["leaflets"].items()),
    "donor.vertices=70",
    "donor.contact_vertices=336",
    "donor.starts=[[3,1,2]]",
    "filter.initial=[1.5,1.5,1.5]",
    "filter.P0=2.25",
    "filter.R=1e-8",
    "filter.method.tolerance=1e-3",
    "mechanics.protocol.dt=0.5",
    "mechanics.protocol.end=1.0",
    "mechanics.newton.tolerance=1e-8",
]
"""Sucked outwards, so that nothing touches or buckles; the annulus narrows by a tenth."""

SMALL_HEART = [
    "experiment=reference_heart",
    "mesh.edge_length=4.0",
    "mechanics.contact_points.columns=72",
    "mechanics.contact_points.rows=16",
    "heart.closed_depth=0.75",  # the template's
    "heart.smoothing_mm=1.0",
    "mesh=coarse",
    "observation.columns=40",
    "observation.rows=10",
    "tracking.enabled=false",
]


def made_up_recording(folder: Path) -> str:
    """A skirt whose last frame is our own closure with the moduli ``TRUTH``."""
    data = skirt()
    write(folder, data)
    place = f"donor.recording={folder}"
    config = plain(composed(*SMALL, place))
    valve = recorded_valve(config, build(DonorSettings, config["donor"]))
    model = valve.model(tuple(config["parameters"]))
    closed = model.close(TRUTH, sensitivities=False).simulation
    assert closed.converged
    fine = valve.recording.valve.surface.vertices
    free = np.setdiff1d(np.arange(len(fine)), valve.recording.valve.annulus)
    positions = embed(valve.mesh, fine)(closed.frames[-1])
    data["frames"][-1, free] = positions[free]
    write(folder, data)
    return place


def test_a_recorded_valve_end_to_end(run, tmp_path: Path) -> None:
    place = made_up_recording(tmp_path)
    status, _, err = run(*SMALL, place, "hydra.run.dir=here", "paths.results=published")
    assert status == 0, err
    assert "tricuspid" in (tmp_path / "here" / "donor.md").read_text()
    record = read_record(tmp_path / "here" / "result.json")
    assert record.status == "converged"
    rows = record.table_of().rows
    assert [row["closure"] for row in rows] == ["generic", "fitted, start 1"]
    # The recording is ours, but interpolated on other triangles than the mesh is made of.
    for row, found in zip(rows[1:], record.estimates, strict=True):
        estimate = [one.estimate for one in found.moduli]
        # Nothing is known of the tissue but what is estimated.
        assert all(one.truth is None for one in found.unknowns)
        assert estimate == pytest.approx(TRUTH, rel=0.1)
        assert row["mean"] < 0.5 * rows[0]["mean"]
    # Overrides keep a run out of the results.
    assert not (tmp_path / "published").exists()


def test_an_absent_recording_is_one_clear_line(run, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("MVEST_TRIVALVE", str(tmp_path / "nowhere"))
    status, out, err = run("experiment=donor")
    assert (status, out) == (2, "")
    assert len(err.strip().splitlines()) == 1
    assert err.startswith("error: donor.recording = ")
    assert "there is no folder" in err
    assert "conf/experiment/donor.yaml" in err


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("filter=paper", "needs the iterated filter"),
        ("mechanics.element=hex18", "layers of 'hex18'"),
        ("donor.annulus=Rand", "no node set 'Rand'; there are ALL"),
    ],
)
def test_wrong_requests(run, tmp_path: Path, override: str, words: str) -> None:
    write(tmp_path, skirt())
    settings = [word for word in SMALL if "tolerance" not in word or "newton" in word]
    status, _, err = run(*settings, f"donor.recording={tmp_path}", override)
    assert status == 2
    assert words in err


def gate_of_made_up(values):
    """What the gate would say; asking it is `tests.closure.test_robustness`'s."""
    rows = [GateRow("reference", 0.0, 0.0, True, "converged")]
    rows += [GateRow("perturbed start", 0.1, 0.7, False, "converged")]
    return GateReport(tuple(rows))


def twin_of_made_up(values, name, changes):
    """What a twin would give; estimating is the twin study's."""
    assert values["valve"]["folder"]
    unknown = Unknown(name="E_f.anterior", unit="MPa", estimate=6.3, std=0.1, truth=6.0)
    return EstimateRecord(case=name, status="converged", reason="converged", unknowns=(unknown,))


def run_heart(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["experiments.run", *arguments])
    return main()


@pytest.mark.slow
def test_the_shape_is_meshed_and_closed(tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.studies.imported.gate_report", gate_of_made_up)
    monkeypatch.setattr("experiments.studies.imported._twin", twin_of_made_up)
    monkeypatch.setenv("MVEST_HRA", str(heart(tmp_path / "heart")))
    monkeypatch.chdir(tmp_path)
    assert run_heart(monkeypatch, *SMALL_HEART) == 0
    (file,) = tmp_path.glob("outputs/reference_heart/*/result.json")
    record = read_record(file)
    opened, closed = record.table_of().rows
    assert closed["orifice"] < 0.2 * opened["orifice"]
    gate = record.table_of("gate").rows
    assert [row["variation"] for row in gate] == ["reference", "perturbed start"]
    assert record.numbers["passed"] is False
    assert record.gate.startswith("NOT passed")
    assert record.table_of("moduli").rows[0]["relative_error"] == pytest.approx(0.05)
    assert list(file.parent.glob("*.png"))
