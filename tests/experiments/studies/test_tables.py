import io

import pandas as pd
import pytest

from experiments.studies.twin.report import frame, readable, text_table, write_tables
from tests.reporting.records import failed_record as failed_data
from tests.reporting.records import record as data
from tests.reporting.records import twin


def record(**changes):
    return twin(data(**changes))


def failed_record(**changes):
    return twin(failed_data(**changes))


def test_our_row_stands_below_the_papers() -> None:
    table = frame([record()])
    assert list(table["source"]) == ["paper", "mvest"]
    assert list(table["estimate E_f.anterior [MPa]"]) == [6.02, 6.2296]
    assert list(table["distance mean [mm]"]) == [0.06, 0.0004]
    # -6.4e-5 of the truth is an error of 0.0064 %, without sign.
    assert list(table["error E_f.anterior [%]"]) == pytest.approx([3.37, 0.0064])


def test_a_run_without_a_published_counterpart_stands_alone() -> None:
    assert list(frame([record(paper=None)])["source"]) == ["mvest"]


def test_a_failed_run_keeps_its_row_and_its_reason() -> None:
    table = frame([record(), failed_record(row="tet4")])
    assert table["status"].iloc[-1] == "failed"
    assert "no prediction" in table["reason"].iloc[-1]
    assert pd.isna(table["estimate E_f.anterior [MPa]"].iloc[-1])
    reading = readable([record(), failed_record(row="tet4")])
    assert reading["ended"].iloc[-1] == "not converged"
    assert reading["E_f.anterior [MPa]"].iloc[-1] == "–"


def test_numbers_are_rounded_for_reading() -> None:
    reading = readable([record()])
    assert reading["E_f.anterior [MPa]"].to_list() == ["6.02", "6.23 ± 0.02"]
    assert reading["error of all moduli [%]"].to_list() == ["2.84 ± 0.67", "0.0056 ± 8.0e-04"]
    assert "6.23 ± 0.02" in text_table([record()])


def test_files_hold_the_same_numbers_and_their_provenance(tmp_path) -> None:
    paths = write_tables(tmp_path, "table1", [record(), failed_record(row="tet4")])
    assert [path.name for path in paths] == ["table1.csv", "table1.md", "table1.tex"]
    csv, markdown, tex = (path.read_text(encoding="utf-8") for path in paths)
    for text in (csv, markdown, tex):
        assert "commit 0123456789ab+changes, configuration cdcdcdcdcdcd" in text
    back = pd.read_csv(io.StringIO(csv), comment="#")
    assert back["estimate E_f.posterior [MPa]"].to_list()[:2] == [2.13, 2.0901]
    rows = [line for line in markdown.splitlines() if line.startswith("|")]
    assert len(rows) == 2 + 3
    assert len({line.count("|") for line in rows}) == 1
    body = [line for line in tex.splitlines() if line.endswith(r"\\")]
    assert {line.count(" & ") for line in body} == {3}
    assert r"$\pm$" in tex
    assert r"E\_f.anterior" in tex
    assert "–" not in tex


def test_equal_records_give_equal_files(tmp_path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_tables(tmp_path / name, "t", [record()])
    for suffix in ("csv", "md", "tex"):
        first, second = ((tmp_path / n / f"t.{suffix}").read_bytes() for n in ("a", "b"))
        assert first == second
