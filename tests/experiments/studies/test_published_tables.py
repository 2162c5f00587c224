"""The published tables follow from the published records: what every study makes of its runs.

A change of any statistic, column, unit or order of rows shows here, on real results.
"""

from dataclasses import replace
from io import StringIO

import pandas as pd
import pytest

from experiments.common.records.writer import write_results
from experiments.common.study import load_study
from experiments.results.published import records_of
from tests.places import ROOT

RESULTS = ROOT / "results"
TABLES = sorted(path.stem for path in (RESULTS / "records").glob("*.jsonl"))


@pytest.mark.parametrize("table", TABLES)
def test_tables_follow_from_records(table: str, tmp_path) -> None:
    found = records_of(RESULTS, table)
    assert found is not None
    study = replace(load_study(found.first.study), figure=None)
    written = [path for path in write_results(tmp_path, study, found) if path.suffix == ".csv"]
    assert written
    for path in written:
        now, then = path.read_text(), (RESULTS / path.name).read_text()
        if now != then:  # the last digit depends on the machine
            frames = (pd.read_csv(StringIO(text), comment="#") for text in (now, then))
            pd.testing.assert_frame_equal(*frames, rtol=1e-12, obj=path.name)
