"""The study of a reference heart on a made-up one, and without any."""

import sys

import pytest
from hydra.core.global_hydra import GlobalHydra

from experiments.run import main
from mvest.cases.importing.reference_heart import DATA_VARIABLE
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
