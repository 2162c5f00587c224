"""What is told of the joint estimates: targets that are missed are called missed."""

import copy

from experiments.studies.joint.report import joint_text, write_joint

NAMES = ["E_f.anterior", "E_f.posterior", "chord_rest_length"]


def entry(error: float, **more) -> dict:
    return {
        "status": "converged",
        "estimate": [6.0, 2.0, 1.0],
        "error": [0.0, error, 0.0],
        "std": [0.01, 0.01, 0.001],
        "runs": 5,
        "nees": 25.0,
        "residual_mm": 0.5,
        **more,
    }


def bound(frames: str, count: int, std: list, correlation: float) -> dict:
    rows = [[1.0, correlation, 0.0], [correlation, 1.0, 0.0], [0.0, 0.0, 1.0]]
    return {"frames": frames, "count": count, "std": std, "correlation": rows}


RECORD = {
    "experiment": "joint",
    "title": "Joint",
    "parameters": NAMES,
    "truth": [6.23, 2.09, 1.0],
    "start": [3.74, 2.93, 1.03],
    "times": [0.0, 0.1, 0.2],
    "vertices": 80,
    "noise_mm": 0.5,
    "bounds": [
        bound("open and closed", 2, [0.05, 0.05, 0.002], -0.9),
        bound("whole cycle", 3, [0.01, 0.01, 0.001], 0.2),
    ],
    "exact": entry(0.009),
    "seeds": [entry(0.01, seed=1), entry(-0.01, seed=2)],
    "first": [{"error": [0.4, 0.1, 0.03], "std": [0.5, 0.4, 0.05]}] * 3,
    "passes": [{"error": [0.1, 0.1, 0.01], "std": [0.1, 0.1, 0.01]}] * 2,
    "rms_over_bound": [0.8, 1.4, 0.9],
    "finer": entry(0.05, cells=[40, 5], distance_mm=0.2),
    "told": entry(0.05, shift=[0.0, 0.04, 0.0], cells=[48, 6], distance_mm=0.3)
    | {"std": [0.01, 0.04, 0.001], "nees": 1.6},
    "provenance": {
        "versions": {"mvest": "0.1.0"},
        "git": {"sha": "0" * 40, "dirty": False},
        "config_hash": "1" * 64,
        "mesh_hash": "2" * 64,
        "seed": 1,
    },
}


def test_targets_are_met_or_missed_by_the_numbers():
    assert joint_text(RECORD).count(": met") == 2
    changed = copy.deepcopy(RECORD)
    changed["exact"]["error"][1] = -0.011
    changed["rms_over_bound"][1] = 1.51
    text = joint_text(changed)
    assert text.count(": missed") == 2
    assert "1.100 %" in text


def test_ratios_of_few_seeds_have_a_band():
    # Chi-square with two degrees of freedom: 0.0506 and 7.378; half of them, and the root.
    assert "between 0.16 and 1.92 in 95 % of cases" in joint_text(RECORD)


def test_the_most_correlated_parameters_of_two_frames_are_named():
    text = joint_text(RECORD)
    assert "anterior modulus and posterior modulus correlated by -0.900" in text
    # The posterior's bound is 5 times that of the whole cycle, the length's twice.
    assert "2.0 to 5.0 times" in text
    undetermined = copy.deepcopy(RECORD)
    undetermined["bounds"][0]["std"][2] = None
    assert "do not determine all parameters" in joint_text(undetermined)


def test_errors_on_another_mesh_are_told_in_standard_deviations():
    text = joint_text(RECORD)
    assert "over these standard deviations: +0.0, +1.2, +0.0, normalised squared error 1.6" in text
    assert "(without: +0.0, +5.0, +0.0, 25)" in text
    lost = {**RECORD, "told": {"status": "failed", "reason": "too far", "cells": [48, 6]}}
    assert "may shift is not known (too far)" in joint_text(lost)
    assert "std with that shift" not in joint_text(lost)


def test_files_are_written(tmp_path):
    names = {path.name for path in write_joint(tmp_path, RECORD)}
    assert names == {"joint.csv", "joint.md", "joint.png", "joint.pdf"}
    # Of three parameters: no noise, two seeds, the finer truth without and with its mesh's error.
    assert len((tmp_path / "joint.csv").read_text().splitlines()) == 1 + 5 * len(NAMES)
