"""What is said of the joint estimates: targets that are missed are called missed."""

from dataclasses import replace
from typing import Any

from experiments.common.building.whole_cycle import Bound
from experiments.studies.joint.findings import Findings, Fit, Frame, MeshError, OtherMesh, Pass
from experiments.studies.joint.report import joint_words
from experiments.studies.joint.study import STUDY
from tests.experiments.studies.made_up import made_up

NAMES = ("E_f.anterior", "E_f.posterior", "chord_rest_length")


def fit(error: float) -> Fit:
    return Fit(
        status="converged",
        reason="converged",
        estimate=(6.0, 2.0, 1.0),
        error=(0.0, error, 0.0),
        std=(0.01, 0.01, 0.001),
        nees=25.0,
        iterations=4,
        runs=5,
        residual_mm=0.5,
    )


def bound(frames: str, count: int, std: tuple[float | None, ...], correlation: float) -> Bound:
    rows = ((1.0, correlation, 0.0), (correlation, 1.0, 0.0), (0.0, 0.0, 1.0))
    return Bound(frames, count, std, rows, 1.0, ())


FINDINGS = Findings(
    truth=(6.23, 2.09, 1.0),
    start=(3.74, 2.93, 1.03),
    times=(0.0, 0.1, 0.2),
    noise_mm=0.5,
    assumed_mm=0.1,
    vertices=80,
    bounds=(
        bound("open and closed", 2, (0.05, 0.05, 0.002), -0.9),
        bound("whole cycle", 3, (0.01, 0.01, 0.001), 0.2),
    ),
    exact=fit(0.009),
    exact_frames=(),
    seeds=(fit(0.01), fit(-0.01)),
    first=(Frame((0.4, 0.1, 0.03), (0.5, 0.4, 0.05), 1.0, (0.5, 2.0), 1.0),) * 3,
    passes=(Pass((0.1, 0.1, 0.01), (0.1, 0.1, 0.01)),) * 2,
    rms_over_bound=(0.8, 1.4, 0.9),
    finer=OtherMesh(fit(0.05), (40, 5), 0.2),
    mesh_error=MeshError((0.0, 0.04, 0.0), (0.01, 0.04, 0.001), 1.6, 0.3, (48, 6)),
    measures={},
)


def words(**changed: Any) -> str:
    return joint_words(made_up(replace(FINDINGS, **changed), parameters=NAMES))


def test_targets_are_met_or_missed_by_the_numbers():
    assert words().count(": met") == 2
    text = words(
        exact=replace(FINDINGS.exact, error=(0.0, -0.011, 0.0)), rms_over_bound=(0.8, 1.51, 0.9)
    )
    assert text.count(": missed") == 2
    assert "1.100 %" in text


def test_ratios_of_few_seeds_have_a_band():
    # Chi-square with two degrees of freedom: 0.0506 and 7.378; half of them, and the root.
    assert "between 0.16 and 1.92 in 95 % of cases" in words()


def test_the_most_correlated_parameters_of_two_frames_are_named():
    text = words()
    assert "anterior modulus and posterior modulus correlated by -0.900" in text
    # The posterior's bound is 5 times that of the whole cycle, the length's twice.
    assert "2.0 to 5.0 times" in text
    two, whole = FINDINGS.bounds
    undetermined = replace(two, std=(*two.std[:2], None))
    assert "do not determine all parameters" in words(bounds=(undetermined, whole))


def test_errors_on_another_mesh_are_said_in_standard_deviations():
    text = words()
    assert "over these standard deviations: +0.0, +1.2, +0.0, normalised squared error 1.6" in text
    assert "(without: +0.0, +5.0, +0.0, 25)" in text
    lost = words(mesh_error="too far")
    assert "may shift is not known (too far)" in lost
    assert "std with that shift" not in lost


def test_files_are_written(tmp_path):
    record = made_up(FINDINGS, parameters=NAMES, experiment="joint")
    names = {path.name for path in STUDY.write(tmp_path, {"joint": record}, {})}
    assert names == {"joint.csv", "joint.md", "joint.png", "joint.pdf"}
    # Of three parameters: no noise, two seeds, the finer truth without and with its mesh's error.
    assert len((tmp_path / "joint.csv").read_text().splitlines()) == 1 + 5 * len(NAMES)
