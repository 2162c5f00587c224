"""Memory that is foreseen: what needs too much of it is refused before anything is built."""

import sys
from pathlib import Path

import pytest

from experiments.common.building.twin import expected_memory_gb
from experiments.run import main

MEASURED = {(36, 4): 0.29, (72, 8): 0.37, (100, 12): 0.55, (150, 20): 0.99}
"""Cells of hex18 -> peak in GB of a closure with derivatives, without what records and draws."""


@pytest.mark.parametrize("cells", MEASURED)
def test_a_closure_takes_no_more_memory_than_is_expected_and_hardly_less(cells):
    expected = expected_memory_gb("hex18", *cells)
    assert MEASURED[cells] < expected < 2 * MEASURED[cells]


def test_more_nodes_are_expected_to_take_more():
    thin, thick = (expected_memory_gb("hex18", 300, 40, layers) for layers in (1, 2))
    assert expected_memory_gb("tet4", 300, 40) < thin < thick
    assert expected_memory_gb("hex27", 300, 40) == thick


@pytest.mark.parametrize(
    ("setting", "named"),
    [
        (("mesh.columns=300", "mesh.rows=40"), "mesh: 300 x 40 x 1 cells of hex18 need about 4."),
        (("truth.columns=300", "truth.rows=40"), "truth: 300 x 40 x 1 cells of hex18"),
    ],
)
def test_a_mesh_beyond_the_memory_of_a_job_is_not_built(
    tmp_path, monkeypatch, capsys, setting, named
):
    monkeypatch.chdir(tmp_path)
    meshed = "experiments.common.building.closure.structured_mesh"
    monkeypatch.setattr(meshed, lambda *_: pytest.fail("built"))
    line = ["experiments.run", "experiment=debug", "memory_limit_gb=2", *setting]
    monkeypatch.setattr(sys, "argv", line)
    assert main() == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {named}")
    assert error.endswith("more than the 2 GB that a job may have (memory_limit_gb)\n")
    assert not list(Path("outputs").rglob("result.json"))
