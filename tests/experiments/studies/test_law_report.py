"""The study of the laws: what its table and figures say, from a record made by hand."""

import numpy as np
import pandas as pd
import pytest

from experiments.common.records.record import read_record, record_from, write_record
from experiments.studies.law.findings import Findings
from experiments.studies.law.report import curves_figure, law_text
from experiments.studies.law.study import STUDY
from mvest.errors import InputError
from tests.reporting.records import stored

STRETCH = np.linspace(1.0, 1.2, 5)


def curve(scale):
    return np.column_stack([scale * (STRETCH - 1), 0.5 * scale * (STRETCH - 1)]).tolist()


def parameter(name, truth, estimate, unit="MPa"):
    return {
        "name": name, "unit": unit, "truth": truth, "start": 0.03, "estimate": estimate,
        "std": 0.004, "bound": None if truth is None else 0.003,
    }  # fmt: skip


def sample(seed, estimate, low, high, *, converged=True):
    return {
        "seed": seed, "estimate": estimate, "low": low, "high": high, "converged": converged,
        "forward_solves": 5,
    }  # fmt: skip


DATA = {
    "schema": 2,
    "experiment": "law",
    "title": "Two laws",
    "row": "exponential law",
    "table": "law",
    "status": "converged",
    "reason": "completed",
    "detail": "",
    "seconds_total": 99.0,
    "forward_solves": 15,
    "model": None,
    "mesh": None,
    "noise_mm": 0.5,
    "chi_square_band": [0.97, 1.03],
    "parameters": ["c0.anterior", "c2.anterior"],
    "truth": [0.06, 1446.5],
    "samples": [
        sample(1, [0.058, 1300.0], [0.055, 1100.0], [0.0599, 1500.0]),
        sample(2, [0.061, 1400.0], [0.057, 1200.0], [0.065, 1600.0]),
        sample(3, [9.0, 9.0], [8.0, 8.0], [9.5, 9.5], converged=False),
    ],
    "stretches": {"anterior": {"along": [0.9, 1.0, 1.07], "across": [0.95, 1.1, 1.2]}},
    "fits": [
        {
            "law": "exponential",
            "parameters": [
                parameter("c0.anterior", 0.06, 0.0612),
                parameter("c2.anterior", 1446.5, 1390.0, ""),
            ],
            "distance_mm": {"mean": 0.021, "max": 0.4},
            "residual_rms_mm": 0.499, "chi_square": 0.996, "iterations": 5, "forward_solves": 6,
            "seconds": 41.0, "reason": "converged", "converged": True,
        },
        {
            "law": "linear",
            "parameters": [parameter("E_f.anterior", None, 2.5)],
            "distance_mm": {"mean": 0.31, "max": 1.2},
            "residual_rms_mm": 0.6, "chi_square": 1.44, "iterations": 7, "forward_solves": 8,
            "seconds": 52.0, "reason": "not converged: out of iterations", "converged": False,
        },
    ],
    "curves": {
        "anterior": {
            "stretch": STRETCH.tolist(),
            "truth": curve(1.0),
            "exponential": {"estimate": curve(1.1), "low": curve(0.9), "high": curve(1.3)},
            "linear": curve(2.0),
        }
    },
    "excised": {
        "anterior": {
            "stretch": STRETCH.tolist(), "stress": curve(0.2), "slope_at_rest": 0.06, "slope": 4.0,
            "reached": [1.17, None],
        }
    },
    "provenance": {
        "versions": {"mvest": "0.1.0"}, "git": {"sha": "a" * 40, "dirty": False},
        "config_hash": "b" * 64, "mesh_hash": "c" * 64, "seed": 1,
    },
}  # fmt: skip


def record(**changes):
    return record_from(stored(DATA | changes, "law"), Findings, "made up")


RECORD = record()


def test_the_table_has_both_fits_and_says_which_did_not_converge():
    text = law_text(RECORD)
    assert "| exponential | c0.anterior (MPa) | 0.06 | 0.03 | 0.0612 | 0.004 | 0.003 |" in text
    # No unit is no unit, and what the linear law looks for has no true value.
    assert "| exponential | c2.anterior | 1.45e+03 |" in text
    assert "| linear | E_f.anterior (MPa) | – | 0.03 | 2.5 | 0.004 | – |" in text
    assert "| exponential | 0.021 / 0.40 | 0.996 | 5 | 41 |" in text
    assert "| linear (not converged: out of iterations) | 0.310 / 1.20 | 1.440 | 7 | 52 |" in text
    assert "between 0.970 and 1.030" in text


def test_repeats_are_counted_without_those_that_gave_no_estimate():
    # The first interval of c0 ends below the truth of 0.06.
    text = law_text(RECORD)
    assert "from 3 samples of the errors, of which 2 gave" in text
    assert "| c0.anterior | 0.06 | 0.0595 | 0.058 to 0.061 | 1 of 2 |" in text
    assert "| c2.anterior | 1.45e+03 | 1.35e+03 | 1.3e+03 to 1.4e+03 | 2 of 2 |" in text


def test_published_files_come_out_of_the_record_again(tmp_path):
    (tmp_path / "results").mkdir()
    written = STUDY.write(tmp_path / "results", {"law": RECORD}, {})
    names = {path.name for path in written}
    assert {"law.csv", "law.md", "law.png", "law.pdf", "law_biaxial.png"} <= names
    table = pd.read_csv(tmp_path / "results" / "law.csv")
    assert list(table.parameter) == ["c0.anterior", "c2.anterior", "E_f.anterior"]
    assert table.chi_square_per_number.tolist() == [0.996, 0.996, 1.44]
    write_record(tmp_path / "law.json", RECORD)
    again = STUDY.write(tmp_path, {"law": read_record(tmp_path / "law.json", Findings)}, {})
    for path in again:
        if path.suffix in (".csv", ".md"):
            assert path.read_text() == (tmp_path / "results" / path.name).read_text()
    assert "| anterior | 0.06 | 4 | 1.17 / – |" in (tmp_path / "law.md").read_text()


def test_the_figure_shows_truth_estimates_band_and_what_was_seen():
    along, across = curves_figure(RECORD).axes
    for k, axes in enumerate((along, across)):
        lines = {line.get_label().split(",")[0]: line.get_ydata() for line in axes.get_lines()}
        assert set(lines) == {"truth", "exponential law", "linear law"}
        np.testing.assert_allclose(lines["truth"], np.array(curve(1.0))[:, k])
        np.testing.assert_allclose(lines["linear law"], np.array(curve(2.0))[:, k])
        stretches = RECORD.findings.stretches["anterior"]
        seen = stretches.along if k == 0 else stretches.across
        assert axes.patches[0].get_x() == seen[0]
        assert axes.patches[0].get_width() == pytest.approx(seen[2] - seen[0])
    assert "across" in across.get_title()


def test_a_run_without_a_fit_has_its_words_and_no_figure(tmp_path):
    bare = record(fits=[], curves={}, stretches={}, chi_square_band=None, samples=[])
    names = {path.name for path in STUDY.write(tmp_path, {"law": bare}, {})}
    assert "law.md" in names
    assert "law.png" not in names


def test_a_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        STUDY.write(tmp_path / "file", {"law": RECORD}, {})
