"""The study of a whole cycle, on a few elements that the pressure hardly moves."""

import numpy as np
import pytest

from experiments.common.records.record import read_record

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
    "cycle.finer=[12,1,24,5]",
    "cycle.check=[16,1,24,5]",
    "cycle.seeds=2",
    # What moves so little says little in 0.5 mm of noise.
    "cycle.noise_mm=0.01",
    "cycle.exact_assumed_mm=0.001",
    "tracking.enabled=false",
)
# Chordae short enough to pull in so small a motion.
SHORT = ("truth.values=[6.23,2.09,0.94]", "filter.initial=[3.74,2.93,0.95]")


@pytest.fixture
def done(run_here):
    def call(*arguments):
        status, _, folder, said = run_here(*arguments, *TINY)
        assert status == 0, said.err
        return read_record(folder / "result.json"), folder, said

    return call


def bounds_of(record, frames):
    rows = record.table_of().rows
    return np.array([row["bound"] or np.inf for row in rows if row["frames"] == frames])


def estimate_of(record, label):
    (found,) = (one for one in record.estimates if one.case == label)
    return found


def test_the_joint_study_recovers_all_parameters(done):
    record, folder, _ = done("experiment=joint", *SHORT)
    # Nothing to hide behind: without noise the truth is found, from 40 % and 1 % away.
    exact = estimate_of(record, "no noise")
    assert abs(exact.parameters[0].prior_mean / exact.parameters[0].truth - 1) > 0.3
    assert max(abs(own.relative_error) for own in exact.parameters) < 0.01
    assert exact.innovation.residual_rms < 1e-3
    two, whole = (bounds_of(record, name) for name in ("open and closed", "whole cycle"))
    assert np.all(two > whole)
    # What is left of the observation is its noise.
    for seed in (1, 2):
        found = estimate_of(record, f"whole cycle, errors {seed}")
        assert 0.009 < found.innovation.residual_rms < 0.011
    labels = [row["estimate from"] for row in record.table_of("estimates").rows]
    assert labels[3:9] == ["whole cycle, errors 1"] * 3 + ["whole cycle, errors 2"] * 3
    names = {path.name for path in folder.iterdir()}
    assert {"joint.csv", "joint.md", "joint.png", "joint_estimates.csv"} <= names


def test_an_estimate_from_another_mesh_says_what_its_own_may_have_done(done):
    record, _, _ = done("experiment=joint", *SHORT, "cycle.estimated=[another mesh]")
    plain = estimate_of(record, "another mesh").parameters
    wider = estimate_of(record, "another mesh, with the mesh's error").parameters
    # Another mesh is another truth, and the third one differs more.
    assert record.numbers["check_mesh_apart_mm"] > record.numbers["meshes_apart_mm"] > 1e-3
    for one, other in zip(plain, wider, strict=True):
        assert other.estimate == one.estimate
        # Meshes this coarse shift by far more than the noise.
        assert other.std > one.std


def test_the_cycle_study_compares_frames_and_time_steps(done):
    record, folder, _ = done(
        "experiment=cycle", "cycle.time_steps=[0.05,0.025,0.0125]", "cycle.path_steps=4"
    )
    counts = {row["frames"]: row["count"] for row in record.table_of().rows}
    assert counts == {
        "open and closed": 2, "3 frames, evenly": 3, "whole cycle": 5,
        "only closing": 1, "only held closed": 2, "only opening": 1,
    }  # fmt: skip
    steps = record.table_of("time_steps").rows
    assert steps[0]["change"] > steps[1]["change"] > 0
    assert steps[2]["change"] is None
    # So small a motion is smooth.
    assert max(row["unevenness"] for row in steps) < 1.5
    assert not record.estimates
    assert {"cycle.csv", "cycle_time_steps.csv", "cycle.png"} <= {p.name for p in folder.iterdir()}


def test_what_cannot_be_estimated_is_refused(run_here):
    status, _, _, said = run_here("experiment=joint", "cycle.estimated=[half a cycle]", *TINY)
    assert status != 0
    assert "expected some of no noise, open and closed, whole cycle, another mesh" in said.err
