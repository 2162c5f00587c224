"""Words about predictions that a wrong count would spoil."""

from dataclasses import replace

from experiments.studies.prediction.findings import Findings, Observed, Patient, Predicted, Scenario
from experiments.studies.prediction.report import coverage


def row(low, high, truth):
    return Predicted(
        estimate=low, first_order_std=None, mean=None, std=None, low=low, high=high, samples=2,
        mesh_error=None, wide_low=low - 0.5, wide_high=high + 0.5, truth_own_mesh=truth,
        inside_own_mesh=low <= truth <= high, truth_same_mesh=None, inside_same_mesh=None,
        inside_wide=low - 0.5 <= truth <= high + 0.5,
    )  # fmt: skip


def scenario(**measures):
    return Scenario(
        failure="", samples=2, failures=(), sampled=(), truth_failure="", finer_failure="",
        measures=measures,
    )  # fmt: skip


def test_an_interval_without_width_counts_only_where_it_misses():
    scenarios = {
        "observed": scenario(gap_mm2=row(8.0, 12.0, 9.0), other=row(0.0, 1.0, 5.0)),
        "ring": scenario(gap_mm2=row(0.0, 0.0, 0.0)),
        "clip": scenario(gap_mm2=row(0.0, 0.0, 1.5)),
        "both": scenario(gap_mm2=replace(row(1.0, 2.0, 3.0), inside_own_mesh=None)),
    }
    patient = Patient(
        seed=1, truth=(), estimate=None, std=None, relative_error=None, reason="",
        correlation=None, scenarios=scenarios,
    )  # fmt: skip
    findings = Findings(
        patients=(patient,), estimate=None, std=None, relative_error=None, scenarios={},
        stress_meshes=(), reach_mm=1.0, check_mesh=(), measures={},
        observed=Observed(
            vertices=1, truth_cells=(2, 2), truth_element="hex18", noise_mm=0.0,
            correlated_mm=0.5, correlation_length_mm=5.0,
        ),
    )  # fmt: skip
    # Inside: observed. Missed: clip. Neither: the ring, where there is nothing to be wrong about,
    # and both, whose truth is not known.
    assert coverage(findings, "gap_mm2", "own") == (1, 2)
    # With the mesh's error the ring's interval has a width, and both, 3.0 in 0.5 to 2.5, misses.
    assert coverage(findings, "gap_mm2", "wide") == (2, 4)
