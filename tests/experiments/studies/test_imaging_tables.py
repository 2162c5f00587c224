"""Tables of the image step: sums by hand, targets, what was not found, and what is refused."""

from dataclasses import asdict, replace

import pandas as pd
import pytest

from experiments.common.records.record import record_from
from experiments.studies.imaging.findings import (
    DetectedVolume,
    Evaluation,
    Findings,
    KindOfVolume,
    Learning,
    Sequence,
)
from experiments.studies.imaging.report import write_imaging
from experiments.studies.imaging.tables import imaging_table, imaging_words
from mvest.errors import InputError
from tests.experiments.studies.made_up import made_up
from tests.experiments.studies.test_imaging_study import ACCURACY, CONFIDENCE, findings


def volume(setting, surface, area=2.0, ap=-0.5):
    found = surface is not None
    return DetectedVolume(
        setting=setting,
        valve="a",
        frame=0,
        confidence=0.9 if found else 0.1,
        surface_mm=surface,
        point_mm=2 * surface if found else None,
        tips_mm=1.0 if found else None,
        annulus_area_error_percent=area if found else None,
        ap_error_mm=ap if found else None,
        state_right=None,
        seconds=10.0,
    )


SEQUENCE = Sequence(
    setting="shifted", valve="a", frames=3, confidence=0.9, detected=True, wrong=False,
    surface_mm=1.0, points_mm=2.0, tips_mm=1.0, surface_open_mm=1.0, surface_closed_mm=1.0,
    annulus_area_error_percent=2.0, ap_error_mm=0.5, state_right_percent=100.0, seconds=10.0,
)  # fmt: skip
ROWS = [
    volume("shifted", 1.0),
    volume("in distribution", 0.4, area=-6.0, ap=1.0),
    volume("in distribution", 0.6, area=2.0, ap=-1.5),
    volume("in distribution", 2.0, area=1.0, ap=-1.0),
    volume("in distribution", None),
]


def test_a_setting_is_summarised_over_its_volumes():
    table = imaging_table(ROWS).set_index("setting")
    assert list(table.index) == ["in distribution", "shifted"]
    row = table.loc["in distribution"]
    assert row["volumes"] == 4
    assert row["surface mean [mm]"] == pytest.approx(1.0)
    assert row["surface median [mm]"] == pytest.approx(0.6)
    # A valve that was not found is no valve below 1.5 mm.
    assert row["valve detected [%]"] == pytest.approx(75.0)
    assert row["surface below 1.5 mm [%]"] == pytest.approx(50.0)
    assert row["point to point [mm]"] == pytest.approx(2.0)
    assert row["annulus area error [%]"] == pytest.approx(3.0)
    assert row["annulus area bias [%]"] == pytest.approx(-1.0)
    assert row["AP diameter error [mm]"] == pytest.approx(3.5 / 3)
    assert row["AP diameter bias [mm]"] == pytest.approx(-0.5)
    assert row["time per volume [s]"] == 10.0
    assert table.loc["shifted", "surface 90 % [mm]"] == pytest.approx(1.0)


def test_targets_stand_beside_what_was_measured():
    table = imaging_table(ROWS)
    words = imaging_words(
        table,
        {
            "in distribution": {"surface mean [mm]": 0.8, "surface below 1.5 mm [%]": 45.0},
            "shifted": {"surface 90 % [mm]": 1.0},
        },
    )
    assert words == [
        "In distribution: surface mean [mm] 1 (target ≤ 0.8: missed), "
        "surface below 1.5 mm [%] 50 (target ≥ 45: met).",
        "Shifted: surface 90 % [mm] 1 (target ≤ 1: met).",
    ]
    assert imaging_words(table) == []
    for wrong in ({"moved": {"surface mean [mm]": 1.0}}, {"shifted": {"colour": 1.0}}):
        with pytest.raises(InputError, match="targets"):
            imaging_words(table, wrong)


def test_the_files_say_what_the_truth_is_and_the_target(tmp_path):
    tested = Evaluation(
        rows=tuple(ROWS),
        training=tuple(Learning("pose", n, "shifted", 1.0, 2.0, "degrees", 3) for n in (10, 20)),
        confidence=replace(
            CONFIDENCE, rows=(KindOfVolume("shifted", 2, 0.6, 0.75, 0.9, 100.0, 50.0),)
        ),
        sequences=(SEQUENCE,),
        accuracy=ACCURACY,
    )
    targets = {"in distribution": {"surface mean [mm]": 0.8}}
    record = made_up(findings(tested=tested, targets=targets), experiment="imaging")
    written = write_imaging(tmp_path, {"imaging": record}, {})
    tables = ("imaging", "imaging_sequences", "imaging_confidence")
    figures = ("distance", "training", "confidence", "std", "correlation")
    assert {path.name for path in written} == {
        *(f"{name}.{kind}" for name in tables for kind in ("csv", "md", "tex")),
        *(f"imaging_{name}.{kind}" for name in figures for kind in ("png", "pdf")),
    }
    text = (tmp_path / "imaging.md").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert len(lines) == 2 + 2 + 1
    assert lines[3].startswith("| – its target |")
    assert "≤ 0.8" in lines[3]
    assert "Simulated transoesophageal echo" in text
    assert "missed" in text
    read = pd.read_csv(tmp_path / "imaging.csv", comment="#")
    assert read["surface mean [mm]"].tolist() == [1.0, 1.0]
    assert (tmp_path / "imaging.tex").read_text(encoding="utf-8").count(r"\\") == 4


@pytest.mark.parametrize(
    ("rows", "message"), [([], "no rows"), ([volume("moved", 1.0)], "setting moved")]
)
def test_rows_that_are_none_are_refused(rows, message):
    with pytest.raises(InputError, match=message):
        imaging_table(rows)


def test_a_row_without_an_entry_is_refused():
    tested = Evaluation(
        rows=tuple(ROWS), training=(), confidence=CONFIDENCE, sequences=(), accuracy=ACCURACY
    )
    data = asdict(made_up(findings(tested=tested)))
    del data["findings"]["tested"]["rows"][0]["point_mm"]
    with pytest.raises(InputError, match=r"rows\.0\.point_mm"):
        record_from(data, Findings, "this")
