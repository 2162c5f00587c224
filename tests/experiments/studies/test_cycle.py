"""The studies of a whole cycle, on a few elements that the pressure hardly moves."""

import sys

import numpy as np
import pytest

from experiments.common.building import whole_cycle
from experiments.common.building.cycle_settings import CycleSettings
from experiments.common.building.whole_cycle import shift_by_check_mesh
from experiments.run import main
from experiments.studies.cycle import study as cycle
from experiments.studies.cycle.study import frame_sets
from mvest.closure.cycle import CycleObservation
from mvest.errors import ConfigurationError, InputError
from mvest.estimation import Gaussian, IteratedFilter, Log, Prediction
from tests.experiments.runner.logged import logged

TINY = (
    "mesh.columns=8",
    "mesh.rows=1",
    "observation.columns=16",
    "observation.rows=5",
    "mechanics.contact_points.columns=16",
    "mechanics.contact_points.rows=5",
    "cycle.protocol.pressure_mmHg=10",
    "cycle.protocol.rise=0.1",
    "cycle.protocol.hold=0.05",
    "cycle.protocol.fall=0.1",
    "cycle.protocol.dt=0.05",
    # The paper's damping: steps this long fail with less, and cost seconds until they are halved.
    "mechanics.damping.beta=0.1",
    "cycle.protocol.times=[0.0,0.05,0.1,0.15,0.25]",
    "cycle.finer_columns=10",
    "cycle.finer_rows=1",
    "cycle.finer_contact=[20,5]",
    "cycle.check_columns=12",
    "cycle.check_rows=1",
    "cycle.check_contact=[24,5]",
    "cycle.seeds=2",
    "cycle.beats=3",
    "cycle.beat_times=[0.05,0.1]",
    # What moves so little says little in 0.5 mm of noise.
    "cycle.noise_mm=0.01",
    "cycle.exact_assumed_mm=0.001",
    "tracking.enabled=false",
)


@pytest.fixture
def run(run_here):
    return lambda *arguments: run_here(*arguments, *TINY)


def test_sets_of_frames_are_spread_over_the_cycle():
    sets = frame_sets(15, 8)
    assert sets[0] == [0, 8]
    assert sets[1] == [0, 7, 14]
    assert [len(s) for s in sets] == [2, 3, 5, 8, 15]


def test_the_joint_study_recovers_all_parameters_and_records_them(run):
    status, record, folder, said = run(
        # Chordae short enough to pull in so small a motion.
        "experiment=joint",
        "truth.values=[6.23,2.09,0.94]",
        "filter.initial=[3.74,2.93,0.95]",
    )
    assert status == 0, said.err
    found = record["findings"]
    # Nothing to hide behind: without noise the truth is found, from 40 % and 1 % away.
    assert np.abs(found["exact"]["error"]).max() < 1e-2
    assert abs(found["start"][0] / found["truth"][0] - 1) > 0.3
    whole = np.array(found["bounds"][1]["std"])
    two = np.array(found["bounds"][0]["std"], dtype=float)
    assert np.all(two > whole)
    assert len(found["seeds"]) == 2
    errors = np.array([entry["error"] for entry in found["seeds"]])
    expected = np.sqrt(np.mean(errors**2, axis=0)) / whole
    np.testing.assert_allclose(found["rms_over_bound"], expected)
    # Another mesh is another truth.
    assert found["finer"]["distance_mm"] > 1e-3
    error = logged(folder)["error_exact.E_f.anterior"]
    assert error == pytest.approx(found["exact"]["error"][0], abs=1e-12)
    # What is left of the observation is its noise.
    assert all(0.009 < entry["residual_mm"] < 0.011 for entry in found["seeds"])
    assert found["exact"]["residual_mm"] < 1e-3
    # Meshes this coarse shift by far more than the noise, and the estimate says so.
    finer, by_mesh = found["finer"], found["mesh_error"]
    assert by_mesh["distance_mm"] > finer["distance_mm"] > 0
    fit = finer["fit"]
    np.testing.assert_allclose(np.hypot(by_mesh["shift"], fit["std"]), by_mesh["std"], rtol=1e-6)
    assert by_mesh["nees"] < fit["nees"]
    assert np.max(np.abs(np.divide(by_mesh["shift"], fit["std"]))) > 3
    assert "the same, with the mesh's error" in (folder / "joint.csv").read_text()
    assert {"joint.csv", "joint.md", "joint.png"} <= {path.name for path in folder.iterdir()}
    assert "target" in said.out


def test_the_cycle_study_records_frames_steps_and_the_drift(run):
    status, record, folder, said = run(
        "experiment=cycle", "cycle.time_steps=[0.05,0.025,0.0125]", "cycle.path_steps=4"
    )
    assert status == 0, said.err
    found = record["findings"]
    frames = found["frames"]
    # The open frame says nothing of any parameter.
    assert frames[0]["std_alone"] == [None, None, None]
    assert [entry["count"] for entry in found["sets"]] == [2, 3, 5]
    assert {entry["frames"] for entry in found["phases"]} == {"closing", "held closed", "opening"}
    assert logged(folder)["bound_5_frames.E_f.anterior"] == found["sets"][-1]["std"][0]
    steps = found["steps"]
    assert steps["rms_mm"][0] > steps["rms_mm"][1] > 0
    # So small a motion is smooth.
    changes = np.array([along["rms_mm"] for along in steps["along"]])
    assert changes.shape == (3, 4)
    uneven = changes.max(axis=1) / np.median(changes, axis=1)
    assert max(uneven) < 1.5
    assert steps["path"][-1][0] / steps["path"][0][0] == pytest.approx(0.7)
    drift = found["drift"]
    assert np.array(drift["truth"]).shape == (3, 2)
    # From the first to the last beat by -30 % in the first modulus alone.
    assert drift["truth"][2][0] / drift["truth"][0][0] == pytest.approx(0.7)
    assert drift["truth"][2][1] == drift["truth"][0][1]
    for k in range(2):
        assert drift["smoother"]["mean_std"][k] < drift["filter"]["mean_std"][k]
    assert {"cycle.csv", "cycle.md", "cycle.png"} <= {path.name for path in folder.iterdir()}


def test_a_check_says_what_a_cycle_will_tell_and_estimates_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "experiments.studies.joint.study.CycleObservation",
        lambda *a, **k: pytest.fail("something was observed"),
    )
    monkeypatch.setattr(sys, "argv", ["experiments.run", "experiment=joint", "check=true", *TINY])
    assert main() == 0
    said = capsys.readouterr().out
    # 16 x 5 vertices in 5 frames, three coordinates each.
    assert "1200 numbers of 0 s, 0.05 s, 0.1 s, 0.15 s, 0.25 s; 0.01 mm of noise assumed" in said
    rows = [line.split() for line in said.splitlines() if line.strip().startswith("E_f.")]
    assert [row[2] for row in rows] == ["3.74", "2.93"]  # where the filter starts
    assert "No estimation was run." in said
    assert not list(tmp_path.rglob("result.json"))


class LogLinear:
    """Two vertices in two frames, linear in the logarithms of two parameters."""

    H = np.random.default_rng(5).normal(size=(12, 2))

    def __call__(self, m):
        return Prediction(self.H @ np.log(m), self.H / m)


def test_the_shift_by_a_mesh_is_the_difference_of_two_estimates(monkeypatch):
    rng = np.random.default_rng(6)
    frames = rng.normal(size=(2, 2, 3))
    frames[1, 0] = np.nan  # not seen
    observation = CycleObservation(frames, np.array([0.2, 0.3]))
    model, prior = observation.of(LogLinear()), Gaussian.from_variance(np.ones(2), np.ones(2))

    def estimated(y):
        return IteratedFilter(1e-12)(model, prior, y, observation.R, transform=Log())

    found = estimated(observation.y)
    off = rng.normal(size=(2, 2, 3))
    at = LogLinear()(found.mean).y.reshape(2, 2, 3)
    monkeypatch.setattr(whole_cycle, "frames_on_mesh", lambda values, settings, m, mesh: at + off)
    by = shift_by_check_mesh({}, CycleSettings(), found, model, prior, observation)
    moved = estimated(observation.y + off[observation.seen].ravel())
    np.testing.assert_allclose(by.shift, moved.transformed.mean - found.transformed.mean, rtol=1e-8)
    seen = np.linalg.norm(off[observation.seen], axis=1)
    assert by.distance_mm == pytest.approx(seen.mean())


def test_a_mesh_on_which_nothing_closes_is_said_and_not_raised(monkeypatch):
    observation = CycleObservation(np.zeros((2, 2, 3)), np.full(2, 0.2))
    model, prior = observation.of(LogLinear()), Gaussian.from_variance(np.ones(2), np.ones(2))
    found = IteratedFilter()(model, prior, observation.y, observation.R, transform=Log())

    def lost(values, settings, m, mesh):
        raise InputError("no cycle")

    monkeypatch.setattr(whole_cycle, "frames_on_mesh", lost)
    by = shift_by_check_mesh({}, CycleSettings(), found, model, prior, observation)
    assert by == "on the mesh of the check: no cycle"


def test_time_steps_that_are_not_halves_are_refused():
    settings = CycleSettings(time_steps=(0.05, 0.02), path_steps=1)
    with pytest.raises(ConfigurationError, match="each to be half of the one before"):
        cycle._time_steps({}, settings, np.array([6.0]))


def test_a_time_step_that_cannot_be_followed_is_said(monkeypatch):
    def frames(config, model, m):
        if m[0] < 2:
            raise InputError("no cycle with the parameters")
        return np.full((1, 1, 3), m[0])

    monkeypatch.setattr(cycle, "stored_frames", frames)
    found, reason = cycle._followed({}, None, np.array([[3.0], [2.5], [1.0], [0.5]]))
    assert [f[0, 0, 0] for f in found] == [3.0, 2.5]
    assert reason == "no cycle with the parameters"
