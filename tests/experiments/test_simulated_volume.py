"""The volume to try, and the command that makes such volumes."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments import cli
from mvest.exchange.surfaces import read_surface
from mvest.exchange.volumes import read_volume
from mvest.imaging.detection.tracking import detect_valve
from mvest.imaging.detection.trained_model import default_model

EXAMPLES = Path(__file__).parents[2] / "examples"
TRUTH = EXAMPLES / "volume_truth"


def test_the_valve_in_the_sample_is_where_the_truth_beside_it_says():
    volume = read_volume(EXAMPLES / "volume.seq.nrrd")
    valve = detect_valve(volume, default_model())
    assert (EXAMPLES / "volume.seq.nrrd").stat().st_size < 1 << 20
    said = json.loads((TRUTH / "truth.json").read_text())
    assert said["simulated"] is True
    np.testing.assert_allclose(volume.times, said["times_s"], atol=1e-6)
    for frame in (said["open_frame"], said["closed_frame"]):
        true = read_surface(TRUTH / f"valve_{frame:04d}.vtp").vertices
        gap = np.linalg.norm(valve.vertices[frame][:, None] - true[None, ::4], axis=2)
        assert gap.min(axis=0).mean() < 2.0


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["out.nrrd"], "out.nrrd"),
        (["out.seq.nrrd", "speed=3"], "known are valve, mechanics, moduli"),
        (["out.seq.nrrd", "moduli=[0,2]"], "moduli = 0, expected 1e-06 to 10000 MPa"),
    ],
)
def test_what_cannot_be_simulated_is_said_in_one_line(
    words, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["simulate", "volume", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ")
    assert message in line
    assert list(tmp_path.iterdir()) == []
