"""The studies of chordae by family and of a stiff patch, on a few elements that hardly move."""

import json
import re
import sys

import numpy as np
import pytest

from experiments.common.plain import flat
from experiments.run import main
from experiments.studies.chord.report import chord_text, write_chord
from experiments.studies.patch.report import patch_text, write_patch
from tests.experiments.runner.logged import logged

TINY = (
    "mesh.columns=8",
    "mesh.rows=1",
    "observation.columns=16",
    "observation.rows=5",
    "mechanics.contact_points.columns=16",
    "mechanics.contact_points.rows=5",
    "cycle.protocol.rise=0.1",
    "cycle.protocol.hold=0.05",
    "cycle.protocol.fall=0.1",
    "cycle.protocol.dt=0.05",
    "cycle.protocol.pressure_mmHg=10",
    "cycle.protocol.times=[0.0,0.05,0.1,0.15]",
    "cycle.finer_columns=10",
    "cycle.finer_rows=1",
    "cycle.check_columns=12",
    "cycle.check_rows=1",
    "cycle.check_contact=[24,5]",
    "cycle.seeds=2",
    "tracking.enabled=false",
)


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run the application in an empty folder: exit status, record, folder and what it said."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: str):
        given = ["experiments.run", *TINY, *arguments, "hydra.run.dir=here"]
        monkeypatch.setattr(sys, "argv", given)
        status = main()
        folder = tmp_path / "here"
        record = json.loads((folder / "result.json").read_text())
        return status, record, folder, capsys.readouterr()

    return call


PROVENANCE = {
    "git": {"sha": "0" * 40, "dirty": False},
    "versions": {"mvest": "0"},
    "config_hash": "0" * 64,
    "mesh_hash": "0" * 64,
    "seed": 1,
}
FEW = (
    # Meshes this coarse differ by more than they move: noise that is told is above that.
    "cycle.noise_mm=0.5",
    "parameters=[E_f.anterior,E_f.posterior,field.anterior.0,field.anterior.1,field.anterior.2]",
    "filter.initial=[6.0,2.2,0,0,0]",
    "filter.P0=[0.1,0.01,0.1,0.1,0.1]",
    "mechanics.fields.anterior.modes=3",
)


def test_a_patch_is_compared_with_the_truth_where_it_is(run):
    status, record, folder, said = run("experiment=patch", "patch.compared=true", *FEW)
    assert status == 0, said.err
    found = record["findings"]
    assert set(found["results"]) == {"patch", "no patch"}
    with_patch, without = found["results"]["patch"], found["results"]["no patch"]
    # The truth is the leaflet's modulus, twice as much at the centre, and nowhere else.
    assert max(without["truth"]) == pytest.approx(6.23)
    assert min(with_patch["truth"]) == pytest.approx(6.23)
    assert 6.23 * 1.5 < with_patch["true_at_centre"] <= 2 * 6.23 + 1e-9
    # The other mesh is another object, and the noise the same: only the truth differs.
    assert found["cells_of_truth"] != record["model"]["cells"][:2]
    assert with_patch["at_centre"] != without["at_centre"]
    # What is told of the highest modulus is what the map has.
    assert with_patch["peak"] == pytest.approx(max(with_patch["modulus"]))
    modulus, truth = np.array(with_patch["modulus"]), np.array(with_patch["truth"])
    assert np.all(modulus > 0)
    assert with_patch["rms_log_error"] <= np.abs(np.log(modulus / truth)).max()
    # More lies within wider limits, and what is left is noise of 0.5 mm.
    for entry in (with_patch, without):
        assert entry["shift_rms"] > 0
        assert entry["within_two_with_shift"] >= entry["within_two_std"]
        assert 0.45 < entry["residual_mm"] < 0.7
    assert logged(folder)["peak"] == with_patch["peak"]
    assert (folder / "patch.png").is_file()
    assert "half the patch's radius" in patch_text(flat(record))


def test_every_chordal_family_is_estimated_from_both_sets_of_frames(run):
    status, record, folder, said = run(
        "experiment=chord", "truth.values=[6,2,0.9,1.1,0.97,0.97]", "cycle.noise_mm=0.05"
    )
    assert status == 0, said.err
    found = record["findings"]
    first = [entry for entry in found["results"] if entry["seed"] == 0]
    assert [entry["frames"] for entry in first] == ["open and closed", "whole cycle"]
    prior, (two, whole) = np.array(found["prior_std"]), (np.array(e["std"]) for e in first)
    # Data never widen the posterior by more than its change of place, and more data tell more.
    assert np.all(two < 1.2 * prior)
    assert np.sum(np.log(whole)) < np.sum(np.log(two))
    assert len([e for e in found["results"] if e["frames"] == "whole cycle"]) == 2
    assert logged(folder)["std.chord_stiffness.basal"] == whole[3]
    assert (folder / "chord.png").is_file()


def test_tables_say_what_missed_its_target(tmp_path):
    entry = {
        "truth": [6.0, 12.0, 6.0], "modulus": [6.0, 9.0, 6.0], "log_std": [0.1, 0.2, 0.1],
        "at_centre": 9.0, "true_at_centre": 12.0, "log_std_at_centre": 0.2, "peak": 9.0,
        "peak_distance_mm": 4.0, "outside": 6.0, "rms_log_error": 0.1, "within_two_std": 0.9,
        "residual_mm": 0.5, "shift_rms": None, "within_two_with_shift": None,
        "shift_unknown": "no cycle",
    }  # fmt: skip
    record = {
        "title": "t", "results": {"patch": entry, "no patch": {**entry, "truth": [6.0] * 3}},
        "map": {"along_mm": [0, 1, 0], "down_mm": [0, 0, 1], "triangles": [[0, 1, 2]]},
        "patch": {"radius_mm": 7.0, "factor": 2.0, "region": "anterior"}, "truth": [6.0, 2.0],
        "field": {"correlation_length_mm": 5.0, "std_log": 0.4, "modes": 3, "share": 0.5},
        "cells_of_truth": [36, 4], "model": {"cells": [24, 3, 1]}, "times": [0, 1], "vertices": 9,
        "noise_mm": 0.5,
        "experiment": "made_up",
        "provenance": PROVENANCE,
    }  # fmt: skip
    text = patch_text(record)
    # 9 of 12 MPa is 25 % less; 4 mm is more than 3.5 mm.
    assert "-25 % off, target 20 %: missed" in text
    assert "may shift is not known (no cycle)" in text
    assert re.search(r"Place 4\.0 mm off, target 3\.5 mm .*: missed", text)
    files = write_patch(tmp_path, json.loads(json.dumps(record)))
    assert {path.suffix for path in files} == {".csv", ".md", ".png", ".pdf"}


def chord_record():
    def entry(frames, std):
        return {
            "frames": frames, "seed": 0, "status": "converged", "reason": "converged", "nees": 2.1,
            "estimate": [6.1, 1.01], "error": [0.01, 0.01], "std": std,
            "correlation": [[1, -0.7], [-0.7, 1]],
        }  # fmt: skip

    return {
        "title": "t", "parameters": ["E_f.anterior", "chord_stiffness.basal"], "truth": [6.0, 1.0],
        "start": [5.0, 1.1], "prior_std": [0.5, 0.3], "noise_mm": 0.5, "times": [0, 1],
        "vertices": 9, "results": [entry("open and closed", [0.3, 0.29]),
                                   entry("whole cycle", [0.1, 0.14])],
        "bounds": [{"frames": "open and closed", "std": [0.4, None]},
                   {"frames": "whole cycle", "std": [0.1, 0.16]}],
        "experiment": "made_up",
        "provenance": PROVENANCE,
    }  # fmt: skip


def test_identified_is_what_the_data_make_twice_as_sure(tmp_path):
    text = chord_text(chord_record())
    # 10 % of 50 % is, 30 % of 50 % is not; 14 % of 30 % is, 29 % of 30 % is not.
    modulus, chord = (line for line in text.splitlines() if line.startswith(("| ant", "| bas")))
    assert modulus.endswith("| whole cycle |")
    assert chord.endswith("| whole cycle |")
    assert "(unbounded)" in chord
    assert "-0.70" in text
    assert len(write_chord(tmp_path, chord_record())) == 4
