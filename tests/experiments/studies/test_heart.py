"""The study of a reference heart on a made-up one, and without any."""

import sys

import pytest

from experiments.common.records.record import read_record
from experiments.run import main
from experiments.studies.heart.findings import Findings, TwinRow
from experiments.studies.heart.report import heart_answer, heart_table, heart_words
from mvest.cases.importing.reference_heart import CITATION, DATA_VARIABLE
from mvest.closure.robustness import GateReport, GateRow
from tests.cases.importing.made_up_heart import heart

SMALL = [
    "experiment=reference_heart",
    "mesh.edge_length=4.0",
    "mechanics.contact_points.columns=72",
    "mechanics.contact_points.rows=16",
    "heart.options.closed_depth=0.75",  # the template's
    "heart.options.smoothing_mm=1.0",
    "mesh=coarse",
    "observation.columns=40",
    "observation.rows=10",
    "heart.gate=[perturbed start]",
    "tracking.enabled=false",
]


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["experiments.run", *arguments])
    return main()


def gate_of_made_up(build, m, cases, on_case, on_path):
    """What the gate would say; asking it is `tests.closure.test_robustness`'s."""
    rows = [GateRow("reference", 0.0, 0.0, True, 1.0, "converged")]
    rows += [GateRow(case.name, 0.1, 0.7, False, 1.0, "converged") for case in cases]
    return GateReport(tuple(rows), (), None, False)


def twin_of_made_up(values, name, changes):
    """What a twin would give; estimating is the twin study's."""
    assert values["valve"]["folder"]
    return TwinRow(name, (6.0, 2.0), (6.3, 2.0), (0.1, 0.1), (5.0, 0.0), 0.02, "converged")


@pytest.mark.slow
def test_the_shape_is_measured_meshed_and_closed(tmp_path, monkeypatch):
    monkeypatch.setattr("experiments.studies.heart.study.run_gate", gate_of_made_up)
    monkeypatch.setattr("experiments.studies.heart.study._twin", twin_of_made_up)
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
    words = heart_words(record)
    assert not found.passed
    assert "Gate **NOT passed**; not asked: time step / 2, time step / 4" in words
    assert "| perturbed start | 0.1 / 0.7 | **NOT passed**: converged |" in words
    assert found.claim in words
    assert CITATION in words
    assert "| same mesh | 6.3 ± 0.1 MPa (true 6) | 2 ± 0.1 MPa (true 2) | +5 % | +0 %" in words
    assert len(heart_table(record)) > 40
    assert "reference heart" in heart_answer(record)
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
