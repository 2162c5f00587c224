"""Tables: exact for programs, rounded and joined for readers, and safe against markup in texts."""

import io
from dataclasses import dataclass

import numpy as np
import pandas as pd
import pytest

from mvest.errors import InputError
from mvest.reporting.tables import Column, Table, joined, table

ROWS = [
    {"run": "a", "E": 6.2296, "sd": 0.0213, "low": 6.1, "high": 6.3, "truth": 6.23, "n": 5},
    {"run": "b|<i>", "E": None, "sd": None, "low": None, "high": None, "truth": 6.23, "n": None},
    {"run": "c", "E": 5.0, "sd": 0.1, "low": 4.8, "high": 5.2, "truth": 6.23, "n": 7},
]
WHOLE = table(ROWS, E=Column("MPa", ".2f", low="low", high="high", truth="truth"), sd="MPa")


def test_programs_get_every_column_exactly() -> None:
    back = pd.read_csv(io.StringIO(WHOLE.csv()))
    assert list(back) == ["E [MPa]", "sd [MPa]", "run", "low", "high", "truth", "n"]
    assert back["E [MPa]"][0] == 6.2296
    assert np.isnan(back["E [MPa]"][1])
    # A missing count does not turn the others into 5.0.
    assert ",5\n" in WHOLE.csv()


def test_readers_get_one_rounded_cell_and_a_cross_where_the_truth_is_outside() -> None:
    cells = [row["E (MPa)"] for row in WHOLE.readable()]
    assert cells == ["6.23 (6.10 to 6.30)", "–", "5.00 (4.80 to 5.20) ✗"]
    assert set(WHOLE.readable()[0]) == {"E (MPa)", "sd (MPa)", "truth", "run", "n"}
    spread = table(ROWS, E=Column("MPa", std="sd"))
    assert spread.readable()[0]["E (MPa)"] == "6.23 ± 0.021"


def test_no_text_of_a_run_acts() -> None:
    assert "<i>" not in WHOLE.markdown()
    assert {line.count(" | ") for line in WHOLE.markdown().splitlines()} == {4}


def test_a_table_comes_back_from_plain_data() -> None:
    back = Table.of_plain(WHOLE.plain(), "here")
    assert back.values == WHOLE.values
    assert back.columns == WHOLE.columns
    for wrong in ({}, {"columns": {"E": {"colour": "red"}}, "values": {}}):
        with pytest.raises(InputError, match="here is no table"):
            Table.of_plain(wrong, "here")
    with pytest.raises(InputError, match="differ in length"):
        Table.of_plain({"columns": {}, "values": {"a": [1], "b": [1, 2]}}, "here")


def test_rows_may_be_dataclasses_or_a_frame_and_become_plain() -> None:
    @dataclass
    class Row:
        x: float
        ok: bool

    assert table([Row(np.float64("nan"), True)]).rows == [{"x": None, "ok": True}]  # type: ignore[arg-type]
    frame = pd.DataFrame({"x": np.arange(2)})
    assert table(frame).values == {"x": [0, 1]}
    with pytest.raises(InputError, match="without the column y"):
        table(frame, y="mm")


def test_tables_below_each_other_say_where_rows_come_from() -> None:
    both = joined({"one": table([{"x": 1.0}], x="mm"), "two": table([{"x": 2.0, "y": 3}])})
    assert both.rows == [{"run": "one", "x": 1.0, "y": None}, {"run": "two", "x": 2.0, "y": 3}]
    assert both.columns["x"].unit == "mm"
