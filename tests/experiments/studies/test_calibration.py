"""Estimates in worlds that are not as they assume: what the table and the figure say of them."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.common.cases.findings import Revealed
from experiments.studies.patient.calibration import (
    calibration_answer,
    calibration_figure,
    calibration_frame,
    ecdf_band,
    worlds_of,
    write_calibration_tables,
)
from experiments.studies.patient.report import kept_of_patient, write_patients
from mvest.problem.verdict import DOUBTFUL, NONE, TRUSTWORTHY, Ground, Verdict
from mvest.reporting.case.findings import UnknownRow
from tests.experiments.studies.made_up_patients import patient

SD = 0.1


def modulus(name: str, z: float, truth: float = 5.0) -> UnknownRow:
    """An estimate whose logarithm is off by z of its standard deviations of 0.1."""
    estimate, reach = float(truth * np.exp(-z * SD)), float(np.exp(1.959964 * SD))
    return UnknownRow(
        name=name, label="", unit="MPa", kind="modulus", treatment="estimated", prior_mean=6.0,
        prior_std=3.0, estimate=estimate, std=SD * estimate, low=estimate / reach,
        high=estimate * reach, truth=truth,
    )  # fmt: skip


def run(world: str, seed: int, z: tuple[float, float], trust=TRUSTWORTHY, correlation=0.0):
    grounds = () if trust == TRUSTWORTHY else (Ground("distance", trust, "it is far"),)
    record = patient(
        f"drawn_{seed}",
        "calibration",
        unknowns=(modulus("E_f.anterior", z[0]), modulus("E_f.posterior", z[1])),
        correlation=((1.0, correlation), (correlation, 1.0)),
        verdict=Verdict(trust, grounds),
    )
    found = replace(record.findings, revealed=Revealed(1, (), (), world))
    source = replace(record.provenance, seed=seed)
    return replace(record, findings=found, provenance=source)


@pytest.fixture
def runs():
    """A world as it is assumed, and one with a wrong interval that is trusted."""
    return [
        run("reference", 1, (0.5, -0.5)),
        run("reference", 2, (1.0, 2.5)),
        run("open shape off", 1, (4.0, 1.0)),
        run("open shape off", 2, (-5.0, -4.0), NONE),
        run("open shape off", 3, (0.1, 0.2), DOUBTFUL),
    ]


def lines(tmp_path, runs) -> tuple[dict[str, dict[str, str]], str]:
    write_calibration_tables(tmp_path, runs)
    text = (tmp_path / "calibration.md").read_text()
    table = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    head = [cell.strip() for cell in table[0]]
    rows = [dict(zip(head, (cell.strip() for cell in row), strict=True)) for row in table[2:]]
    return {row["world"]: row for row in rows}, text


def test_what_is_said_of_a_world(tmp_path, runs):
    rows, text = lines(tmp_path, runs)
    assert list(rows) == ["reference", "open shape off", "generic guess", "prior alone"]
    as_assumed, off = rows["reference"], rows["open shape off"]
    assert as_assumed["valves"] == "2 of 20"
    assert off["trustworthy / doubtful / none"] == "1 / 1 / 1"
    # |z| of 0.5, 1.0 and 0.5, 2.5: all inside but the last.
    assert as_assumed["E_f anterior inside"].startswith("2 of 2 (16 to 100 %)")
    assert as_assumed["E_f posterior inside"].startswith("1 of 2")
    assert as_assumed["inside, trustworthy"].startswith("3 of 4")
    # 4, 5 and 4 SD off; the first is trusted.
    assert as_assumed["more than 3 SD off (trustworthy)"] == "0 (0)"
    assert off["more than 3 SD off (trustworthy)"] == "3 (1)"
    # (0.25 + 0.25) / 2 and (1 + 6.25) / 2, on average.
    assert as_assumed["NEES"].startswith("1.94 (")
    # Guessing 6 for 5 is off by 20 %; the prior's logarithm has an SD of 0.5, the estimate's 0.1.
    assert as_assumed["generic guess"] == "20.0 %"
    assert as_assumed["width / prior's"] == "0.20"
    assert rows["generic guess"]["median error (trustworthy)"] == "20.0 %"
    # Three valves, 6 for 5 with a factor of 2.7 either way.
    assert rows["prior alone"]["E_f anterior inside"].startswith("3 of 3")
    assert "**Not complete: 35 of 40 runs are missing.**" in text
    assert "called trustworthy hold: reference (3 of 4); open shape off (1 of 2)." in text
    assert "more than 3 SD off are trustworthy: open shape off (1 of 3)." in text
    assert "What spoke against estimates: distance (2)." in text


def test_correlated_errors_are_judged_as_such():
    table = calibration_frame([run("reference", 1, (1.0, 1.0), correlation=0.5)])
    # (1, 1) C⁻¹ (1, 1)ᵀ / 2 with C⁻¹ = 4/3 (1, −1/2; −1/2, 1): 2/3.
    assert table["NEES"].tolist() == pytest.approx([2 / 3, 2 / 3])
    assert table["off by [SD]"].tolist() == pytest.approx([1.0, 1.0])
    assert table["truth in posterior"].tolist() == pytest.approx([0.841, 0.841], abs=1e-3)


def test_a_complete_table_does_not_say_otherwise(tmp_path):
    runs = [run("reference", seed, (0.3, 0.1)) for seed in range(20)]
    assert "Not complete" not in lines(tmp_path, runs)[1]


def test_the_answer_counts_what_is_trusted(runs):
    words = calibration_answer({str(k): one for k, one in enumerate(runs)})
    assert words == (
        "5 simulated valves in 2 worlds, of which all but one are not as the estimator assumes: "
        "3 estimates are called trustworthy, and 4 of their 6 moduli lie inside their 95 % "
        "intervals; of 3 moduli off by more than 3 standard deviations 1 are called trustworthy."
    )


def test_the_band_holds_a_curve_in_95_of_100_samples():
    at, low, high = ecdf_band(20)
    rng = np.random.default_rng(3)
    empirical = (rng.random((3000, 20, 1)) <= at).mean(axis=1) - at
    held = np.all((empirical >= low - 1e-12) & (empirical <= high + 1e-12), axis=1).mean()
    # Counts are whole numbers: no band has 95 % exactly.
    assert 0.94 < held < 0.985
    # Pointwise bands would hold it less often.
    assert np.all(high - low > 0)


def test_a_panel_for_each_world(runs):
    figure = calibration_figure(worlds_of(runs))
    titles = [axes.get_title() for axes in figure.axes if axes.axison]
    assert titles == ["reference\n2 of 2 trustworthy", "open shape off\n1 of 3 trustworthy"]


def test_a_kept_record_has_what_its_table_needs(tmp_path, runs):
    kept = {f"c-{k}": kept_of_patient(one) for k, one in enumerate(runs)}
    assert not kept["c-0"].findings.case.distances
    written = write_patients(tmp_path, kept, {})
    assert {path.name for path in written} >= {"calibration.md", "calibration.csv"}
    again = (tmp_path / "calibration.md").read_text()
    assert lines(tmp_path, runs)[1] == again
