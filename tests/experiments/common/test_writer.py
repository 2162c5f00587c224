"""The one writer of results: what it writes of any study, a failed run's included."""

from dataclasses import dataclass

from matplotlib.figure import Figure

from experiments.common.records.writer import words_of, write_results
from experiments.common.study import Results, Study
from mvest.reporting.tables import Column, table
from tests.experiments.studies.made_up import made_up


@dataclass(frozen=True)
class Settings:
    """None."""


def summary(results):
    rows = results.table().rows
    return {"mean": table([{"mean": sum(row["x"] for row in rows) / len(rows)}], mean="mm:.1f")}


STUDY = Study(
    settings=Settings,
    run=lambda job: None,  # type: ignore[arg-type, return-value]
    summary=summary,
    figure=lambda results: Figure(),
    captions={"": "A figure."},
    latex=("t_mean",),
)
ROWS = table([{"x": 1.0}, {"x": 2.0}], x=Column("mm", ".2f"))


def results(**header):
    record = made_up(table="t", tables={"": ROWS.plain()}, numbers={"n": 2}, **header)
    return Results({"t": record})


def test_a_study_gets_tables_page_and_figure(tmp_path):
    written = {path.name for path in write_results(tmp_path, STUDY, results())}
    assert written == {"t.csv", "t_mean.csv", "t_mean.tex", "t.md", "t.png"}
    assert (tmp_path / "t.csv").read_text().splitlines()[1:] == ["x [mm]", "1.0", "2.0"]
    page = (tmp_path / "t.md").read_text()
    assert "| 1.5 |" in page
    assert "![A figure.](t.png)" in page
    assert "commit 0123456789ab+changes" in page


def test_a_run_that_failed_early_says_why(tmp_path):
    record = made_up(table="t", status="failed", reason="the valve does not close")
    names = {path.name for path in write_results(tmp_path, STUDY, Results({"t": record}))}
    assert names == {"t.md"}
    assert "no result: the valve does not close" in words_of(STUDY, record)


def test_what_did_not_pass_the_gate_is_said_before_anything_else():
    said = words_of(STUDY, results(gate="NOT passed on 54 x 6 hex18").first)
    assert said.startswith("The anatomy did NOT pass the gate")


def test_a_long_table_is_named_as_a_file(tmp_path):
    rows = table([{"x": float(k)} for k in range(61)], x="mm")
    record = made_up(table="t", tables={"": rows.plain()})
    write_results(tmp_path, Study(settings=Settings, run=STUDY.run), Results({"t": record}))
    assert "61 rows: t.csv" in (tmp_path / "t.md").read_text()
