"""The study of the recorded donor valve, on a small made-up recording and without any."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.common.records.record import read_record
from experiments.common.schema import build
from experiments.studies.donor.findings import Findings
from experiments.studies.donor.settings import CITATION, DATA_VARIABLE, DonorSettings
from experiments.studies.donor.study import build_donor
from mvest.valve.mesh.solid_mesh import embed
from tests.experiments.configured import composed, plain
from tests.valve.io.recorded import CASE, NAMES, skirt, write

TRUTH = np.array([2.0, 1.0, 3.0])
SMALL = [
    "experiment=donor",
    f"donor.case={CASE}",
    f"donor.annulus={NAMES.annulus}",
    f"donor.free_edge={NAMES.free_edge}",
    *(f"donor.leaflets.{region}={name}" for region, name in NAMES.leaflets.items()),
    "donor.vertices=70",
    "donor.contact_vertices=336",
    "donor.starts=[[1.5,1.5,1.5],[3,1,2]]",
    "filter.initial=[1.5,1.5,1.5]",
    "filter.P0=2.25",
    "filter.R=1e-8",
    "filter.tolerance=1e-3",
    "mechanics.protocol.dt=0.5",
    "mechanics.protocol.end=1.0",
    "mechanics.newton.tolerance=1e-8",
]
"""Sucked outwards, so that nothing touches or buckles; the annulus narrows by a tenth."""


def made_up_recording(folder: Path) -> str:
    """A skirt whose last frame is our own closure with the moduli ``TRUTH``."""
    data = skirt()
    write(folder, data)
    place = f"donor.recording={folder}"
    config = plain(composed(*SMALL, place))
    study = build_donor(config, build(DonorSettings, config["donor"]))
    closed = study.model().close(TRUTH, sensitivities=False).simulation
    assert closed.converged
    fine = study.recording.surface.vertices
    free = np.setdiff1d(np.arange(len(fine)), study.recording.annulus)
    positions = embed(study.mesh, fine)(closed.frames[-1])
    data["frames"][-1, free] = positions[free]
    write(folder, data)
    return place


def test_made_up_valve_end_to_end(run, tmp_path: Path) -> None:
    place = made_up_recording(tmp_path)
    status, out, err = run(*SMALL, place, "hydra.run.dir=here", "paths.results=published")
    assert status == 0, err
    assert "tricuspid" in out
    record = json.loads((tmp_path / "here" / "result.json").read_text())
    assert record["status"] == "converged"
    found = record["findings"]
    # Nothing is known of the tissue but what is estimated.
    assert "truth" not in found
    assert [row["closure"] for row in found["rows"]] == [
        "generic",
        "fitted, start 1",
        "fitted, start 2",
    ]
    # The recording is ours, but interpolated on other triangles than the mesh is made of.
    for row in found["rows"][1:]:
        assert row["estimate"] == pytest.approx(TRUTH, rel=0.1)
        assert row["distance_mm"]["mean"] < 0.5 * found["rows"][0]["distance_mm"]["mean"]
    read = read_record(tmp_path / "here" / "result.json", Findings).findings
    assert 0 < read.starts_differ < 5e-3
    words = (tmp_path / "here" / "donor.md").read_text()
    assert "The fitted closure is nearer to the recording than the generic one" in words
    assert CITATION in found["data"]["citation"]
    names = {path.name for path in (tmp_path / "here").iterdir()}
    assert {"donor.csv", "donor.md", "donor.png", "result.json", "fields.npz"} <= names
    # Overrides keep a run out of the results.
    assert not (tmp_path / "published").exists()


def test_absent_data_are_one_clear_line(run, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path / "nowhere"))
    status, out, err = run("experiment=donor")
    assert (status, out) == (2, "")
    assert len(err.strip().splitlines()) == 1
    assert err.startswith("error: donor valve: there is no folder")
    for part in (CITATION, DATA_VARIABLE):
        assert part in err


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("filter.mode=paper", "needs the iterated filter"),
        ("donor.starts=[[1,2]]", "expected lists of 3 moduli"),
        ("donor.starts=[]", "expected lists of 3 moduli"),
        ("donor.vertices=10", "remesh to 10 vertices"),
        ("donor.vertexes=10", "did you mean vertices?"),
        ("mechanics.element=hex18", "cannot thicken into 'hex18'"),
        ("mechanics.protocol.pressure_mmHg=5", "the recording says how large the pressure is"),
        ("donor.annulus=Rand", "no node sets 'Rand'; there are VALVE.ALL"),
        ("donor.case=Other", "there is no folder"),
    ],
)
def test_wrong_requests(run, tmp_path: Path, override: str, words: str) -> None:
    write(tmp_path, skirt())
    status, _, err = run(*SMALL, f"donor.recording={tmp_path}", override)
    assert status == 2
    assert words in err
