"""The study of a reference heart on a made-up one, and without any."""

import json
import sys

import numpy as np
import pytest
from hydra.core.global_hydra import GlobalHydra

from experiments.common.record import read_record
from experiments.run import main
from experiments.studies.heart.findings import Findings
from experiments.studies.heart.report import heart_answer, heart_table, heart_words
from mvest.cases.importing.reference_heart import CITATION, DATA_VARIABLE
from tests.cases.importing.made_up_heart import heart

SMALL = [
    "experiment=reference_heart",
    "mesh.columns=16",
    "mesh.rows=2",
    "mesh.edge_length=4.0",
    "mechanics.contact_points.columns=48",
    "mechanics.contact_points.rows=12",
    "mechanics.protocol.dt=0.05",
    "observation.columns=40",
    "observation.rows=10",
    "heart.gate=[perturbed start]",
    # Its own elements, which are closed faster.
    "heart.twins={tet10 on a pytetwild mesh: {source: structured, element: hex18}}",
    "tracking.enabled=false",
]


@pytest.fixture(autouse=True)
def no_hydra_left_over():
    yield
    GlobalHydra.instance().clear()


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["experiments.run", *arguments])
    return main()


def test_moduli_that_were_put_in_come_back(tmp_path, monkeypatch):
    source = heart(tmp_path / "heart")
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *SMALL, f"heart.source={source}") == 0
    (file,) = tmp_path.glob("outputs/reference_heart/*/result.json")
    record = read_record(file, Findings)
    found = record.findings
    sizes = {one.name: one.value for one in found.measures}
    # The template's, 26.9 mm by 36 mm.
    assert sizes["annulus, anteroposterior diameter"] == pytest.approx(26.9, rel=0.05)
    assert sizes["annulus, commissural diameter"] == pytest.approx(36.0, rel=0.05)
    # Meshes of the midsurface with its thickness hold the tissue of the source.
    for mesh in found.meshes:
        tissue = sizes["tissue enclosed by the surface of the source"]
        assert mesh.volume_mm3 == pytest.approx(tissue, rel=0.1)
    used, still, _ = found.closures
    assert (used.annulus_contraction, still.annulus_contraction) == (0.08, 0.0)
    assert used.closed.orifice_mm2 < 0.2 * used.opened.orifice_mm2
    assert "time step / 32, every step converged" in found.left_out
    assert [asked.name for asked in found.gate[:2]] == ["reference", "perturbed start"]
    for twin in found.twins:
        np.testing.assert_allclose(twin.error_percent, 0.0, atol=0.5)
    words = heart_words(record)
    assert found.claim in words
    assert CITATION in words
    assert len(heart_table(record)) > 40
    assert "reference heart" in heart_answer(record)
    assert "NaN" not in json.dumps(json.loads(file.read_text()), allow_nan=False)
    assert list(file.parent.glob("*.png"))


def test_without_the_data_it_says_where_to_get_them(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path / "nowhere"))
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "experiment=reference_heart", "tracking.enabled=false") == 2
    said = capsys.readouterr().err
    assert "The reference heart is not part of this package" in said
    assert "Traceback" not in said


def test_an_unknown_variation_of_the_gate_is_refused(tmp_path, monkeypatch, capsys):
    source = heart(tmp_path / "heart")
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *SMALL, f"heart.source={source}", "heart.gate=[nothing]") == 2
    assert "heart.gate has 'nothing', expected some of" in capsys.readouterr().err
