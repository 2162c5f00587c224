"""Tables of the image step: sums by hand, targets, what was not found, and what is refused."""

import pandas as pd
import pytest

from experiments.studies.imaging.tables import imaging_table, imaging_words, write_imaging_tables
from mvest.errors import InputError

PROVENANCE = {
    "experiment": "imaging",
    "provenance": {
        "git": {"sha": "0123456789abcdef", "dirty": False},
        "versions": {"mvest": "0.1.0"},
        "config_hash": "c" * 64,
        "mesh_hash": "d" * 64,
        "seed": 1,
    },
}


def volume(setting, surface, area=2.0, ap=-0.5):
    found = surface is not None
    return {
        "setting": setting,
        "surface_mm": surface,
        "point_mm": 2 * surface if found else None,
        "tips_mm": 1.0 if found else None,
        "annulus_area_error_percent": area if found else None,
        "ap_error_mm": ap if found else None,
        "seconds": 10.0,
    }


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
    assert row["valve found [%]"] == pytest.approx(75.0)
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
    training = [
        {
            "stage": "pose", "training_volumes": n, "setting": "shifted", "median": 1.0, "p90": 2.0,
            "unit": "degrees",
        }
        for n in (10, 20)
    ]  # fmt: skip
    record = PROVENANCE | {
        "rows": ROWS,
        "targets": {"in distribution": {"surface mean [mm]": 0.8}},
        "training": training,
    }
    written = write_imaging_tables(tmp_path, record)
    assert {path.name for path in written} == {
        "imaging.csv", "imaging.md", "imaging.tex", "imaging_distance.png",
        "imaging_distance.pdf", "imaging_training.png", "imaging_training.pdf",
    }  # fmt: skip
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
    ("rows", "message"),
    [
        ([], "no rows"),
        ([volume("moved", 1.0)], "setting moved"),
        ([{"setting": "shifted", "surface_mm": 1.0}], "row 0 has no point_mm"),
    ],
)
def test_rows_that_are_none_are_refused(rows, message):
    with pytest.raises(InputError, match=message):
        imaging_table(rows)
