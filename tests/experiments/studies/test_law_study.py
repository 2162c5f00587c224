"""The study of the material laws in a size that takes seconds."""

import numpy as np
import pytest

from experiments.studies.law.findings import Findings

SMALL = (
    "experiment=law",
    "mesh.columns=12",
    "mesh.rows=2",
    "observation.columns=16",
    "observation.rows=5",
    "observation.noise_mm=0.002",
    "filter.R=4e-6",
    "mechanics.contact_points.columns=24",
    "mechanics.contact_points.rows=6",
    "mechanics.protocol.pressure_mmHg=5",
    "mechanics.protocol.ramp=0.1",
    "mechanics.protocol.dt=0.1",
    "mechanics.protocol.end=0.1",
    "mechanics.protocol.equilibrium=false",
    # Little load stretches nothing: leaflets of this size show their ground only.
    "parameters=[mu.anterior,mu.posterior]",
    "truth.values=[0.03,0.02]",
    "filter.initial=[0.02,0.03]",
    "filter.P0=1e-3",
    "repeats=2",
    "tracking.enabled=false",
)


@pytest.fixture
def run(run_here):
    return lambda *arguments: run_here(*SMALL, *arguments, findings=Findings)


def test_the_study_fits_both_laws_to_the_same_data(run):
    status, record, folder, said = run()
    assert status == 0, said.err
    found = record.findings
    own, other = found.fits
    assert (own.law, other.law) == ("exponential", "linear")
    for p in own.parameters:
        assert abs(p.estimate - p.truth) < 4 * p.std, p
        # A wide prior adds next to nothing to what the data say.
        assert p.std == pytest.approx(p.bound, rel=0.1)
    # The linear law has no true values, nor is it given any.
    assert [p.truth for p in other.parameters] == [None, None]
    assert [p.name for p in other.parameters] == ["E_f.anterior", "E_f.posterior"]
    assert own.distance_mm.mean < other.distance_mm.mean
    # The first sample is the fit itself, and the second saw other errors.
    first, second = (sample.estimate for sample in found.samples)
    assert first == pytest.approx([p.estimate for p in own.parameters], rel=1e-6)
    assert first != second
    low, high = found.chi_square_band
    assert low < own.chi_square < high
    for curves in found.curves.values():
        law = curves.exponential
        band = [np.array(side) for side in (law.low, law.estimate, law.high)]
        assert np.all(band[0] <= band[1] + 1e-9)
        assert np.all(band[1] <= band[2] + 1e-9)
        assert np.array(curves.truth).shape == (len(curves.stretch), 2)
    names = {path.name for path in folder.iterdir()}
    assert {"law.csv", "law.md", "law.png", "law_biaxial.png", "result.json"} <= names
    # Both fits say how they go on.
    assert "exponential law, step 1" in said.err
    assert "\nlinear law, step 1" in said.err


def test_the_other_law_has_moduli_only(run):
    status, record, _, said = run("law_study.linear_parameters=[E_f.anterior,pressure_scale]")
    assert status == 2
    assert record is None
    assert "expected E_f.REGION" in said.err


def test_parameters_that_the_tissue_does_not_have_are_refused(run):
    status, _, _, said = run("parameters=[mu.anterior,E_f.posterior]")
    assert status == 2
    assert "'posterior' follows the exponential law" in said.err
